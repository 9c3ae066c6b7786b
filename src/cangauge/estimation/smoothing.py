"""Best SoC of a recorded log: a Rauch–Tung–Striebel pass over the estimator's filter.

The filter's SoC at a moment follows from the samples before it. Backwards over the recorded states,
each estimate is corrected by what came after (Rauch, Tung, Striebel, AIAA J. 3 (1965) 1445; Särkkä,
Bayesian Filtering and Smoothing, 2013, ch. 9):

    G = P·Fᵀ·P'⁻¹,   x̂ ← x + G·(x̂' − x'),   P̂ ← P + G·(P̂' − P')·Gᵀ

with x', P' the state predicted from x, P. The considered errors of the curve are the same at all
times, so no correction of theirs is passed on: their part of the covariance stays.

A filter that was started again, by a contradiction or after an unobserved interval, has forgotten
what was before: the pass ends there, and the filter's own SoC stands for the time before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cangauge._typing import FloatArray
from cangauge.estimation.ekf import (
    CAPACITY,
    LASTING,
    LEARNED,
    OFFSET,
    SLOW,
    SOC,
    SocEkf,
    full_covariance,
)
from cangauge.estimation.estimator import Estimator

TIME_ROUNDING_S = 1e-6
"""Rounding of sums of steps in time [s]."""


@dataclass(frozen=True, eq=False)
class Step:
    """One prediction of the filter: the state before and after it, and its matrix."""

    x: FloatArray
    p: FloatArray
    transition: FloatArray
    x_after: FloatArray
    p_after: FloatArray
    elapsed_s: float
    """Time of it since the filter was made [s]."""


class RecordingEkf(SocEkf):
    """`SocEkf` that keeps its predictions since it was started.

    Attributes
    ----------
    steps : list of Step
    """

    steps: list[Step]
    _elapsed_s = 0.0

    def predict(
        self,
        seconds: float,
        discharged_pct: float,
        moved_pct: float,
        gap_var_pct2: float,
        away_s: float = 0.0,
    ) -> None:
        """Propagate the state; see `SocEkf.predict`."""
        self._elapsed_s += seconds
        super().predict(seconds, discharged_pct, moved_pct, gap_var_pct2, away_s)

    def start(self, soc_pct: float, soc_std_pct: float) -> None:
        """Restart from a SoC with its standard deviation [%]."""
        super().start(soc_pct, soc_std_pct)
        self.steps = []

    def _propagate(
        self,
        discharged_pct: float,
        by_offset_and_capacity: tuple[float, float],
        kept: tuple[float, float],
        noise: tuple[float, float, float, float],
    ) -> None:
        x, p = np.array(self._x), full_covariance(self._p)
        super()._propagate(discharged_pct, by_offset_and_capacity, kept, noise)
        transition = np.eye(x.size)
        transition[SOC, OFFSET], transition[SOC, CAPACITY] = by_offset_and_capacity
        transition[SLOW, SLOW], transition[LASTING, LASTING] = kept
        after = np.array(self._x), full_covariance(self._p)
        self.steps.append(Step(x, p, transition, *after, self._elapsed_s))

    def restore(self, state: object) -> None:
        """Continue from a state, without what led to it."""
        super().restore(state)  # type: ignore[arg-type]
        self.steps = []

    def smoothed(self) -> tuple[FloatArray, FloatArray]:
        """Return SoC and standard deviation [%] before each prediction, and now: (steps + 1,)."""
        x, p = np.array(self._x), full_covariance(self._p)
        soc, variance = [x[SOC]], [p[SOC, SOC]]
        for step in reversed(self.steps):
            # Scaled: the states differ by orders of magnitude.
            scale = np.sqrt(np.maximum(np.diag(step.p_after), 1e-300))
            gain = step.p @ step.transition.T / scale
            gain = np.linalg.lstsq((step.p_after / np.outer(scale, scale)).T, gain.T, rcond=1e-12)[
                0
            ].T
            gain = gain / scale
            gain[LEARNED:] = 0.0
            gain[LEARNED:, LEARNED:] = np.eye(len(gain) - LEARNED)
            x = step.x + gain @ (x - step.x_after)
            p = step.p + gain @ (p - step.p_after) @ gain.T
            soc.append(x[SOC])
            variance.append(p[SOC, SOC])
        return np.array(soc[::-1]), np.sqrt(np.maximum(variance[::-1], 0.0))


class Smoother:
    """Smoothed SoC of a log, from an estimator with a `RecordingEkf`.

    Call `observe` after each sample, then `soc`.
    """

    def __init__(self) -> None:
        self._time_s: list[float] = []

    def observe(self, estimator: Estimator) -> None:
        """Note the estimator's time of a sample."""
        self._time_s.append(estimator.time_s)

    def soc(
        self, estimator: Estimator, soc_pct: FloatArray, std_pct: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return smoothed SoC and standard deviation at every sample [%], shape (n,) each.

        Parameters
        ----------
        estimator : Estimator
            After the last sample.
        soc_pct, std_pct : array of shape (n,)
            The filter's own estimates at the samples observed.
        """
        ekf = estimator.filter.likelier
        if not (isinstance(ekf, RecordingEkf) and ekf.steps and self._time_s):
            return soc_pct, std_pct
        smooth_pct, smooth_std = ekf.smoothed()
        elapsed_s = np.array([step.elapsed_s for step in ekf.steps])
        last_s = self._time_s[-1] - estimator.snapshot().since.seconds
        # The first state, before any prediction, has the time of the filter's start.
        at_s = last_s - elapsed_s[-1] + elapsed_s
        smooth_pct, smooth_std = smooth_pct[1:], smooth_std[1:]
        time_s = np.array(self._time_s)
        # Between updates the count leads: interpolate the correction, not the SoC.
        sample = np.clip(np.searchsorted(time_s, at_s - TIME_ROUNDING_S), 0, time_s.size - 1)
        correction = smooth_pct - soc_pct[sample]
        inside = (time_s >= at_s[0] - TIME_ROUNDING_S) & np.isfinite(soc_pct)
        soc_pct, std_pct = soc_pct.copy(), std_pct.copy()
        soc_pct[inside] += np.interp(time_s, at_s, correction)[inside]
        std_pct[inside] = np.interp(time_s, at_s, smooth_std)[inside]
        return np.clip(soc_pct, 0.0, 100.0), std_pct
