"""The extended model: the given model, the references' structure, and the accepted causes.

A verdict linearises the voltage about no effect. A skew of seconds or a fifth of the capacity is
far from that point, so the accepted causes are fitted through the model's own equations, with
residual and tangents at the current values (Gauss–Newton) and everything else marginalised as for
the verdict.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import least_squares

from cangauge._typing import FloatArray
from cangauge._version import __version__
from cangauge.diagnosis.bayes_factors import Score
from cangauge.diagnosis.design_matrix import DesignMatrix
from cangauge.diagnosis.hypotheses import prior_precision
from cangauge.diagnosis.linear_gaussian import (
    ExchangedColumns,
    NormalEquations,
    columns_of,
    constrained_mode,
    marginalize,
    products_of,
    with_change,
)
from cangauge.diagnosis.problem import DiagnosisProblem
from cangauge.diagnosis.structure import select_structure, with_structure
from cangauge.inference.linearized import pack_state, residual, with_modelled_voltage
from cangauge.inference.time_scales import haar_transform
from cangauge.model.effects.base import BOUND_MARGIN, Effect, Pack, PackState, Values
from cangauge.model.effects.library import STEP, Candidate, effect_entries, shape_key
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Made, Model, Ranges

LOG_EFFECTS = frozenset({"initial_soc"})
"""Effects of one log, which a model for later drives does not keep."""

GAUSS_NEWTON_ROUNDS = 3

TANGENT_STD = 0.05
"""Relative uncertainty of a tangent, which is the model's and not the pack's. On development cases
with much evidence amplitudes were off by 1 to 15 % where noise alone would leave 0.3 %."""

SOC_BANDS = 6
"""Bands of the jackknife over SoC, with as many rows each."""

MIN_BAND_ROWS = 30
"""Rows that a log needs in a band; fewer, which have no slow scale, are always left out."""

ONSETS = 100
"""Times of onset tried over the longest log, then between the neighbours of the best."""

MIN_ONSET_PART = 0.02
"""Least part of the squares of a change's column, with the coefficients projected out, relative to
that of a change at the start of the log. With less, hardly any rows lie before or after the change:
it is a wrong row."""


@dataclass(frozen=True, eq=False)
class Extension:
    """Extended model and its causes."""

    model: ExtendedModel
    remarks: tuple[str, ...]
    """Sentences on what could not be carried over."""
    cause: dict[str, dict[str, float]] = field(default_factory=dict)
    """Parameters of each accepted effect."""
    std: dict[str, dict[str, float]] = field(default_factory=dict)
    """Standard deviations of their amplitudes."""


@dataclass(frozen=True, eq=False)
class Cause:
    """Accepted effect with its parameters."""

    number: int
    """Candidate whose columns are its tangents."""
    candidate: Candidate
    values: Values

    @property
    def amplitude(self) -> FloatArray:
        """Amplitudes relative to neutral, shape (k,)."""
        values = np.array([self.values[name] for name in self.candidate.amplitudes])
        return values - self.candidate.neutral

    def with_amplitude(self, amplitude: FloatArray) -> Cause:
        """Return the cause with other amplitudes relative to neutral, clipped to the bounds."""
        low, high = self.candidate.bounds[:, 0], self.candidate.bounds[:, 1]
        total = self.candidate.neutral + np.clip(amplitude, low, high)
        named = dict(zip(self.candidate.amplitudes, total.tolist(), strict=True))
        return replace(self, values={**self.values, **named})


def extend(problem: DiagnosisProblem, accepted: Sequence[Score]) -> Extension:
    """Return the extended model with the accepted effects refined.

    Parameters
    ----------
    problem : DiagnosisProblem
    accepted : sequence of Score
        Of the verdict; without any, the model has the references' coefficients and structure only.
    """
    pieces = select_structure(problem.hypotheses, problem.reference_equations, problem.error)
    reduced = _with_structure_of(problem, pieces)
    logs = problem.diagnosed_equations
    if not accepted:
        return Extension(*_healthy_model(reduced, logs))
    # All structure is marginalised here, not only what the extended model has.
    causes, covariance, explained = _refine_amplitudes(
        problem, _initial_causes(reduced, logs, accepted)
    )
    logs = explained.diagnosed_equations
    base, remarks = _healthy_model(_with_structure_of(explained, pieces), logs)
    # Bounds depend on the pack, which has changed with the coefficients.
    causes = [
        replace(cause, values=cause.candidate.effect.clipped(cause.values, base.pack))
        for cause in causes
    ]
    std = iter(np.sqrt(np.diag(covariance)).tolist())
    return Extension(
        _with_causes(base, causes),
        remarks,
        {cause.candidate.effect.id: dict(cause.values) for cause in causes},
        {
            cause.candidate.effect.id: {name: next(std) for name in cause.candidate.amplitudes}
            for cause in causes
        },
    )


def _with_structure_of(problem: DiagnosisProblem, structure: tuple[int, ...]) -> DiagnosisProblem:
    """Return the problem with no more structure than the references need.

    Judged by the error expected of the diagnosed logs: beyond the references' temperatures that is
    large, and few pieces are worth it. (On winter trips, all the structure of summer trips made the
    voltage better and the SoC worse.)
    """
    before = problem.hypotheses
    hypotheses = replace(before, structure=structure)
    return replace(
        problem,
        hypotheses=hypotheses,
        reference_equations=problem.reference_equations.columns(
            before.shared_amplitudes(structure)
        ),
    )


def _healthy_model(
    problem: DiagnosisProblem, logs: Sequence[NormalEquations]
) -> tuple[ExtendedModel, tuple[str, ...]]:
    """Return the model with coefficients and structure for logs without a cause, and remarks."""
    posterior = marginalize(problem.hypotheses, problem.reference_equations, logs, problem.error)
    solution, _ = constrained_mode(posterior, problem.model.model, [])
    return _with_solution(problem, solution)


def _with_solution(
    problem: DiagnosisProblem, solution: FloatArray
) -> tuple[ExtendedModel, tuple[str, ...]]:
    """Return the model with a solution's coefficients and structure, and remarks."""
    p = problem.hypotheses.column_scale.size
    remarks: tuple[str, ...] = ()
    voltage_model = with_change(problem.model.model, solution[:p])
    if voltage_model is None:
        voltage_model = problem.model.model
        remarks = ("coefficients unchanged: otherwise the pseudo-OCV would not rise everywhere",)
    model = replace(problem.model, model=voltage_model)
    return with_structure(model, problem.hypotheses, solution[p:]), remarks


