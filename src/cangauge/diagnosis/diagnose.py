"""The diagnosis: model, references and logs in; where, which, how far out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cangauge.diagnosis.caveats import limits, reference_fit, stepped_temperature, worse_with
from cangauge.diagnosis.cross_validation import (
    Fold,
    Judged,
    closed_fraction,
    closed_interval,
    folds,
    judge,
    rms,
    soc_mae_pct,
)
from cangauge.diagnosis.error_breakdown import Moment, Place, places, worst_moments
from cangauge.diagnosis.extended_model import (
    Extension,
    cause_parameters,
    extend,
    library_without,
    model_file_of,
)
from cangauge.diagnosis.linear_gaussian import gather
from cangauge.diagnosis.posterior import (
    ACCEPT_LOG_BAYES,
    NONE,
    OF_TEMPERATURE,
    UNKNOWN,
    Verdict,
    decide,
)
from cangauge.diagnosis.problem import DiagnosisProblem, build_problem
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

EVEN = 0.5
"""A verdict with less is as likely wrong as right."""

SHOWN = 6
"""So many candidates are judged on rows held out and listed in full."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What the diagnosis found."""

    settled: DiagnosisProblem
    verdict: Verdict
    baseline_rmse_v: float
    extended_rmse_v: float
    floor_v: float
    stated_v: float
    """RMS error that the model file states [V]."""
    explainable_v: float | None
    """What the most flexible structure of the references leaves of one that is left out [V]."""
    baseline_soc_mae_pct: float | None
    extended_soc_mae_pct: float | None
    """By the online estimator, initial SoC withheld; None where the logs do not tell their SoC."""
    closed: float | None
    closed_ci: tuple[float, float] | None
    where: tuple[Place, ...]
    worst: tuple[Moment, ...]
    candidates: tuple[dict[str, Any], ...]
    observability: tuple[dict[str, object], ...]
    extension: Extension

    @property
    def limits(self) -> list[str]:
        """What these logs cannot show, whatever the verdict, a sentence each."""
        settled = self.settled
        found = limits(
            [terms.prepared for terms in settled.diagnosed],
            [terms.prepared for terms in settled.references],
            settled.model.capacity_ah,
            settled.options.initial_soc_pct,
            settled.temperature_source,
        )
        steps = stepped_temperature(
            settled.temperature_step_k, settled.model.model.kt_v_per_k, self.floor_v
        )
        misses = [
            (terms.prepared.log.name, rms(errors))
            for terms, errors in zip(settled.references, settled.given_errors_v[0], strict=True)
        ]
        fit = reference_fit(misses, self.stated_v, settled.as_given.pack.voltage_v)
        worse = ""
        if self.extension.cause:
            worse = worse_with(self.baseline_rmse_v, self.extended_rmse_v)
        said = [*settled.left_out, worse, fit, *found, steps]
        return [sentence for sentence in said if sentence]

    def to_dict(self, extended_model: str | None = None) -> dict[str, Any]:
        """Return the object that `cangauge gap --json` prints."""
        verdict = self.verdict
        return {
            "schema": 1,
            "gap": {
                "baseline_rmse_v": self.baseline_rmse_v,
                "extended_rmse_v": self.extended_rmse_v,
                "floor_sensor_v": self.floor_v,
                "floor_explainable_v": self.explainable_v,
                "closed_fraction": self.closed,
                "closed_fraction_ci": None if self.closed_ci is None else list(self.closed_ci),
                "baseline_soc_mae_pct": self.baseline_soc_mae_pct,
                "extended_soc_mae_pct": self.extended_soc_mae_pct,
            },
            "where": [place.to_dict() for place in self.where],
            "worst_moments": [moment.to_dict() for moment in self.worst],
            "cause": {
                "verdict": verdict.cause,
                "probability": verdict.probability,
                "probability_unknown": verdict.chances[UNKNOWN],
                "probability_none": verdict.chances[NONE],
                "ambiguous_with": list(verdict.ambiguous_with),
                "explained_fraction": verdict.explained,
                "accepted": [
                    {
                        "effect": effect_id,
                        "parameters": values,
                        "closed_fraction": self.closed,
                    }
                    for effect_id, values in self.extension.cause.items()
                ],
                "candidates": list(self.candidates),
            },
            "observability": list(self.observability),
            "limits": self.limits,
            "extended_model": extended_model,
        }


