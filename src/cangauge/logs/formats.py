"""Third-party logs: BMW i3 trips, Argonne D3 tests, exports of cyclers, Battery Data Format.

Each format has a test of the file's beginning (`is_…`) and a reader (`read_…`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge._formatting import counted
from cangauge._io import MAX_HEADING
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.columns import Columns, read_columns
from cangauge.logs.draft import DraftLog
from cangauge.logs.file_content import FileContent, split_cells
from cangauge.logs.units import convert


def _take(
    draft: DraftLog, columns: Columns, field: str, unit: str, column: str | None = None
) -> FloatArray:
    """Return a column in the canonical unit of `field`; note its heading and a conversion."""
    column = column or field
    label = columns.label[column]
    values, remark = convert(columns.numbers(column), field, unit, source=draft.source, label=label)
    draft.labels[field] = label
    draft.remarks.extend([remark] if remark else [])
    return values


# --- BMW i3 trips ("Battery and Heating Data in Real Driving Cycles"): `;`-separated text.
# Discharge is stored as negative current. `SoC [%]` is the car's own and becomes the reference.
# Rows that lack a required value are dropped with a remark.

# One heading misspells the unit's bracket: `max. SoC [%)`.
_I3_HEADING: Final = re.compile(r"^(?P<name>.*?)\s*(?:\[(?P<unit>[^\])]*)[\])])?\s*$")
_I3_COLUMNS: Final = {
    "time": "time_s",
    "battery current": "current_a",
    "battery voltage": "voltage_v",
    "battery temperature": "temperature_c",
    "soc": "soc_pct",
}


def is_bmw_i3(content: FileContent) -> bool:
    """Return whether the file begins like an i3 trip."""
    line = content.first_line.lower()
    return line.startswith("time [s];") and "battery voltage [" in line


def read_bmw_i3(content: FileContent) -> DraftLog:
    """Read one trip.

    Raises
    ------
    InputError
        If a column is missing, or holds anything but numbers or missing values.
    """
    header = split_cells(content.head[0], ";")
    places: dict[str, int] = {}
    units: dict[str, str] = {}
    for index, heading in enumerate(header):
        match = _I3_HEADING.match(heading) if len(heading) <= MAX_HEADING else None
        field = _I3_COLUMNS.get(match["name"].strip().lower()) if match else None
        if match and field and field not in places:
            places[field], units[field] = index, match["unit"] or ""
    columns = read_columns(content, places, header=header, delimiter=";", skip_lines=1)
    draft = DraftLog(
        content.name,
        str(content.path),
        temperature_source="pack",
        drop_incomplete=True,
        remarks=[*columns.remarks],
    )
    for field, unit in units.items():
        draft.values[field] = _take(draft, columns, field, unit)
    draft.require("time_s", "current_a", "voltage_v", headings=header)
    draft.negate_current("i3 trips store discharge as negative")
    return draft


# --- Argonne's Downloadable Dynamometer Database (D3): 10 Hz, tab-separated text.
# Headings differ between years; they are compared without unit (`[V]` or `__V`), spaces and
# underscores, in any case. Positive current discharges; a copy from the car's CAN may have the
# opposite sign, which is then determined from the data. `Cell Temp` is the temperature of the test
# room. Rows before time 0 (the wait before the test) and rows that lack a required value are
# dropped, each with a remark.

_D3_HEADING: Final = re.compile(
    r"^(?P<name>.*?)\s*(?:\[(?P<square>[^\]]*)\]|__(?P<tail>[^_\s]*))?\s*$"
)
_CAN: Final = "car's CAN"
# In order of preference: instruments before copies from CAN, the 500 A clamp before the 200 A one.
_INSTRUMENTS: Final[dict[str, dict[str, str]]] = {
    "500 A clamp": {
        "current_a": r"hvbatterycurrentw/?500amaxclamp",
        "voltage_v": r"hvbatteryvoltagew/?500amaxclamp",
    },
    "200 A clamp": {
        "current_a": r"hvbatterycurrentw/?200amaxclamp",
        "voltage_v": r"hvbatteryvoltagew/?200amaxclamp",
    },
    "HV battery channels": {"current_a": r"hvbatterycurrent", "voltage_v": r"hvbatteryvoltage"},
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
    "time_s": (r"time(stamp)?", r"daqtime"),
    "temperature_c": (r"(test)?celltemp(erature)?",),
    "soc_pct": (r"hvbatterysoc", r"hvbatt(ery)?soc(can\d*)?"),
}


@dataclass(frozen=True, slots=True)
class _Heading:
    index: int
    text: str
    simple: str
    unit: str


def is_d3(content: FileContent) -> bool:
    """Return whether the file begins like a D3 test."""
    if "\t" not in content.first_line:
        return False
    headings = _d3_headings(content.first_line)
    has_time = _find(headings, *_OTHERS["time_s"]) is not None
    return has_time and any(each.simple.startswith(("hvbatt", "dyno")) for each in headings)


def read_d3(content: FileContent) -> DraftLog:
    """Read one test.

    Raises
    ------
    InputError
        If time, battery current or voltage is missing, or holds anything but numbers.
    """
    headings = _d3_headings(content.head[0])
    texts = [heading.text for heading in headings]
    wanted = {field: _find(headings, *patterns) for field, patterns in _OTHERS.items()}
    for instrument, patterns in _INSTRUMENTS.items():
        for field, pattern in patterns.items():
            wanted[f"{instrument} {field}"] = _find(headings, pattern)
    found = {column: heading for column, heading in wanted.items() if heading}
    columns = read_columns(
        content,
        {column: heading.index for column, heading in found.items()},
        header=texts,
        delimiter="\t",
        skip_lines=1,
    )
    draft = DraftLog(
        content.name, str(content.path), drop_incomplete=True, remarks=[*columns.remarks]
    )
    for field in _OTHERS:
        if field in found:
            draft.values[field] = _take(draft, columns, field, found[field].unit)
    draft.require("time_s", headings=texts)
    if "temperature_c" in found:
        draft.temperature_source = "room"
        draft.remarks.append(
            f"{found['temperature_c'].text} is the temperature of the test room, not the battery's"
        )
    _take_instrument(draft, columns, found)
    draft.require("current_a", "voltage_v", headings=texts)
    _drop_wait(draft)
    return draft


def _take_instrument(draft: DraftLog, columns: Columns, found: dict[str, _Heading]) -> None:
    """Take current and voltage from the first instrument that has both.

    Where none has both, each comes from the first that has it.
    """
    filled: dict[str, dict[str, FloatArray]] = {"current_a": {}, "voltage_v": {}}
    for instrument in _INSTRUMENTS:
        for field, of_field in filled.items():
            column = f"{instrument} {field}"
            if column not in found:
                continue
            values = _take(draft, columns, field, found[column].unit, column)
            if np.isfinite(values).any():
                of_field[instrument] = values
            else:
                draft.remarks.append(f"{found[column].text} is empty and was not used")
        if all(instrument in of_field for of_field in filled.values()):
            filled = {field: {instrument: each[instrument]} for field, each in filled.items()}
            break
    for field, of_field in filled.items():
        if not of_field:
            continue
        instrument, values = next(iter(of_field.items()))
        draft.values[field] = values
        draft.labels[field] = found[f"{instrument} {field}"].text
        draft.remarks.append(f"{field} from the {instrument}")
        if field == "current_a":
            draft.sign_unknown = instrument == _CAN


def _drop_wait(draft: DraftLog) -> None:
    waiting = draft.values["time_s"] < 0.0
    if waiting.all():
        raise InputError(
            "all rows are before time 0",
            source=draft.source,
            field=draft.labels["time_s"],
            cure="check the export",
        )
    if waiting.any():
        draft.remarks.append(
            f"{counted(int(waiting.sum()), 'row')} before time 0 (the wait before the test) dropped"
        )
        draft.keep(~waiting)


def _d3_headings(line: str) -> list[_Heading]:
    headings = []
    for index, text in enumerate(split_cells(line, "\t")):
        match = _D3_HEADING.match(text) if len(text) <= MAX_HEADING else None
        name = match["name"] if match else text
        unit = (match["square"] or match["tail"] or "") if match else ""
        headings.append(_Heading(index, text, re.sub(r"[\s_]", "", name).lower(), unit))
    return headings


def _find(headings: Sequence[_Heading], *patterns: str) -> _Heading | None:
    matches = (
        heading
        for pattern in patterns
        for heading in headings
        if re.fullmatch(pattern, heading.simple)
    )
    return next(matches, None)


# --- Exports of battery cyclers: comma-separated text.
# A temperature from the file name is the chamber's set point (`_P25_`: +25 °C, `_N05_`: −5 °C;
# `HPPC-40C`: 40 °C; `2C-Discharge` is a rate and no temperature); without one, the user must give
# it. Rows that lack time, current or voltage are an error.

_PREAMBLE_LINES: Final = 40
_SIGNED: Final = re.compile(r"_(?P<sign>[NP])(?P<value>\d\d)(?=[_.])")
_HPPC: Final = re.compile(r"HPPC-(?P<value>\d+)C(?=[-_.])", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class _Cycler:
    """One kind of export; headings in lower case."""

    name: str
    time: str
    current: str
    voltage: str
    must_have: str
    discharge_sign: float
    set_point: re.Pattern[str] | None = None
    """Temperature in the file name."""
    sensors: str = ""
    """Beginning of the headings of temperature sensors; their mean is taken."""
    ambient: str = ""
    """Heading of the room's temperature, taken where there is no sensor."""


