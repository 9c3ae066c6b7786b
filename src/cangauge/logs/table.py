"""Read any table with plain headings, or with columns named by the user.

The text may have a preamble, a second row of units, `,`, `;`, tab or `|` between the columns and
decimal commas. What the headings leave open is assumed, and stated in `DraftLog.assumed`; the sign
of current is then found from the data. Three shapes are read: a row per time; rows that hold only
the channels that changed (exports of measurement tools); a row per entity and time (exports of
Home Assistant).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._typing import FloatArray, IntArray
from cangauge.errors import InputError
from cangauge.logs.columns import is_number, read_columns
from cangauge.logs.draft import MAX_INCOMPLETE, DraftLog
from cangauge.logs.file_content import FileContent, split_cells
from cangauge.logs.headings import (
    FIELDS,
    Choice,
    ChosenColumn,
    ColumnMap,
    choose_columns,
    meaning_of,
    missing_quantities,
    shown_headings,
    suggestion,
)
from cangauge.logs.stamps import (
    UnreadableStampError,
    is_clock,
    is_stamp,
    is_time_format,
    seconds_of_numbers,
    seconds_of_text,
)
from cangauge.logs.units import convert

DOCS: Final = "docs/logs.md"
"""Page that explains the columns of a log."""

HOLD_S: Final = 1.0
"""Longest time that a voltage is held to the next row with a current [s], where rows hold only the
channels that changed: a voltage follows its current within this time, and a bus repeats both."""

HOLD_ENTITY_S: Final = 60.0
"""The same for recorders that store a value when it changes [s]: no longer than charge is counted
over a gap."""

LEAF_SPY_SOC: Final = 1e-4
"""LeafSpy writes SoC in ten-thousandths of a percent."""

_DELIMITERS: Final = ("\t", ";", ",", "|")
_HEADER_LINES: Final = 160
_CELLS_TRIED: Final = 60_000
"""Cells to search for a header, over all lines and delimiters: bounds the time of a search."""
_SUB_HEADERS: Final = 4
_LONG_FORMAT: Final = ("entity_id", "state", "last_changed")
_QUANTITY_UNITS: Final = {
    "time": "s", "current": "A", "voltage": "V", "temperature": "°C", "soc": "%"
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Layout:
    """Where a text holds its table.

    Parameters
    ----------
    delimiter : str
    headings, units : list of str
        Cells of the header and of the row of units ([] if there is none).
    skip_lines : int
        Lines before the first row of data.
    choice : Choice
    """

    delimiter: str
    headings: list[str]
    units: list[str]
    skip_lines: int
    choice: Choice


class TableColumns(Protocol):
    """Columns of a table in memory or text, by name."""

    @property
    def source(self) -> str:
        """File or table, for messages."""

    def numbers(self, name: str) -> FloatArray:
        """Return a column as numbers, NaN where missing."""

    def stamps(self, name: str) -> Any:
        """Return a column as numbers, or as a pyarrow string array if it holds text."""


def find_layout(content: FileContent, given: ColumnMap | None = None) -> Layout | None:
    """Return where a text holds a table of which time, current and voltage are known, or None.

    Parameters
    ----------
    content : FileContent
    given : ColumnMap, optional
        Columns of the user.

    Raises
    ------
    InputError
        If a column of the user is in no line.
    """
    if given is not None and given.specs and all(_is_number_spec(each) for each in _texts(given)):
        found = _without_header(content, given)
        if found is not None:
            return found
    budget = _CELLS_TRIED
    for joined in (False, True):
        for number, line in enumerate(content.head[:_HEADER_LINES]):
            if not any(char.isalpha() for char in line):
                continue
            for delimiter in _DELIMITERS:
                cells = _cells(content, number, delimiter, joined=joined)
                budget -= len(cells)
                if len(cells) < 3 or budget < 0:
                    continue
                layout = _layout_at(content, number + joined, delimiter, cells, given)
                if layout is not None and layout.choice.is_complete:
                    return layout
    if given is not None and given.specs:
        headings, _ = likely_table(content, None)
        choice = choose_columns(headings, (), given)  # names a heading that is missing
        raise InputError(
            f"no plain heading of {missing_quantities(choice)} (found: {shown_headings(headings)})",
            source=content.path,
            field=given.where,
            cure=f"name it too: {suggestion(headings, choice)} ({DOCS})",
        )
    return None


def _texts(given: ColumnMap) -> list[str]:
    return [spec.text for spec in given.specs.values()]


def _is_number_spec(text: str) -> bool:
    return text.startswith("#")


def _without_header(content: FileContent, given: ColumnMap) -> Layout | None:
    """Return the layout of a table whose columns are given by number, if it has no header."""
    for number, line in enumerate(content.head[:_HEADER_LINES]):
        for delimiter in _DELIMITERS:
            cells = split_cells(line, delimiter)
            if len(cells) >= 3 and sum(_is_value(cell) for cell in cells) > len(cells) / 2:
                before = split_cells(content.head[number - 1], delimiter) if number else []
                if len(before) == len(cells):
                    return None  # a header
                headings = [f"column {k}" for k in range(1, len(cells) + 1)]
                choice = choose_columns(headings, (), given)
                return Layout(delimiter, headings, [], number, choice)
    return None


def _cells(content: FileContent, number: int, delimiter: str, *, joined: bool) -> list[str]:
    line = content.head[number]
    if delimiter not in line:
        return []
    cells = split_cells(line, delimiter)
    if not joined:
        return cells
    if number + 1 >= len(content.head):
        return []
    below = split_cells(content.head[number + 1], delimiter)
    if len(below) != len(cells) or any(_is_value(cell) for cell in below[1:]):
        return []
    return [f"{one} {other}".strip() for one, other in zip(cells, below, strict=True)]


def _layout_at(
    content: FileContent, number: int, delimiter: str, cells: list[str], given: ColumnMap | None
) -> Layout | None:
    """Return the layout if the header is at this line and its columns are complete."""
    try:
        choice = choose_columns(cells, (), given)
    except InputError:
        return None
    if "time" not in choice.chosen:
        return None
    place = choice.chosen["time"].places[-1]
    units: list[str] = []
    first = number + 1
    for below in range(number + 1, min(number + 1 + _SUB_HEADERS, len(content.head))):
        row = split_cells(content.head[below], delimiter)
        if not any(row):
            continue
        if place < len(row) and _is_value(row[place]):
            first = below
            break
        again = choose_columns(cells, row, given)
        if len(again.chosen) >= len(choice.chosen) and any(
            again.chosen[name].unit != column.unit for name, column in choice.chosen.items()
        ):
            units, choice = row, again
    data = split_cells(content.head[first], delimiter) if first < len(content.head) else []
    return Layout(delimiter, cells, units, first, _with_date(choice, cells, data))


def _with_date(choice: Choice, headings: Sequence[str], data: Sequence[str]) -> Choice:
    """Return the choice with a column of dates before a column of clock times."""
    time = choice.chosen["time"]
    place = time.places[0]
    if time.given or place >= len(data) or not is_clock(data[place]):
        return choice
    for k, heading in enumerate(headings[: len(data)]):
        meaning = meaning_of(heading)
        is_date = meaning is not None and meaning.quantity == "time" and ":" not in data[k]
        if k != place and is_date and is_stamp(data[k]) and not is_number(data[k]):
            both = replace(time, places=(k, place), others=())
            return Choice({**choice.chosen, "time": both}, choice.guesses)
    return choice


def _is_value(cell: str) -> bool:
    return is_number(cell.replace(",", ".")) or is_stamp(cell)


def likely_table(content: FileContent, given: ColumnMap | None) -> tuple[list[str], Choice]:
    """Return the likeliest header of a text and its incomplete choice, for messages."""
    for number, line in enumerate(content.head[:_HEADER_LINES]):
        for delimiter in _DELIMITERS:
            if delimiter not in line:
                continue
            values = sum(_is_value(cell) for cell in split_cells(line, delimiter))
            if values < 2 or not number:
                continue
            for above in range(number - 1, max(number - 1 - _SUB_HEADERS, -1), -1):
                cells = split_cells(content.head[above], delimiter)
                if len(cells) >= 3 and sum(meaning_of(cell) is not None for cell in cells) >= 2:
                    return cells, choose_columns(cells, (), given)
            cells = split_cells(content.head[number - 1], delimiter)
            if len(cells) >= 2:
                return cells, choose_columns(cells, (), given)
    return [], Choice({}, {})


def is_table(content: FileContent) -> bool:
    """Return whether a text holds a table with plain headings."""
    return is_long_format(content) or find_layout(content) is not None


def read_table(content: FileContent, given: ColumnMap | None = None) -> DraftLog:
    """Read a table with plain headings, or with the columns of the user.

    Raises
    ------
    InputError
        If a column is not found, or holds anything but values of its quantity.
    """
    if is_long_format(content):
        return read_long_format(content, given)
    layout = find_layout(content, given)
    if layout is None:
        raise unknown_columns(str(content.path), *likely_table(content, given))
    columns = read_columns(
        content,
        wanted_places(layout.choice),
        header=layout.headings,
        delimiter=layout.delimiter,
        skip_lines=layout.skip_lines,
    )
    draft = DraftLog(content.name, str(content.path), remarks=[*columns.remarks])
    fill_draft(draft, layout.choice, layout.headings, columns)
    return draft


def unknown_columns(source: str, headings: Sequence[str], choice: Choice) -> InputError:
    """Return the error for a table whose columns are not plain."""
    return InputError(
        f"no plain heading of {missing_quantities(choice)} (found: {shown_headings(headings)})",
        source=source,
        cure=f"name the columns, e.g. {suggestion(headings, choice)} ({DOCS})",
    )


def wanted_places(choice: Choice) -> dict[str, int]:
    """Return the index of every column to read, by a name for `fill_draft`."""
    wanted = {
        f"{name} {k}": place
        for name, column in choice.chosen.items()
        for k, place in enumerate(column.places)
    }
    time = choice.chosen["time"]
    return wanted | {f"time other {k}": place for k, place in enumerate(time.others)}


def fill_draft(
    draft: DraftLog, choice: Choice, headings: Sequence[str], columns: TableColumns
) -> None:
    """Set the values of a draft from the chosen columns, with its assumptions.

    Parameters
    ----------
    draft : DraftLog
    choice : Choice
        Complete.
    headings : sequence of str
    columns : TableColumns
        Holds the columns of `wanted_places`.
    """
    for name, column in choice.chosen.items():
        label = " + ".join(headings[place] for place in column.places)
        draft.labels[FIELDS[name]] = label
        if name == "time":
            values, unit = _time(draft, column, columns, headings)
            label = draft.labels["time_s"]
        else:
            values, unit = _quantity(draft, name, column, columns)
        draft.values[FIELDS[name]] = values
        factor = "" if column.factor == 1.0 else f" × {column.factor:g}"
        draft.assumed.append(f'{name} = "{label}"{factor} [{unit}]')
    _leaf_spy(draft, headings)
    current = choice.chosen["current"]
    draft.sign_unknown = current.factor > 0.0
    draft.temperature_source = _source_of(choice)
    _drop_or_hold(draft, HOLD_S)


def _source_of(choice: Choice) -> Any:
    column = choice.chosen.get("temperature")
    return "unknown" if column is None else column.source


def _quantity(
    draft: DraftLog, name: str, column: ChosenColumn, columns: TableColumns
) -> tuple[FloatArray, str]:
    field = FIELDS[name]
    parts = [columns.numbers(f"{name} {k}") for k in range(len(column.places))]
    values = parts[0]
    if len(parts) > 1:
        stacked = np.vstack(parts)
        known = np.isfinite(stacked)
        count = np.sum(known, axis=0)
        total = np.sum(np.where(known, stacked, 0.0), axis=0)
        values = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        draft.remarks.append(f"{name}: mean of {len(parts)} columns")
    values = values * column.factor
    unit = column.unit
    finite = values[np.isfinite(values)]
    if (
        name == "soc"
        and not unit
        and finite.size
        and 0.0 < finite.max() <= 1.0
        and finite.min() >= 0
    ):
        return 100.0 * values, "0–1, from its range"
    label = draft.labels[field]
    converted, _ = convert(values, field, unit, source=draft.source or draft.name, label=label)
    return converted, unit or f"{_QUANTITY_UNITS[name]}, assumed"


def _time(
    draft: DraftLog, column: ChosenColumn, columns: TableColumns, headings: Sequence[str]
) -> tuple[FloatArray, str]:
    """Return time [s] and how it was read; of several time columns, the first that increases."""
    first = _seconds(draft, column, columns, [f"time {k}" for k in range(len(column.places))])
    for k, place in enumerate(column.others):
        if _increases(first[0]):
            break
        draft.labels["time_s"] = headings[place]
        try:
            other = _seconds(draft, column, columns, [f"time other {k}"])
        except InputError:
            continue
        if _increases(other[0]):
            return other
    if not _increases(first[0]) and column.others:
        draft.labels["time_s"] = headings[column.places[0]]
    return first


def _increases(time_s: FloatArray) -> bool:
    finite = time_s[np.isfinite(time_s)]
    return finite.size > 1 and bool(np.all(np.diff(finite) >= 0.0)) and finite[-1] > finite[0]


def _seconds(
    draft: DraftLog, column: ChosenColumn, columns: TableColumns, names: Sequence[str]
) -> tuple[FloatArray, str]:
    cells = [columns.stamps(name) for name in names]
    if len(cells) == 1 and isinstance(cells[0], np.ndarray):
        unit = "" if is_time_format(column.unit) else column.unit
        values, how = seconds_of_numbers(cells[0] * column.factor, unit)
        return values, how
    texts = [cell if not isinstance(cell, np.ndarray) else _as_text(cell) for cell in cells]
    joined = texts[0] if len(texts) == 1 else pc.binary_join_element_wise(*texts, " ")
    unit = column.unit if is_time_format(column.unit) else ""
    try:
        return seconds_of_text(joined, unit)
    except UnreadableStampError as error:
        raise InputError(
            f"row {error.row + 1} is not a time",
            source=columns.source,
            field=draft.labels["time_s"],
            value=error.text,
            cure="seconds, hh:mm:ss or dates are read; name another column with --columns time=…",
        ) from error


def _as_text(values: FloatArray) -> Any:
    return pc.cast(pa.array(values, from_pandas=True), pa.string())


def _leaf_spy(draft: DraftLog, headings: Sequence[str]) -> None:
    """Rescale the SoC of LeafSpy, known by its other headings."""
    soc = draft.values.get("soc_pct")
    if soc is None or not {"Gids", "AHr", "Pack Volts"} <= set(headings):
        return
    finite = soc[np.isfinite(soc)]
    if finite.size and np.median(finite) > 110.0:
        draft.values["soc_pct"] = soc * LEAF_SPY_SOC
        draft.remarks.append("LeafSpy log: SoC in 0.0001 %")


def _drop_or_hold(draft: DraftLog, hold_s: float) -> None:
    """Drop the few incomplete rows; where rows hold only what changed, hold the latest values."""
    draft.drop_incomplete = True
    values = draft.values
    time, current, voltage = (values[name] for name in ("time_s", "current_a", "voltage_v"))
    temperature = values.get("temperature_c", time)
    whole = np.isfinite(time) & np.isfinite(current) & np.isfinite(voltage)
    missing = 1.0 - float(np.mean(whole & np.isfinite(temperature)))
    if missing <= MAX_INCOMPLETE or not whole.size:
        return
    timed = np.isfinite(time)
    at = np.flatnonzero(timed & np.isfinite(current))
    if not at.size or not np.isfinite(voltage[timed]).any():
        return
    held, age_s = _held(time, voltage, at)
    near = age_s <= hold_s
    if np.mean(near) < 0.5:
        return
    at, held = at[near], held[near]
    found = {"time_s": time[at], "current_a": current[at], "voltage_v": held}
    for name in ("temperature_c", "soc_pct"):
        if name in values:
            found[name], _ = _held(time, values[name], at)
    if "temperature_c" in found:
        temperature = found["temperature_c"]
        first = temperature[np.isfinite(temperature)][:1]
        found["temperature_c"] = np.where(np.isnan(temperature), first if first.size else np.nan,
                                          temperature)  # fmt: skip
    draft.values = found
    draft.remarks.append(
        f"rows hold only what changed: {at.size} rows with a current kept, with the latest voltage"
        f" (at most {float(age_s[near].max()):.2g} s old) and temperature"
    )


def _held(time: FloatArray, values: FloatArray, at: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the latest known value at some rows, and its age [s]; NaN and infinity before any."""
    known = np.flatnonzero(np.isfinite(values) & np.isfinite(time))
    latest = np.searchsorted(known, at, side="right") - 1
    if not known.size:
        return np.full(at.size, np.nan), np.full(at.size, np.inf)
    row = known[np.maximum(latest, 0)]
    before = latest < 0
    return np.where(before, np.nan, values[row]), np.where(before, np.inf, time[at] - time[row])


