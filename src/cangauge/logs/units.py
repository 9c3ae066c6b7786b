"""Units of a log: conversion of stated units, errors where the values contradict a unit."""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from typing import Any, Final, Literal, cast, get_args

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
CANONICAL_UNIT: Final = dict(zip(FIELDS, ("s", "A", "V", "°C", "%"), strict=True))
REQUIRED: Final = ("time_s", "current_a", "voltage_v", "temperature_c")
"""Columns of every log."""

_SPELLINGS: Final[dict[str, dict[tuple[float, float], str]]] = {
    "time_s": {
        (1.0, 0.0): "s|sec|secs|second|seconds|sek|sekunden",
        (1e-3, 0.0): "ms|msec|millis|millisecond|milliseconds",
        (1e-6, 0.0): "us|µs|μs|usec|microsecond|microseconds",
        (1e-9, 0.0): "ns|nanoseconds",
        (60.0, 0.0): "min|mins|minutes|minuten",
        (3600.0, 0.0): "h|hr|hrs|hours|stunden",
        (86400.0, 0.0): "d|days",
    },
    "current_a": {
        (1.0, 0.0): "a|amp|amps|amper|ampere|adc",
        (1e-2, 0.0): "ca",
        (1e-3, 0.0): "ma",
        (1e-6, 0.0): "ua|µa|μa",
        (1e3, 0.0): "ka",
    },
    "voltage_v": {
        (1.0, 0.0): "v|volt|volts|vdc",
        (1e-3, 0.0): "mv",
        (1e-6, 0.0): "uv|µv|μv",
        (1e3, 0.0): "kv",
    },
    "temperature_c": {
        (1.0, 0.0): "c|°c|degc|deg c|deg. c|deg_c|celsius|grad c|grad celsius|℃|º c|ºc|â°c|\ufffdc",
        (1.0, -273.15): "k|kelvin",
        (5.0 / 9.0, -160.0 / 9.0): "f|°f|degf|deg f|fahrenheit|℉|ºf|â°f|\ufffdf",
    },
    "soc_pct": {
        (1.0, 0.0): "%|per|pct|percent|prozent",
        (100.0, 0.0): "1|-|0-1|0..1|fraction|ratio|pu",
    },
}
"""Spellings (lower case, single blanks) by factor and offset to the canonical unit; of degrees also
those that a wrong decoding leaves."""
_UNITS: Final = {
    field: {name: unit for unit, names in units.items() for name in names.split("|")}
    for field, units in _SPELLINGS.items()
}
_WORDS: Final = {
    "mA": "milliamperes", "uA": "microamperes", "mV": "millivolts", "uV": "microvolts",
    "ms": "milliseconds", "us": "microseconds", "us ms": "milliseconds or microseconds",
    "d": "days (dates of a spreadsheet)", "h d": "hours or days", "": "another unit",
}  # fmt: skip
_SCALED: Final = re.compile(r"(?P<scale>0?[.,]\d+|1|10+(?=\s*[mµμu]))\s*(?P<unit>\D+)$")
"""A unit of a bit: 0.1V, 10mV; 500A is the range of a sensor."""
_FOREIGN: Final = (
    "w|kw|wh|kwh|ah|mah|as|nm|rpm|km/h|kmh|mph|hz|khz|pa|bar|mbar|ohm|mohm|ω|mω|v/s|a/s|k/s|wh/kg"
    "|ah/kg|mah/g|m|m/s|kg|l|deg"
)
FOREIGN_UNITS: Final = frozenset(_FOREIGN.split("|"))
"""Units of quantities that no log holds; a heading with one of them is none of its columns."""

