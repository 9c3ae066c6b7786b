"""Any table, of text or Arrow, as a draft of a log.

A table with the names of the canonical log defines its columns. In any other they are found by
plain headings or named by the user; what the headings leave open is assumed, and stated in
`DraftLog.assumed`; the sign of current is then found from the data. Rows may hold all channels, or
only those that changed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._typing import FloatArray, IntArray
from cangauge.errors import InputError
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.columns import (
    ChosenColumn,
    UnknownColumnsError,
    choose_columns,
    refuse_doubled,
    refuse_odd_names,
)
from cangauge.logs.draft import BESIDES, MAX_INCOMPLETE, DraftLog
from cangauge.logs.headings import Rank, charge_scale, parse_heading
from cangauge.logs.log import SOURCE
from cangauge.logs.quantities import (
    FIELDS,
    QUANTITIES,
    REQUIRED,
    convert,
    known_temperature_source,
    unit_of,
)
from cangauge.logs.stamps import changes_of_clock, is_clock, is_stamp, seconds_of
from cangauge.logs.text import TextTable
from cangauge.logs.values import first_text, is_number, numbers_of, read_cells

MAX_COUNTERS: Final = 6
"""Most columns in Ah among which the one that counts the charge is searched [-]."""
HOLD_S: Final = 1.0
"""Longest time over which a voltage is held or interpolated to a row with a current [s], where each
channel has times of its own: a bus repeats both within it."""
_STATES: Final = re.compile(
    r"(?<![a-z])(?:state|status|md|mode|direction|dir|type|step|command|(?:dis)?charg(?:e|ing))"
    "(?![a-z])|状态|类型"
)
"""Words of a heading whose cells may state the direction of an unsigned current."""
_UNITS: Final = re.compile(r"(?:^|[^a-z])(?:units?|einheit|unité)$", re.IGNORECASE)
"""Heading of a column that states the unit of the one before it."""
_CHARGES: Final = r"(?:^|[^a-z])(?:c|ch|cha[a-z]*|chg[a-z]*)(?:$|[^a-z])|充"
_DISCHARGES: Final = r"(?:^|[^a-z])(?:d|dis[a-z]*|dch[a-z]*)(?:$|[^a-z])|放"
_FLAG: Final = re.compile(r"(?:is)?\W*_?(?:state|status|flag)?\W*", re.IGNORECASE)
"""What beside `charging` makes a heading that its cells affirm or deny."""
_YES: Final = "^(?:1|1[.]0|true|yes|on)$"
_NO: Final = "^(?:0|0[.]0|false|no|off)$"
_LEAF_SPY: Final = {"Gids", "AHr", "Pack Volts"}
"""Columns of a LeafSpy log, whose SoC is in ten-thousandths of a percent."""


@dataclass(frozen=True, slots=True)
class ArrowTable:
    """Columns of an Arrow table or file; `read` returns a pyarrow.Table of some of them.

    `word` is the temperature source that the metadata state, `source` the file, for errors.
    """

    headings: Sequence[str]
    read: Callable[[list[str]], Any]
    word: str = ""
    source: str | None = None
    units: Sequence[str] = ()
    remarks: list[str] = field(default_factory=list)
    decimal_mark: str = ""

    def columns(
        self,
        places: Sequence[int],
        times: Collection[int] = (),
        optional: Collection[int] = (),
    ) -> dict[int, Any]:
        """Return columns by place; raise InputError if another column has one of their names."""
        names = [self.headings[place] for place in places]
        for name in names:
            refuse_doubled(name, self.headings, self.source)
        table = self.read(names)
        columns = {place: table.column(name) for place, name in zip(places, names, strict=True)}
        source, mark = self.source, self.decimal_mark
        return read_cells(columns, self.headings, source, mark, times=times, optional=optional)


def draft_of_table(
    table: TextTable | ArrowTable,
    given: ColumnMap | None,
    *,
    name: str,
    source: str,
    besides: Mapping[int, float] | None = None,
    is_defined: bool = False,
) -> DraftLog:
    """Return the draft of a log from a table; `given` are the user's columns.

    `besides` are further columns to take, by place, with factors; by default those in Ah.
    `is_defined`: a format defines columns and sign, as the canonical log does.

    Raises
    ------
    InputError
        If a column is not found, or holds anything but values of its quantity.
    """
    where, headings = source or name, [*table.headings]
    choice = choose_columns(headings, table.units, given)
    if choice.is_canonical:
        refuse_odd_names(headings, where)
    elif given is None and choose_columns(headings).is_canonical:
        problem, cure = "the row of units contradicts the headings", "correct one of them"
        shown, cure = ",".join(table.units)[:80], f"{cure}, or name the columns with --columns"
        raise InputError(problem, source=where, value=shown, cure=cure)
    if not choice.is_complete:
        raise UnknownColumnsError(where, headings, choice, given)
    is_defined = is_defined or choice.is_canonical
    chosen = choice.chosen
    words = [k for k, text in enumerate(headings) if text.strip().lower() == SOURCE][:1]
    measured = [place for column in chosen.values() for place in column.places]
    times = [*chosen["time"].places, *(place for place, _ in chosen["time"].others)]
    taken = [*measured, *times, *words]
    unit_columns = {k: k + 1 for k in taken if _UNITS.search("".join(headings[k + 1 : k + 2]))}
    counters = {} if is_defined or "soc" not in chosen else _counters(table, taken)
    others = besides or counters
    wanted = dict.fromkeys([*taken, *unit_columns.values(), *others])
    cells = table.columns([*wanted], times=times, optional=[*counters])
    draft = DraftLog(name, source, headings=tuple(headings), remarks=[*table.remarks])
    units = {place: _only_word(cells[k], where, headings[k]) for place, k in unit_columns.items()}
    for quantity, column in chosen.items():
        beside = next((units[place] for place in column.places if place in units), "")
        if quantity == "time":
            chosen[quantity], unit = _take_time(draft, column, cells, beside)
        else:
            unit = _take(draft, quantity, column, cells, beside)
        is_converted = unit_of(FIELDS[quantity], chosen[quantity].unit) not in {None, (1.0, 0.0)}
        if is_converted or not is_defined:
            draft.assumed.append(_assumption(draft, quantity, column.factor, unit))
    _take_besides(draft, cells, others, may_be_words=besides is None)
    used = {*words, *(place for column in chosen.values() for place in column.places)}
    draft.ignored = tuple(text for k, text in enumerate(headings) if text and k not in used)
    word: str = chosen["temperature"].source if "temperature" in chosen else "unknown"
    if is_defined:
        word = table.word or word
    for place in words:
        word = _only_word(cells[place], where, SOURCE) or word
    draft.temperature_source = known_temperature_source(word, source=where)
    if not is_defined:
        _direct(draft, chosen["current"], table)
        _hold_changes(draft)
    return draft


def _assumption(draft: DraftLog, quantity: str, factor: float, unit: str) -> str:
    """Return by which heading, factor and unit a quantity was read."""
    label = draft.labels[FIELDS[quantity]]
    shown = label if len(label) <= 80 else f"{label[:80]}…"
    times = "" if factor == 1.0 else f" × {factor:g}"
    return f'{quantity} = "{shown}"{times} [{unit}]'


def _take_besides(
    draft: DraftLog, cells: dict[int, Any], factors: Mapping[int, float], *, may_be_words: bool
) -> None:
    """Take columns that are none of the log's."""
    for place, factor in factors.items():
        label = draft.headings[place]
        with suppress(InputError) if may_be_words else nullcontext():
            numbers, _ = numbers_of(cells[place], draft.where, label)
            draft.values[f"{BESIDES}{label}"] = numbers * factor


