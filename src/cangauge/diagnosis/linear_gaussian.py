"""Linear Gaussian model of all logs, references and diagnosed.

    residual = coefficients·δθ + structure·ρ + per-log·o + effect·a + error

δθ is the change of the voltage model coefficients, with the model file's information as prior; ρ
are the amplitudes of the shared structure; o are the per-log effects, whose prior is the spread
between healthy logs; a are the amplitudes of the tested effect, which only diagnosed logs have. All
but a are marginalised. The result is quadratic in a, for all candidates at once:

    ln p(residual | a) = g·a − ½ a·S·a + const.

The error is correlated in time: products are formed for each time scale of a Haar transform
(`inference.time_scales`) and weighted by the error variance at that scale.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from cangauge._typing import FloatArray
from cangauge.diagnosis.design_matrix import DesignMatrix
from cangauge.diagnosis.hypotheses import Hypotheses, Layout, prior_precision
from cangauge.errors import InputError
from cangauge.inference.least_squares import nearest_rising
from cangauge.inference.linearized import SLOPE_CHECKS
from cangauge.inference.time_scales import haar_transform
from cangauge.model.voltage_model import BASIS_NAMES, SLOPE_AT_LEAST, VoltageModel, ocv_basis_slope

STRUCTURE_STD = 0.1
"""Standard deviation by which diagnosed logs may change the structure of the references, in parts
of its bounds. Without this limit, structure would absorb a cause of the same effect."""

USUAL_OVERDISPERSION = 3.4
"""Median over six development packs (i3, car1, LG at 0, 10 and 25 °C, simulated: 1.5–5.8): used
where references do not show it."""

JITTER = 1e-10
"""Relative diagonal load: coefficients without information stay at their prior mean."""


@dataclass(frozen=True)
class ErrorModel:
    """Error of the voltage model on healthy logs, and the prior scales that go with it."""

    scale_v2: tuple[float, ...]
    """Error variance at each time scale (`inference.time_scales`) [V²]."""
    per_log_std: tuple[float, ...]
    """Standard deviation of the per-log amplitudes (`Hypotheses.per_log_prior_std`)."""
    rmse_v: float
    """RMS error of a row without the per-log effects [V]."""
    overdispersion: Mapping[str, float] = field(default_factory=dict)
    """Ratio of each effect's squared evidence on left-out references to its expectation by chance;
    empty where not known."""
    reference_v2: float = 0.0
    """Mean square error of left-out references, per-log effects included [V²]."""
    reference_excess: tuple[float, ...] = ()
    """Excess chi-square of each left-out reference (`bayes_factors.excess_chi_square`)."""
    information_weight: float = 1.0
    """Weight of the model file's information: below 1 where references contradict it."""
    structure: Mapping[str, float] = field(default_factory=dict)
    """Prior scale of each structure effect in parts of its physical range; 1 where not listed."""

    @property
    def lasting_v2(self) -> float:
        """Variance per row of an error that does not average out [V²]."""
        return self.scale_v2[-1]

    @property
    def usual_overdispersion(self) -> float:
        """Geometric mean of the overdispersions."""
        known = [*self.overdispersion.values()]
        return math.exp(float(np.mean(np.log(known)))) if known else USUAL_OVERDISPERSION

    def overdispersion_of(self, effect_id: str) -> float:
        """Return an effect's overdispersion, the usual one where its own is not known."""
        return self.overdispersion.get(effect_id, self.usual_overdispersion)


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Products of a log's columns with each other, by time scale.

    Columns: coefficients (p); amplitudes (of all candidates; of a reference those of
    `Hypotheses.reference_columns`); `PER_LOG_STATES`; residual. See `Hypotheses.diagnosed_layout`
    and `Hypotheses.reference_layout`.
    """

    products: FloatArray
    """Shape (SCALES, columns, columns)."""
    counts: FloatArray
    """Haar coefficients of each scale, shape (SCALES,); reduced where rows have less weight."""
    _last_weighted: dict[object, FloatArray] = field(default_factory=dict, repr=False)
    _last_marginal: dict[object, tuple[FloatArray, float]] = field(default_factory=dict, repr=False)

    def columns(self, kept: NDArray[np.intp]) -> NormalEquations:
        """Return the products of some columns."""
        return NormalEquations(self.products.take(kept, 1).take(kept, 2), self.counts)

    def inflated(self, factor: float) -> NormalEquations:
        """Return the products for an error variance `factor` times as large."""
        if factor == 1.0:
            return self
        return NormalEquations(self.products / factor, self.counts)

    def weighted(self, error: ErrorModel) -> FloatArray:
        """Return the sum of the products over the scales, each divided by its variance [-]."""
        known = self._last_weighted
        if error.scale_v2 not in known:  # the same for many trials of the prior scales
            known.clear()
            factors = 1.0 / np.array(error.scale_v2)
            known[error.scale_v2] = np.asarray(np.tensordot(factors, self.products, axes=1))
        return known[error.scale_v2]

    def marginal(self, error: ErrorModel, layout: Layout) -> tuple[FloatArray, float]:
        """Integrate out the per-log amplitudes.

        Returns
        -------
        products : array
            Weighted products of the columns `Layout.kept`.
        log_det : float
            ln det of the amplitudes' posterior precision over their prior's.
        """
        known, key = self._last_marginal, (error.scale_v2, error.per_log_std, layout)
        if key not in known:  # a reference's is the same whatever it is compared with
            weighted, kept = self.weighted(error), layout.kept
            std, root = self._per_log_root(error, layout)
            toward = std[:, None] * weighted[np.ix_(layout.per_log, kept)]
            gained = solve_triangular(root, toward, lower=True, check_finite=False)
            log_det = 2.0 * float(np.sum(np.log(np.diag(root))))
            known.clear()
            known[key] = (weighted[np.ix_(kept, kept)] - gained.T @ gained, log_det)
        return known[key]

    def per_log_amplitudes(
        self, error: ErrorModel, layout: Layout, weights: FloatArray
    ) -> FloatArray:
        """Return the most probable per-log amplitudes for a residual of weighted columns."""
        std, root = self._per_log_root(error, layout)
        right = std * (self.weighted(error)[layout.per_log] @ weights)
        return np.asarray(std * cho_solve((root, True), right, check_finite=False))

    def _per_log_root(self, error: ErrorModel, layout: Layout) -> tuple[FloatArray, FloatArray]:
        """Return standard deviations, and the lower root of the precision in units of these."""
        std = np.array(error.per_log_std)
        block = self.weighted(error)[np.ix_(layout.per_log, layout.per_log)] * std * std[:, None]
        block[np.diag_indices(std.size)] += 1.0
        return std, np.linalg.cholesky(block)


@dataclass(frozen=True, eq=False)
class SharedEquations:
    """Normal equations of the shared amplitudes from logs without an effect; they add up.

    The per-log amplitudes are integrated out, by the error model that they were formed with.
    """

    products: FloatArray
    """Of the shared columns and the residual, shape (shared + 1, shared + 1) [-]."""
    log_det: float
    """ln det of the error's variances and of the per-log amplitudes' precision over their prior."""
    logs: int

    def __add__(self, other: SharedEquations) -> SharedEquations:
        """Return the equations of the logs of both."""
        log_det = self.log_det + other.log_det
        return SharedEquations(self.products + other.products, log_det, self.logs + other.logs)

    def columns(self, kept: NDArray[np.intp]) -> SharedEquations:
        """Return the equations without some of the shared amplitudes."""
        return replace(self, products=self.products[np.ix_(kept, kept)])


References = Sequence[NormalEquations] | SharedEquations
"""Logs without an effect, each or their sum."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """Log likelihood of all candidate amplitudes, and the shared solution without any effect."""

    hypotheses: Hypotheses
    error: ErrorModel
    gradient: FloatArray
    """g, shape (amplitudes,)."""
    curvature: FloatArray
    """S, shape (amplitudes, amplitudes)."""
    chi_square: float
    """Weighted sum of squares without any effect."""
    mean: FloatArray
    """Solution without any effect: scaled δθ, then ρ; shape (n,)."""
    sensitivity: FloatArray
    """Decrease of that solution per amplitude, shape (n, amplitudes)."""
    precision: FloatArray
    """Of that solution, shape (n, n)."""

    def slice_of(self, k: int) -> slice:
        """Return the amplitudes of candidate k."""
        return slice(int(self.hypotheses.offsets[k]), int(self.hypotheses.offsets[k + 1]))


def normal_equations(
    matrix: DesignMatrix, column_scale: FloatArray, weight: FloatArray | None = None
) -> NormalEquations:
    """Form the products of a log's columns.

    Parameters
    ----------
    matrix : DesignMatrix
        With m rows.
    column_scale : array of shape (p,)
        Divides the coefficient columns.
    weight : array of shape (m,), optional
        Weight of each row: ½ means twice the error, 0 leaves the row out.
    """
    columns = columns_of(matrix, column_scale)
    count_factor = 1.0
    if weight is not None:
        keep = weight > 0.0
        columns = columns[keep] * weight[keep, None]
        count_factor = float(np.mean(weight[keep] ** 2))
    return products_of(haar_transform(columns), count_factor)


def columns_of(matrix: DesignMatrix, column_scale: FloatArray) -> FloatArray:
    """Return the columns of the normal equations, the residual last."""
    coefficients = matrix.coefficients / column_scale
    return np.column_stack(
        [coefficients, *matrix.effects, matrix.per_log_states, matrix.residual_v]
    )


def products_of(scales: Sequence[FloatArray], count_factor: float = 1.0) -> NormalEquations:
    """Return the normal equations of transformed columns (`haar_transform`)."""
    products = np.empty((len(scales), scales[0].shape[1], scales[0].shape[1]))
    for number, each in enumerate(scales):
        np.matmul(each.T, each, out=products[number])
    return NormalEquations(products, count_factor * np.array([float(len(each)) for each in scales]))


class ExchangedColumns:
    """Normal equations of a log with some of its columns exchanged; the others' products stay.

    Parameters
    ----------
    matrix : DesignMatrix
    column_scale : array of shape (p,)
    at : array of int
        Columns that are exchanged.
    """

    def __init__(
        self, matrix: DesignMatrix, column_scale: FloatArray, at: NDArray[np.intp]
    ) -> None:
        self._at = at
        self._scales = haar_transform(columns_of(matrix, column_scale))
        self._given = products_of(self._scales)

    def equations(self, columns: FloatArray) -> NormalEquations:
        """Return the normal equations with other columns, shape (m, columns exchanged)."""
        products, at = self._given.products.copy(), self._at
        for number, (given, new) in enumerate(
            zip(self._scales, haar_transform(columns), strict=True)
        ):
            cross = given.T @ new
            products[number][:, at], products[number][at] = cross, cross.T
            products[number][np.ix_(at, at)] = new.T @ new
        return NormalEquations(products, self._given.counts)


def shared_equations(
    hypotheses: Hypotheses, references: References, error: ErrorModel
) -> SharedEquations:
    """Return the sum of the references' equations of the shared amplitudes."""
    if isinstance(references, SharedEquations):
        return references
    layout = hypotheses.reference_layout
    total, log_det = np.zeros((layout.kept.size, layout.kept.size)), 0.0
    for log in references:
        products, per_log_det = log.marginal(error, layout)
        total += products
        log_det += per_log_det + float(log.counts @ np.log(error.scale_v2))
    return SharedEquations(total, log_det, len(references))


