"""When the values of a signal are believed: limits by default, and what a mapping states.

Whether a signal can be trusted now: debounced, timed out; a function of its frames alone.

Rules
-----
- A value that fails (frame refused, "not available", out of range, too fast, stuck) is never used.
- So many failures in a row make the signal invalid; then good values are held back, too, until so
  many of them came in a row (copies of a frame between them do not matter). A signal that was
  never valid becomes so with its first good value.
- Too fast means: farther from the latest good value than the time since allows. That grows, so that
  a signal that really is elsewhere now comes back.
- A signal without a good value for longer than its time-out is old, until the next good one.
- The time-out is the stated one. Otherwise it comes from the period p, stated or learned from the
  frames' stamps: 10·p, within half a second and what is usual for the role; at least 3·p.
  Temperature and SoC, which many senders send when they change, never time out sooner than usual.

Times are bus time, so that a live run and its recording judge alike.

A signal that stands still while another one proves that it should move.

Current and voltage of a pack move together: U falls by R1·I at once. A voltage whose code does
not change at all while the current swings to and fro, again and again, by so much that R1·ΔI is
many steps of the voltage, is stuck; and the other way round. Nothing is called stuck

- at rest, where neither moves;
- in a charge at constant current, where the voltage creeps one way: swings are counted, to and
  fro, not drift;
- for a voltage meter's noise beside a current of exactly 0: a swing of the voltage must be many
  times the model's own error.

Temperature has no such partner: coarse and slow, it stands still for hours in a healthy car. It
is called stuck only after a time that the user states.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, replace
from typing import Final

from cangauge.bus.mapping import CheckMap

# --- When the values of a signal are believed: limits by default, and what a mapping states

INVALID_AFTER: Final = 5
VALID_AFTER: Final = 3
STUCK_AFTER_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class SignalChecks:
    """What a signal's values must satisfy, and how many may fail.

    Parameters
    ----------
    lowest, highest : float
        What a value can be [A, positive = discharge; V; °C; %].
    max_jump, max_rate_per_s : float
        A value may differ from the latest good one by the first, and for every second since by
        the second more [A, V, K, %].
    invalid_after, valid_after : int
        So many refused values in a row make the signal invalid; so many good ones valid again.
    stuck_after_s : float
        See `CheckMap` [s].
    timeout_s : float, optional
        Stated time-out [s].
    usual_timeout_s : float
        Time-out while the period is not known [s].
    """

    lowest: float = -math.inf
    highest: float = math.inf
    max_jump: float = math.inf
    max_rate_per_s: float = 0.0
    invalid_after: int = INVALID_AFTER
    valid_after: int = VALID_AFTER
    stuck_after_s: float = math.inf
    timeout_s: float | None = None
    usual_timeout_s: float = 10.0


DEFAULTS: Final = {
    "current": SignalChecks(stuck_after_s=STUCK_AFTER_S, usual_timeout_s=2.0),
    "voltage": SignalChecks(stuck_after_s=STUCK_AFTER_S, usual_timeout_s=2.0),
    "temperature": SignalChecks(),
    "soc_reference": SignalChecks(),
}
"""By role. What no pack can be is bounded where its model is known; see `input_health`."""


def checks_of(role: str, *stated: CheckMap) -> SignalChecks:
    """Return the checks of a role, with what mappings state in their place, the last one first."""
    checks = DEFAULTS[role]
    for each in stated:
        own = {
            name: value
            for name in CheckMap.model_fields
            if (value := getattr(each, name)) is not None
        }
        checks = replace(checks, **own)
    return checks


# --- Whether a signal can be trusted now: debounced, timed out; a function of its frames alone

MISSED_UNTIL_OLD: Final = 10.0
MISSED_AT_LEAST: Final = 3.0
"""Periods without a value until the signal is old; and at least."""
TIMEOUT_AT_LEAST_S: Final = 0.5
"""No time-out is shorter unless it is stated: frames are lost in bursts [s]."""

LEARN_FROM: Final = 8
"""Steps between frames that tell their period."""
_LEARN_WEIGHT: Final = 1.0 / 16.0
_PAUSE: Final = 4.0
"""A step longer than so many periods counts as so many: a pause is no period."""


class Fault(enum.IntEnum):
    """Why a value was refused."""

    NONE = 0
    PROTECTION = 1
    """CRC wrong, or frame too short."""
    REPEATED = 2
    """The counter stands still."""
    NOT_AVAILABLE = 3
    RANGE = 4
    RATE = 5
    STUCK = 6


class Trust(enum.IntEnum):
    """What is known of a signal."""

    UNKNOWN = 0
    """No good value yet."""
    VALID = 1
    INVALID = 2


# Of every value; members of an enum are slow to look up.
_NO_FAULT: Final = Fault.NONE
_VALID: Final = Trust.VALID
_INVALID: Final = Trust.INVALID


class SignalHealth:
    """Judges the values of one signal, one after the other.

    Parameters
    ----------
    checks : SignalChecks
    period_s : float, optional
        Stated period of its values [s]; by default it is learned.
    is_cyclic : bool
        Whether it is sent at its period even when it does not change.

    Attributes
    ----------
    trust : Trust
    fault : Fault
        What failed last; NONE after a good value that was used.
    latest, latest_s : float
        The latest good value and its bus time [s]; NaN before the first.
    """

    __slots__ = (
        "_arrived_s",
        "_checks",
        "_failures",
        "_is_cyclic",
        "_learned_s",
        "_passes",
        "_period_s",
        "_shortest_timeout_s",
        "_steps",
        "fault",
        "latest",
        "latest_s",
        "trust",
    )

    def __init__(
        self, checks: SignalChecks, period_s: float | None = None, *, is_cyclic: bool = True
    ) -> None:
        self._checks = checks
        self._period_s = period_s
        self._is_cyclic = is_cyclic
        # Whatever the period is found to be, the time-out is no shorter.
        self._shortest_timeout_s = (
            min(checks.usual_timeout_s, TIMEOUT_AT_LEAST_S)
            if checks.timeout_s is None
            else checks.timeout_s
        )
        self.trust = Trust.UNKNOWN
        self.fault = Fault.NONE
        self.latest = self.latest_s = math.nan
        self._failures = self._passes = 0
        self._arrived_s = math.nan
        self._learned_s = math.nan
        self._steps = 0

    def judge(self, value: float, time_s: float) -> Fault:
        """Return what is wrong with a value (NaN: not available); for `take` or `fail`.

        Parameters
        ----------
        value : float
            [A], [V], [°C] or [%].
        time_s : float
            Bus time [s].
        """
        self._learn(time_s)
        if math.isnan(value):
            return Fault.NOT_AVAILABLE
        checks = self._checks
        if not checks.lowest <= value <= checks.highest:
            return Fault.RANGE
        if checks.max_jump < math.inf:
            most = checks.max_jump + checks.max_rate_per_s * abs(time_s - self.latest_s)
            if abs(value - self.latest) > most:  # never before the first good value: NaN
                return Fault.RATE
        return _NO_FAULT

    def take(self, value: float, time_s: float) -> bool:
        """Take a good value; return whether it may be used, or is held back."""
        self._failures = 0
        if self.trust is _INVALID:
            self._passes += 1
            if self._passes < self._checks.valid_after:
                return False
        self.trust = _VALID
        self.fault = _NO_FAULT
        self.latest, self.latest_s = value, time_s
        return True

    def fail(self, fault: Fault) -> None:
        """Take note of a value that cannot be used, or of a frame that was refused."""
        self.fault = fault
        self._failures += 1
        if fault is not Fault.REPEATED:  # a copy says nothing against the frame before it
            self._passes = 0
        if self._failures >= self._checks.invalid_after and self.trust is Trust.VALID:
            self.trust = Trust.INVALID

    def rewind(self, time_s: float) -> None:
        """Time runs backwards to `time_s` [s]: what came later counts as of that moment."""
        self.latest_s = min(self.latest_s, time_s)

    def is_old(self, now_s: float) -> bool:
        """Return whether there is no good value within the time-out before `now_s` [s]."""
        age_s = now_s - self.latest_s
        # Asked for every signal at every sample: mostly there is no need to know the time-out.
        return not (age_s <= self._shortest_timeout_s or age_s <= self.timeout_s)

    def is_usable(self, now_s: float) -> bool:
        """Return whether the latest good value still holds at `now_s` [s]."""
        return self.trust is _VALID and not self.is_old(now_s)

    def value_at(self, now_s: float) -> float:
        """Return the latest good value if it still holds at `now_s` [s], else NaN."""
        return self.latest if self.is_usable(now_s) else math.nan

    @property
    def is_failing(self) -> bool:
        """Return whether so many values in a row failed, or too few passed since, to trust it."""
        return self.trust is Trust.INVALID or self._failures >= self._checks.invalid_after

    @property
    def period_s(self) -> float:
        """The period of its values, stated or learned [s]; NaN while it is not known."""
        if self._period_s is not None:
            return self._period_s
        return self._learned_s if self._steps >= LEARN_FROM else math.nan

    @property
    def timeout_s(self) -> float:
        """How long a value holds [s]."""
        checks = self._checks
        if checks.timeout_s is not None:
            return checks.timeout_s
        usual_s, period_s = checks.usual_timeout_s, self.period_s
        if math.isnan(period_s):
            return usual_s
        if self._is_cyclic:
            usual_s = min(max(MISSED_UNTIL_OLD * period_s, TIMEOUT_AT_LEAST_S), usual_s)
        return max(usual_s, MISSED_AT_LEAST * period_s)

    def _learn(self, time_s: float) -> None:
        step_s, self._arrived_s = time_s - self._arrived_s, time_s
        if not step_s > 0.0:
            return
        self._steps += 1
        learned_s = self._learned_s
        if math.isnan(learned_s):
            self._learned_s = step_s
        else:
            step_s = min(step_s, _PAUSE * learned_s)
            self._learned_s = learned_s + _LEARN_WEIGHT * (step_s - learned_s)


# --- A signal that stands still while another one proves that it should move

SWINGS: Final = 4
"""Turning points that the other signal must show."""
FRAMES: Final = 10
"""Values that must have stood still."""
STEPS: Final = 8.0
"""Steps of the standing signal that a swing must be worth."""
ERRORS: Final = 8.0
"""Standard deviations of the fast voltage error that a swing of the voltage must be worth."""
SWING_C_RATE: Final = 0.1
"""A swing of the current must be worth this at least [1/h]: 5 A at 50 Ah."""
UNKNOWN_STEP: Final = 0.0025
"""Step of a voltage that never moved yet, relative to its value."""


@dataclass(frozen=True, slots=True)
class Pack:
    """What the model knows of a pack that helps to judge its signals.

    Parameters
    ----------
    resistance_ohm : float
        What the voltage falls by at once, positive [Ω].
    error_std_v : float
        Fast error of the voltage [V].
    capacity_ah : float
        [Ah].
    usual_v : float
        Voltage at half charge [V].
    """

    resistance_ohm: float
    error_std_v: float
    capacity_ah: float
    usual_v: float


class Still:
    """How long one signal has stood still.

    Parameters
    ----------
    step : float
        Its step as the frame has it [A, V]; the smallest move seen, where that is larger.

    Attributes
    ----------
    since_s : float
        Since when [s].
    values : int
        Values since then.
    """

    __slots__ = ("_frame_step", "_seen_step", "_value", "since_s", "values")

    def __init__(self, step: float) -> None:
        self._frame_step = step
        self._seen_step = math.inf
        self._value = math.nan
        self.since_s = math.nan
        self.values = 0

    def take(self, value: float, time_s: float) -> bool:
        """Take a value; return whether it moved (or time ran backwards)."""
        if value == self._value and time_s >= self.since_s:
            self.values += 1
            return False
        move = abs(value - self._value)
        if 0.0 < move < self._seen_step:
            self._seen_step = move
        self._value, self.since_s, self.values = value, time_s, 1
        return True

    def step(self, unknown: float) -> float:
        """Return its step [A, V]; `unknown` relative to its value where it never moved."""
        if math.isinf(self._seen_step):
            return max(self._frame_step, unknown * abs(self._value))
        return max(self._frame_step, self._seen_step)


class Swings:
    """Counts turning points at least `size` apart (zigzag)."""

    __slots__ = ("_high", "_low", "_rises", "count")

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Begin anew."""
        self._low, self._high = math.inf, -math.inf
        self._rises = 0
        self.count = 0

    def take(self, value: float, size: float) -> None:
        """Take a value."""
        # Of every value, so no `min` and `max`: they would cost more than all the rest.
        if value < self._low:  # noqa: PLR1730
            self._low = value
        if value > self._high:  # noqa: PLR1730
            self._high = value
        if self._rises <= 0 and value - self._low >= size:
            self._turn(1, value)
        elif self._rises >= 0 and self._high - value >= size:
            self._turn(-1, value)

    def _turn(self, rises: int, value: float) -> None:
        self.count += 1
        self._rises = rises
        self._low = self._high = value


