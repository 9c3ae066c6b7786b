"""Trips of the BMW i3 ("Battery and Heating Data in Real Driving Cycles"): `;`-separated text.

The file stores discharge as negative current; it is turned here. `SoC [%]` is the car's own and
becomes the reference: it may be missing anywhere. Rows without time, current, voltage or battery
temperature are dropped with a remark (an error above 5 % of the rows).

Exports of battery cyclers, by a table of formats.

- Arbin: `Test_Time(s)`, `Current(A)`, `Voltage(V)`, `Step_Index`; negative = discharge;
  temperature from the file name.
- ESC dynamic test: `time, step, current, voltage, chgAh, disAh`; positive = discharge;
  temperature from the file name.
- Bitrode: `Exclude`, `Time(s)`, `Current(A)`, `Voltage(V)`, or the same without a header;
  negative = discharge; temperature from the file name of an HPPC test. Excluded rows are dropped.
- VisuaLCN: a preamble, `Total Time`, `Current`, `Voltage`, `Temperature A1` …; negative =
  discharge; temperature is the mean of its sensors.

A temperature from a file name is the chamber's set point (`_P25_`: +25 °C, `_N05_`: −5 °C;
`HPPC-40C`: 40 °C; `2C-Discharge` is a rate and no temperature). Where there is none, the user has
to give one. Rows without time, current or voltage are an error.

Test files of Argonne's Downloadable Dynamometer Database (D3), 10 Hz, tab-separated.

Headings differ between years; they are compared after dropping the unit (`[V]` or `__V`), spaces
and underscores, in any case. Current is positive when discharging; copies from the car's CAN can
have the sign turned, so for these it is found from the data. `Cell Temp` is the test **room**.

Rules: rows before time 0 (the wait before the test) are dropped; rows without time, current,
voltage or temperature are dropped (an error above 5 % of the rows); each with a remark. The
500 A clamp is taken before the 200 A one, instruments before copies from CAN.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge._io import MAX_HEADING
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.columns import Columns, read_columns
from cangauge.logs.draft import DraftLog
from cangauge.logs.file_content import FileContent, cells
from cangauge.logs.units import convert

# --- Trips of the BMW i3 ("Battery and Heating Data in Real Driving Cycles"): `;`-separated …

# The unit's bracket is misspelt in one heading: `max. SoC [%)`.
_HEADING: Final = re.compile(r"^(?P<name>.*?)\s*(?:\[(?P<unit>[^\])]*)[\])])?\s*$")
_COLUMNS: Final = {
    "time": "time_s",
    "battery current": "current_a",
    "battery voltage": "voltage_v",
    "battery temperature": "temperature_c",
    "soc": "soc_pct",
}


def is_bmw_i3_header(line: str) -> bool:
    """Whether a header line is that of an i3 trip."""
    return line.lower().startswith("time [s];") and "battery voltage [" in line.lower()


def read_bmw_i3(content: FileContent) -> DraftLog:
    """Read one trip.

    Raises
    ------
    InputError
        If a column is missing, or holds something else than numbers or missing values.
    """
    header = cells(content.head[0], ";")
    wanted, units = {}, {}
    for index, heading in enumerate(header):
        match = _HEADING.match(heading) if len(heading) <= MAX_HEADING else None
        field = _COLUMNS.get(match["name"].strip().lower()) if match else None
        if match and field and field not in wanted:
            wanted[field], units[field] = index, match["unit"] or ""
    columns = read_columns(content, wanted, header=header, delimiter=";", skip_lines=1)
    draft = DraftLog(
        content,
        {},
        columns.label,
        temperature_source="pack",
        drop_incomplete=True,
        remarks=[*columns.remarks],
    )
    for field in wanted:
        values, remark = convert(
            columns.numbers(field),
            field,
            units[field],
            source=content.path,
            label=columns.label[field],
        )
        draft.values[field] = values
        draft.remarks.extend([remark] if remark else [])
    draft.require("time_s", "current_a", "voltage_v", headings=header)
    draft.values["current_a"] = 0.0 - draft.values["current_a"]  # no -0.0
    draft.remarks.append("current negated: i3 trips store discharge as negative")
    return draft


# --- Exports of battery cyclers, by a table of formats

_PREAMBLE_LINES: Final = 40
_SIGNED: Final = re.compile(r"_(?P<sign>[NP])(?P<value>\d\d)(?=[_.])")
_HPPC: Final = re.compile(r"HPPC-(?P<value>\d+)C(?=[-_.])", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class _Format:
    """How one kind of export is read: headings in lower case; cells of a headless first row."""

    name: str
    time: str
    current: str
    voltage: str
    must_have: str
    discharge_sign: float
    temperature_name: re.Pattern[str] | None = None
    temperature_columns: str = ""
    headless: tuple[str, ...] = ()


_BITRODE_HEADER: Final = (
    "exclude,time(s),cycle,loop,loop,loop,step,steptime(s),"
    "current(a),voltage(v),power(w),capacity(ah),energy(wh),mode,data"
)
_FORMATS: Final = (
    _Format("Arbin", "test_time(s)", "current(a)", "voltage(v)", "step_index", -1.0, _SIGNED),
    _Format("ESC dynamic test", "time", "current", "voltage", "disah", +1.0, _SIGNED),
    _Format(
        "Bitrode",
        "time(s)",
        "current(a)",
        "voltage(v)",
        "exclude",
        -1.0,
        _HPPC,
        headless=tuple(_BITRODE_HEADER.split(",")),
    ),
    _Format(
        "VisuaLCN",
        "total time",
        "current",
        "voltage",
        "amp-hours",
        -1.0,
        temperature_columns="temperature ",
    ),
)
_MODES: Final = {"REST", "CHRG", "DCHG", "PAUS"}


@dataclass(frozen=True, slots=True)
class Layout:
    """Which format a file has and where its data begin."""

    format: _Format
    header: list[str]
    skip_lines: int


def find_layout(content: FileContent) -> Layout | None:
    """Return the layout of a cycler's export, or None if it is something else."""
    for number, line in enumerate(content.head[:_PREAMBLE_LINES]):
        header = cells(line, ",")
        names = {cell.lower() for cell in header}
        for kind in _FORMATS:
            if {kind.time, kind.current, kind.voltage, kind.must_have} <= names:
                return Layout(kind, header, number + 1)
    first = cells(content.head[0], ",")
    bitrode = _FORMATS[2]
    if len(first) >= 14 and first[0] in {"No", "Yes"} and first[13] in _MODES:
        return Layout(bitrode, list(bitrode.headless), 0)
    return None


