"""A time that nobody saw: the bus asleep, or the service not running.

Two stories can be told of it. *Parked*: nothing but small consumers, so the SoC is what it was to
within a little. *Moved*: somebody charged or drove, so the SoC may be anything that a fast charger
can reach. How likely the second is before any voltage is seen grows with the time; after it, the
voltage decides (see `belief`).

Coulomb counting over irregular samples, with a stated limit on gaps.

Steps up to `gap_s` count by the trapezoidal rule. Longer ones up to `BRIDGE_S` count so too, but
their charge is uncertain by the whole recent current. Beyond that the pack is taken to have
rested (bus asleep, service not running), and since it may have been charged meanwhile, the
uncertainty grows with the time away. `pause` says how the filter treats such a time.

Across a restart the currents at both ends of the gap count for the few seconds that a driver holds
a current, and the mean of the last minute for the rest.

The estimator's own time: bus time that never runs backwards, whatever the stamps do.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from cangauge.estimate.state import ClockState, CounterState
from cangauge.model.charge import BRIDGE_S

# --- A time that nobody saw: the bus asleep, or the service not running

USE_S = 120.0
"""The current before a pause may have gone on for so long into it [s]."""

DRAIN_PCT_PER_HOUR = 0.05
DRAIN_AT_MOST_PCT = 5.0
"""What consumers of a parked car and self-discharge may take [% per hour; %]: 1.2 % a day."""

MOVED_AT_MOST = 0.3
"""Probability that somebody charged or drove in a long pause: a guess, of which the voltage takes
little notice."""

MOVED_TIME_S = 1800.0
"""Within such a time it grows to 63 % of that [s]."""

SHORTEST_S = 1.0
"""No time is so short that nobody can have [s]."""

FASTEST_PCT_PER_HOUR = 150.0
"""How fast the SoC may change unseen [% per hour]: a fast charger."""

MOVED_STD_AT_MOST_PCT = 30.0
"""Standard deviation of a SoC of which nothing is known [%] (uniform over 0–100: 29 %)."""


def parked_std_pct(seconds: float, rms_pct_per_s: float) -> float:
    """Return the standard deviation of the charge that a parked car loses or gains [%].

    Parameters
    ----------
    seconds : float
        How long [s].
    rms_pct_per_s : float
        Recent current before [% of capacity per s].
    """
    drain_pct = min(DRAIN_PCT_PER_HOUR * seconds / 3600.0, DRAIN_AT_MOST_PCT)
    use_pct = min(rms_pct_per_s * min(seconds, USE_S), MOVED_STD_AT_MOST_PCT)
    return math.hypot(drain_pct, use_pct)


def moved_std_pct(seconds: float) -> float:
    """Return the standard deviation of the SoC if somebody charged or drove for a time [%]."""
    return min(FASTEST_PCT_PER_HOUR * seconds / 3600.0, MOVED_STD_AT_MOST_PCT)


def moved_log_odds(seconds: float) -> float:
    """Return ln(p / (1 − p)) for p, the probability that somebody did, before any voltage."""
    probability = -MOVED_AT_MOST * math.expm1(-max(seconds, SHORTEST_S) / MOVED_TIME_S)
    return math.log(probability / (1.0 - probability))


# --- Coulomb counting over irregular samples, with a stated limit on gaps

AWAY_PCT_PER_HOUR = 20.0
"""SoC that a pack may gain or lose unseen [% per hour]: a slow charger's rate."""

AWAY_AT_MOST_PCT = 30.0
"""However long the gap, the SoC's standard deviation does not grow beyond this [%]."""

CURRENT_MEMORY_S = 300.0
"""Over how long the recent current is averaged, for the uncertainty of a bridged gap [s]."""


HELD_S = 5.0
"""A current while driving stays similar for about so long [s]."""

MEAN_MEMORY_S = 60.0
"""Over how long the current is averaged that is counted across a restart [s]."""


