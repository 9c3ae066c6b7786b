"""All signals of a vehicle together: which values go on, and what the status must say of the rest.

What cannot be is decided by the pack's model where there is one: its resistance couples current
and voltage (`stuck`), its voltage bounds what a pack can show. Without a model only what the
mapping states is checked, so that a wrong scale in a mapping is seen as such by whoever reads a
capture, and not as a signal that never comes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
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


_NO_FAULT: Final = Fault.NONE

Watch = Callable[[float, float], bool]
"""Takes a value and its bus time [s]; returns whether the signal is stuck."""


class SignalGate:
    """Reads one signal, and lets through what may be used.

    Parameters
    ----------
    signal : BoundSignal
    health : SignalHealth
    is_stuck : Watch, optional
    fate : MessageCounters
        Where it is counted what became of a value.
    """

    __slots__ = ("_decode", "_fate", "_gain", "_health", "_is_in", "_is_stuck", "_offset")

    def __init__(
        self,
        signal: BoundSignal,
        health: SignalHealth,
        is_stuck: Watch | None,
        fate: MessageCounters,
    ) -> None:
        codec = signal.codec
        self._decode = codec.decode
        self._is_in = codec.is_in if codec.conditions else None
        self._gain, self._offset = signal.gain, signal.offset
        self._health = health
        self._is_stuck = is_stuck
        self._fate = fate

    def read(self, payload: bytes | bytearray, time_s: float) -> float:
        """Return the value [A, V, °C, %]; NaN if the frame has none or it is not to be used.

        Parameters
        ----------
        payload : bytes
            Of the message's own length.
        time_s : float
            Bus time [s].
        """
        if self._is_in is not None and not self._is_in(payload):
            return math.nan
        value = self._gain * self._decode(payload) + self._offset  # as `BoundSignal.decode`
        health, is_stuck = self._health, self._is_stuck
        fault = health.judge(value, time_s)
        if fault is _NO_FAULT:
            if is_stuck is None or not is_stuck(value, time_s):
                if health.take(value, time_s):
                    return value
                self._fate.held_back += 1
                return math.nan
            fault = Fault.STUCK
        self._refuse(fault)
        return math.nan

    def _refuse(self, fault: Fault) -> None:
        self._health.fail(fault)
        if fault is Fault.NOT_AVAILABLE:
            self._fate.not_available += 1
        elif fault is Fault.STUCK:
            self._fate.stuck += 1
        else:
            self._fate.implausible += 1


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

    def __getitem__(self, role: str) -> SignalHealth:
        """Return what is known of one signal."""
        return self._of[role]

    def gate(self, signal: BoundSignal, fate: MessageCounters) -> SignalGate:
        """Return what reads a signal's values; what becomes of them is counted in `fate`."""
        return SignalGate(signal, self._of[signal.role], self._watch(signal), fate)

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
        return math.nan if health is None else health.value_at(now_s)

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

    def _watch(self, signal: BoundSignal) -> Watch | None:
        """Return what notices that a signal is stuck; None where nothing can."""
        if signal.role == "temperature" and signal.checks.stuck_after_s < math.inf:
            return _StillFor(signal.checks.stuck_after_s)
        if self._pair is not None and signal.role in _FAST:
            return self._pair.current if signal.role == "current" else self._pair.voltage
        return None


class _StillFor:
    """Says that a signal is stuck once it has stood still for a stated time [s]."""

    def __init__(self, after_s: float) -> None:
        self._after_s = after_s
        self._still = Still(0.0)

    def __call__(self, value: float, time_s: float) -> bool:
        moved = self._still.take(value, time_s)
        return not moved and time_s - self._still.since_s >= self._after_s


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
