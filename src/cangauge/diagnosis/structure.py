"""Structure that the references need beyond the voltage model, and the model with it.

The verdict marginalises over all structure. A model file has only the few pieces (candidates of the
shared structure) that make the references more probable.

Structure changes the factors of coefficients: cells warmer than their sensor change the voltage by
kt times the rise, so the columns of a model with another kt cannot give both at once. Coefficients
and structure are therefore solved for repeatedly about the last solution (Gauss–Newton), until the
references are no less probable than under the first one.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.diagnosis.design_matrix import DesignMatrix, candidates_for, design_matrix
from cangauge.diagnosis.hypotheses import Hypotheses
from cangauge.diagnosis.linear_gaussian import (
    ErrorModel,
    NormalEquations,
    References,
    SharedEquations,
    constrained_mode,
    log_likelihood,
    marginalize,
    normal_equations,
    shared_equations,
    structure_precision,
    with_change,
)
from cangauge.inference.rows import SampledLog
from cangauge.model.effects.library import Candidate
from cangauge.model.extended import ExtendedModel

MIN_LOG_GAIN = 3.0
"""Increase of the references' log probability that a further piece needs."""

NEGLIGIBLE = 1e-3
"""Size, in parts of its bounds, below which a piece is left out of a model."""

MAX_PIECES = 14
"""More pieces made no measurable difference."""

MAX_STEPS = 3
"""Gauss–Newton steps. Without convergence the step with the most probable references is taken."""


@dataclass(frozen=True, eq=False)
class ReferenceModel:
    """Model as the references know it, and their equations about it."""

    model: ExtendedModel
    """With their coefficients, without their structure."""
    structured: ExtendedModel | None
    """With both; None if its pseudo-OCV would not rise."""
    hypotheses: Hypotheses
    total: SharedEquations
    """Of all references."""
    equations: tuple[NormalEquations, ...] = ()
    """Of each; empty where only the sum is kept."""


def learn_structure(
    references: Sequence[SampledLog],
    model: ExtendedModel,
    hypotheses: Hypotheses,
    equations: SharedEquations,
    error: ErrorModel,
) -> ReferenceModel:
    """Learn coefficients and structure from the references.

    Parameters
    ----------
    references : sequence of SampledLog
    model : ExtendedModel
        Model as given.
    hypotheses : Hypotheses
    equations : SharedEquations
        Of the references, linearised about `model`.
    error : ErrorModel
    """
    target, best = log_likelihood(hypotheses, equations, error) - MIN_LOG_GAIN, -np.inf
    # Coefficients first: with too small a kt in the columns, a temperature rise is overestimated.
    start = ReferenceModel(model, None, hypotheses, equations)
    moved, about = _with_coefficients(start, error)
    last = found = replace(_linearized(references, moved, None, about, error), equations=())
    for left in reversed(range(MAX_STEPS)):
        step = _step(references, last, error)
        probability = log_likelihood(step.hypotheses, step.total, error)
        if probability >= target or (probability > best and left == 0):
            return step
        last = replace(step, equations=())
        del step  # the products of each reference take ten megabytes
        if probability > best:
            found, best = last, probability
    return _linearized(references, found.model, found.structured, found.hypotheses, error)


def _step(
    references: Sequence[SampledLog], last: ReferenceModel, error: ErrorModel
) -> ReferenceModel:
    """Solve for coefficients and structure with columns about the last solution."""
    structured = _structured(last.model, last.hypotheses, last.total, error)
    model, hypotheses = _with_coefficients(last, error)
    return _linearized(references, model, structured, hypotheses, error)


