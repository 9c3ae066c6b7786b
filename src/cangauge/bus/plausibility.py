"""Plausibility of the signals of a pack: range, rate, stuck detection, debouncing, time-out.

A failed value is never used. `invalid_after` consecutive failures make a valid signal invalid, and
`valid_after` consecutive good values make it valid again; the first one makes a new signal valid.
The rate limit widens with the time since the latest good value: a lasting step is accepted.

A signal is old when its latest good value is older than the time-out. It is stated, or follows from
the period p, stated or learned: 10·p, at least 0.5 s and at most the usual time-out of the role,
but never below 3·p. Signals often sent on change keep at least the usual one. All times are bus
time, so that a live run and its recording give the same result.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Final, Literal, Self

from pydantic import Field, PositiveFloat, model_validator

from cangauge.model.fields import Fields
from cangauge.types import (
    CURRENT_AT_MOST_A,
    SOC_WITHIN_PCT,
    TEMPERATURE_WITHIN_C,
    VOLTAGE_WITHIN,
    Reason,
)

STUCK_AFTER_S: Final = 10.0
"""Least time of a constant value [s]: a pack at rest between two pulses is constant for less."""
_LIMITS: Final[dict[str, dict[str, float]]] = {
    "soc_reference": {"lowest": SOC_WITHIN_PCT[0], "highest": SOC_WITHIN_PCT[1]},
    "temperature": {
        "lowest": TEMPERATURE_WITHIN_C[0],
        "highest": TEMPERATURE_WITHIN_C[1],
        "max_jump": 5.0,
        "max_rate_per_s": 1.0,
    },
}
"""Limits of every pack. Those of a change of temperature [K, K/s] are above coarse quantization and
alternating sensors, and above what a pack's heat capacity allows. Current and voltage have none:
contactors, fuses, short circuits."""
USUAL_TIMEOUT_S: Final = (10.0, 2.0)
"""Time-out while the period is not known [s]: of signals sent on change, and of cyclic ones."""
MISSED_UNTIL_OLD: Final = 10.0
MISSED_AT_LEAST: Final = 3.0
TIMEOUT_AT_LEAST_S: Final = 0.5
"""Time-out of a cyclic signal: usual and least [periods]; least [s], for bursts of lost frames."""
LEARN_FROM: Final = 8
"""Frame intervals from which a period counts as learned, by a mean over about 16 of them; longer
intervals than four periods enter as four: a pause is not a period."""
FASTER: Final = 5.0
"""Stated period / learned one from which the stated one is wrong: 10 ms that stand as 10 s."""


@dataclass(frozen=True, slots=True)
class PackProperties:
    """Pack properties used for plausibility, taken from its model.

    `resistance_ohm` is instantaneous and positive [Ω], `error_std_v` the standard deviation of the
    fast voltage error [V], `capacity_ah` in Ah, `usual_v` the voltage at 50 % SoC [V].
    """

    resistance_ohm: float
    error_std_v: float
    capacity_ah: float
    usual_v: float

    @property
    def short_circuit_a(self) -> float:
        """Current that no state of the pack exceeds [A], at most `CURRENT_AT_MOST_A`."""
        return self.usual_v / max(self.resistance_ohm, self.usual_v / CURRENT_AT_MOST_A)


class SignalChecks(Fields):
    """Plausibility limits of a signal [A, positive = discharge; V; °C; %].

    A value may differ from the latest good one by `max_jump`, plus `max_rate_per_s` for every
    second since then. `invalid_after` and `valid_after` are consecutive values: few beside a
    time-out, more than a disturbed frame. `stuck_after_s` is the least duration of a constant value
    that can count as stuck [s]: current and voltage while the other one moves; others only where it
    is stated.
    """

    lowest: float = -math.inf
    highest: float = math.inf
    max_jump: PositiveFloat = math.inf
    max_rate_per_s: PositiveFloat = 0.0
    invalid_after: Annotated[int, Field(ge=1, le=1000)] = 5
    valid_after: Annotated[int, Field(ge=1, le=1000)] = 3
    stuck_after_s: PositiveFloat | None = None
    timeout_s: PositiveFloat | None = None

    @model_validator(mode="after")
    def _a_range(self) -> Self:
        if self.lowest >= self.highest:
            raise ValueError("lowest must lie below highest")
        if (self.max_rate_per_s > 0.0) is not (self.max_jump < math.inf):
            raise ValueError("max_jump and max_rate_per_s need each other")
        return self

    def within_pack(self, role: str, pack: PackProperties | None) -> SignalChecks:
        """Return the checks with the physical limits of a pack where none are stated.

        Without a pack only a SoC has some.
        """
        limits = _LIMITS.get(role, {})
        if pack is None:
            limits = limits if role == "soc_reference" else {}
        elif role == "voltage":
            low, high = VOLTAGE_WITHIN
            limits = {"lowest": low * pack.usual_v, "highest": high * pack.usual_v}
        elif role == "current":
            limits = {"lowest": -pack.short_circuit_a, "highest": pack.short_circuit_a}
        return self.model_copy(update={**limits, **self.model_dump(exclude_unset=True)})


Count = Literal[
    "wanted",  # frames with its id
    "crc_errors",  # frames refused
    "counter_repeats",  # frames refused: repeated alive counter
    "counter_jumps",  # good frames after a loss
    "frames_lost",  # frames missing according to the alive counter
    "short",  # frames refused: shorter than in the DBC
    "not_available",  # values refused: the code means "not available"
    "implausible",  # values refused: out of range, or changed too fast
    "stuck",  # values refused: the signal is stuck
    "held_back",  # good values not used yet, while the signal recovers from failures
    "two_senders",  # frames refused: two senders use the id
]
"""Counts of one wanted message: frames and values, refused ones by cause."""


# Looked up for every value; enum members are slow to look up.
_NO_REASON: Final = Reason.NONE
_IMPLAUSIBLE: Final = Reason.IMPLAUSIBLE_INPUT


class SignalHealth:
    """Check the values of one signal in order of time.

    `period_s` is the stated period of its values [s]; by default it is learned. `is_cyclic`: it is
    sent every period even when it does not change. `is_stuck` takes a value and its bus time [s];
    by default a signal that is not cyclic is stuck after a stated time, and a cyclic one never.
    `counts` are those of its message, to continue.

    Attributes
    ----------
    is_invalid, reason : bool, Reason
        Whether it failed too often since its latest good value; why it failed last, if it did.
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
        counts: Counter[Count] | None = None,
    ) -> None:
        self._checks = checks
        # Read for every value; slow to read from a model.
        self._lowest, self._highest = checks.lowest, checks.highest
        self._max_jump, self._max_rate_per_s = checks.max_jump, checks.max_rate_per_s
        self._stated_s = math.nan if period_s is None else period_s
        self._is_cyclic = is_cyclic
        self._counts: Counter[Count] = Counter() if counts is None else counts
        self._is_stuck = is_stuck
        if not is_cyclic and checks.stuck_after_s is not None:  # it has no partner
            self._is_stuck = self._is_constant
        self.is_invalid = False
        self.reason = Reason.NONE
        self.latest = self.latest_s = math.nan
        self._failures = self._passes = self._intervals = 0
        self._arrived_s = self._learned_s = self._since_s = math.nan

    def update(self, value: float, time_s: float) -> float:
        """Return a value [A, V, °C, %; NaN: not available] at bus time [s]; NaN if refused."""
        interval_s, self._arrived_s = time_s - self._arrived_s, time_s
        if interval_s > 0.0:
            self._learn(interval_s)
        if value != value:  # noqa: PLR0124 - NaN; this runs for every value
            self._counts["not_available"] += 1
            return self.fail(_NO_REASON)
        most = self._max_jump
        if most < math.inf:
            most += self._max_rate_per_s * abs(time_s - self.latest_s)
        # The second is false before the first good value (NaN).
        if not self._lowest <= value <= self._highest or abs(value - self.latest) > most:
            self._counts["implausible"] += 1
            return self.fail(_IMPLAUSIBLE)
        if self._is_stuck is not None and self._is_stuck(value, time_s):
            self._counts["stuck"] += 1
            return self.fail(Reason.SIGNAL_STUCK)
        self._failures = 0
        if self.is_invalid:
            self._passes += 1
            if self._passes < self._checks.valid_after:
                self._counts["held_back"] += 1
                return math.nan
        self.is_invalid, self.reason = False, _NO_REASON
        self.latest, self.latest_s = value, time_s
        return value

    def _is_constant(self, value: float, time_s: float) -> bool:
        if value != self.latest or time_s < self._since_s:
            self._since_s = time_s
        return time_s - self._since_s >= (self._checks.stuck_after_s or math.inf)

    def _learn(self, interval_s: float) -> None:
        self._intervals += 1
        if self._intervals == 1:
            self._learned_s = interval_s
        # A pause counts as a few periods; frames may come in bursts of many.
        longest_s = max(4.0 * self._learned_s, 10.0 * self._stated_s)  # 2nd: may be NaN
        self._learned_s += (min(interval_s, longest_s) - self._learned_s) / 16.0

    def fail(self, reason: Reason, *, is_repeated: bool = False) -> float:
        """Record a failed value or frame; return NaN. A repeated one does not stop recovery."""
        self.reason = reason
        self._failures += 1
        if not is_repeated:
            self._passes = 0
        if self._failures >= self._checks.invalid_after and not math.isnan(self.latest_s):
            self.is_invalid = True
        return math.nan

    def rewind(self, time_s: float) -> None:
        """Date the latest good value back when time runs backwards to `time_s` [s]."""
        self.latest_s = min(self.latest_s, time_s)

    def is_usable(self, now_s: float) -> bool:
        """Return whether the latest good value is valid and not old at `now_s` [s]."""
        return not self.is_invalid and now_s - self.latest_s <= self.timeout_s

    def value_at(self, now_s: float) -> float:
        """Return the latest good value if usable at `now_s` [s], else NaN."""
        return self.latest if self.is_usable(now_s) else math.nan

    @property
    def is_implausible(self) -> bool:
        """Whether the newest value was refused as implausible."""
        return self._failures > 0 and self.reason == _IMPLAUSIBLE

    @property
    def is_failing(self) -> bool:
        """Whether the signal is invalid, or failed too often in a row to become valid."""
        return self.is_invalid or self._failures >= self._checks.invalid_after

    @property
    def period_s(self) -> float:
        """Period of the values, stated or learned [s]; NaN while not known.

        A stated one that is much too long does not count: a silent bus would seem alive.
        """
        is_stated = self._stated_s <= FASTER * self._learned_s  # false for NaN
        return self._stated_s if is_stated or self._intervals < LEARN_FROM else self._learned_s

    @property
    def is_faster_than_stated(self) -> bool:
        """Whether the values come much more often than a stated period says."""
        return self.period_s < self._stated_s

    @property
    def timeout_s(self) -> float:
        """Age at which a value becomes old [s]."""
        if self._checks.timeout_s is not None:
            return self._checks.timeout_s
        usual_s, period_s = USUAL_TIMEOUT_S[self._is_cyclic], self.period_s
        if math.isnan(period_s):
            return usual_s
        if self._is_cyclic:
            usual_s = min(max(MISSED_UNTIL_OLD * period_s, TIMEOUT_AT_LEAST_S), usual_s)
        return max(usual_s, MISSED_AT_LEAST * period_s)


