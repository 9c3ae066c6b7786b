"""Inspect a log: timing, channels, charge, sign of current, and what it can identify."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Literal

import numpy as np

from cangauge._text import counted, duration, rounded, significant, uncertain
from cangauge._typing import BoolArray, FloatArray
from cangauge.bus.plausibility import (
    LEAST_SWING,
    STUCK_AFTER_S,
    SWING_C_RATE,
    PackProperties,
    stuck_detectors,
)
from cangauge.errors import InputError
from cangauge.identify.rows import (
    LEAST_ROWS,
    SOC_SPAN_AT_LEAST_PCT,
    TEMPERATURE_SPAN_K,
    usable_delays,
    usable_rows,
)
from cangauge.logs.charge import MIN_SPAN_PCT, contradiction, implied_capacity
from cangauge.logs.gaps import discharged_ah, uncounted_gaps, usual_gap_s, usual_step_s
from cangauge.logs.log import Log
from cangauge.logs.resolution import quantum_of
from cangauge.logs.sign import (
    STEP_SPACING_S,
    SignFinding,
    correlation,
    current_steps,
    sign_of_current,
    spaced_rows,
)
from cangauge.model.coulomb_counting import capacity_from_full_discharge
from cangauge.model.voltage_model import DELAYS_S
from cangauge.settings import GAP_S
from cangauge.types import SOC_WITHIN_PCT

Verdict = Literal["yes", "partly", "no"]

LISTED: Final = 10
FIT_RATE_HZ: Final = 1.0
"""Rate of a fit by default [Hz]."""
MIN_STEPS: Final = 8
"""Fewest clear steps of current for a resistance."""
CORRELATED: Final = 0.9
"""Correlation above which two influences are hard to separate [-]."""
REST_SHARE: Final = 0.02
"""Current at rest, relative to the peak [-]."""
REST_S: Final = 300.0
"""Shortest rest that shows the rest voltage [s]."""
WIDE_SOC_PCT: Final = 60.0
"""Span of SoC that shows most of the voltage curve [%]."""
CURRENT_SHARE: Final = 0.05
"""Smallest swing of current that must move the voltage, of its range [-]."""
VOLTAGE_SHARE: Final = 0.002
"""Smallest swing of voltage that must move the current, relative to its median [-]."""
SINGLE_ROW: Final = "too short: a single row, and charge is counted from one row to the next"


Gap = dict[str, float]
"""Time without rows: time of the last row before it, and its length [s]."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel of a log; values in `unit`.

    `quantum` is the quantization step (None: there is none), `levels` the number of distinct
    values, `missing` the rows without one. `stuck` are the intervals in which the channel kept one
    value while the other one swung: start and length [s], value, and why.
    """

    unit: str
    minimum: float
    maximum: float
    median: float
    quantum: float | None
    levels: int
    missing: int
    stuck: tuple[dict[str, Any], ...] = ()


@dataclass(frozen=True, slots=True)
class Timing:
    """Timing of the rows: intervals [s] (None for a single row), and gaps above `gap_limit_s`.

    `regular`: 99 % of the intervals are within 10 % of the median. `longest_gaps` are at most ten.
    """

    start_s: float
    duration_s: float
    interval_median_s: float | None
    interval_max_s: float | None
    rate_hz: float | None
    regular: bool
    gap_limit_s: float
    gap_count: int
    gap_total_s: float
    longest_gaps: tuple[Gap, ...]


@dataclass(frozen=True, slots=True)
class Charge:
    """Charge [Ah] by the trapezoidal rule; nothing is counted over a gap beyond `bridge_s`.

    `span_ah` is the range of the charge state, `in_gaps_ah` what is interpolated over gaps.
    """

    discharged_ah: float
    charged_ah: float
    net_ah: float
    span_ah: float
    in_gaps_ah: float
    uncounted_gaps: int
    uncounted_s: float


@dataclass(frozen=True, slots=True)
class Soc:
    """The reference SoC: share of rows with a value [-], values [%].

    `implied_capacity_ah` is the charge per 100 %, by least squares, with its standard deviation;
    None below a span of 5 %, and where charge and SoC contradict each other.
    """

    coverage: float
    first_pct: float
    last_pct: float
    minimum_pct: float
    maximum_pct: float
    implied_capacity_ah: float | None
    implied_capacity_std_ah: float | None


@dataclass(frozen=True, slots=True)
class LogInspection:
    """Findings of `inspect_log`; `soc` is None without a reference, `resistance` without steps.

    `resistance` has the median and the quartiles of −ΔU/ΔI over steps of current [Ω], of the
    current's right sign. `abilities` say what the log can identify, and why, with figures.
    `contradiction` says that charge and SoC of the log contradict each other; else it is None.
    """

    name: str
    source: str
    temperature_source: str
    rows: int
    timing: Timing
    channels: dict[str, Channel]
    charge: Charge
    soc: Soc | None
    resistance: dict[str, float] | None
    sign: SignFinding
    contradiction: str | None
    abilities: dict[str, tuple[Verdict, str]]
    remarks: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def answer(self) -> str:
        """What the log is good for, or what stands against it."""
        problem = SINGLE_ROW if self.rows == 1 else self.contradiction
        if problem is not None:
            return problem
        if self.sign.sign < 0:
            return f"{self.sign.sentence}; --sign charge inverts it"
        for topic in ("rows for a fit", "voltage curve over SoC"):
            verdict, text = self.abilities[topic]
            if verdict == "no":
                return f"good for an estimate, not for a fit: {text}"
        if self.soc is None:
            needed = "--capacity-ah and, of one log, --initial-soc"
            return f"good for an estimate; a fit needs {needed}, as the log has no SoC"
        covered = f"{self.soc.minimum_pct:.0f} … {self.soc.maximum_pct:.0f} % SoC"
        least, most = SOC_WITHIN_PCT
        if self.soc.minimum_pct < least or self.soc.maximum_pct > most:
            return f"good for an estimate, not for a fit: {covered} is a wrong scale or offset"
        return f"good for a fit over {covered}, and for an estimate"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        plain = asdict(self)
        del plain["sign"]
        plain["abilities"] = [
            {"topic": topic, "verdict": verdict, "text": text}
            for topic, (verdict, text) in self.abilities.items()
        ]
        found = {"sign_of_current": self.sign.to_dict(), "answer": self.answer}
        return {"kind": "log", **plain, **found}


def inspect_log(log: Log) -> LogInspection:
    """Inspect a log; the sign of its current is one of the findings."""
    timing, sign = _timing(log), sign_of_current(log)
    contradicts = None if sign.sign < 0 else contradiction(log)
    soc = _soc(log, sign, contradicts)
    charge = _charge(log, timing.gap_limit_s)
    resistance = _resistance(log, sign)
    channels = _channels(log, resistance["median_ohm"] if resistance else None)
    warnings = tuple(_warnings(log, timing, channels, charge, sign))
    abilities: dict[str, tuple[Verdict, str]] = {
        "sign of current": ("yes" if sign.sign else "no", sign.sentence),
        "voltage curve over SoC": _curve(charge, soc),
        "capacity": ("no", contradicts) if contradicts else _capacity(log, charge, soc),
        "ohmic resistance": _ohmic(resistance, max(STEP_SPACING_S, usual_step_s(log.time_s))),
        "delayed current terms": _delays(log, timing),
        "rows for a fit": _rows(log, timing),
        "temperature coefficient": _temperature(log),
        "start from rest": _start(log, timing),
        "rest voltage": _rests(log),
    }
    return LogInspection(
        log.name,
        log.source,
        log.temperature_source,
        len(log),
        timing,
        channels,
        charge,
        soc,
        resistance,
        sign,
        contradicts,
        abilities,
        log.remarks,
        warnings,
    )


def channel_rows(found: LogInspection) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows of the channels: a constant one has no step."""
    rows = []
    for name, item in found.channels.items():
        values = (significant(value, 5) for value in (item.minimum, item.median, item.maximum))
        step = "constant" if item.levels == 1 else significant(item.quantum, 3)
        rows.append([name, *values, item.unit, step, str(item.missing)])
    return ["channel", "minimum", "median", "maximum", "unit", "step", "missing rows"], rows


