"""Units of a log: conversion of stated units, and errors where the values contradict a unit.

Voltage and temperature that are swapped are detected too: the voltage is the column whose steps
follow those of the current.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Literal, cast, get_args

import numpy as np

from cangauge._io import MAX_LOG_SPAN_S, MAX_STAMP_S
from cangauge._typing import FloatArray
from cangauge.errors import InputError

TemperatureSource = Literal["cell", "pack", "coolant", "room", "unknown"]
TEMPERATURE_SOURCES: Final[tuple[str, ...]] = get_args(TemperatureSource)

REQUIRED: Final = ("time_s", "current_a", "voltage_v", "temperature_c")
"""Columns of every log."""

# Spelling (lower case, without blanks) -> (factor, offset) to the unit of the canonical log.
_UNITS: Final[dict[str, dict[str, tuple[float, float]]]] = {
    "time_s": {
        **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sek", "sekunden"), (1.0, 0.0)),
        **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), (1e-3, 0.0)),
        **dict.fromkeys(("us", "µs", "μs", "usec", "microseconds"), (1e-6, 0.0)),
        **dict.fromkeys(("ns", "nanoseconds"), (1e-9, 0.0)),
        **dict.fromkeys(("min", "mins", "minutes", "minuten"), (60.0, 0.0)),
        **dict.fromkeys(("h", "hr", "hrs", "hours", "stunden"), (3600.0, 0.0)),
        **dict.fromkeys(("d", "days"), (86400.0, 0.0)),
    },
    "current_a": {
        **dict.fromkeys(("a", "amp", "amps", "ampere", "adc"), (1.0, 0.0)),
        "ma": (1e-3, 0.0),
        "ka": (1e3, 0.0),
    },
    "voltage_v": {
        **dict.fromkeys(("v", "volt", "volts"), (1.0, 0.0)),
        "mv": (1e-3, 0.0),
        "vdc": (1.0, 0.0),
        "kv": (1e3, 0.0),
    },
    "temperature_c": {
        **dict.fromkeys(
            ("c", "°c", "degc", "deg c", "deg. c", "celsius", "grad c", "℃", "º c", "ºc", "â°c"),
            (1.0, 0.0),
        ),
        **dict.fromkeys(("\ufffdc", "grad celsius", "deg_c"), (1.0, 0.0)),
        **dict.fromkeys(("k", "kelvin"), (1.0, -273.15)),
        **dict.fromkeys(
            ("f", "°f", "degf", "deg f", "fahrenheit", "℉", "ºf", "â°f", "\ufffdf"),
            (5.0 / 9.0, -160.0 / 9.0),
        ),
    },
    "soc_pct": {
        **dict.fromkeys(("%", "per", "pct", "percent", "prozent"), (1.0, 0.0)),
        **dict.fromkeys(("1", "-", "0-1", "0..1", "fraction", "ratio", "pu"), (100.0, 0.0)),
    },
}

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
MAX_RATE_HZ: Final = 2000.0
COLDEST_C: Final = -60.0
HOTTEST_C: Final = 120.0
UNUSUALLY_HOT_C: Final = 62.0
ZERO_C_IN_K: Final = 273.15
MAX_HOURS_AT_PEAK: Final = 100.0
"""Largest charge, in hours of the largest current [h]."""
_EPOCH_MS: Final = 1e11

# Test whether a column follows the current.
LARGE_SHARE: Final = 0.25
"""Fraction of the rows to compare: those with the largest steps of current [-]."""
LEAST_ROWS: Final = 20
FOLLOWS: Final = 0.7
"""Agreement from which a column follows the current [-]. Real drives: voltages at least 0.89,
temperatures at most 0.01; voltages under constant current at most 0.6."""

_Refuse = Callable[..., InputError]


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
    return _UNITS[field].get(" ".join(unit.lower().split()))


def convert(
    values: FloatArray, field: str, unit: str, *, source: object, label: str
) -> tuple[FloatArray, str | None]:
    """Convert values from the unit that the header states to the canonical one.

    Parameters
    ----------
    values : array of shape (n,)
    field : {"time_s", "current_a", "voltage_v", "temperature_c", "soc_pct"}
    unit : str
        As in the header; "" means the canonical unit.
    source, label : object, str
        File and heading, for messages.

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
    factor, offset = found
    if (factor, offset) == (1.0, 0.0):
        return values, None
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

    def refuse(field: str, problem: str, value: float, cure: str, unit: str = "") -> InputError:
        if unit and labels.get(field, field).lower() != field:
            quantity = field.rpartition("_")[0]
            cure += f" (or state the unit: --columns '{quantity}={labels[field]}[{unit}]')"
        return InputError(
            problem, source=str(source), field=labels.get(field, field), value=value, cure=cure
        )

    _check_time(values, refuse, in_seconds=in_seconds)
    # Before the voltage: a temperature below 1 °C in its place looks like kilovolts or inverted.
    _check_swapped(values, labels.get("voltage_v", "voltage_v"), refuse)
    _check_voltage(values["voltage_v"], refuse)
    _check_current(values["current_a"], refuse)
    if "soc_pct" in values:
        _check_soc(values["soc_pct"], refuse)
    return _check_temperature(values, refuse)