SWINGS: Final = 4
FRAMES: Final = 10
"""Turning points that the partner, and equal values that a stuck signal must show."""
LEAST_SWING: Final = 8.0
SWING_C_RATE: Final = 0.1
"""Least swing of the partner, as an effect on the constant signal [quantization steps of it] and of
the voltage [standard deviations of its fast error]; of the current [1/h]: 5 A at 50 Ah, above a
pack at rest with its consumers."""
COARSE_STEP: Final = 0.0025
"""Assumed quantization of a voltage that has not changed yet, relative to the pack's: 1 V of a
car's, the coarsest in use."""


class StuckDetector:
    """Detect a signal that is constant while its partner swings; made by `stuck_detectors`.

    `after_s` is the least duration of a constant value that counts as stuck [s]; `step` the
    quantization in the frame [A, V], 0 for floats. The smallest change seen counts where it is
    larger. `partner_swing` takes it; it returns the least distance of the partner's turning points
    that proves that this signal should change.
    """

    partner: StuckDetector

    def __init__(
        self, after_s: float, step: float, partner_swing: Callable[[float], float]
    ) -> None:
        self._after_s, self._step, self._partner_swing = after_s, step, partner_swing
        self._smallest = self.swing = math.inf
        self._value = self._since_s = math.nan
        self._repeats = 0
        self.restart()

    def restart(self) -> None:
        """Count turning points (zigzag) anew, since the partner has changed."""
        self._low, self._high = math.inf, -math.inf
        self._direction = self.turns = 0

    def update(self, value: float, time_s: float) -> bool:
        """Add a value at bus time `time_s` [s]; return whether the signal is stuck."""
        if value == self._value and time_s >= self._since_s:
            self._repeats += 1
        else:
            change = abs(value - self._value)
            if 0.0 < change < self._smallest:
                self._smallest = change
                self.partner.swing = self._partner_swing(max(self._step, change))
            self._value, self._since_s, self._repeats = value, time_s, 1
            self.partner.restart()
        # Branches instead of `min` and `max`: this runs for every value.
        if value < self._low:  # noqa: PLR1730
            self._low = value
        if value > self._high:  # noqa: PLR1730
            self._high = value
        rises = self._direction <= 0 and value - self._low >= self.swing
        if rises or (self._direction >= 0 and self._high - value >= self.swing):
            self._direction = 1 if rises else -1
            self._low = self._high = value
            self.turns += 1
        return (
            self.partner.turns >= SWINGS
            and self._repeats >= FRAMES
            and time_s - self._since_s >= self._after_s
        )


