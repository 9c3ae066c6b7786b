"""What references show: error model, structure and coverage, learned once for many diagnoses.

Error model, prior scales, overdispersion, and the model that columns are taken about, are learned
on the first `LEARNED_ON` references. Coefficients and amplitudes of the structure follow from the
sum of the normal equations of all. Coverage, in temperature and SoC, limits the conclusions beyond
the references' operating points.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.diagnosis.error_model import (
    HealthyEvidence,
    error_from_noise,
    error_from_references,
    healthy_evidence,
    with_overdispersion,
)
from cangauge.diagnosis.hypotheses import Hypotheses
from cangauge.diagnosis.input_checks import check_inputs
from cangauge.diagnosis.linear_gaussian import (
    ErrorModel,
    NormalEquations,
    SharedEquations,
    shared_equations,
)
from cangauge.diagnosis.structure import (
    ReferenceModel,
    learn_structure,
    reference_equations,
    reference_matrix,
    reference_normal_equations,
)
from cangauge.errors import InputError
from cangauge.identify.starts import start_by_model, with_start
from cangauge.inference.linearized import residual
from cangauge.inference.rows import SOC_TOLERANCE_PCT, FitOptions, SampledLog, sample_log
from cangauge.logs.log import Log
from cangauge.logs.resample import dequantize, resample
from cangauge.model.effects.library import LIBRARY, Candidate, candidates
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model

_LOG = logging.getLogger(__name__)

COVERED_K, COVERED_PCT = 3.0, 3.0
"""References cover temperatures and SoC up to this far outside their own range [K, %]."""

COLDER_PART, WARMER_PART = 0.2, 0.5
"""References also cover temperatures below and above their range by these parts of it, since they
show the temperature dependence; less in the cold, where resistance rises more steeply. (On the
trips of the check, winter is 0.3 below summer.)"""

BEYOND_WEIGHT = 0.3
"""Weight of a row at an SoC that only the model's own logs cover. The only value tested, on
development cases, against a weight of 0."""

LEAST_REFERENCE_WEIGHT = 0.1
"""Weight of a reference at operating points that no other covers."""

LEAST_COVERED = 0.2
"""Rows at an SoC that neither references nor the model's own logs cover are left out, if the others
are at least this part of a log."""

SOC_STD_PCT = 0.5
"""Prior standard deviation of a healthy log's initial SoC [%]."""

SLOW_STD, RESISTANCE_STD = 0.08, 0.03
"""Prior standard deviations of `PER_LOG_STATES`, in parts of the pack resistance."""

OTHER_STD = 0.01
"""Prior standard deviation of the other per-log effects, in parts of their physical range."""

LEARNED_ON = 100
"""References that error model, structure and overdispersion are learned on; the equations of the
others are added to the sum. A variance over n logs is known to √(2/n): 14 %."""

LEAST_WEIGHT_BEYOND = 0.1
"""Least information weight at temperatures that no reference covers, where the model file is the
only source."""

TEMPERATURE_STRUCTURE = frozenset({"charge_transfer", "inner_temperature"})
"""Structure that depends on temperature whatever its shape."""


@dataclass(frozen=True, eq=False)
class LearnedReferences:
    """What references show of healthy logs: all that a diagnosis needs of them.

    Of each reference it holds the log and its rows, but neither columns nor products, so that it
    stays small with a thousand of them. It can be pickled.
    """

    widened: ExtendedModel
    """Given model with its ranges widened to those of the logs."""
    hypotheses: Hypotheses
    error: ErrorModel
    """Without overdispersion, which depends on where the diagnosed logs lie."""
    equations: SharedEquations
    """Of all references, by the error model expected of the diagnosed logs."""
    model: ExtendedModel
    """Given model with the references' coefficients, without their structure."""
    structured: ExtendedModel | None = None
    """`model` with the structure that the references need."""
    covered: bool = True
    """Whether they cover the temperatures of the logs that it was learned for."""
    references: tuple[SampledLog, ...] = ()
    errors_v: tuple[FloatArray, ...] = ()
    """Errors of the given model on each reference, shape (m,) [V]."""
    healthy: HealthyEvidence | None = None
    """With two references at least."""
    outliers: tuple[str, ...] = ()

    def covers(self, logs: Sequence[Log]) -> bool:
        """Return whether it holds for logs: they state their SoC, at the references' temperatures.

        Elsewhere the structure that depends on temperature is not that of the references, and a
        start found from the voltage has a wider prior: such logs need the references themselves.
        """
        stated = all(log.first_soc() is not None for log in logs)
        return stated and _temperatures_within([log.temperature_c for log in logs], self.references)

    def check(self, logs: Sequence[Log], model: ExtendedModel, leave_out: Sequence[str]) -> None:
        """Raise InputError for a diagnosis that it does not hold for.

        Parameters
        ----------
        logs : sequence of Log
            To diagnose.
        model : ExtendedModel
            Of the pack.
        leave_out : sequence of str
            Effects to leave out of the library.
        """
        learned_of = self.widened.model.coefficients
        problem = ""
        if leave_out:
            problem = "the references were learned with the whole library"
        elif not np.array_equal(learned_of, model.model.coefficients):
            problem = "the references were learned for another model"
        elif not self.covers(logs):
            problem = "a log states no SoC, or lies at temperatures that no reference covers"
        if problem:
            raise InputError(problem, field="references", cure="give the references themselves")

    def error_for(self, diagnosed: Sequence[SampledLog]) -> ErrorModel:
        """Return the error model with the overdispersion where the diagnosed logs lie."""
        if self.healthy is None:
            return self.error
        weights = _reference_weights(self.references, diagnosed)
        error = with_overdispersion(self.error, self.healthy, weights)
        return error if self.covered else _error_beyond(error)