def _counters(table: TextTable | ArrowTable, taken: Sequence[int]) -> dict[int, float]:
    """Return columns that may count the charge, with their factor to Ah; few, as pairs count."""
    units = zip_longest(table.headings, table.units[: len(table.headings)], fillvalue="")
    scales = {place: charge_scale(*each) for place, each in enumerate(units)}
    found = {k: scale for k, scale in scales.items() if scale is not None and k not in taken}
    return found if len(found) <= MAX_COUNTERS else {}


def _only_word(column: Any, where: str, label: str) -> str:
    words = {str(word).strip().lower() for word in pc.unique(column.cast(pa.string())).to_pylist()}
    words -= {"", "none"}
    if len(words) > 1:
        problem = "the column must hold one word throughout"
        raise InputError(problem, source=where, field=label, value=sorted(words)[:3])
    return words.pop() if words else ""


def _take(
    draft: DraftLog, quantity: str, column: ChosenColumn, cells: dict[int, Any], beside: str
) -> str:
    """Take a quantity in its canonical unit; return how the unit was found.

    `beside` is the unit that a column beside states.
    """
    name, where, unit = FIELDS[quantity], draft.where, column.unit
    texts = _label(draft, name, column, " − " if quantity == "current" else " + ")
    read = [numbers_of(cells[k], where, text) for k, text in zip(column.places, texts, strict=True)]
    for in_cells in [*(in_cells for _, in_cells in read), beside]:
        if in_cells and unit and unit_of(name, in_cells) != unit_of(name, unit):
            problem = "the cells have another unit than the heading"
            cure = f"state the right one: --columns '{quantity}=HEADING[UNIT]'"
            raise draft.error(name, problem, cure, f"{in_cells}, heading {unit}")
        unit = unit or in_cells
    parts = [numbers if column.factor == 1.0 else numbers * column.factor for numbers, _ in read]
    how = unit or f"{QUANTITIES[quantity].unit}, assumed"
    if quantity == "soc":
        unit, how = _unit_of_soc(draft, parts[0], unit, how)
    parts = [convert(part, name, unit, source=where, label=draft.labels[name]) for part in parts]
    if len(parts) == 1:
        draft.values[name] = parts[0]
    elif quantity == "temperature":
        draft.take_probes(texts, parts)
        how = f"{how}, the median"
    else:
        draft.values[name] = _discharge_less_charge(draft, parts)
    return how