def ability_rows(found: LogInspection) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows of what a log can identify."""
    rows = [[topic, *ability] for topic, ability in found.abilities.items()]
    return ["quantity", "identifiable", "reason"], rows


def _timing(log: Log) -> Timing:
    time_s, step = log.time_s, np.diff(log.time_s)
    limit_s = usual_gap_s(time_s, GAP_S)
    gaps = np.flatnonzero(step > limit_s)
    longest = gaps[np.argsort(-step[gaps], kind="stable")][:LISTED]
    median = float(np.median(step)) if step.size else None
    is_regular = bool(median and np.mean(np.abs(step - median) <= 0.1 * median) >= 0.99)
    return Timing(
        float(time_s[0]),
        log.duration_s,
        median,
        float(step.max()) if step.size else None,
        1.0 / median if median else None,
        is_regular,
        limit_s,
        int(gaps.size),
        float(step[gaps].sum()),
        tuple({"start_s": float(time_s[i]), "length_s": float(step[i])} for i in longest),
    )


def _charge(log: Log, gap_limit_s: float) -> Charge:
    state, step = discharged_ah(log.time_s, log.current_a), np.diff(log.time_s)
    part, uncounted = np.diff(state), uncounted_gaps(log.time_s)
    return Charge(
        float(part[part > 0.0].sum()),
        float(np.abs(part[part < 0.0]).sum()),
        float(state[-1]),
        float(np.ptp(state)),
        float(np.abs(part[step > gap_limit_s]).sum()),
        int(uncounted.size),
        float(step[uncounted].sum()),
    )


def _soc(log: Log, sign: SignFinding, contradicts: str | None) -> Soc | None:
    if log.soc_pct is None or not np.isfinite(log.soc_pct).any():
        return None
    soc = log.soc_pct[np.isfinite(log.soc_pct)]
    capacity_ah = std_ah = None
    if contradicts is None and np.ptp(soc) >= MIN_SPAN_PCT:
        with suppress(InputError):
            found = implied_capacity([log])
            capacity_ah = found.capacity_ah * (sign.sign or 1)
            std_ah = found.std_ah
    if capacity_ah is not None and capacity_ah <= 0.0:
        capacity_ah = std_ah = None
    first, last, low, high = (float(each) for each in (soc[0], soc[-1], soc.min(), soc.max()))
    return Soc(soc.size / len(log), first, last, low, high, capacity_ah, std_ah)


def _resistance(log: Log, sign: SignFinding) -> dict[str, float] | None:
    current, voltage = current_steps(log)
    if current.size < MIN_STEPS:
        return None
    ohm = np.quantile(-voltage / current * (sign.sign or 1), [0.5, 0.25, 0.75]).tolist()
    if ohm[0] <= 0.0:
        return None
    found = dict(zip(("median_ohm", "lower_ohm", "upper_ohm"), ohm, strict=True))
    return {**found, "steps": current.size}


# --- Channels


_UNITS: Final = {"current_a": "A", "voltage_v": "V", "temperature_c": "°C", "soc_pct": "%"}


def _channels(log: Log, resistance_ohm: float | None) -> dict[str, Channel]:
    """Describe the channels of a log.

    With a resistance [Ω], current and voltage are searched for stuck intervals.
    """
    columns = {name: getattr(log, name) for name in _UNITS}
    channels = {
        name: _channel(values, _UNITS[name])
        for name, values in columns.items()
        if values is not None and np.isfinite(values).any()
    }
    if resistance_ohm:
        stuck = _stuck(log, channels["current_a"], channels["voltage_v"], abs(resistance_ohm))
        channels |= {name: replace(channels[name], stuck=found) for name, found in stuck.items()}
    return channels


def _channel(values: FloatArray, unit: str) -> Channel:
    finite = values[np.isfinite(values)]
    low, high, median = float(finite.min()), float(finite.max()), float(np.median(finite))
    levels, missing = int(np.unique(finite).size), int(values.size - finite.size)
    return Channel(unit, low, high, median, quantum_of(finite), levels, missing)


def _stuck(
    log: Log, current: Channel, voltage: Channel, resistance_ohm: float
) -> dict[str, tuple[dict[str, Any], ...]]:
    """Return the stuck intervals of current and voltage, by the detectors of the service."""
    pack = PackProperties(
        resistance_ohm,
        error_std_v=VOLTAGE_SHARE * abs(voltage.median) / LEAST_SWING,
        capacity_ah=CURRENT_SHARE * (current.maximum - current.minimum) / SWING_C_RATE,
        usual_v=abs(voltage.median),
    )
    of_current, of_voltage = stuck_detectors(
        pack, (current.quantum or 0.0, STUCK_AFTER_S), (voltage.quantum or 0.0, STUCK_AFTER_S)
    )
    columns = (each.tolist() for each in (log.time_s, log.current_a, log.voltage_v))
    flags = [
        (of_current.update(current_a, time_s), of_voltage.update(voltage_v, time_s))
        for time_s, current_a, voltage_v in zip(*columns, strict=True)
    ]
    is_stuck_a, is_stuck_v = np.transpose(flags)
    why_a = f"the voltage swung several times by {of_voltage.swing:.3g} V or more"
    why_v = f"the current swung several times by {of_current.swing:.3g} A or more"
    return {
        "current_a": _intervals(log.time_s, log.current_a, is_stuck_a, why_a),
        "voltage_v": _intervals(log.time_s, log.voltage_v, is_stuck_v, why_v),
    }


def _intervals(
    time_s: FloatArray, values: FloatArray, is_stuck: BoolArray, why: str
) -> tuple[dict[str, Any], ...]:
    """Return the intervals of one value that have a row recognised as stuck."""
    first = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    last = np.append(first[1:], values.size) - 1
    hit = np.logical_or.reduceat(is_stuck, first)
    names = ("start_s", "duration_s", "value")
    start_s = time_s[first[hit]]
    rows = np.column_stack([start_s, time_s[last[hit]] - start_s, values[first[hit]]]).tolist()
    return tuple({**dict(zip(names, row, strict=True)), "why": why} for row in rows)


# --- Warnings


def _warnings(
    log: Log, timing: Timing, channels: dict[str, Channel], charge: Charge, sign: SignFinding
) -> Iterator[str]:
    if sign.sign < 0:
        yield "the sign of current is inverted: multiply current_a by -1"
    elif sign.sign == 0:
        yield "the sign of current could not be confirmed: make sure that discharge is > 0"
    if (timing.interval_median_s or 0.0) > GAP_S:
        yield (
            f"rows are {_interval(timing)} apart: shorter delays of the current cannot be"
            " identified, and quick changes of voltage not be followed"
        )
    if timing.gap_count:
        longest = timing.longest_gaps[0]
        yield (
            f"{counted(timing.gap_count, 'gap')} of more than {rounded(timing.gap_limit_s, 2)} s,"
            f" the longest {longest['length_s']:.4g} s at {longest['start_s']:.1f} s;"
            f" {charge.in_gaps_ah:.3g} Ah are interpolated over gaps"
        )
    if charge.uncounted_gaps:
        yield (
            f"no charge is counted over {charge.uncounted_gaps} of them,"
            f" {duration(charge.uncounted_s)} in all: the pack is assumed to rest; where the log's"
            " own SoC moves over one, a fit splits the log there"
        )
    for name, channel in channels.items():
        for each in channel.stuck[:LISTED]:
            yield (
                f"{name} stuck at {each['value']:g} {channel.unit} for {each['duration_s']:.0f} s"
                f" from {each['start_s']:.1f} s: {each['why']}"
            )
    yield from (f"{n} never changes" for n in ("current_a", "voltage_v") if channels[n].levels == 1)
    if log.temperature_source == "room":
        yield "the temperature is the room's: the battery may be colder or hotter"


def _interval(timing: Timing) -> str:
    return f"{timing.interval_median_s or 0.0:.3g} s"


# --- Abilities: a verdict, and the reason with its figures


def _curve(charge: Charge, soc: Soc | None) -> tuple[Verdict, str]:
    if soc is None:
        text = f"no reference SoC; the charge state spans {charge.span_ah:.3g} Ah: give the"
        text += " capacity and the SoC at the start, or fit it with a log that has both"
        return "partly", text
    span = soc.maximum_pct - soc.minimum_pct
    covered = f"SoC covers {soc.minimum_pct:.1f} … {soc.maximum_pct:.1f} %"
    if span < SOC_SPAN_AT_LEAST_PCT:
        return "no", f"{covered}: too little for a curve"
    is_wide = span >= WIDE_SOC_PCT
    return ("yes", covered) if is_wide else ("partly", f"{covered}: only this part of the curve")


def _capacity(log: Log, charge: Charge, soc: Soc | None) -> tuple[Verdict, str]:
    if soc is None or soc.implied_capacity_ah is None:
        text = f"no reference SoC that spans {MIN_SPAN_PCT:g} %; at least {charge.span_ah:.3g}"
        return "no", f"{text} Ah, the capacity if the log runs from full to empty"
    span = soc.maximum_pct - soc.minimum_pct
    try:
        whole_ah = capacity_from_full_discharge([log], [None])
    except InputError:
        per_100 = uncertain(soc.implied_capacity_ah, soc.implied_capacity_std_ah, "Ah")
        text = f"{per_100} per 100 % of reference SoC, over {span:.1f} %"
        return "yes" if span >= WIDE_SOC_PCT else "partly", text
    return "yes", f"{whole_ah:.4g} Ah: the log runs from full to empty"


def _ohmic(resistance: dict[str, float] | None, step_s: float) -> tuple[Verdict, str]:
    if resistance is None:
        return "no", f"fewer than {MIN_STEPS} clear steps of current"
    ohm, low, high, steps = resistance.values()
    text = f"{ohm:.4g} Ω (quartiles {low:.4g} … {high:.4g}) from {steps} steps of"
    verdict: Verdict = "yes" if abs(high - low) <= 0.5 * abs(ohm) else "partly"
    return verdict, f"{text} current over {step_s:.3g} s"


def _delays(log: Log, timing: Timing) -> tuple[Verdict, str]:
    if timing.interval_median_s is None or timing.duration_s < 10.0 * DELAYS_S[-1]:
        text = f"{timing.duration_s:.0f} s is too short for delays up to {DELAYS_S[-1]:.0f} s"
        return "no", text
    usable = usable_delays([log], DELAYS_S)
    step = f"rows every {_interval(timing)}"
    if len(usable) == 1:
        return "no", f"{step} are too slow for any delay"
    kept = ", ".join(f"{delay:g}" for delay in usable)
    if len(usable) < len(DELAYS_S):
        return "partly", f"{step} identify delays of {kept} s only"
    # At rows about a second apart, not on a grid: a gap may last months.
    rows = spaced_rows(log.time_s, 1.0)
    rows = rows[log.time_s[rows] >= log.time_s[0] + DELAYS_S[1]]
    before = np.interp(log.time_s[rows] - DELAYS_S[1], log.time_s, log.current_a)
    if rows.size <= 2 or np.ptp(log.current_a[rows]) == 0.0 or np.ptp(before) == 0.0:
        return "no", "current does not vary"
    alike = correlation(log.current_a[rows], before)
    text = f"currents {DELAYS_S[1]:.0f} s apart correlate by {alike:.2f}"
    return ("yes", text) if alike <= CORRELATED else ("partly", f"{text}: hard to separate")


def _rows(log: Log, timing: Timing) -> tuple[Verdict, str]:
    """Assess how many rows a fit would use: those behind a filled delay line."""
    delay_s = usable_delays([log], DELAYS_S) if len(log) > 1 else DELAYS_S
    kept, removed = usable_rows(log, delay_s, FIT_RATE_HZ)
    total = kept.size + removed["start_up_or_shut_down"] + removed["delay_line_filling"]
    step_s = max(timing.interval_median_s or 0.0, 1.0 / FIT_RATE_HZ)
    if kept.size < LEAST_ROWS:
        delay = f"{max(delay_s):.0f} s"
        needed = f"it needs {LEAST_ROWS} rows, {step_s:.3g} s apart, beyond the first {delay}"
        return "no", f"{needed} and the {delay} after each gap; there are {kept.size or 'none'}"
    text = f"{kept.size} of {total} rows every {step_s:.3g} s; the first {max(delay_s):.0f} s, and"
    text += " as long after each gap, fill the delay line"
    return "yes" if kept.size > 0.5 * total else "partly", text


def _temperature(log: Log) -> tuple[Verdict, str]:
    span = float(np.ptp(log.temperature_c))
    where = {
        "room": "; it is the ROOM's temperature, not the battery's",
        "unknown": "; where it was measured is not known",
    }.get(log.temperature_source, f" ({log.temperature_source})")
    if span < TEMPERATURE_SPAN_K:
        return "no", f"temperature {f'spans only {span:.1f} K' if span else 'never changes'}{where}"
    alike = correlation(discharged_ah(log.time_s, log.current_a), log.temperature_c)
    text = f"temperature spans {span:.1f} K, correlated with charge by {alike:+.2f}{where}"
    is_doubtful = abs(alike) > CORRELATED or where.startswith(";")
    return "partly" if is_doubtful else "yes", text


def _start(log: Log, timing: Timing) -> tuple[Verdict, str]:
    within_s = max(DELAYS_S[1], timing.interval_median_s or 0.0)
    first = log.current_a[log.time_s - log.time_s[0] <= within_s]
    at_start = float(np.max(np.abs(first)))
    what = f"the first {within_s:.3g} s" if first.size > 1 else "the first row"
    text = f"up to {at_start:.3g} A in {what}"
    if at_start > REST_SHARE * float(np.max(np.abs(log.current_a))):
        return "no", text
    return "yes", f"{text}: the first voltages are near rest"


def _rests(log: Log) -> tuple[Verdict, str]:
    """Assess the rests, which show the rest voltage and an offset of the current sensor."""
    still = np.abs(log.current_a) <= REST_SHARE * float(np.max(np.abs(log.current_a)))
    edges = np.flatnonzero(np.diff(np.concatenate(([False], still, [False])).astype(np.int8)))
    length = log.time_s[edges[1::2] - 1] - log.time_s[edges[::2]]
    rests = int((length >= REST_S).sum())
    longest = duration(float(length.max(initial=0.0)))
    text = f"{counted(rests, 'rest')} of 5 min or more, the longest {longest}"
    return "yes" if rests >= 3 else "partly" if rests else "no", text
