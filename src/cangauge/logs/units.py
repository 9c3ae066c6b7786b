"""Units of a log: conversion of stated units, errors where the values contradict a unit."""

from __future__ import annotations

from typing import Final, Literal, NamedTuple, cast, get_args

import numpy as np

from cangauge._typing import BoolArray, FloatArray
from cangauge.errors import InputError

TemperatureSource = Literal["cell", "pack", "coolant", "room", "unknown"]
TEMPERATURE_SOURCES: Final[tuple[str, ...]] = get_args(TemperatureSource)

FIELDS: Final[dict[str, str]] = {
    "time": "time_s",
    "current": "current_a",
    "voltage": "voltage_v",
    "temperature": "temperature_c",
    "soc": "soc_pct",
}
"""Canonical column by the name that users write."""
REQUIRED: Final = ("time_s", "current_a", "voltage_v", "temperature_c")
"""Columns of every log."""


def _spelled(factor: float, offset: float, *names: str) -> dict[str, tuple[float, float]]:
    return dict.fromkeys(names, (factor, offset))


# Spelling (lower case, single blanks) -> factor and offset to the unit of the canonical log.
_UNITS: Final[dict[str, dict[str, tuple[float, float]]]] = {
    "time_s": _spelled(1.0, 0.0, "s", "sec", "secs", "second", "seconds", "sek", "sekunden")
    | _spelled(1e-3, 0.0, "ms", "msec", "millis", "milliseconds")
    | _spelled(1e-6, 0.0, "us", "µs", "μs", "usec", "microseconds")
    | _spelled(1e-9, 0.0, "ns", "nanoseconds")
    | _spelled(60.0, 0.0, "min", "mins", "minutes", "minuten")
    | _spelled(3600.0, 0.0, "h", "hr", "hrs", "hours", "stunden")
    | _spelled(86400.0, 0.0, "d", "days"),
    "current_a": _spelled(1.0, 0.0, "a", "amp", "amps", "amper", "ampere", "adc")
    | _spelled(1e-3, 0.0, "ma")
    | _spelled(1e3, 0.0, "ka"),
    "voltage_v": _spelled(1.0, 0.0, "v", "volt", "volts")
    | _spelled(1e-3, 0.0, "mv")
    | _spelled(1e3, 0.0, "kv")
    | _spelled(1.0, 0.0, "vdc"),
    # With the spellings that a wrong decoding of "°" leaves.
    "temperature_c": _spelled(
        1.0, 0.0, "c", "°c", "degc", "deg c", "deg. c", "deg_c", "celsius", "grad c",
        "grad celsius", "℃", "º c", "ºc", "â°c", "\ufffdc",
    )
    | _spelled(1.0, -273.15, "k", "kelvin")
    | _spelled(
        5.0 / 9.0, -160.0 / 9.0, "f", "°f", "degf", "deg f", "fahrenheit", "℉", "ºf", "â°f",
        "\ufffdf",
    ),
    "soc_pct": _spelled(1.0, 0.0, "%", "per", "pct", "percent", "prozent")
    | _spelled(100.0, 0.0, "1", "-", "0-1", "0..1", "fraction", "ratio", "pu"),
}  # fmt: skip

_FOREIGN: Final = (
    "w kw wh kwh ah mah as nm rpm km/h kmh mph hz khz pa bar mbar ohm mohm ω mω v/s a/s k/s wh/kg"
    " ah/kg mah/g m m/s kg l deg"
)
FOREIGN_UNITS: Final = frozenset(_FOREIGN.split())
"""Units of quantities that no log holds; a heading with one of them is none of its columns."""

# Plausible values, from a cell of 2 V to a truck's pack of 1000 V.
MAX_VOLTAGE_V: Final = 1500.0
MAX_CURRENT_A: Final = 2000.0
MAX_INTERVAL_S: Final = 90.0
"""Usual time between rows of a log that counts charge [s]: cyclers log every 60 s at rest."""
MAX_RATE_HZ: Final = 2000.0
MAX_DAYS: Final = 366.0
"""First to last row [d]: setting the clock within a log can add decades."""
MAX_STAMP_S: Final = 1e11
"""Largest time of a row [s]: the year 5138, counted from 1970; in ms since 1970, 1973."""
COLDEST_C: Final = -60.0
HOTTEST_C: Final = 120.0
UNUSUALLY_HOT_C: Final = 62.0
MAX_HOURS_AT_PEAK: Final = 100.0
"""Largest charge of a log, in hours of its largest current [h]."""
_EXCEL_1990: Final = 32_874.0
"""1990-01-01 as a spreadsheet's date [d since 1899-12-30]; as hours, nearly four years."""
_RARE: Final = 1e-3
"""Fraction of impossible currents up to which they are codes, not another unit [-]."""


