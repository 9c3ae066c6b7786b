"""The estimator's own time: bus time that never runs backwards, whatever the stamps do."""

from __future__ import annotations

import math

from cangauge.estimate.state import ClockState

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