# --- A row per entity and time


def is_long_format(content: FileContent) -> bool:
    """Return whether the header is that of a history of entities."""
    names = [cell.lower() for cell in split_cells(content.first_line, ",")]
    return set(_LONG_FORMAT) <= set(names)


def read_long_format(content: FileContent, given: ColumnMap | None) -> DraftLog:
    """Read a history of entities: the entity is the heading, a row is a change.

    Raises
    ------
    InputError
        If no entity is plainly the current or the voltage.
    """
    header = split_cells(content.first_line, ",")
    names = [cell.lower() for cell in header]
    columns = read_columns(
        content,
        {name: names.index(name) for name in _LONG_FORMAT},
        header=header,
        delimiter=",",
        skip_lines=content.head.index(content.first_line) + 1,
    )
    entities = np.asarray(columns.text["entity_id"].to_pylist(), dtype=object)
    headings = ["time", *dict.fromkeys(entities.tolist())]
    choice = choose_columns(headings, (), given)
    if not choice.is_complete:
        raise unknown_columns(str(content.path), headings, choice)
    draft = DraftLog(content.name, str(content.path), remarks=[*columns.remarks])
    stamps, how = seconds_of_text(pc.utf8_trim_whitespace(columns.text["last_changed"]))
    order = np.argsort(stamps, kind="stable")
    stamps, entities = stamps[order], entities[order]
    states = columns.text["state"].to_pylist()
    cells = [states[row] for row in order.tolist()]
    draft.values["time_s"], draft.labels["time_s"] = stamps, "last_changed"
    draft.assumed.append(f'time = "last_changed" [{how}]')
    pivot = _Pivot(entities, cells, columns.source)
    for name, column in choice.chosen.items():
        if name == "time":
            continue
        wanted = [headings[place] for place in column.places]
        draft.labels[FIELDS[name]] = " + ".join(wanted)
        pivot.wanted = dict(zip([f"{name} {k}" for k in range(len(wanted))], wanted, strict=True))
        draft.values[FIELDS[name]], unit = _quantity(draft, name, column, pivot)
        draft.assumed.append(f'{name} = "{draft.labels[FIELDS[name]]}" [{unit}]')
    draft.sign_unknown = choice.chosen["current"].factor > 0.0
    draft.temperature_source = _source_of(choice)
    # A recorder stores changes: between them current and voltage are the latest values. A row for
    # every time at which one of them changed.
    current, voltage = draft.values["current_a"], draft.values["voltage_v"]
    last = np.append(np.flatnonzero(np.diff(stamps) > 0.0), stamps.size - 1)
    changed = np.isin(stamps[last], stamps[np.isfinite(current) | np.isfinite(voltage)])
    at = last[changed]
    latest, age_s = _held(stamps, current, at)
    draft.values["current_a"] = np.full(stamps.size, np.nan)
    draft.values["current_a"][at] = np.where(age_s <= HOLD_ENTITY_S, latest, np.nan)
    _drop_or_hold(draft, HOLD_ENTITY_S)
    return draft