# Plausible values, from a cell of 2 V to a truck's pack of 1000 V.
_MAX_VOLTAGE_V: Final = 1500.0
_MAX_CURRENT_A: Final = 2000.0
_MAX_INTERVAL_S: Final = 90.0
"""Usual time between rows of a log that counts charge [s]: cyclers log every 60 s at rest."""
_MAX_RATE_HZ: Final = 2000.0
_FASTEST_S: Final = 0.01
"""Shortest cycle of a battery's message on a bus [s]: what fits a time without a unit."""
_FASTEST_C: Final = 60.0
"""Highest RMS current by capacity [1/h]: no battery is emptied in a minute."""
_MAX_DAYS: Final = 366.0
"""First to last row [d]: setting the clock within a log can add decades."""
_MAX_STAMP_S: Final = 5e11
"""Largest time of a row [s]: a Julian date has 2e11; in ms since 1970, 1985."""
COLDEST_C: Final = -60.0
HOTTEST_C: Final = 120.0
_UNUSUALLY_HOT_C: Final = 62.0
_EXCEL_1990: Final = 32_874.0
"""1990-01-01 as a spreadsheet's date [d since 1899-12-30]; as hours, nearly four years."""
_RARE: Final = 1e-3
"""Fraction of impossible currents up to which they are codes, not another unit [-]."""

_Check = tuple[Any, str, float, str, str, str]
"""Whether a value is wrong; field, value, problem, cure, and the units that the user may state."""


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
    >>> unit_of("voltage_v", "0.1V")
    (0.1, 0.0)
    """
    name = " ".join(unit.lower().removeprefix("unit_").split())
    scale = _SCALED.match(name)
    if name in _UNITS[field] or scale is None or scale["unit"] not in _UNITS[field]:
        return _UNITS[field].get(name)
    factor, offset = _UNITS[field][scale["unit"]]
    return factor * float(scale["scale"].replace(",", ".")), offset


def convert(
    values: FloatArray, field: str, unit: str, *, source: object, label: str
) -> tuple[FloatArray, str | None]:
    """Convert values of shape (n,) from a stated unit ("": the canonical one).

    Returns the values, and a remark where they were converted.

    Raises
    ------
    InputError
        If the unit is not known for this quantity.
    """
    factor, offset = (1.0, 0.0) if not unit.strip() else unit_of(field, unit) or (0.0, 0.0)
    if not factor:
        raise InputError(
            f"the unit is not known for {field}",
            source=str(source),
            field=label,
            value=unit,
            cure=f"convert it to one of: {', '.join(_UNITS[field])}",
        )
    if (factor, offset) == (1.0, 0.0):
        return values, None
    return values * factor + offset, f"{label}: converted from {unit} to {field}"


def _is_code(number: int) -> bool:
    """Return whether all bits of a number are set (65535), or but the last or the highest."""
    return number > 254 and any((number + k) & (number + k - 1) == 0 for k in (0, 1, 2))


def _fitting(interval: float, units: str) -> str:
    """Return those of the units in which rows are as far apart as a log's."""
    seconds = {unit: interval * _UNITS["time_s"][unit][0] for unit in units.split()}
    return " ".join(k for k, step_s in seconds.items() if _FASTEST_S <= step_s <= _MAX_INTERVAL_S)


def _c_rate(values: dict[str, FloatArray]) -> float:
    """Return RMS current by the capacity that the log's SoC implies, time being in seconds [1/h].

    NaN without a SoC that moves.
    """
    if "soc_pct" not in values:
        return math.nan
    known = np.isfinite(values["soc_pct"])
    time, current, soc = (values[name][known] for name in ("time_s", "current_a", "soc_pct"))
    if not soc.size or np.ptp(soc) == 0.0:
        return math.nan
    between = slice(*sorted((int(np.argmin(soc)), int(np.argmax(soc)))))
    charge_ah = abs(np.sum(current[between] * np.diff(time, append=time[-1])[between])) / 3600.0
    rms_a = math.sqrt(np.mean(current**2))
    return rms_a * np.ptp(soc) / 100.0 / charge_ah if charge_ah else math.nan


