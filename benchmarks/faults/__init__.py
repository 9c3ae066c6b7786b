"""Fault injection on a live bus: named faults of input, bus, service and state, and their results.

    make faults        (or: PYTHONPATH=benchmarks python -m faults --help)

The service runs in its own process and is observed by its command line, its exit status and its
published frames (`dbc/soc_estimate.dbc`) only.

fault      a fault: name, description, what it changes and does
catalogue  the named faults; add one here
frames     a log → frames with times, and changes of values and frames
stamps     changed time stamps
actions    actions on the service, its files, the bus interface and the machine
bench      one service on one bus
line       a separate bus for each fault: UDP multicast, or a vcan interface
process    the process of the service
run        one fault, or all of them in parallel
criteria   observation → verdict → table
"""
