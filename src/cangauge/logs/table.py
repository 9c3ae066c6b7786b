"""Any table, of text or Arrow, as a draft of a log.

A table with the names of the canonical log defines its columns. In any other they are found by
plain headings or named by the user; what the headings leave open is assumed, and stated in
`DraftLog.assumed`; the sign of current is then found from the data. Rows may hold all channels, or
only those that changed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._typing import FloatArray, IntArray
from cangauge.errors import InputError
from cangauge.logs import stamps
from cangauge.logs.column_map import (
    Choice,
    ChosenColumn,
    ColumnMap,
    choose_columns,
    shown_headings,
    unknown_columns,
)
from cangauge.logs.draft import MAX_INCOMPLETE, DraftLog
from cangauge.logs.headings import meaning_of
from cangauge.logs.text import MISSING, TextTable, is_number
from cangauge.logs.units import FIELDS, REQUIRED, convert, known_temperature_source, unit_of

SOURCE: Final = "temperature_source"
"""Column or metadata of a canonical log: the location of the temperature sensor."""
_CANONICAL: Final = (*FIELDS.values(), SOURCE)
_CANONICAL_UNIT: Final = dict(zip(FIELDS, ("s", "A", "V", "°C", "%"), strict=True))
_HOLD_S: Final = 1.0
"""Longest time that a voltage is held to the next row with a current [s], where rows hold only the
channels that changed: a bus repeats both within it."""
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
    units: Sequence[str] = ()
    remarks: list[str] = field(default_factory=list)

    def columns(self, places: Sequence[int]) -> dict[int, Any]:
        """Return columns by place."""
        table = self.read([self.headings[place] for place in places])
        return {place: table.column(self.headings[place]) for place in places}


def is_canonical(headings: Sequence[str]) -> bool:
    """Return whether columns have the names of a canonical log's, possibly an incomplete one.

    A temperature of another name is not a missing one: such a table is a logger's own.
    """
    names = {name.strip().lower() for name in headings}
    meanings = (meaning_of(name) for name in names - {*_CANONICAL})
    others = any(meaning is not None and meaning.quantity == "temperature" for meaning in meanings)
    others = others or any("temperature" in name for name in names - {*_CANONICAL})
    return len(names & set(REQUIRED)) >= 2 and ("temperature_c" in names or not others)


def draft_of_table(
    table: TextTable | ArrowTable, given: ColumnMap | None, *, name: str, source: str
) -> DraftLog:
    """Return the draft of a log from a table; `given` are the user's columns.

    Raises
    ------
    InputError
        If a column is not found, or holds anything but values of its quantity.
    """
    where = source or name
    headings = list(table.headings)
    draft = DraftLog(name, source, headings=tuple(headings))
    defined = given is None and is_canonical(headings)
    if defined:
        choice = _canonical_choice(headings, where)
    else:
        choice = choose_columns(headings, table.units, given)
        if not choice.is_complete:
            raise unknown_columns(where, headings, choice)
    wanted = [place for column in choice.chosen.values() for place in column.places]
    time = choice.chosen["time"]
    if not time.given:  # dates that may belong to a column of clock times
        meanings = ((place, meaning_of(heading)) for place, heading in enumerate(headings))
        wanted += [place for place, m in meanings if m and m.quantity == "time"]
    lower = [heading.strip().lower() for heading in headings]
    wanted += [lower.index(SOURCE)] if defined and SOURCE in lower else []
    columns = table.columns([*dict.fromkeys(wanted)])
    time_s, how, time = _time(columns, time, headings, where)
    choice.chosen["time"] = time
    draft.values["time_s"] = time_s
    for quantity, column in choice.chosen.items():
        label = " + ".join(headings[place] for place in column.places)
        draft.labels[FIELDS[quantity]] = label
        unit = how if quantity == "time" else _take(draft, quantity, column, columns)
        if quantity == "temperature" and len(column.places) > 1:
            unit += ", the median"
        factor = "" if column.factor == 1.0 else f" × {column.factor:g}"
        shown = label if len(label) <= 80 else f"{label[:80]}…"
        draft.assumed.append(f'{quantity} = "{shown}"{factor} [{unit}]')
    used = {place for column in choice.chosen.values() for place in column.places}
    draft.ignored = tuple(text for k, text in enumerate(headings) if text and k not in used)
    draft.remarks[:0] = table.remarks
    if defined:
        draft.assumed = []
        draft.ignored = tuple(n for n in headings if n and n.strip().lower() not in _CANONICAL)
        word = _only_word(columns[lower.index(SOURCE)], where) if SOURCE in lower else ""
        word = word or getattr(table, "word", "") or "unknown"
        draft.temperature_source = known_temperature_source(word, source=where, field=SOURCE)
    else:
        draft.sign_unknown = choice.chosen["current"].factor > 0.0
        if "temperature" in choice.chosen:
            draft.temperature_source = choice.chosen["temperature"].source
        _hold_changes(draft)
    return draft


def _canonical_choice(headings: Sequence[str], where: str) -> Choice:
    """Return the columns of a canonical log by their names."""
    names = [name.strip().lower() for name in headings]
    for name in _CANONICAL:
        if names.count(name) > 1:
            raise InputError(
                f"{names.count(name)} columns have this name",
                source=where,
                field=name,
                cure="rename or drop all but one",
            )
        if name in REQUIRED[:3] and name not in names:
            raise InputError(
                f"this column is missing (found: {shown_headings(headings)})",
                source=where,
                field=name,
                cure="a log needs time_s, current_a (positive = discharge), voltage_v,"
                " temperature_c [s, A, V, °C]",
            )
    return Choice(
        {
            quantity: ChosenColumn((names.index(name),), _CANONICAL_UNIT[quantity], given=True)
            for quantity, name in FIELDS.items()
            if name in names
        }
    )


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
    headings = [draft.headings[place] for place in column.places]
    label = draft.labels[name]
    parts = [
        numbers_of(columns[place], where, heading)
        for place, heading in zip(column.places, headings, strict=True)
    ]
    unit = column.unit
    for in_cells in sorted({unit for _, unit in parts} - {""}):
        if unit and unit_of(name, in_cells) != unit_of(name, unit):
            raise InputError(
                "the cells have another unit than the heading",
                source=where,
                field=label,
                value=f"{in_cells}, heading {unit}",
                cure=f"state the right one: --columns '{quantity}=HEADING[UNIT]'",
            )
        unit = unit or in_cells
    values = parts[0][0] * column.factor
    if quantity == "soc":
        finite = values[np.isfinite(values)]
        if not unit and finite.size and finite.min() >= 0.0 and 0.0 < finite.max() <= 1.0:
            draft.values[name] = 100.0 * values
            return "0–1, from its range"
        if {"Gids", "AHr", "Pack Volts"} <= set(draft.headings) and np.nanmedian(values) > 110.0:
            draft.remarks.append("LeafSpy log: SoC in 0.0001 %")
            values = values * _LEAF_SPY_SOC
    if quantity == "temperature":
        probes = [
            convert(part * column.factor, name, unit, source=where, label=label)[0]
            for part, _ in parts
        ]
        draft.take_probes(headings, probes)
    else:
        draft.values[name], _ = convert(values, name, unit, source=where, label=label)
    return unit or f"{_CANONICAL_UNIT[quantity]}, assumed"


def numbers_of(column: Any, source: str, label: str) -> tuple[FloatArray, str]:
    """Return a column as numbers, NaN where missing, and the unit in its cells (`53.2 V`).

    Raises
    ------
    InputError
        If a cell holds anything but a number, or the column has another type.
    """

    def error(problem: str, value: object, cure: str) -> InputError:
        return InputError(problem, source=source, field=label, value=value, cure=cure)

    kind, of = column.type, pa.types
    is_text = _is_text(kind)
    is_number_type = of.is_integer(kind) or of.is_floating(kind) or of.is_decimal(kind)
    if not (is_text or is_number_type or of.is_null(kind)):
        cure = "store it as floating point"
        raise error("the column does not hold numbers", str(kind)[:60], cure)
    unit = ""
    try:
        try:
            numbers = pc.cast(column, pa.float64(), safe=False)
        except pa.ArrowInvalid:
            bare, unit = _without_unit(_with_decimal_point(_present(column)))
            numbers = pc.cast(bare, pa.float64())
    except pa.ArrowInvalid as problem:
        shown = enumerate(_present(column).to_pylist(), start=1)
        wrong = ((k, text) for k, text in shown if text and not is_number(text.replace(",", ".")))
        row, value = next(wrong, (1, None))
        cure = "correct the cell, or leave it empty where the value is unknown"
        raise error(f"row {row} is not a number", value, cure) from problem
    return np.array(numbers.to_numpy(), dtype=np.float64), unit


def _is_text(kind: Any) -> bool:
    """Return whether an Arrow type is text, dictionary-encoded or not."""
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    return str(kind) in {"string", "large_string", "string_view"}


def _present(column: Any) -> Any:
    """Return the trimmed cells of a column of text, null where there is no value."""
    trimmed = pc.utf8_trim_whitespace(column.cast(pa.string()))
    missing = pc.is_in(pc.utf8_lower(trimmed), value_set=pa.array(["", *MISSING]))
    return pc.if_else(missing, pa.scalar(None, pa.string()), trimmed)


def _with_decimal_point(cells: Any) -> Any:
    """Return cells with `.` as the decimal mark; the other mark separates thousands."""
    both = pc.and_(pc.match_substring(cells, ","), pc.match_substring(cells, "."))
    if pc.any(both).as_py():
        german = r"^[^,]*,[^,.]*$"  # 1.234,5
        is_comma = pc.any(pc.match_substring_regex(pc.filter(cells, both), german)).as_py()
        cells = pc.replace_substring(cells, "." if is_comma else ",", "")
    return pc.replace_substring(cells, ",", ".")


def _without_unit(cells: Any) -> tuple[Any, str]:
    """Return cells without a unit that all of them carry (`53.2 V`), and the unit."""
    pattern = r"^(?P<number>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(?P<unit>\D{1,4})$"
    parts = pc.extract_regex(cells, pattern)
    if pc.any(pc.and_(pc.is_null(parts), pc.is_valid(cells))).as_py():
        return cells, ""
    parts = parts.combine_chunks() if isinstance(parts, pa.ChunkedArray) else parts
    units = pc.drop_null(pc.unique(parts.field("unit"))).to_pylist()
    return (parts.field("number"), units[0].strip()) if len(units) == 1 else (cells, "")


# --- Time


def _time(
    columns: dict[int, Any], column: ChosenColumn, headings: Sequence[str], where: str
) -> tuple[FloatArray, str, ChosenColumn]:
    """Return time [s], how it was read, and its column; of several, the first that increases."""
    place = column.places[0]
    if not column.given and stamps.is_clock(_first(columns[place])):  # with the dates beside it
        texts = {other: _first(columns[other]) for other in sorted(set(columns) - {place})}
        dates = [k for k, text in texts.items() if ":" not in text and not is_number(text)]
        date = next((k for k in dates if stamps.is_stamp(texts[k])), None)
        column = column if date is None else replace(column, places=(date, place), others=())
    label = " + ".join(headings[place] for place in column.places)
    first = _seconds([columns[place] for place in column.places], column, where, label)
    for place in () if _increases(first[0]) else column.others:
        meaning = meaning_of(headings[place])
        other = replace(column, places=(place,), unit=meaning.unit if meaning else "")
        with suppress(InputError):
            values, how = _seconds([columns[place]], other, where, headings[place])
            if _increases(values):
                return values, how, other
    return *first, column


def _first(column: Any) -> str:
    """Return the first value of a column of text; "" of any other."""
    if not _is_text(column.type):
        return ""
    return next((str(cell.as_py()) for cell in column if cell.is_valid), "")


def _increases(time_s: FloatArray) -> bool:
    finite = time_s[np.isfinite(time_s)]
    return finite.size > 1 and bool(np.all(np.diff(finite) >= 0.0)) and finite[-1] > finite[0]


def _seconds(
    parts: Sequence[Any], column: ChosenColumn, source: str, label: str
) -> tuple[FloatArray, str]:
    """Return a time column, or a date and its time, as seconds, and how it was read."""
    kind = parts[0].type
    unit = "" if stamps.is_time_format(column.unit) else column.unit
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
        per_second = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[kind.unit]
        counts = parts[0].cast(pa.int64()).cast(pa.float64(), safe=False).to_numpy()
        return np.asarray(counts, dtype=np.float64) / per_second, unit or str(kind)
    if pa.types.is_date(kind):
        parts = [parts[0].cast(pa.string()), *parts[1:]]
    if len(parts) == 1:
        cells = _present(parts[0]) if _is_text(parts[0].type) else None
        if cells is None or is_number(_first(cells).replace(",", ".") or "0"):
            values, _ = numbers_of(parts[0], source, label)
            return stamps.seconds_of_numbers(values * column.factor, unit)
    else:
        cells = pc.binary_join_element_wise(*(part.cast(pa.string()) for part in parts), " ")
    form = column.unit if stamps.is_time_format(column.unit) else ""
    return stamps.seconds_of_text(cells, form, source, label)


# --- Rows that hold only what changed


def _hold_changes(draft: DraftLog) -> None:
    """Hold the latest voltage and temperature at each current, if rows hold only what changed."""
    values = draft.values
    time, current, voltage = (values[name] for name in REQUIRED[:3])
    temperature = values.get("temperature_c", time)
    whole = np.isfinite(time + current + voltage + temperature)
    at = np.flatnonzero(np.isfinite(time + current))
    if np.mean(whole) >= 1.0 - MAX_INCOMPLETE or not at.size:
        return
    latest_v, age_s = held(time, voltage, at)
    near = age_s <= _HOLD_S
    if np.mean(near) < 0.5:
        return
    at = at[near]
    draft.values = {"time_s": time[at], "current_a": current[at], "voltage_v": latest_v[near]}
    for name in values.keys() - draft.values.keys():
        draft.values[name], _ = held(time, values[name], at)
    if "temperature_c" in values:  # before the first value, the first
        known = draft.values["temperature_c"][np.isfinite(draft.values["temperature_c"])]
        np.nan_to_num(
            draft.values["temperature_c"], nan=known[0] if known.size else np.nan, copy=False
        )
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