def _unit_of_soc(draft: DraftLog, soc: FloatArray, unit: str, how: str) -> tuple[str, str]:
    """Return the unit of a SoC by its range, if nothing states it or LeafSpy wrote it."""
    finite = soc[np.isfinite(soc)]
    is_within_1 = finite.size and finite.min() >= 0.0 and finite.max() <= 1.0
    if is_within_1 and not unit and np.any(finite % 1.0):  # 1, then 0, may be percents too
        return "0-1", "0–1, from its range"
    if _LEAF_SPY.issubset(draft.headings) and np.nanmedian(finite) > 110.0:
        draft.remarks.append("LeafSpy log: SoC in 0.0001 %")
        return "0.0001%", how
    return unit, how


def _discharge_less_charge(draft: DraftLog, parts: Sequence[FloatArray]) -> FloatArray:
    """Return the difference of two currents of one direction each, whatever their signs."""
    if any(np.any(part < 0.0) and np.any(part > 0.0) for part in parts):
        problem = "these are no currents of one direction each: one has both signs"
        cure = "name the one that holds both directions: --columns 'current=?'"
        raise draft.error("current_a", problem, cure)
    return np.abs(parts[0]) - np.abs(parts[1])


def _direct(draft: DraftLog, column: ChosenColumn, table: TextTable | ArrowTable) -> None:
    """Leave the sign of current to the data, unless a negative factor or two columns define it."""
    if column.factor > 0.0 and len(column.places) == 1:
        draft.sign_by = "data"
        if not np.any(draft.values["current_a"] < 0.0):
            direct_by_state(draft, table)


def direct_by_state(draft: DraftLog, table: TextTable | ArrowTable) -> None:
    """Make an unsigned current negative where a column of words says that it charges.

    Raises
    ------
    InputError
        If the words do not state the direction of each current.
    """
    current, headings = draft.values["current_a"], [*draft.headings]
    places = [
        place
        for place, text in enumerate(headings)
        if headings.count(text) == 1 and _STATES.search(text.lower())
    ]
    for place, column in table.columns(places, optional=places).items() if places else ():
        cells = pc.fill_null(pc.utf8_lower(column.cast(pa.string())), "")
        flag = parse_heading(headings[place])
        ways = [_CHARGES, _DISCHARGES]
        if flag.way and _FLAG.fullmatch(flag.name.replace(flag.way, "")):
            answers = (_NO, _YES) if flag.is_discharge else (_YES, _NO)
            ways = [f"{words}|{answer}" for words, answer in zip(ways, answers, strict=True)]
        charges, discharges = (
            np.asarray(pc.match_substring_regex(cells, words), dtype=bool) & (current > 0.0)
            for words in ways
        )
        is_direction = "direction" in headings[place].lower() and len(pc.unique(cells)) > 1
        if not (charges.any() and discharges.any()) and not is_direction:
            continue
        unclear = np.flatnonzero((current > 0.0) & (charges == discharges))
        if unclear.size:
            row = int(unclear[0])
            lacks = "does not say whether the unsigned current charges or discharges"
            cure = "write it as charge or discharge, or give the current a sign"
            raise draft.error(headings[place], f"row {row + 1} {lacks}", cure, cells[row].as_py())
        draft.values["current_a"] = np.where(charges, -current, current)
        draft.sign_by = "format"
        draft.assumed.append(f'current charges where "{headings[place]}" says so')
        return


