"""Values that contradict their unit: refused, with the unit to state."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from itertools import islice
from typing import Final

import numpy as np

from cangauge._typing import BoolArray, FloatArray
from cangauge.errors import COLDEST_C, HOTTEST_C, InputError
from cangauge.logs.quantities import LIMITS, QUANTITIES
from cangauge.logs.resolution import wrapped_current

_TIME_UNITS: Final = QUANTITIES["time"].units
_WORDS: Final = {
    "s": "seconds",
    "ms": "milliseconds",
    "us": "microseconds",
    "ns": "nanoseconds",
    "min": "minutes",
    "h": "hours",
    "d": "days (dates of a spreadsheet)",
}
WRAPPED: Final = "a signed value was read as unsigned"
"""What is wrong with a current of one sign that wraps."""

_Wrong = tuple[float, str, str, list[str]]
"""A value that contradicts its unit, the problem, the cure, and units that the user may state."""


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
        Whether the unit of time is fixed, as that of a capture or of dates: rows may then be as
        close as an accelerated replay makes them. None: nothing states it.
    stated : collection of str
        Columns whose unit the user states.
    """
    current, voltage = values["current_a"], values["voltage_v"]
    temperature = values["temperature_c"]
    typical_v, typical_c = float(np.median(voltage)), float(np.median(temperature))
    is_low = COLDEST_C <= typical_v <= LIMITS["unusually_hot_c"]  # as a temperature
    is_constant = is_low and bool(np.ptp(temperature) == 0.0)  # a code
    voltage_label = labels.get("voltage_v", "voltage_v")
    checks = (
        ("current_a", _wrapped(current, voltage)),
        ("time_s", _wrong_time(values, in_seconds=in_seconds)),
        # Before the voltage: a temperature in its place looks like kilovolts.
        ("temperature_c", _swapped(typical_c, voltage_label) if is_low and not is_constant else ()),
        ("voltage_v", _wrong_voltage(voltage, typical_v)),
        ("current_a", _wrong_current(current)),
        ("soc_pct", _wrong_soc(values.get("soc_pct"), is_stated="soc_pct" in stated)),
        ("temperature_c", _wrong_temperature(temperature, typical_c, may_be_swapped=is_low)),
    )
    wrong: dict[str, _Wrong] = {}
    for field, found in checks:
        for first in islice(found, 1):
            wrong.setdefault(field, first)
    named = {
        field: (labels[field], units)
        for field, (*_, units) in wrong.items()
        if units and field not in stated and labels.get(field, field).lower() != field
    }
    for field, (value, problem, cure, _) in wrong.items():  # the first is raised
        if field in named:
            sure = {each: column for each, column in named.items() if len(column[1]) == 1}
            options = sure if field in sure else {field: named[field]}
            cure = f"{cure} (or state the unit: {_option(options)})"  # noqa: PLW2901
            if len(options) > 1:
                cure = f"state the units: {_option(options)}"  # noqa: PLW2901
        label, where = labels.get(field, field), str(source)
        raise InputError(problem, source=where, field=label, value=float(value), cure=cure)
    option = _option({"temperature_c": (labels.get("temperature_c", "temperature_c"), ["°F"])})
    doubt = "" if "temperature_c" in stated else f": if it is °F, state the unit: {option}"
    remark = f"temperature {typical_c:.0f} °C is unusually hot{doubt}"
    return (remark,) if typical_c > LIMITS["unusually_hot_c"] else ()


def _option(columns: dict[str, tuple[str, list[str]]]) -> str:
    """Return the option that states the units of columns, "?" where several are possible."""
    field, (label, units) = next(iter(columns.items()))
    is_tick = field == "time_s" and "tick" in label.lower()
    if len(units) == 1 and not is_tick:
        parts = (
            f"{name.rpartition('_')[0]}={of}[{unit}]" for name, (of, [unit]) in columns.items()
        )
        return f"--columns '{','.join(parts)}'"
    factor = " and a factor, such as [ms]:10 for ticks of 10 ms" if is_tick else ""
    option = f"--columns '{field.rpartition('_')[0]}={label}[?]'"
    return f"{option}, with {' or '.join(units)} for ?{factor}"