@dataclass(slots=True)
class _Pivot:
    """States of entities as columns."""

    entities: Any
    cells: list[Any]
    source: str
    wanted: dict[str, str] = None  # type: ignore[assignment] # set before each use

    def numbers(self, name: str) -> FloatArray:
        entity = self.wanted[name]
        return np.array(
            [
                float(cell) if of == entity and cell is not None and is_number(cell) else np.nan
                for of, cell in zip(self.entities.tolist(), self.cells, strict=True)
            ]
        )

    def stamps(self, name: str) -> Any:
        raise NotImplementedError(name)


# --- Tables in memory


@dataclass(frozen=True, slots=True)
class ArrowColumns:
    """Columns of an Arrow table, by name.

    Parameters
    ----------
    table : pyarrow.Table
    place : dict of str to int
        Index by name.
    source : str
    """

    table: Any
    place: dict[str, int]
    source: str

    def numbers(self, name: str) -> FloatArray:
        """Return a column as numbers, NaN where missing."""
        column = self.table.column(self.place[name])
        label = self.table.column_names[self.place[name]]
        try:
            plain = column.cast(pa.float64(), safe=False)
        except (pa.ArrowException, OSError) as error:
            raise InputError(
                "the column does not hold numbers",
                source=self.source,
                field=label,
                value=str(column.type)[:60],
                cure="store it as floating point",
            ) from error
        return np.asarray(plain.to_numpy(), dtype=np.float64)

    def stamps(self, name: str) -> Any:
        """Return a time column as seconds, or as text."""
        column = self.table.column(self.place[name])
        kind = column.type
        if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
            per_second = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[kind.unit]
            counts = column.cast(pa.int64()).cast(pa.float64(), safe=False)
            return np.asarray(counts.to_numpy(), dtype=np.float64) / per_second
        if pa.types.is_date(kind):
            return column.cast(pa.string())
        if pa.types.is_string(kind) or pa.types.is_large_string(kind) or "string" in str(kind):
            text = pc.utf8_trim_whitespace(column.cast(pa.string()))
            try:
                return np.asarray(text.cast(pa.float64()).to_numpy(), dtype=np.float64)
            except pa.ArrowInvalid:
                return text
        return self.numbers(name)