_BITRODE: Final = _Cycler(
    "Bitrode", "time(s)", "current(a)", "voltage(v)", "exclude", -1.0, set_point=_HPPC
)
_CYCLERS: Final = (
    _Cycler(
        "Arbin",
        "test_time(s)",
        "current(a)",
        "voltage(v)",
        "step_index",
        -1.0,
        set_point=_SIGNED,
        sensors="aux_temperature",
    ),
    _Cycler("ESC dynamic test", "time", "current", "voltage", "disah", +1.0, _SIGNED),
    _BITRODE,
    _Cycler(
        "VisuaLCN", "total time", "current", "voltage", "amp-hours", -1.0, sensors="temperature "
    ),
)
# Battery Data Format of the Battery Data Alliance (package batterydf), with its labels and its
# machine-readable names, and the schema of the package battery-data-standard. The former does not
# state the sign: its net capacity is charge less discharge, so that positive charges, as in the
# latter. All columns but three are optional, and may be empty.
_BDF: Final = "Battery Data Format"
BDF_LABELS: Final = {
    "time_s": "Test Time / s",
    "current_a": "Current / A",
    "voltage_v": "Voltage / V",
    "sensor": "Surface Temperature T1 / degC",
    "ambient": "Ambient Temperature / degC",
}
_STANDARDS: Final = (
    _Cycler(
        _BDF,
        "test time / s",
        "current / a",
        "voltage / v",
        "test time / s",
        -1.0,
        sensors="surface temperature t",
        ambient="ambient temperature / degc",
    ),
    _Cycler(
        _BDF,
        "test_time_second",
        "current_ampere",
        "voltage_volt",
        "test_time_second",
        -1.0,
        sensors="temperature_t",
        ambient="ambient_temperature_celsius",
    ),
    _Cycler(
        "battery-data-standard",
        "test_time_s",
        "current_a",
        "voltage_v",
        "test_time_s",
        -1.0,
        sensors="temperature_t",
        ambient="ambient_temperature_deg_c",
    ),
)
# Bitrode also exports without a header.
_BITRODE_HEADER: Final = (
    "exclude,time(s),cycle,loop,loop,loop,step,steptime(s),"
    "current(a),voltage(v),power(w),capacity(ah),energy(wh),mode,data"
)
_BITRODE_MODES: Final = {"REST", "CHRG", "DCHG", "PAUS"}


