"""The published equation by plain least squares: k0 … k7, kt and R1 … Rn, from one factor a log.

Least squares needs of a log only the triangular factor R of the QR decomposition of its rows
[columns, voltage]. The factor of several logs is that of their factors stacked, and has the
condition of the rows, not its square as normal equations have (Golub, Van Loan, Matrix
Computations, 4th ed., §5.3); the powers of 1/s need that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.identify.least_squares import SECONDS_PER_DATUM
from cangauge.identify.rows import ROWS_PER_COEFFICIENT, SOC_SPAN_AT_LEAST_PCT, FitRows
from cangauge.model.model_file import Published
from cangauge.model.voltage_model import (
    BASIS_NAMES,
    EDGE,
    KNOTS_PCT,
    PublishedCurve,
    ocv_basis,
)

SINGULAR = 1e-9
"""Singular value relative to the largest, of columns of equal norm, below which a combination of
coefficients is not identified [-]: voltages are known to 1e-4, and trips over a fifth of the SoC
reach 1e-10, from full to empty 1e-6."""


@dataclass(frozen=True, eq=False)
class Factor:
    """Summary of a log for the published equation.

    Parameters
    ----------
    root : array of shape (p + 1, p + 1)
        Triangular factor of [columns, voltage].
    rows : int
    row_s : float
        Time that a row stands for [s].
    soc_range_pct : pair of float
    """

    root: FloatArray
    rows: int
    row_s: float
    soc_range_pct: tuple[float, float]


def published_columns(rows: FitRows, delays: int, epsilon: float, t_ref_c: float) -> FloatArray:
    """Return the columns of k0 … k7, kt, R1 … Rn, shape (m, p), with the first currents delayed."""
    warmer = rows.dequantized_c - t_ref_c
    return np.column_stack([ocv_basis(rows.soc_pct, epsilon), warmer, rows.currents_a[:, :delays]])


def factor_of(rows: FitRows, delays: int, epsilon: float, t_ref_c: float) -> Factor:
    """Return the factor of a log's rows, of which the first currents are delayed ones."""
    size = len(BASIS_NAMES) + 1 + delays + 1
    root = np.zeros((size, size))
    for part in rows.parts():
        block = rows.part(part)
        columns = published_columns(block, delays, epsilon, t_ref_c)
        table = np.column_stack([columns, block.voltage_v])
        root = np.linalg.qr(np.vstack([root, table])).R
    range_pct = float(rows.soc_pct.min()), float(rows.soc_pct.max())
    return Factor(root, len(rows), rows.row_s, range_pct)


def pooled(factors: Sequence[Factor]) -> Factor:
    """Return the factor of several logs together."""
    rows = sum(item.rows for item in factors)
    return Factor(
        np.linalg.qr(np.vstack([item.root for item in factors])).R,
        rows,
        sum(item.rows * item.row_s for item in factors) / rows,
        (
            min(item.soc_range_pct[0] for item in factors),
            max(item.soc_range_pct[1] for item in factors),
        ),
    )


@dataclass(frozen=True, eq=False)
class PublishedFit:
    """Coefficients of the published equation.

    Parameters
    ----------
    coefficients : array of shape (p,)
        k0 … k7 [V], kt [V/K], R1 … Rn [Ω].
    covariance : array of shape (p, p)
        Theirs; rows of a minute count as one.
    residual_v : float
        Rms residual [V].
    condition_number : float
        Of the columns, scaled to equal norm.
    identified : bool
        Whether the logs determine every coefficient.
    soc_range_pct : pair of float
    """

    coefficients: FloatArray
    covariance: FloatArray
    residual_v: float
    condition_number: float
    identified: bool
    soc_range_pct: tuple[float, float]

    def fields(self, epsilon: float, t_ref_c: float, delay_s: Sequence[float]) -> Published:
        """Return the equation for a model file."""
        return Published.of(
            self.coefficients.tolist(),
            np.sqrt(np.diag(self.covariance)).tolist(),
            epsilon=epsilon,
            t_ref_c=t_ref_c,
            delays_s=delay_s,
        )

    def jacobian(self, epsilon: float) -> FloatArray:
        """Return d(curve at the knots, kt, R1 … Rn)/d(coefficients)."""
        n, p = len(BASIS_NAMES), self.coefficients.size
        low, high = self.soc_range_pct
        part = EDGE * (high - low)
        ends = ocv_basis([low, low + part, high - part, high], epsilon)
        inside = np.clip(KNOTS_PCT, low, high)
        beyond = (KNOTS_PCT - inside)[:, None]
        slope = np.where(beyond < 0.0, ends[1] - ends[0], ends[3] - ends[2]) / part
        jacobian = np.zeros((KNOTS_PCT.size + p - n, p))
        jacobian[: KNOTS_PCT.size, :n] = ocv_basis(inside, epsilon) + beyond * slope
        jacobian[KNOTS_PCT.size :, n:] = np.eye(p - n)
        return jacobian


def solve_published(factor: Factor, epsilon: float) -> PublishedFit:
    """Return the least-squares coefficients; of several solutions the one of least norm."""
    p = len(factor.root) - 1
    norm = np.linalg.norm(factor.root[:, :p], axis=0)
    norm[norm == 0.0] = 1.0
    columns, volts = factor.root[:, :p] / norm, factor.root[:, p]
    left, singular, right = np.linalg.svd(columns, full_matrices=False)
    kept = singular > SINGULAR * singular[0]
    inverse = np.where(kept, 1.0 / np.where(kept, singular, 1.0), 0.0)
    scaled = right.T @ (inverse * (left.T @ volts))
    residual2 = float(np.sum((volts - columns @ scaled) ** 2)) / factor.rows
    datum = max(1.0, SECONDS_PER_DATUM / max(factor.row_s, 1e-9))
    covariance = (right.T * (inverse**2 * residual2 * datum)) @ right / np.outer(norm, norm)
    coefficients = scaled / norm
    span = factor.soc_range_pct[1] - factor.soc_range_pct[0]
    identified = bool(kept.all()) and factor.rows >= ROWS_PER_COEFFICIENT * p
    identified = identified and span >= SOC_SPAN_AT_LEAST_PCT
    if identified:
        try:
            PublishedCurve(tuple(coefficients[: len(BASIS_NAMES)]), epsilon, factor.soc_range_pct)
        except InputError:
            identified = False
    return PublishedFit(
        coefficients,
        covariance,
        residual2**0.5,
        float(singular[0] / singular[-1]) if singular[-1] > 0.0 else float("inf"),
        identified,
        factor.soc_range_pct,
    )
