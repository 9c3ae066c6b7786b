"""Logs whose format defines columns and sign: BMW i3 trips, Argonne D3 tests, cyclers' exports."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge._files import Head
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.cells import numbers_of
from cangauge.logs.column_map import ColumnMap, shown_headings
from cangauge.logs.draft import DraftLog
from cangauge.logs.headings import LONGEST
from cangauge.logs.text import TextTable, split_cells
from cangauge.logs.units import convert

# One heading of the i3 trips misspells the unit's bracket: `max. SoC [%)`; D3's units follow `__`.
_HEADING: Final = re.compile(
    r"^(?P<name>.*?)\s*(?:\[(?P<square>[^\])]*)[\])]|__(?P<tail>[^_\s]*))?\s*$"
)


@dataclass(frozen=True, slots=True)
class _Column:
    place: int
    text: str
    simple: str
    """Without unit, spaces and underscores, in lower case."""
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
    """Values of a delimited text by a name for each column."""

    def __init__(
        self, head: Head, delimiter: str, header: Sequence[str], skip_lines: int,
        wanted: Mapping[str, tuple[int, str]],
    ) -> None:  # fmt: skip
        self.table = TextTable(head, delimiter, header, (), skip_lines, [])
        self._wanted = wanted
        self._columns = self.table.columns([place for place, _ in wanted.values()])
        self.draft = DraftLog(head.name, str(head.path), remarks=[*self.table.remarks])

    def label(self, name: str) -> str:
        place = self._wanted[name][0]
        headings = self.table.headings
        return headings[place] if place < len(headings) else f"column {place + 1}"

    def values(self, name: str, field: str) -> FloatArray:
        """Return a column in the canonical unit of a field, with a remark if it is converted."""
        place, unit = self._wanted[name]
        source, label = self.draft.source, self.label(name)
        numbers, _ = numbers_of(self._columns[place], source, label)
        values, remark = convert(numbers, field, unit, source=source, label=label)
        self.draft.remarks.extend([remark] if remark else [])
        return values

    def cells(self, name: str) -> list[str]:
        return [str(cell).strip() for cell in self._columns[self._wanted[name][0]].to_pylist()]

    def take(self, field: str, name: str = "") -> None:
        self.draft.values[field] = self.values(name or field, field)
        self.draft.labels[field] = self.label(name or field)


def _require(draft: DraftLog, columns: Sequence[_Column], *fields: str) -> None:
    for field in fields:
        if field not in draft.values:
            shown = shown_headings([column.text for column in columns])
            raise InputError(
                f"no column of this file holds it (found: {shown})",
                source=draft.source,
                field=field,
                cure="check the export, or convert it to a canonical log",
            )


class BmwI3Trip:
    """A trip of "Battery and Heating Data in Real Driving Cycles"; its SoC is the car's own."""

    name = "BMW i3 trip"
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
        found = {field: _find(header, name) for field, name in self._FIELDS.items()}
        wanted = {field: (c.place, c.unit) for field, c in found.items() if c is not None}
        text = _Text(head, ";", [column.text for column in header], 1, wanted)
        for field in wanted:
            text.take(field)
        _require(text.draft, header, "time_s", "current_a", "voltage_v")
        text.draft.temperature_source = "pack"
        text.draft.negate_current("i3 trips store discharge as negative")
        return text.draft


class D3Test:
    """A 10 Hz test of Argonne's Downloadable Dynamometer Database: tab-separated text.

    Headings differ between years. Positive current discharges; a copy from the car's CAN may have
    the opposite sign, which is then found from the data. `Cell Temp` is the temperature of the
    test room. Rows before time 0 (the wait before the test) are dropped.
    """

    name = "ANL D3 test"
    takes_columns = False
    _CAN: Final = "car's CAN"
    # In order of preference: instruments before copies from CAN, the 500 A clamp before the other.
    _INSTRUMENTS: Final[dict[str, dict[str, str]]] = {
        "500 A clamp": {
            "current_a": r"hvbatterycurrentw/?500amaxclamp",
            "voltage_v": r"hvbatteryvoltagew/?500amaxclamp",
        },
        "200 A clamp": {
            "current_a": r"hvbatterycurrentw/?200amaxclamp",
            "voltage_v": r"hvbatteryvoltagew/?200amaxclamp",
        },
        "HV battery channels": {"current_a": "hvbatterycurrent", "voltage_v": "hvbatteryvoltage"},
        "power analyser": {
            "current_a": r"hvbattcurrhioki\w*",
            "voltage_v": r"hvbattvolthioki\w*",
        },
        _CAN: {
            "current_a": r"hvbatt(ery)?curr(ent)?\w*can\d*",
            "voltage_v": r"hvbatt(ery)?volt(age)?\w*can\d*",
        },
    }
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
        found = {field: _find(header, *names) for field, names in self._OTHERS.items()}
        for instrument, names in self._INSTRUMENTS.items():
            found |= {f"{instrument} {field}": _find(header, n) for field, n in names.items()}
        wanted = {name: (c.place, c.unit) for name, c in found.items() if c is not None}
        text = _Text(head, "\t", [column.text for column in header], 1, wanted)
        draft = text.draft
        for field in self._OTHERS:
            if field in wanted:
                text.take(field)
        _require(draft, header, "time_s")
        if "temperature_c" in wanted:
            draft.temperature_source = "room"
            label = draft.labels["temperature_c"]
            draft.remarks.append(f"{label} is the temperature of the test room, not the battery's")
        self._take_instrument(text, wanted)
        _require(draft, header, "current_a", "voltage_v")
        waiting = draft.values["time_s"] < 0.0
        if waiting.all():
            problem, cure = "all rows are before time 0", "check the export"
            label = draft.labels["time_s"]
            raise InputError(problem, source=draft.source, field=label, cure=cure)
        draft.keep(~waiting, "before time 0 (the wait before the test) dropped")
        return draft

    def _take_instrument(self, text: _Text, wanted: Mapping[str, object]) -> None:
        """Take current and voltage from the first instrument that has both, else from the first."""
        filled: dict[str, dict[str, FloatArray]] = {"current_a": {}, "voltage_v": {}}
        for instrument in self._INSTRUMENTS:
            for field, of_field in filled.items():
                column = f"{instrument} {field}"
                if column not in wanted:
                    continue
                values = text.values(column, field)
                if np.isfinite(values).any():
                    of_field[instrument] = values
                else:
                    label = text.label(column)
                    text.draft.remarks.append(f"{label} is empty and was not used")
            if all(instrument in of_field for of_field in filled.values()):
                filled = {field: {instrument: of[instrument]} for field, of in filled.items()}
                break
        for field, of_field in filled.items():
            if of_field:
                instrument, values = next(iter(of_field.items()))
                text.draft.values[field] = values
                text.draft.labels[field] = text.label(f"{instrument} {field}")
                text.draft.remarks.append(f"{field} from the {instrument}")
                if field == "current_a":
                    text.draft.sign_unknown = instrument == self._CAN


