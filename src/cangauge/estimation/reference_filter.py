"""Reference implementation of the estimator's Kalman filter, by filterpy.

`SocEkf` does its arithmetic in plain floats, row by row. `ReferenceEkf` is the same filter with the
two steps of the arithmetic left to filterpy's `ExtendedKalmanFilter`: slower, and not of our
making. Tests hold the two to each other.

A Schmidt–Kalman update equals the ordinary one but for the considered states: their values and
their covariance among each other are kept (Jazwinski, Stochastic Processes and Filtering Theory,
1970, ch. 8.4), which is how it is made here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

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


class ReferenceEkf(SocEkf):
    """`SocEkf` with the arithmetic of filterpy's `ExtendedKalmanFilter`."""

    def _propagate(
        self,
        discharged_pct: float,
        by_offset_and_capacity: tuple[float, float],
        kept: tuple[float, float],
        noise: tuple[float, float, float, float],
    ) -> None:
        ekf = self._loaded()
        ekf.F = np.eye(ekf.dim_x)
        ekf.F[SOC, OFFSET], ekf.F[SOC, CAPACITY] = by_offset_and_capacity
        ekf.F[SLOW, SLOW], ekf.F[LASTING, LASTING] = kept
        ekf.Q = np.diag([*noise, *[0.0] * (ekf.dim_x - len(noise))])
        ekf.B = np.eye(ekf.dim_x)[:, :1]
        ekf.predict(u=np.array([[-discharged_pct]]))
        self._store(ekf)

    def _correct(
        self,
        jacobian: Sequence[float],
        spread: list[float],  # noqa: ARG002 - filterpy computes it
        innovation: float,
        of_state: float,  # noqa: ARG002
        variance: float,
    ) -> None:
        ekf = self._loaded()
        considered = ekf.x[LEARNED:].copy(), ekf.P[LEARNED:, LEARNED:].copy()
        row = np.array([jacobian])
        ekf.update(np.array([[innovation]]), lambda _: row, lambda _: np.zeros((1, 1)), R=variance)
        ekf.x[LEARNED:], ekf.P[LEARNED:, LEARNED:] = considered
        self._store(ekf)

    def _loaded(self) -> ExtendedKalmanFilter:
        """Return filterpy's filter at the present state."""
        ekf = ExtendedKalmanFilter(dim_x=len(self._x), dim_z=1, dim_u=1)
        ekf.x = np.array(self._x).reshape(-1, 1)
        ekf.P = full_covariance(self._p)
        return ekf

    def _store(self, ekf: ExtendedKalmanFilter) -> None:
        self._x = ekf.x[:, 0].tolist()
        self._p = ekf.P[:LEARNED].tolist()