def _with_causes(model: ExtendedModel, causes: Sequence[Cause]) -> ExtendedModel:
    for cause in causes:
        model = model.with_effect(cause.candidate.effect, cause.values)
    return model


def _initial_causes(
    problem: DiagnosisProblem, logs: Sequence[NormalEquations], accepted: Sequence[Score]
) -> list[Cause]:
    """Return the causes of the linear solution, with amplitudes and shapes fitted from there."""
    posterior = marginalize(problem.hypotheses, problem.reference_equations, logs, problem.error)
    chosen = [k for score in accepted for k in score.candidates]
    solution, amplitudes = constrained_mode(posterior, problem.model.model, chosen)
    model, _ = _with_solution(problem, solution)
    rest = iter(amplitudes)
    causes = []
    for score in accepted:
        candidates = [problem.hypotheses.candidates[k] for k in score.candidates]
        start = _mixture(candidates, [next(rest) for _ in candidates])
        effect = candidates[0].effect
        # Search for the onset with the references' model too: the linear solution may have
        # attributed a late change to a resistance.
        found = [
            _with_change_point(problem.diagnosed, base, effect, start)
            for base in (model, problem.structured or problem.model)
        ]
        starts = [values for k, values in enumerate(found) if values not in found[:k]]
        refined = [_refine_parameters(problem, model, effect, values) for values in starts]
        trials = [Cause(score.candidates[0], candidates[0], values) for _, values in refined]
        best = 0
        if len(trials) > 1:
            best = int(np.argmin([_chi_square(problem, [trial]) for trial in trials]))
        model = refined[best][0]
        causes.append(trials[best])
    return causes


