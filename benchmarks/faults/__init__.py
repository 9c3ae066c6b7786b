"""Faults on a live bus: named ways to break input, bus, service and state, a table of what comes.

    make faults        (or: PYTHONPATH=benchmarks python -m faults --help)

The service runs in a process of its own and is known by its command line, its exit status and the
frames that it publishes (`dbc/soc_estimate.dbc`) alone.

drive      a log → frames with times; what a fault may change
alter      changes of values and frames, pure and seeded
catalogue  the named faults (`catalogue_frames`, `_service`, `_state`, `_bus`)
line       a bus of its own for each fault: UDP multicast, or a vcan interface
process    the service's process
bench      one service on one line, with what a fault may do to it
run        plays one fault, watches what is published
judge      what was observed → passed or not, and why
table      rows for people, JSON for programs
"""