def learn_references(references: Sequence[Log], model: Model) -> LearnedReferences:
    """Learn error model and structure from references once, for any number of diagnoses.

    `diagnose` gives the same with it as with the references, for logs that it `covers` and whose
    temperatures and currents lie within the references' ranges.

    Parameters
    ----------
    references : sequence of Log
        Logs on which the model is good, at least one.
    model : Model

    Raises
    ------
    InputError
        If there is none, or one is of another pack, has a dead channel or is given twice.
    """
    if not references:
        raise InputError("no references to learn from", cure="give logs without a fault")
    given = model.extended_model()
    _, checked, outliers = check_inputs([], references, given)
    started, std_pct, sentences = with_starts(checked, model)
    widened = with_wider_range(given, started)
    learned = learn(
        [sampled_for_diagnosis(log, FitOptions.of_model(model)) for log in started],
        model,
        widened,
        candidates(list(LIBRARY.values()), widened.pack, started[0].time_s, for_diagnosis=True),
        start_std_pct=math.hypot(SOC_STD_PCT, std_pct),
    )
    return replace(learned, outliers=(*outliers, *sentences))


def learn(
    references: Sequence[SampledLog],
    model: Model,
    widened: ExtendedModel,
    choices: Sequence[Candidate],
    *,
    start_std_pct: float,
    covered: bool = True,
) -> LearnedReferences:
    """Learn error model, coefficients and structure from references, if any."""
    hypotheses = _hypotheses(
        model,
        choices,
        has_references=bool(references),
        covered=covered,
        start_std_pct=start_std_pct,
    )
    stated = error_from_noise(model.noise, model.rate_hz, hypotheses)
    none = shared_equations(hypotheses, [], stated)
    without = LearnedReferences(widened, hypotheses, stated, none, widened, covered=covered)
    if not references:
        return without
    _LOG.info("learning the error model from the references")
    error, healthy = stated, None
    first, several = references[:LEARNED_ON], len(references) > 1
    equations = tuple(reference_equations(first, widened, hypotheses))
    if several:
        least_weight = 0.0 if covered else LEAST_WEIGHT_BEYOND
        error = error_from_references(hypotheses, equations, stated, least_weight)
    expected = error if covered or not several else _error_beyond(error)
    _LOG.info("learning the structure from the references")
    total = shared_equations(hypotheses, equations, expected)
    del equations  # the products of each take ten megabytes
    found = learn_structure(first, widened, hypotheses, total, expected)
    further = shared_equations(found.hypotheses, [], expected)
    # A cache of their own, which is not kept.
    rest = (item.with_history_cache() for item in references[LEARNED_ON:])
    for log in reference_equations(rest, found.model, found.hypotheses, found.structured):
        further += shared_equations(found.hypotheses, [log], expected)
    given = model.extended_model()
    if several:
        as_diagnosed = _covered_equations(references, found, given)
        healthy = healthy_evidence(
            found.hypotheses,
            found.equations,
            error,
            as_diagnosed,
            further if covered else None,  # a sum is by one error model
        )
    return replace(
        without,
        hypotheses=found.hypotheses,
        error=error,
        equations=found.total + further,
        model=found.model,
        structured=found.structured,
        # The cache of a log is larger than the log.
        references=tuple(
            replace(item, signals=replace(item.signals, cached_history=None)) for item in references
        ),
        errors_v=tuple(residual(item, given) for item in references),
        healthy=healthy,
    )


