"""Least squares with a rising pseudo-OCV and a prior on the temperature coefficient.

The columns 1 … 1/s⁴, s, ln s, ln(1 − s) are nearly dependent (condition numbers of 10⁶ and more
over the SoC of a few trips), so the columns are scaled to unit length and the problem is solved
by SVD. Where the pseudo-OCV of the plain solution falls within the identified SoC, the same
problem is solved as a convex quadratic programme with a lower bound on the slope.

Over one discharge the temperature rises while the charge falls, and the model error changes as
slowly as both. Plain least squares then returns any temperature coefficient kt that reduces the
residual slightly, with a small standard error: volts per kelvin for a pack of 96 cells, each of
which has tenths of a millivolt per kelvin (`benchmarks/other_temperatures.py`). `kt_prior` gives
kt a zero-mean prior, weighted against the data with the residual's variance per time scale.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import lapack

from cangauge._typing import FloatArray
from cangauge.errors import CangaugeError
from cangauge.inference.time_scales import SCALES

SINGULAR = 1e-11
"""Singular values below this, relative to the largest, are truncated."""

CLUSTER_S = 300.0
"""Distance from which residuals count as independent in the standard errors [s]."""

FEASIBLE = 1e-9
"""Tolerance of a bound, relative to one plus its value."""

KT_PRIOR_PER_K = 2.5e-4
"""Prior standard deviation of kt, relative to the voltage [1/K]: 1 mV/K per cell, a few times the
entropic coefficient. Chosen on simulated packs and real cells: half of it was better for the cells,
two to four times as much for packs with the published coefficient, which is eight times as
large."""

COEFFICIENTS_AT_LEAST = 40
"""Haar coefficients of a scale, at least, for its variance to be that of the errors: with fewer the
fit has absorbed them."""

GROWTH_AT_MOST = np.log(4.0)
"""Growth of the log variance of errors from one scale to the next: that of a random walk."""

GROWTH_SCALES = 3
"""Number of the slowest well-observed scales from which the growth is estimated."""

JITTER = 1e-9
"""Ridge on the information matrix, relative to its mean diagonal."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Coefficients of a fit with their uncertainty."""

    coefficients: FloatArray
    """Shape (p,), in the units of the columns."""
    std_error: FloatArray
    """Shape (p,); robust against residuals correlated within `CLUSTER_S`."""
    condition_number: float
    """Of the scaled columns."""
    constrained: bool
    """Whether a bound is active: the plain solution's pseudo-OCV falls."""
    back: FloatArray
    """Coefficients of orthonormal coordinates, shape (p, kept): x = back·z."""
    kt_prior: KtPrior | None = None
    """Prior on the temperature coefficient, if one was used."""

    def first(self, number: int) -> Solution:
        """Return the solution restricted to the first coefficients."""
        return replace(
            self,
            coefficients=self.coefficients[:number],
            std_error=self.std_error[:number],
            back=self.back[:number],
        )


def solve(
    columns: FloatArray, target: FloatArray, block: NDArray[np.intp], bounds: FloatArray | None,
    at_least: float | FloatArray,
) -> Solution:  # fmt: skip
    """Minimise |columns·x − target|² subject to bounds·x ≥ at_least.

    Parameters
    ----------
    columns : array of shape (n, p)
    target : array of shape (n,)
    block : array of shape (n,)
        Rows with the same number may have correlated residuals.
    bounds : array of shape (m, p), optional
    at_least : float or array of shape (m,)

    Raises
    ------
    CangaugeError
        If the convex solver fails.
    """
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    left, singular, right = np.linalg.svd(columns / scale, full_matrices=False)
    kept = singular > SINGULAR * singular[0]
    left, right = left[:, kept], right[kept]
    # x = scale⁻¹·rightᵀ·(z/singular): in z the objective is |z − leftᵀ·target|², a sphere.
    back = (right / singular[kept, None]).T / scale[:, None]
    z = left.T @ target
    constrained = bounds is not None and bool(np.any(bounds @ (back @ z) < at_least))
    if constrained and bounds is not None:
        z = _project(z, bounds @ back, np.broadcast_to(at_least, bounds.shape[:1]))
    x = back @ z
    return Solution(
        coefficients=x,
        std_error=_clustered_std_error(left, target - columns @ x, block, back),
        condition_number=float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf"),
        constrained=constrained,
        back=back,
    )


