"""All named faults, and which are run where."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from faults import catalogue_bus, catalogue_frames, catalogue_service, catalogue_state
from faults.drive import SHORT
from faults.fault import UNDISTURBED, Fault

ON_ANY_BUS: Final = [*catalogue_frames.ALL, *catalogue_service.ALL, *catalogue_state.ALL]
ON_UDP: Final = [*ON_ANY_BUS, *catalogue_service.UDP_ONLY]

ON_KERNEL: Final = ("error frames", "remote frames")
"""Faults that a kernel's bus treats in its own way: run there too."""

ON_VCAN: Final = [
    *catalogue_bus.ALL,
    *(fault for fault in ON_ANY_BUS if fault.name in ON_KERNEL),
]
"""What `vcan` runs unless told otherwise; it can run everything of `ON_ANY_BUS` besides."""

EVERYTHING: Final = {fault.name: fault for fault in [*ON_UDP, *catalogue_bus.ALL]}


def undisturbed(like: Fault) -> Fault:
    """Return the run without a fault that another one is compared with."""
    return Fault(UNDISTURBED, "nothing", like.profile, config=like.config, vehicle=like.vehicle)


def shortened(fault: Fault) -> Fault:
    """Return a fault of the replay clock with the short profile, for tests."""
    return replace(fault, profile=SHORT)
