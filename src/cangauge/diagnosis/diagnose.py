"""Diagnosis of the gap between a model and logs: size, place, cause, and closed fraction."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from cangauge._display import figure, html
from cangauge._io import file_sha256
from cangauge._typing import FloatArray
from cangauge.diagnosis.caveats import (
    extended_soc_caveat,
    extension_caveat,
    log_caveats,
    reference_fit_caveat,
    temperature_step_caveat,
)
from cangauge.diagnosis.cross_validation import (
    Fold,
    HeldOutErrors,
    closed_fraction,
    closed_fraction_interval,
    folds,
    held_out_errors,
    rms,
    soc_error_pct,
)
from cangauge.diagnosis.error_breakdown import (
    ErrorShare,
    LogErrors,
    WorstSegment,
    error_shares,
    worst_segments,
)
from cangauge.diagnosis.extended_model import (
    Extension,
    extend,
    extended_model_file,
    parameters_of,
)
from cangauge.diagnosis.posterior import (
    EXPECTED_BEYOND,
    MIN_LOG_BAYES,
    NONE,
    UNKNOWN,
)
from cangauge.diagnosis.problem import DiagnosisProblem, build_problem
from cangauge.diagnosis.references import LearnedReferences
from cangauge.diagnosis.verdict import ALARM_BELOW, Verdict, decide
from cangauge.errors import InputError
from cangauge.inference.linearized import residual
from cangauge.inference.rows import SampledLog
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

_LOG = logging.getLogger(__name__)

LIKELY = 0.5
"""A verdict with less probability is more likely wrong than right."""

CROSS_VALIDATED = 6
"""Number of candidates with errors on held-out rows."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Result of `diagnose`.

    Errors are RMS errors of the voltage on the diagnosed logs, on rows that the fit of the effect
    did not see.

    See Also
    --------
    Diagnosis.summary : The verdict in one or two sentences.
    Diagnosis.to_dict : All results as one JSON object.
    """

    logs: tuple[Log, ...]
    """Diagnosed logs, as given."""
    model: Model
    """Diagnosed model."""
    problem: DiagnosisProblem
    """Basis of the verdict: error model, hypotheses, design matrices."""
    verdict: Verdict
    """Cause (an effect, `none` or `unknown`) with probabilities."""
    extension: Extension
    """Parameters of the accepted effects, and the extended model's equations."""
    baseline_rmse_v: float
    """Error of the given model [V]."""
    extended_rmse_v: float
    """Error of the extended model [V]."""
    floor_v: float
    """Error of the given model on the references, or that stated in the model file without any
    [V]."""
    explainable_v: float | None
    """Error on a left-out reference with the structure of the others [V]; None below two
    references."""
    closed_fraction: float | None
    """Closed part of the squared error above the floor; None without a gap."""
    closed_fraction_ci: tuple[float, float] | None
    """95 % interval of the closed fraction."""
    error_breakdown: tuple[ErrorShare, ...]
    """Shares of the squared error over SoC, temperature, current, rest, time and time scale."""
    worst_segments: tuple[WorstSegment, ...]
    """Segments with the largest errors, worst first."""
    candidates: tuple[dict[str, Any], ...]
    """Every effect, most probable first: probability, log Bayes factor, error, parameters."""
    observability: tuple[dict[str, object], ...]
    """Visible part of each effect's physical range (0–1), and what would separate the effect."""

    @cached_property
    def extended_model(self) -> Model:
        """Model with the references' structure and the accepted effects, ready to save and run."""
        return extended_model_file(self.extension, self.model, self.extended_rmse_v)

    @property
    def baseline_soc_mae_pct(self) -> float | None:
        """Mean absolute SoC error of the estimator with the given model [%].

        Runs the estimator over the diagnosed logs at the model's rate, with the initial SoC
        withheld; None if no log has a reference SoC.
        """
        return None if self._given_soc_error is None else self._given_soc_error[0]

    @property
    def extended_soc_mae_pct(self) -> float | None:
        """The same with the extended model [%]."""
        return None if self._extended_soc_error is None else self._extended_soc_error[0]

    @property
    def extended_soc_caveat(self) -> str:
        """Caveat of an extended model with a larger SoC error; "" without. Runs the estimator."""
        if self._given_soc_error is None or self._extended_soc_error is None:
            return ""
        return extended_soc_caveat(self._given_soc_error[0], *self._extended_soc_error)

    @cached_property
    def _given_soc_error(self) -> tuple[float, float] | None:
        return soc_error_pct(self.logs, self.model)

    @cached_property
    def _extended_soc_error(self) -> tuple[float, float] | None:
        return soc_error_pct(self.logs, self.extended_model)

    @property
    def summary(self) -> str:
        """Verdict in one or two sentences."""
        verdict, has_references = self.verdict, bool(self.problem.references)
        floor = "references" if has_references else "stated in the model file"
        sizes = f"{self.baseline_rmse_v:.2f} V; {floor} {self.floor_v:.2f} V"
        if verdict.cause == NONE:
            if has_references and self.baseline_rmse_v > self.floor_v:
                sizes += f"; {self.extended_rmse_v:.2f} V with the structure of the references"
            error = "reference error" if has_references else "error stated in the model file"
            if verdict.detected:
                return f"A fault is likely, though no single cause is more so than none ({sizes})."
            return (
                f"No significant gap beyond the {error} ({sizes})."
                f" P(no fault) = {verdict.probability:.2f}."
            )
        if verdict.cause == UNKNOWN:
            return (
                f"Gap of unknown cause ({sizes}): no effect of the library is likely."
                f" P(unknown cause) = {verdict.probability:.2f}."
            )
        ambiguous = ""
        if verdict.ambiguous_with:
            ambiguous = f", with {', '.join(verdict.ambiguous_with)} in the 90 % set"
        worse = ", worse than without it" if self.extended_rmse_v > self.baseline_rmse_v else ""
        text = (
            f"{verdict.cause} (probability {verdict.probability:.2f}{ambiguous}): gap of {sizes};"
            f" {self.extended_rmse_v:.2f} V with it on held-out rows{worse}."
        )
        if not self.problem.covered and verdict.cause in EXPECTED_BEYOND:
            text += (
                " No reference covers these temperatures, where healthy cells behave like that:"
                " this does not indicate a fault."
            )
        return text

    @property
    def caveats(self) -> list[str]:
        """Limits of what these logs can show, whatever the verdict; one or two sentences each."""
        problem = self.problem
        fits = [
            (sampled.log.name, rms(errors))
            for sampled, errors in zip(problem.references, problem.reference_errors_v, strict=True)
        ]
        stated_v = self.model.noise.voltage_rmse_v
        worse = ""
        if self.extension.cause:
            worse = extension_caveat(self.baseline_rmse_v, self.extended_rmse_v)
        found = [
            *problem.outliers,
            worse,
            reference_fit_caveat(fits, stated_v, problem.given.pack.voltage_v),
            *log_caveats(
                [matrix.sampled for matrix in problem.diagnosed],
                problem.references,
                problem.model.capacity_ah,
                problem.temperature_source,
            ),
            temperature_step_caveat(
                problem.temperature_step_k, problem.model.model.kt_v_per_k, self.floor_v
            ),
        ]
        return [sentence for sentence in found if sentence]

    def plot(self) -> Any:
        """Return the probabilities of the causes as bars, for `bokeh.plotting.show`."""
        return figure("diagnosis_figure", self)

    def _repr_html_(self) -> str:
        """Return verdict, sizes, probabilities and caveats for a notebook."""
        return html("diagnosis_html", self)

    def log_errors(self) -> list[LogErrors]:
        """Return the errors of each diagnosed log with the given and the extended model."""
        return [
            LogErrors(matrix.sampled, before_v, residual(matrix.sampled, self.extension.model))
            for matrix, before_v in zip(
                self.problem.diagnosed, self.problem.diagnosed_errors_v, strict=True
            )
        ]

    def _inputs(self) -> dict[str, Any]:
        """Return what was compared: model, logs and references, with the hashes of their files."""

        def described(sampled: Sequence[SampledLog]) -> list[dict[str, Any]]:
            logs = [each.log for each in sampled]
            return [{"name": log.name, "sha256": file_sha256(log.source)} for log in logs]

        text = self.model.to_json().encode()
        return {
            "model": {"name": self.model.name, "sha256": hashlib.sha256(text).hexdigest()},
            "logs": described([matrix.sampled for matrix in self.problem.diagnosed]),
            "references": described(self.problem.references),
        }

    def to_dict(
        self, extended_model: str | None = None, *, soc_error: bool = True
    ) -> dict[str, Any]:
        """Return the object that `cangauge gap --json` prints.

        Parameters
        ----------
        extended_model : str, optional
            Path of the extended model's file, to be reported.
        soc_error : bool
            Run the estimator for the SoC error with either model; otherwise these are None.
        """
        verdict = self.verdict
        return {
            "schema": 2,
            "gap": {
                "baseline_rmse_v": self.baseline_rmse_v,
                "extended_rmse_v": self.extended_rmse_v,
                "floor_sensor_v": self.floor_v,
                "floor_explainable_v": self.explainable_v,
                "closed_fraction": self.closed_fraction,
                "closed_fraction_ci": self.closed_fraction_ci and list(self.closed_fraction_ci),
                "baseline_soc_mae_pct": self.baseline_soc_mae_pct if soc_error else None,
                "extended_soc_mae_pct": self.extended_soc_mae_pct if soc_error else None,
            },
            "where": [share.to_dict() for share in self.error_breakdown],
            "worst_moments": [segment.to_dict() for segment in self.worst_segments],
            "cause": {
                "detected": verdict.detected,
                "verdict": verdict.cause,
                "probability": verdict.probability,
                "probability_none": verdict.probabilities[NONE],
                "probability_unknown": verdict.probabilities[UNKNOWN],
                "family": verdict.family,
                "family_probability": verdict.family_probability,
                "credible_set": list(verdict.credible_set),
                "ambiguous_with": list(verdict.ambiguous_with),
                "explained_fraction": verdict.explained,
                "accepted": [
                    {
                        "effect": effect_id,
                        "parameters": values,
                        "closed_fraction": self.closed_fraction,
                    }
                    for effect_id, values in self.extension.cause.items()
                ],
                "candidates": list(self.candidates),
            },
            "ceiling": None if verdict.ceiling is None else verdict.ceiling.to_dict(),
            "observability": list(self.observability),
            "inputs": self._inputs(),
            "limits": self.caveats,
            "extended_model": extended_model,
        }


