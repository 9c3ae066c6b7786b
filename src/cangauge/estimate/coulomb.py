"""Coulomb counting over irregular samples, with a stated limit on gaps.

Steps up to `gap_s` count by the trapezoidal rule. Longer ones up to `BRIDGE_S` count so too, but
their charge is uncertain by the whole recent current. Beyond that the pack is taken to have
rested (bus asleep, service not running), and since it may have been charged meanwhile, the
uncertainty grows with the time away. `pause` says how the filter treats such a time.

Across a restart the currents at both ends of the gap count for the few seconds that a driver holds
a current, and the mean of the last minute for the rest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from cangauge.estimate.pause import parked_std_pct
from cangauge.estimate.state import CounterState
from cangauge.model.charge import BRIDGE_S

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
