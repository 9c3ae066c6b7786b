"""Single rows that no pack makes: a wrong value between two right ones.

A current of a thousand amperes for one sample, with a voltage that does not move, or a voltage that
jumps under a current that does not, is the sensor's or the bus's. One such row can have more
evidence for an effect than an hour of driving.

Logs that can be diagnosed: of this pack, alive, given once, without rows that no pack makes.

What cannot be mended is refused, with the cure; what is left out is said.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.model.extended import ExtendedModel

# --- Single rows that no pack makes: a wrong value between two right ones

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


def without_outliers(log: Log, model: ExtendedModel) -> tuple[Log, NDArray[np.intp]]:
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


# --- Logs that can be diagnosed: of this pack, alive, given once, without rows that no pack …

LEAST_PART, MOST_PART = 0.7, 1.4
"""The median voltage of the model's pack lies between these parts of its usual one."""


def check_inputs(
    logs: Sequence[Log], references: Sequence[Log], model: ExtendedModel
) -> tuple[list[Log], list[Log], list[str]]:
    """Return logs and references without rows that no pack makes, and what is to be said of it.

    Parameters
    ----------
    logs, references : sequence of Log
    model : ExtendedModel

    Raises
    ------
    InputError
        If one is of another pack, has a dead channel, or is given twice.
    """
    for log in (*logs, *references):
        _check_alive(log)
        _check_pack(log, model)
    for one, other in itertools.combinations((*logs, *references), 2):
        _check_apart(one, other)
    kept, said = [], []
    for log in (*logs, *references):
        clean, rows = without_outliers(log, model)
        kept.append(clean)
        said += [_sentence(log, int(row)) for row in rows]
    return kept[: len(logs)], kept[len(logs) :], said


def _sentence(log: Log, row: int) -> str:
    current, voltage = log.current_a, log.voltage_v
    return (
        f"{log.name}, row {row + 1} ({log.time_s[row]:.1f} s): {current[row]:.0f} A and"
        f" {voltage[row]:.1f} V between {current[row - 1]:.0f} A, {voltage[row - 1]:.1f} V and"
        f" {current[row + 1]:.0f} A, {voltage[row + 1]:.1f} V. No pack makes one such row: it was"
        " left out, and what gives such values is not diagnosed."
    )


def _check_alive(log: Log) -> None:
    for channel, unit in (("current_a", "A"), ("voltage_v", "V")):
        values = getattr(log, channel)
        if np.ptp(values) == 0.0:
            raise InputError(
                f"never changes in {log.duration_s / 60.0:.0f} min: nothing can be concluded",
                source=log.source or log.name,
                field=channel,
                value=f"{values[0]:g} {unit}",
                cure="check the signal, or give a log in which the pack is used",
            )


def _check_pack(log: Log, model: ExtendedModel) -> None:
    usual = model.pack.voltage_v
    median = float(np.median(log.voltage_v))
    if not LEAST_PART * usual <= median <= MOST_PART * usual:
        raise InputError(
            f"the model's pack has about {usual:.0f} V",
            source=log.source or log.name,
            field="voltage_v",
            value=round(median, 1),
            cure="nothing can be concluded from a log of another pack: give its own model",
        )


def _check_apart(one: Log, other: Log) -> None:
    if np.array_equal(one.current_a, other.current_a) and np.array_equal(
        one.voltage_v, other.voltage_v
    ):
        raise InputError(
            f"holds the same rows as {other.source or other.name}: they would count twice",
            source=one.source or one.name,
            cure="give each log once, and as a LOG or as a reference",
        )