def sampled_for_diagnosis(
    log: Log, options: FitOptions, *, soc_tolerance_pct: float = SOC_TOLERANCE_PCT
) -> SampledLog:
    """Return a log with its rows, and a history of its current that all columns share."""
    sampled = sample_log(resample(dequantize(log)), options, soc_tolerance_pct=soc_tolerance_pct)
    return sampled.with_history_cache()


def with_wider_range(model: ExtendedModel, logs: Sequence[Log]) -> ExtendedModel:
    """Return the model with its temperature and current ranges widened to those of the logs.

    Outside its range the model limits the temperature, so that logs there carry no information on
    the temperature dependence. The SoC range stays, as the pseudo-OCV does not extrapolate.
    """
    low_c, high_c = model.model.temperature_range_c
    low_a, high_a = model.model.current_range_a
    for log in logs:
        low_c = min(low_c, float(log.temperature_c.min()))
        high_c = max(high_c, float(log.temperature_c.max()))
        low_a = min(low_a, float(log.current_a.min()))
        high_a = max(high_a, float(log.current_a.max()))
    voltage_model = replace(
        model.model, temperature_range_c=(low_c, high_c), current_range_a=(low_a, high_a)
    )
    return replace(model, model=voltage_model)


def with_starts(logs: Sequence[Log], model: Model) -> tuple[list[Log], float, list[str]]:
    """Return logs with a start, the largest deviation of those found [%], a sentence for each.

    Where a log states no SoC its start is found from the voltage by the model. It is then known as
    well as the model's lasting error allows, which the prior of every log's start allows for.
    """
    found, std_pct, sentences = list(logs), 0.0, []
    for k, log in enumerate(logs):
        if log.first_soc() is not None:
            continue
        start = start_by_model(log, model)
        found[k] = with_start(log, start.soc_pct)
        std_pct = max(std_pct, start.std_pct or 0.0)
        sentences.append(
            f"{log.name} states no SoC: its start of {start.soc_pct:.1f} ± {start.std_pct or 0:.1f}"
            " % was found from the voltage. A cause that shifts the voltage as a whole may hide in"
            " it; --initial-soc states the start."
        )
    return found, std_pct, sentences


def _hypotheses(
    model: Model,
    choices: Sequence[Candidate],
    *,
    has_references: bool,
    covered: bool,
    start_std_pct: float,
) -> Hypotheses:
    """Assign the candidates' roles and the prior of the voltage model."""
    # References cannot show the temperature dependence at temperatures that they do not cover.
    structure = tuple(
        k
        for k, choice in enumerate(choices)
        if has_references
        and choice.effect.is_structure
        and (covered or not _depends_on_temperature(choice))
    )
    per_log, per_log_std = _per_log_effects(choices, model, start_std_pct)
    information = model.information
    root, scale = None, np.ones(9 + len(model.delays_s))
    if information is not None:
        root, scale = np.array(information.root), np.array(information.scale)
    return Hypotheses(tuple(choices), root, scale, structure, per_log, per_log_std)


def _depends_on_temperature(choice: Candidate) -> bool:
    return choice.effect.id in TEMPERATURE_STRUCTURE or bool(choice.shape.get("activation_k"))


def _per_log_effects(
    choices: Sequence[Candidate], model: Model, start_std_pct: float
) -> tuple[tuple[int, ...], FloatArray]:
    """Return the per-log effects, every effect at its usual shapes, with their prior deviations."""
    by_effect: dict[str, dict[tuple[object, ...], int]] = {}
    for k, choice in enumerate(choices):
        if choice.effect.is_cause and choice.is_for_fit:
            # The first candidate of a shape is linearised at a small effect, as per-log ones are.
            shapes = by_effect.setdefault(choice.effect.id, {})
            shapes.setdefault(tuple(choice.shape.items()), k)
    noise = model.noise
    constant_v = max(noise.lasting_std_v, 0.25 * math.hypot(noise.fast_std_v, noise.slow_std_v))
    known_std = {"voltage_offset": [constant_v], "initial_soc": [start_std_pct]}
    per_log: list[int] = []
    stds: list[float] = []
    for effect_id, shapes in by_effect.items():
        for k in shapes.values():
            widths = choices[k].bounds[:, 1] - choices[k].bounds[:, 0]
            usual = known_std.get(effect_id, (OTHER_STD * widths).tolist())
            # The shapes together have the effect's variance.
            stds.extend(std / math.sqrt(len(shapes)) for std in usual)
            per_log.append(k)
    return tuple(per_log), np.array([*stds, SLOW_STD, RESISTANCE_STD])