def _find_cycler(content: FileContent) -> tuple[_Cycler, list[str], int] | None:
    """Return the kind of export, its header and the number of lines before the data."""
    for number, line in enumerate(content.head[:_PREAMBLE_LINES]):
        header = split_cells(line, ",")
        names = {cell.lower() for cell in header}
        for kind in (*_CYCLERS, *_STANDARDS):
            if {kind.time, kind.current, kind.voltage, kind.must_have} <= names:
                return kind, header, number + 1
    first = split_cells(content.head[0], ",")
    if len(first) >= 14 and first[0] in {"No", "Yes"} and first[13] in _BITRODE_MODES:
        return _BITRODE, _BITRODE_HEADER.split(","), 0
    return None


def is_cycler(content: FileContent) -> bool:
    """Return whether the file begins like a cycler's export."""
    return _find_cycler(content) is not None


def read_cycler(content: FileContent) -> DraftLog:
    """Read a cycler's export.

    Raises
    ------
    InputError
        If a row is incomplete or holds anything but numbers.
    """
    found = _find_cycler(content)
    if found is None:
        raise InputError("not a known cycler's export", source=content.path)
    kind, header, skip_lines = found
    names = [cell.lower() for cell in header]
    wanted = {
        "time_s": names.index(kind.time),
        "current_a": names.index(kind.current),
        "voltage_v": names.index(kind.voltage),
    }
    sensors = {
        f"sensor {index}": index
        for index, name in enumerate(names)
        if kind.sensors and name.startswith(kind.sensors)
    }
    if kind.ambient and kind.ambient in names:
        sensors["ambient"] = names.index(kind.ambient)
    excludes = {"exclude": names.index("exclude")} if kind.must_have == "exclude" else {}
    columns = read_columns(
        content,
        wanted | sensors | excludes,
        header=header,
        delimiter=",",
        skip_lines=skip_lines,
    )
    draft = DraftLog(
        content.name,
        str(content.path),
        {field: columns.numbers(field) for field in wanted},
        dict(columns.label),
        remarks=[f"{kind.name} export", *columns.remarks],
    )
    if kind.discharge_sign < 0.0:
        draft.negate_current(f"{kind.name} stores discharge as negative")
    if sensors:
        _take_sensors(draft, {name: columns.numbers(name) for name in sensors})
    elif kind.set_point is not None:
        _take_set_point(draft, list(kind.set_point.finditer(content.path.name)))
    if excludes:
        cells = columns.text["exclude"].to_pylist()
        excluded = np.array([cell.strip() == "Yes" for cell in cells])
        if excluded.any():
            rows = counted(int(excluded.sum()), "row")
            draft.remarks.append(f"{rows} that the cycler excludes dropped")
            draft.keep(~excluded)
    return draft


def _take_sensors(draft: DraftLog, sensors: dict[str, FloatArray]) -> None:
    """Take the mean of the sensors on the cell, else the room's temperature."""
    filled = {name: values for name, values in sensors.items() if np.isfinite(values).any()}
    ambient = filled.pop("ambient", None)
    if filled:
        draft.values["temperature_c"] = draft.mean_of_probes(
            [draft.labels.get(name, name) for name in filled], list(filled.values())
        )
        draft.temperature_source = "cell"
        draft.remarks.append(f"temperature: mean of {len(filled)} sensors")
    elif ambient is not None:
        draft.values["temperature_c"] = ambient
        draft.temperature_source = "room"
        draft.remarks.append("temperature: the room's")


def _take_set_point(draft: DraftLog, found: Sequence[re.Match[str]]) -> None:
    if len(found) != 1:
        return
    groups = found[0].groupdict()
    value_c = float(groups["value"]) * (-1.0 if groups.get("sign") == "N" else 1.0)
    draft.values["temperature_c"] = np.full(draft.values["time_s"].size, value_c)
    draft.temperature_source = "room"
    draft.remarks.append(f"temperature {value_c:g} °C from the file name: the chamber's set point")
