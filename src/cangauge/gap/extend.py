"""The extended model: the given model, what the references add to it, and the accepted effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from cangauge import __version__
from cangauge.gap.at_cause import Cause, at_causes, squares, with_causes
from cangauge.gap.at_moment import at_moment
from cangauge.gap.bounded import moved, within_bounds
from cangauge.gap.columns import Candidate, residual
from cangauge.gap.evidence import gather
from cangauge.gap.scores import Score
from cangauge.gap.settle import Settled
from cangauge.gap.structure import needed, with_pieces
from cangauge.model.effects.effect import Effect, Values
from cangauge.model.effects.library import LIBRARY, effect_entries, one_of
from cangauge.model.effects.parameter import LEEWAY, Pack
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Made, ModelFile, Ranges

FloatArray = NDArray[np.float64]

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


def extend(settled: Settled, accepted: Sequence[Score]) -> Extension:
    """Return the extended model, its cause refined beyond the linear solution.

    Parameters
    ----------
    settled : Settled
    accepted : sequence of Score
    """
    few = _with_needed_structure(settled)
    if not accepted:
        return Extension(*_base(few))
    found = at_causes(settled, _begin(few, accepted))
    base, remarks = _base(_with_needed_structure(found.settled))
    # The pack's sizes have moved with the coefficients, and a file must agree with them.
    causes = [
        replace(cause, values=cause.choice.effect.within(cause.values, base.pack))
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


def _begin(few: Settled, accepted: Sequence[Score]) -> list[Cause]:
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


def _with_needed_structure(settled: Settled) -> Settled:
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


def _base(settled: Settled) -> tuple[ExtendedModel, tuple[str, ...]]:
    """Return the given model with coefficients and structure, the logs being without a cause."""
    evidence = gather(
        settled.frame, settled.reference_grams, settled.diagnosed_grams, settled.error
    )
    solution, _ = within_bounds(evidence, settled.model.model, [])
    return _moved(settled, solution)


def _moved(settled: Settled, solution: FloatArray) -> tuple[ExtendedModel, tuple[str, ...]]:
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
    settled: Settled, model: ExtendedModel, effect: Effect, start: Values
) -> tuple[ExtendedModel, dict[str, float]]:
    """Return model and parameters, fitted through the model's own equations from a start."""
    free = (*effect.amplitudes, *(shape for shape in effect.shapes if not shape.is_moment))
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

    logs = [terms.prepared.remembering() for terms in settled.diagnosed]

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


def model_file_of(extension: Extension, given: ModelFile, error_v: float) -> ModelFile:
    """Return the extended model as a model file that estimator and service run.

    Parameters
    ----------
    extension : Extension
    given : ModelFile
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
        key = one_of(effect, values)
        if key not in merged:
            merged[key] = (effect, dict(values))
            continue
        neutral = effect.neutral(pack)
        _, total = merged[key]
        for parameter in effect.amplitudes:
            total[parameter.name] += values[parameter.name] - neutral[parameter.name]
        merged[key] = (effect, effect.within(total, pack))
    return list(merged.values())


def _for_later_drives(effect: Effect, values: Values) -> Values:
    # A step that has happened stays; online its time counts from the service's first sample.
    return {**values, "start_s": 0.0} if effect.id == "resistance_step" else values


def cause_parameters(
    score: Score, settled: Settled, extension: Extension | None = None
) -> dict[str, dict[str, object]]:
    """Return each parameter of a candidate with its 95 % interval and unit.

    Parameters
    ----------
    score : Score
    settled : Settled
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
        low, high = named[name].bounds(settled.model.pack, LEEWAY)
        away = 1.96 * std[name]
        interval = [max(values[name] - away, low), min(values[name] + away, high)]
        result[name] = {"value": values[name], "ci": interval, "unit": units[name]}
    for name in first.shape:
        result[name] = {"value": values[name], "ci": None, "unit": units[name]}
    return result


def library_without(left_out: Sequence[str]) -> list[Effect]:
    """Return the library's effects but some."""
    return [effect for effect in LIBRARY.values() if effect.id not in left_out]
