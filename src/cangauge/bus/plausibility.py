"""Plausibility of the signals of a pack: range, rate, stuck detection, debouncing, time-out.

Rules of `SignalHealth`:

- A value fails when its frame was refused, its code means "not available", it is out of range, it
  changed too fast, or the signal is stuck. A failed value is never used.
- `invalid_after` consecutive failures make a valid signal invalid. It becomes valid again after
  `valid_after` consecutive good values; repeated frames in between do not restart that count. The
  first good value makes a new signal valid.
- The rate limit applies to the distance from the latest good value. It widens with the time since
  then, so that a lasting step is accepted in the end.
- A signal is old when its latest good value is older than the time-out. The time-out is stated, or
  follows from the period p (stated or learned from the time stamps): 10·p, at least 0.5 s and at
  most the usual time-out of the role, but never below 3·p. Temperature and SoC, often sent on
  change only, keep at least their usual time-out.

All times are bus time, so that a live run and its recording give the same result.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

from cangauge.bus.mapping import CheckMap
from cangauge.types import CURRENT_AT_MOST_A, TEMPERATURE_WITHIN_C, VOLTAGE_WITHIN

INVALID_AFTER: Final = 5
VALID_AFTER: Final = 3
"""Consecutive values of the debouncing: short beside a time-out, longer than a disturbed frame."""
STUCK_AFTER_S: Final = 10.0
"""Least time of a constant value [s]: a pack at rest between two pulses is constant for less."""

TEMPERATURE_JUMP_K: Final = 5.0
TEMPERATURE_RATE_K_PER_S: Final = 1.0
"""Above coarse quantization and alternating sensors, and above what a pack's heat capacity allows.
Current and voltage have no default rate limit: contactors, fuses, short circuits."""

MISSED_UNTIL_OLD: Final = 10.0
MISSED_AT_LEAST: Final = 3.0
"""Time-out of a cyclic signal, usual and least [periods]."""
TIMEOUT_AT_LEAST_S: Final = 0.5
"""Shortest time-out that is not stated: frames are lost in bursts [s]."""

LEARN_FROM: Final = 8
"""Frame intervals from which a period counts as learned."""
_LEARN_WEIGHT: Final = 1.0 / 16.0
_LONGEST_INTERVAL: Final = 4.0
"""Longer intervals enter the learned period as this many periods: a pause is not a period."""


@dataclass(frozen=True, slots=True)
class Pack:
    """Pack properties used for plausibility, taken from its model.

    Parameters
    ----------
    resistance_ohm : float
        Instantaneous resistance, positive [Ω].
    error_std_v : float
        Standard deviation of the fast voltage error [V].
    capacity_ah : float
        [Ah].
    usual_v : float
        Voltage at 50 % SoC [V].
    """

    resistance_ohm: float
    error_std_v: float
    capacity_ah: float
    usual_v: float


@dataclass(frozen=True, slots=True)
class SignalChecks:
    """Limits of one signal.

    Parameters
    ----------
    lowest, highest, max_jump, max_rate_per_s, invalid_after, valid_after, stuck_after_s, timeout_s
        As in `mapping.CheckMap`; without limit by default.
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

    def updated(self, *stated: CheckMap) -> SignalChecks:
        """Return the checks with stated values replaced; the last mapping wins."""
        given = {
            name: value
            for each in stated
            for name in CheckMap.model_fields
            if (value := getattr(each, name)) is not None
        }
        return replace(self, **given)

    def within_pack(self, role: str, pack: Pack) -> SignalChecks:
        """Return the checks with the physical limits of a pack where none are stated."""
        limits = {
            "current": (-CURRENT_AT_MOST_A, CURRENT_AT_MOST_A),
            "voltage": (VOLTAGE_WITHIN[0] * pack.usual_v, VOLTAGE_WITHIN[1] * pack.usual_v),
            "temperature": TEMPERATURE_WITHIN_C,
        }
        low, high = limits.get(role, (-math.inf, math.inf))
        jump, rate_per_s = self.max_jump, self.max_rate_per_s
        if role == "temperature" and jump == math.inf:
            jump, rate_per_s = TEMPERATURE_JUMP_K, TEMPERATURE_RATE_K_PER_S
        return replace(
            self,
            lowest=low if self.lowest == -math.inf else self.lowest,
            highest=high if self.highest == math.inf else self.highest,
            max_jump=jump,
            max_rate_per_s=rate_per_s,
        )


