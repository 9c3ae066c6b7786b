"""Simulated truth: packs, drives and faults whose cause is known.

    pack, packs.toml       cells, impedances, masses and sensors, drawn
    drive                  speed → power → current, and the weather
    physics                voltage, state of charge, heat and temperatures under a current
    faults, faults.toml    what may be wrong, of what size
    recording              what the sensors read, as a log
    injection              the same for a recorded log
    simulation             `simulate`: all of it by one seed

Independent of what it validates: it imports neither the voltage model nor the effects library,
identification, estimation or diagnosis, and shares no equation with them except where a module
states it.
"""
