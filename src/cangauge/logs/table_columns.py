"""Values of a table's chosen columns in canonical units, with what was assumed of them.

Shared by text, Parquet, workbooks and data frames. Rows may hold all channels, or only those that
changed (exports of measurement tools): then the latest voltage is held for a short time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._typing import FloatArray, IntArray
from cangauge.errors import InputError
from cangauge.logs.arrow import is_text
from cangauge.logs.column_map import (
    Choice,
    ChosenColumn,
    ColumnMap,
    choose_columns,
    missing_quantities,
    shown_headings,
    suggestion,
)
from cangauge.logs.columns import without_unit
from cangauge.logs.draft import MAX_INCOMPLETE, PROBES_APART_K, DraftLog
from cangauge.logs.headings import FIELDS
from cangauge.logs.stamps import (
    WITHOUT_ZONE,
    UnreadableStampError,
    hour_jump,
    is_time_format,
    seconds_of_numbers,
    seconds_of_text,
)
from cangauge.logs.units import TemperatureSource, convert, unit_of

DOCS: Final = "docs/logs.md"
"""Page that explains the columns of a log."""

HOLD_S: Final = 1.0
"""Longest time that a voltage is held to the next row with a current [s], where rows hold only the
channels that changed: a voltage follows its current within this time, and a bus repeats both."""

HOLD_ENTITY_S: Final = 60.0
"""The same for recorders that store a value when it changes [s]: no longer than charge is counted
over a gap."""

SHOWN_HEADING: Final = 80
"""Longest heading in the line of assumptions [characters]."""

LEAF_SPY_SOC: Final = 1e-4
"""LeafSpy writes SoC in ten-thousandths of a percent."""

_QUANTITY_UNITS: Final = {
    "time": "s", "current": "A", "voltage": "V", "temperature": "°C", "soc": "%"
}  # fmt: skip


class TableColumns(Protocol):
    """Columns of a table in memory or text, by name."""

    @property
    def source(self) -> str:
        """File or table, for messages."""

    @property
    def units(self) -> Mapping[str, str]:
        """Unit that all cells of a column read as numbers carry, by name."""

    def numbers(self, name: str) -> FloatArray:
        """Return a column as numbers, NaN where missing."""

    def stamps(self, name: str) -> Any:
        """Return a column as numbers, or as a pyarrow string array if it holds text."""


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
    draft.headings = tuple(headings)
    for name, column in choice.chosen.items():
        label = " + ".join(headings[place] for place in column.places)
        draft.labels[FIELDS[name]] = label
        if name == "time":
            values, unit = _time(draft, column, columns, headings)
            label = draft.labels["time_s"]
            if unit.endswith(WITHOUT_ZONE):
                _remark_hour_jump(draft, values)
        else:
            values, unit = quantity_values(draft, name, column, columns)
        draft.values[FIELDS[name]] = values
        factor = "" if column.factor == 1.0 else f" × {column.factor:g}"
        shown = label if len(label) <= SHOWN_HEADING else f"{label[:SHOWN_HEADING]}…"
        draft.assumed.append(f'{name} = "{shown}"{factor} [{unit}]')
    chosen = {place for column in choice.chosen.values() for place in column.places}
    draft.ignored = tuple(
        heading for place, heading in enumerate(headings)
        if heading and place not in chosen and heading != draft.labels["time_s"]
    )  # fmt: skip
    _leaf_spy(draft, headings)
    current = choice.chosen["current"]
    draft.sign_unknown = current.factor > 0.0
    draft.temperature_source = temperature_source_of(choice)
    drop_or_hold(draft, HOLD_S)


def temperature_source_of(choice: Choice) -> TemperatureSource:
    """Return where the chosen temperature is measured, if its heading defines it."""
    column = choice.chosen.get("temperature")
    return "unknown" if column is None else column.source


def quantity_values(
    draft: DraftLog, name: str, column: ChosenColumn, columns: TableColumns
) -> tuple[FloatArray, str]:
    """Return a quantity in its canonical unit, and the unit that was read or assumed."""
    field = FIELDS[name]
    parts = [columns.numbers(f"{name} {k}") for k in range(len(column.places))]
    values, unit = parts[0], _unit_of_cells(draft, name, column, columns)
    if len(parts) > 1:
        draft.remarks.append(f"{name}: mean of {len(parts)} columns")
        apart = np.inf
        if name == "temperature":
            kelvin, _ = unit_of(field, unit) or (1.0, 0.0)
            apart = PROBES_APART_K / abs(kelvin * column.factor)
        values = draft.mean_of_probes([draft.headings[k] for k in column.places], parts, apart)
    values = values * column.factor
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


def _unit_of_cells(draft: DraftLog, name: str, column: ChosenColumn, columns: TableColumns) -> str:
    """Return the unit of a column, by its heading or by its cells (`53.2 V`)."""
    in_cells = {columns.units.get(f"{name} {k}", "") for k in range(len(column.places))} - {""}
    in_heading = unit_of(FIELDS[name], column.unit) if column.unit else None
    for unit in sorted(in_cells):
        if column.unit and unit_of(FIELDS[name], unit) != in_heading:
            raise InputError(
                "the cells have another unit than the heading",
                source=draft.source or draft.name, field=draft.labels[FIELDS[name]],
                value=f"{unit}, heading {column.unit}",
                cure=f"state the right one: --columns '{name}=HEADING[UNIT]'",
            )  # fmt: skip
    return column.unit or min(in_cells, default="")


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


def _remark_hour_jump(draft: DraftLog, time_s: FloatArray) -> None:
    """Remark on an hour that local time leaves out; raise InputError for one that it repeats."""
    jump = hour_jump(time_s)
    if jump is None:
        return
    row, forward = jump
    cure = f"name its zone, e.g. --columns 'time={draft.labels['time_s']}[Europe/Berlin]'"
    problem = f"local time jumps an hour {'ahead' if forward else 'back'} at row {row + 1}"
    if not forward:
        raise InputError(
            problem, source=draft.source or draft.name, field=draft.labels["time_s"], cure=cure
        )
    draft.remarks.append(f"{problem}, as daylight saving time does: {cure}")


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
    return read_stamps(joined, unit, columns.source, draft.labels["time_s"])


def read_stamps(cells: Any, unit: str, source: str, label: str) -> tuple[FloatArray, str]:
    """Return stamps of text as seconds; see `seconds_of_text`.

    Raises
    ------
    InputError
        If a cell is no time.
    """
    try:
        return seconds_of_text(cells, unit)
    except UnreadableStampError as error:
        raise InputError(
            f"row {error.row + 1} is not a time",
            source=source,
            field=label,
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


def drop_or_hold(draft: DraftLog, hold_s: float) -> None:
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
    latest_v, age_s = held(time, voltage, at)
    near = age_s <= hold_s
    if np.mean(near) < 0.5:
        return
    at, latest_v = at[near], latest_v[near]
    found = {"time_s": time[at], "current_a": current[at], "voltage_v": latest_v}
    for name in ("temperature_c", "soc_pct"):
        if name in values:
            found[name], _ = held(time, values[name], at)
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


def held(time: FloatArray, values: FloatArray, at: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the latest known value at some rows, and its age [s]; NaN and infinity before any."""
    known = np.flatnonzero(np.isfinite(values) & np.isfinite(time))
    latest = np.searchsorted(known, at, side="right") - 1
    if not known.size:
        return np.full(at.size, np.nan), np.full(at.size, np.inf)
    row = known[np.maximum(latest, 0)]
    before = latest < 0
    return np.where(before, np.nan, values[row]), np.where(before, np.inf, time[at] - time[row])


@dataclass(frozen=True, slots=True)
class ArrowColumns:
    """Columns of an Arrow table, by name.

    Parameters
    ----------
    table : pyarrow.Table
    place : dict of str to int
        Index by name.
    source : str
    units : dict of str to str
        Unit in the cells of a column that was read as numbers (`53.2 V`), by name.
    """

    table: Any
    place: dict[str, int]
    source: str
    units: dict[str, str] = field(default_factory=dict)

    def numbers(self, name: str) -> FloatArray:
        """Return a column as numbers, NaN where missing."""
        column = self.table.column(self.place[name])
        label = self.table.column_names[self.place[name]]
        if is_text(column.type):
            text = pc.utf8_trim_whitespace(column.cast(pa.string()))
            bare = without_unit(text)
            column = text
            if bare is not None:
                column, self.units[name] = bare
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
        if is_text(kind):
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
