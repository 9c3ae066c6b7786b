"""Single rows that no pack makes: a wrong value between two right ones.

A current of a thousand amperes for one sample, with a voltage that does not move, or a voltage that
jumps under a current that does not, is the sensor's or the bus's. One such row can have more
evidence for an effect than an hour of driving.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cangauge.logs.log import Log
from cangauge.model.extended import ExtendedModel

FloatArray = NDArray[np.float64]

IMPOSSIBLE_PART = 0.1
"""Current and voltage of a row contradict each other by more than this part of the pack's voltage.
Of the 4,711 logs of a check two have such rows, many each: their voltage is noisy in bursts."""

FEW = 5
"""More such rows in one log are no accident, and stay: what makes them is to be found."""

LEAST_OHM, MOST_OHM = 0.5, 3.0
"""Whatever the pack's resistance is between these parts of the model's at once."""

BACK_AGAIN = 0.25
"""The rows before and after differ by less than this part of the jump."""

LARGE_C_RATE = 2.0
"""A smaller jump of current is none [1/h]."""

ANSWER_S, ANSWERED_PART = 5.0, 0.25
"""A pack answers a current within so long [s], a late sensor too, by more than this part of the
drop over its resistance at once."""

SMALLEST = 100
"""In so few rows nothing is usual."""


def without_spikes(log: Log, model: ExtendedModel) -> tuple[Log, NDArray[np.intp]]:
    """Return a log without the few rows that no pack makes, and which these were.

    Parameters
    ----------
    log : Log
    model : ExtendedModel
        Of the pack; its resistance at once and its voltage say what is possible.
    """
    if len(log) < SMALLEST:
        return log, np.zeros(0, dtype=np.intp)
    jump_a, over_a = _jump(log.current_a)
    jump_v, over_v = _jump(log.voltage_v)
    ohm = abs(model.model.resistance_ohm[0])
    # What the resistance leaves unexplained, the sign of a drop being minus that of the current.
    possible_v = np.sort([-LEAST_OHM * ohm * jump_a, -MOST_OHM * ohm * jump_a], axis=0)
    contradicts_v = np.maximum(jump_v - possible_v[1], possible_v[0] - jump_v)
    back_again = (over_a < BACK_AGAIN * np.abs(jump_a)) | (over_v < BACK_AGAIN * np.abs(jump_v))
    impossible = (contradicts_v > IMPOSSIBLE_PART * model.pack.voltage_v) & back_again
    # Or a current that all others together do not span, gone in the next row, and no answer to it.
    ordered = np.sort(log.current_a)
    others_a = ordered[-1 - FEW] - ordered[FEW]
    alone_a = max(float(others_a), LARGE_C_RATE * model.capacity_ah)
    alone = np.flatnonzero(
        (np.abs(jump_a) > alone_a) & (over_a < BACK_AGAIN * np.abs(jump_a)) & ~impossible
    )
    for at in alone:
        near = np.abs(log.time_s - log.time_s[at + 1]) < ANSWER_S
        answer_v = float(np.ptp(log.voltage_v[near]))
        impossible[at] = answer_v < ANSWERED_PART * ohm * np.abs(jump_a[at])
    rows = 1 + np.flatnonzero(impossible)
    if not rows.size or rows.size > FEW:
        return log, rows[:0]
    keep = np.ones(len(log), dtype=bool)
    keep[rows] = False
    return log.rows(keep), rows


def _jump(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far inner rows lie off the mean of their neighbours, and these apart."""
    before, here, after = values[:-2], values[1:-1], values[2:]
    return here - 0.5 * (before + after), np.abs(after - before)