def known_temperature_source(
    word: str, *, source: str | None = None, field: str = "temperature_source"
) -> TemperatureSource:
    """Return the word if it names a temperature source, else raise InputError."""
    if word not in TEMPERATURE_SOURCES:
        raise InputError(
            "not a known temperature source",
            source=source,
            field=field,
            value=word,
            cure=f"use one of: {', '.join(TEMPERATURE_SOURCES)}",
        )
    return cast("TemperatureSource", word)


def unit_of(field: str, unit: str) -> tuple[float, float] | None:
    """Return (factor, offset) from a unit to the canonical one of a field; None if unknown.

    Examples
    --------
    >>> unit_of("current_a", "mA")
    (0.001, 0.0)
    """
    return _UNITS[field].get(" ".join(unit.lower().removeprefix("unit_").split()))


def convert(
    values: FloatArray, field: str, unit: str, *, source: object, label: str
) -> tuple[FloatArray, str | None]:
    """Convert values from the unit that the header states ("": the canonical one).

    Returns
    -------
    array of shape (n,)
    str or None
        A remark if the values were converted.

    Raises
    ------
    InputError
        If the unit is not known for this quantity.
    """
    if not unit.strip():
        return values, None
    found = unit_of(field, unit)
    if found is None:
        raise InputError(
            f"the unit is not known for {field}",
            source=str(source),
            field=label,
            value=unit,
            cure=f"convert it to one of: {', '.join(_UNITS[field])}",
        )
    if found == (1.0, 0.0):
        return values, None
    factor, offset = found
    return values * factor + offset, f"{label}: converted from {unit} to {field}"


def refuse_wrong_units(
    values: dict[str, FloatArray],
    *,
    source: object,
    labels: dict[str, str],
    in_seconds: bool = False,
) -> tuple[str, ...]:
    """Raise InputError if the values cannot be in the canonical units.

    Medians are checked first, against a few odd rows, then single impossible values.

    Parameters
    ----------
    values : dict of str to array of shape (n,)
        `time_s`, `current_a`, `voltage_v`, `temperature_c` (finite) and optionally `soc_pct`.
    source, labels : object, dict of str to str
        File, and heading by field, for messages.
    in_seconds : bool
        Whether the format fixes the unit of time, as a capture's does: rows may then be as close
        as an accelerated replay makes them.

    Returns
    -------
    tuple of str
        Remarks on possible but unusual values.
    """
    time, current = values["time_s"], values["current_a"]
    voltage, temperature = values["voltage_v"], values["temperature_c"]
    check = _Check(str(source), labels)
    _check_time(check, time, current, in_seconds=in_seconds)
    middle, middle_c = float(np.median(voltage)), float(np.median(temperature))
    cold_voltage = COLDEST_C <= middle <= UNUSUALLY_HOT_C
    in_kelvin = 200.0 <= middle_c <= 400.0
    # Before the voltage: a temperature in its place looks like kilovolts. A constant is a code.
    check.refuse_if(
        cold_voltage
        and max(HOTTEST_C, 273.15 + UNUSUALLY_HOT_C) < middle_c <= MAX_VOLTAGE_V
        and np.ptp(temperature) > 0.0,
        "temperature_c",
        f"it looks like a pack's voltage, and {labels.get('voltage_v', 'voltage_v')} like a"
        " temperature",
        middle_c,
        "the two columns (or signals) look swapped: exchange them",
    )
    for wrong, problem, cure, unit in (
        (middle > MAX_VOLTAGE_V, "voltage looks like millivolts", "divide it by 1000", "mV"),
        (middle <= 0.0, "the median voltage is not positive", "check column and polarity", ""),
        (middle < 1.0, "voltage looks like kilovolts", "convert it to volts", "kV"),
    ):
        check.refuse_if(wrong, "voltage_v", problem, middle, cure, unit)
    check.refuse_row(np.abs(voltage) > MAX_VOLTAGE_V, "voltage_v", voltage, "a battery's voltage")
    large = np.abs(current) > MAX_CURRENT_A
    if np.mean(large) < _RARE and current.size > 1000:
        check.refuse_row(large, "current_a", current, "a battery's current")
    row = int(np.argmax(np.abs(current)))
    problem = f"current exceeds {MAX_CURRENT_A:g} A in row {row + 1}: it looks like milliamperes"
    check.refuse_if(large.any(), "current_a", problem, current[row], "divide it by 1000", "mA")
    _check_soc(check, values.get("soc_pct", np.empty(0)))
    swap = ", or exchange it with the voltage if the two are swapped" if cold_voltage else ""
    problem = "temperature looks like kelvin"
    check.refuse_if(in_kelvin, "temperature_c", problem, middle_c, f"subtract 273.15{swap}", "K")
    problem = "this is not a battery's temperature in °C"
    is_odd = not COLDEST_C <= middle_c <= HOTTEST_C
    check.refuse_if(is_odd, "temperature_c", problem, middle_c, "convert it to °C")
    odd = (temperature < COLDEST_C) | (temperature > HOTTEST_C)
    check.refuse_row(odd, "temperature_c", temperature, "a battery's temperature in °C")
    if middle_c <= UNUSUALLY_HOT_C:
        return ()
    label = labels.get("temperature_c", "temperature_c")
    return (
        f"temperature {middle_c:.0f} °C is unusually hot: if it is °F, state the unit:"
        f" --columns 'temperature={label}[°F]'",
    )


