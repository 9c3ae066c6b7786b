"""Test files of Argonne's Downloadable Dynamometer Database (D3), 10 Hz, tab-separated.

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

from cangauge.errors import InputError
from cangauge.limits import MAX_HEADING
from cangauge.logs.assemble import Draft
from cangauge.logs.columns import Columns, read_columns
from cangauge.logs.content import Content, cells
from cangauge.logs.log import FloatArray
from cangauge.logs.units import convert

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


def read_d3(content: Content) -> Draft:
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
    draft = Draft(content, {}, drop_incomplete=True, remarks=[*columns.remarks])
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


def _take_instrument(draft: Draft, columns: Columns, wanted: Mapping[str, _Heading]) -> None:
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
    draft: Draft, columns: Columns, name: str, field: str, heading: _Heading
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


def _drop_wait(draft: Draft) -> None:
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