_FAST: Final = SignalChecks(stuck_after_s=STUCK_AFTER_S, usual_timeout_s=2.0)
DEFAULTS: Final = {"current": _FAST, "voltage": _FAST}
"""By role. Physical limits need the pack's model; see `SignalChecks.within_pack`."""


class Fault(enum.IntEnum):
    """Cause of a refused value."""

    NONE = 0
    PROTECTION = 1
    """CRC wrong, or frame too short."""
    REPEATED = 2
    """The alive counter did not change."""
    NOT_AVAILABLE = 3
    RANGE = 4
    RATE = 5
    STUCK = 6
    TWO_SENDERS = 7
    """The frame may be another sender's."""


class SignalState(enum.IntEnum):
    """Debounced validity of a signal."""

    UNKNOWN = 0
    """No good value yet."""
    VALID = 1
    INVALID = 2


# Looked up for every value; enum members are slow to look up.
_NO_FAULT: Final = Fault.NONE
_VALID: Final = SignalState.VALID
_INVALID: Final = SignalState.INVALID


@dataclass(slots=True)
class MessageStatistics:
    """Frame and value statistics of one wanted message."""

    wanted: int = 0
    """Frames with its id."""
    crc_errors: int = 0
    """Frames refused: wrong CRC."""
    counter_repeats: int = 0
    """Frames refused: repeated alive counter."""
    counter_jumps: int = 0
    """Good frames after a loss."""
    frames_lost: int = 0
    """Frames missing according to the alive counter."""
    short: int = 0
    """Frames refused: shorter than in the DBC."""
    not_available: int = 0
    """Values refused: the code means "not available"."""
    implausible: int = 0
    """Values refused: out of range, or changed too fast."""
    stuck: int = 0
    """Values refused: the signal is stuck."""
    held_back: int = 0
    """Good values not used yet, while the signal recovers from failures."""
    two_senders: int = 0
    """Frames refused: two senders use the id."""