class _Check(NamedTuple):
    """Refusals of one log's values."""

    source: str
    labels: dict[str, str]

    def refuse_if(  # noqa: PLR0917 - as the sentence has it
        self, wrong: object, field: str, problem: str, value: float, cure: str, unit: str = ""
    ) -> None:
        if not wrong:
            return
        label = self.labels.get(field, field)
        if unit and label.lower() != field:
            cure += f" (or state the unit: --columns '{field.rpartition('_')[0]}={label}[{unit}]')"
        raise InputError(problem, source=self.source, field=label, value=float(value), cure=cure)

    def refuse_row(self, wrong: BoolArray, field: str, values: FloatArray, kind: str) -> None:
        row = int(np.argmax(wrong))
        problem = f"row {row + 1} is not {kind}"
        cure = "remove the row: codes such as 255 and 65535 mean 'not available'"
        self.refuse_if(wrong.any(), field, problem, values[row], cure)


def _check_time(check: _Check, time: FloatArray, current: FloatArray, *, in_seconds: bool) -> None:
    if time.size < 2:
        return
    step = np.diff(time)
    interval = float(np.median(step))
    by_1000 = "divide it by 1000"
    problem = "time looks like milliseconds since 1970"
    check.refuse_if(time[0] > MAX_STAMP_S, "time_s", problem, time[0], by_1000, "ms")
    check.refuse_row(np.abs(time) > MAX_STAMP_S, "time_s", time, "a time in seconds")
    row = int(np.argmax(step)) + 1
    days = (time[-1] - time[0]) / 86400.0
    problem = f"the log lasts {days:.0f} days; its longest step ends at row {row + 1}"
    cure = "if the clock was set there, split the log there"
    check.refuse_if(days > MAX_DAYS, "time_s", problem, time[row], cure)
    problem = f"rows are {interval:g} apart: time looks like milliseconds"
    cure = f"{by_1000} (a log with a row every 90 s or more cannot be used)"
    check.refuse_if(interval > MAX_INTERVAL_S, "time_s", problem, interval, cure, "ms")
    in_days = time[0] > _EXCEL_1990
    looks = "days (dates of a spreadsheet)" if in_days else "hours or days"
    problem = f"rows are {interval:g} apart: time looks like {looks}"
    too_close = not in_seconds and 0.0 < interval < 1.0 / MAX_RATE_HZ
    unit = "d" if in_days else "h"
    check.refuse_if(too_close, "time_s", problem, interval, "convert it to seconds", unit)
    # A fast log in milliseconds moves more charge than a battery holds. A steady drain can last for
    # weeks; a drive that varies this much cannot.
    peak = float(np.max(np.abs(current)))
    if float(np.mean(np.abs(current))) < 0.5 * peak and interval >= 5.0:
        hours = float(np.ptp(np.cumsum(current[:-1] * step))) / 3600.0 / peak
        problem = f"the charge moved is {hours:.0f} h of the largest current: time looks like"
        is_ms = hours > MAX_HOURS_AT_PEAK and np.all(time == np.rint(time))
        check.refuse_if(is_ms, "time_s", f"{problem} milliseconds", interval, by_1000, "ms")


def _check_soc(check: _Check, soc: FloatArray) -> None:
    finite = soc[np.isfinite(soc)]
    if not finite.size:
        return
    low, high = float(finite.min()), float(finite.max())
    problem = "SoC looks like a fraction of 1"
    cure = "multiply it by 100 (or leave it out if it stays below 1 %)"
    check.refuse_if(0.0 < high <= 1.0 and low >= 0.0, "soc_pct", problem, high, cure, "-")
    value = high if high > 110.0 else low
    row = int(np.flatnonzero(soc == value)[0]) + 1
    problem = f"SoC of row {row} is not within 0–100 %"
    is_odd = high > 110.0 or low < -10.0
    check.refuse_if(is_odd, "soc_pct", problem, value, "convert it to %")
