"""Whether current, voltage, temperature, SoC and time of a log agree in size and sign.

`agreeing` is the one check. Its hypotheses are of three kinds:

- **unit or column**: the sizes of all columns fit another unit, a swap of two, or a
  field that wraps. The log is refused, with the unit to state;
- **sign** (`sign`): positive current charges. It is inverted if only the data show the sign;
- **own charge column** (`charge`): one of the columns in Ah counts the current.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import COLDEST_C, HOTTEST_C, InputError
from cangauge.logs.charge import implied_capacity, with_own_count
from cangauge.logs.log import Log
from cangauge.logs.quantities import LIMITS, QUANTITIES
from cangauge.logs.resolution import wrapped_current
from cangauge.logs.sign import SignFinding, SignSource, sign_of_current
from cangauge.logs.values import typical

_TIME_UNITS: Final = {
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


_Doubt = tuple[float, str, str, Sequence[str]]
"""What is wrong with a column: a value, the problem, the cure, and units to state instead."""


def agreeing(
    log: Log,
    *,
    labels: Mapping[str, str],
    in_seconds: bool | None = False,
    stated: Collection[str] = (),
    sign_by: SignSource = "format",
    counters: Mapping[str, FloatArray] | None = None,
) -> Log:
    """Return a log whose columns agree, with its sign, its own charge column and remarks.

    Parameters
    ----------
    log : Log
    labels : mapping
        Headings by canonical column, for messages.
    in_seconds : bool, optional
        Whether the unit of time is fixed, as that of a capture or of dates: rows may then be as
        close as an accelerated replay makes them. None: nothing states it.
    stated : collection of str
        Columns whose unit the user states.
    sign_by : {"format", "user", "data"}
        Source of the sign of the current.
    counters : mapping, optional
        Columns in Ah by their headings, shape (n,).

    Raises
    ------
    InputError
        If a column cannot be in its canonical unit.
    """
    log = _in_canonical_units(log, labels, in_seconds, stated)
    log = _discharging(log, sign_by)
    return with_own_count(log, counters) if counters and log.soc_pct is not None else log


# --- Sign


def _discharging(log: Log, sign_by: SignSource) -> Log:
    """Return a log with the sign of current that the data show, if they do; remark on doubts.

    A SoC that contradicts the sign which the voltage alone proves is left out.
    """
    finding, is_open = sign_of_current(log), sign_by == "data"
    voltage, soc = SignFinding.of(finding.evidence[:2]), finding.evidence[2]
    remarks, assumed, current_a = [*log.remarks], [*log.assumed], log.current_a
    soc_pct = log.soc_pct
    contradicts = abs(soc.weight) >= 1.0 and soc.weight * voltage.sign < 0.0
    if soc_pct is not None and not finding.sign and contradicts:
        first, last = soc_pct[np.isfinite(soc_pct)][[0, -1]]
        why = f"by the sign of current that the voltage proves ({voltage.strongest.text})"
        moves = f"it moves from {first:.4g} to {last:.4g} % against the charge, {why}"
        remarks.append(f"SoC left out: {moves}; is it a depth of discharge?")
        soc_pct, finding = None, voltage
    if is_open and assumed:
        way = "charges" if finding.sign < 0 else "discharges"
        how = "found from the data" if finding.sign else "not confirmed by the data"
        assumed.append(f"positive current {way}, {how}")
    if is_open and finding.sign < 0:
        current_a = 0.0 - current_a
        remarks.append(f"current negated, sign found from the data: {finding.strongest.text}")
    elif finding.sign < 0:
        kept = "current looks inverted and was kept as stored"
        if sign_by == "user":
            kept = "the stated sign of current looks inverted and was kept as stated"
        remarks.append(f"{kept}: {finding.sentence}")
    elif is_open and not finding.sign:
        remark = "sign of current unknown and undetermined by the data: kept as stored"
        remarks.append(f"{remark} (--sign charge inverts it)")
    return replace(
        log,
        current_a=current_a,
        soc_pct=soc_pct,
        remarks=tuple(remarks),
        assumed=tuple(assumed),
    )


# --- Size


def _in_canonical_units(
    log: Log, labels: Mapping[str, str], in_seconds: bool | None, stated: Collection[str]
) -> Log:
    """Return the log, with a remark on an unusual temperature; InputError for another unit."""
    usual_v, usual_c = typical(log.voltage_v), typical(log.temperature_c)
    may_be_swapped = COLDEST_C <= usual_v <= LIMITS["unusually_hot_c"]
    label_v, label_c = (labels.get(name, name) for name in ("voltage_v", "temperature_c"))
    table = (
        ("time_s", _of_time(log, in_seconds)),
        # Before the voltage: a temperature in its place looks like kilovolts.
        ("temperature_c", _swapped(log, usual_c, label_v) if may_be_swapped else ()),
        ("voltage_v", _of_voltage(log.voltage_v, usual_v)),
        ("current_a", _of_current(log)),
        ("soc_pct", _of_soc(log.soc_pct, is_stated="soc_pct" in stated)),
        (
            "temperature_c",
            _of_temperature(log.temperature_c, usual_c, may_be_swapped=may_be_swapped),
        ),
    )
    wrong: dict[str, _Doubt] = {}
    for field, doubts in table:
        for first in islice(doubts, 1):
            wrong.setdefault(field, first)
    if wrong:
        raise _refusal(log, wrong, labels, stated)
    if usual_c <= LIMITS["unusually_hot_c"]:
        return log
    remark = f"temperature {usual_c:.0f} °C is unusually hot"
    if "temperature_c" not in stated:
        option = _option({"temperature_c": (label_c, ["°F"])})
        remark += f": if it is °F, state the unit: {option}"
    return replace(log, remarks=(*log.remarks, remark))


def _refusal(
    log: Log, wrong: Mapping[str, _Doubt], labels: Mapping[str, str], stated: Collection[str]
) -> InputError:
    """Return the error of the first doubt; its cure states the units of all that have one."""
    named = {
        field: (labels[field], units)
        for field, (*_, units) in wrong.items()
        if units and field not in stated and labels.get(field, field).lower() != field
    }
    field, (value, problem, cure, _) = next(iter(wrong.items()))
    options = {each: column for each, column in named.items() if len(column[1]) == 1}
    if field not in options:
        options = {each: column for each, column in named.items() if each == field}
    if len(options) > 1:
        cure = f"state the units: {_option(options)}"
    elif options:
        cure = f"{cure} (or state the unit: {_option(options)})"
    where, label = log.source or log.name, labels.get(field, field)
    return InputError(problem, source=where, field=label, value=float(value), cure=cure)


def _option(columns: Mapping[str, tuple[str, Sequence[str]]]) -> str:
    """Return the option that states the units of columns, "?" where one may have several."""
    texts, how = [], ""
    for field, (label, units) in columns.items():
        unit, is_tick = units[0], "tick" in label.lower()
        if len(units) > 1 or is_tick:
            unit, how = "?", f", with {' or '.join(units)} for ?"
        if is_tick:
            how += " and a factor, such as [ms]:10 for ticks of 10 ms"
        texts.append(f"{field.rpartition('_')[0]}={label}[{unit}]")
    return f"--columns '{','.join(texts)}'{how}"


# Doubts on a column, the likeliest first. Medians stand before single values, so that a few odd
# rows are not another unit.


def _of_time(log: Log, in_seconds: bool | None) -> Iterator[_Doubt]:
    first, step = float(log.time_s[0]), np.diff(log.time_s)
    usual = float(np.median(step)) if step.size else 1.0
    finer = _fitting(usual, ("ms", "us", "ns"))
    coarser = ["d"] if first > LIMITS["spreadsheet_d"] else _fitting(usual, ("min", "h", "d"))
    if first > LIMITS["stamp_s"]:
        yield first, "time looks like milliseconds since 1970", "divide it by 1000", ["ms"]
    convert, apart = "convert it to seconds", f"rows are {usual:g}"
    if usual > LIMITS["interval_s"]:
        too_slow = "a log with a row every 90 s or more cannot be used"
        if in_seconds:
            yield usual, f"{apart} s apart: {too_slow}", "export a row each minute", []
        yield usual, f"{apart} apart: {_looks_like(finer)}", f"{convert} ({too_slow})", finer
    if usual < 1.0 / LIMITS["rate_hz"] and not in_seconds:
        yield usual, f"{apart} apart: {_looks_like(coarser)}", convert, coarser
    others = _other_units(log, finer, coarser) if in_seconds is None and step.size else []
    if others:
        problem, cure = "apart, in seconds or another unit", "name the unit in the heading"
        yield usual, f"{apart} {problem}", cure, ["s", *others]
    yield from _odd_row(log.time_s, -LIMITS["stamp_s"], LIMITS["stamp_s"], "a time in seconds")
    days = log.duration_s / _seconds("d")
    if days > LIMITS["log_d"]:
        row = int(np.argmax(step)) + 1
        problem = f"the log lasts {days:.0f} days; its longest step ends at row {row + 1}"
        yield float(log.time_s[row]), problem, "if the clock was set there, split the log there", []


def _looks_like(units: Sequence[str]) -> str:
    names = " or ".join(_TIME_UNITS[unit] for unit in units)
    return f"time looks like {names or 'another unit'}"


def _seconds(unit: str) -> float:
    return QUANTITIES["time"].units[unit][0]


def _fitting(step: float, units: Sequence[str]) -> list[str]:
    """Return those of the units in which rows are as far apart as a log's."""
    least_s, most_s = LIMITS["fastest_s"], LIMITS["interval_s"]
    return [unit for unit in units if least_s <= step * _seconds(unit) <= most_s]