def each_left_out(
    hypotheses: Hypotheses,
    references: Sequence[NormalEquations],
    error: ErrorModel,
    further: SharedEquations | None = None,
) -> Iterator[SharedEquations]:
    """Yield the sum of all references but one, for each in order; of `further` ones in any case.

    The sum before it plus the sum after it: a difference from the sum of all would lose digits.
    """
    each = [shared_equations(hypotheses, [log], error) for log in references]
    none = shared_equations(hypotheses, [], error)
    after = [none if further is None else further]
    for item in reversed(each[1:]):
        after.append(item + after[-1])
    before = none
    for item in each:
        yield before + after.pop()
        before += item


def marginalize(
    hypotheses: Hypotheses,
    references: References,
    diagnosed: Sequence[NormalEquations],
    error: ErrorModel,
) -> Posterior:
    """Integrate out everything but the amplitudes of the candidates.

    Parameters
    ----------
    hypotheses : Hypotheses
    references : sequence of NormalEquations, or SharedEquations
        Logs without the tested effect; a sum of them is by its own error model.
    diagnosed : sequence of NormalEquations
        Logs with it.
    error : ErrorModel
    """
    amplitudes = int(hypotheses.offsets[-1])
    known = shared_equations(hypotheses, references, error)
    precision, right = known.products[:-1, :-1].copy(), known.products[:-1, -1].copy()
    chi_square = float(known.products[-1, -1])
    cross = np.zeros((right.size, amplitudes))
    curvature, gradient = np.zeros((amplitudes, amplitudes)), np.zeros(amplitudes)
    layout = hypotheses.diagnosed_layout
    shared, effects = layout.shared, layout.effects
    for log in diagnosed:
        products, _ = log.marginal(error, layout)
        precision += products[np.ix_(shared, shared)]
        right += products[shared, -1]
        chi_square += float(products[-1, -1])
        cross += products[np.ix_(shared, effects)]
        curvature += products[np.ix_(effects, effects)]
        gradient += products[effects, -1]
    chi_square += _add_priors(precision, right, hypotheses, error)
    if known.logs and diagnosed and hypotheses.structure:
        healthy = marginalize(hypotheses, known, [], error).mean
        chi_square += _hold_structure(precision, right, hypotheses, healthy)
    solved = _solved(precision, np.column_stack([right, cross]) if diagnosed else right[:, None])
    mean, sensitivity = solved[:, 0], solved[:, 1:] if diagnosed else cross
    return Posterior(
        hypotheses=hypotheses,
        error=error,
        gradient=gradient - cross.T @ mean,
        curvature=curvature - cross.T @ sensitivity,
        chi_square=chi_square - float(right @ mean),
        mean=mean,
        sensitivity=sensitivity,
        precision=precision,
    )