def follows_current(current_a: FloatArray, values: FloatArray) -> bool:
    """Return whether a column's steps have the sign of the current's, or all the opposite one.

    Signs alone count, so that neither the unit nor a few wrong rows matter. False where the current
    hardly changes, as in a cycler's discharge.

    Parameters
    ----------
    current_a, values : arrays of shape (n,)
        In any unit.
    """
    change = np.diff(current_a)
    size = np.abs(change)
    if size.size < LEAST_ROWS:
        return False
    large = (size >= np.quantile(size, 1.0 - LARGE_SHARE)) & (size > 0.0)
    if np.count_nonzero(large) < LEAST_ROWS:
        return False
    agreement = np.mean(np.sign(change[large]) * np.sign(np.diff(values)[large]))
    return bool(abs(agreement) >= FOLLOWS)


def _check_time(values: dict[str, FloatArray], refuse: _Refuse, *, in_seconds: bool) -> None:
    time = values["time_s"]
    if time.size < 2:
        return
    interval = float(np.median(np.diff(time)))
    if time[0] > _EPOCH_MS:
        raise refuse(
            "time_s",
            "time looks like milliseconds since 1970",
            float(time[0]),
            "divide it by 1000",
            "ms",
        )
    far = np.flatnonzero(np.abs(time) > MAX_STAMP_S)
    if far.size:
        raise refuse(
            "time_s",
            f"row {far[0] + 1} is not a time in seconds",
            float(time[far[0]]),
            "correct or remove the row",
        )
    if time[-1] - time[0] > MAX_LOG_SPAN_S:
        row = int(np.argmax(np.diff(time))) + 1
        raise refuse(
            "time_s",
            f"the log lasts {(time[-1] - time[0]) / 86400.0:.0f} days; its longest step ends at"
            f" row {row + 1}",
            float(time[row]),
            "if the clock was set there, split the log there",
        )
    if interval > MAX_INTERVAL_S:
        raise refuse(
            "time_s",
            f"rows are {interval:g} apart: time looks like milliseconds",
            interval,
            "divide it by 1000 (a log with a row every 90 s or more cannot be used)",
            "ms",
        )
    if not in_seconds and 0.0 < interval < 1.0 / MAX_RATE_HZ:
        raise refuse(
            "time_s",
            f"rows are {interval:g} apart: time looks like hours or days",
            interval,
            "convert it to seconds",
            "h",
        )
    _check_charge(time, values["current_a"], interval, refuse)


def _check_charge(time: FloatArray, current: FloatArray, interval: float, refuse: _Refuse) -> None:
    """Detect a fast log in milliseconds: it moves more charge than a battery holds."""
    peak = float(np.max(np.abs(current)))
    # A steady drain can last for weeks; a drive that varies this much cannot.
    varied = float(np.mean(np.abs(current))) < 0.5 * peak
    if not varied or interval < 5.0 or not np.all(time == np.rint(time)):
        return
    charge = np.cumsum(current[:-1] * np.diff(time))
    hours = float(np.ptp(charge)) / 3600.0 / peak
    if hours > MAX_HOURS_AT_PEAK:
        raise refuse(
            "time_s",
            f"the charge moved is {hours:.0f} h of the largest current:"
            " time looks like milliseconds",
            interval,
            "divide it by 1000",
            "ms",
        )