def _with_coefficients(last: ReferenceModel, error: ErrorModel) -> tuple[ExtendedModel, Hypotheses]:
    """Return the model with the references' coefficients, and the hypotheses about it."""
    hypotheses = last.hypotheses
    posterior = marginalize(hypotheses, last.total, [], error)
    solution, _ = constrained_mode(posterior, last.model.model, [])
    change = solution[: hypotheses.column_scale.size]
    voltage_model = with_change(last.model.model, change)
    if voltage_model is None:
        return last.model, hypotheses
    mean = hypotheses.prior_mean
    mean = np.zeros(change.size) if mean is None else mean
    return (
        replace(last.model, model=voltage_model),
        replace(hypotheses, prior_mean=mean - change * hypotheses.column_scale),
    )


def _structured(
    model: ExtendedModel,
    hypotheses: Hypotheses,
    references: References,
    error: ErrorModel,
) -> ExtendedModel | None:
    """Return the model with the references' coefficients and needed structure, or None."""
    pieces = select_structure(hypotheses, references, error)
    whole = marginalize(hypotheses, references, [], error)
    p = hypotheses.column_scale.size
    spans = dict(zip(hypotheses.structure, _spans(hypotheses), strict=True))
    at = np.concatenate([np.arange(p), *(np.arange(*spans[k]) for k in pieces)])
    precision = whole.precision[np.ix_(at, at)]
    balance = 1.0 / np.sqrt(np.diag(precision))
    right = (whole.precision @ whole.mean)[at]
    mean = balance * np.linalg.solve(precision * balance * balance[:, None], balance * right)
    selected = replace(hypotheses, structure=pieces)
    posterior = replace(
        whole,
        hypotheses=selected,
        precision=precision,
        mean=mean,
        sensitivity=whole.sensitivity[at],
    )
    solution, _ = constrained_mode(posterior, model.model, [])
    voltage_model = with_change(model.model, solution[:p])
    if voltage_model is None:
        return None
    return with_structure(replace(model, model=voltage_model), selected, solution[p:])


def select_structure(
    hypotheses: Hypotheses, references: References, error: ErrorModel
) -> tuple[int, ...]:
    """Return the pieces of structure that the references need, most needed first.

    Forward selection: each step adds the piece that makes the references most probable together
    with the pieces selected before, with all amplitudes and coefficients marginalised.
    """
    whole = marginalize(hypotheses, references, [], error)
    right = whole.precision @ whole.mean
    p = hypotheses.column_scale.size
    prior = structure_precision(hypotheses, error)
    pieces = [np.arange(*span) - p for span in _spans(hypotheses)]
    # What the coefficients and the pieces chosen so far leave of the rest.
    known = np.linalg.solve(whole.precision[:p, :p], whole.precision[:p, p:])
    precision = whole.precision[p:, p:] - whole.precision[p:, :p] @ known
    right = right[p:] - known.T @ right[:p]
    chosen: list[int] = []
    while len(chosen) < min(MAX_PIECES, len(pieces)):
        rest = [j for j in range(len(pieces)) if j not in chosen]
        gains = _log_gains(precision, right, prior, [pieces[j] for j in rest])
        if gains.max() < MIN_LOG_GAIN:
            break
        chosen.append(rest[int(np.argmax(gains))])
        at = pieces[chosen[-1]]
        known = np.linalg.solve(precision[np.ix_(at, at)], precision[at])
        right = right - known.T @ right[at]
        precision = precision - precision[:, at] @ known
    return tuple(hypotheses.structure[j] for j in chosen)


def _log_gains(
    precision: FloatArray,
    right: FloatArray,
    prior: FloatArray,
    pieces: Sequence[NDArray[np.intp]],
) -> FloatArray:
    """Return the increase of the log probability by each piece's amplitudes, shape (pieces,)."""
    gains, widths = np.empty(len(pieces)), np.array([piece.size for piece in pieces])
    for width in np.unique(widths):
        of_width = np.flatnonzero(widths == width)
        at = np.stack([pieces[j] for j in of_width.tolist()])
        blocks, toward = precision[at[:, :, None], at[:, None, :]], right[at]
        mode = np.linalg.solve(blocks, toward[..., None])[..., 0]
        volume = np.linalg.slogdet(blocks)[1] - np.sum(np.log(prior[at]), axis=1)
        gains[of_width] = 0.5 * (np.sum(toward * mode, axis=1) - volume)
    return gains


