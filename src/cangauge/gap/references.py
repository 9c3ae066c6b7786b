"""What reference logs say: how far the model strays without a cause.

Everything is judged on whole logs left out: fitted on the other references (and the model's own
information), seen on the one left out. Without at least two references the model file's own noise
stands in.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.columns import OWN, LogTerms
from cangauge.gap.evidence import ErrorModel, Frame, Gram, gather
from cangauge.model.model_file import ModelNoise

FloatArray = NDArray[np.float64]

SOC_STD_PCT = 0.7
"""How well a log's assumed initial SoC is known without a cause [%]."""

SLOW_STD, LEVEL_STD = 0.08, 0.03
"""How much slow polarisation and resistance differ from log to log without a cause, in parts of
the pack's resistance."""

MEMORY_S = 600
"""Over how long residuals may be correlated [s]."""

ALIKE_WITHIN = (20.0, 200.0)
"""Bounds of κ, the rows that tell as much as one."""

OWN_ROUNDS = 6

KNOWN_LOGS = 2.0
"""The model file's noise counts like this many reference logs."""


def error_from_noise(noise: ModelNoise, rate_hz: float) -> ErrorModel:
    """Return the error that a model file states, for want of references."""
    slow_v2, fast_v2 = noise.slow_std_v**2, noise.fast_std_v**2
    total_v2 = max(slow_v2 + fast_v2, 1e-12)
    seconds = (slow_v2 * noise.slow_time_s + fast_v2 * noise.fast_time_s) / total_v2
    return ErrorModel(
        rmse_v=math.sqrt(total_v2),
        rows_alike=float(np.clip(1.0 + 2.0 * seconds * rate_hz, *ALIKE_WITHIN)),
        own_std=_own_std(max(noise.lasting_std_v, 0.25 * math.sqrt(total_v2))),
    )


def _own_std(voltage_v: float) -> tuple[float, ...]:
    return (voltage_v, SOC_STD_PCT, SLOW_STD, LEVEL_STD)


def left_out_errors(
    frame: Frame, terms: Sequence[LogTerms], grams: Sequence[Gram], error: ErrorModel
) -> list[FloatArray]:
    """Return each reference's error under a fit to the others [V], shape (m,) each."""
    errors = []
    for number, log in enumerate(terms):
        others = [gram for k, gram in enumerate(grams) if k != number]
        solution = gather(frame, others, [], error).mean
        errors.append(log.residual_v - _predicted(frame, log, solution))
    return errors


def error_from_references(
    errors: Sequence[FloatArray], stated: ErrorModel, rate_hz: float
) -> ErrorModel:
    """Return the error that references show under fits to the others.

    Parameters
    ----------
    errors : sequence of arrays
        Each reference's left-out error [V].
    stated : ErrorModel
        What the model file says; it counts like `KNOWN_LOGS` logs for what differs between logs.
    rate_hz : float
        Rate of the rows.
    """
    means = np.array([float(values.mean()) for values in errors])
    centred = [values - values.mean() for values in errors]
    within_v2 = float(np.mean(np.concatenate(centred) ** 2))
    # The median, since one reference far outside the others' temperatures tells nothing of theirs.
    usual_v = 1.48 * float(np.median(np.abs(means)))
    between_v2 = (means.size * usual_v**2 + KNOWN_LOGS * stated.own_std[0] ** 2) / (
        means.size + KNOWN_LOGS
    )
    return ErrorModel(
        rmse_v=math.sqrt(max(within_v2, 1e-12)),
        rows_alike=_rows_alike(centred, within_v2, rate_hz),
        own_std=_own_std(math.sqrt(max(between_v2, (0.1 * stated.rmse_v) ** 2))),
    )


def own_from_references(frame: Frame, grams: Sequence[Gram], error: ErrorModel) -> ErrorModel:
    """Return the error with what differs from log to log learned from the references.

    Expectation maximisation on the variance of each of `columns.OWN`; what `error` says of them
    counts like `KNOWN_LOGS` logs.

    Parameters
    ----------
    frame : Frame
    grams : sequence of Gram
        Of the references.
    error : ErrorModel
    """
    stated = np.array(error.own_std)
    shared = frame.scale.size + frame.amplitudes_of(frame.repairs).size
    for _ in range(OWN_ROUNDS):
        evidence = gather(frame, grams, [], error)
        balance = 1.0 / np.sqrt(np.diag(evidence.precision))
        inverse = np.linalg.inv(evidence.precision * balance * balance[:, None])
        variance = (np.diag(inverse) * balance**2)[shared:].reshape(-1, len(OWN))
        mean = evidence.mean[shared:].reshape(-1, len(OWN))
        total = np.sum(mean**2 + variance, axis=0) + KNOWN_LOGS * stated**2
        own = np.sqrt(total / (len(grams) + KNOWN_LOGS))
        error = replace(error, own_std=tuple(own.tolist()))
    return error


def _predicted(frame: Frame, log: LogTerms, solution: FloatArray) -> FloatArray:
    p = frame.scale.size
    volts = (log.baseline / frame.scale) @ solution[:p]
    at = p
    for k in frame.repairs:
        width = log.effects[k].shape[1]
        volts = volts + log.effects[k] @ solution[at : at + width]
        at += width
    return np.asarray(volts)


def _rows_alike(centred: Sequence[FloatArray], variance: float, rate_hz: float) -> float:
    """Return 1 + 2·Σρ over the lags up to `MEMORY_S`, as far as the correlation is positive."""
    lags = round(MEMORY_S * rate_hz)
    total = np.zeros(lags + 1)
    rows = 0
    for values in centred:
        size = values.size
        spectrum = np.abs(np.fft.rfft(values, 2 * size)) ** 2
        covariance = np.fft.irfft(spectrum)[: min(lags + 1, size)]
        total[: covariance.size] += covariance
        rows += size
    correlation = total / (rows * max(variance, 1e-12))
    negative = np.flatnonzero(correlation <= 0.0)
    end = int(negative[0]) if negative.size else correlation.size
    return float(np.clip(1.0 + 2.0 * correlation[1:end].sum(), *ALIKE_WITHIN))