class ChargeStep(NamedTuple):
    """What one sample added."""

    seconds: float
    """Time since the last sample [s]."""
    discharged_pct: float
    """Charge taken out since the last sample [% of capacity]."""
    gap_std_pct: float
    """Uncertainty of that charge if a gap lay in between, else 0 [%]."""
    away_s: float = 0.0
    """The time [s] if it was too long to count over, else 0."""
    parked_std_pct: float = 0.0
    """Uncertainty of the charge of such a time if nobody charged or drove [%]."""


class CoulombCounter:
    """Charge since the start, in % of capacity.

    Parameters
    ----------
    capacity_ah : float
        Charge from 100 to 0 % [Ah].
    gap_s : float
        Longer steps between samples are gaps [s].
    """

    def __init__(self, capacity_ah: float, gap_s: float) -> None:
        self._pct_per_as = 100.0 / (3600.0 * capacity_ah)
        self._gap_s = gap_s
        self._last: tuple[float, float] | None = None
        self._mean_square_a2 = 0.0
        self._mean_a = 0.0
        self._is_restored = False
        self.discharged_pct = 0.0
        """Charge taken out since the first sample [%]."""
        self.moved_pct = 0.0
        """Charge moved either way since the first sample [%]."""
        self.counted_s = 0.0
        """Time since the first sample in which charge was counted [s]."""

    def step(self, time_s: float, current_a: float) -> ChargeStep:
        """Take one sample, later than the one before (positive current discharges)."""
        last, self._last = self._last, (time_s, current_a)
        if last is None:
            self._mean_square_a2 = current_a * current_a
            self._mean_a = current_a
            return ChargeStep(0.0, 0.0, 0.0)
        seconds = time_s - last[0]
        across_a = 0.5 * (current_a + last[1])
        if self._is_restored and seconds > self._gap_s:
            held = HELD_S / seconds * -math.expm1(-0.5 * seconds / HELD_S)
            across_a = self._mean_a + held * (current_a + last[1] - 2.0 * self._mean_a)
        self._is_restored = False
        lately = math.exp(-seconds / MEAN_MEMORY_S)
        self._mean_a = lately * self._mean_a + (1.0 - lately) * current_a
        recent = math.exp(-seconds / CURRENT_MEMORY_S)
        # The average forgets slowly, and so learns slowly that a drive began: what was seen at the
        # gap's ends counts as well.
        mean_square_a2 = self._mean_square_a2
        self._mean_square_a2 = recent * self._mean_square_a2 + (1.0 - recent) * current_a**2
        if seconds > BRIDGE_S:
            away_pct = AWAY_PCT_PER_HOUR * seconds / 3600.0
            rms_a = math.sqrt(max(mean_square_a2, last[1] ** 2))
            parked_pct = parked_std_pct(seconds, rms_a * self._pct_per_as)
            away_pct = min(away_pct, AWAY_AT_MOST_PCT)
            return ChargeStep(seconds, 0.0, away_pct, seconds, parked_pct)
        self.counted_s += seconds
        out_pct = across_a * seconds * self._pct_per_as
        self.discharged_pct += out_pct
        self.moved_pct += abs(out_pct)
        if seconds <= self._gap_s:
            return ChargeStep(seconds, out_pct, 0.0)
        rms_a = math.sqrt(max(mean_square_a2, 0.5 * (current_a**2 + last[1] ** 2)))
        return ChargeStep(seconds, out_pct, rms_a * seconds * self._pct_per_as)

    def state(self) -> CounterState:
        """Return what is to be remembered."""
        time_s, current_a = self._last or (math.nan, 0.0)
        return CounterState.model_construct(
            time_s=time_s,
            current_a=current_a,
            mean_square_a2=self._mean_square_a2,
            mean_a=self._mean_a,
            discharged_pct=self.discharged_pct,
            moved_pct=self.moved_pct,
            counted_s=self.counted_s,
        )

    def restore(self, state: CounterState) -> None:
        """Go on from a state."""
        self._last = None if math.isnan(state.time_s) else (state.time_s, state.current_a)
        self._mean_square_a2 = state.mean_square_a2
        self._mean_a = state.mean_a
        self._is_restored = True
        self.discharged_pct = state.discharged_pct
        self.moved_pct = state.moved_pct
        self.counted_s = state.counted_s


