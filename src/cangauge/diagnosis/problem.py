"""The diagnosis problem: everything that a verdict is computed from.

Checks the logs, assigns the roles of the hypotheses, estimates error model and structure from the
references, and linearises the diagnosed logs. Reference coverage, in temperature and SoC, limits
the conclusions beyond the references' operating points.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.diagnosis.design_matrix import DesignMatrix, candidates_for, design_matrix
from cangauge.diagnosis.error_model import (
    error_from_noise,
    error_from_references,
    with_overdispersion,
)
from cangauge.diagnosis.hypotheses import Hypotheses
from cangauge.diagnosis.input_checks import check_count, check_inputs
from cangauge.diagnosis.linear_gaussian import (
    ErrorModel,
    NormalEquations,
    Posterior,
    marginalize,
    normal_equations,
)
from cangauge.diagnosis.structure import (
    learn_structure,
    reference_equations,
    reference_matrices,
    reference_normal_equations,
)
from cangauge.errors import InputError
from cangauge.identify.starts import start_by_model, with_start
from cangauge.inference.linearized import residual
from cangauge.inference.rows import SOC_TOLERANCE_PCT, FitOptions, SampledLog, sample_log
from cangauge.logs.log import Log, TemperatureSource
from cangauge.logs.resample import dequantize, resample, usual_step_k
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

LEAST_WEIGHT_BEYOND = 0.1
"""Least information weight at temperatures that no reference covers, where the model file is the
only source."""

TEMPERATURE_STRUCTURE = frozenset({"charge_transfer", "inner_temperature"})
"""Structure that depends on temperature whatever its shape."""


@dataclass(frozen=True, eq=False)
class DiagnosisProblem:
    """Checked logs, hypotheses, error model and design matrices of one diagnosis."""

    model: ExtendedModel
    """Given model with the references' coefficients, without their structure; columns other than
    those of thermal effects are about it."""
    options: FitOptions
    hypotheses: Hypotheses
    error: ErrorModel
    references: tuple[DesignMatrix, ...]
    diagnosed: tuple[DesignMatrix, ...]
    reference_equations: tuple[NormalEquations, ...]
    """Normal equations of the references."""
    given: ExtendedModel
    """Given model with its own temperature range; the gap is its error."""
    covered: bool = True
    """Whether the references cover the diagnosed logs' temperatures."""
    structured: ExtendedModel | None = None
    """`model` with the structure that the references need (`design_matrix`)."""
    temperature_step_k: float = 0.0
    """Coarsest step of a diagnosed log's reported temperature [K]."""
    temperature_source: TemperatureSource = "unknown"
    """Where the model's temperature was measured."""
    outliers: tuple[str, ...] = ()
    """One sentence for each row left out as an outlier, and each start found from the voltage."""

    @cached_property
    def reference_errors_v(self) -> tuple[FloatArray, ...]:
        """Errors of the given model on each reference, shape (m,) [V]."""
        return tuple(residual(matrix.sampled, self.given) for matrix in self.references)

    @cached_property
    def diagnosed_errors_v(self) -> tuple[FloatArray, ...]:
        """Errors of the given model on each diagnosed log, shape (m,) [V]."""
        return tuple(residual(matrix.sampled, self.given) for matrix in self.diagnosed)

    @cached_property
    def diagnosed_equations(self) -> tuple[NormalEquations, ...]:
        """Normal equations of the diagnosed logs, by their noise scale."""
        return tuple(self.equations_of(matrix) for matrix in self.diagnosed)

    @cached_property
    def weighted_equations(self) -> tuple[NormalEquations, ...]:
        """Normal equations of the diagnosed logs with rows weighted by SoC coverage.

        Outside the SoC that the references cover, an error may be the cause or the extrapolated
        pseudo-OCV. Logs with too few covered rows are left out; if that leaves none, all rows
        count.
        """
        references = [matrix.sampled for matrix in self.references]
        found = []
        for matrix, equations in zip(self.diagnosed, self.diagnosed_equations, strict=True):
            weight = soc_weight(matrix.sampled, references, self.given.model.soc_range_pct)
            if np.all(weight == 1.0):
                found.append(equations)
            elif np.mean(weight > 0.0) >= LEAST_COVERED:
                found.append(self.equations_of(matrix, weight))
        return tuple(found) or self.diagnosed_equations

    @cached_property
    def posterior(self) -> Posterior:
        """Posterior of all effects, from the references and the weighted diagnosed logs."""
        return marginalize(
            self.hypotheses, self.reference_equations, self.weighted_equations, self.error
        )

    def equations_of(
        self, matrix: DesignMatrix, weight: FloatArray | None = None
    ) -> NormalEquations:
        """Return the normal equations of a diagnosed log, by its noise scale."""
        equations = normal_equations(matrix, self.hypotheses.column_scale, weight)
        return equations.inflated(self.noise_scale(matrix))

    def noise_scale(self, matrix: DesignMatrix) -> float:
        """Return a log's error variance relative to that of the references, at least 1.

        The model's error grows with the current: twice the mean square current, twice the variance.
        """
        if not self.references:
            return 1.0
        usual = float(np.mean([_mean_square_current(each) for each in self.references]))
        return max(1.0, _mean_square_current(matrix) / max(usual, 1e-12))