def _solved(precision: FloatArray, right: FloatArray) -> FloatArray:
    """Return the solution of positive equations, balanced by their diagonal."""
    balance = 1.0 / np.sqrt(np.diag(precision))
    factor = cho_factor(precision * balance * balance[:, None], check_finite=False)
    return np.asarray(
        balance[:, None] * cho_solve(factor, balance[:, None] * right, check_finite=False)
    )


def inverse(precision: FloatArray) -> FloatArray:
    """Return the inverse of a positive matrix, balanced by its diagonal."""
    balance = 1.0 / np.sqrt(np.diag(precision))
    balanced = np.linalg.inv(precision * balance * balance[:, None])
    return np.asarray(balanced * balance * balance[:, None])


def log_likelihood(hypotheses: Hypotheses, references: References, error: ErrorModel) -> float:
    """Return the log marginal likelihood of the references, up to a constant."""
    known = shared_equations(hypotheses, references, error)
    precision, right = known.products[:-1, :-1].copy(), known.products[:-1, -1].copy()
    squares, log_det = float(known.products[-1, -1]), known.log_det
    squares += _add_priors(precision, right, hypotheses, error)
    log_det -= float(np.sum(np.log(structure_precision(hypotheses, error))))
    return log_gaussian_integral(precision, right) - 0.5 * (squares + log_det)