class StuckPair:
    """Watches current and voltage for one that stands still while the other swings.

    Parameters
    ----------
    pack : Pack
    current_step_a, voltage_step_v : float
        Steps of the signals in their frames [A], [V]; 0 for floats.
    current_after_s, voltage_after_s : float
        Standing still for so long is suspicious [s].
    """

    def __init__(
        self,
        pack: Pack,
        *,
        current_step_a: float,
        voltage_step_v: float,
        current_after_s: float,
        voltage_after_s: float,
    ) -> None:
        self._pack = pack
        self._after_s = (current_after_s, voltage_after_s)
        self._current, self._voltage = Still(current_step_a), Still(voltage_step_v)
        # What the other one did while this one stood still.
        self._voltage_swings, self._current_swings = Swings(), Swings()
        self._size_current_swings()
        self._size_voltage_swings()

    def current(self, current_a: float, time_s: float) -> bool:
        """Take a current [A]; return whether the current is stuck."""
        if self._current.take(current_a, time_s):
            self._voltage_swings.reset()
            self._size_voltage_swings()
        self._current_swings.take(current_a, self._current_swing_a)
        return _stuck(self._current, self._voltage_swings, self._after_s[0], time_s)

    def voltage(self, voltage_v: float, time_s: float) -> bool:
        """Take a voltage [V]; return whether the voltage is stuck."""
        if self._voltage.take(voltage_v, time_s):
            self._current_swings.reset()
            self._size_current_swings()
        self._voltage_swings.take(voltage_v, self._voltage_swing_v)
        return _stuck(self._voltage, self._current_swings, self._after_s[1], time_s)

    def _size_current_swings(self) -> None:
        """Say what counts as a swing of the current [A], beside the voltage as it moves now."""
        pack = self._pack
        self._current_swing_a = math.inf
        if math.isfinite(pack.resistance_ohm) and pack.resistance_ohm > 0.0:
            swing_v = STEPS * self._voltage.step(UNKNOWN_STEP)
            self._current_swing_a = max(
                swing_v / pack.resistance_ohm, SWING_C_RATE * pack.capacity_ah
            )

    def _size_voltage_swings(self) -> None:
        """Say what counts as a swing of the voltage [V], beside the current as it moves now."""
        pack = self._pack
        swing_a = max(STEPS * self._current.step(0.0), SWING_C_RATE * pack.capacity_ah)
        size_v = max(swing_a * pack.resistance_ohm, ERRORS * pack.error_std_v)
        self._voltage_swing_v = size_v if size_v > 0.0 else math.inf


def _stuck(still: Still, swings: Swings, after_s: float, time_s: float) -> bool:
    return swings.count >= SWINGS and still.values >= FRAMES and time_s - still.since_s >= after_s
