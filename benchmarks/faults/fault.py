"""What a fault is: a name, what is done in words, and what is done."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import Any, Final, Literal

from faults.drive import FAST, FrameChange, Profile, ValueChange
from faults.stage import Stage

Need = Literal["vcan", "root", "state", "alone"]
"""An interface that can be taken down; rights of root; a service with --state; no other run
beside it (it turns what all share)."""


@dataclass(frozen=True)
class Action:
    """Something done to the service, the bus or the machine at a time of the profile [s]."""

    at_s: float
    do: Callable[[Stage], None]


Plan = Callable[[Profile, Random], list[Action]]


@dataclass(frozen=True)
class Fault:
    """One row of the table.

    Parameters
    ----------
    name : str
    done : str
        What is done, in words.
    profile : Profile
    values, frames : callable, optional
        Changes of what is sent.
    untrue : tuple of str
        Roles whose values cannot be trusted while `values` acts.
    plan : callable, optional
        What is done besides.
    needs : frozenset of str
    config : dict
        Keys of the service's configuration.
    vehicle : str
        "generic" or "float": the same signals as IEEE floats, without CRC.
    cold : bool
        Start the service in a fresh interpreter.
    """

    name: str
    done: str
    profile: Profile = FAST
    values: ValueChange | None = None
    untrue: tuple[str, ...] = ()
    frames: FrameChange | None = None
    plan: Plan | None = None
    needs: frozenset[Need] = frozenset()
    config: dict[str, Any] = field(default_factory=dict)
    vehicle: str = "generic"
    cold: bool = False

    @property
    def alike(self) -> tuple[str, str, str]:
        """What a run must share with this one to be its undisturbed run."""
        return self.profile.name, self.vehicle, repr(sorted(self.config.items()))


UNDISTURBED: Final = "undisturbed"


def at(share: float, do: Callable[[Stage], None]) -> Plan:
    """Return the plan that does one thing at a share of the fault's time."""
    return during((share, do))


def during(*steps: tuple[float, Callable[[Stage], None]]) -> Plan:
    """Return the plan that does things at shares of the fault's time."""

    def plan(profile: Profile, _rng: Random) -> list[Action]:
        first, last = profile.fault_s
        return [Action(first + share * (last - first), do) for share, do in steps]

    return plan