def stuck_detectors(
    pack: PackProperties, current: tuple[float, float | None], voltage: tuple[float, float | None]
) -> tuple[StuckDetector, StuckDetector]:
    """Return coupled stuck detectors for current and voltage of one pack.

    A change of the current by ΔI changes the voltage by R·ΔI at once. A voltage whose code stays
    constant while the current swings, by R·ΔI of several quantization steps, is stuck; and vice
    versa. Turning points are counted, not drift, so that these are not called stuck: a pack at
    rest; a charge at constant current; a current of exactly 0 next to a noisy voltage. Of each
    signal: its quantization in the frame [A, V] and `stuck_after_s`.
    """
    (step_a, after_a_s), (step_v, after_v_s) = current, voltage
    ohm, least_a = pack.resistance_ohm, SWING_C_RATE * pack.capacity_ah

    def swing_a(step_v: float) -> float:
        return max(LEAST_SWING * step_v / ohm, least_a) if 0.0 < ohm < math.inf else math.inf

    def swing_v(step_a: float) -> float:
        least_v = max(LEAST_SWING * max(step_a * ohm, pack.error_std_v), least_a * ohm)
        return least_v if least_v > 0.0 else math.inf

    of_current = StuckDetector(after_a_s or STUCK_AFTER_S, step_a, swing_v)
    of_voltage = StuckDetector(after_v_s or STUCK_AFTER_S, step_v, swing_a)
    of_current.swing = swing_a(max(step_v, COARSE_STEP * pack.usual_v))
    of_voltage.swing = swing_v(step_a)
    of_current.partner, of_voltage.partner = of_voltage, of_current
    return of_current, of_voltage