def diagnose(
    logs: Sequence[Log],
    model_file: Model,
    references: Sequence[Log],
    *,
    leave_out: Sequence[str] = (),
    initial_soc_pct: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Find where, which and how far.

    Parameters
    ----------
    logs : sequence of Log
        Logs that the model does not explain, sharing one cause.
    model_file : Model
    references : sequence of Log
        Logs on which the model is known to be good.
    leave_out : sequence of str
        Effects that the library is to be without.
    initial_soc_pct : float, optional
        SoC at each diagnosed log's first row [%].
    progress : callable, optional
        Called with a line of text before each long step.

    Raises
    ------
    InputError
        If a log cannot be diagnosed: too short, of another pack, counted out of 0–100 %.
    """
    say = progress or _silent
    settled = build_problem(
        logs,
        model_file,
        references,
        library_without(leave_out),
        initial_soc_pct=initial_soc_pct,
        progress=progress,
    )
    held_out = folds(settled)
    if not held_out:
        raise InputError(
            f"{logs[0].duration_s:.0f} s are too short to leave rows out and judge on them:"
            " nothing can be concluded",
            source=logs[0].source or logs[0].name,
            cure="give a log of at least 10 min, better half an hour with changing load and SoC",
        )
    say("weighing the evidence")
    verdict = decide(settled)
    accepted = [score.effect_id for score in verdict.accepted]
    say("judging on rows left out")
    judged = judge(settled, held_out, accepted)
    floor = _floor_v(settled, model_file)
    baseline = rms(np.concatenate([item.baseline_v for item in judged]))
    extended = rms(np.concatenate([item.extended_v for item in judged]))
    is_gap = verdict.cause != NONE
    say("extending the model")
    extension = extend(settled, verdict.accepted)
    say("running the estimator with either model")
    better = model_file_of(extension, model_file, extended)
    clean_v2 = settled.error.clean_v2
    _, given_v = settled.given_errors_v
    return Diagnosis(
        settled=settled,
        verdict=verdict,
        baseline_rmse_v=baseline,
        extended_rmse_v=extended,
        floor_v=floor,
        stated_v=model_file.noise.voltage_rmse_v,
        explainable_v=float(np.sqrt(clean_v2)) if clean_v2 > 0.0 else None,
        baseline_soc_mae_pct=soc_mae_pct(logs, model_file),
        extended_soc_mae_pct=soc_mae_pct(logs, better),
        closed=closed_fraction(baseline, extended, floor) if is_gap else None,
        closed_ci=closed_interval(settled, judged, floor) if is_gap else None,
        where=tuple(places(settled.diagnosed, given_v, model_file.capacity_ah)),
        worst=tuple(worst_moments(settled.diagnosed, given_v)),
        candidates=tuple(_candidates(settled, held_out, verdict, floor, extension)),
        observability=tuple(_observability(settled)),
        extension=extension,
    )


def _candidates(
    settled: DiagnosisProblem,
    held_out: Sequence[Fold],
    verdict: Verdict,
    floor: float,
    extension: Extension,
) -> list[dict[str, Any]]:
    result = []
    for number, score in enumerate(verdict.candidates):
        judged = judge(settled, held_out, [score.effect_id]) if number < SHOWN else []
        result.append(
            {
                "effect": score.effect_id,
                "probability": verdict.chances[score.effect_id],
                "log_bayes_factor": score.log_bayes_factor,
                **_errors(settled, judged, floor),
                "parameters": cause_parameters(score, settled, extension),
            }
        )
    return result


def _errors(settled: DiagnosisProblem, judged: Sequence[Judged], floor: float) -> dict[str, Any]:
    if not judged:
        return {"rmse_v": None, "closed_fraction": None, "ci": None}
    baseline = rms(np.concatenate([item.baseline_v for item in judged]))
    extended = rms(np.concatenate([item.extended_v for item in judged]))
    interval = closed_interval(settled, judged, floor)
    return {
        "rmse_v": extended,
        "closed_fraction": closed_fraction(baseline, extended, floor),
        "ci": None if interval is None else list(interval),
    }


def _floor_v(settled: DiagnosisProblem, model_file: Model) -> float:
    """Return the model's error on the references, or what the model file states without any."""
    if not settled.references:
        return model_file.noise.voltage_rmse_v
    return rms(np.concatenate(settled.given_errors_v[0]))


def _observability(settled: DiagnosisProblem) -> list[dict[str, object]]:
    """Return how much of each effect's physical range these logs could show.

    `visible` is 1 less the smallest amplitude that would have the evidence of `ACCEPT_LOG_BAYES`,
    as far as references stray, in parts of the bounds.
    """
    evidence = gather(settled.frame, settled.reference_grams, settled.judged_grams, settled.error)
    best: dict[str, float] = {}
    needs: dict[str, str] = {}
    for k, choice in enumerate(settled.frame.choices):
        if not choice.effect.is_cause:
            continue
        at = evidence.of(k)
        strays = settled.error.strays.get(choice.effect.id, 1.0)
        information = np.diag(evidence.curvature[at, at]) / strays
        reach = np.abs(choice.bounds).max(axis=1)
        smallest = np.sqrt(2.0 * (ACCEPT_LOG_BAYES + 2.0) / np.maximum(information, 1e-30)) / reach
        visible = float(np.clip(1.0 - smallest.min(), 0.0, 1.0))
        best[choice.effect.id] = max(best.get(choice.effect.id, 0.0), visible)
        needs[choice.effect.id] = choice.effect.separated_by
    return [
        {"effect": effect_id, "visible": visible, "needs": needs[effect_id]}
        for effect_id, visible in sorted(best.items(), key=lambda item: -item[1])
    ]


def in_words(diagnosis: Diagnosis) -> str:
    """Return the verdict in one sentence."""
    verdict, references = diagnosis.verdict, diagnosis.settled.references
    floor = "references show" if references else "the model file states"
    gap = f"{diagnosis.baseline_rmse_v:.2f} V where {floor} {diagnosis.floor_v:.2f} V"
    if verdict.cause == NONE:
        if references and diagnosis.baseline_rmse_v > diagnosis.floor_v:
            gap += f", {diagnosis.extended_rmse_v:.2f} V with what they teach"
        beyond = "references show or explain" if references else "model file states"
        if verdict.probability < EVEN or not diagnosis.settled.covered:
            chance = f"that there is none has a probability of {verdict.probability:.2f}"
            return f"No gap that is certain beyond what the {beyond} ({gap}); {chance}."
        return f"No gap beyond what the {beyond} ({gap})."
    if verdict.cause == UNKNOWN:
        return f"A gap ({gap}) that no effect in the library is likely to be the cause of."
    alike = (
        f", not to be told from {', '.join(verdict.ambiguous_with)}"
        if verdict.ambiguous_with
        else ""
    )
    after = f"with it {diagnosis.extended_rmse_v:.2f} V on rows left out"
    if diagnosis.extended_rmse_v > diagnosis.baseline_rmse_v:
        after += ", more than without"
    healthy = ""
    if not diagnosis.settled.covered and verdict.cause in OF_TEMPERATURE:
        healthy = (
            " No reference has these temperatures, and there healthy cells do so as well: it tells"
            " no fault."
        )
    return (
        f"{gap}: {verdict.cause} (probability {verdict.probability:.2f}{alike}); {after}.{healthy}"
    )


def _silent(_text: str) -> None:
    """Say nothing."""
