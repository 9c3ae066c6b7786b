"""The diagnosis problem: everything that a verdict is computed from.

Checks the logs, learns from the references (`references`), and linearises the diagnosed logs.
"""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cangauge._typing import FloatArray
from cangauge.diagnosis.design_matrix import DesignMatrix, candidates_for, design_matrix
from cangauge.diagnosis.hypotheses import Hypotheses
from cangauge.diagnosis.input_checks import check_count, check_distinct, check_inputs
from cangauge.diagnosis.linear_gaussian import (
    ErrorModel,
    NormalEquations,
    Posterior,
    SharedEquations,
    marginalize,
    normal_equations,
)
from cangauge.diagnosis.references import (
    LEAST_COVERED,
    SOC_STD_PCT,
    LearnedReferences,
    learn,
    sampled_for_diagnosis,
    soc_weight,
    temperatures_covered,
    with_starts,
    with_wider_range,
)
from cangauge.errors import InputError
from cangauge.inference.linearized import residual
from cangauge.inference.rows import FitOptions, SampledLog
from cangauge.logs.log import Log, TemperatureSource
from cangauge.logs.resample import usual_step_k
from cangauge.model.effects.library import LIBRARY, Candidate, candidates
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class DiagnosisProblem:
    """Checked logs, hypotheses, error model and design matrices of one diagnosis."""

    model: ExtendedModel
    """Given model with the references' coefficients, without their structure; columns other than
    those of thermal effects are about it."""
    options: FitOptions
    hypotheses: Hypotheses
    error: ErrorModel
    references: tuple[SampledLog, ...]
    reference_errors_v: tuple[FloatArray, ...]
    """Errors of the given model on each reference, shape (m,) [V]."""
    reference_equations: SharedEquations
    """Of all references, by `error`."""
    diagnosed: tuple[DesignMatrix, ...]
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
        found = []
        for matrix, equations in zip(self.diagnosed, self.diagnosed_equations, strict=True):
            weight = soc_weight(matrix.sampled, self.references, self.given.model.soc_range_pct)
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
        return max(1.0, _mean_square_current(matrix.sampled) / max(usual, 1e-12))


def build_problem(
    logs: Sequence[Log],
    model: Model,
    references: Sequence[Log] | LearnedReferences,
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
    known = references if isinstance(references, LearnedReferences) else None
    if known is not None:
        known.check(logs, given, leave_out)
    own = () if isinstance(references, LearnedReferences) else references
    logs, own, outliers = check_inputs(logs, own, given)
    start_std_pct = SOC_STD_PCT
    if initial_soc_pct is None:
        logs, std_pct, sentences = with_starts(logs, model)
        start_std_pct, outliers = math.hypot(start_std_pct, std_pct), [*outliers, *sentences]
    own, std_pct, sentences = with_starts(own, model)
    start_std_pct, outliers = math.hypot(start_std_pct, std_pct), [*outliers, *sentences]
    if not own and known is None and model.information is None:
        raise InputError(
            "the model file has no information matrix and there are no references: an error of the"
            " model cannot be distinguished from a cause",
            source=model.name,
            field="information",
            cure="give logs on which the model is good with --reference",
        )
    widened = with_wider_range(given if known is None else known.widened, [*logs, *own])
    library = [effect for effect in LIBRARY.values() if effect.id not in leave_out]
    choices = candidates(library, widened.pack, logs[0].time_s, for_diagnosis=True)
    options = replace(FitOptions.of_model(model), initial_soc_pct=initial_soc_pct)
    # Steps of the temperature are visible only before averaging.
    for log in logs:
        check_count(log, options)
    of_logs = [sampled_for_diagnosis(log, options, soc_tolerance_pct=np.inf) for log in logs]
    if known is None:
        of_references = [sampled_for_diagnosis(log, FitOptions.of_model(model)) for log in own]
        covered = not of_references or temperatures_covered(of_references, of_logs)
        learned = learn(
            of_references, model, widened, choices, covered=covered, start_std_pct=start_std_pct
        )
    else:
        for item, other in itertools.product(of_logs, known.references):
            check_distinct(item.log, other.log)
        learned = _for_logs(known, logs, choices)
    diagnosed = []
    for item in of_logs:
        _LOG.info("testing every effect on %s", item.log.name)
        of_log = candidates_for(choices, learned.model.pack, item)
        diagnosed.append(design_matrix(item, learned.model, of_log, learned.structured))
    return DiagnosisProblem(
        model=learned.model,
        options=options,
        hypotheses=learned.hypotheses,
        error=learned.error_for(of_logs),
        references=learned.references,
        reference_errors_v=learned.errors_v,
        reference_equations=learned.equations,
        diagnosed=tuple(diagnosed),
        given=given,
        covered=learned.covered,
        structured=learned.structured,
        temperature_step_k=max(usual_step_k(log) for log in logs),
        temperature_source=model.temperature_source,
        outliers=(*outliers, *learned.outliers),
    )


def _for_logs(
    learned: LearnedReferences, logs: Sequence[Log], choices: Sequence[Candidate]
) -> LearnedReferences:
    """Return what is learned with the candidates and the ranges of the diagnosed logs."""
    structured = learned.structured
    return replace(
        learned,
        hypotheses=replace(learned.hypotheses, candidates=tuple(choices)),
        model=with_wider_range(learned.model, logs),
        structured=None if structured is None else with_wider_range(structured, logs),
    )


def _mean_square_current(sampled: SampledLog) -> float:
    return float(np.mean(sampled.rows.delayed_current_a[:, 0] ** 2))