def read_cycler(content: FileContent, layout: Layout) -> DraftLog:
    """Read a cycler's export.

    Raises
    ------
    InputError
        If a row is incomplete or holds something else than numbers.
    """
    kind, header = layout.format, layout.header
    names = [cell.lower() for cell in header]
    wanted = {
        "time_s": names.index(kind.time),
        "current_a": names.index(kind.current),
        "voltage_v": names.index(kind.voltage),
    }
    sensors = [
        index
        for index, name in enumerate(names)
        if kind.temperature_columns and name.startswith(kind.temperature_columns)
    ]
    wanted |= {f"sensor {index}": index for index in sensors}
    if kind.must_have == "exclude":
        wanted["exclude"] = names.index("exclude")
    columns = read_columns(
        content, wanted, header=header, delimiter=",", skip_lines=layout.skip_lines
    )
    fields = ("time_s", "current_a", "voltage_v")
    draft = DraftLog(
        content,
        {field: columns.numbers(field) for field in fields},
        dict(columns.label),
        remarks=[f"{kind.name} export", *columns.remarks],
    )
    if kind.discharge_sign < 0.0:
        draft.values["current_a"] = 0.0 - draft.values["current_a"]
        draft.remarks.append(f"current negated: {kind.name} stores discharge as negative")
    if sensors:
        readings = [columns.numbers(f"sensor {index}") for index in sensors]
        draft.values["temperature_c"] = np.mean(readings, axis=0)
        draft.temperature_source = "cell"
        draft.remarks.append(f"temperature: mean of {len(sensors)} sensors")
    else:
        _temperature_from_name(draft, kind)
    if "exclude" in columns.text:
        excluded = np.array([cell.strip() == "Yes" for cell in columns.text["exclude"].to_pylist()])
        if excluded.any():
            draft.remarks.append(f"{int(excluded.sum())} rows that the cycler excludes dropped")
            draft.keep(~excluded)
    return draft


def _temperature_from_name(draft: DraftLog, kind: _Format) -> None:
    found = (
        list(kind.temperature_name.finditer(draft.content.path.name))
        if kind.temperature_name
        else []
    )
    if len(found) != 1:
        return
    groups = found[0].groupdict()
    value = float(groups["value"]) * (-1.0 if groups.get("sign") == "N" else 1.0)
    draft.values["temperature_c"] = np.full(draft.values["time_s"].size, value)
    draft.temperature_source = "room"
    draft.remarks.append(f"temperature {value:g} °C from the file name: the chamber's set point")


# --- Test files of Argonne's Downloadable Dynamometer Database (D3), 10 Hz, tab-separated

_UNIT: Final = re.compile(r"^(?P<name>.*?)\s*(?:\[(?P<square>[^\]]*)\]|__(?P<tail>[^_\s]*))?\s*$")


@dataclass(frozen=True, slots=True)
class _Instrument:
    """What measured, and patterns of its headings in their simplified spelling."""

    what: str
    current_a: str
    voltage_v: str


