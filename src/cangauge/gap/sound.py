"""Logs that can be diagnosed: of this pack, alive, given once, without rows that no pack makes.

What cannot be mended is refused, with the cure; what is left out is said.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from cangauge.errors import InputError
from cangauge.gap.spikes import without_spikes
from cangauge.logs.log import Log
from cangauge.model.extended import ExtendedModel

LEAST_PART, MOST_PART = 0.7, 1.4
"""The median voltage of the model's pack lies between these parts of its usual one."""


def sound(
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
        clean, rows = without_spikes(log, model)
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
