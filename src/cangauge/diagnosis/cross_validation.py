"""Cross-validation of the gap: errors on rows that the fit of the effects did not see.

Of several logs each is left out in turn. A single log is divided into blocks of 240 s, of which
every fourth is left out in turn, with 60 s on either side that neither fit nor evaluation uses.
Each row is evaluated once, but for rows of a log of few minutes that leave no others to fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.diagnosis.bayes_factors import scores
from cangauge.diagnosis.hypotheses import prior_precision
from cangauge.diagnosis.linear_gaussian import NormalEquations, Posterior, marginalize
from cangauge.diagnosis.problem import DiagnosisProblem
from cangauge.estimation.offline import run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.inference.rows import BLOCK_GUARD_S, BLOCK_S
from cangauge.logs.log import Log
from cangauge.logs.resample import resample
from cangauge.model.model_file import Model

FOLDS = 4
"""One block of a single log in this number is left out in turn."""

PIECE_S = 300.0
"""Length of the pieces that the bootstrap draws, beyond the correlation of errors [s]."""

DRAWS = 400
"""Draws of the bootstrap."""

SETTLING_S = 300.0
"""Start of a log, with withheld initial SoC, that the SoC error leaves out [s]."""

SOC_EVERY_S, SOC_PART = 60.0, 0.5
"""A log has a reference SoC if this part of its minutes has a value; one value is only its
start."""


@dataclass(frozen=True, eq=False)
class Fold:
    """Posterior without some rows, and the rows of one log to evaluate it on."""

    posterior: Posterior
    log: int
    """Number of the diagnosed log."""
    rows: NDArray[np.bool_]
    """Mask, shape (m,)."""


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """Errors on held-out rows of one log."""

    time_s: FloatArray
    baseline_v: FloatArray
    """Of the given model."""
    extended_v: FloatArray
    """With the structure of the references and some effects."""


def folds(problem: DiagnosisProblem) -> list[Fold]:
    """Return the folds of the diagnosed logs; none for one log that is too short."""
    logs, equations = problem.diagnosed, problem.diagnosed_equations
    held_out: list[tuple[list[NormalEquations], int, NDArray[np.bool_]]] = []
    if len(logs) > 1:
        for number, matrix in enumerate(logs):
            rest = [log for k, log in enumerate(equations) if k != number]
            held_out.append((rest, number, np.ones(matrix.residual_v.size, dtype=bool)))
    else:
        elapsed = logs[0].sampled.rows.time_s - logs[0].sampled.rows.time_s[0]
        around = [elapsed + shift_s for shift_s in (-BLOCK_GUARD_S, 0.0, BLOCK_GUARD_S)]
        fold_of = [np.clip(time_s, 0.0, elapsed[-1]) // BLOCK_S % FOLDS for time_s in around]
        for fold in range(FOLDS):
            rows = fold_of[1] == fold
            fitted = np.all([each != fold for each in fold_of], axis=0)
            if rows.any() and fitted.any():
                held_out.append(([problem.equations_of(logs[0], 1.0 * fitted)], 0, rows))
    references = problem.reference_equations
    return [
        Fold(marginalize(problem.hypotheses, references, rest, problem.error), number, rows)
        for rest, number, rows in held_out
    ]


def held_out_errors(
    problem: DiagnosisProblem, held_out: Sequence[Fold], effects: Sequence[str]
) -> list[HeldOutErrors]:
    """Return the errors with some effects, each fold fitted without the rows it is evaluated on.

    Parameters
    ----------
    problem : DiagnosisProblem
    held_out : sequence of Fold
    effects : sequence of str
        Effects to include; their shapes are chosen on the rows of the fit.
    """
    result = []
    for fold in held_out:
        matrix = problem.diagnosed[fold.log]
        extended_v = matrix.residual_v - matrix.voltage(*_solution(fold.posterior, effects))
        result.append(
            HeldOutErrors(
                matrix.sampled.rows.time_s[fold.rows],
                problem.diagnosed_errors_v[fold.log][fold.rows],
                extended_v[fold.rows],
            )
        )
    return result


def _solution(posterior: Posterior, effects: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Return coefficients (p,) and all candidates' amplitudes with some effects."""
    hypotheses = posterior.hypotheses
    p = hypotheses.column_scale.size
    known = {choice.effect.id for choice in hypotheses.candidates}
    others = [effect_id for effect_id in known if effect_id not in effects]
    best = {score.effect_id: score.candidates for score in scores(posterior, leave_out=others)}
    chosen = [k for effect_id in effects for k in best[effect_id]]
    at, bounds = hypotheses.amplitudes_of(chosen), hypotheses.bounds_of(chosen)
    total = posterior.curvature[np.ix_(at, at)] + prior_precision(bounds)
    amplitude = np.linalg.solve(total, posterior.gradient[at])
    amplitude = np.clip(amplitude, bounds[:, 0], bounds[:, 1])
    shared = posterior.mean - posterior.sensitivity[:, at] @ amplitude
    amplitudes = np.zeros(int(hypotheses.offsets[-1]))
    amplitudes[hypotheses.amplitudes_of(hypotheses.structure)] = shared[p:]
    amplitudes[at] += amplitude
    return shared[:p] / hypotheses.column_scale, amplitudes


