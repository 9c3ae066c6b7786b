"""Read any table with plain headings, or with columns named by the user.

The text may have a preamble, a second row of units, `,`, `;`, tab or `|` between the columns and
decimal commas. What the headings leave open is assumed, and stated in `DraftLog.assumed`; the sign
of current is then found from the data. A row holds one time, or one entity at a time (exports of
Home Assistant).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
import pyarrow.compute as pc

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.column_map import (
    Choice,
    ColumnMap,
    choose_columns,
    missing_quantities,
    shown_headings,
    suggestion,
)
from cangauge.logs.columns import is_number, read_columns
from cangauge.logs.draft import DraftLog
from cangauge.logs.file_content import FileContent, split_cells
from cangauge.logs.headings import FIELDS, meaning_of
from cangauge.logs.stamps import is_clock, is_stamp
from cangauge.logs.table_columns import (
    DOCS,
    HOLD_ENTITY_S,
    drop_or_hold,
    fill_draft,
    held,
    quantity_values,
    read_stamps,
    temperature_source_of,
    unknown_columns,
    wanted_places,
)

_DELIMITERS: Final = ("\t", ";", ",", "|")
_HEADER_LINES: Final = 160
_CELLS_TRIED: Final = 60_000
"""Cells to search for a header, over all lines and delimiters: bounds the time of a search."""
_SUB_HEADERS: Final = 4
_ROWS_TRIED: Final = 20
"""Rows that a guess of the time looks at."""
_FRAME_WORDS: Final = frozenset({"id", "can id", "identifier", "dlc", "len", "data", "d1"})
_LONG_FORMAT: Final = ("entity_id", "state", "last_changed")


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
            if delimiter not in line or not number:
                continue
            if sum(_is_value(cell) for cell in split_cells(line, delimiter)) < 2:
                continue
            cells = _header_above(content, number, delimiter)
            if cells:
                choice = choose_columns(cells, (), given)
                return cells, _with_guess_of_time(choice, content, number, delimiter)
    return [], Choice({}, {})


def _header_above(content: FileContent, number: int, delimiter: str) -> list[str]:
    """Return the cells of the header above a first row of data, [] if there is none."""
    for above in range(number - 1, max(number - 1 - _SUB_HEADERS, -1), -1):
        cells = split_cells(content.head[above], delimiter)
        if len(cells) >= 3 and sum(meaning_of(cell) is not None for cell in cells) >= 2:
            return cells
    cells = split_cells(content.head[number - 1], delimiter)
    is_header = sum(_is_value(cell) for cell in cells) < 0.5 * len(cells)
    return cells if len(cells) >= 2 and is_header else []


def _with_guess_of_time(
    choice: Choice, content: FileContent, number: int, delimiter: str
) -> Choice:
    """Return the choice with the first column that increases as a guess of the time."""
    if "time" in choice.chosen or "time" in choice.guesses:
        return choice
    lines = content.head[number : number + _ROWS_TRIED]
    rows = [
        [cell.replace(",", ".") for cell in split_cells(line, delimiter)]
        for line in lines
        if line.strip()
    ]
    taken = {place for column in choice.chosen.values() for place in column.places}
    for place in range(min(map(len, rows), default=0)):
        values = [float(row[place]) for row in rows if is_number(row[place])]
        increases = all(low < high for low, high in pairwise(values))
        if place not in taken and len(values) == len(rows) > 2 and increases:
            return Choice(choice.chosen, {**choice.guesses, "time": place})
    return choice


def is_of_frames(headings: Sequence[str]) -> bool:
    """Return whether headings are those of CAN frames: an id, a length or bytes."""
    return bool(_FRAME_WORDS & {heading.strip().lower() for heading in headings})


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
    draft.headings = tuple(headings)
    cells = pc.utf8_trim_whitespace(columns.text["last_changed"])
    stamps, how = read_stamps(cells, "", columns.source, "last_changed")
    order = np.argsort(stamps, kind="stable")
    stamps, entities = stamps[order], entities[order]
    states = columns.text["state"].to_pylist()
    of_rows = [states[row] for row in order.tolist()]
    draft.values["time_s"], draft.labels["time_s"] = stamps, "last_changed"
    draft.assumed.append(f'time = "last_changed" [{how}]')
    pivot = _Pivot(entities, of_rows, columns.source)
    for name, column in choice.chosen.items():
        if name == "time":
            continue
        wanted = [headings[place] for place in column.places]
        draft.labels[FIELDS[name]] = " + ".join(wanted)
        pivot.wanted = dict(zip([f"{name} {k}" for k in range(len(wanted))], wanted, strict=True))
        draft.values[FIELDS[name]], unit = quantity_values(draft, name, column, pivot)
        draft.assumed.append(f'{name} = "{draft.labels[FIELDS[name]]}" [{unit}]')
    draft.sign_unknown = choice.chosen["current"].factor > 0.0
    draft.temperature_source = temperature_source_of(choice)
    # A recorder stores changes: between them current and voltage are the latest values. A row for
    # every time at which one of them changed.
    current, voltage = draft.values["current_a"], draft.values["voltage_v"]
    last = np.append(np.flatnonzero(np.diff(stamps) > 0.0), stamps.size - 1)
    changed = np.isin(stamps[last], stamps[np.isfinite(current) | np.isfinite(voltage)])
    at = last[changed]
    latest, age_s = held(stamps, current, at)
    draft.values["current_a"] = np.full(stamps.size, np.nan)
    draft.values["current_a"][at] = np.where(age_s <= HOLD_ENTITY_S, latest, np.nan)
    drop_or_hold(draft, HOLD_ENTITY_S)
    return draft


@dataclass(slots=True)
class _Pivot:
    """States of entities as columns."""

    entities: Any
    cells: list[Any]
    source: str
    wanted: dict[str, str] = None  # type: ignore[assignment] # set before each use
    units: dict[str, str] = field(default_factory=dict)

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