def draft_of_arrow(
    table: Any,
    given: ColumnMap | None,
    *,
    name: str,
    source: str,
    read: Callable[[Sequence[str]], Any] | None = None,
) -> DraftLog:
    """Return the draft of a table in memory, by plain headings or the columns of the user.

    Parameters
    ----------
    table : pyarrow.Table, or its column names where `read` is given
    given : ColumnMap, optional
    name, source : str
        Of the log.
    read : callable, optional
        Returns the table with some columns, for files that are read by column.

    Raises
    ------
    InputError
        If a column is not found or does not hold its quantity.
    """
    where = source or name
    headings = list(table) if read is not None else list(table.column_names)
    choice = choose_columns(headings, (), given)
    if not choice.is_complete:
        raise unknown_columns(where, headings, choice)
    wanted = wanted_places(choice)
    if read is not None:
        names = list(dict.fromkeys(headings[place] for place in wanted.values()))
        table = read(names)
        wanted = {key: names.index(headings[place]) for key, place in wanted.items()}
    if not table.num_rows:
        raise InputError("the log holds no rows", source=where, cure="check the export")
    draft = DraftLog(name, source)
    fill_draft(draft, choice, headings, ArrowColumns(table, wanted, where))
    for key, column in (("time_s", choice.chosen["time"]),):
        kind = table.column(wanted["time 0"]).type
        if pa.types.is_timestamp(kind) and not column.unit:
            draft.assumed[0] = f'time = "{draft.labels[key]}" [{kind}]'
    return draft