def _other_units(log: Log, finer: list[str], coarser: list[str]) -> list[str]:
    """Return those of the units that time may be in as well as in seconds."""
    step = np.diff(log.time_s)
    # Seconds have steps below 10, or decimal ones: 0.016667 are 60 Hz, or 1 s in minutes.
    if finer and np.all(log.time_s % 1.0 == 0.0) and np.min(step) >= 10.0:
        with suppress(InputError):  # in the finer unit, a SoC may need a current of many C
            capacity_ah = abs(implied_capacity([log], least_pct=0.0).capacity_ah)
            rms_a = float(np.sqrt(np.mean(log.current_a**2)))
            if rms_a > LIMITS["c_rate_per_h"] * capacity_ah * _seconds(finer[0]):
                return []
        return finer
    mean = float(step.mean())
    parts = [1000.0 * mean, *(mean * _seconds(unit) for unit in coarser)]
    are_whole = [abs(part - round(part)) < 1e-3 for part in parts]
    is_coarse = any(are_whole) and not are_whole[0] and np.ptp(step) < 0.2 * mean
    return coarser if is_coarse else []


def _swapped(log: Log, usual_c: float, voltage_label: str) -> Iterator[_Doubt]:
    is_code = np.ptp(log.temperature_c) == 0.0
    if 273.15 + LIMITS["unusually_hot_c"] < usual_c <= LIMITS["voltage_v"] and not is_code:
        problem = f"it looks like a pack's voltage, and {voltage_label} like a temperature"
        yield usual_c, problem, "the two columns (or signals) look swapped: exchange them", []


