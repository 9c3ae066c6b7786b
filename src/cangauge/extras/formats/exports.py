"""Logs whose format defines columns and sign: BMW i3 trips, Argonne D3 tests, cyclers' exports."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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

# One heading of the i3 trips misspells the unit's bracket: `max. SoC [%)`; D3's units follow `__`.
_HEADING: Final = re.compile(
    r"^(?P<name>.*?)\s*(?:\[(?P<square>[^\])]*)[\])]|__(?P<tail>[^_\s]*))?\s*$"
)


class _Column(NamedTuple):
    """A heading; `simple` is it without unit, spaces and underscores, in lower case."""

    place: int
    text: str
    simple: str
    unit: str


def _columns(line: str, delimiter: str) -> list[_Column]:
    found = []
    for place, text in enumerate(split_cells(line, delimiter)):
        match = _HEADING.match(text) if len(text) <= LONGEST else None
        name = match["name"] if match else text
        unit = (match["square"] or match["tail"] or "") if match else ""
        found.append(_Column(place, text, re.sub(r"[\s_]", "", name).lower(), unit))
    return found


def _find(columns: Sequence[_Column], *patterns: str) -> _Column | None:
    matches = (
        column for pattern in patterns for column in columns if re.fullmatch(pattern, column.simple)
    )
    return next(matches, None)


class _Text:
    """Wanted columns of a delimited text by name, and the draft that they fill."""

    def __init__(
        self,
        head: Head,
        delimiter: str,
        header: Sequence[str],
        skip_lines: int,
        wanted: Mapping[str, _Column | None],
    ) -> None:
        table = TextTable(head, delimiter, header, (), skip_lines, [])
        self.wanted = {name: column for name, column in wanted.items() if column is not None}
        self._cells = table.columns([column.place for column in self.wanted.values()])
        self._shown = shown_headings(header)
        self.draft = DraftLog(head.name, str(head.path), remarks=[*table.remarks])

    def cells(self, name: str) -> Any:
        return self._cells[self.wanted[name].place]

    def values(self, name: str, field: str) -> FloatArray:
        """Return a column in the canonical unit of a field, with a remark if it is converted."""
        source, label = self.draft.source, self.wanted[name].text
        numbers, _ = numbers_of(self.cells(name), source, label)
        unit = self.wanted[name].unit
        values = convert(numbers, field, unit, source=source, label=label)
        if values is not numbers:
            self.draft.remarks.append(f"{label}: converted from {unit} to {field}")
        return values

    def take(self, field: str, name: str = "", values: FloatArray | None = None) -> None:
        name = name or field
        self.draft.values[field] = self.values(name, field) if values is None else values
        self.draft.labels[field] = self.wanted[name].text

    def require(self, *fields: str) -> None:
        for field in fields:
            if field not in self.draft.values:
                raise InputError(
                    f"no column of this file holds it (found: {self._shown})",
                    source=self.draft.source,
                    field=field,
                    cure="check the export, or convert it to a canonical log",
                )


class BmwI3Trip:
    """A trip of "Battery and Heating Data in Real Driving Cycles"; its SoC is the car's own."""

    takes_columns = False
    _FIELDS: Final = {
        "time_s": "time",
        "current_a": "batterycurrent",
        "voltage_v": "batteryvoltage",
        "temperature_c": "batterytemperature",
        "soc_pct": "soc",
    }

    def matches(self, head: Head) -> bool:
        """Return whether the header is a trip's."""
        line = head.first_line.lower()
        return line.startswith("time [s];") and "battery voltage [" in line

    def read(self, head: Head, _given: ColumnMap | None = None, /) -> DraftLog:
        """Read a trip; discharge is stored as negative current."""
        header = _columns(head.lines[0], ";")
        wanted = {field: _find(header, name) for field, name in self._FIELDS.items()}
        text = _Text(head, ";", [column.text for column in header], 1, wanted)
        for field in text.wanted:
            text.take(field)
        text.require("time_s", "current_a", "voltage_v")
        text.draft.temperature_source = "pack"
        text.draft.negate_current("i3 trips store discharge as negative")
        return text.draft


