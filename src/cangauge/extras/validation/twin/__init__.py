"""Simulated truth: packs, drives and faults whose cause is known.

Independent of what it validates: it imports neither the voltage model nor the effects library,
identification, estimation or diagnosis, and shares no equation with them except where a plant
states it.
"""

from __future__ import annotations

from cangauge.extras.validation.twin.faults import Fault, FaultKind, fault_kinds
from cangauge.extras.validation.twin.simulation import Simulation, simulate

__all__ = ["Fault", "FaultKind", "Simulation", "fault_kinds", "simulate"]