def triangular_factor(tables: Iterable[FloatArray]) -> FloatArray:
    """Return R of the QR decomposition of tables below each other, which need not fit in memory.

    Parameters
    ----------
    tables : iterable of arrays of shape (m, p)

    Returns
    -------
    array of shape (p, p)
        Filled up with rows of zeros if there are fewer rows than columns.
    """
    root: FloatArray | None = None
    for table in tables:
        kept = 0 if root is None else len(root)
        stacked = np.zeros((max(kept + len(table), table.shape[1]), table.shape[1]), order="F")
        if root is not None:
            stacked[:kept] = root
        stacked[kept : kept + len(table)] = table
        root = np.triu(lapack.dgeqrf(stacked, overwrite_a=True)[0][: table.shape[1]])
    if root is None:
        raise ValueError("no table is given")
    return root


def nearest_rising(
    root: FloatArray, target: FloatArray, bounds: FloatArray, at_least: FloatArray
) -> FloatArray:
    """Minimise |root·x − target|² subject to bounds·x ≥ at_least; root is square and regular.

    Parameters
    ----------
    root : array of shape (p, p)
    target : array of shape (p,)
    bounds : array of shape (m, p)
    at_least : array of shape (m,)

    Raises
    ------
    CangaugeError
        If the convex solver fails.
    """
    inverse = np.linalg.inv(root)
    plain = inverse @ target
    if np.all(bounds @ plain >= at_least):
        return np.asarray(plain)
    return np.asarray(inverse @ _project(target, bounds @ inverse, at_least))


def _project(z: FloatArray, bounds: FloatArray, at_least: FloatArray) -> FloatArray:
    """Return the point nearest to z with bounds·point ≥ at_least, by an active-set outer loop.

    Only bounds violated by z, or by the previous point, enter the quadratic programme.
    """
    length = np.linalg.norm(bounds, axis=1)
    moves = length > 0.0  # a row without a kept direction cannot be bounded
    bounds, at_least = bounds[moves] / length[moves, None], at_least[moves] / length[moves]
    feasible = at_least - FEASIBLE * (1.0 + np.abs(at_least))
    point, active = z, np.zeros(at_least.size, dtype=bool)
    while np.any(violated := (bounds @ point < feasible) & ~active):
        active |= violated
        point = _solve_quadratic(z, bounds[active], at_least[active])
    return point


def _solve_quadratic(z: FloatArray, bounds: FloatArray, at_least: FloatArray) -> FloatArray:
    # Relative to z and in units of the largest violation: the solver's tolerances suit numbers
    # about 1, and at a hundred it may stop short.
    violation = at_least - bounds @ z
    unit = float(np.abs(violation).max())
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix(np.eye(z.size)),
        np.zeros(z.size),
        sparse.csc_matrix(-bounds),
        -violation / unit,
        [clarabel.NonnegativeConeT(at_least.size)],
        settings,
    ).solve()
    if str(solution.status) not in {"Solved", "AlmostSolved"}:
        raise CangaugeError(
            f"the fit with a rising pseudo-OCV failed ({solution.status}):"
            " check the sign of current, and that the log covers some SoC"
        )
    return z + unit * np.array(solution.x)


def _clustered_std_error(
    left: FloatArray, residual: FloatArray, block: NDArray[np.intp], back: FloatArray
) -> FloatArray:
    _, number = np.unique(block, return_inverse=True)
    scores = np.zeros((int(number.max()) + 1, left.shape[1]))
    np.add.at(scores, number, left * residual[:, None])
    clusters = np.sum((back @ scores.T) ** 2, axis=1)
    return sandwich_std_error(
        back, clusters, len(scores), square_v2=float(residual @ residual), rows=len(left)
    )


def sandwich_std_error(
    back: FloatArray, clusters: FloatArray, groups: int, *, square_v2: float, rows: int
) -> FloatArray:
    """Return the cluster-robust sandwich estimate (Liang and Zeger), at least the plain one.

    Parameters
    ----------
    back : array of shape (p, kept)
        Of a `Solution`.
    clusters : array of shape (p,)
        Sum over the clusters of the squared effect of their scores on each coefficient.
    groups : int
        Number of clusters.
    square_v2 : float
        Sum of the squared residuals.
    rows : int
    """
    free = max(rows - back.shape[1], 1)
    small_sample = (groups / max(groups - 1, 1)) * ((rows - 1) / free)
    # A few clusters cannot determine p directions: the plain estimate is the lower limit.
    plain = square_v2 / free * np.sum(back**2, axis=1)
    return np.asarray(np.sqrt(np.maximum(small_sample * clusters, plain)))