def diagnose(
    logs: Sequence[Log],
    model: Model,
    references: Sequence[Log] | LearnedReferences = (),
    *,
    leave_out: Sequence[str] = (),
    initial_soc_pct: float | None = None,
    alarm_below: float = ALARM_BELOW,
) -> Diagnosis:
    """Diagnose the gap between a model and logs.

    Parameters
    ----------
    logs : sequence of Log
        Logs with a gap, which share one cause; at least 10 min each.
    model : Model
        Model of this pack, from `fit` or a model file.
    references : sequence of Log, or LearnedReferences
        Logs on which the model is good, at least three for reliable probabilities. They show the
        error to expect without a cause. The start of one without SoC is found from its voltage.
        For many diagnoses with the same references: what `learn_references` returns.
    leave_out : sequence of str
        Effects to leave out of the library.
    initial_soc_pct : float, optional
        SoC at the first row of each diagnosed log, instead of the log's own [%]; where neither is
        known it is found from the voltage.
    alarm_below : float
        A fault is reported where `none` is at most this probable (0–1).

    Returns
    -------
    Diagnosis
        Sizes of gap and floor [V], the verdict with probabilities, parameters of the cause with
        95 % intervals, where the error lies, caveats, and the extended model.

    Raises
    ------
    InputError
        If a log is too short, of another pack, given twice, has a dead channel, or has no SoC
        within 0–100 % that explains it; or without references and an information matrix in `model`.

    Examples
    --------
    >>> from cangauge.diagnosis import diagnose
    >>> from cangauge.logs.read import read_log
    >>> from cangauge.model.model_file import Model
    >>> found = diagnose(
    ...     logs=[read_log("monday.csv")],
    ...     model=Model.load("pack.json"),
    ...     references=[read_log(f"reference{k}.csv") for k in (1, 2, 3)],
    ... )  # doctest: +SKIP
    >>> print(found.summary)  # doctest: +SKIP
    current_offset (probability 0.93): gap of 1.32 V; references 0.50 V; 0.51 V with it on …
    >>> found.extended_soc_mae_pct  # doctest: +SKIP
    0.8
    """
    problem = build_problem(
        logs,
        model,
        references,
        leave_out=leave_out,
        initial_soc_pct=initial_soc_pct,
    )
    held_out = folds(problem)
    if not held_out:
        raise InputError(
            f"{logs[0].duration_s:.0f} s are too short to hold rows out: nothing can be concluded",
            source=logs[0].source or logs[0].name,
            cure="give a log of at least 10 min, better half an hour with changing load and SoC",
        )
    _LOG.info("comparing the effects")
    verdict = decide(problem, alarm_below)
    _LOG.info("cross-validating")
    errors = held_out_errors(problem, held_out, [score.effect_id for score in verdict.accepted])
    _LOG.info("refining the extended model")
    extension = extend(problem, verdict.accepted)
    floor_v = model.noise.voltage_rmse_v
    if problem.references:
        floor_v = rms(np.concatenate(problem.reference_errors_v))
    baseline_v, extended_v, closed, interval = _closed(errors, floor_v)
    is_gap = verdict.cause != NONE
    reference_v2 = problem.error.reference_v2
    return Diagnosis(
        logs=tuple(logs),
        model=model,
        problem=problem,
        verdict=verdict,
        extension=extension,
        baseline_rmse_v=baseline_v,
        extended_rmse_v=extended_v,
        floor_v=floor_v,
        explainable_v=float(np.sqrt(reference_v2)) if reference_v2 > 0.0 else None,
        closed_fraction=closed if is_gap else None,
        closed_fraction_ci=interval if is_gap else None,
        error_breakdown=tuple(
            error_shares(problem.diagnosed, problem.diagnosed_errors_v, model.capacity_ah)
        ),
        worst_segments=tuple(worst_segments(problem.diagnosed, problem.diagnosed_errors_v)),
        candidates=tuple(_candidates(problem, held_out, verdict, floor_v, extension)),
        observability=tuple(_observability(problem)),
    )


