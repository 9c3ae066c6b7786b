"""Which pieces of the structure that clean logs share a model needs.

The verdict integrates over all of them; a model that somebody reads and a service runs has few.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.evidence import ErrorModel, Frame, Gram, gather, structure_precision
from cangauge.gap.settle import Settled

FloatArray = NDArray[np.float64]

WORTH_IT = 3.0
"""A further piece must make the references more probable by this, as a logarithm."""

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
    ends = p + np.cumsum([0, *(len(frame.choices[k].amplitudes) for k in frame.repairs)])

    def log_probability(pieces: Sequence[int]) -> float:
        of_pieces = [np.arange(ends[j], ends[j + 1]) for j in pieces]
        at = np.concatenate([np.arange(p), *of_pieces])
        balance = 1.0 / np.sqrt(np.diag(whole.precision)[at])
        root = np.linalg.cholesky(whole.precision[np.ix_(at, at)] * balance * balance[:, None])
        gained = np.linalg.solve(root, balance * right[at])
        volume = np.sum(np.log(np.diag(root))) - np.sum(np.log(balance))
        return float(0.5 * gained @ gained - volume + 0.5 * np.sum(np.log(prior[at[p:] - p])))

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


def with_needed_structure(settled: Settled) -> Settled:
    """Return the common ground with no more structure than the references call for.

    Under the error that is expected of the diagnosed logs: beyond the references' temperatures that
    is a large one, and little is worth a piece. (On winter trips, all that summer trips call for
    made the voltage better and the SoC worse.)
    """
    before = settled.frame
    frame = replace(before, repairs=needed(before, settled.reference_grams, settled.error))
    at = [before.shown.index(k) for k in frame.shown]
    return replace(
        settled,
        frame=frame,
        references=tuple(
            replace(terms, effects=tuple(terms.effects[k] for k in at))
            for terms in settled.references
        ),
    )
