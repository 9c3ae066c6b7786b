"""Whether a signal can be trusted now: debounced, timed out; a function of its frames alone.

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
"""

from __future__ import annotations

import enum
import math
from typing import Final

from cangauge.bus.signal_checks import SignalChecks

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
