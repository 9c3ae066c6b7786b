"""The moment at which a cause begins: found by trying, since the voltage jumps there.

A slope by the moment is nothing but the jump, so no descent finds it. All logs are tried with the
same moment, as the extended model has it, each moment with the amplitude that suits it best.

How much amplitudes depend on where the pack was charged.

A model's slope over SoC is least known where the curve bends, near empty, and a cause of the charge
is seen best there: chance alone says that its size is known well, and it is wrong by the slope.
What is found without one band of SoC after the other says how far it may be wrong (a jackknife that
leaves out groups: Efron, The Jackknife, the Bootstrap and Other Resampling Plans, 1982, ch. 3).

The amplitudes of accepted causes, found where the causes are and not where there is none.

A verdict takes the voltage's change by a small amplitude. A skew of seconds or a fifth of the
capacity is no small one, so residual and tangents are taken again at the values found, with
everything else integrated out as for the verdict (Gauss–Newton), until the values stay.

The extended model: the given model, what the references add to it, and the accepted effects.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import least_squares

from cangauge import __version__
from cangauge._typing import FloatArray
from cangauge.diagnosis.bayes_factors import Score
from cangauge.diagnosis.design_matrix import DesignMatrix
from cangauge.diagnosis.linear_gaussian import (
    Gram,
    gather,
    gram_of,
    moved,
    prior_precision,
    within_bounds,
)
from cangauge.diagnosis.problem import DiagnosisProblem
from cangauge.diagnosis.references import needed, with_pieces
from cangauge.inference.linearized import pack_state, residual, with_modelled_voltage
from cangauge.model.effects.base import BOUND_MARGIN, Effect, Pack, Values
from cangauge.model.effects.library import LIBRARY, STEP, Candidate, effect_entries, shape_key
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Made, Model, Ranges

# --- The moment at which a cause begins: found by trying, since the voltage jumps there

TRIED = 100
"""Moments that are tried, spread over the longest log; then as many between the best one's
neighbours."""

LEAST_PART = 0.02
"""A jump that leaves less than this part of its column's square beside what is known, if it were
there all along, has next to no rows before or after it: it is a row that is wrong, not a jump."""


def at_moment(
    logs: Sequence[DesignMatrix], model: ExtendedModel, effect: Effect, start: Values
) -> dict[str, float]:
    """Return the values with the moments that leave the least mean square of the logs' voltage.

    Parameters
    ----------
    logs : sequence of DesignMatrix
    model : ExtendedModel
        Without the effect.
    effect : Effect
        One that has no moment keeps its values.
    start : mapping
        Its values; the amplitudes' sizes do not matter, their proportions do.
    """
    values = dict(start)
    for parameter in effect.shapes:
        if parameter.is_change_point:
            values[parameter.name] = _best(logs, model, effect, values, parameter.name)
    return values


def _best(
    logs: Sequence[DesignMatrix], model: ExtendedModel, effect: Effect, values: Values, name: str
) -> float:
    states = [pack_state(terms.prepared, model) for terms in logs]
    # What the coefficients or a log's own level explain as well is no jump.
    known = [np.linalg.qr(np.column_stack([terms.baseline, terms.own]))[0] for terms in logs]
    left_v = np.concatenate(
        [
            _beside(basis, residual(terms.prepared, model))
            for basis, terms in zip(known, logs, strict=True)
        ]
    )

    def columns_of(moment_s: float) -> list[FloatArray]:
        trial = {**values, name: moment_s}
        columns = []
        for terms, state in zip(logs, states, strict=True):
            extra_v = effect.extra_voltage(state, trial, model.model, model.pack)
            rows = terms.prepared.at
            columns.append(np.zeros(rows.size) if extra_v is None else extra_v[rows])
        return columns

    least_v2 = LEAST_PART * float(np.sum(np.concatenate(columns_of(0.0)) ** 2))

    def taken_v2(moment_s: float) -> float:
        beside = [_beside(*pair) for pair in zip(known, columns_of(moment_s), strict=True)]
        column = np.concatenate(beside)
        square = float(column @ column)
        return float(column @ left_v) ** 2 / square if square > least_v2 else 0.0

    longest_s = max(float(np.ptp(terms.prepared.log.time_s)) for terms in logs)
    apart_s = longest_s / TRIED
    tried = [values[name], *np.arange(TRIED) * apart_s]
    best = float(max(tried, key=taken_v2))
    tried = [best, *np.linspace(max(best - apart_s, 0.0), best + apart_s, TRIED)]
    return float(max(tried, key=taken_v2))


def _beside(basis: FloatArray, volts: FloatArray) -> FloatArray:
    """Return what orthonormal columns do not explain."""
    return np.asarray(volts - basis @ (basis.T @ volts))


# --- How much amplitudes depend on where the pack was charged

BANDS = 6
"""Bands of SoC, with as many rows each."""

LEAST_ROWS = 30
"""Fewer rows of a log in a band are left out with no band, having no slow scale of their own."""


def variance_by_charge(
    logs: Sequence[DesignMatrix],
    scale: FloatArray,
    factors: Sequence[float],
    amplitudes: Callable[[Sequence[Gram]], FloatArray],
) -> FloatArray:
    """Return the variance of amplitudes that differ with the band of SoC that is left out.

    Parameters
    ----------
    logs : sequence of DesignMatrix
    scale : array of shape (p,)
        Of the baseline's columns.
    factors : sequence of float
        By how much larger each log's error is, as variance (`Gram.weakened`).
    amplitudes : callable
        Returns amplitudes, shape (k,), from the products of the logs.

    Returns
    -------
    array of shape (k,)
    """
    soc_pct = np.concatenate([terms.prepared.rows.soc_pct for terms in logs])
    edges = np.quantile(soc_pct, np.linspace(0.0, 1.0, BANDS + 1)[1:-1])
    of_logs = []
    for terms, factor in zip(logs, factors, strict=True):
        band = np.searchsorted(edges, terms.prepared.rows.soc_pct)
        of_logs.append(
            {
                number: gram_of(terms.at(band == number), scale).weakened(factor)
                for number in range(BANDS)
                if np.count_nonzero(band == number) >= LEAST_ROWS
            }
        )
    found = []
    for left_out in range(BANDS):
        rest = [[gram for k, gram in each.items() if k != left_out] for each in of_logs]
        if any(rest):
            found.append(amplitudes([_sum(grams) for grams in rest if grams]))
    if len(found) < 2:
        return np.zeros(0 if not found else found[0].size)
    differ = np.array(found) - np.mean(found, axis=0)
    return np.asarray((len(found) - 1) / len(found) * np.sum(differ**2, axis=0))


def _sum(grams: Sequence[Gram]) -> Gram:
    """Return the products of parts of one log, whose own terms they share."""
    return Gram(
        np.sum([gram.products for gram in grams], axis=0),
        np.sum([gram.counts for gram in grams], axis=0),
    )


# --- The amplitudes of accepted causes, found where the causes are and not where there is none

ROUNDS = 3

TANGENT_STD = 0.05
"""How well a tangent is known, as a part of it: it is the model's, and the plant is another. On
development cases of large evidence amplitudes were off by 1 to 15 % where chance left 0.3 %."""


@dataclass(frozen=True, eq=False)
class Cause:
    """An accepted effect."""

    candidate: int
    """Which of the frame's candidates its tangents stand for."""
    choice: Candidate
    values: Values

    @property
    def amplitude(self) -> FloatArray:
        """Amplitudes beside the neutral ones, shape (k,)."""
        return (
            np.array([self.values[name] for name in self.choice.amplitudes]) - self.choice.neutral
        )

    def moved(self, amplitude: FloatArray) -> Cause:
        """Return the cause with other amplitudes beside the neutral ones, within bounds."""
        low, high = self.choice.bounds[:, 0], self.choice.bounds[:, 1]
        total = self.choice.neutral + np.clip(amplitude, low, high)
        named = dict(zip(self.choice.amplitudes, total.tolist(), strict=True))
        return replace(self, values={**self.values, **named})


