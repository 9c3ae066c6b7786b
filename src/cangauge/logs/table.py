"""Any table, of text or Arrow, as a draft of a log.

A table with the names of the canonical log defines its columns. In any other they are found by
plain headings or named by the user; what the headings leave open is assumed, and stated in
`DraftLog.assumed`; the sign of current is then found from the data. Rows may hold all channels, or
only those that changed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._typing import FloatArray, IntArray
from cangauge.errors import InputError
from cangauge.logs.cells import first_text, is_clock, is_date, numbers_of, seconds_of
from cangauge.logs.column_map import (
    SOURCE,
    ChosenColumn,
    ColumnMap,
    choose_columns,
    is_canonical,
    shown_headings,
)
from cangauge.logs.draft import MAX_INCOMPLETE, DraftLog
from cangauge.logs.text import TextTable
from cangauge.logs.units import FIELDS, REQUIRED, convert, known_temperature_source

_CANONICAL_UNIT: Final = dict(zip(FIELDS, ("s", "A", "V", "°C", "%"), strict=True))
_HOLD_S: Final = 1.0
"""Longest time that a voltage is held to the next row with a current [s], where rows hold only the
channels that changed: a bus repeats both within it."""
_LEAF_SPY: Final = frozenset({"Gids", "AHr", "Pack Volts"})
_LEAF_SPY_SOC: Final = 1e-4
"""LeafSpy writes SoC in ten-thousandths of a percent."""


@dataclass(frozen=True, slots=True)
class ArrowTable:
    """Columns of an Arrow table or file; `read` returns a pyarrow.Table of some of them.

    `word` is the temperature source that the metadata state.
    """

    headings: Sequence[str]
    read: Callable[[list[str]], Any]
    word: str = ""
    units: ClassVar[Sequence[str]] = ()
    remarks: ClassVar[Sequence[str]] = ()

    def columns(self, places: Sequence[int]) -> dict[int, Any]:
        """Return columns by place."""
        table = self.read([self.headings[place] for place in places])
        return {place: table.column(self.headings[place]) for place in places}


def draft_of_table(
    table: TextTable | ArrowTable, given: ColumnMap | None, *, name: str, source: str
) -> DraftLog:
    """Return the draft of a log from a table; `given` are the user's columns.

    Raises
    ------
    InputError
        If a column is not found, or holds anything but values of its quantity.
    """
    headings, where = list(table.headings), source or name
    draft = DraftLog(name, source, headings=tuple(headings))
    names = [heading.strip().lower() for heading in headings]
    defined = given is None and is_canonical(headings)
    for missing in REQUIRED[:3]:
        if defined and missing not in names:
            raise InputError(
                f"this column is missing (found: {shown_headings(headings)})",
                source=where,
                field=missing,
                cure="a log needs time_s, current_a (positive = discharge), voltage_v,"
                " temperature_c [s, A, V, °C]",
            )
    chosen = choose_columns(headings, table.units, given, source=where)
    word_at = [names.index(SOURCE)] if defined and SOURCE in names else []
    places = [k for each in (*chosen.values(), *chosen["time"].others) for k in each.places]
    columns = table.columns([*dict.fromkeys([*places, *word_at])])
    draft.remarks.extend(table.remarks)
    chosen["time"], draft.values["time_s"], how = _time(columns, chosen["time"], headings, where)
    for quantity, column in chosen.items():
        label = " + ".join(headings[place] for place in column.places)
        draft.labels[FIELDS[quantity]] = label
        unit = how if quantity == "time" else _take(draft, quantity, column, columns)
        factor = "" if column.factor == 1.0 else f" × {column.factor:g}"
        shown = label if len(label) <= 80 else f"{label[:80]}…"
        if not (defined and label.strip().lower() == FIELDS[quantity]):
            draft.assumed.append(f'{quantity} = "{shown}"{factor} [{unit}]')
    used = {*word_at, *(place for column in chosen.values() for place in column.places)}
    draft.ignored = tuple(text for k, text in enumerate(headings) if text and k not in used)
    if defined:
        word = _only_word(columns[word_at[0]], where) if word_at else getattr(table, "word", "")
        draft.temperature_source = known_temperature_source(
            word or "unknown", source=where, field=SOURCE
        )
    else:
        draft.sign_unknown = chosen["current"].factor > 0.0
        if "temperature" in chosen:
            draft.temperature_source = chosen["temperature"].source
        _hold_changes(draft)
    return draft


def _only_word(column: Any, where: str) -> str:
    words = {str(word).strip().lower() for word in pc.unique(column.cast(pa.string())).to_pylist()}
    words -= {"", "none"}
    if len(words) > 1:
        problem = "the column must hold one word throughout"
        raise InputError(problem, source=where, field=SOURCE, value=sorted(words)[:3])
    return words.pop() if words else ""


# --- Quantities


def _take(draft: DraftLog, quantity: str, column: ChosenColumn, columns: dict[int, Any]) -> str:
    """Take a quantity in its canonical unit; return the unit that was read or assumed."""
    name, where = FIELDS[quantity], draft.source or draft.name
    headings, label = [draft.headings[place] for place in column.places], draft.labels[name]
    numbers = [numbers_of(columns[place], where, draft.headings[place]) for place in column.places]
    unit = next((in_cells for _, in_cells in numbers if in_cells), column.unit)
    parts = [values * column.factor for values, _ in numbers]
    if quantity == "soc":
        finite = parts[0][np.isfinite(parts[0])]
        if not unit and finite.size and finite.min() >= 0.0 and 0.0 < finite.max() <= 1.0:
            draft.values[name] = 100.0 * parts[0]
            return "0–1, from its range"
        if _LEAF_SPY.issubset(draft.headings) and np.nanmedian(parts[0]) > 110.0:
            draft.remarks.append("LeafSpy log: SoC in 0.0001 %")
            parts[0] *= _LEAF_SPY_SOC
    parts = [convert(part, name, unit, source=where, label=label)[0] for part in parts]
    draft.values[name] = parts[0]
    if len(parts) > 1:
        draft.take_probes(headings, parts)
    read = unit or f"{_CANONICAL_UNIT[quantity]}, assumed"
    return f"{read}, the median" if len(parts) > 1 else read


# --- Time


def _time(
    columns: dict[int, Any], column: ChosenColumn, headings: Sequence[str], where: str
) -> tuple[ChosenColumn, FloatArray, str]:
    """Return the column of time, its values [s], and how they were read.

    Of several columns it is the first that increases; clock times have the dates beside them.
    """
    texts = {k: first_text(columns[k]) for one in (column, *column.others) for k in one.places}
    if column.others and is_clock(texts[column.places[0]]):
        date = next((k for k, text in texts.items() if is_date(text) and ":" not in text), None)
        column = column if date is None else ChosenColumn((date, *column.places), column.unit)

    def read(one: ChosenColumn) -> tuple[ChosenColumn, FloatArray, str]:
        label = " + ".join(headings[place] for place in one.places)
        parts = [columns[place] for place in one.places]
        return one, *seconds_of(parts, one.unit, one.factor, where, label)

    first = read(column)
    for other in () if _increases(first[1]) else column.others:
        with suppress(InputError):
            found = read(other)
            if _increases(found[1]):
                return found
    return first


def _increases(time_s: FloatArray) -> bool:
    finite = time_s[np.isfinite(time_s)]
    return finite.size > 1 and bool(np.all(np.diff(finite) >= 0.0)) and finite[-1] > finite[0]


# --- Rows that hold only what changed


def _hold_changes(draft: DraftLog) -> None:
    """Hold the latest voltage and temperature at each current, if rows hold only what changed."""
    values = draft.values
    time, current, voltage = (values[name] for name in REQUIRED[:3])
    whole = np.isfinite(time + current + voltage + values.get("temperature_c", 0.0))
    at = np.flatnonzero(np.isfinite(time + current))
    _, age_s = held(time, voltage, at)
    near = age_s <= _HOLD_S
    if np.mean(whole) >= 1.0 - MAX_INCOMPLETE or 2 * near.sum() < at.size or not at.size:
        return
    at = at[near]
    draft.values = {name: held(time, column, at)[0] for name, column in values.items()}
    if "temperature_c" in values:  # before the first value, the first
        held_c = draft.values["temperature_c"]
        known = held_c[np.isfinite(held_c)]
        np.nan_to_num(held_c, nan=known[0] if known.size else np.nan, copy=False)
    draft.remarks.append(
        f"rows hold only what changed: {at.size} rows with a current kept, with the latest voltage"
        f" (at most {float(age_s[near].max()):.2g} s old) and temperature"
    )


def held(time: FloatArray, values: FloatArray, at: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the latest known value at some rows, and its age [s]; NaN and infinity before any."""
    known = np.flatnonzero(np.isfinite(values) & np.isfinite(time))
    latest = np.searchsorted(known, at, side="right") - 1
    if not known.size:
        return np.full(at.size, np.nan), np.full(at.size, np.inf)
    row = known[np.maximum(latest, 0)]
    before = latest < 0
    return np.where(before, np.nan, values[row]), np.where(before, np.inf, time[at] - time[row])