def build_problem(
    logs: Sequence[Log],
    model: Model,
    references: Sequence[Log],
    *,
    leave_out: Sequence[str] = (),
    initial_soc_pct: float | None = None,
) -> DiagnosisProblem:
    """Prepare a diagnosis up to the verdict; parameters as of `diagnose`.

    Raises
    ------
    InputError
        If a log gives no rows, is of another pack, has a dead channel or is given twice, or if
        there are neither references nor an information matrix in the model file.
    """
    given = model.extended_model()
    logs, references, outliers = check_inputs(logs, references, given)
    start_std_pct = SOC_STD_PCT
    if initial_soc_pct is None:
        logs, std_pct, sentences = _with_starts(logs, model)
        start_std_pct, outliers = math.hypot(start_std_pct, std_pct), [*outliers, *sentences]
    references, std_pct, sentences = _with_starts(references, model)
    start_std_pct, outliers = math.hypot(start_std_pct, std_pct), [*outliers, *sentences]
    widened = with_wider_range(given, [*logs, *references])
    options = FitOptions(
        capacity_ah=model.capacity_ah,
        initial_soc_pct=initial_soc_pct,
        rate_hz=model.rate_hz,
        delay_s=widened.model.delay_s,
        epsilon=model.epsilon,
        t_ref_c=model.t_ref_c,
    )
    if not references and model.information is None:
        raise InputError(
            "the model file has no information matrix and there are no references: an error of the"
            " model cannot be distinguished from a cause",
            source=model.name,
            field="information",
            cure="give logs on which the model is good with --reference",
        )
    library = [effect for effect in LIBRARY.values() if effect.id not in leave_out]
    choices = candidates(library, widened.pack, logs[0].time_s, for_diagnosis=True)
    # Steps of the temperature are visible only before averaging.
    for log in logs:
        check_count(log, options)
    of_logs = [sampled_for_diagnosis(log, options, soc_tolerance_pct=np.inf) for log in logs]
    of_references = [
        sampled_for_diagnosis(log, replace(options, initial_soc_pct=None)) for log in references
    ]
    covered = not of_references or temperatures_covered(of_references, of_logs)
    hypotheses = _hypotheses(
        model,
        choices,
        has_references=bool(of_references),
        covered=covered,
        start_std_pct=start_std_pct,
    )
    error = error_from_noise(model.noise, model.rate_hz, hypotheses)
    known, structured = widened, None
    matrices: tuple[DesignMatrix, ...] = ()
    equations: tuple[NormalEquations, ...] = ()
    if of_references:
        _LOG.info("learning the error model from the references")
        several = len(of_references) > 1
        equations = reference_equations(
            reference_matrices(of_references, widened, hypotheses), hypotheses
        )
        if several:
            least_weight = 0.0 if covered else LEAST_WEIGHT_BEYOND
            error = error_from_references(hypotheses, equations, error, least_weight)
        expected = error if covered or not several else _error_beyond(error)
        _LOG.info("learning the structure from the references")
        learned = learn_structure(of_references, widened, hypotheses, equations, expected)
        known, structured, hypotheses = learned.model, learned.structured, learned.hypotheses
        matrices, equations = learned.matrices, learned.equations
        if several:
            diagnosed_like = [
                _covered_equations(number, learned.matrices, learned.equations, hypotheses, given)
                for number in range(len(matrices))
            ]
            weights = _reference_weights(of_references, of_logs)
            error = with_overdispersion(
                hypotheses, learned.equations, error, weights, diagnosed_like
            )
            error = error if covered else _error_beyond(error)
    diagnosed = []
    for item in of_logs:
        _LOG.info("testing every effect on %s", item.log.name)
        of_log = candidates_for(choices, known.pack, item)
        diagnosed.append(design_matrix(item, known, of_log, structured))
    return DiagnosisProblem(
        model=known,
        options=options,
        hypotheses=hypotheses,
        error=error,
        references=matrices,
        diagnosed=tuple(diagnosed),
        reference_equations=equations,
        given=given,
        covered=covered,
        structured=structured,
        temperature_step_k=max(usual_step_k(log) for log in logs),
        temperature_source=model.temperature_source,
        outliers=tuple(outliers),
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


def _with_starts(logs: Sequence[Log], model: Model) -> tuple[list[Log], float, list[str]]:
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
    number: int,
    matrices: Sequence[DesignMatrix],
    equations: Sequence[NormalEquations],
    hypotheses: Hypotheses,
    given: ExtendedModel,
) -> NormalEquations:
    """Return a reference's normal equations as if it were diagnosed with the others."""
    others = [matrix.sampled for k, matrix in enumerate(matrices) if k != number]
    weight = soc_weight(matrices[number].sampled, others, given.model.soc_range_pct)
    if np.all(weight == 1.0) or np.mean(weight > 0.0) < LEAST_COVERED:
        return equations[number]
    return reference_normal_equations(matrices[number], hypotheses, weight)