@dataclass(frozen=True, slots=True)
class CyclerExport:
    """A cycler's export as comma-separated text, known by its headings (in lower case).

    A temperature from the file name is the chamber's set point (`_P25_`: +25 °C, `_N05_`: −5 °C;
    `HPPC-40C`: 40 °C; `2C-Discharge` is a rate and no temperature).

    Parameters
    ----------
    name : str
    time, current, voltage, must_have : str
        Headings.
    charges : bool
        Whether positive current charges.
    set_point : str
        Regular expression of the temperature in the file name.
    sensors : str
        Beginning of the headings of temperature sensors; their median is taken.
    ambient : str
        Heading of the room's temperature, taken where there is no sensor.
    bare : str
        Header of files that have none.
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
        names = [cell.lower() for cell in header]
        fields = {"time_s": self.time, "current_a": self.current, "voltage_v": self.voltage}
        wanted = {field: (names.index(name), "") for field, name in fields.items()}
        sensors = [
            k for k, name in enumerate(names) if self.sensors and name.startswith(self.sensors)
        ]
        wanted |= {f"sensor {k}": (k, "") for k in sensors}
        for name in ("ambient", "exclude"):
            heading = self.ambient if name == "ambient" else name
            if heading and heading in names and (name == "ambient" or self.bare):
                wanted[name] = (names.index(heading), "")
        text = _Text(head, ",", header, skip_lines, wanted)
        draft = text.draft
        draft.remarks.insert(0, f"{self.name} export")
        for field in fields:
            text.take(field)
        if self.charges:
            draft.negate_current(f"{self.name} stores discharge as negative")
        if sensors or "ambient" in wanted:
            self._take_sensors(text, [name for name in wanted if name.startswith("sensor")], wanted)
        elif self.set_point:
            self._take_set_point(draft, head.path.name)
        if "exclude" in wanted:
            excluded = np.array([cell == "Yes" for cell in text.cells("exclude")])
            draft.keep(~excluded, "that the cycler excludes dropped")
        return draft

    def _take_sensors(self, text: _Text, names: list[str], wanted: Mapping[str, object]) -> None:
        """Take the mean of the sensors on the cell, else the room's temperature."""
        draft = text.draft
        values = {name: text.values(name, "temperature_c") for name in names}
        values = {name: each for name, each in values.items() if np.isfinite(each).any()}
        if values:
            labels = [text.label(name) for name in values]
            draft.take_probes(labels, list(values.values()))
            draft.temperature_source = "cell"
            if len(values) > 1:
                draft.remarks.append(f"temperature: median of {len(values)} columns")
        elif "ambient" in wanted:
            text.take("temperature_c", "ambient")
            draft.temperature_source = "room"
            draft.remarks.append("temperature: the room's")

    def _take_set_point(self, draft: DraftLog, file_name: str) -> None:
        found = list(re.finditer(self.set_point, file_name, re.IGNORECASE))
        if len(found) != 1:
            return
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
        "Arbin", "test_time(s)", "current(a)", "voltage(v)", "step_index",
        set_point=_SIGNED, sensors="aux_temperature",
    ),
    CyclerExport(
        "ESC dynamic test", "time", "current", "voltage", "disah", charges=False,
        set_point=_SIGNED,
    ),
    CyclerExport(
        "Bitrode", "time(s)", "current(a)", "voltage(v)", "exclude",
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
        _BDF, "test time / s", "current / a", "voltage / v",
        sensors="surface temperature t", ambient="ambient temperature / degc",
    ),
    CyclerExport(
        _BDF, "test_time_second", "current_ampere", "voltage_volt",
        sensors="temperature_t", ambient="ambient_temperature_celsius",
    ),
    CyclerExport(
        "battery-data-standard", "test_time_s", "current_a", "voltage_v",
        sensors="temperature_t", ambient="ambient_temperature_deg_c",
    ),
)  # fmt: skip
