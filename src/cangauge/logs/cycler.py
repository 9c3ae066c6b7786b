"""Exports of battery cyclers, by a table of formats.

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
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge.logs.assemble import Draft
from cangauge.logs.columns import read_columns
from cangauge.logs.content import Content, cells

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


def find_layout(content: Content) -> Layout | None:
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


def read_cycler(content: Content, layout: Layout) -> Draft:
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
    draft = Draft(
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


def _temperature_from_name(draft: Draft, kind: _Format) -> None:
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