def with_structure(
    model: ExtendedModel, hypotheses: Hypotheses, amplitudes: FloatArray
) -> ExtendedModel:
    """Return a model with the structure that is not negligible.

    Parameters
    ----------
    model : ExtendedModel
    hypotheses : Hypotheses
    amplitudes : array
        Of the whole structure, in order, relative to the neutral values.
    """
    at = 0
    totals: dict[tuple[object, ...], tuple[Candidate, FloatArray]] = {}
    for k in hypotheses.structure:
        candidate = hypotheses.candidates[k]
        amplitude = amplitudes[at : at + len(candidate.amplitudes)]
        at += amplitude.size
        # Candidates of one shape differ in the size that their columns were linearised at.
        key = (candidate.effect.id, *candidate.shape.items())
        totals[key] = (candidate, amplitude + (totals[key][1] if key in totals else 0.0))
    for candidate, total in totals.values():
        low, high = candidate.bounds[:, 0], candidate.bounds[:, 1]
        amplitude = np.clip(total, low, high)
        if np.any(np.abs(amplitude) > NEGLIGIBLE * (high - low)):
            # Bounds depend on the pack, which changes with the coefficients.
            values = candidate.effect.clipped(candidate.values(amplitude), model.pack)
            model = model.with_effect(candidate.effect, values)
    return model


def _spans(hypotheses: Hypotheses) -> list[tuple[int, int]]:
    """Return the first and last (exclusive) index of each piece's amplitudes in a solution."""
    widths = [len(hypotheses.candidates[k].amplitudes) for k in hypotheses.structure]
    ends = hypotheses.column_scale.size + np.cumsum([0, *widths])
    return list(itertools.pairwise(ends.tolist()))


def reference_matrix(
    reference: SampledLog,
    model: ExtendedModel,
    hypotheses: Hypotheses,
    structured: ExtendedModel | None = None,
) -> DesignMatrix:
    """Return a reference's design matrix, with the columns `Hypotheses.reference_columns`."""
    columns = hypotheses.reference_columns
    unique = tuple(dict.fromkeys(columns))
    candidates = candidates_for(hypotheses.candidates, model.pack, reference)
    matrix = design_matrix(reference, model, [candidates[k] for k in unique], structured)
    return replace(matrix, effects=tuple(matrix.effects[unique.index(k)] for k in columns))


def reference_equations(
    references: Iterable[SampledLog],
    model: ExtendedModel,
    hypotheses: Hypotheses,
    structured: ExtendedModel | None = None,
) -> Iterator[NormalEquations]:
    """Yield each reference's normal equations; one design matrix is in memory at a time."""
    for item in references:
        matrix = reference_matrix(item, model, hypotheses, structured)
        yield reference_normal_equations(matrix, hypotheses)


def _linearized(
    references: Sequence[SampledLog],
    model: ExtendedModel,
    structured: ExtendedModel | None,
    hypotheses: Hypotheses,
    error: ErrorModel,
) -> ReferenceModel:
    equations = tuple(reference_equations(references, model, hypotheses, structured))
    total = shared_equations(hypotheses, equations, error)
    return ReferenceModel(model, structured, hypotheses, total, equations)


def reference_normal_equations(
    matrix: DesignMatrix, hypotheses: Hypotheses, weight: FloatArray | None = None
) -> NormalEquations:
    """Return a reference's normal equations; columns that have two roles are multiplied once."""
    columns = hypotheses.reference_columns
    first = [columns.index(k) for k in dict.fromkeys(columns)]
    unique = replace(matrix, effects=tuple(matrix.effects[k] for k in first))
    equations = normal_equations(unique, hypotheses.column_scale, weight)
    return equations.columns(hypotheses.reference_places)