def _covered_equations(
    references: Sequence[SampledLog], learned: ReferenceModel, given: ExtendedModel
) -> list[NormalEquations]:
    """Return each reference's normal equations as if it were diagnosed with the others."""
    spans = _spans(references, "soc_pct")
    found = list(learned.equations)
    for k, item in enumerate(references[: len(found)]):
        others = np.delete(spans, k, axis=0)
        weight = _weight_by_soc(item, others, given.model.soc_range_pct)
        if not np.all(weight == 1.0) and np.mean(weight > 0.0) >= LEAST_COVERED:
            matrix = reference_matrix(item, learned.model, learned.hypotheses, learned.structured)
            found[k] = reference_normal_equations(matrix, learned.hypotheses, weight)
    return found


def _error_beyond(error: ErrorModel) -> ErrorModel:
    """Return the error model at temperatures that no reference covers.

    Neither the correlation of the error nor overdispersion is known there: all scales get the
    variance of the slowest.
    """
    return replace(error, scale_v2=(error.lasting_v2,) * len(error.scale_v2), overdispersion={})


def temperatures_covered(references: Sequence[SampledLog], diagnosed: Sequence[SampledLog]) -> bool:
    """Return whether the references cover the temperatures of most diagnosed rows."""
    return _temperatures_within([item.rows.temperature_c for item in diagnosed], references)


def _temperatures_within(
    temperatures_c: Sequence[FloatArray], references: Sequence[SampledLog]
) -> bool:
    spans = _spans(references, "temperature_c")
    values, coldest, warmest = np.concatenate(temperatures_c), spans[:, 0].min(), spans[:, 1].max()
    low = coldest - max(COVERED_K, COLDER_PART * (warmest - coldest))
    high = warmest + max(COVERED_K, WARMER_PART * (warmest - coldest))
    return bool(np.mean((values >= low) & (values <= high)) > 0.5)


def soc_weight(
    item: SampledLog, references: Sequence[SampledLog], model_range_pct: tuple[float, float]
) -> FloatArray:
    """Return the weight of each row of a log by SoC coverage, shape (m,).

    Parameters
    ----------
    item : SampledLog
    references : sequence of SampledLog
    model_range_pct : tuple of float
        SoC range that the model was fitted on [%].

    Returns
    -------
    array of shape (m,)
        1 where references cover the SoC; `BEYOND_WEIGHT` where only the model's own logs do; 0
        where the pseudo-OCV extrapolates. All 1 without references.
    """
    return _weight_by_soc(item, _spans(references, "soc_pct"), model_range_pct)


def _weight_by_soc(
    item: SampledLog, spans_pct: FloatArray, model_range_pct: tuple[float, float]
) -> FloatArray:
    soc_pct = item.rows.soc_pct
    fitted = (soc_pct >= model_range_pct[0]) & (soc_pct <= model_range_pct[1])
    beyond = np.where(fitted, BEYOND_WEIGHT, 0.0)
    return np.where(_inside(soc_pct, spans_pct, COVERED_PCT), 1.0, beyond)


def _reference_weights(
    references: Sequence[SampledLog], diagnosed: Sequence[SampledLog]
) -> list[float]:
    """Return the weight of each reference for overdispersion.

    A reference at operating points that no other covers shows how the model extrapolates. That
    counts little if the diagnosed logs stay within the references' operating points.
    """
    spans_c, spans_pct = _spans(references, "temperature_c"), _spans(references, "soc_pct")

    def part_inside(item: SampledLog, spans_c: FloatArray, spans_pct: FloatArray) -> float:
        in_temperature = _inside(item.rows.temperature_c, spans_c, COVERED_K)
        return float(np.mean(in_temperature & _inside(item.rows.soc_pct, spans_pct, COVERED_PCT)))

    covered = min(part_inside(item, spans_c, spans_pct) for item in diagnosed)
    return [
        max(
            LEAST_REFERENCE_WEIGHT,
            1.0 - covered,
            part_inside(item, np.delete(spans_c, k, axis=0), np.delete(spans_pct, k, axis=0)),
        )
        for k, item in enumerate(references[:LEARNED_ON])
    ]


def _spans(logs: Sequence[SampledLog], name: str) -> FloatArray:
    """Return the least and the largest value of each log's rows, shape (logs, 2)."""
    values = [getattr(item.rows, name) for item in logs]
    return np.array([(each.min(), each.max()) for each in values]).reshape(-1, 2)


def _inside(values: FloatArray, spans: FloatArray, margin: float) -> NDArray[np.bool_]:
    """Return which values lie within the range of all spans together; all without spans."""
    if not len(spans):
        return np.ones(values.size, dtype=bool)
    low, high = spans[:, 0].min() - margin, spans[:, 1].max() + margin
    return np.asarray((values >= low) & (values <= high))