def rms(values: FloatArray) -> float:
    """Return the root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def closed_fraction(baseline_v: float, extended_v: float, floor_v: float) -> float | None:
    """Return the closed part of the squared gap above the floor; None without a gap."""
    gap = baseline_v**2 - floor_v**2
    if not gap > 0.0:
        return None
    return min((baseline_v**2 - extended_v**2) / gap, 1.0)


def closed_fraction_interval(
    errors: Sequence[HeldOutErrors], floor_v: float
) -> tuple[float, float] | None:
    """Return the 95 % interval of the closed fraction by a block bootstrap; None if undefined."""
    pieces = []
    for item in errors:
        piece = (item.time_s // PIECE_S).astype(np.intp)
        for number in np.unique(piece):
            at = piece == number
            squares = [float(np.sum(part[at] ** 2)) for part in (item.baseline_v, item.extended_v)]
            pieces.append((*squares, float(at.sum())))
    table = np.array(pieces)
    if table.shape[0] < 3:
        return None
    rng = np.random.default_rng(0)
    drawn = table[rng.integers(0, table.shape[0], (DRAWS, table.shape[0]))].sum(axis=1)
    baseline, extended = drawn[:, 0] / drawn[:, 2], drawn[:, 1] / drawn[:, 2]
    gap = baseline - floor_v**2
    usable = gap > 0.0
    if usable.mean() < 0.9:
        return None
    closed = np.minimum((baseline - extended)[usable] / gap[usable], 1.0)
    low, high = np.quantile(closed, [0.025, 0.975])
    return float(low), float(high)


def soc_error_pct(logs: Sequence[Log], model: Model) -> tuple[float, float] | None:
    """Return the estimator's SoC error with withheld initial SoC, and what it states itself [%].

    The estimator runs at the model's rate.

    Parameters
    ----------
    logs : sequence of Log
        Those without a reference SoC throughout are skipped.
    model : Model

    Returns
    -------
    mean_absolute, mean_std : float
        None without any reference SoC.
    """
    found = [_soc_errors_pct(log, model) for log in (resample(log, model.rate_hz) for log in logs)]
    together = np.concatenate([np.zeros((2, 0)), *found], axis=1)
    if not together.size:
        return None
    mean_absolute, mean_std = together.mean(axis=1).tolist()
    return mean_absolute, mean_std


def _soc_errors_pct(log: Log, model: Model) -> FloatArray:
    """Return absolute errors and standard deviations after settling, shape (2, n)."""
    if log.soc_pct is None or not _has_reference_soc(log.time_s, log.soc_pct):
        return np.zeros((2, 0))
    found = run_estimator(samples_of(log), model, EstimatorSettings())
    errors = np.array([np.abs(found.soc_pct - log.soc_pct), found.soc_std_pct])
    known = np.isfinite(errors).all(axis=0) & (log.time_s - log.time_s[0] >= SETTLING_S)
    return errors[:, known]


def _has_reference_soc(time_s: FloatArray, soc_pct: FloatArray) -> bool:
    minute = ((time_s - time_s[0]) // SOC_EVERY_S).astype(np.intp)
    known = np.unique(minute[np.isfinite(soc_pct)]).size
    return known >= SOC_PART * np.unique(minute).size