class D3Test:
    """A 10 Hz test of Argonne's Downloadable Dynamometer Database: tab-separated text.

    Headings differ between years. Positive current discharges; a copy from the car's CAN may have
    the opposite sign, which is then found from the data. `Cell Temp` is the temperature of the
    test room. Rows before time 0 (the wait before the test) are dropped.
    """

    takes_columns = False
    _CAN: Final = "car's CAN"
    # In order of preference: instruments before copies from CAN, the 500 A clamp before the other.
    _INSTRUMENTS: Final = {
        "500 A clamp": r"hvbattery{0}w/?500amaxclamp",
        "200 A clamp": r"hvbattery{0}w/?200amaxclamp",
        "HV battery channels": "hvbattery{0}",
        "power analyser": r"hvbatt{1}hioki\w*",
        _CAN: r"hvbatt(ery)?({0}|{1})\w*can\d*",
    }
    _WORDS: Final = {"current_a": ("current", "curr"), "voltage_v": ("voltage", "volt")}
    _OTHERS: Final = {
        "time_s": (r"time(stamp)?", "daqtime"),
        "temperature_c": (r"(test)?celltemp(erature)?",),
        "soc_pct": ("hvbatterysoc", r"hvbatt(ery)?soc(can\d*)?"),
    }

    def matches(self, head: Head) -> bool:
        """Return whether the header is a test's."""
        if "\t" not in head.first_line:
            return False
        header = _columns(head.first_line, "\t")
        has_time = _find(header, *self._OTHERS["time_s"]) is not None
        return has_time and any(c.simple.startswith(("hvbatt", "dyno")) for c in header)

    def read(self, head: Head, _given: ColumnMap | None = None, /) -> DraftLog:
        """Read a test."""
        header = _columns(head.lines[0], "\t")
        wanted = {field: _find(header, *names) for field, names in self._OTHERS.items()}
        for instrument, pattern in self._INSTRUMENTS.items():
            for field, words in self._WORDS.items():
                wanted[f"{instrument} {field}"] = _find(header, pattern.format(*words))
        text = _Text(head, "\t", [column.text for column in header], 1, wanted)
        draft = text.draft
        for field in self._OTHERS:
            if field in text.wanted:
                text.take(field)
        text.require("time_s")
        if "temperature_c" in draft.labels:
            draft.temperature_source = "room"
            label = draft.labels["temperature_c"]
            draft.remarks.append(f"{label} is the temperature of the test room, not the battery's")
        self._take_instrument(text)
        text.require("current_a", "voltage_v")
        waiting = draft.values["time_s"] < 0.0
        if waiting.all():
            problem, cure = "all rows are before time 0", "check the export"
            label = draft.labels["time_s"]
            raise InputError(problem, source=draft.source, field=label, cure=cure)
        draft.keep(~waiting, "before time 0 (the wait before the test) dropped")
        return draft

    def _take_instrument(self, text: _Text) -> None:
        """Take current and voltage from the first instrument that has both, else from the first."""
        taken: dict[str, tuple[str, FloatArray]] = {}
        for instrument in self._INSTRUMENTS:
            own = {}
            for field in self._WORDS:
                name = f"{instrument} {field}"
                if name in text.wanted:
                    values = text.values(name, field)
                    if np.isfinite(values).any():
                        own[field] = instrument, values
                    else:
                        label = text.wanted[name].text
                        text.draft.remarks.append(f"{label} is empty and was not used")
            if len(own) == len(self._WORDS):
                taken = own
                break
            taken = {**own, **taken}
        for field in self._WORDS:
            if field in taken:
                instrument, values = taken[field]
                text.take(field, f"{instrument} {field}", values)
                text.draft.remarks.append(f"{field} from the {instrument}")
                text.draft.sign_unknown |= field == "current_a" and instrument == self._CAN


