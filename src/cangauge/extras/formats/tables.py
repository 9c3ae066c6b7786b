"""Tables in other clothes: a workbook's longest sheet, a row per value."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any, Final, Self

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._files import Head
from cangauge._typing import FloatArray, IntArray
from cangauge.errors import InputError
from cangauge.extras.formats.channels import DRIVING, Channels
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.columns import Choice, choose_columns
from cangauge.logs.draft import DraftLog
from cangauge.logs.gaps import BRIDGE_S, usual_step_s
from cangauge.logs.read import LogTableReader
from cangauge.logs.stamps import changes_of_clock, over_midnight, seconds_of
from cangauge.logs.text import MAX_ROWS, TextTable, headed
from cangauge.logs.values import is_text

HELD_S: Final = 3600.0
"""Longest silence of all series over which a value holds [s]: a recorder stores a value when it
changes, and a pack's voltage or temperature moves within an hour."""
POLLED_SHARE: Final = 0.1
"""Share of values that repeat the one before from which they are polled, not stored on change [-]:
of many series some, such as the temperature, hardly move."""
DAY_S: Final = 86_400.0
_VALUE: Final = r"^(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(?P<unit>\D{0,4})$"


class Workbook:
    """The longest sheet of an Excel workbook (.xlsx)."""

    takes_columns = True

    def matches(self, head: Head) -> bool:
        """Return whether the file is a workbook: `Head` unpacks every other zip."""
        return head.data.startswith(b"PK\x03\x04")

    def read(self, head: Head, columns: ColumnMap | None = None) -> DraftLog:
        """Read the longest sheet as a text of tabs.

        Raises
        ------
        InputError
            If openpyxl is not installed, or the workbook is damaged or holds no log.
        """
        sheets = _sheets(head)
        rows = max(sheets.values(), key=len, default=[])
        longest = next((title for title, each in sheets.items() if each is rows), "")
        others = [
            f"{title!r} ({len(each)} rows)"
            for title, each in sheets.items()
            if each and title != longest
        ]
        draft = LogTableReader().read(head.holding("\n".join([*rows, ""]).encode()), columns)
        if others:
            remark = f"sheet {longest!r} is read, the longest; not read: {', '.join(others)}"
            draft.remarks.append(remark)
        return draft


def _sheets(head: Head) -> dict[str, list[str]]:
    """Return the rows of each sheet by its title."""
    try:
        import openpyxl  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise InputError(
            "reading a workbook needs openpyxl",
            source=head.path,
            cure="install the extra: pip install 'cangauge[excel]', or export the sheet as CSV",
        ) from error
    try:
        with head.open() as file:
            book = openpyxl.load_workbook(file, read_only=True, data_only=True)
            return {sheet.title: _rows(sheet) for sheet in book.worksheets}
    except Exception as error:  # openpyxl raises whatever a damaged part provokes
        raise InputError(
            f"the workbook is damaged ({type(error).__name__})",
            source=head.path,
            cure="save it again, or export the sheet as CSV",
        ) from error


def _rows(sheet: Any) -> list[str]:
    """Return the rows of a sheet that hold anything, as lines with tabs."""
    lines = (
        "\t".join("" if cell is None else " ".join(f"{cell}".split()) for cell in row)
        for row in sheet.iter_rows(values_only=True)
    )
    return [line for line in islice(lines, MAX_ROWS) if line.strip()]