def _of_temperature(celsius: FloatArray, usual: float, *, may_be_swapped: bool) -> Iterator[_Doubt]:
    kind = "a battery's temperature in °C"
    if 200.0 <= usual <= 400.0:
        also = ", or exchange it with the voltage if the two are swapped" if may_be_swapped else ""
        units = ["K"] if np.any(celsius % 1.0) else ["K", "0.1°C"]
        yield usual, "temperature looks like kelvin", f"subtract 273.15{also}", units
    if 10.0 * HOTTEST_C < usual <= 1000.0 * HOTTEST_C:
        problem = "temperature looks like thousandths of a degree"
        yield usual, problem, "divide it by 1000", ["0.001°C"]
    if not COLDEST_C <= usual <= HOTTEST_C:
        yield usual, f"this is not {kind}", "convert it to °C", []
    yield from _odd_row(celsius, COLDEST_C, HOTTEST_C, kind)


def _of_voltage(volts: FloatArray, usual: float) -> Iterator[_Doubt]:
    most = LIMITS["voltage_v"]
    if abs(usual) > most:
        yield _in_finer_unit(usual, most, "volts", "voltage")
    if usual <= 0.0:
        yield usual, "the median voltage is not positive", "check column and polarity", []
    if usual < 1.0:
        yield usual, "voltage looks like kilovolts", "convert it to volts", ["kV"]
    yield from _odd_row(volts, -most, most, "a battery's voltage")


