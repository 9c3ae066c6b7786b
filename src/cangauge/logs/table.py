"""Any table, of text or Arrow, by plain headings or the columns of the user.

What the headings leave open is assumed, and stated in `DraftLog.assumed`; the sign of current is
then found from the data. Rows may hold all channels, or only those that changed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Protocol

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
    unknown_columns,
)
from cangauge.logs.draft import MAX_INCOMPLETE, PROBES_APART_K, DraftLog
from cangauge.logs.headings import meaning_of
from cangauge.logs.text import MISSING, TextTable, is_number
from cangauge.logs.units import FIELDS, convert, unit_of

HOLD_S: Final = 1.0
"""Longest time that a voltage is held to the next row with a current [s], where rows hold only the
channels that changed: a bus repeats both within it."""
LEAF_SPY_SOC: Final = 1e-4
"""LeafSpy writes SoC in ten-thousandths of a percent."""

_SHOWN_HEADING: Final = 80
"""Longest heading in the line of assumptions [characters]."""
_ASSUMED_UNIT: Final = dict(zip(FIELDS, ("s", "A", "V", "°C", "%"), strict=True))


class Table(Protocol):
    """A table whose columns are read by their place."""

    @property
    def headings(self) -> Sequence[str]:
        """Name of each column."""

    def columns(self, places: Sequence[int]) -> dict[int, Any]:
        """Return pyarrow columns by place."""


def is_text(kind: Any) -> bool:
    """Return whether an Arrow type is text, dictionary-encoded or not."""
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    return str(kind) in {"string", "large_string", "string_view"}


def _present(column: Any) -> Any:
    """Return the trimmed cells of a column of text, null where there is no value."""
    trimmed = pc.utf8_trim_whitespace(column.cast(pa.string()))
    missing = pc.is_in(pc.utf8_lower(trimmed), value_set=pa.array(["", *MISSING]))
    return pc.if_else(missing, pa.scalar(None, pa.string()), trimmed)


def numbers_of(column: Any, source: str, label: str) -> tuple[FloatArray, str]:
    """Return a column as numbers, NaN where missing, and the unit in its cells (`53.2 V`).

    Raises
    ------
    InputError
        If a cell holds anything but a number, or the column has another type.
    """
    kind, unit = column.type, ""
    is_numeric = any(
        of(kind)
        for of in (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_null)
    )
    if not is_text(kind) and not is_numeric:
        cure = "store it as floating point"
        raise InputError(
            "the column does not hold numbers", source=source, field=label, value=str(kind)[:60],
            cure=cure,
        )  # fmt: skip
    cells = _present(column) if is_text(kind) else column
    try:
        try:
            numbers = pc.cast(cells, pa.float64(), safe=False)
        except pa.ArrowInvalid:
            cells = _with_decimal_point(cells)
            bare, unit = _without_unit(cells)
            numbers = pc.cast(bare, pa.float64())
    except pa.ArrowInvalid as error:
        shown = enumerate(_present(column).to_pylist(), start=1)
        wrong = ((k, text) for k, text in shown if text and not is_number(text.replace(",", ".")))
        row, value = next(wrong, (1, None))
        raise InputError(
            f"row {row} is not a number",
            source=source,
            field=label,
            value=value,
            cure="correct the cell, or leave it empty where the value is unknown",
        ) from error
    return np.array(numbers.to_numpy(), dtype=np.float64), unit


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
        cells = _present(parts[0]) if is_text(kind) else None
        first = "" if cells is None else next((c.as_py() for c in cells if c.is_valid), "")
        if cells is None or is_number(first.replace(",", ".")):
            values, _ = numbers_of(parts[0], source, label)
            return stamps.seconds_of_numbers(values * column.factor, unit)
    else:
        cells = pc.binary_join_element_wise(*(each.cast(pa.string()) for each in parts), " ")
    form = column.unit if stamps.is_time_format(column.unit) else ""
    return stamps.seconds_of_text(cells, form, source, label)


# --- Draft of a log


def draft_of(table: Table, choice: Choice, *, name: str, source: str) -> DraftLog:
    """Return the draft of a log from the chosen columns of a table, with what was assumed.

    Raises
    ------
    InputError
        If a column holds anything but values of its quantity.
    """
    where = source or name
    headings = table.headings
    time = choice.chosen["time"]
    places = [place for column in choice.chosen.values() for place in column.places]
    columns = table.columns([*dict.fromkeys([*places, *time.others, *_dates_beside(table, time)])])
    draft = DraftLog(name, source, headings=tuple(headings))
    used = set(places)
    for quantity, chosen in choice.chosen.items():
        column = chosen
        if quantity == "time":
            values, unit, column = _time(columns, chosen, headings, where)
            used.update(column.places)
        else:
            values, unit = _values(draft, quantity, column, columns, where)
        label = " + ".join(headings[place] for place in column.places)
        draft.labels[FIELDS[quantity]] = label
        draft.values[FIELDS[quantity]] = values
        factor = "" if column.factor == 1.0 else f" × {column.factor:g}"
        shown = label if len(label) <= _SHOWN_HEADING else f"{label[:_SHOWN_HEADING]}…"
        draft.assumed.append(f'{quantity} = "{shown}"{factor} [{unit}]')
    if not draft.values["time_s"].size:
        raise InputError("the log holds no rows", source=where, cure="check the export")
    draft.ignored = tuple(h for k, h in enumerate(headings) if h and k not in used)
    draft.sign_unknown = choice.chosen["current"].factor > 0.0
    if "temperature" in choice.chosen:
        draft.temperature_source = choice.chosen["temperature"].source
    _leaf_spy(draft)
    _hold_changes(draft)
    return draft


def _dates_beside(table: Table, time: ChosenColumn) -> list[int]:
    """Return the columns of dates that may belong to a column of clock times."""
    if time.given:
        return []
    meanings = ((k, meaning_of(heading)) for k, heading in enumerate(table.headings))
    return [k for k, m in meanings if m and m.quantity == "time" and k not in time.places]


def _time(
    columns: dict[int, Any], column: ChosenColumn, headings: Sequence[str], where: str
) -> tuple[FloatArray, str, ChosenColumn]:
    """Return time [s], how it was read, and its column; of several, the first that increases."""
    column = _with_date(column, columns)
    label = " + ".join(headings[place] for place in column.places)
    first = _seconds([columns[place] for place in column.places], column, where, label)
    for place in () if _increases(first[0]) else column.others:
        other = replace(column, places=(place,), unit="")
        meaning = meaning_of(headings[place])
        other = replace(other, unit=meaning.unit if meaning else "")
        try:
            values, how = _seconds([columns[place]], other, where, headings[place])
        except InputError:
            continue
        if _increases(values):
            return values, how, other
    return *first, column


def _with_date(column: ChosenColumn, columns: dict[int, Any]) -> ChosenColumn:
    """Return a column of clock times with the column of dates beside it."""
    place = column.places[0]
    if (
        column.given
        or not is_text(columns[place].type)
        or not stamps.is_clock(_first(columns[place]))
    ):
        return column
    for other in sorted(set(columns) - {place}):
        text = _first(columns[other]) if is_text(columns[other].type) else ""
        if ":" not in text and stamps.is_stamp(text) and not is_number(text):
            return replace(column, places=(other, place), others=())
    return column


def _first(column: Any) -> str:
    return next((str(cell.as_py()) for cell in column if cell.is_valid), "")


def _increases(time_s: FloatArray) -> bool:
    finite = time_s[np.isfinite(time_s)]
    return finite.size > 1 and bool(np.all(np.diff(finite) >= 0.0)) and finite[-1] > finite[0]


def _values(
    draft: DraftLog, quantity: str, column: ChosenColumn, columns: dict[int, Any], where: str
) -> tuple[FloatArray, str]:
    """Return a quantity in its canonical unit, and the unit that was read or assumed."""
    canonical = FIELDS[quantity]
    label = " + ".join(draft.headings[place] for place in column.places)
    parts = [numbers_of(columns[place], where, draft.headings[place]) for place in column.places]
    unit = column.unit
    for in_cells in sorted({each for _, each in parts} - {""}):
        if unit and unit_of(canonical, in_cells) != unit_of(canonical, unit):
            raise InputError(
                "the cells have another unit than the heading",
                source=where,
                field=label,
                value=f"{in_cells}, heading {unit}",
                cure=f"state the right one: --columns '{quantity}=HEADING[UNIT]'",
            )
        unit = unit or in_cells
    values = parts[0][0]
    if len(parts) > 1:
        draft.remarks.append(f"{quantity}: mean of {len(parts)} columns")
        names = [draft.headings[place] for place in column.places]
        per_kelvin = abs((unit_of(canonical, unit) or (1.0, 0.0))[0] * column.factor)
        probes = [numbers for numbers, _ in parts]
        values = draft.mean_of_probes(names, probes, PROBES_APART_K / per_kelvin)
    values = values * column.factor
    if quantity == "soc" and not unit:
        finite = values[np.isfinite(values)]
        if finite.size and finite.min() >= 0.0 and 0.0 < finite.max() <= 1.0:
            return 100.0 * values, "0–1, from its range"
    values, _ = convert(values, canonical, unit, source=where, label=label)
    return values, unit or f"{_ASSUMED_UNIT[quantity]}, assumed"


def _leaf_spy(draft: DraftLog) -> None:
    """Rescale the SoC of LeafSpy, known by its other headings."""
    soc = draft.values.get("soc_pct")
    if soc is None or not {"Gids", "AHr", "Pack Volts"} <= set(draft.headings):
        return
    if np.nanmedian(soc) > 110.0:
        draft.values["soc_pct"] = soc * LEAF_SPY_SOC
        draft.remarks.append("LeafSpy log: SoC in 0.0001 %")


def _hold_changes(draft: DraftLog) -> None:
    """Hold the latest voltage and temperature at each current, if rows hold only what changed."""
    values = draft.values
    time, current, voltage = (values[name] for name in ("time_s", "current_a", "voltage_v"))
    temperature = values.get("temperature_c", time)
    whole = np.isfinite(time) & np.isfinite(current) & np.isfinite(voltage)
    at = np.flatnonzero(np.isfinite(time) & np.isfinite(current))
    if np.mean(whole & np.isfinite(temperature)) >= 1.0 - MAX_INCOMPLETE or not at.size:
        return
    latest_v, age_s = held(time, voltage, at)
    near = age_s <= HOLD_S
    if np.mean(near) < 0.5:
        return
    at = at[near]
    found = {"time_s": time[at], "current_a": current[at], "voltage_v": latest_v[near]}
    for name in ("temperature_c", "soc_pct"):
        if name in values:
            found[name], _ = held(time, values[name], at)
    if "temperature_c" in found:
        known = found["temperature_c"][np.isfinite(found["temperature_c"])]
        found["temperature_c"] = np.nan_to_num(
            found["temperature_c"], nan=known[0] if known.size else np.nan
        )
    draft.values = found
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


# --- Tables in memory


@dataclass(frozen=True, slots=True)
class ArrowTable:
    """Columns of an Arrow table, or of a file; `read` returns a pyarrow.Table of some of them."""

    headings: Sequence[str]
    read: Callable[[list[str]], Any]
    units: Sequence[str] = field(default=())

    def columns(self, places: Sequence[int]) -> dict[int, Any]:
        """Return columns by place."""
        table = self.read([self.headings[place] for place in places])
        return {place: table.column(self.headings[place]) for place in places}


def draft_by_headings(
    table: TextTable | ArrowTable, given: ColumnMap | None, *, name: str, source: str
) -> DraftLog:
    """Return the draft of a table by plain headings and the columns of the user.

    Raises
    ------
    InputError
        If a column is not found or does not hold its quantity.
    """
    choice = choose_columns(table.headings, table.units, given)
    if not choice.is_complete:
        raise unknown_columns(source or name, table.headings, choice)
    draft = draft_of(table, choice, name=name, source=source)
    draft.remarks[:0] = getattr(table, "remarks", ())
    return draft
