"""Logs whose format defines columns and sign: BMW i3 trips, Argonne D3 tests, cyclers' exports."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._files import Head
from cangauge.errors import InputError
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.columns import NEEDED, shown_headings
from cangauge.logs.draft import DraftLog
from cangauge.logs.headings import parse_heading
from cangauge.logs.quantities import FIELDS
from cangauge.logs.table import ArrowTable, draft_of_table
from cangauge.logs.text import TextTable, split_cells
from cangauge.settings import TemperatureSource


def _simple(heading: str) -> str:
    """Return a heading without unit, blanks and underscores, in lower case."""
    return re.sub(r"[\s_]", "", parse_heading(heading).name).lower()


def _matching(headings: Sequence[str], *patterns: str) -> list[int]:
    """Return the places of the simple headings of some patterns, the first pattern's first."""
    return [k for one in patterns for k, text in enumerate(headings) if re.fullmatch(one, text)]


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
        Regular expressions of the headings of time and SoC, the preferred first.
    instruments : dict
        Those of current and voltage by the instrument that measures both, the preferred first.
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
    waits : bool
        Rows before time 0 are of the wait before the test.
    """

    name: str
    known_by: tuple[str, ...]
    columns: dict[str, tuple[str, ...]]
    instruments: dict[str, tuple[str, str]]
    delimiter: str = ","
    charges: bool = True
    source: TemperatureSource = "cell"
    sensors: str = "(?!)"
    ambient: str = "(?!)"
    set_point: str = "(?!)"
    bare: str = ""
    waits: bool = False
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
        """Read an export.

        Raises
        ------
        InputError
            If a column is missing, or holds anything but numbers.
        """
        header, skip_lines = self._header(head) or ([], 0)
        simple = [*map(_simple, header)]
        patterns = [*chain(*self.instruments.values(), *self.columns.values())]
        excludes = ["exclude"] if self.bare else []
        text = TextTable(head, self.delimiter, header, (), skip_lines, [])
        wanted = _matching(simple, *patterns, self.sensors, self.ambient, *excludes)
        cells = text.columns(wanted)
        remarks = [f"{self.name} export", *text.remarks]
        only = _matching(simple, *self.instruments.get("", ()))
        for place, column in cells.items():
            if column.null_count == len(column) and place not in only:
                remarks.append(f"{header[place]} is empty and was not used")
                simple[place] = ""
        driving, sensors = self._driving(simple), _matching(simple, self.sensors)
        remarks += [
            f"{FIELDS[name]} from the {each}" for name, (each, _) in driving.items() if each
        ]
        places = {name: [place] for name, (_, place) in driving.items()}
        places |= {name: _matching(simple, *each)[:1] for name, each in self.columns.items()}
        places["temperature"] = sensors or _matching(simple, self.ambient)[:1]
        given = {name: "+".join(f"#{k + 1}" for k in each) for name, each in places.items() if each}
        missing = [FIELDS[name] for name in NEEDED if name not in given]
        if missing:
            found = [text for text, name in zip(header, simple, strict=True) if name]
            problem = f"no column of this file holds its values (found: {shown_headings(found)})"
            cure = "check the export, or name the columns with --columns"
            raise InputError(problem, source=head.path, field=missing[0], cure=cure)
        table = _table(head, header, {k: cells[k] for k in chain(*places.values())})
        draft = draft_of_table(
            table,
            ColumnMap(given),
            name=head.name,
            source=str(head.path),
            is_defined=True,
        )
        draft.remarks[:0] = remarks
        draft.headings, draft.ignored, draft.in_seconds = tuple(header), (), False
        if driving["current"][0] == _CAN:
            draft.sign_by = "data"
        if self.charges:
            draft.negate_current(f"{self.name} stores discharge as negative")
        self._note_temperature(draft, len(sensors))
        for place in _matching(simple, *excludes)[:1]:
            words = cells[place].cast("string")  # a column of 0 is one of numbers
            is_excluded = pc.fill_null(pc.equal(words, "Yes"), fill_value=False)
            draft.keep(~np.asarray(is_excluded, dtype=bool), "that the cycler excludes dropped")
        if self.waits:
            is_waiting = draft.values["time_s"] < 0.0
            if is_waiting.all():
                raise draft.error("time_s", "all rows are before time 0", "check the export")
            draft.keep(~is_waiting, "before time 0 (the wait before the test) dropped")
        return draft

    def _driving(self, simple: Sequence[str]) -> dict[str, tuple[str, int]]:
        """Return instrument and place of current and voltage: of the first that has both."""
        taken: dict[str, tuple[str, int]] = {}
        for instrument, pair in self.instruments.items():
            own = {}
            for quantity, pattern in zip(("current", "voltage"), pair, strict=True):
                for place in _matching(simple, pattern)[:1]:
                    own[quantity] = instrument, place
            if len(own) == 2:
                return own
            taken = own | taken
        return taken

    def _note_temperature(self, draft: DraftLog, sensors: int) -> None:
        """Note the place of the temperature; without sensors, take the set point, if any."""
        name = "temperature_c"
        draft.temperature_source = self.source if sensors else "unknown"
        if sensors > 1:
            draft.remarks.append(f"temperature: median of {sensors} columns")
        if sensors:
            return
        if name in draft.values:
            draft.temperature_source = "room"
            draft.remarks.append("temperature: the room's, not the battery's")
        found = [*re.finditer(self.set_point, Path(draft.source).name, re.IGNORECASE)]
        if len(found) == 1:
            value_c = float(found[0]["value"])
            if found[0].groupdict().get("sign") == "N":
                value_c = -value_c
            draft.values[name] = np.full(draft.values["time_s"].size, value_c)
            draft.temperature_source = "room"
            shown = f"temperature {value_c:g} °C from the file name: the chamber's set point"
            draft.remarks.append(shown)


def _table(head: Head, header: Sequence[str], cells: dict[int, Any]) -> ArrowTable:
    """Return a table of the chosen columns; the others have no heading."""

    def read(names: list[str]) -> Any:
        return pa.table({header[place]: column for place, column in cells.items()}).select(names)

    headings = [text if place in cells else "" for place, text in enumerate(header)]
    return ArrowTable(headings, read, source=str(head.path))


_CAN: Final = "car's CAN"
# D3's channels, the preferred first: instruments before copies from CAN.
_INSTRUMENTS: Final = {
    instrument: (pattern.format("current", "curr"), pattern.format("voltage", "volt"))
    for instrument, pattern in {
        "500 A clamp": r"hvbattery{0}w/?500amaxclamp",
        "200 A clamp": r"hvbattery{0}w/?200amaxclamp",
        "HV battery channels": "hvbattery{0}",
        "power analyser": r"hvbatt{1}hioki\w*",
        _CAN: r"hvbatt(ery)?({0}|{1})\w*can\d*",
    }.items()
}


def _cycler(name: str, time: str, current: str, voltage: str, *more: str, **how: Any) -> Export:
    """Return a cycler's export by its headings, in lower case."""
    headings = time, current, voltage
    simple = [re.escape(_simple(heading)) for heading in headings]
    known_by = tuple(map(re.escape, (*headings, *more)))
    return Export(name, known_by, {"time": (simple[0],)}, {"": (simple[1], simple[2])}, **how)