def _mixture(candidates: Sequence[Candidate], amplitudes: Sequence[FloatArray]) -> dict[str, float]:
    """Return one effect for a mixture of shapes: sum of amplitudes, weighted mean of shapes."""
    total = np.sum(amplitudes, axis=0)
    weights = np.array([float(np.sum(np.abs(each))) for each in amplitudes])
    weights = weights / weights.sum() if weights.sum() > 0.0 else np.full(weights.size, 0.5)
    values = candidates[0].values(total)
    for name in candidates[0].shape:
        values[name] = float(weights @ np.array([each.shape[name] for each in candidates]))
    return values


def _with_change_point(
    logs: Sequence[DesignMatrix], model: ExtendedModel, effect: Effect, start: Values
) -> dict[str, float]:
    """Return an effect's values with the onsets that leave the least squares of the voltage.

    Grid search, since the voltage jumps at the onset and has no gradient there. The sizes of the
    amplitudes do not matter, only their proportions.
    """
    values = dict(start)
    for parameter in effect.shapes:
        if parameter.is_change_point:
            values[parameter.name] = _best_onset(logs, model, effect, values, parameter.name)
    return values


def _best_onset(
    logs: Sequence[DesignMatrix], model: ExtendedModel, effect: Effect, values: Values, name: str
) -> float:
    """Return the onset [s] that explains most, common to all logs."""
    states = [pack_state(matrix.sampled, model) for matrix in logs]
    # A part that coefficients or per-log states also explain is no evidence of a change.
    known = [np.linalg.qr(np.column_stack([m.coefficients, m.per_log_states]))[0] for m in logs]

    def unexplained(volts: Sequence[FloatArray]) -> FloatArray:
        parts = [each - basis @ (basis.T @ each) for basis, each in zip(known, volts, strict=True)]
        return np.concatenate(parts)

    def columns_of(onset_s: float) -> list[FloatArray]:
        trial = {**values, name: onset_s}
        return [_extra_v(effect, state, trial, model) for state in states]

    residual_v = unexplained([residual(matrix.sampled, model) for matrix in logs])
    least_v2 = MIN_ONSET_PART * float(np.sum(np.concatenate(columns_of(0.0)) ** 2))

    def explained_v2(onset_s: float) -> float:
        column = unexplained(columns_of(onset_s))
        square = float(column @ column)
        return float(column @ residual_v) ** 2 / square if square > least_v2 else 0.0

    longest_s = max(float(np.ptp(matrix.sampled.log.time_s)) for matrix in logs)
    step_s = longest_s / ONSETS
    tried = [values[name], *np.arange(ONSETS) * step_s]
    best = float(max(tried, key=explained_v2))
    tried = [best, *np.linspace(max(best - step_s, 0.0), best + step_s, ONSETS)]
    return float(max(tried, key=explained_v2))


def _extra_v(effect: Effect, state: PackState, values: Values, model: ExtendedModel) -> FloatArray:
    """Return the voltage that an effect adds on the rows of a state [V]."""
    extra_v = effect.extra_voltage_at(state, values, model.model, model.pack)
    return np.zeros_like(state.time_s) if extra_v is None else extra_v