def _closed(
    errors: Sequence[HeldOutErrors], floor_v: float
) -> tuple[float, float, float | None, tuple[float, float] | None]:
    """Return RMS errors before and after [V], the closed fraction and its 95 % interval."""

    def together(parts: Sequence[FloatArray]) -> float:
        return rms(np.concatenate(parts))

    baseline_v = together([item.baseline_v for item in errors])
    extended_v = together([item.extended_v for item in errors])
    fraction = closed_fraction(baseline_v, extended_v, floor_v)
    return baseline_v, extended_v, fraction, closed_fraction_interval(errors, floor_v)


def _candidates(
    problem: DiagnosisProblem,
    held_out: Sequence[Fold],
    verdict: Verdict,
    floor_v: float,
    extension: Extension,
) -> list[dict[str, Any]]:
    """Return one JSON object for each effect; the first ones are cross-validated."""
    result = []
    for number, score in enumerate(verdict.candidates):
        rmse_v, closed, interval = None, None, None
        if number < CROSS_VALIDATED:
            errors = held_out_errors(problem, held_out, [score.effect_id])
            _, rmse_v, closed, interval = _closed(errors, floor_v)
        result.append(
            {
                "effect": score.effect_id,
                "probability": verdict.probabilities[score.effect_id],
                "log_bayes_factor": score.log_bayes_factor,
                "rmse_v": rmse_v,
                "closed_fraction": closed,
                "ci": None if interval is None else list(interval),
                "parameters": parameters_of(score, problem, extension),
            }
        )
    return result