_SIGNED: Final = r"_(?P<sign>[NP])(?P<value>\d\d)(?=[_.])"
READERS: Final = (
    # "Battery and Heating Data in Real Driving Cycles"; its SoC is the car's own.
    Export(
        "BMW i3",
        (r"time \[s\]", r"battery voltage \[.*"),
        {"time": ("time",), "soc": ("soc",)},
        {"": ("batterycurrent", "batteryvoltage")},
        delimiter=";",
        sensors="batterytemperature",
        source="pack",
    ),
    # A 10 Hz test of Argonne's Downloadable Dynamometer Database. Headings differ between years.
    # Positive current discharges; a copy from the car's CAN may have the opposite sign, which is
    # then found from the data. `Cell Temp` is the temperature of the test room.
    Export(
        "ANL D3",
        (r"(daq[ _]?)?time(stamp)?\s*(\[.*|__.*)?", "(hv[ _]?batt|dyno).*"),
        {
            "time": (r"time(stamp)?", "daqtime"),
            "soc": ("hvbatterysoc", r"hvbatt(ery)?soc(can\d*)?"),
        },
        _INSTRUMENTS,
        delimiter="\t",
        charges=False,
        ambient=r"(test)?celltemp(erature)?",
        waits=True,
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
    Export(
        "Battery Data Format",
        (r"test[ _]time( / s|_second|_s)", "current( / a|_ampere|_a)", "voltage( / v|_volt|_v)"),
        {"time": ("testtime",)},
        {"": ("current", "voltage")},
        sensors="(surface)?temperaturet.*",
        ambient="ambienttemperature(deg)?",
    ),
)