@dataclass(frozen=True, slots=True)
class CyclerExport:
    """A cycler's export as comma-separated text, known by its headings (in lower case).

    `must_have` is a further heading. `charges`: positive current charges. `sensors` begins the
    headings of temperature sensors, whose median is taken; `ambient` is the room's, taken where
    there is none. `set_point` is the regular expression of a temperature in the file name, the
    chamber's set point (`_P25_`: +25 °C, `_N05_`: −5 °C; `HPPC-40C`: 40 °C; `2C-Discharge` is a
    rate). `bare` is the header of files that have none; they mark rows to `exclude`.
    """

    name: str
    time: str
    current: str
    voltage: str
    must_have: str = ""
    charges: bool = True
    set_point: str = ""
    sensors: str = ""
    ambient: str = ""
    bare: str = ""
    takes_columns = False

    def matches(self, head: Head) -> bool:
        """Return whether the file begins like this cycler's export."""
        return self._header(head) is not None

    def _header(self, head: Head) -> tuple[list[str], int] | None:
        """Return the header, and the number of lines before the data."""
        wanted = {self.time, self.current, self.voltage} | {self.must_have} - {""}
        for number, line in enumerate(head.lines[:40]):
            header = split_cells(line, ",")
            if wanted <= {cell.lower() for cell in header}:
                return header, number + 1
        first = split_cells(head.first_line, ",")
        is_bare = self.bare and len(first) >= 14 and first[0] in {"No", "Yes"}
        if is_bare and first[13] in {"REST", "CHRG", "DCHG", "PAUS"}:
            return self.bare.split(","), 0
        return None

    def read(self, head: Head, _given: ColumnMap | None = None, /) -> DraftLog:
        """Read an export."""
        header, skip_lines = self._header(head) or ([], 0)
        columns = [_Column(k, text, text.lower(), "") for k, text in enumerate(header)]
        names = {
            "time_s": self.time,
            "current_a": self.current,
            "voltage_v": self.voltage,
            "ambient": self.ambient,
            "exclude": self.bare and "exclude",
        }
        wanted = {
            field: next((column for column in columns if name and column.simple == name), None)
            for field, name in names.items()
        }
        sensors = {
            f"sensor {column.place}": column
            for column in columns
            if self.sensors and column.simple.startswith(self.sensors)
        }
        text = _Text(head, ",", header, skip_lines, {**wanted, **sensors})
        draft = text.draft
        draft.remarks.insert(0, f"{self.name} export")
        for field in REQUIRED[:3]:
            text.take(field)
        if self.charges:
            draft.negate_current(f"{self.name} stores discharge as negative")
        self._take_temperature(text, head.path.name, list(sensors))
        if "exclude" in text.wanted:
            excluded = pc.equal(pc.utf8_trim_whitespace(text.cells("exclude")), "Yes")
            is_excluded = np.asarray(pc.fill_null(excluded, fill_value=False), dtype=bool)
            draft.keep(~is_excluded, "that the cycler excludes dropped")
        return draft

    def _take_temperature(self, text: _Text, file_name: str, sensors: list[str]) -> None:
        """Take the sensors on the cell, else the room's temperature or the set point, if any."""
        draft = text.draft
        probes = {name: text.values(name, "temperature_c") for name in sensors}
        probes = {name: each for name, each in probes.items() if np.isfinite(each).any()}
        if probes:
            draft.take_probes([text.wanted[name].text for name in probes], list(probes.values()))
            draft.temperature_source = "cell"
            if len(probes) > 1:
                draft.remarks.append(f"temperature: median of {len(probes)} columns")
        elif "ambient" in text.wanted:
            text.take("temperature_c", "ambient")
            draft.temperature_source = "room"
            draft.remarks.append("temperature: the room's")
        found = list(re.finditer(self.set_point or "(?!)", file_name, re.IGNORECASE))
        if len(found) == 1 and not sensors:
            groups = found[0].groupdict()
            value_c = float(groups["value"]) * (-1.0 if groups.get("sign") == "N" else 1.0)
            draft.values["temperature_c"] = np.full(draft.values["time_s"].size, value_c)
            draft.temperature_source = "room"
            shown = f"temperature {value_c:g} °C from the file name: the chamber's set point"
            draft.remarks.append(shown)


_SIGNED: Final = r"_(?P<sign>[NP])(?P<value>\d\d)(?=[_.])"
_BDF: Final = "Battery Data Format"
READERS: Final = (
    BmwI3Trip(),
    D3Test(),
    CyclerExport(
        "Arbin",
        "test_time(s)",
        "current(a)",
        "voltage(v)",
        "step_index",
        set_point=_SIGNED,
        sensors="aux_temperature",
    ),
    CyclerExport(
        "ESC dynamic test",
        "time",
        "current",
        "voltage",
        "disah",
        charges=False,
        set_point=_SIGNED,
    ),
    CyclerExport(
        "Bitrode",
        "time(s)",
        "current(a)",
        "voltage(v)",
        "exclude",
        set_point=r"HPPC-(?P<value>\d+)C(?=[-_.])",
        bare="exclude,time(s),cycle,loop,loop,loop,step,steptime(s),current(a),voltage(v),"
        "power(w),capacity(ah),energy(wh),mode,data",
    ),
    CyclerExport(
        "VisuaLCN", "total time", "current", "voltage", "amp-hours", sensors="temperature "
    ),
    # Battery Data Format of the Battery Data Alliance (package batterydf), with its labels and its
    # machine-readable names, and the schema of the package battery-data-standard. The former does
    # not state the sign: its net capacity is charge less discharge, so that positive charges, as
    # in the latter. All columns but three are optional, and may be empty.
    CyclerExport(
        _BDF,
        "test time / s",
        "current / a",
        "voltage / v",
        sensors="surface temperature t",
        ambient="ambient temperature / degc",
    ),
    CyclerExport(
        _BDF,
        "test_time_second",
        "current_ampere",
        "voltage_volt",
        sensors="temperature_t",
        ambient="ambient_temperature_celsius",
    ),
    CyclerExport(
        "battery-data-standard",
        "test_time_s",
        "current_a",
        "voltage_v",
        sensors="temperature_t",
        ambient="ambient_temperature_deg_c",
    ),
)
