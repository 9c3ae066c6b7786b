"""Logs whose format defines columns and sign: BMW i3 trips, Argonne D3 tests, cyclers' exports."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow.compute as pc

from cangauge._files import Head
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.columns import shown_headings
from cangauge.logs.draft import DraftLog
from cangauge.logs.headings import LONGEST
from cangauge.logs.quantities import REQUIRED, convert
from cangauge.logs.text import TextTable, split_cells
from cangauge.logs.values import numbers_of
from cangauge.settings import TemperatureSource

# One heading of the i3 trips misspells the unit's bracket: `max. SoC [%)`; D3's units follow `__`.
_UNIT: Final = re.compile(r"\s*(?:\[([^\])]*)[\])]|__([^_\s]*))?\s*$")


class _Column(NamedTuple):
    """A heading; `simple` is it without unit, blanks and underscores, in lower case."""

    place: int
    text: str
    simple: str
    unit: str


def _columns(cells: Sequence[str]) -> list[_Column]:
    found = []
    for place, text in enumerate(cells):
        match = _UNIT.search(text[:LONGEST])
        name, unit = (text[: match.start()], match[1] or match[2] or "") if match else (text, "")
        found.append(_Column(place, text, re.sub(r"[\s_]", "", name).lower(), unit))
    return found


def _find(columns: Sequence[_Column], patterns: Sequence[str]) -> _Column | None:
    matches = (
        column for pattern in patterns for column in columns if re.fullmatch(pattern, column.simple)
    )
    return next(matches, None)


class _Cells:
    """The wanted columns of an export, read, and the draft that they fill."""

    def __init__(self, table: TextTable, wanted: dict[str, _Column]) -> None:
        self._cells = table.columns([column.place for column in wanted.values()])
        self._found = f"found: {shown_headings(table.headings)}"
        self.wanted = wanted
        self.draft = DraftLog(table.head.name, str(table.head.path), remarks=[*table.remarks])

    def values(self, name: str, quantity: str) -> FloatArray:
        """Return a column in the canonical unit, with a remark if it is converted."""
        column, source = self.wanted[name], self.draft.source
        numbers, _ = numbers_of(self._cells[column.place], source, column.text)
        values = convert(numbers, quantity, column.unit, source=source, label=column.text)
        if values is not numbers:
            self.draft.remarks.append(f"{column.text}: converted from {column.unit} to {quantity}")
        return values

    def take(self, quantity: str, name: str, values: FloatArray) -> None:
        self.draft.values[quantity] = values
        self.draft.labels[quantity] = self.wanted[name].text

    def require(self, *quantities: str) -> None:
        for quantity in quantities:
            if quantity not in self.draft.values:
                problem = f"no column of this file holds it ({self._found})"
                cure = "check the export, or convert it to a canonical log"
                raise InputError(problem, source=self.draft.source, field=quantity, cure=cure)

    def says_yes(self, name: str) -> Any:
        yes = pc.equal(pc.utf8_trim_whitespace(self._cells[self.wanted[name].place]), "Yes")
        return np.asarray(pc.fill_null(yes, fill_value=False), dtype=bool)


@dataclass(frozen=True, slots=True)
class Export:
    """A text whose format defines columns, units and sign.

    Parameters
    ----------
    name : str
        Of the format; a remark names it.
    known_by : tuple of str
        Regular expressions, each of which matches a heading (in lower case) of such a file.
    columns : dict
        Regular expressions of a quantity's headings, the preferred first.
    delimiter : str
    charges : bool
        Positive current charges.
    source : str
        Place of the sensors of temperature.
    sensors, ambient : str
        Headings of the temperatures whose median is taken, and of the room's, taken without any.
    set_point : str
        Regular expression of a temperature in the file name, the chamber's set point (`_P25_`:
        +25 °C, `_N05_`: −5 °C; `HPPC-40C`: 40 °C; `2C-Discharge` is a rate).
    bare : str
        Header of files that have none; they mark rows to `exclude`.
    """

    name: str
    known_by: tuple[str, ...]
    columns: dict[str, tuple[str, ...]] = field(default_factory=dict)
    delimiter: str = ","
    charges: bool = True
    source: TemperatureSource = "cell"
    sensors: str = "(?!)"
    ambient: str = "(?!)"
    set_point: str = "(?!)"
    bare: str = ""
    takes_columns = False

    def matches(self, head: Head) -> bool:
        """Return whether the file begins like this export."""
        return self._header(head) is not None

    def _header(self, head: Head) -> tuple[list[str], int] | None:
        """Return the header, and the number of lines before the data."""
        for number, line in enumerate(head.lines[:40]):
            if self.delimiter not in line:
                continue
            header = split_cells(line, self.delimiter)
            lower = [cell.lower() for cell in header]
            if all(any(re.fullmatch(each, cell) for cell in lower) for each in self.known_by):
                return header, number + 1
        first = split_cells(head.first_line, self.delimiter)
        is_bare = self.bare and len(first) >= 14 and first[0] in {"No", "Yes"}
        if is_bare and first[13] in {"REST", "CHRG", "DCHG", "PAUS"}:
            return self.bare.split(","), 0
        return None

    def read(self, head: Head, _given: ColumnMap | None = None, /) -> DraftLog:
        """Read an export."""
        header, skip_lines = self._header(head) or ([], 0)
        columns = _columns(header)
        more = {"ambient": (self.ambient,), "exclude": ("exclude",) if self.bare else ()}
        wanted = {
            name: column
            for name, patterns in (self.columns | more).items()
            if (column := _find(columns, patterns)) is not None
        }
        sensors = [column for column in columns if re.fullmatch(self.sensors, column.simple)]
        wanted |= {column.text: column for column in sensors}
        table = TextTable(head, self.delimiter, header, (), skip_lines, [])
        cells = _Cells(table, wanted)
        cells.draft.remarks.insert(0, f"{self.name} export")
        self._take(cells)
        self._take_temperature(cells, head.path.name, [column.text for column in sensors])
        self._drop(cells)
        return cells.draft

    def _take(self, cells: _Cells) -> None:
        """Take all but the temperature."""
        for quantity in (*REQUIRED[:3], "soc_pct"):
            if quantity in cells.wanted:
                cells.take(quantity, quantity, cells.values(quantity, quantity))
        cells.require(*REQUIRED[:3])
        if self.charges:
            cells.draft.negate_current(f"{self.name} stores discharge as negative")

    def _drop(self, cells: _Cells) -> None:
        """Drop rows that are not of the test."""
        if "exclude" in cells.wanted:
            cells.draft.keep(~cells.says_yes("exclude"), "that the cycler excludes dropped")

    def _take_temperature(self, cells: _Cells, file_name: str, sensors: Sequence[str]) -> None:
        """Take the sensors, else the room's temperature or the set point, if any."""
        draft = cells.draft
        probes = {name: cells.values(name, "temperature_c") for name in sensors}
        probes = {name: each for name, each in probes.items() if np.isfinite(each).any()}
        if probes:
            draft.take_probes([*probes], [*probes.values()])
            draft.labels["temperature_c"] = next(iter(probes))
            draft.temperature_source = self.source
            if len(probes) > 1:
                draft.remarks.append(f"temperature: median of {len(probes)} columns")
        elif "ambient" in cells.wanted:
            cells.take("temperature_c", "ambient", cells.values("ambient", "temperature_c"))
            draft.temperature_source = "room"
            draft.remarks.append("temperature: the room's, not the battery's")
        found = list(re.finditer(self.set_point, file_name, re.IGNORECASE))
        if len(found) == 1 and not sensors:
            groups = found[0].groupdict()
            value_c = float(groups["value"]) * (-1.0 if groups.get("sign") == "N" else 1.0)
            draft.values["temperature_c"] = np.full(draft.values["time_s"].size, value_c)
            draft.temperature_source = "room"
            shown = f"temperature {value_c:g} °C from the file name: the chamber's set point"
            draft.remarks.append(shown)


