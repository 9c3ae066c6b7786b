"""Validation: simulated truth, and what the diagnosis finds of it.

    twin        packs, drives and faults whose cause is known; shares nothing with what it validates
    gap_check   every effect injected into healthy logs of a pack, each left out in turn

The public names are those of the twin, loaded on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cangauge.extras.validation.twin import (
        Fault,
        FaultKind,
        Simulation,
        fault_kinds,
        simulate,
    )

__all__ = ["Fault", "FaultKind", "Simulation", "fault_kinds", "simulate"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module("cangauge.extras.validation.twin"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
