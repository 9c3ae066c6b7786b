"""Which pieces of the structure that clean logs share a model needs.

The verdict integrates over all of them; a model that somebody reads and a service runs has few.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.bounded import moved, within_bounds
from cangauge.gap.columns import Candidate
from cangauge.gap.evidence import (
    ErrorModel,
    Gram,
    gather,
    log_integral,
    structure_precision,
)
from cangauge.gap.frame import Frame
from cangauge.model.extended import ExtendedModel

FloatArray = NDArray[np.float64]

WORTH_IT = 3.0
"""A further piece must make the references more probable by this, as a logarithm."""

NEGLIGIBLE = 1e-3
"""A piece smaller than this part of its bounds is left out."""

AT_MOST = 14
"""Pieces: more made no difference that was measured."""


def needed(frame: Frame, references: Sequence[Gram], error: ErrorModel) -> tuple[int, ...]:
    """Return the pieces without which the references are less probable, the most needed first.

    Added one by one, each the one that makes the references most probable beside those before it,
    with all amplitudes and coefficients integrated out.

    Parameters
    ----------
    frame : Frame
    references : sequence of Gram
    error : ErrorModel
    """
    whole = gather(frame, references, [], error)
    right = whole.precision @ whole.mean
    prior = structure_precision(frame, error)
    p = frame.scale.size
    ends = _ends(frame)

    def log_probability(pieces: Sequence[int]) -> float:
        of_pieces = [np.arange(*ends[j]) for j in pieces]
        at = np.concatenate([np.arange(p), *of_pieces])
        held = 0.5 * float(np.sum(np.log(prior[at[p:] - p])))
        return log_integral(whole.precision[np.ix_(at, at)], right[at]) + held

    chosen: list[int] = []
    best = log_probability(chosen)
    while len(chosen) < min(AT_MOST, len(frame.repairs)):
        rest = [j for j in range(len(frame.repairs)) if j not in chosen]
        chances = [log_probability([*chosen, j]) for j in rest]
        if max(chances) < best + WORTH_IT:
            break
        best = max(chances)
        chosen.append(rest[int(np.argmax(chances))])
    return tuple(frame.repairs[j] for j in chosen)


def with_pieces(model: ExtendedModel, frame: Frame, amplitudes: FloatArray) -> ExtendedModel:
    """Return a model with the pieces of structure that are not negligible.

    Parameters
    ----------
    model : ExtendedModel
    frame : Frame
        Whose `repairs` are the pieces.
    amplitudes : array
        Of all pieces, in order, beside the neutral ones.
    """
    at = 0
    totals: dict[tuple[object, ...], tuple[Candidate, FloatArray]] = {}
    for k in frame.repairs:
        choice = frame.choices[k]
        amplitude = amplitudes[at : at + len(choice.amplitudes)]
        at += amplitude.size
        # Columns of one shape differ in how large the effect is that they were taken of.
        key = (choice.effect.id, *choice.shape.items())
        totals[key] = (choice, amplitude + (totals[key][1] if key in totals else 0.0))
    for choice, total in totals.values():
        low, high = choice.bounds[:, 0], choice.bounds[:, 1]
        amplitude = np.clip(total, low, high)
        if np.any(np.abs(amplitude) > NEGLIGIBLE * (high - low)):
            # The pack's sizes move with the coefficients, and a file must agree with them.
            values = choice.effect.within(choice.values(amplitude), model.pack)
            model = model.with_effect(choice.effect, values)
    return model


def repaired(
    model: ExtendedModel, frame: Frame, references: Sequence[Gram], error: ErrorModel
) -> ExtendedModel | None:
    """Return the model with the coefficients and the structure that the references call for.

    Parameters
    ----------
    model : ExtendedModel
        That the references' columns were taken of.
    frame : Frame
    references : sequence of Gram
    error : ErrorModel

    Returns
    -------
    ExtendedModel or None
        None if its pseudo-OCV would not rise.
    """
    pieces = needed(frame, references, error)
    whole = gather(frame, references, [], error)
    p = frame.scale.size
    ends = dict(zip(frame.repairs, _ends(frame), strict=True))
    at = np.concatenate([np.arange(p), *(np.arange(*ends[k]) for k in pieces)])
    precision = whole.precision[np.ix_(at, at)]
    balance = 1.0 / np.sqrt(np.diag(precision))
    right = (whole.precision @ whole.mean)[at]
    mean = balance * np.linalg.solve(precision * balance * balance[:, None], balance * right)
    few = replace(
        whole,
        frame=replace(frame, repairs=pieces),
        precision=precision,
        mean=mean,
        per_amplitude=whole.per_amplitude[at],
    )
    solution, _ = within_bounds(few, model.model, [])
    voltage_model = moved(model.model, solution[:p])
    if voltage_model is None:
        return None
    return with_pieces(replace(model, model=voltage_model), few.frame, solution[p:])


def _ends(frame: Frame) -> list[tuple[int, int]]:
    """Return where each piece's amplitudes begin and end in a solution."""
    widths = [len(frame.choices[k].amplitudes) for k in frame.repairs]
    ends = frame.scale.size + np.cumsum([0, *widths])
    return list(itertools.pairwise(ends.tolist()))
