"""The most probable coefficients, structure and amplitudes that physics allows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cangauge.errors import InputError
from cangauge.gap.evidence import Evidence, prior_precision
from cangauge.identify.least_squares import nearest_rising
from cangauge.identify.voltage_fit import SLOPE_CHECKS
from cangauge.model.voltage_model import (
    BASIS_NAMES,
    SLOPE_AT_LEAST,
    VoltageModel,
    ocv_basis_slope,
)

FloatArray = NDArray[np.float64]


def within_bounds(
    evidence: Evidence, model: VoltageModel, chosen: Sequence[int]
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the most probable coefficients, structure and amplitudes that physics allows.

    One convex problem for all of them, so that what a bound takes from one goes to the others:
    the pseudo-OCV rises over the identified SoC, and structure and effects keep their bounds.

    Parameters
    ----------
    evidence : Evidence
    model : VoltageModel
        That the evidence starts from.
    chosen : sequence of int
        Candidates to be in the model.

    Returns
    -------
    solution : array
        δθ [V, V/K, Ω], then the amplitudes of `frame.repairs`.
    amplitudes : list of arrays
        Of each accepted effect, beside the neutral values.
    """
    frame = evidence.frame
    p, n = frame.scale.size, len(BASIS_NAMES)
    at = frame.amplitudes_of(chosen)
    limits = np.vstack([frame.bounds_of(frame.repairs), frame.bounds_of(chosen)])
    first, size = evidence.precision.shape[0], evidence.precision.shape[0] + at.size
    curvature = evidence.curvature[np.ix_(at, at)] + prior_precision(frame.bounds_of(chosen))
    upper = _root(evidence.precision)
    root, target = np.zeros((size, size)), np.zeros(size)
    root[:first, :first] = upper
    root[:first, first:] = upper @ evidence.per_amplitude[:, at]
    target[:first] = upper @ evidence.mean
    if at.size:
        lower = _root(curvature)
        root[first:, first:] = lower
        target[first:] = lower @ np.linalg.solve(curvature, evidence.gradient[at])
    slopes = ocv_basis_slope(np.linspace(*model.soc_range_pct, SLOPE_CHECKS), model.epsilon)
    rising = np.zeros((SLOPE_CHECKS, size))
    rising[:, :n] = slopes / frame.scale[:n]
    needed = SLOPE_AT_LEAST * model.pseudo_ocv_at(50.0)[0] - slopes @ np.array(model.ocv_v)
    repairs = p + np.arange(limits.shape[0] - at.size)
    bounded = np.concatenate((repairs, first + np.arange(at.size)))
    kept = np.zeros((bounded.size, size))
    kept[np.arange(bounded.size), bounded] = 1.0
    found = nearest_rising(
        root,
        target,
        np.vstack([rising, kept, -kept]),
        np.concatenate((needed, limits[:, 0], -limits[:, 1])),
    )
    solution = found[: p + repairs.size].copy()
    solution[:p] /= frame.scale
    amplitudes, begin = [], first
    for k in chosen:
        end = begin + len(frame.choices[k].amplitudes)
        amplitudes.append(found[begin:end])
        begin = end
    return solution, amplitudes


def _root(matrix: FloatArray) -> FloatArray:
    """Return the upper root R of a positive matrix, RᵀR, balanced by its diagonal."""
    scale = np.sqrt(np.diag(matrix))
    return np.asarray(np.linalg.cholesky(matrix / scale / scale[:, None]).T * scale)


def moved(model: VoltageModel, change: FloatArray) -> VoltageModel | None:
    """Return the model with its coefficients moved; None if its pseudo-OCV would not rise."""
    try:
        return model.with_coefficients(model.coefficients + change)
    except InputError:
        return None