def _error_beyond(error: ErrorModel) -> ErrorModel:
    """Return the error model at temperatures that no reference covers.

    Neither the correlation of the error nor overdispersion is known there: all scales get the
    variance of the slowest.
    """
    return replace(error, scale_v2=(error.lasting_v2,) * len(error.scale_v2), overdispersion={})


def temperatures_covered(references: Sequence[SampledLog], diagnosed: Sequence[SampledLog]) -> bool:
    """Return whether the references cover the temperatures of most diagnosed rows."""
    known = np.concatenate([item.rows.temperature_c for item in references])
    values = np.concatenate([item.rows.temperature_c for item in diagnosed])
    spread = float(np.ptp(known))
    low = known.min() - max(COVERED_K, COLDER_PART * spread)
    high = known.max() + max(COVERED_K, WARMER_PART * spread)
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
    soc_pct = item.rows.soc_pct
    if not references:
        return np.ones(soc_pct.size)
    fitted = (soc_pct >= model_range_pct[0]) & (soc_pct <= model_range_pct[1])
    beyond = np.where(fitted, BEYOND_WEIGHT, 0.0)
    return np.where(_inside(item, references, "soc_pct", COVERED_PCT), 1.0, beyond)


def _reference_weights(
    references: Sequence[SampledLog], diagnosed: Sequence[SampledLog]
) -> list[float]:
    """Return the weight of each reference for overdispersion.

    A reference at operating points that no other covers shows how the model extrapolates. That
    counts little if the diagnosed logs stay within the references' operating points.
    """
    covered = min(_part_inside(item, references) for item in diagnosed)
    return [
        max(
            LEAST_REFERENCE_WEIGHT,
            1.0 - covered,
            _part_inside(item, [other for other in references if other is not item]),
        )
        for item in references
    ]


def _part_inside(item: SampledLog, others: Sequence[SampledLog]) -> float:
    """Return the part of a log's rows within the temperature and SoC ranges of others."""
    in_temperature = _inside(item, others, "temperature_c", COVERED_K)
    return float(np.mean(in_temperature & _inside(item, others, "soc_pct", COVERED_PCT)))


def _inside(
    item: SampledLog, others: Sequence[SampledLog], name: str, margin: float
) -> NDArray[np.bool_]:
    """Return which rows lie within the range of others; all rows without others."""
    values = getattr(item.rows, name)
    if not others:
        return np.ones(values.size, dtype=bool)
    known = np.concatenate([getattr(other.rows, name) for other in others])
    return np.asarray((values >= known.min() - margin) & (values <= known.max() + margin))


def _mean_square_current(matrix: DesignMatrix) -> float:
    return float(np.mean(matrix.sampled.rows.delayed_current_a[:, 0] ** 2))