def _odd_row(values: FloatArray, wrong: BoolArray, kind: str) -> Iterator[_Wrong]:
    """Yield the first row whose value is impossible."""
    for row in np.flatnonzero(wrong)[:1]:
        cure = "remove the row: codes such as 255 and 65535 mean 'not available'"
        yield values[row], f"row {row + 1} is not {kind}", cure, []


def _in_finer_unit(value: float, limit: float, unit: str, what: str) -> _Wrong:
    """Return what is wrong with a value above the limit [V or A]: it is in milli or micro."""
    is_milli = abs(value) <= 1e3 * limit
    prefix, divisor = ("milli", "1000") if is_milli else ("micro", "1,000,000")
    symbol = f"{'m' if is_milli else 'u'}{unit[0].upper()}"
    return value, f"{what} looks like {prefix}{unit}", f"divide it by {divisor}", [symbol]


def _wrong_time(values: dict[str, FloatArray], *, in_seconds: bool | None) -> Iterator[_Wrong]:
    time = values["time_s"]
    if time[0] > LIMITS["stamp_s"]:
        yield time[0], "time looks like milliseconds since 1970", "divide it by 1000", ["ms"]
    yield from _odd_row(time, np.abs(time) > LIMITS["stamp_s"], "a time in seconds")
    step = np.diff(time) if time.size > 1 else np.ones(1)
    interval, days = float(np.median(step)), step.sum() / 86400.0
    apart = f"rows are {interval:g} apart"
    finer = _fitting(interval, ("ms", "us", "ns"))
    coarser = ["d"] if time[0] > LIMITS["spreadsheet_d"] else _fitting(interval, ("min", "h", "d"))
    words = [" or ".join(_WORDS[each] for each in units) for units in (finer, coarser)]
    if interval > LIMITS["interval_s"]:
        too_slow = "a log with a row every 90 s or more cannot be used"
        if in_seconds:
            problem = f"rows are {interval:g} s apart: {too_slow}"
            yield interval, problem, "export a row each minute", []
        problem = f"{apart}: time looks like {words[0] or 'another unit'}"
        yield interval, problem, f"convert it to seconds ({too_slow})", finer
    if not in_seconds and 0.0 < interval < 1.0 / LIMITS["rate_hz"]:
        problem = f"{apart}: time looks like {words[1] or 'another unit'}"
        yield interval, problem, "convert it to seconds", coarser
    if in_seconds is None and (others := _other_units(values, finer, coarser)):
        problem = f"{apart}, in seconds or another unit"
        yield interval, problem, "name the unit in the heading", ["s", *others]
    if days > LIMITS["log_d"]:
        row = int(np.argmax(step)) + 1
        problem = f"the log lasts {days:.0f} days; its longest step ends at row {row + 1}"
        yield time[row], problem, "if the clock was set there, split the log there", []


def _fitting(interval: float, units: Sequence[str]) -> list[str]:
    """Return those of the units in which rows are as far apart as a log's."""
    step_s = {unit: interval * _TIME_UNITS[unit][0] for unit in units}
    return [unit for unit in units if LIMITS["fastest_s"] <= step_s[unit] <= LIMITS["interval_s"]]


def _other_units(values: dict[str, FloatArray], finer: list[str], coarser: list[str]) -> list[str]:
    """Return those of the units that time may be in as well as in seconds."""
    time, scale = values["time_s"], _TIME_UNITS
    step = np.diff(time) if time.size > 1 else np.ones(1)
    # Seconds have steps below 10, or decimal ones: 0.016667 are 60 Hz, or 1 s in minutes.
    if finer and np.all(time % 1.0 == 0.0) and np.min(step) >= 10.0:
        # A SoC settles it: the charge in a finer unit would be too little for it.
        return [] if _c_rate(values) / scale[finer[0]][0] > LIMITS["c_rate_per_h"] else finer
    mean = float(step.mean())
    parts = [1000.0 * mean, *(mean * scale[unit][0] for unit in coarser)]
    are_whole = [abs(part - round(part)) < 1e-3 for part in parts]
    is_coarse = any(are_whole) and not are_whole[0] and np.ptp(step) < 0.2 * mean
    return coarser if is_coarse else []


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