_CAN: Final = "car's CAN"
_INSTRUMENTS: Final = {
    "500 A clamp": r"hvbattery{0}w/?500amaxclamp",
    "200 A clamp": r"hvbattery{0}w/?200amaxclamp",
    "HV battery channels": "hvbattery{0}",
    "power analyser": r"hvbatt{1}hioki\w*",
    _CAN: r"hvbatt(ery)?({0}|{1})\w*can\d*",
}
"""D3's channels, the preferred first: instruments before copies from CAN."""
_WORDS: Final = {"current_a": ("current", "curr"), "voltage_v": ("voltage", "volt")}


@dataclass(frozen=True, slots=True)
class D3Test(Export):
    """A 10 Hz test of Argonne's Downloadable Dynamometer Database: tab-separated text.

    Headings differ between years. Positive current discharges; a copy from the car's CAN may have
    the opposite sign, which is then found from the data. `Cell Temp` is the temperature of the
    test room. Rows before time 0 (the wait before the test) are dropped.
    """

    def _take(self, cells: _Cells) -> None:
        """Take time, SoC, and current and voltage of the first instrument that has both."""
        draft = cells.draft
        for quantity in ("time_s", "soc_pct"):
            if quantity in cells.wanted:
                cells.take(quantity, quantity, cells.values(quantity, quantity))
        cells.require("time_s")
        taken: dict[str, tuple[str, FloatArray]] = {}
        for instrument in _INSTRUMENTS:
            own = {}
            for quantity in _WORDS:
                name = f"{instrument} {quantity}"
                if name not in cells.wanted:
                    continue
                values = cells.values(name, quantity)
                if np.isfinite(values).any():
                    own[quantity] = instrument, values
                else:
                    draft.remarks.append(f"{cells.wanted[name].text} is empty and was not used")
            taken = own if len(own) == len(_WORDS) else {**own, **taken}
            if len(own) == len(_WORDS):
                break
        for quantity, (instrument, values) in sorted(taken.items()):
            cells.take(quantity, f"{instrument} {quantity}", values)
            draft.remarks.append(f"{quantity} from the {instrument}")
            draft.sign_unknown |= quantity == "current_a" and instrument == _CAN
        cells.require("current_a", "voltage_v")

    def _drop(self, cells: _Cells) -> None:
        """Drop the wait before the test."""
        draft = cells.draft
        waiting = draft.values["time_s"] < 0.0
        if waiting.all():
            problem, label = "all rows are before time 0", draft.labels["time_s"]
            raise InputError(problem, source=draft.source, field=label, cure="check the export")
        draft.keep(~waiting, "before time 0 (the wait before the test) dropped")