def _refine_parameters(
    problem: DiagnosisProblem, model: ExtendedModel, effect: Effect, start: Values
) -> tuple[ExtendedModel, dict[str, float]]:
    """Return model and parameters fitted through the model's own equations."""
    free = (*effect.amplitudes, *(shape for shape in effect.shapes if not shape.is_change_point))
    parameters = free or effect.parameters
    constants = {p.name: start[p.name] for p in effect.parameters if p not in parameters}
    pack = problem.model.pack  # in `model`, structure represents much of the resistance
    bounds = np.array([parameter.bounds(pack) for parameter in parameters])
    neutral = effect.neutral(pack)
    centre = np.array([neutral[parameter.name] for parameter in parameters])
    scale = bounds[:, 1] - bounds[:, 0]
    low, high = (bounds[:, 0] - centre) / scale, (bounds[:, 1] - centre) / scale
    is_amplitude = np.array([parameter in effect.amplitudes for parameter in parameters])
    prior = 4.0 * np.sqrt(problem.error.lasting_v2) * is_amplitude

    def values_of(unit: FloatArray) -> dict[str, float]:
        values = (centre + unit * scale).tolist()
        return {p.name: value for p, value in zip(parameters, values, strict=True)} | constants

    logs = [matrix.sampled for matrix in problem.diagnosed]

    base_v = [residual(log, model) for log in logs]
    states = [pack_state(log, model) for log in logs]

    def errors(unit: FloatArray) -> FloatArray:
        trial = values_of(unit)
        if effect.adds_voltage_only:
            volts = [
                before_v - _extra_v(effect, state, trial, model)
                for before_v, state in zip(base_v, states, strict=True)
            ]
        else:
            volts = [residual(log, model.with_effect(effect, trial)) for log in logs]
        return np.concatenate([*volts, prior * unit])

    begin = (np.array([start[parameter.name] for parameter in parameters]) - centre) / scale
    begin = np.clip(begin, low + 1e-9, high - 1e-9)
    # Finite differences are relative to the value, so values are shifted away from 0.
    away = 1.0 - low
    found = least_squares(
        lambda shifted: errors(shifted - away),
        begin + away,
        bounds=(low + away, high + away),
        diff_step=1e-3,
        max_nfev=12,
    )
    values = values_of(found.x - away)
    return model.with_effect(effect, values), values