class SignalHealth:
    """Check the values of one signal in order of time.

    Parameters
    ----------
    checks : SignalChecks
    period_s : float, optional
        Stated period of its values [s]; by default it is learned.
    is_cyclic : bool
        Whether the signal is sent every period even when it does not change.
    is_stuck : callable, optional
        Takes a value and its bus time [s]; returns whether the signal is stuck.
    statistics : MessageStatistics, optional
        Counts the refused values.

    Attributes
    ----------
    state : SignalState
    fault : Fault
        Latest failure; NONE after a good value that was used.
    latest, latest_s : float
        Latest good value and its bus time [s]; NaN before the first.
    """

    def __init__(
        self,
        checks: SignalChecks,
        period_s: float | None = None,
        *,
        is_cyclic: bool = True,
        is_stuck: Callable[[float, float], bool] | None = None,
        statistics: MessageStatistics | None = None,
    ) -> None:
        self._checks = checks
        self._period_s = period_s
        self._is_cyclic = is_cyclic
        self._is_stuck = is_stuck
        self._statistics = statistics or MessageStatistics()
        self.state = SignalState.UNKNOWN
        self.fault = Fault.NONE
        self.latest = self.latest_s = math.nan
        self._failures = self._passes = 0
        self._arrived_s = self._learned_s = math.nan
        self._intervals = 0

    def update(self, value: float, time_s: float) -> float:
        """Check a value; return it if it may be used, else NaN.

        Parameters
        ----------
        value : float
            [A], [V], [°C] or [%]; NaN: not available.
        time_s : float
            Bus time [s].
        """
        checks = self._checks
        interval_s, self._arrived_s = time_s - self._arrived_s, time_s
        if interval_s > 0.0:
            self._learn(interval_s)
        if value != value:  # noqa: PLR0124 - NaN; this runs for every value
            self._statistics.not_available += 1
            return self.fail(Fault.NOT_AVAILABLE)
        if not checks.lowest <= value <= checks.highest:
            self._statistics.implausible += 1
            return self.fail(Fault.RANGE)
        if checks.max_jump < math.inf:
            most = checks.max_jump + checks.max_rate_per_s * abs(time_s - self.latest_s)
            if abs(value - self.latest) > most:  # False before the first good value (NaN)
                self._statistics.implausible += 1
                return self.fail(Fault.RATE)
        if self._is_stuck is not None and self._is_stuck(value, time_s):
            self._statistics.stuck += 1
            return self.fail(Fault.STUCK)
        self._failures = 0
        if self.state is _INVALID:
            self._passes += 1
            if self._passes < checks.valid_after:
                self._statistics.held_back += 1
                return math.nan
        self.state, self.fault = _VALID, _NO_FAULT
        self.latest, self.latest_s = value, time_s
        return value

    def _learn(self, interval_s: float) -> None:
        self._intervals += 1
        learned_s = self._learned_s
        if self._intervals == 1:
            self._learned_s = interval_s
        else:
            interval_s = min(interval_s, _LONGEST_INTERVAL * learned_s)
            self._learned_s = learned_s + _LEARN_WEIGHT * (interval_s - learned_s)

    def fail(self, fault: Fault) -> float:
        """Record a failed value or a refused frame; return NaN."""
        self.fault = fault
        self._failures += 1
        if fault is not Fault.REPEATED:  # a repeated frame does not invalidate the original
            self._passes = 0
        if self._failures >= self._checks.invalid_after and self.state is _VALID:
            self.state = _INVALID
        return math.nan

    def rewind(self, time_s: float) -> None:
        """Date the latest good value back when time runs backwards to `time_s` [s]."""
        self.latest_s = min(self.latest_s, time_s)

    def is_usable(self, now_s: float) -> bool:
        """Return whether the latest good value is valid and not old at `now_s` [s]."""
        return self.state is _VALID and now_s - self.latest_s <= self.timeout_s

    def value_at(self, now_s: float) -> float:
        """Return the latest good value if usable at `now_s` [s], else NaN."""
        return self.latest if self.is_usable(now_s) else math.nan

    @property
    def is_failing(self) -> bool:
        """Whether the signal is invalid, or failed too often in a row to become valid."""
        return self.state is _INVALID or self._failures >= self._checks.invalid_after

    @property
    def period_s(self) -> float:
        """Period of the values, stated or learned [s]; NaN while not known."""
        if self._period_s is not None:
            return self._period_s
        return self._learned_s if self._intervals >= LEARN_FROM else math.nan

    @property
    def timeout_s(self) -> float:
        """Age at which a value becomes old [s]."""
        checks = self._checks
        if checks.timeout_s is not None:
            return checks.timeout_s
        usual_s, period_s = checks.usual_timeout_s, self.period_s
        if math.isnan(period_s):
            return usual_s
        if self._is_cyclic:
            usual_s = min(max(MISSED_UNTIL_OLD * period_s, TIMEOUT_AT_LEAST_S), usual_s)
        return max(usual_s, MISSED_AT_LEAST * period_s)


SWINGS: Final = 4
"""Turning points that the partner must show."""
FRAMES: Final = 10
"""Equal values that a stuck signal must show."""
STEPS: Final = 8.0
"""Least swing of the partner, as an effect on the constant signal [quantization steps of it]."""
ERRORS: Final = 8.0
"""Least swing of the voltage [standard deviations of the fast voltage error]."""
SWING_C_RATE: Final = 0.1
"""Least swing of the current [1/h]: 5 A at 50 Ah, above a pack at rest with its consumers."""
UNKNOWN_STEP: Final = 0.0025
"""Assumed quantization step of a voltage that has not changed yet, relative to its value: 1 V of a
car's pack, the coarsest in use."""


