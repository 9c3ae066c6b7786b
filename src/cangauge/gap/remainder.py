"""What is left of logs: by how much, beyond chance, with and without an effect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.evidence import Evidence, Gram, without_own
from cangauge.gap.frame import Frame
from cangauge.gap.scores import Score
from cangauge.identify.scales import SCALES

FloatArray = NDArray[np.float64]

NOISIER = 0.2
"""Errors' variance differs from log to log by this part without a cause."""


def left_over(
    evidence: Evidence, diagnosed: Sequence[Gram], chosen: Sequence[int], amplitude: FloatArray
) -> FloatArray:
    """Return the diagnosed logs' squares once some candidates explain them, shape (SCALES,) [V²].

    Parameters
    ----------
    evidence : Evidence
    diagnosed : sequence of Gram
        Of the diagnosed logs, the last ones of the evidence.
    chosen : sequence of int
        Candidates.
    amplitude : array
        Of all of them, in order.
    """
    frame = evidence.frame
    layout, at = frame.diagnosed, frame.amplitudes_of(chosen)
    solution = evidence.mean - evidence.per_amplitude[:, at] @ amplitude
    known = np.zeros(solution.size + int(frame.first[-1]) + 1)
    known[: solution.size] = -solution
    known[solution.size + at] = -amplitude
    known[-1] = 1.0
    total = np.zeros(SCALES)
    for log in diagnosed:
        _, follows, _ = without_own(log, frame, evidence.error, is_reference=False)
        mine = follows @ known
        weights = np.zeros(log.products.shape[1])
        # A candidate may be structure, a log's own and the cause at once.
        weights[layout.shared] -= solution
        weights[layout.own] -= mine
        weights[layout.effects[at]] -= amplitude
        weights[layout.residual] = 1.0
        total += (log.products @ weights) @ weights
    return total


def kept_v2(
    frame: Frame,
    log: Gram,
    solution: FloatArray,
    chosen: Sequence[int] = (),
    amplitude: FloatArray | None = None,
) -> float:
    """Return a log's mean square error with what is shared and some effects alone [V²].

    What is the log's own is not taken off: it could hide a gap that no effect explains.

    Parameters
    ----------
    frame : Frame
    log : Gram
        With the columns of all of the frame's candidates.
    solution : array
        Coefficients and repairs, as `Evidence.mean`.
    chosen, amplitude : optional
        Candidates and all their amplitudes.
    """
    layout = frame.diagnosed
    weights = np.zeros(log.products.shape[1])
    weights[layout.shared] -= solution
    if amplitude is not None:
        weights[layout.effects[frame.amplitudes_of(chosen)]] -= amplitude
    weights[layout.residual] = 1.0
    return float(np.sum((log.products @ weights) @ weights) / np.sum(log.counts))


def expected_v2(log: Gram, alone: Evidence) -> float:
    """Return the mean square error to expect of a log without a cause [V²].

    Errors as the references have them, what is each log's own, and how surely the references and
    the model file know the coefficients and the structure where this log went.

    Parameters
    ----------
    log : Gram
        With the columns of all of the frame's candidates.
    alone : Evidence
        Of the references alone.
    """
    error, layout = alone.error, alone.frame.diagnosed
    shared, own = layout.shared, layout.own
    products = log.products.sum(axis=0)
    balance = 1.0 / np.sqrt(np.diag(alone.precision))
    spread = np.linalg.inv(alone.precision * balance * balance[:, None])
    spread *= balance * balance[:, None]
    squares = float(np.sum(products[np.ix_(shared, shared)] * spread))
    squares += float(np.diag(products)[own] @ np.array(error.own_std) ** 2)
    squares += float(log.counts @ np.array(error.scale_v2))
    return squares / float(np.sum(log.counts))


def excess(
    evidence: Evidence, diagnosed: Sequence[Gram], clean: float, score: Score | None = None
) -> float:
    """Return by how much the weighted squares of some logs exceed what chance leaves.

    These are the squares of their errors, of what their own terms and the coefficients had to
    give, and of what the references lost by it. Errors count only scale by scale and beyond what
    varies from log to log: a sensor that is a little noisier is no gap.

    Parameters
    ----------
    evidence : Evidence
    diagnosed : sequence of Gram
        The last logs of the evidence.
    clean : float
        Squares of the references alone.
    score : Score, optional
        An effect to add.
    """
    chosen = () if score is None else score.candidates
    amplitude = np.zeros(0) if score is None else score.amplitude
    total = evidence.squares - clean - (0.0 if score is None else score.explained)
    counts = np.sum([gram.counts for gram in diagnosed], axis=0)
    errors = left_over(evidence, diagnosed, chosen, amplitude) / np.array(evidence.error.scale_v2)
    usual = (1.0 + NOISIER) * counts + 2.0 * np.sqrt(2.0 * counts)
    given = max(total - float(errors.sum()), 0.0)
    return given + float(np.sum(np.maximum(errors - usual, 0.0)))