def _check_swapped(values: dict[str, FloatArray], voltage_label: str, refuse: _Refuse) -> None:
    temperature = float(np.median(values["temperature_c"]))
    if temperature <= HOTTEST_C or not _may_be_temperature(values["voltage_v"]):
        return
    temperature_follows = follows_current(values["current_a"], values["temperature_c"])
    voltage_follows = follows_current(values["current_a"], values["voltage_v"])
    swapped = temperature_follows and not voltage_follows
    if not temperature_follows and not voltage_follows:
        # The range decides, unless it is a battery's in kelvin. A constant is a code.
        in_kelvin = COLDEST_C <= temperature - ZERO_C_IN_K <= UNUSUALLY_HOT_C
        varies = float(np.ptp(values["temperature_c"])) > 0.0
        swapped = varies and not in_kelvin and temperature <= MAX_VOLTAGE_V
    if swapped:
        raise refuse(
            "temperature_c",
            f"it looks like a pack's voltage, and {voltage_label} like a temperature",
            temperature,
            "the two columns (or signals) look swapped: exchange them",
        )


def _may_be_temperature(values: FloatArray) -> bool:
    return bool(COLDEST_C <= np.median(values) <= UNUSUALLY_HOT_C)


def _check_voltage(voltage: FloatArray, refuse: _Refuse) -> None:
    middle = float(np.median(voltage))
    if middle > MAX_VOLTAGE_V:
        raise refuse(
            "voltage_v", "voltage looks like millivolts", middle, "divide it by 1000", "mV"
        )
    if middle <= 0.0:
        raise refuse(
            "voltage_v", "the median voltage is not positive", middle, "check column and polarity"
        )
    if middle < 1.0:
        raise refuse(
            "voltage_v", "voltage looks like kilovolts", middle, "convert it to volts", "kV"
        )
    row = int(np.argmax(np.abs(voltage)))
    if abs(voltage[row]) > MAX_VOLTAGE_V:
        raise refuse(
            "voltage_v",
            f"row {row + 1} is not a battery's voltage",
            float(voltage[row]),
            "remove the row: codes such as 65535 mean 'not available'",
        )


def _check_current(current: FloatArray, refuse: _Refuse) -> None:
    row = int(np.argmax(np.abs(current)))
    if abs(current[row]) <= MAX_CURRENT_A:
        return
    share = float(np.mean(np.abs(current) > MAX_CURRENT_A))
    if share < 0.001 and current.size > 1000:
        raise refuse(
            "current_a",
            f"row {row + 1} is not a battery's current",
            float(current[row]),
            "remove the row: codes such as 65535 mean 'not available'",
        )
    raise refuse(
        "current_a",
        f"current exceeds {MAX_CURRENT_A:g} A in row {row + 1}: it looks like milliamperes",
        float(current[row]),
        "divide it by 1000",
        "mA",
    )


def _check_temperature(values: dict[str, FloatArray], refuse: _Refuse) -> tuple[str, ...]:
    temperature = values["temperature_c"]
    middle = float(np.median(temperature))
    if middle > HOTTEST_C:
        if follows_current(values["current_a"], temperature):
            raise refuse(
                "temperature_c",
                "it moves when the current does, as a voltage",
                middle,
                "check which column (or signal) is the temperature",
            )
        if 200.0 <= middle <= 400.0:
            cure = "subtract 273.15"
            voltage_follows = follows_current(values["current_a"], values["voltage_v"])
            if not voltage_follows and _may_be_temperature(values["voltage_v"]):
                cure += ", or exchange it with the voltage if the two are swapped"
            raise refuse("temperature_c", "temperature looks like kelvin", middle, cure, "K")
    if not COLDEST_C <= middle <= HOTTEST_C:
        raise refuse(
            "temperature_c", "this is not a battery's temperature in °C", middle, "convert it to °C"
        )
    odd = np.flatnonzero((temperature < COLDEST_C) | (temperature > HOTTEST_C))
    if odd.size:
        raise refuse(
            "temperature_c",
            f"row {odd[0] + 1} is not a battery's temperature in °C",
            float(temperature[odd[0]]),
            "remove the row: codes such as 255 mean 'not available'",
        )
    if middle > UNUSUALLY_HOT_C:
        return (f"temperature {middle:.0f} °C is unusually hot: if it is °F, convert it",)
    return ()


def _check_soc(soc: FloatArray, refuse: _Refuse) -> None:
    finite = soc[np.isfinite(soc)]
    if not finite.size:
        return
    low, high = float(finite.min()), float(finite.max())
    if 0.0 < high <= 1.0 and low >= 0.0:
        raise refuse(
            "soc_pct",
            "SoC looks like a fraction of 1",
            high,
            "multiply it by 100 (or leave it out if it stays below 1 %)",
            "-",
        )
    if high > 110.0 or low < -10.0:
        value = high if high > 110.0 else low
        row = int(np.flatnonzero(soc == value)[0]) + 1
        raise refuse("soc_pct", f"SoC of row {row} is not within 0–100 %", value, "convert it to %")
