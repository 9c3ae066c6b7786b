"""Input checks: refuse logs of another pack, dead channels and duplicates; remove outliers.

An outlier is removed and reported. A count beyond full or empty is diagnosed if some start explains
it. Everything else raises an error.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.inference.rows import SOC_TOLERANCE_PCT, FitOptions
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import counted_soc_pct
from cangauge.model.extended import ExtendedModel

LEAST_PART, MOST_PART = 0.7, 1.4
"""Limits of a log's median voltage relative to the pack's usual voltage."""

CONTRADICTION_PART = 0.1
"""Mismatch between the jumps of current and voltage from which a row is an outlier, in parts of the
pack voltage. Of the 4,711 logs of a check two have such rows, many each: bursts of voltage
noise."""

MAX_OUTLIERS = 5
"""More outliers in one log are not incidental: they stay and are diagnosed."""

LEAST_RESISTANCE, MOST_RESISTANCE = 0.5, 3.0
"""Limits of the pack's immediate resistance relative to the model's."""

RETURN_PART = 0.25
"""The neighbours of an outlier differ by less than this part of its jump."""

LARGE_C_RATE = 2.0
"""Smallest jump of an outlier in current [1/h]."""

RESPONSE_S, RESPONSE_PART = 5.0, 0.25
"""Time within which the voltage responds to a current [s], even with a late sensor, and the part of
the ohmic drop that it reaches."""

MOST_COUNTED_PCT = 150.0
"""Span of the counted SoC that a wrong capacity or current gain explains at most: their physical
bounds are a third of the value."""

MIN_ROWS = 100
"""Rows that a search for outliers needs."""


def check_inputs(
    logs: Sequence[Log], references: Sequence[Log], model: ExtendedModel
) -> tuple[list[Log], list[Log], list[str]]:
    """Return logs and references without outliers, and one sentence for each outlier.

    Raises
    ------
    InputError
        If a log is of another pack, has a dead channel, or is given twice.
    """
    for log in (*logs, *references):
        _check_alive(log)
        _check_pack(log, model)
    for one, other in itertools.combinations((*logs, *references), 2):
        check_distinct(one, other)
    kept, sentences = [], []
    for log in (*logs, *references):
        clean, rows = without_outliers(log, model)
        kept.append(clean)
        sentences += [_outlier_sentence(log, int(row)) for row in rows]
    return kept[: len(logs)], kept[len(logs) :], sentences


def check_count(log: Log, options: FitOptions) -> None:
    """Raise InputError if no start explains a log whose counted SoC leaves 0–100 %.

    A wrong start, capacity or efficiency is a cause to find: the voltage says where the SoC is.
    """
    soc = counted_soc_pct(log, options.capacity_ah, options.initial_soc_pct)
    low, high = float(soc.min()), float(soc.max())
    if low >= -SOC_TOLERANCE_PCT and high <= 100.0 + SOC_TOLERANCE_PCT:
        return
    too_much = high - low > MOST_COUNTED_PCT
    # As the SoC rises so does the voltage, whatever the start.
    if too_much or np.corrcoef(soc, log.voltage_v)[0, 1] < 0.0:
        reason = "no start explains it" if too_much else "the voltage moves the other way"
        raise InputError(
            f"the SoC counted with {options.capacity_ah:.2f} Ah runs from {high:.1f} to"
            f" {low:.1f} %: {reason}",
            source=log.source or log.name,
            field="soc_pct",
            cure="check --capacity-ah and the sign of current (positive must discharge; see"
            " `cangauge inspect`)",
        )


def without_outliers(log: Log, model: ExtendedModel) -> tuple[Log, NDArray[np.intp]]:
    """Return a log without its few physically impossible single rows, and the indices of these.

    Such a row is a fault of sensor or bus: a jump of the current by 1000 A for one sample without
    a response of the voltage, or a jump of the voltage without one of the current. One such row can
    have more evidence for an effect than an hour of driving.

    Parameters
    ----------
    log : Log
    model : ExtendedModel
        Its immediate resistance and voltage define which rows are possible.
    """
    none = np.zeros(0, dtype=np.intp)
    if len(log) < MIN_ROWS:
        return log, none
    jump_a, across_a = _jump(log.current_a)
    jump_v, across_v = _jump(log.voltage_v)
    ohm = abs(model.model.resistance_ohm[0])
    # Mismatch beyond the ohmic drop, whose sign is opposite to the current's.
    drop_v = np.sort([-LEAST_RESISTANCE * ohm * jump_a, -MOST_RESISTANCE * ohm * jump_a], axis=0)
    mismatch_v = np.maximum(jump_v - drop_v[1], drop_v[0] - jump_v)
    returns_a = across_a < RETURN_PART * np.abs(jump_a)
    returns = returns_a | (across_v < RETURN_PART * np.abs(jump_v))
    impossible = (mismatch_v > CONTRADICTION_PART * model.pack.voltage_v) & returns
    # Or a current beyond the span of all others for one row, without a response of the voltage.
    ordered = np.sort(log.current_a)
    span_a = float(ordered[-1 - MAX_OUTLIERS] - ordered[MAX_OUTLIERS])
    least_a = max(span_a, LARGE_C_RATE * model.capacity_ah)
    for at in np.flatnonzero((np.abs(jump_a) > least_a) & returns_a & ~impossible):
        near = np.abs(log.time_s - log.time_s[at + 1]) < RESPONSE_S
        response_v = float(np.ptp(log.voltage_v[near]))
        impossible[at] = response_v < RESPONSE_PART * ohm * np.abs(jump_a[at])
    rows = 1 + np.flatnonzero(impossible)
    if not rows.size or rows.size > MAX_OUTLIERS:
        return log, none
    keep = np.ones(len(log), dtype=bool)
    keep[rows] = False
    return log.rows(keep), rows


def _jump(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return each inner row's deviation from its neighbours' mean, and |difference| of those."""
    before, here, after = values[:-2], values[1:-1], values[2:]
    return here - 0.5 * (before + after), np.abs(after - before)


def _outlier_sentence(log: Log, row: int) -> str:
    values = [
        f"{log.current_a[k]:.0f} A, {log.voltage_v[k]:.1f} V" for k in (row, row - 1, row + 1)
    ]
    return (
        f"{log.name}, row {row + 1} ({log.time_s[row]:.1f} s) was left out as physically"
        f" impossible: {values[0]} between {values[1]} and {values[2]}. The source of such values"
        " is not diagnosed."
    )


def _check_alive(log: Log) -> None:
    for channel, unit in (("current_a", "A"), ("voltage_v", "V")):
        values = getattr(log, channel)
        if np.ptp(values) == 0.0:
            raise InputError(
                f"constant for {log.duration_s / 60.0:.0f} min: no diagnosis is possible",
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
            f"this log is of another pack: the model's has about {usual:.0f} V",
            source=log.source or log.name,
            field="voltage_v",
            value=round(median, 1),
            cure="use the model of this pack",
        )


def check_distinct(one: Log, other: Log) -> None:
    """Raise InputError if two logs have the same rows."""
    if np.array_equal(one.current_a, other.current_a) and np.array_equal(
        one.voltage_v, other.voltage_v
    ):
        raise InputError(
            f"same rows as {other.source or other.name}: they would count twice",
            source=one.source or one.name,
            cure="give each log once, either as LOG or as reference",
        )
