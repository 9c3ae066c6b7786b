"""Errors of the diagnosed logs, row by row: with the model as given and with the extended one.

How far the gap shrinks, on rows that the fit of the effect did not see.

Several logs: each is left out in turn. One log: blocks of 240 s, every fourth left out in turn, the
last one never; the middle 120 s of those left out judge, with 60 s on either side.

The gap in SoC: the online estimator over the diagnosed logs, before and after.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.diagnosis.bayes_factors import scores
from cangauge.diagnosis.design_matrix import DesignMatrix
from cangauge.diagnosis.linear_gaussian import Evidence, Gram, gather, gram_of
from cangauge.diagnosis.problem import DiagnosisProblem
from cangauge.estimate.offline import run_estimator, samples_of
from cangauge.estimate.settings import EstimatorSettings
from cangauge.inference.linearized import residual
from cangauge.inference.rows import SampledLog
from cangauge.logs.log import Log
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model

# --- Errors of the diagnosed logs, row by row: with the model as given and with the extended…


@dataclass(frozen=True, eq=False)
class LogErrors:
    """One diagnosed log; m rows at the model's rate."""

    prepared: SampledLog
    before_v: FloatArray
    """Measured − model as given, shape (m,) [V]."""
    after_v: FloatArray
    """Measured, corrected by what the model knows of the sensors, − extended model [V]."""


def errors_before_and_after(settled: DiagnosisProblem, extended: ExtendedModel) -> list[LogErrors]:
    """Return the errors of every diagnosed log.

    Those after are of rows that the extended model was fitted on; how far the gap shrinks is
    judged on rows left out (`held_out`).

    Parameters
    ----------
    settled : DiagnosisProblem
    extended : ExtendedModel
        Of the diagnosis (`Extension.model`).
    """
    _, given = settled.given_errors_v
    return [
        LogErrors(terms.prepared, before, residual(terms.prepared, extended))
        for terms, before in zip(settled.diagnosed, given, strict=True)
    ]


# --- How far the gap shrinks, on rows that the fit of the effect did not see

BLOCK_S, GUARD_S, FOLDS = 240.0, 60.0, 4
PIECE_S = 300.0
"""Errors further apart than this are drawn apart in the bootstrap [s]."""

DRAWS = 400


@dataclass(frozen=True, eq=False)
class Judged:
    """Errors of the model as it is, and of the extended one, on rows left out."""

    log: int
    """Which of the diagnosed logs."""
    keep: NDArray[np.bool_]
    """Rows of the log, shape (m,)."""
    baseline_v: FloatArray
    extended_v: FloatArray


@dataclass(frozen=True, eq=False)
class Fold:
    """What the other rows say, and the rows that judge it."""

    evidence: Evidence
    rows: tuple[tuple[int, NDArray[np.bool_]], ...]
    """Which of the diagnosed logs, and which rows of it, shape (m,)."""


def folds(settled: DiagnosisProblem) -> list[Fold]:
    """Return the evidence without some rows, in turn, with those rows; none for a log too short.

    Parameters
    ----------
    settled : DiagnosisProblem
    """
    return [
        Fold(gather(settled.frame, settled.reference_grams, fit_on, settled.error), tuple(judged))
        for fit_on, judged in _folds(settled)
    ]


def judge(
    settled: DiagnosisProblem, held_out: Sequence[Fold], effects: Sequence[str]
) -> list[Judged]:
    """Return the errors with some effects added, each fitted without the rows that judge it.

    Parameters
    ----------
    settled : DiagnosisProblem
    held_out : sequence of Fold
        From `folds`.
    effects : sequence of str
        Effects to add, in order; their shapes are chosen on the rows of the fit.
    """
    result = []
    _, given = settled.given_errors_v
    for fold in held_out:
        solution = solution_with(fold.evidence, effects)
        for number, keep in fold.rows:
            terms = settled.diagnosed[number].at(keep)
            result.append(
                Judged(
                    number, keep, given[number][keep], terms.residual_v - _volts(terms, solution)
                )
            )
    return result


def solution_with(evidence: Evidence, effects: Sequence[str]) -> FloatArray:
    """Return coefficients of baseline and all amplitudes, shape (p + amplitudes,).

    Parameters
    ----------
    evidence : Evidence
    effects : sequence of str
        Effects of the diagnosed logs; the others' amplitudes are zero.
    """
    frame = evidence.frame
    p = frame.scale.size
    others = [key for key in {choice.effect.id for choice in frame.choices} if key not in effects]
    best = {score.effect_id: score.candidates for score in scores(evidence, leave_out=others)}
    chosen = [k for effect_id in effects for k in best[effect_id]]
    whole = np.zeros(p + int(frame.first[-1]))
    at = frame.amplitudes_of(chosen)
    bounds = frame.bounds_of(chosen)
    precision = np.diag((4.0 / (bounds[:, 1] - bounds[:, 0])) ** 2)
    amplitude = np.linalg.solve(
        evidence.curvature[np.ix_(at, at)] + precision, evidence.gradient[at]
    )
    amplitude = np.clip(amplitude, bounds[:, 0], bounds[:, 1])
    shared = evidence.mean - evidence.per_amplitude[:, at] @ amplitude
    repairs = frame.amplitudes_of(frame.repairs)
    whole[:p] = shared[:p]
    whole[p + repairs] = shared[p : p + repairs.size]
    whole[p + at] += amplitude
    whole[:p] /= frame.scale
    return whole