def _observability(problem: DiagnosisProblem) -> list[dict[str, object]]:
    """Return the part of each effect's physical range that these logs could show.

    `visible` is 1 minus the smallest amplitude, in parts of the bounds, whose evidence would reach
    `MIN_LOG_BAYES` with the references' overdispersion.
    """
    hypotheses, error = problem.hypotheses, problem.error
    best: dict[str, float] = {}
    needs: dict[str, str] = {}
    for k, candidate in enumerate(hypotheses.candidates):
        effect = candidate.effect
        if not effect.is_cause:
            continue
        at = problem.posterior.slice_of(k)
        overdispersion = error.overdispersion_of(effect.id)
        information = np.diag(problem.posterior.curvature[at, at]) / overdispersion
        largest = np.abs(candidate.bounds).max(axis=1)
        smallest = np.sqrt(2.0 * (MIN_LOG_BAYES + 2.0) / np.maximum(information, 1e-30)) / largest
        visible = float(np.clip(1.0 - smallest.min(), 0.0, 1.0))
        best[effect.id] = max(best.get(effect.id, 0.0), visible)
        needs[effect.id] = effect.separated_by
    return [
        {"effect": effect_id, "visible": visible, "needs": needs[effect_id]}
        for effect_id, visible in sorted(best.items(), key=lambda item: -item[1])
    ]
