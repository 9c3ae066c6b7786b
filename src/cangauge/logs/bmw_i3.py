"""Trips of the BMW i3 ("Battery and Heating Data in Real Driving Cycles"): `;`-separated text.

The file stores discharge as negative current; it is turned here. `SoC [%]` is the car's own and
becomes the reference: it may be missing anywhere. Rows without time, current, voltage or battery
temperature are dropped with a remark (an error above 5 % of the rows).
"""

from __future__ import annotations

import re
from typing import Final

from cangauge.limits import MAX_HEADING
from cangauge.logs.assemble import Draft
from cangauge.logs.columns import read_columns
from cangauge.logs.content import Content, cells
from cangauge.logs.units import convert

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


def read_bmw_i3(content: Content) -> Draft:
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
    draft = Draft(
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