def _refine_amplitudes(
    problem: DiagnosisProblem, causes: Sequence[Cause]
) -> tuple[list[Cause], FloatArray, DiagnosisProblem]:
    """Find the most probable amplitudes of the causes by Gauss–Newton.

    Returns
    -------
    causes : list of Cause
    covariance : array
        Of all amplitudes, in order. Variances are the larger of two: noise and tangents together,
        or the jackknife over SoC.
    explained : DiagnosisProblem
        The problem with the causes removed from the residuals.
    """
    hypotheses, error = problem.hypotheses, problem.error
    numbers = [cause.number for cause in causes]
    at = hypotheses.amplitudes_of(numbers)
    prior = prior_precision(hypotheses.bounds_of(numbers))
    widths = [len(cause.candidate.amplitudes) for cause in causes]
    overdispersion = np.repeat(
        [error.overdispersion_of(cause.candidate.effect.id) for cause in causes], widths
    )
    factor = 1.0 / np.sqrt(overdispersion)

    def step_of(
        logs: Sequence[NormalEquations], amplitude: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the Gauss–Newton step from an amplitude, and the precision at its end."""
        posterior = marginalize(hypotheses, problem.reference_equations, logs, error)
        total = posterior.curvature[np.ix_(at, at)] * factor * factor[:, None] + prior
        gradient = posterior.gradient[at] / overdispersion - prior @ amplitude
        return np.linalg.solve(total, gradient), total

    layout = hypotheses.diagnosed_layout
    moving = np.append(layout.effects[at], layout.residual)
    others = [
        ExchangedColumns(matrix, hypotheses.column_scale, moving) for matrix in problem.diagnosed
    ]
    found = list(causes)
    for _ in range(GAUSS_NEWTON_ROUNDS):
        matrices = [_at_causes(matrix, problem, found) for matrix in problem.diagnosed]
        amplitude = np.concatenate([cause.amplitude for cause in found])
        logs = [
            log.equations(
                np.column_stack([*(matrix.effects[k] for k in numbers), matrix.residual_v])
            ).inflated(problem.noise_scale(matrix))
            for log, matrix in zip(others, matrices, strict=True)
        ]
        step, total = step_of(logs, amplitude)
        parts = np.split(amplitude + step, np.cumsum(widths)[:-1])
        found = [cause.with_amplitude(part) for cause, part in zip(found, parts, strict=True)]
    jackknife = _jackknife_variance(
        problem, matrices, at.size, lambda logs: step_of(logs, amplitude)[0]
    )
    tangents = TANGENT_STD * np.concatenate([cause.amplitude for cause in found])
    covariance = np.asarray(np.linalg.inv(total) + np.diag(tangents**2))
    covariance += np.diag(np.maximum(jackknife - np.diag(covariance), 0.0))
    without = [_at_causes(m, problem, found, tangents=False) for m in problem.diagnosed]
    return found, covariance, replace(problem, diagnosed=tuple(without))


def _jackknife_variance(
    problem: DiagnosisProblem,
    matrices: Sequence[DesignMatrix],
    size: int,
    amplitudes: Callable[[Sequence[NormalEquations]], FloatArray],
) -> FloatArray:
    """Return the variance of amplitudes by leaving out one band of SoC after another, shape (k,).

    A model's slope over SoC is least certain near empty, where a cause of the charge shows most:
    its size is then wrong by the slope, which noise does not reveal. (Grouped jackknife: Efron, The
    Jackknife, the Bootstrap and Other Resampling Plans, 1982, ch. 3.)
    """
    soc_pct = np.concatenate([matrix.sampled.rows.soc_pct for matrix in matrices])
    edges = np.quantile(soc_pct, np.linspace(0.0, 1.0, SOC_BANDS + 1)[1:-1])
    by_band: list[dict[int, NormalEquations]] = []
    for matrix in matrices:
        band = np.searchsorted(edges, matrix.sampled.rows.soc_pct)
        columns = columns_of(matrix, problem.hypotheses.column_scale)
        factor = problem.noise_scale(matrix)
        by_band.append(
            {
                number: products_of(haar_transform(columns[band == number])).inflated(factor)
                for number in range(SOC_BANDS)
                if np.count_nonzero(band == number) >= MIN_BAND_ROWS
            }
        )
    found = []
    for left_out in range(SOC_BANDS):
        rest = [[part for k, part in each.items() if k != left_out] for each in by_band]
        if any(rest):
            found.append(
                amplitudes(
                    [
                        NormalEquations(
                            np.sum([part.products for part in parts], axis=0),
                            np.sum([part.counts for part in parts], axis=0),
                        )
                        for parts in rest
                        if parts
                    ]
                )
            )
    if len(found) < 2:
        return np.zeros(size)
    deviation = np.array(found) - np.mean(found, axis=0)
    return np.asarray((len(found) - 1) / len(found) * np.sum(deviation**2, axis=0))


def _chi_square(problem: DiagnosisProblem, causes: Sequence[Cause]) -> float:
    """Return the weighted squares that remain with some causes."""
    logs = [
        problem.equations_of(_at_causes(matrix, problem, causes, tangents=False))
        for matrix in problem.diagnosed
    ]
    references = problem.reference_equations
    return marginalize(problem.hypotheses, references, logs, problem.error).chi_square


def _at_causes(
    matrix: DesignMatrix,
    problem: DiagnosisProblem,
    causes: Sequence[Cause],
    *,
    tangents: bool = True,
) -> DesignMatrix:
    """Return a design matrix with the causes in its residual, and their tangents there."""
    sampled, base = matrix.sampled, problem.structured or problem.model
    with_all = _with_causes(base, causes)
    change_v = residual(sampled, with_all) - residual(sampled, base)
    effects = list(matrix.effects)
    if tangents:
        smooth = with_modelled_voltage(sampled, with_all)
        here = residual(smooth, with_all)
        for number, cause in enumerate(causes):
            columns = np.empty_like(effects[cause.number])
            for k, width in enumerate(np.diff(cause.candidate.bounds)[:, 0]):
                step = np.zeros(columns.shape[1])
                step[k] = STEP * width
                if cause.amplitude[k] + step[k] > cause.candidate.bounds[k, 1]:
                    step[k] = -step[k]
                moved = [*causes]
                moved[number] = cause.with_amplitude(cause.amplitude + step)
                there = residual(smooth, _with_causes(base, moved))
                columns[:, k] = (here - there) / step[k]
            effects[cause.number] = columns
    return replace(matrix, residual_v=matrix.residual_v + change_v, effects=tuple(effects))


def extended_model_file(extension: Extension, given: Model, rmse_v: float) -> Model:
    """Return the extended model as a model file for estimator and service.

    Parameters
    ----------
    extension : Extension
    given : Model
        Diagnosed model.
    rmse_v : float
        RMS error on held-out rows, to which the noise is scaled [V].
    """
    model = extension.model
    coefficients = {
        name: given.coefficients[name].model_copy(update={"value": value, "std_error": None})
        for name, value in zip(
            given.coefficient_names, model.model.coefficients.tolist(), strict=True
        )
    }
    noise = given.noise
    ratio = rmse_v / noise.voltage_rmse_v if noise.voltage_rmse_v > 0.0 else 1.0
    scaled = noise.model_copy(
        update={
            "fast_std_v": ratio * noise.fast_std_v,
            "slow_std_v": ratio * noise.slow_std_v,
            "lasting_std_v": ratio * noise.lasting_std_v,
            "voltage_rmse_v": rmse_v,
            "voltage_mae_pct": ratio * noise.voltage_mae_pct,
            "judged_on": "logs left out by `cangauge gap`",
        }
    )
    # A step in the past remains; online, time counts from the service's first sample.
    kept = [
        (effect, {**values, "start_s": 0.0} if effect.id == "resistance_step" else values)
        for effect, values in model.effects
        if effect.id not in LOG_EFFECTS
    ]
    made = Made(
        by=f"cangauge {__version__} gap",
        options=given.made.options,
        logs=given.made.logs,
        fingerprint=given.made.fingerprint,
    )
    return given.model_copy(
        update={
            "name": f"{given.name}, extended",
            "coefficients": coefficients,
            "range": Ranges(
                soc_pct=model.model.soc_range_pct,
                temperature_c=model.model.temperature_range_c,
                current_a=model.model.current_range_a,
            ),
            "effects": effect_entries(_merged(kept, model.pack)),
            "noise": scaled,
            "information": None,
            "made": made,
        }
    )


def _merged(effects: Sequence[tuple[Effect, Values]], pack: Pack) -> list[tuple[Effect, Values]]:
    """Return the effects with those of one kind and shape added up, within bounds."""
    merged: dict[tuple[object, ...], tuple[Effect, dict[str, float]]] = {}
    for effect, values in effects:
        key = shape_key(effect, values)
        if key not in merged:
            merged[key] = (effect, dict(values))
            continue
        neutral = effect.neutral(pack)
        _, total = merged[key]
        for parameter in effect.amplitudes:
            total[parameter.name] += values[parameter.name] - neutral[parameter.name]
        merged[key] = (effect, effect.clipped(total, pack))
    return list(merged.values())


def parameters_of(
    score: Score, problem: DiagnosisProblem, extension: Extension
) -> dict[str, dict[str, object]]:
    """Return value, 95 % interval and unit of each parameter of an effect.

    Parameters
    ----------
    score : Score
    problem : DiagnosisProblem
    extension : Extension
        Refined values are used for the causes in it, the linear solution for other effects.
    """
    candidates = [problem.hypotheses.candidates[k] for k in score.candidates]
    first, size = candidates[0], len(candidates[0].amplitudes)
    if score.effect_id in extension.cause:
        values: Values = extension.cause[score.effect_id]
        std = extension.std[score.effect_id]
    else:
        values = _mixture(candidates, np.split(score.amplitude, len(candidates)))
        std = {}
        for k, name in enumerate(first.amplitudes):
            of_name = np.arange(k, score.amplitude.size, size)
            std[name] = float(np.sqrt(np.sum(score.covariance[np.ix_(of_name, of_name)])))
    by_name = {parameter.name: parameter for parameter in first.effect.parameters}
    result: dict[str, dict[str, object]] = {}
    for name in first.amplitudes:
        # Bounds relative to the model are not exact, so the interval may exceed them a little.
        low, high = by_name[name].bounds(problem.model.pack, BOUND_MARGIN)
        half = 1.96 * std[name]
        interval = [max(values[name] - half, low), min(values[name] + half, high)]
        result[name] = {"value": values[name], "ci": interval, "unit": by_name[name].unit}
    for name in first.shape:
        result[name] = {"value": values[name], "ci": None, "unit": by_name[name].unit}
    return result