def _add_priors(
    precision: FloatArray, right: FloatArray, hypotheses: Hypotheses, error: ErrorModel
) -> float:
    """Add the priors in place; return the square of their mean."""
    square = 0.0
    p = hypotheses.column_scale.size
    block = precision[:p, :p]
    if hypotheses.prior_root is not None:
        information = prior_information(hypotheses, error)
        block += information
        if hypotheses.prior_mean is not None:
            right[:p] += information @ hypotheses.prior_mean
            square = float(hypotheses.prior_mean @ information @ hypotheses.prior_mean)
    block[np.diag_indices(p)] += JITTER * np.trace(block) / p
    structure = structure_precision(hypotheses, error)
    at = p + np.arange(structure.size)
    precision[at, at] += structure
    return square


def structure_precision(hypotheses: Hypotheses, error: ErrorModel) -> FloatArray:
    """Return the prior precision of each structure amplitude, shape (amplitudes,)."""
    names, precision = hypotheses.structure_prior
    scales = np.array([error.structure.get(name, 1.0) for name in names])
    return np.asarray(precision / scales**2)


def prior_information(hypotheses: Hypotheses, error: ErrorModel) -> FloatArray:
    """Return the model file's precision of the scaled coefficients, shape (p, p)."""
    root = hypotheses.prior_root
    if root is None:
        return np.zeros((hypotheses.column_scale.size, hypotheses.column_scale.size))
    return np.asarray(error.information_weight * root.T @ root / error.lasting_v2)


