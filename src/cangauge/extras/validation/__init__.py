"""Validation: simulated truth, and what the diagnosis finds of it.

twin        packs, drives and faults whose cause is known; shares nothing with what it validates
gap_check   every effect injected into healthy logs of a pack, each left out in turn
"""