def _wrong_voltage(voltage: FloatArray, typical: float) -> Iterator[_Wrong]:
    if typical > LIMITS["voltage_v"]:
        yield _in_finer_unit(typical, LIMITS["voltage_v"], "volts", "voltage")
    if typical <= 0.0:
        yield typical, "the median voltage is not positive", "check column and polarity", []
    if typical < 1.0:
        yield typical, "voltage looks like kilovolts", "convert it to volts", ["kV"]
    yield from _odd_row(voltage, np.abs(voltage) > LIMITS["voltage_v"], "a battery's voltage")


def _wrapped(current: FloatArray, voltage: FloatArray) -> Iterator[_Wrong]:
    found = wrapped_current(current, voltage)
    if found is not None:
        wraps_at_a, bits, step_a = found
        field = f"{bits} bits unsigned of {step_a:g} A"
        problem = f"the current wraps at {wraps_at_a:.10g} A ({field}): {WRAPPED}"
        cure = f"read it as signed: {wraps_at_a:.10g} A less, from half of that on"
        yield current[np.argmax(np.abs(current))], problem, cure, []


def _wrong_current(current: FloatArray) -> Iterator[_Wrong]:
    size = np.abs(current)
    large, peak = size > LIMITS["current_a"], int(np.argmax(size))
    digits = [int(f"{amps:f}".replace(".", "").strip("0")) for amps in set(size[large])]
    if (np.mean(large) < LIMITS["odd_share"] and current.size > 1000) or all(map(_is_code, digits)):
        yield from _odd_row(current, large, "a battery's current")
    if large.any():
        what = f"current exceeds {LIMITS['current_a']:g} A in row {peak + 1}: it"
        yield _in_finer_unit(float(current[peak]), LIMITS["current_a"], "amperes", what)


def _is_code(number: int) -> bool:
    """Return whether all bits of a number are set (65535), or but the last or the highest."""
    return number > 254 and any((number + k) & (number + k - 1) == 0 for k in (0, 1, 2))


def _wrong_soc(soc: FloatArray | None, *, is_stated: bool) -> Iterator[_Wrong]:
    if soc is None or not np.isfinite(soc).any():
        return
    known = soc[np.isfinite(soc)]
    least, most = float(known.min()), float(known.max())
    if least >= 0.0 and 0.0 < most <= 1.0 and not is_stated:
        cure = "multiply it by 100 (or leave it out if it stays below 1 %)"
        yield most, "SoC looks like a fraction of 1", cure, ["-", "%"]
    odd = most if most > 110.0 else least
    if not -10.0 <= odd <= 110.0:
        row = int(np.argmax(soc == odd))
        yield odd, f"SoC of row {row + 1} is not within 0–100 %", "convert it to %", []


def _swapped(typical: float, label: str) -> Iterator[_Wrong]:
    if 273.15 + LIMITS["unusually_hot_c"] < typical <= LIMITS["voltage_v"]:
        problem = f"it looks like a pack's voltage, and {label} like a temperature"
        yield typical, problem, "the two columns (or signals) look swapped: exchange them", []


def _wrong_temperature(
    temperature: FloatArray, typical: float, *, may_be_swapped: bool
) -> Iterator[_Wrong]:
    if 200.0 <= typical <= 400.0:
        also = ", or exchange it with the voltage if the two are swapped" if may_be_swapped else ""
        units = ["K"] if np.any(temperature % 1.0) else ["K", "0.1°C"]
        yield typical, "temperature looks like kelvin", f"subtract 273.15{also}", units
    if HOTTEST_C < typical / 10.0 <= 100.0 * HOTTEST_C:
        problem = "temperature looks like thousandths of a degree"
        yield typical, problem, "divide it by 1000", ["0.001°C"]
    if not COLDEST_C <= typical <= HOTTEST_C:
        yield typical, "this is not a battery's temperature in °C", "convert it to °C", []
    odd = (temperature < COLDEST_C) | (temperature > HOTTEST_C)
    yield from _odd_row(temperature, odd, "a battery's temperature in °C")