class StuckDetector:
    """Detect a signal that is constant while its partner swings; made by `stuck_detectors`.

    Parameters
    ----------
    frame_step : float
        Quantization step of the signal in its frame [A, V]; 0 for floats. The smallest change
        seen counts where it is larger.
    unknown_step : float
        Quantization step assumed before the first change, relative to the value.
    after_s : float
        Least duration of a constant value that counts as stuck [s].
    partner_swing : callable
        Takes the quantization step of this signal; returns the least swing of the partner.
    """

    partner: StuckDetector

    def __init__(
        self,
        frame_step: float,
        unknown_step: float,
        after_s: float,
        partner_swing: Callable[[float], float],
    ) -> None:
        self._frame_step = frame_step
        self._unknown_step = unknown_step
        self._after_s = after_s
        self._partner_swing = partner_swing
        self._smallest = math.inf
        self._value = self._since_s = math.nan
        self._repeats = 0
        # Turning points at least `swing` apart (zigzag) since the partner changed; it resets them.
        self.low, self.high = math.inf, -math.inf
        self.direction = self.turns = 0
        self.swing = math.inf

    def update(self, value: float, time_s: float) -> bool:
        """Add a value at bus time `time_s` [s]; return whether the signal is stuck."""
        if value == self._value and time_s >= self._since_s:
            self._repeats += 1
        else:
            self._change(value, time_s)
        # Branches instead of `min` and `max`: this runs for every value.
        if value < self.low:  # noqa: PLR1730
            self.low = value
        if value > self.high:  # noqa: PLR1730
            self.high = value
        rises = self.direction <= 0 and value - self.low >= self.swing
        if rises or (self.direction >= 0 and self.high - value >= self.swing):
            self.direction = 1 if rises else -1
            self.low = self.high = value
            self.turns += 1
        return (
            self.partner.turns >= SWINGS
            and self._repeats >= FRAMES
            and time_s - self._since_s >= self._after_s
        )

    def _change(self, value: float, time_s: float) -> None:
        """Restart the count of equal values, and with it the partner's turning points."""
        change, partner = abs(value - self._value), self.partner
        if 0.0 < change < self._smallest:
            self._smallest = change
            partner.swing = self._partner_swing(max(self._frame_step, change))
        elif math.isinf(self._smallest):
            step = max(self._frame_step, self._unknown_step * abs(value))
            partner.swing = self._partner_swing(step)
        self._value, self._since_s, self._repeats = value, time_s, 1
        partner.low, partner.high = math.inf, -math.inf
        partner.direction = partner.turns = 0


def stuck_detectors(
    pack: Pack,
    *,
    current_step_a: float,
    voltage_step_v: float,
    current_after_s: float,
    voltage_after_s: float,
) -> tuple[StuckDetector, StuckDetector]:
    """Return coupled stuck detectors for current and voltage of one pack.

    A change of the current by ΔI changes the voltage by R·ΔI at once. A voltage whose code stays
    constant while the current swings, by R·ΔI of several quantization steps, is stuck; and vice
    versa. Turning points are counted, not drift, so that these are not called stuck: a pack at
    rest; a charge at constant current; a current of exactly 0 next to a noisy voltage (a swing must
    be a multiple of the model's voltage error).

    Parameters
    ----------
    pack : Pack
    current_step_a, voltage_step_v : float
        Quantization steps of the signals in their frames [A], [V]; 0 for floats.
    current_after_s, voltage_after_s : float
        Least duration of a constant value that counts as stuck [s].
    """
    least_swing_a = SWING_C_RATE * pack.capacity_ah

    def current_swing_a(voltage_step_v: float) -> float:
        if not (math.isfinite(pack.resistance_ohm) and pack.resistance_ohm > 0.0):
            return math.inf
        return max(STEPS * voltage_step_v / pack.resistance_ohm, least_swing_a)

    def voltage_swing_v(current_step_a: float) -> float:
        swing_a = max(STEPS * current_step_a, least_swing_a)
        swing_v = max(swing_a * pack.resistance_ohm, ERRORS * pack.error_std_v)
        return swing_v if swing_v > 0.0 else math.inf

    current = StuckDetector(current_step_a, 0.0, current_after_s, voltage_swing_v)
    voltage = StuckDetector(voltage_step_v, UNKNOWN_STEP, voltage_after_s, current_swing_a)
    current.partner, voltage.partner = voltage, current
    return current, voltage


class ConstantDetector:
    """Detect a signal that has been constant for a stated time.

    For a temperature: slow, coarse and without a partner, it is constant for hours in a healthy
    car. Used only where the user states a time.

    Parameters
    ----------
    after_s : float
        [s].
    """

    def __init__(self, after_s: float) -> None:
        self._after_s = after_s
        self._value = self._since_s = math.nan

    def update(self, value: float, time_s: float) -> bool:
        """Add a value at bus time `time_s` [s]; return whether the signal is stuck."""
        if value != self._value or time_s < self._since_s:
            self._value, self._since_s = value, time_s
            return False
        return time_s - self._since_s >= self._after_s
