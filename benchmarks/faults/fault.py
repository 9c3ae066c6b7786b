"""Faults: a name, a description, changes of samples and frames, and planned actions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import Any, Final, Literal

from cangauge.types import Reason
from faults.bench import Bench
from faults.frames import FAST, FrameChange, Profile, ValueChange
from faults.process import Target

Need = Literal["vcan", "root", "state", "alone"]
"""A vcan interface; root rights; a service with --state; no other run at the same time."""


@dataclass(frozen=True)
class Action:
    """An action on the service, the bus or the machine at a time of the profile [s]."""

    at_s: float
    do: Callable[[Bench], None]


Plan = Callable[[Profile, Random], list[Action]]


@dataclass(frozen=True)
class Fault:
    """One fault, a row of the table.

    Parameters
    ----------
    name : str
    description : str
        What is done, for the table.
    profile : Profile
    values, frames : callable, optional
        Changes of the samples and of the frames that are sent.
    untrusted : tuple of str
        Roles whose values are invalid while `values` acts.
    plan : callable, optional
        Actions during the run.
    needs : frozenset of str
    config : dict
        Keys of the service's configuration.
    vehicle : str
        "generic", or "float": IEEE floats without CRC.
    target : callable, optional
        Instead of the service as it is: with changed stamps (see `stamps`).
    reports : Reason
        Must be published while the fault lasts, and no valid estimate from `REPORTED_S` on.
    recovers : bool
        Whether the estimate must be valid again at the end.
    """

    name: str
    description: str
    profile: Profile = FAST
    values: ValueChange | None = None
    untrusted: tuple[str, ...] = ()
    frames: FrameChange | None = None
    plan: Plan | None = None
    needs: frozenset[Need] = frozenset()
    config: dict[str, Any] = field(default_factory=dict)
    vehicle: str = "generic"
    target: Target | None = None
    reports: Reason = Reason.NONE
    recovers: bool = False

    @property
    def reference_key(self) -> tuple[str, str, str]:
        """Key of the undisturbed run that a run is compared with."""
        return self.profile.name, self.vehicle, repr(sorted(self.config.items()))


UNDISTURBED: Final = "undisturbed"


def at(share: float, do: Callable[[Bench], None]) -> Plan:
    """Plan one action at a fraction of the fault's time."""
    return during((share, do))


def during(*steps: tuple[float, Callable[[Bench], None]]) -> Plan:
    """Plan actions at fractions of the fault's time."""

    def plan(profile: Profile, _rng: Random) -> list[Action]:
        first, last = profile.fault_s
        return [Action(first + share * (last - first), do) for share, do in steps]

    return plan
