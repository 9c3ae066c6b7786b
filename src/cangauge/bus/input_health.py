"""All signals of a vehicle together: which values go on, and what the status must say of the rest.

What cannot be is decided by the pack's model where there is one: its resistance couples current
and voltage (`stuck`), its voltage bounds what a pack can show. Without a model only what the
mapping states is checked, so that a wrong scale in a mapping is seen as such by whoever reads a
capture, and not as a signal that never comes.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

from cangauge.bus.bound import BoundSignal, Vehicle
from cangauge.bus.counters import MessageCounters
from cangauge.bus.signal_checks import SignalChecks
from cangauge.bus.signal_health import Fault, SignalHealth
from cangauge.bus.stuck import Pack, Still, StuckPair
from cangauge.estimate.types import Reason
from cangauge.estimate.validity import CURRENT_AT_MOST_A, TEMPERATURE_WITHIN_C, VOLTAGE_WITHIN

_FAST: Final = {"current", "voltage"}
_MISSING: Final = {
    "current": Reason.CURRENT_MISSING,
    "voltage": Reason.VOLTAGE_MISSING,
    "temperature": Reason.TEMPERATURE_MISSING,
}
_WHY: Final = {
    Fault.NONE: Reason.NONE,
    Fault.PROTECTION: Reason.PROTECTION_FAILED,
    Fault.REPEATED: Reason.PROTECTION_FAILED,
    Fault.NOT_AVAILABLE: Reason.NONE,
    Fault.RANGE: Reason.IMPLAUSIBLE_INPUT,
    Fault.RATE: Reason.IMPLAUSIBLE_INPUT,
    Fault.STUCK: Reason.SIGNAL_STUCK,
}


TEMPERATURE_JUMP_K: Final = 5.0
TEMPERATURE_RATE_K_PER_S: Final = 1.0
"""A battery is heavy: coarse steps, and two sensors taking turns, stay below this. Current and
voltage may change as fast as they like: contactors, fuses, short circuits."""


class InputHealth:
    """Judges every value of a vehicle's signals; pure, driven by the frames' time stamps alone.

    Parameters
    ----------
    vehicle : Vehicle
    pack : Pack, optional
        What the model knows of the pack; without it no signal of it is ever called stuck, and
        only stated ranges are checked.
    """

    def __init__(self, vehicle: Vehicle, pack: Pack | None = None) -> None:
        self._signals = vehicle.signals
        self._of: dict[str, SignalHealth] = {
            signal.role: SignalHealth(
                signal.checks if pack is None else _bounded(signal.role, signal.checks, pack),
                # Not every frame of a multiplexed message has the signal: its period is learned.
                None if signal.codec.conditions else vehicle.messages[signal.key].period_s,
                is_cyclic=signal.role in _FAST,
            )
            for signal in vehicle.signals
        }
        self._pair = None if pack is None else _pair(vehicle, pack)
        self._still_temperature = Still(0.0)

    def __getitem__(self, role: str) -> SignalHealth:
        """Return what is known of one signal."""
        return self._of[role]

    def passed(
        self, signal: BoundSignal, value: float, time_s: float, fate: MessageCounters
    ) -> float:
        """Return a value if it may be used, else NaN; what became of it is counted in `fate`."""
        health = self._of[signal.role]
        fault = health.judge(value, time_s)
        if fault is Fault.NONE and self._is_stuck(signal, value, time_s):
            fault = Fault.STUCK
        if fault is Fault.NONE:
            if health.take(value, time_s):
                return value
            fate.held_back += 1
            return math.nan
        health.fail(fault)
        if fault is Fault.NOT_AVAILABLE:
            fate.not_available += 1
        elif fault is Fault.STUCK:
            fate.stuck += 1
        else:
            fate.implausible += 1
        return math.nan

    def refused(self, key: int, fault: Fault) -> None:
        """Take note that a frame of the message with that key was refused."""
        for signal in self._signals:
            if signal.key == key:
                self._of[signal.role].fail(fault)

    def rewind(self, time_s: float) -> None:
        """Time runs backwards to `time_s` [s]."""
        for health in self._of.values():
            health.rewind(time_s)

    def latest(self, role: str, now_s: float) -> float:
        """Return a signal's latest value if it still holds at bus time `now_s` [s], else NaN."""
        health = self._of.get(role)
        return health.latest if health is not None and health.is_usable(now_s) else math.nan

    @property
    def latest_s(self) -> dict[str, float]:
        """Bus time of the latest good value by role [s]; NaN before the first."""
        return {role: health.latest_s for role, health in self._of.items()}

    def reasons(self, now_s: float) -> Reason:
        """Return which signals are not to be had at bus time `now_s` [s], and why.

        One that is missing without a reason is too old, never came, or its sender says "not
        available".
        """
        reasons = Reason.NONE
        for role, missing in _MISSING.items():
            health = self._of.get(role)
            if health is not None and not health.is_usable(now_s):
                reasons |= missing
                if health.is_failing:
                    reasons |= _WHY[health.fault]
        return reasons

    def _is_stuck(self, signal: BoundSignal, value: float, time_s: float) -> bool:
        if signal.role == "temperature":
            after_s = signal.checks.stuck_after_s
            if after_s == math.inf or self._still_temperature.take(value, time_s):
                return False
            return time_s - self._still_temperature.since_s >= after_s
        if self._pair is None:
            return False
        if signal.role == "current":
            return self._pair.current(value, time_s)
        return signal.role == "voltage" and self._pair.voltage(value, time_s)


def _bounded(role: str, checks: SignalChecks, pack: Pack) -> SignalChecks:
    """Return the checks with what no pack can be in place of limits that are not stated."""
    limits = {
        "current": (-CURRENT_AT_MOST_A, CURRENT_AT_MOST_A),
        "voltage": (VOLTAGE_WITHIN[0] * pack.usual_v, VOLTAGE_WITHIN[1] * pack.usual_v),
        "temperature": TEMPERATURE_WITHIN_C,
    }
    low, high = limits.get(role, (-math.inf, math.inf))
    if role == "temperature" and checks.max_jump == math.inf:
        checks = replace(
            checks, max_jump=TEMPERATURE_JUMP_K, max_rate_per_s=TEMPERATURE_RATE_K_PER_S
        )
    return replace(
        checks,
        lowest=low if checks.lowest == -math.inf else checks.lowest,
        highest=high if checks.highest == math.inf else checks.highest,
    )


def _pair(vehicle: Vehicle, pack: Pack) -> StuckPair:
    current, voltage = vehicle.current, vehicle.voltage
    return StuckPair(
        pack,
        current_step_a=2.0 * current.half_step,
        voltage_step_v=2.0 * voltage.half_step,
        current_after_s=current.checks.stuck_after_s,
        voltage_after_s=voltage.checks.stuck_after_s,
    )