def _other_units(values: dict[str, FloatArray], finer: str, coarser: str) -> str:
    """Return those of the units that time may be in as well as in seconds."""
    time = values["time_s"]
    step = np.diff(time) if time.size > 1 else np.ones(1)
    # Seconds have steps below 10, or decimal ones: 0.016667 are 60 Hz, or 1 s in minutes.
    if finer and np.all(time % 1.0 == 0.0) and np.min(step) >= 10.0:
        # A SoC settles it: the charge in a finer unit would be too little for it.
        scale = _UNITS["time_s"][finer.rsplit(maxsplit=1)[-1]][0]
        return "" if _c_rate(values) / scale > _FASTEST_C else finer
    mean = float(step.mean())
    parts = [1000.0 * mean, *(mean * _UNITS["time_s"][unit][0] for unit in coarser.split())]
    are_whole = [abs(part - round(part)) < 1e-3 for part in parts]
    is_coarse = any(are_whole) and not are_whole[0] and np.ptp(step) < 0.2 * mean
    return coarser if is_coarse else ""


def refuse_wrong_units(
    values: dict[str, FloatArray],
    *,
    source: object,
    labels: dict[str, str],
    in_seconds: bool | None = False,
    stated: Collection[str] = (),
) -> tuple[str, ...]:
    """Raise InputError if the values cannot be in the canonical units; return remarks.

    Medians are checked first, against a few odd rows, then single impossible values.

    Parameters
    ----------
    values, labels : dict
        Arrays of shape (n,) and headings by canonical column; only `soc_pct` may hold NaN.
    source : object
        File, for messages.
    in_seconds : bool, optional
        Whether the format fixes the unit of time, as a capture's does: rows may then be as close
        as an accelerated replay makes them. None: nothing states it.
    stated : collection of str
        Columns whose unit the user states.
    """

    def odd_row(field: str, wrong: BoolArray, kind: str) -> _Check:
        row = int(np.argmax(wrong))
        cure = "remove the row: codes such as 255 and 65535 mean 'not available'"
        return wrong.any(), field, values[field][row], f"row {row + 1} is not {kind}", cure, ""

    time, current = values["time_s"], values["current_a"]
    voltage, temperature = values["voltage_v"], values["temperature_c"]
    step = np.diff(time) if time.size > 1 else np.ones(1)
    interval, days, last = float(np.median(step)), step.sum() / 86400.0, int(np.argmax(step)) + 1
    too_close = not in_seconds and 0.0 < interval < 1.0 / _MAX_RATE_HZ
    finer, coarser = _fitting(interval, "ns us ms"), _fitting(interval, "min h d")
    coarser = "d" if time[0] > _EXCEL_1990 else coarser
    apart = f"rows are {interval:g} apart: time looks like"
    others = _other_units(values, finer, coarser) if in_seconds is None else ""
    middle, middle_c = float(np.median(voltage)), float(np.median(temperature))
    is_low = COLDEST_C <= middle <= _UNUSUALLY_HOT_C
    # Before the voltage: a temperature in its place looks like kilovolts. A constant is a code.
    hottest_k = max(HOTTEST_C, 273.15 + _UNUSUALLY_HOT_C)
    swapped = is_low and hottest_k < middle_c <= _MAX_VOLTAGE_V and np.ptp(temperature) > 0.0
    milli_v = "mV" if middle <= 1e3 * _MAX_VOLTAGE_V else "uV"
    large = np.abs(current) > _MAX_CURRENT_A
    peak = int(np.argmax(np.abs(current)))
    milli_a = "mA" if abs(current[peak]) <= 1e3 * _MAX_CURRENT_A else "uA"
    digits = [int(f"{amps:f}".replace(".", "").strip("0")) for amps in set(abs(current[large]))]
    are_codes = (np.mean(large) < _RARE and current.size > 1000) or all(map(_is_code, digits))
    soc = values.get("soc_pct", np.empty(0))
    soc = soc[np.isfinite(soc)] if np.isfinite(soc).any() else np.full(1, 50.0)
    most, least = float(np.max(soc)), float(np.min(soc))
    odd_soc = most if most > 110.0 else least
    soc_row = int(np.argmax(values.get("soc_pct", soc) == odd_soc))
    celsius = (temperature >= COLDEST_C) & (temperature <= HOTTEST_C)
    t, u, i, c, by_1000 = "time_s", "voltage_v", "current_a", "temperature_c", "divide it by 1000"
    checks: tuple[_Check, ...] = (
        (time[0] > _MAX_STAMP_S, t, time[0], "time looks like milliseconds since 1970", by_1000,
         "ms"),
        odd_row(t, np.abs(time) > _MAX_STAMP_S, "a time in seconds"),
        (interval > _MAX_INTERVAL_S, t, interval, f"{apart} {_WORDS.get(finer, finer)}",
         f"{by_1000 if finer == 'ms' else 'convert it to seconds'} (a log with a row every 90 s or"
         " more cannot be used)", finer),
        (too_close, t, interval, f"{apart} {_WORDS.get(coarser, coarser)}",
         "convert it to seconds", coarser),
        (others, t, interval, f"rows are {interval:g} apart, in seconds or another unit",
         "name the unit in the heading", f"s {others}"),
        (days > _MAX_DAYS, t, time[min(last, time.size - 1)],
         f"the log lasts {days:.0f} days; its longest step ends at row {last + 1}",
         "if the clock was set there, split the log there", ""),
        (swapped, c, middle_c,
         f"it looks like a pack's voltage, and {labels.get(u, u)} like a temperature",
         "the two columns (or signals) look swapped: exchange them", ""),
        (middle > _MAX_VOLTAGE_V, u, middle, f"voltage looks like {_WORDS[milli_v]}",
         by_1000 if milli_v == "mV" else "convert it to volts", milli_v),
        (middle <= 0.0, u, middle, "the median voltage is not positive",
         "check column and polarity", ""),
        (middle < 1.0, u, middle, "voltage looks like kilovolts", "convert it to volts", "kV"),
        odd_row(u, np.abs(voltage) > _MAX_VOLTAGE_V, "a battery's voltage"),
        odd_row(i, large & are_codes, "a battery's current"),
        (large.any(), i, current[peak],
         f"current exceeds {_MAX_CURRENT_A:g} A in row {peak + 1}: it looks like {_WORDS[milli_a]}",
         by_1000 if milli_a == "mA" else "convert it to amperes", milli_a),
        (least >= 0.0 and 0.0 < most <= 1.0 and "soc_pct" not in stated, "soc_pct", most,
         "SoC looks like a fraction of 1",
         "multiply it by 100 (or leave it out if it stays below 1 %)", "- %"),
        (not -10.0 <= odd_soc <= 110.0, "soc_pct", odd_soc,
         f"SoC of row {soc_row + 1} is not within 0–100 %", "convert it to %", ""),
        (200.0 <= middle_c <= 400.0, c, middle_c, "temperature looks like kelvin",
         "subtract 273.15"
         + (", or exchange it with the voltage if the two are swapped" if is_low else ""),
         "K" if np.any(temperature % 1.0) else "K 0.1°C"),
        (not COLDEST_C <= middle_c <= HOTTEST_C, c, middle_c,
         "this is not a battery's temperature in °C", "convert it to °C", ""),
        odd_row(c, ~celsius, "a battery's temperature in °C"),
    )  # fmt: skip
    for wrong, field, value, problem, cure, unit in checks:
        if wrong:
            label, units = labels.get(field, field), unit.split()
            is_tick = field == t and "tick" in label.lower()
            shown = unit if len(units) == 1 and not is_tick else "?"
            option = f"--columns '{field.rpartition('_')[0]}={label}[{shown}]'"
            if shown == "?":
                option += f", with {' or '.join(units)} for ?"
                option += " and a factor, such as [ms]:10 for ticks of 10 ms" if is_tick else ""
            is_open = bool(units) and label.lower() != field and field not in stated
            also = f" (or state the unit: {option})" if is_open else ""
            raise InputError(
                problem, source=str(source), field=label, value=float(value), cure=cure + also
            )
    remark = f"temperature {middle_c:.0f} °C is unusually hot: if it is °F, state the unit:"
    remark += f" --columns 'temperature={labels.get(c, c)}[°F]'"
    return (remark,) if middle_c > _UNUSUALLY_HOT_C else ()