@dataclass(frozen=True, eq=False)
class AtCause:
    """Causes where residual and tangents agree with them."""

    causes: tuple[Cause, ...]
    covariance: FloatArray
    """Of all amplitudes, in order, shape (…, …)."""
    settled: DiagnosisProblem
    """The common ground with the causes taken off the diagnosed logs' residuals."""


def at_causes(settled: DiagnosisProblem, causes: Sequence[Cause]) -> AtCause:
    """Return the causes with their most probable amplitudes.

    Parameters
    ----------
    settled : DiagnosisProblem
    causes : sequence of Cause
        Where to begin, one at least.

    Notes
    -----
    An amplitude is known as well as chance and its tangent let it be, or as well as the bands of
    SoC agree on it, whichever is less (`by_charge`).
    """
    frame, error = settled.frame, settled.error
    at = frame.amplitudes_of([cause.candidate for cause in causes])
    bounds = frame.bounds_of([cause.candidate for cause in causes])
    prior = prior_precision(bounds)
    strays = np.concatenate(
        [
            np.full(len(cause.choice.amplitudes), error.strays.get(cause.choice.effect.id, 1.0))
            for cause in causes
        ]
    )
    worth = 1.0 / np.sqrt(strays)

    def solved(grams: Sequence[Gram], here: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how far to go from here, and the precision of where that is."""
        evidence = gather(frame, settled.reference_grams, grams, error)
        total = evidence.curvature[np.ix_(at, at)] * worth * worth[:, None] + prior
        return np.linalg.solve(total, evidence.gradient[at] / strays - prior @ here), total

    found = tuple(causes)
    factors = [settled.hardness(terms) for terms in settled.diagnosed]
    for _ in range(ROUNDS):
        diagnosed = [_terms_at(terms, settled, found) for terms in settled.diagnosed]
        grams = [
            gram_of(terms, frame.scale).weakened(factor)
            for terms, factor in zip(diagnosed, factors, strict=True)
        ]
        here = np.concatenate([cause.amplitude for cause in found])
        step, total = solved(grams, here)
        ends = np.cumsum([0, *(len(cause.choice.amplitudes) for cause in found)])
        found = tuple(
            cause.moved((here + step)[ends[k] : ends[k + 1]]) for k, cause in enumerate(found)
        )
    differing = variance_by_charge(
        diagnosed, frame.scale, factors, lambda grams: solved(grams, here)[0]
    )
    diagnosed = [_terms_at(terms, settled, found, tangents=False) for terms in settled.diagnosed]
    of_tangents = TANGENT_STD * np.concatenate([cause.amplitude for cause in found])
    covariance = np.asarray(np.linalg.inv(total) + np.diag(of_tangents**2))
    covariance += np.diag(np.maximum(differing - np.diag(covariance), 0.0))
    return AtCause(found, covariance, replace(settled, diagnosed=tuple(diagnosed)))


def squares(settled: DiagnosisProblem, causes: Sequence[Cause]) -> float:
    """Return the weighed squares that the diagnosed logs keep with some causes."""
    grams = [
        gram_of(_terms_at(terms, settled, causes, tangents=False), settled.frame.scale).weakened(
            settled.hardness(terms)
        )
        for terms in settled.diagnosed
    ]
    return gather(settled.frame, settled.reference_grams, grams, settled.error).squares


def _terms_at(
    terms: DesignMatrix,
    settled: DiagnosisProblem,
    causes: Sequence[Cause],
    *,
    tangents: bool = True,
) -> DesignMatrix:
    """Return a diagnosed log's terms with the causes in its residual, and their tangents there."""
    prepared, acting = terms.prepared.with_history_cache(), settled.acting or settled.model
    changed = residual(prepared, with_causes(acting, causes)) - residual(prepared, acting)
    effects = list(terms.effects)
    if tangents:
        smooth = with_modelled_voltage(prepared, with_causes(acting, causes))
        here = residual(smooth, with_causes(acting, causes))
        for number, cause in enumerate(causes):
            columns = np.empty_like(effects[cause.candidate])
            for k, width in enumerate(np.diff(cause.choice.bounds)[:, 0]):
                step = np.zeros(columns.shape[1])
                step[k] = STEP * width
                if cause.amplitude[k] + step[k] > cause.choice.bounds[k, 1]:
                    step[k] = -step[k]
                beside = [*causes]
                beside[number] = cause.moved(cause.amplitude + step)
                there = residual(smooth, with_causes(acting, beside))
                columns[:, k] = (here - there) / step[k]
            effects[cause.candidate] = columns
    return replace(terms, residual_v=terms.residual_v + changed, effects=tuple(effects))


def with_causes(model: ExtendedModel, causes: Sequence[Cause]) -> ExtendedModel:
    """Return a model with the causes."""
    for cause in causes:
        model = model.with_effect(cause.choice.effect, cause.values)
    return model


# --- The extended model: the given model, what the references add to it, and the accepted ef…

BELONGS_TO_A_LOG = frozenset({"initial_soc"})
"""Effects of one log that a model for later drives must not carry on."""


@dataclass(frozen=True, eq=False)
class Extension:
    """The extended model with what could not be carried over."""

    model: ExtendedModel
    remarks: tuple[str, ...]
    cause: dict[str, dict[str, float]] = field(default_factory=dict)
    """Parameters of each accepted effect, found on the model's own equations."""
    std: dict[str, dict[str, float]] = field(default_factory=dict)
    """Standard deviation of each of their amplitudes."""


def extend(settled: DiagnosisProblem, accepted: Sequence[Score]) -> Extension:
    """Return the extended model, its cause refined beyond the linear solution.

    Parameters
    ----------
    settled : DiagnosisProblem
    accepted : sequence of Score
    """
    few = _with_needed_structure(settled)
    if not accepted:
        return Extension(*_base(few))
    found = at_causes(settled, _begin(few, accepted))
    base, remarks = _base(_with_needed_structure(found.settled))
    # The pack's sizes have moved with the coefficients, and a file must agree with them.
    causes = [
        replace(cause, values=cause.choice.effect.clipped(cause.values, base.pack))
        for cause in found.causes
    ]
    std = iter(np.sqrt(np.diag(found.covariance)).tolist())
    return Extension(
        with_causes(base, causes),
        remarks,
        {cause.choice.effect.id: dict(cause.values) for cause in causes},
        {
            cause.choice.effect.id: {name: next(std) for name in cause.choice.amplitudes}
            for cause in causes
        },
    )


def _begin(few: DiagnosisProblem, accepted: Sequence[Score]) -> list[Cause]:
    """Return the causes by the linear solution and a fit of amplitudes and shapes from there."""
    evidence = gather(few.frame, few.reference_grams, few.diagnosed_grams, few.error)
    chosen = [k for score in accepted for k in score.candidates]
    solution, amplitudes = within_bounds(evidence, few.model.model, chosen)
    model, _ = _moved(few, solution)
    rest = iter(amplitudes)
    causes = []
    for score in accepted:
        choices = [few.frame.choices[k] for k in score.candidates]
        start = mixed(choices, [next(rest) for _ in choices])
        effect = choices[0].effect
        # A moment is sought beside what the linear solution made of the model, which may have taken
        # a late jump for a resistance, and beside what references know.
        moments = [
            at_moment(few.diagnosed, beside, effect, start)
            for beside in (model, few.acting or few.model)
        ]
        starts = [values for k, values in enumerate(moments) if values not in moments[:k]]
        refined = [_refined(few, model, effect, values) for values in starts]
        trials = [Cause(score.candidates[0], choices[0], values) for _, values in refined]
        best = 0 if len(trials) == 1 else int(np.argmin([squares(few, [c]) for c in trials]))
        model = refined[best][0]
        causes.append(trials[best])
    return causes


def _with_needed_structure(settled: DiagnosisProblem) -> DiagnosisProblem:
    """Return the common ground with no more structure than the references call for.

    Under the error that is expected of the diagnosed logs: beyond the references' temperatures that
    is a large one, and little is worth a piece. (On winter trips, all that summer trips call for
    made the voltage better and the SoC worse.)
    """
    before = settled.frame
    frame = replace(before, repairs=needed(before, settled.reference_grams, settled.error))
    at = [before.shown.index(k) for k in frame.shown]
    return replace(
        settled,
        frame=frame,
        references=tuple(
            replace(terms, effects=tuple(terms.effects[k] for k in at))
            for terms in settled.references
        ),
    )


def _base(settled: DiagnosisProblem) -> tuple[ExtendedModel, tuple[str, ...]]:
    """Return the given model with coefficients and structure, the logs being without a cause."""
    evidence = gather(
        settled.frame, settled.reference_grams, settled.diagnosed_grams, settled.error
    )
    solution, _ = within_bounds(evidence, settled.model.model, [])
    return _moved(settled, solution)


def _moved(
    settled: DiagnosisProblem, solution: FloatArray
) -> tuple[ExtendedModel, tuple[str, ...]]:
    """Return the given model with a solution's coefficients and structure, and what was not."""
    given, frame = settled.model, settled.frame
    p = frame.scale.size
    remarks: tuple[str, ...] = ()
    voltage_model = moved(given.model, solution[:p])
    if voltage_model is None:
        voltage_model = given.model
        remarks = ("the coefficients stay: moved, the pseudo-OCV would not rise everywhere",)
    return with_pieces(replace(given, model=voltage_model), frame, solution[p:]), remarks


def mixed(choices: Sequence[Candidate], amplitudes: Sequence[FloatArray]) -> dict[str, float]:
    """Return the one effect that stands for a mixture of two shapes: sums and weighted means."""
    total = np.sum(amplitudes, axis=0)
    weights = np.array([float(np.sum(np.abs(each))) for each in amplitudes])
    weights = weights / weights.sum() if weights.sum() > 0.0 else np.full(weights.size, 0.5)
    values = choices[0].values(total)
    for name in choices[0].shape:
        values[name] = float(weights @ np.array([choice.shape[name] for choice in choices]))
    return values


def _refined(
    settled: DiagnosisProblem, model: ExtendedModel, effect: Effect, start: Values
) -> tuple[ExtendedModel, dict[str, float]]:
    """Return model and parameters, fitted through the model's own equations from a start."""
    free = (*effect.amplitudes, *(shape for shape in effect.shapes if not shape.is_change_point))
    parameters = free or effect.parameters
    constants = {p.name: start[p.name] for p in effect.parameters if p not in parameters}
    pack = settled.model.pack  # not the model's, whose structure has taken much of its resistance
    bounds = np.array([parameter.bounds(pack) for parameter in parameters])
    neutral = effect.neutral(pack)
    centre = np.array([neutral[parameter.name] for parameter in parameters])
    scale = bounds[:, 1] - bounds[:, 0]
    low, high = (bounds[:, 0] - centre) / scale, (bounds[:, 1] - centre) / scale
    is_amplitude = np.array([parameter in effect.amplitudes for parameter in parameters])
    prior = 4.0 * np.sqrt(settled.error.lasting_v2) * is_amplitude

    def values_of(unit: FloatArray) -> dict[str, float]:
        values = (centre + unit * scale).tolist()
        return {p.name: value for p, value in zip(parameters, values, strict=True)} | constants

    logs = [terms.prepared.with_history_cache() for terms in settled.diagnosed]

    def errors(unit: FloatArray) -> FloatArray:
        trial = model.with_effect(effect, values_of(unit))
        volts = [residual(log, trial) for log in logs]
        return np.concatenate([*volts, prior * unit])

    begin = (np.array([start[parameter.name] for parameter in parameters]) - centre) / scale
    begin = np.clip(begin, low + 1e-9, high - 1e-9)
    # Differences are taken over a part of the value, which is nothing where a value is 0.
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


def model_file_of(extension: Extension, given: Model, error_v: float) -> Model:
    """Return the extended model as a model file that estimator and service run.

    Parameters
    ----------
    extension : Extension
    given : Model
        The model that was diagnosed.
    error_v : float
        RMS error that is left on rows held out [V]; all parts of the noise are scaled to it.
    """
    model = extension.model
    coefficients = {
        name: given.coefficients[name].model_copy(update={"value": value, "std_error": None})
        for name, value in zip(
            given.coefficient_names, model.model.coefficients.tolist(), strict=True
        )
    }
    noise = given.noise
    ratio = error_v / noise.voltage_rmse_v if noise.voltage_rmse_v > 0.0 else 1.0
    scaled = noise.model_copy(
        update={
            "fast_std_v": ratio * noise.fast_std_v,
            "slow_std_v": ratio * noise.slow_std_v,
            "lasting_std_v": ratio * noise.lasting_std_v,
            "voltage_rmse_v": error_v,
            "voltage_mae_pct": ratio * noise.voltage_mae_pct,
            "judged_on": "logs left out by `cangauge gap`",
        }
    )
    kept = [
        (effect, _for_later_drives(effect, item))
        for effect, item in model.effects
        if effect.id not in BELONGS_TO_A_LOG
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
    """Return the effects, those of one kind and shape added up, within physical bounds."""
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


def _for_later_drives(effect: Effect, values: Values) -> Values:
    # A step that has happened stays; online its time counts from the service's first sample.
    return {**values, "start_s": 0.0} if effect.id == "resistance_step" else values


def cause_parameters(
    score: Score, settled: DiagnosisProblem, extension: Extension | None = None
) -> dict[str, dict[str, object]]:
    """Return each parameter of a candidate with its 95 % interval and unit.

    Parameters
    ----------
    score : Score
    settled : DiagnosisProblem
    extension : Extension, optional
        If the candidate is in it, values and intervals are those found there; else the linear
        solution's.
    """
    choices = [settled.frame.choices[k] for k in score.candidates]
    first, size = choices[0], len(choices[0].amplitudes)
    if extension is not None and score.effect_id in extension.cause:
        values: Values = extension.cause[score.effect_id]
        std = extension.std[score.effect_id]
    else:
        values = mixed(choices, np.split(score.amplitude, len(choices)))
        std = {}
        for k, name in enumerate(first.amplitudes):
            of_one = np.arange(k, score.amplitude.size, size)
            std[name] = float(np.sqrt(np.sum(score.covariance[np.ix_(of_one, of_one)])))
    named = {parameter.name: parameter for parameter in first.effect.parameters}
    units = {name: parameter.unit for name, parameter in named.items()}
    result: dict[str, dict[str, object]] = {}
    for name in first.amplitudes:
        # What a bound is relative to is read off the model: an interval may go beyond it.
        low, high = named[name].bounds(settled.model.pack, BOUND_MARGIN)
        away = 1.96 * std[name]
        interval = [max(values[name] - away, low), min(values[name] + away, high)]
        result[name] = {"value": values[name], "ci": interval, "unit": units[name]}
    for name in first.shape:
        result[name] = {"value": values[name], "ci": None, "unit": units[name]}
    return result


def library_without(left_out: Sequence[str]) -> list[Effect]:
    """Return the library's effects but some."""
    return [effect for effect in LIBRARY.values() if effect.id not in left_out]