def _hold_structure(
    precision: FloatArray, right: FloatArray, hypotheses: Hypotheses, healthy: FloatArray
) -> float:
    """Hold the structure near the references' solution, in place; return the square of its mean."""
    bounds = hypotheses.bounds_of(hypotheses.structure)
    at = hypotheses.column_scale.size + np.arange(bounds.shape[0])
    held = (STRUCTURE_STD * (bounds[:, 1] - bounds[:, 0])) ** -2.0
    precision[at, at] += held
    right[at] += held * healthy[at]
    return float(np.sum(held * healthy[at] ** 2))


def log_gaussian_integral(precision: FloatArray, right: FloatArray) -> float:
    """Return ln ∫ exp(right·x − ½ x·precision·x) dx without the powers of 2π.

    Parameters
    ----------
    precision : array of shape (n, n)
        Positive definite.
    right : array of shape (n,)
    """
    balance = 1.0 / np.sqrt(np.diag(precision))
    root = np.linalg.cholesky(precision * balance * balance[:, None])
    gained = solve_triangular(root, balance * right, lower=True, check_finite=False)
    volume = np.sum(np.log(np.diag(root))) - np.sum(np.log(balance))
    return float(0.5 * gained @ gained - volume)


def constrained_mode(
    posterior: Posterior, model: VoltageModel, chosen: Sequence[int]
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the most probable coefficients, structure and amplitudes within physical bounds.

    One convex problem: the pseudo-OCV rises over the identified SoC, and structure and effects keep
    their bounds, to which the other parameters adapt.

    Parameters
    ----------
    posterior : Posterior
    model : VoltageModel
        Model that the design matrices were linearised about.
    chosen : sequence of int
        Candidates to include.

    Returns
    -------
    solution : array
        δθ [V, V/K, Ω], then the amplitudes of the structure.
    amplitudes : list of arrays
        Of each chosen candidate, relative to the neutral values.
    """
    hypotheses = posterior.hypotheses
    p, n = hypotheses.column_scale.size, len(BASIS_NAMES)
    at = hypotheses.amplitudes_of(chosen)
    bounds = hypotheses.bounds_of(chosen)
    limits = np.vstack([hypotheses.bounds_of(hypotheses.structure), bounds])
    first, size = posterior.precision.shape[0], posterior.precision.shape[0] + at.size
    curvature = posterior.curvature[np.ix_(at, at)] + prior_precision(bounds)
    upper = _root(posterior.precision)
    root, target = np.zeros((size, size)), np.zeros(size)
    root[:first, :first] = upper
    root[:first, first:] = upper @ posterior.sensitivity[:, at]
    target[:first] = upper @ posterior.mean
    if at.size:
        lower = _root(curvature)
        root[first:, first:] = lower
        target[first:] = lower @ np.linalg.solve(curvature, posterior.gradient[at])
    slopes = ocv_basis_slope(np.linspace(*model.soc_range_pct, SLOPE_CHECKS), model.epsilon)
    rising = np.zeros((SLOPE_CHECKS, size))
    rising[:, :n] = slopes / hypotheses.column_scale[:n]
    required = SLOPE_AT_LEAST * model.pseudo_ocv_at(50.0)[0] - slopes @ np.array(model.ocv_v)
    structure = p + np.arange(limits.shape[0] - at.size)
    bounded = np.concatenate((structure, first + np.arange(at.size)))
    selected = np.zeros((bounded.size, size))
    selected[np.arange(bounded.size), bounded] = 1.0
    found = nearest_rising(
        root,
        target,
        np.vstack([rising, selected, -selected]),
        np.concatenate((required, limits[:, 0], -limits[:, 1])),
    )
    solution = found[: p + structure.size].copy()
    solution[:p] /= hypotheses.column_scale
    widths = [len(hypotheses.candidates[k].amplitudes) for k in chosen]
    return solution, np.split(found[first:], np.cumsum(widths)[:-1]) if widths else []


def _root(matrix: FloatArray) -> FloatArray:
    """Return the upper root R of a positive matrix, RᵀR, balanced by its diagonal."""
    scale = np.sqrt(np.diag(matrix))
    return np.asarray(np.linalg.cholesky(matrix / scale / scale[:, None]).T * scale)


def with_change(model: VoltageModel, change: FloatArray) -> VoltageModel | None:
    """Return the model with changed coefficients; None if its pseudo-OCV would not rise."""
    try:
        return model.with_coefficients(model.coefficients + change)
    except InputError:
        return None