# --- The estimator's own time: bus time that never runs backwards, whatever the stamps do

LATEST_S = 1e11
"""A stamp beyond this is none [s] (the year 5138)."""

SHORTEST_STEP_S = 1e-7
"""Two samples less than this apart have the same time [s]: stamps are whole microseconds."""

SET_BACK_S = 1.0
"""A stamp so much before the last one may be that of a clock that was set back [s] …"""

SET_BACK_SAMPLES = 5
"""… and is, once so many in a row are, each after the one before: time then runs on from where it
was. Fewer are late or damaged, and refused."""

EARLY_S = 5.0
"""After an interruption, stamps that say it was so much shorter than it was are not believed
[s]."""

SHORTEST_PAUSE_S = 1e-3
"""An interruption lasts at least this [s]."""

LONGEST_PAUSE_S = 30.0 * 86400.0
"""A longer step counts as this [s]: it tells no more, and may be a clock that went astray."""

UNKNOWN_PAUSE_S = 86400.0
"""How long an interruption is taken to have lasted when no clock knows [s]."""


class EstimatorClock:
    """Maps the samples' stamps to a time that increases."""

    def __init__(self) -> None:
        self.last_s = math.nan
        """Time of the last sample that was taken [s]; NaN before the first."""
        self._shift_s = 0.0
        self._behind = 0
        self._behind_s = math.nan
        self._age_s: float | None = None

    def at(self, stamp_s: float) -> float | None:
        """Return a stamp's time [s], later than the last; None if the sample is to be refused."""
        if not abs(stamp_s) <= LATEST_S:
            return None
        if math.isnan(self.last_s):
            self.last_s, self._age_s = stamp_s, None
            return stamp_s
        shift_s = self._shift_s
        step_s = stamp_s + shift_s - self.last_s
        age_s, self._age_s = self._age_s, None
        if age_s is not None and not step_s >= _at_least(age_s):
            # The stamps begin anew, or their clock was set back or stood still.
            pause_s = UNKNOWN_PAUSE_S if math.isnan(age_s) else max(age_s, SHORTEST_PAUSE_S)
            shift_s += pause_s - step_s
        elif step_s < SHORTEST_STEP_S:
            if not self._is_set_back(stamp_s, step_s):
                return None
            shift_s += stamp_s - self._behind_s - step_s
        elif step_s > LONGEST_PAUSE_S:
            shift_s += LONGEST_PAUSE_S - step_s
        time_s = stamp_s + shift_s
        if time_s - self.last_s < SHORTEST_STEP_S:
            return None
        self._shift_s = shift_s
        self._behind, self._behind_s = 0, math.nan
        self.last_s = time_s
        return time_s

    def _is_set_back(self, stamp_s: float, step_s: float) -> bool:
        if step_s > -SET_BACK_S:
            return False
        if stamp_s - self._behind_s < SHORTEST_STEP_S:
            self._behind = 0
        if self._behind + 1 >= SET_BACK_SAMPLES:
            return True
        self._behind += 1
        self._behind_s = stamp_s
        return False

    def state(self) -> ClockState:
        """Return what is to be remembered."""
        return ClockState.model_construct(
            last_s=self.last_s, shift_s=self._shift_s, behind=self._behind, behind_s=self._behind_s
        )

    @property
    def age_s(self) -> float | None:
        """Age of what was restored, until a sample came [s]; None: nothing was."""
        return self._age_s

    def restore(self, state: ClockState, age_s: float | None) -> None:
        """Go on from a state.

        Parameters
        ----------
        state : ClockState
        age_s : float or None
            How old it is at least [s]; NaN if no clock knows. Stamps that say less are not
            believed. None: there was no interruption.
        """
        self.last_s = state.last_s
        self._shift_s = state.shift_s
        self._behind, self._behind_s = state.behind, state.behind_s
        self._age_s = age_s


def _at_least(age_s: float) -> float:
    """Return how long a pause the stamps must show at least to be believed [s]."""
    return max((UNKNOWN_PAUSE_S if math.isnan(age_s) else age_s) - EARLY_S, SHORTEST_STEP_S)