def _cycler(name: str, time: str, current: str, voltage: str, *more: str, **how: Any) -> Export:
    """Return a cycler's export by its headings, in lower case."""
    headings = time, current, voltage
    columns: dict[str, tuple[str, ...]] = {
        quantity: (re.escape(re.sub(r"[\s_]", "", heading)),)
        for quantity, heading in zip(REQUIRED, headings, strict=False)
    }
    return Export(name, tuple(map(re.escape, (*headings, *more))), columns, **how)


_SIGNED: Final = r"_(?P<sign>[NP])(?P<value>\d\d)(?=[_.])"
_BDF: Final = "Battery Data Format"
READERS: Final = (
    # "Battery and Heating Data in Real Driving Cycles"; its SoC is the car's own.
    Export(
        "BMW i3",
        (r"time \[s\]", r"battery voltage \[.*"),
        {
            "time_s": ("time",),
            "current_a": ("batterycurrent",),
            "voltage_v": ("batteryvoltage",),
            "soc_pct": ("soc",),
        },
        delimiter=";",
        sensors="batterytemperature",
        source="pack",
    ),
    D3Test(
        "ANL D3",
        (r"(daq[ _]?)?time(stamp)?\s*(\[.*|__.*)?", "(hv[ _]?batt|dyno).*"),
        {
            "time_s": (r"time(stamp)?", "daqtime"),
            "soc_pct": ("hvbatterysoc", r"hvbatt(ery)?soc(can\d*)?"),
            **{
                f"{instrument} {quantity}": (pattern.format(*words),)
                for (instrument, pattern), (quantity, words) in product(
                    _INSTRUMENTS.items(), _WORDS.items()
                )
            },
        },
        delimiter="\t",
        ambient=r"(test)?celltemp(erature)?",
    ),
    _cycler(
        "Arbin",
        "test_time(s)",
        "current(a)",
        "voltage(v)",
        "step_index",
        set_point=_SIGNED,
        sensors="(aux)?temperature.*",
    ),
    _cycler(
        "ESC dynamic test",
        "time",
        "current",
        "voltage",
        "disah",
        charges=False,
        set_point=_SIGNED,
    ),
    _cycler(
        "Bitrode",
        "time(s)",
        "current(a)",
        "voltage(v)",
        "exclude",
        set_point=r"HPPC-(?P<value>\d+)C(?=[-_.])",
        bare="exclude,time(s),cycle,loop,loop,loop,step,steptime(s),current(a),voltage(v),"
        "power(w),capacity(ah),energy(wh),mode,data",
    ),
    _cycler("VisuaLCN", "total time", "current", "voltage", "amp-hours", sensors="temperature.+"),
    # Battery Data Format of the Battery Data Alliance (package batterydf), with its labels and its
    # machine-readable names, and the schema of the package battery-data-standard. The former does
    # not state the sign: its net capacity is charge less discharge, so that positive charges, as
    # in the latter. All columns but three are optional, and may be empty.
    _cycler(
        _BDF,
        "test time / s",
        "current / a",
        "voltage / v",
        sensors="surfacetemperaturet.*",
        ambient="ambienttemperature/degc",
    ),
    _cycler(
        _BDF,
        "test_time_second",
        "current_ampere",
        "voltage_volt",
        sensors="temperaturet.*",
        ambient="ambienttemperaturecelsius",
    ),
    _cycler(
        "battery-data-standard",
        "test_time_s",
        "current_a",
        "voltage_v",
        sensors="temperaturet.*",
        ambient="ambienttemperaturedegc",
    ),
)