class LongTable(Channels):
    """A row per value: a name, a value and a time, pivoted on time; the names are the headings.

    Car Scanner (`PID`, `VALUE`), InfluxDB (`_field`, `_value`), Home Assistant (`entity_id`,
    `state`). Some store a value when it changes, others whenever they ask for it.

    An instance holds times [s] and values of each series, in the order of time. `label` is the
    heading of the times, `how` their reading, `names` the heading of the series' names.
    """

    takes_columns = True
    time = "time"
    _NAMES: Final = (
        *("pid", "entity_id", "_measurement", "_field", "field", "name", "signal", "channel"),
        *("sensor", "parameter", "variable", "metric", "topic", "key", "series", "tag"),
    )
    _VALUES: Final = ("value", "_value", "state", "payload", "val")
    _UNITS: Final = frozenset({"unit", "units", "unit_of_measurement"})

    def __init__(
        self, names: str, label: str, how: str, by_name: dict[str, tuple[FloatArray, FloatArray]]
    ) -> None:
        self.label, self.how, self._by_name = label, how, by_name
        repeats = np.concatenate([np.diff(values) == 0.0 for _, values in by_name.values()])
        self._is_polled = bool(np.count_nonzero(repeats) > POLLED_SHARE * repeats.size)
        each = "the current" if self._is_polled else "current and voltage, which are held"
        pivoted = f"{len(by_name)} series of {names} pivoted on time"
        self.remarks = [f"a row per value: {pivoted}; a row for each value of {each}"]

    @classmethod
    def matches(cls, head: Head) -> bool:
        """Return whether the header has a name, a value and a time."""
        return cls._text(head) is not None

    @classmethod
    def read(cls, head: Head, columns: ColumnMap | None = None) -> DraftLog:
        """Read the values: a row for each current, or for each change."""
        text = cls._text(head)
        if text is None:
            raise InputError("no header with a name, a value and a time", source=head.path)
        series = cls._series(text)
        draft = series.draft(head, columns)
        known = np.isfinite(draft.values["current_a"] + draft.values["voltage_v"])
        draft.values = {name: values[known] for name, values in draft.values.items()}
        draft.assumed[0] = f'time = "{series.label}" [{series.how}]'
        draft.labels["time_s"] = series.label
        return draft

    @classmethod
    def _text(cls, head: Head) -> TextTable | None:
        """Return the table of values; None where a row holds all quantities of one time."""
        for text in headed(head, rows=1):
            lower = {cell.lower() for cell in text.headings}
            is_long = lower.intersection(cls._NAMES) and lower.intersection(cls._VALUES)
            choice = choose_columns(text.headings) if is_long else Choice()
            if "time" in choice.chosen and not choice.is_complete:
                return text
        return None

    @classmethod
    def _series(cls, text: TextTable) -> Self:
        lower = [cell.lower() for cell in text.headings]
        value = next(lower.index(name) for name in cls._VALUES if name in lower)
        named = [place for place, name in enumerate(lower) if name in cls._NAMES]
        units = [place for place, name in enumerate(lower) if name in cls._UNITS]
        column = choose_columns(text.headings).chosen["time"]
        time = column.places[0]
        label = text.headings[time]
        cells = text.columns([0, value, time, *named, *units], times=[time])
        # Headers and InfluxDB's notes stand above each table.
        is_note = pc.starts_with(pc.fill_null(cells[0].cast(pa.string()), ""), "#")
        is_row = pc.and_not(pc.is_valid(cells[time]), is_note)
        cells = {place: column.filter(is_row) for place, column in cells.items()}
        words = {
            place: pc.fill_null(cells[place].cast(pa.string()), "") for place in [*named, *units]
        }
        varying = [place for place in named if len(pc.unique(words[place])) > 1] or named[:1]
        source = str(text.head.path)
        stamps_s, how = seconds_of([cells[time]], column.unit, 1.0, source=source, label=label)
        if np.max(stamps_s, initial=0.0) < DAY_S:  # seconds of the day
            stamps_s = over_midnight(stamps_s)
        values, in_cells = _numbers_and_units(cells[value])
        parts = [words[place] for place in varying]
        parts += [
            pc.binary_join_element_wise("[", unit, "]", "")
            for unit in [*(words[place] for place in units), in_cells]
        ]
        names = pc.utf8_trim_whitespace(pc.binary_join_element_wise(*parts, " "))
        names = pc.replace_substring(names, " []", "")
        names = names.combine_chunks().dictionary_encode()
        names_of = " and ".join(text.headings[place] for place in varying)
        series, changes = dict[str, tuple[FloatArray, FloatArray]](), list[str]()
        for name, rows in _rows_by_name(names):
            own_s = stamps_s[rows]
            if "without zone" in how:
                changes += changes_of_clock(own_s, source, label, "export the times in UTC")
            by_time = rows[np.argsort(own_s, kind="stable")]
            if name and np.isfinite(values[rows]).any():
                series[name] = stamps_s[by_time], values[by_time]
        if not series:
            problem, label = "no value is a number", text.headings[value]
            raise InputError(problem, source=source, field=label, cure="check the export")
        table = cls(names_of, label, how, series)
        table.remarks += changes[:1]
        return table

    @property
    def headings(self) -> list[str]:
        """The names of the series."""
        return [*self._by_name]

    def _stamps_of(self, names: Sequence[str]) -> FloatArray:
        """Return the times of all values of some series [s]."""
        return np.unique(np.concatenate([self._by_name[name][0] for name in names]))

    def rows_of(self, current: list[str], voltage: list[str]) -> FloatArray:
        """Return the times of polled currents, or of all changes and usual ones between."""
        if self._is_polled:
            return self._stamps_of(current)
        stamps_s = self._stamps_of([*current, *voltage])
        step_s = max(usual_step_s(stamps_s), 1.0)
        more = np.maximum(np.ceil(np.diff(stamps_s) / step_s).astype(int) - 1, 0)
        more[np.diff(self._session(stamps_s)) > 0] = 0
        number = np.arange(1, more.sum() + 1) - np.repeat(np.cumsum(more) - more, more)
        return np.union1d(stamps_s, np.repeat(stamps_s[:-1], more) + step_s * number)

    def _session(self, at_s: FloatArray) -> IntArray:
        """Return by time the number of silences of all series before it."""
        all_s = self._stamps_of(self.headings)
        ends_s = all_s[1:][np.diff(all_s) > HELD_S]
        return np.searchsorted(ends_s, at_s, side="right")

    def at(self, name: str, rows_s: FloatArray, quantity: str) -> FloatArray:
        """Return the nearest values of polled series, the latest of others.

        Of current and voltage only those that are near, or that hold; of others, the first value
        also holds before it.
        """
        stamps_s, values = self._by_name[name]
        if quantity not in DRIVING:
            known = np.isfinite(values)
            stamps_s, values = stamps_s[known], values[known]
        if self._is_polled:
            after = np.minimum(np.searchsorted(stamps_s, rows_s), stamps_s.size - 1)
            before = np.maximum(after - 1, 0)
            is_before = np.abs(rows_s - stamps_s[before]) <= np.abs(stamps_s[after] - rows_s)
            place = np.where(is_before, before, after)
            holds = np.abs(stamps_s[place] - rows_s) <= BRIDGE_S
        else:
            place = np.maximum(np.searchsorted(stamps_s, rows_s, side="right") - 1, 0)
            is_recorded = self._session(rows_s) == self._session(stamps_s)[place]
            holds = is_recorded & (rows_s >= stamps_s[place])
        return np.where(holds | (quantity not in DRIVING), values[place], np.nan)


def _rows_by_name(names: Any) -> Iterator[tuple[str, IntArray]]:
    """Yield each name of a dictionary array with its rows, in the order of the file."""
    codes = names.indices.to_numpy()
    ends = np.cumsum(np.bincount(codes))
    by_code = np.split(np.argsort(codes, kind="stable"), ends)  # none is left behind the last end
    yield from zip(names.dictionary.to_pylist(), by_code, strict=False)


def _numbers_and_units(cells: Any) -> tuple[FloatArray, Any]:
    """Return the numbers in cells, NaN where a word ends a value, and the units behind them."""
    if not is_text(cells):
        return np.asarray(pc.cast(cells, pa.float64()).to_numpy()), pa.repeat("", len(cells))
    parts = pc.extract_regex(cells.combine_chunks(), _VALUE)
    is_number = pc.is_valid(parts)
    texts = pc.if_else(is_number, parts.field("number"), pa.scalar(None, pa.string()))
    numbers = pc.cast(texts, pa.float64()).to_numpy(zero_copy_only=False)
    return np.asarray(numbers), pc.if_else(is_number, parts.field("unit"), "")


READERS: Final = (Workbook(), LongTable)