_CAN: Final = "car's CAN"
_PAIR: Final = ("current_a", "voltage_v")
_INSTRUMENTS: Final = (
    _Instrument(
        "500 A clamp",
        r"hvbatterycurrentw/?500amaxclamp",
        r"hvbatteryvoltagew/?500amaxclamp",
    ),
    _Instrument(
        "200 A clamp",
        r"hvbatterycurrentw/?200amaxclamp",
        r"hvbatteryvoltagew/?200amaxclamp",
    ),
    _Instrument("HV battery channels", r"hvbatterycurrent", r"hvbatteryvoltage"),
    _Instrument("power analyser", r"hvbattcurrhioki\w*", r"hvbattvolthioki\w*"),
    _Instrument(_CAN, r"hvbatt(ery)?curr(ent)?\w*can\d*", r"hvbatt(ery)?volt(age)?\w*can\d*"),
)
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


def is_d3_header(line: str) -> bool:
    """Whether a header line is that of a D3 test."""
    if "\t" not in line:
        return False
    found = _headings(line)
    has_time = _find(_OTHERS["time_s"], found) is not None
    return has_time and any(heading.simple.startswith(("hvbatt", "dyno")) for heading in found)


def read_d3(content: FileContent) -> DraftLog:
    """Read one test; see the rules at the top of the module.

    The sign of a current that was copied from CAN is left as stored: `settle_can_sign` turns it.

    Raises
    ------
    InputError
        If time, battery current or voltage is not there, or holds something else than numbers.
    """
    headings = _headings(content.head[0])
    texts = [heading.text for heading in headings]
    places = {field: _find(patterns, headings) for field, patterns in _OTHERS.items()}
    wanted = {field: heading for field, heading in places.items() if heading}
    for instrument in _INSTRUMENTS:
        for field in _PAIR:
            heading = _find((getattr(instrument, field),), headings)
            if heading:
                wanted[f"{instrument.what} {field}"] = heading
    columns = read_columns(
        content,
        {name: heading.index for name, heading in wanted.items()},
        header=texts,
        delimiter="\t",
        skip_lines=1,
    )
    draft = DraftLog(content, {}, drop_incomplete=True, remarks=[*columns.remarks])
    for field, heading in places.items():
        if heading:
            draft.values[field] = _converted(draft, columns, field, field, heading)
    draft.require("time_s", headings=texts)
    if places["temperature_c"]:
        draft.temperature_source = "room"
        draft.remarks.append(
            f"{places['temperature_c'].text} is the temperature of the test room, not the battery's"
        )
    _take_instrument(draft, columns, wanted)
    draft.require("current_a", "voltage_v", headings=texts)
    _drop_wait(draft)
    return draft


def _take_instrument(draft: DraftLog, columns: Columns, wanted: Mapping[str, _Heading]) -> None:
    """Take current and voltage from the first instrument that has both, and say which.

    Where none has both, each comes from the first that has it.
    """
    filled: dict[str, dict[str, FloatArray]] = {field: {} for field in _PAIR}
    for instrument in _INSTRUMENTS:
        for field in _PAIR:
            name = f"{instrument.what} {field}"
            if name not in wanted:
                continue
            values = _converted(draft, columns, name, field, wanted[name])
            if np.isfinite(values).any():
                filled[field][instrument.what] = values
            else:
                draft.remarks.append(f"{wanted[name].text} is empty and was passed over")
        if all(instrument.what in filled[field] for field in _PAIR):
            filled = {field: {instrument.what: filled[field][instrument.what]} for field in _PAIR}
            break
    for field in _PAIR:
        for what, values in list(filled[field].items())[:1]:
            draft.values[field] = values
            draft.labels[field] = wanted[f"{what} {field}"].text
            draft.remarks.append(f"{field} from the {what}")
            if field == "current_a":
                draft.sign_unknown = what == _CAN


def _converted(
    draft: DraftLog, columns: Columns, name: str, field: str, heading: _Heading
) -> FloatArray:
    draft.labels[field] = heading.text
    values, remark = convert(
        columns.numbers(name),
        field,
        heading.unit,
        source=draft.content.path,
        label=heading.text,
    )
    draft.remarks.extend([remark] if remark else [])
    return values


def _drop_wait(draft: DraftLog) -> None:
    waiting = draft.values["time_s"] < 0.0
    count = int(waiting.sum())
    if count == waiting.size:
        raise InputError(
            "all rows are before time 0",
            source=draft.content.path,
            field=draft.labels["time_s"],
            cure="check the export",
        )
    if count:
        draft.remarks.append(f"{count} rows before time 0 (the wait before the test) dropped")
        draft.keep(~waiting)


def _headings(line: str) -> list[_Heading]:
    found = []
    for index, text in enumerate(cells(line, "\t")):
        match = _UNIT.match(text) if len(text) <= MAX_HEADING else None
        name = match["name"] if match else text
        unit = (match["square"] or match["tail"] or "") if match else ""
        simple = re.sub(r"[\s_]", "", name).lower()
        found.append(_Heading(index, text, simple, unit))
    return found


def _find(patterns: Sequence[str], headings: Sequence[_Heading]) -> _Heading | None:
    for pattern in patterns:
        for heading in headings:
            if re.fullmatch(pattern, heading.simple):
                return heading
    return None