def _take_time(
    draft: DraftLog, column: ChosenColumn, cells: dict[int, Any], beside: str
) -> tuple[ChosenColumn, str]:
    """Take the time [s]; return its column and its reading; of several, one that increases.

    A date beside a clock time is read with it, unless the user named the clock. `beside` is the
    unit that a column beside states.
    """
    column = replace(column, unit=column.unit or beside)
    name, where = FIELDS["time"], draft.where

    def read(column: ChosenColumn) -> tuple[FloatArray, str]:
        _label(draft, name, column, " + ")
        parts = [cells[place] for place in column.places]
        label = draft.labels[name]
        return seconds_of(parts, column.unit, column.factor, source=where, label=label)

    others = sorted(column.others)
    if others and is_clock(first_text(cells[column.places[0]])):
        for date in [place for place, _ in others if _is_date(first_text(cells[place]))][:1]:
            column, others = replace(column, places=(date, *column.places)), []
    time_s, how = read(column)
    for place, meaning in column.others if others and not _increases(time_s) else ():
        other = replace(column, places=(place,), unit=meaning.unit)
        with suppress(InputError):
            if meaning.rank < Rank.GUESS and _increases(read(other)[0]):
                column, (time_s, how) = other, read(other)
                break
    _label(draft, name, column, " + ")
    known_s = time_s[np.isfinite(time_s)]
    if known_s.size > 1 and known_s.min() == known_s.max():
        cure = "name another one: --columns time=…"
        raise draft.error(name, "this column does not move: it is no time", cure, float(known_s[0]))
    if "without zone" in how:
        cure = f"state the zone of its dates, such as --columns 'time={draft.labels[name]}"
        draft.remarks += changes_of_clock(
            time_s, where, draft.labels[name], f"{cure}[Europe/Berlin]'"
        )
    draft.values[name] = time_s
    if how == "s, assumed":
        draft.in_seconds = False if column.is_stated else None
    elif unit_of(name, how) is None:  # dates, clock times, ticks since a date
        draft.in_seconds = True
    return column, how


def _label(draft: DraftLog, name: str, column: ChosenColumn, joint: str) -> list[str]:
    """Note the headings of a quantity, and whether the user states its unit; return them."""
    texts = [draft.headings[place] for place in column.places]
    draft.labels[name] = joint.join(texts)
    if column.is_stated:
        draft.stated.add(name)
    return texts


def _is_date(text: str) -> bool:
    return ":" not in text and not is_number(text) and is_stamp(text)


def _increases(time_s: FloatArray) -> bool:
    """Return whether times never fall, and rise from most rows to the next."""
    steps = np.diff(time_s[np.isfinite(time_s)])
    return bool(np.all(steps >= 0.0)) and 2 * int(np.count_nonzero(steps)) > steps.size


def _hold_changes(draft: DraftLog) -> None:
    """Hold the latest voltage and temperature at each current, if rows hold only what changed."""
    values = draft.values
    time, current, voltage = (values[name] for name in REQUIRED[:3])
    whole = np.isfinite(time + current + voltage + values.get("temperature_c", time))
    at = np.flatnonzero(np.isfinite(time + current))
    if np.mean(whole) >= 1.0 - MAX_INCOMPLETE or not at.size:
        return
    rows = _latest(time + voltage, at)
    age_s = time[at] - time[rows]
    is_near = (rows <= at) & (age_s <= HOLD_S)
    if np.mean(is_near) < 0.5:
        return
    at, rows, age_s = at[is_near], rows[is_near], age_s[is_near]
    draft.values = {"time_s": time[at], "current_a": current[at], "voltage_v": voltage[rows]}
    for name in values.keys() - draft.values.keys():
        rows = _latest(time + values[name], at)
        draft.values[name] = values[name][rows]
        if name != "temperature_c":  # its first value also holds before it
            draft.values[name][rows > at] = np.nan
    draft.remarks.append(
        f"rows hold only what changed: {at.size} rows with a current kept, with the latest voltage"
        f" (at most {float(age_s.max()):.2g} s old) and temperature"
    )


def _latest(values: FloatArray, at: IntArray) -> IntArray:
    """Return by row the latest one whose value is known, the first where none is known before."""
    known = np.flatnonzero(np.isfinite(values))
    latest = np.searchsorted(known, at, side="right") - 1
    return known[np.maximum(latest, 0)] if known.size else at