def _volts(terms: DesignMatrix, solution: FloatArray) -> FloatArray:
    return np.column_stack([terms.baseline, *terms.effects]) @ solution


def _folds(
    settled: DiagnosisProblem,
) -> list[tuple[list[Gram], list[tuple[int, NDArray[np.bool_]]]]]:
    logs = settled.diagnosed
    grams = settled.diagnosed_grams
    if len(logs) > 1:
        return [
            (
                [gram for k, gram in enumerate(grams) if k != number],
                [(number, np.ones(terms.residual_v.size, dtype=bool))],
            )
            for number, terms in enumerate(logs)
        ]
    terms = logs[0]
    time_s = terms.prepared.rows.time_s
    elapsed = time_s - time_s[0]
    block = (elapsed // BLOCK_S).astype(np.intp)
    since = elapsed % BLOCK_S
    folds = []
    for fold in range(FOLDS):
        mine = (block % FOLDS == fold) & (block < block[-1])
        core = mine & (since >= GUARD_S) & (since < BLOCK_S - GUARD_S)
        if core.any():
            rest = gram_of(terms, settled.frame.scale, 1.0 - mine)
            folds.append(([rest.weakened(settled.hardness(terms))], [(0, core)]))
    return folds


def rms(values: FloatArray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def closed_fraction(baseline: float, extended: float, floor: float) -> float | None:
    """Return the part of the squared gap above the floor that is closed; None without a gap."""
    gap = baseline**2 - floor**2
    if not gap > 0.0:
        return None
    return min((baseline**2 - extended**2) / gap, 1.0)


def closed_interval(
    settled: DiagnosisProblem, judged: Sequence[Judged], floor: float
) -> tuple[float, float] | None:
    """Return a 95 % interval of the closed fraction, by a bootstrap over pieces of the logs."""
    pieces = []
    for item in judged:
        time_s = settled.diagnosed[item.log].prepared.rows.time_s[item.keep]
        piece = (time_s // PIECE_S).astype(np.intp)
        for number in np.unique(piece):
            at = piece == number
            pieces.append(
                (
                    float(np.sum(item.baseline_v[at] ** 2)),
                    float(np.sum(item.extended_v[at] ** 2)),
                    float(at.sum()),
                )
            )
    table = np.array(pieces)
    if table.shape[0] < 3:
        return None
    rng = np.random.default_rng(0)
    drawn = table[rng.integers(0, table.shape[0], (DRAWS, table.shape[0]))].sum(axis=1)
    baseline, extended = drawn[:, 0] / drawn[:, 2], drawn[:, 1] / drawn[:, 2]
    gap = baseline - floor**2
    usable = gap > 0.0
    if usable.mean() < 0.9:
        return None
    closed = np.minimum((baseline - extended)[usable] / gap[usable], 1.0)
    low, high = np.quantile(closed, [0.025, 0.975])
    return float(low), float(high)


# --- The gap in SoC: the online estimator over the diagnosed logs, before and after

SETTLED_S = 300.0
"""The estimate is judged from here on, its initial SoC withheld [s]."""

TOLD_EVERY_S, TOLD_PART = 60.0, 0.5
"""A log tells its SoC if it does in this part of its minutes: one value is where it starts."""


def soc_mae_pct(logs: Sequence[Log], model: Model) -> float | None:
    """Return the EKF's mean absolute error, initial SoC withheld [%]; None without reference.

    Parameters
    ----------
    logs : sequence of Log
        Those that tell their SoC all along are judged.
    model : Model
        Plain or extended: what `cangauge run` would run.
    """
    errors = []
    for log in logs:
        if log.soc_pct is None or not _tells(log.time_s, log.soc_pct):
            continue
        found = run_estimator(samples_of(log), model, EstimatorSettings())
        error = np.abs(found.soc_pct - log.soc_pct)
        errors.append(error[np.isfinite(error) & (log.time_s - log.time_s[0] >= SETTLED_S)])
    together = np.concatenate(errors) if errors else np.zeros(0)
    return float(together.mean()) if together.size else None


def _tells(time_s: FloatArray, soc_pct: FloatArray) -> bool:
    minute = ((time_s - time_s[0]) // TOLD_EVERY_S).astype(np.intp)
    told = np.unique(minute[np.isfinite(soc_pct)]).size
    return told >= TOLD_PART * np.unique(minute).size