@dataclass(frozen=True, eq=False)
class KtPrior:
    """Zero-mean prior on the temperature coefficient kt, against the information of the logs."""

    data_std_v_per_k: float
    """Standard error of kt from the logs alone [V/K]."""
    prior_std_v_per_k: float
    """Prior standard deviation [V/K]."""
    orthogonal_k2: float
    """Sum of squares of the part of the temperature column orthogonal to the others [K²]."""
    shift_per_kt: FloatArray
    """Change of the other coefficients with kt, shape (p,), 0 for kt itself."""
    residual_std_v: float
    """Of plain least squares [V]."""

    @property
    def row_weight(self) -> float:
        """Weight of the row kt = 0 V/K that makes least squares shrink kt by `shrinkage` [K].

        At least the weight for white errors, which bounds kt where the temperature is constant and
        `orthogonal_k2` is zero.
        """
        weight = float(np.sqrt((1.0 / self.shrinkage - 1.0) * self.orthogonal_k2))
        return max(weight, self.residual_std_v / self.prior_std_v_per_k)

    @property
    def shrinkage(self) -> float:
        """Posterior mean over the plain coefficient (0–1)."""
        prior_v2 = self.prior_std_v_per_k**2
        return prior_v2 / (prior_v2 + self.data_std_v_per_k**2)

    @property
    def posterior_std_v_per_k(self) -> float:
        """Posterior standard deviation of kt [V/K]."""
        return self.data_std_v_per_k * float(np.sqrt(self.shrinkage))


def kt_prior(
    columns: FloatArray,
    by_scale: Sequence[FloatArray],
    counts: Sequence[int],
    kt: int,
    *,
    nominal_v: float,
    residual_std_v: float,
) -> KtPrior:
    """Return the prior on kt from the Haar coefficients of columns and residual.

    Only sums of products count: in place of rows there may be the triangular factor of their QR
    decomposition, with as many rows as columns.

    Parameters
    ----------
    columns : array of shape (n, p)
    by_scale : SCALES arrays of shape (n_j, p + 1)
        Haar coefficients of the columns, and of the residual [V].
    counts : sequence of int
        Numbers of coefficients of each scale.
    kt : int
        Index of the temperature column.
    nominal_v : float
        Median of the voltage [V].
    residual_std_v : float
        Root mean square of the residual [V].
    """
    scale = np.sqrt(np.sum(columns**2, axis=0) / sum(counts))
    scale[scale == 0.0] = 1.0
    variance = _scale_variances([item[:, -1] for item in by_scale], counts)
    information = sum(
        item.T @ item / v2
        for item, v2 in zip([each[:, :-1] / scale for each in by_scale], variance, strict=True)
    )
    total = np.asarray(information)
    total[np.diag_indices(len(total))] += JITTER * np.trace(total) / len(total)
    kt_variance = float(np.linalg.inv(total)[kt, kt])
    orthogonal_k, shift_per_kt = _orthogonal_part(columns, kt)
    return KtPrior(
        data_std_v_per_k=float(np.sqrt(kt_variance)) / float(scale[kt]),
        prior_std_v_per_k=KT_PRIOR_PER_K * nominal_v,
        orthogonal_k2=float(orthogonal_k @ orthogonal_k),
        shift_per_kt=shift_per_kt,
        residual_std_v=residual_std_v,
    )


def _orthogonal_part(columns: FloatArray, at: int) -> tuple[FloatArray, FloatArray]:
    """Return a column minus its regression on the others, (n,), and minus its slopes, (p,)."""
    norm = np.linalg.norm(columns, axis=0)
    norm[norm == 0.0] = 1.0
    rest = np.arange(columns.shape[1]) != at
    slopes = np.zeros(columns.shape[1])
    scaled = columns[:, rest] / norm[rest]
    slopes[rest] = np.linalg.lstsq(scaled, columns[:, at], rcond=None)[0] / norm[rest]
    return columns[:, at] - columns @ slopes, -slopes


def _scale_variances(residual_v: Sequence[FloatArray], sizes: Sequence[int]) -> FloatArray:
    """Return the expected variance of the errors of each scale, shape (SCALES,) [V²].

    Slower errors than those of the well-observed scales are absorbed by the fit; their variance is
    extrapolated.
    """
    counts = np.array(sizes)
    found = np.array([float(item @ item) for item in residual_v]) / np.maximum(counts, 1)
    found = np.maximum(found, 1e-12)
    observed = np.flatnonzero(counts >= COEFFICIENTS_AT_LEAST)
    if observed.size:
        last, first = observed[-1], max(observed[-1] - GROWTH_SCALES, 0)
        growth = np.log(found[last] / found[first]) / max(last - first, 1)
        growth = float(np.clip(growth, 0.0, GROWTH_AT_MOST))
        beyond = np.arange(last + 1, SCALES)
        found[beyond] = np.maximum(found[beyond], found[last] * np.exp(growth * (beyond - last)))
    return np.asarray(np.maximum.accumulate(found))