def _of_current(log: Log) -> Iterator[_Doubt]:
    amps, most = log.current_a, LIMITS["current_a"]
    found = wrapped_current(amps, log.voltage_v)
    if found is not None:
        wraps_at_a, bits, step_a = found
        bit_field = f"{bits} bits unsigned of {step_a:g} A"
        problem = f"the current wraps at {wraps_at_a:.10g} A ({bit_field}): {WRAPPED}"
        cure = f"read it as signed: {wraps_at_a:.10g} A less, from half of that on"
        yield amps[np.argmax(np.abs(amps))], problem, cure, []
    for odd in _odd_row(amps, -most, most, "a battery's current"):
        size = np.abs(amps)
        is_large = size > most
        are_few = amps.size > 1000 and np.mean(is_large) < LIMITS["odd_share"]
        if not are_few and not all(map(_is_code, set(size[is_large]))):
            row = int(np.argmax(size))
            what = f"current exceeds {most:g} A in row {row + 1}: it"
            yield _in_finer_unit(float(amps[row]), most, "amperes", what)
        yield odd


def _is_code(value: float) -> bool:
    """Return whether all bits of its digits are set (65535), or but the last or the highest."""
    number = int(f"{value:f}".replace(".", "").strip("0"))
    return number > 254 and any((number + k) & (number + k - 1) == 0 for k in (0, 1, 2))


def _of_soc(soc_pct: FloatArray | None, *, is_stated: bool) -> Iterator[_Doubt]:
    if soc_pct is None or not np.isfinite(soc_pct).any():
        return
    least, most = float(np.nanmin(soc_pct)), float(np.nanmax(soc_pct))
    if least >= 0.0 and 0.0 < most <= 1.0 and not is_stated:
        cure = "multiply it by 100 (or leave it out if it stays below 1 %)"
        yield most, "SoC looks like a fraction of 1", cure, ["-", "%"]
    odd = most if most > 110.0 else least
    if not -10.0 <= odd <= 110.0:
        row = int(np.argmax(soc_pct == odd)) + 1
        yield odd, f"SoC of row {row} is not within 0–100 %", "convert it to %", []


def _odd_row(values: FloatArray, least: float, most: float, kind: str) -> Iterator[_Doubt]:
    """Yield the first row with an impossible value."""
    if values.min() < least or values.max() > most:
        row = int(np.argmax((values < least) | (values > most)))
        cure = "remove the row: codes such as 255 and 65535 mean 'not available'"
        yield float(values[row]), f"row {row + 1} is not {kind}", cure, []


def _in_finer_unit(value: float, limit: float, unit: str, what: str) -> _Doubt:
    """Return the doubt that a value above a limit [V or A] is in milli or micro."""
    prefix, divisor, symbol = "milli", "1000", "m"
    if abs(value) > 1e3 * limit:
        prefix, divisor, symbol = "micro", "1,000,000", "u"
    problem = f"{what} looks like {prefix}{unit}"
    return value, problem, f"divide it by {divisor}", [f"{symbol}{unit[0].upper()}"]
