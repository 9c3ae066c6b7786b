"""Inspect a log: its channels, its sign of current, and what it can identify."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

import numpy as np

from cangauge._formatting import counted, duration
from cangauge.errors import InputError
from cangauge.identify.rows import SOC_SPAN_AT_LEAST_PCT, usable_delays, usable_rows
from cangauge.inspect.channels import (
    GAP_S,
    Channel,
    Charge,
    Resistance,
    Soc,
    Timing,
    describe_channel,
    describe_charge,
    describe_resistance,
    describe_soc,
    describe_timing,
    find_stuck,
)
from cangauge.logs.gaps import usual_gap_s
from cangauge.logs.log import Log
from cangauge.logs.sign import SignFinding, charge_ah, correlation, sign_of_current, spaced_rows
from cangauge.model.coulomb_counting import capacity_from_full_discharge
from cangauge.model.prior import DELAYS_S as FIT_DELAYS_S
from cangauge.model.voltage_model import BASIS_NAMES

Verdict = Literal["yes", "partly", "no"]

# Smallest jumps of current and voltage for the search of stuck channels.
CURRENT_JUMP_SHARE: Final = 0.05
"""Of the range of current [-]."""
VOLTAGE_QUANTA: Final = 4.0
"""Of voltage, in quanta; a jump of current must move the voltage by as much."""
VOLTAGE_SHARE: Final = 0.002
"""Of voltage, relative to its median [-]."""
LISTED_INTERVALS: Final = 5
"""Most stuck intervals of a channel to list in the warnings."""

# Limits of the abilities.
DELAYS_S: Final = (10.0, 30.0, 70.0)
"""Delays of the published model [s]."""
SLOW_S: Final = 2.0
"""Median interval from which a log is slow [s]: the delay line bridges as much."""
FIT_RATE_HZ: Final = 1.0
"""Rate of a fit by default [Hz]."""
CORRELATED: Final = 0.9
"""Correlation above which two influences are hard to separate [-]."""
TEMPERATURE_SPAN_K: Final = 3.0
"""Least span of temperature for its coefficient [K]."""
REST_SHARE: Final = 0.02
"""Current at rest, relative to the peak [-]."""
REST_S: Final = 300.0
"""Shortest rest that shows the rest voltage [s]."""
WIDE_SOC_PCT: Final = 60.0
"""Span of SoC that shows most of the voltage curve [%]."""


@dataclass(frozen=True, slots=True)
class Ability:
    """Whether a log can identify something.

    Parameters
    ----------
    topic : str
    verdict : {"yes", "partly", "no"}
    text : str
        The reason, with figures.
    """

    topic: str
    verdict: Verdict
    text: str


@dataclass(frozen=True, slots=True)
class LogInspection:
    """Findings of `inspect_log`.

    Parameters
    ----------
    name, source, temperature_source : str
    rows : int
    timing : Timing
    channels : dict of str to Channel
        `current_a`, `voltage_v`, `temperature_c`, and `soc_pct` where there is one.
    charge : Charge
    soc : Soc or None
        None without any finite reference.
    resistance : Resistance or None
        None without clear steps.
    sign : SignFinding
    abilities : tuple of Ability
    remarks : tuple of str
        Of the reader.
    warnings : tuple of str
        Problems to check.
    """

    name: str
    source: str
    temperature_source: str
    rows: int
    timing: Timing
    channels: dict[str, Channel]
    charge: Charge
    soc: Soc | None
    resistance: Resistance | None
    sign: SignFinding
    abilities: tuple[Ability, ...]
    remarks: tuple[str, ...]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        plain = asdict(self)
        del plain["sign"]
        return {"kind": "log", **plain, "sign_of_current": self.sign.to_dict()}


def inspect_log(log: Log) -> LogInspection:
    """Inspect a log; the sign of its current is one of the findings."""
    timing = describe_timing(log.time_s, usual_gap_s(log.time_s, GAP_S))
    resistance = describe_resistance(log)
    channels = _channels(log, resistance)
    charge = describe_charge(log, timing.gap_limit_s)
    soc = describe_soc(log)
    sign = sign_of_current(log)
    return LogInspection(
        name=log.name,
        source=log.source,
        temperature_source=log.temperature_source,
        rows=len(log),
        timing=timing,
        channels=channels,
        charge=charge,
        soc=soc,
        resistance=resistance,
        sign=sign,
        abilities=(
            Ability("sign of current", "yes" if sign.sign else "no", sign.sentence),
            _voltage_curve(charge, soc),
            _capacity(log, charge, soc),
            _resistance(resistance),
            _delays(log, timing),
            _rows(log),
            _temperature(log),
            _start(log),
            _rests(log),
        ),
        remarks=log.remarks,
        warnings=tuple(_warnings(log, timing, channels, charge, sign)),
    )


def _channels(log: Log, resistance: Resistance | None) -> dict[str, Channel]:
    current = describe_channel(log.current_a, "A")
    voltage = describe_channel(log.voltage_v, "V")
    if resistance is not None and resistance.median_ohm != 0.0:
        noticeable = max(
            VOLTAGE_QUANTA * (voltage.quantum or 0.0), VOLTAGE_SHARE * abs(voltage.median)
        )
        jump_a = max(
            noticeable / abs(resistance.median_ohm),
            CURRENT_JUMP_SHARE * (current.maximum - current.minimum),
        )
        jump_v = max(noticeable, jump_a * abs(resistance.median_ohm))
        stuck_v = find_stuck(log, log.voltage_v, log.current_a, jump_a, "A")
        stuck_a = find_stuck(log, log.current_a, log.voltage_v, jump_v, "V")
        voltage = describe_channel(log.voltage_v, "V", stuck_v)
        current = describe_channel(log.current_a, "A", stuck_a)
    channels = {
        "current_a": current,
        "voltage_v": voltage,
        "temperature_c": describe_channel(log.temperature_c, "°C"),
    }
    if log.soc_pct is not None and np.isfinite(log.soc_pct).any():
        channels["soc_pct"] = describe_channel(log.soc_pct, "%")
    return channels


def _warnings(
    log: Log,
    timing: Timing,
    channels: dict[str, Channel],
    charge: Charge,
    sign: SignFinding,
) -> list[str]:
    found = []
    if sign.sign < 0:
        found.append("the sign of current is inverted: multiply current_a by -1")
    elif sign.sign == 0:
        found.append("the sign of current could not be confirmed: make sure that discharge is > 0")
    found.extend(_gap_warnings(timing, charge))
    for name, channel in channels.items():
        found.extend(_stuck_warnings(name, channel))
    found.extend(
        f"{name} never changes" for name in ("current_a", "voltage_v") if channels[name].levels == 1
    )
    if log.temperature_source == "room":
        found.append("the temperature is the room's: the battery may be colder or hotter")
    return found


def _gap_warnings(timing: Timing, charge: Charge) -> list[str]:
    found = []
    if (timing.interval_median_s or 0.0) > SLOW_S:
        found.append(
            f"rows are {timing.interval_median_s:.3g} s apart: shorter delays of the current cannot"
            " be identified, and quick changes of voltage not be followed"
        )
    if timing.gap_count:
        longest = timing.longest_gaps[0]
        found.append(
            f"{counted(timing.gap_count, 'gap')} of more than {timing.gap_limit_s:g} s, the longest"
            f" {longest.length_s:.4g} s at {longest.start_s:.1f} s; {charge.in_gaps_ah:.3g} Ah are"
            " interpolated over gaps"
        )
    if charge.uncounted_gaps:
        found.append(
            f"no charge is counted over {charge.uncounted_gaps} of them,"
            f" {duration(charge.uncounted_s)} in all: the pack is assumed to rest; where the log's"
            " own SoC moves over one, a fit splits the log there"
        )
    return found


def _stuck_warnings(name: str, channel: Channel) -> list[str]:
    found = [
        f"{name} stuck at {stretch.value:g} {channel.unit} for {stretch.duration_s:.0f} s"
        f" from {stretch.start_s:.1f} s: {stretch.why}"
        for stretch in channel.stuck[:LISTED_INTERVALS]
    ]
    more = len(channel.stuck) - LISTED_INTERVALS
    return [*found, f"{name}: {more} more stuck intervals"] if more > 0 else found


def _voltage_curve(charge: Charge, soc: Soc | None) -> Ability:
    topic = "voltage curve over SoC"
    if soc is None:
        text = (
            f"no reference SoC; the charge state spans {charge.span_ah:.3g} Ah: give the capacity"
            " and the SoC at the start, or fit it with a log that has both"
        )
        return Ability(topic, "partly", text)
    span = soc.maximum_pct - soc.minimum_pct
    covered = f"SoC covers {soc.minimum_pct:.1f} … {soc.maximum_pct:.1f} %"
    if span >= WIDE_SOC_PCT:
        return Ability(topic, "yes", covered)
    if span >= SOC_SPAN_AT_LEAST_PCT:
        return Ability(topic, "partly", f"{covered}: only this part of the curve")
    return Ability(topic, "no", f"{covered}: too little for a curve")


def _capacity(log: Log, charge: Charge, soc: Soc | None) -> Ability:
    if soc is None or soc.implied_capacity_ah is None:
        text = (
            f"no reference SoC that spans 5 %; at least {charge.span_ah:.3g} Ah, the capacity if"
            " the log runs from full to empty"
        )
        return Ability("capacity", "no", text)
    span = soc.maximum_pct - soc.minimum_pct
    text = f"{soc.implied_capacity_ah:.4g} Ah per 100 % of reference SoC, over {span:.1f} %"
    try:
        whole_ah = capacity_from_full_discharge([log], None)
    except InputError:
        return Ability("capacity", "yes" if span >= WIDE_SOC_PCT else "partly", text)
    return Ability("capacity", "yes", f"{whole_ah:.4g} Ah: the log runs from full to empty")


def _resistance(resistance: Resistance | None) -> Ability:
    if resistance is None:
        return Ability("ohmic resistance", "no", "fewer than eight clear steps of current")
    text = (
        f"{resistance.median_ohm:.4g} Ω (quartiles {resistance.lower_ohm:.4g} …"
        f" {resistance.upper_ohm:.4g}) from {resistance.steps} steps of current over about a second"
    )
    spread = abs(resistance.upper_ohm - resistance.lower_ohm)
    steady = spread <= 0.5 * abs(resistance.median_ohm)
    return Ability("ohmic resistance", "yes" if steady else "partly", text)


def _delays(log: Log, timing: Timing) -> Ability:
    topic = "delayed current terms"
    longest = DELAYS_S[-1]
    if timing.interval_median_s is None or timing.duration_s < 10.0 * longest:
        text = f"{timing.duration_s:.0f} s is too short for delays up to {longest:.0f} s"
        return Ability(topic, "no", text)
    usable = usable_delays([log], FIT_DELAYS_S)
    if len(usable) < len(FIT_DELAYS_S):
        step = f"rows every {timing.interval_median_s:.3g} s"
        if len(usable) == 1:
            return Ability(topic, "no", f"{step} are too slow for any delay")
        kept = ", ".join(f"{delay:g}" for delay in usable)
        return Ability(topic, "partly", f"{step} identify delays of {kept} s only")
    correlated = _autocorrelation(log)
    if correlated is None:
        return Ability(topic, "no", "current does not vary")
    text = f"currents {DELAYS_S[0]:.0f} s apart correlate by {correlated:.2f}"
    if correlated > CORRELATED:
        return Ability(topic, "partly", f"{text}: the terms are hard to separate")
    return Ability(topic, "yes", text)


def _rows(log: Log) -> Ability:
    """Assess how many rows a fit would use: those behind a filled delay line."""
    topic = "rows for a fit"
    delay_s = usable_delays([log], FIT_DELAYS_S) if len(log) > 1 else FIT_DELAYS_S
    kept, removed = usable_rows(log, delay_s, FIT_RATE_HZ)
    total = kept.size + removed["start_up_or_shut_down"] + removed["delay_line_filling"]
    needed = 4 * (len(BASIS_NAMES) + 1 + len(delay_s))
    text = (
        f"{kept.size} of {total} at {FIT_RATE_HZ:g} Hz; the first {max(delay_s):.0f} s, and as long"
        f" after each gap, fill the delay line; {needed} are needed"
    )
    verdict: Verdict = "no" if kept.size < needed else "partly"
    if verdict == "partly" and kept.size > 0.5 * total:
        verdict = "yes"
    return Ability(topic, verdict, text)


def _autocorrelation(log: Log) -> float | None:
    """Return the correlation of current with itself ten seconds before."""
    # At rows about a second apart, not on a grid: a gap may last months.
    rows = spaced_rows(log.time_s, 1.0)
    rows = rows[log.time_s[rows] >= log.time_s[0] + DELAYS_S[0]]
    now = log.current_a[rows]
    before = np.interp(log.time_s[rows] - DELAYS_S[0], log.time_s, log.current_a)
    if now.size <= 2 or np.ptp(now) == 0.0 or np.ptp(before) == 0.0:
        return None
    return correlation(now, before)


def _temperature(log: Log) -> Ability:
    topic = "temperature coefficient"
    span = float(np.ptp(log.temperature_c))
    where = {
        "room": "; it is the ROOM's temperature, not the battery's",
        "unknown": "; where it was measured is not known",
    }.get(log.temperature_source, f" ({log.temperature_source})")
    if span == 0.0:
        return Ability(topic, "no", f"temperature never changes{where}")
    if span < TEMPERATURE_SPAN_K:
        return Ability(topic, "no", f"temperature spans only {span:.1f} K{where}")
    with_charge = correlation(charge_ah(log), log.temperature_c)
    text = f"temperature spans {span:.1f} K, correlated with charge by {with_charge:+.2f}{where}"
    doubtful = abs(with_charge) > CORRELATED or where.startswith(";")
    verdict: Verdict = "partly" if doubtful else "yes"
    return Ability(topic, verdict, text)


def _start(log: Log) -> Ability:
    limit = REST_SHARE * float(np.max(np.abs(log.current_a)))
    first = log.current_a[log.time_s - log.time_s[0] <= DELAYS_S[0]]
    at_start = float(np.max(np.abs(first)))
    if at_start <= limit:
        text = f"at most {at_start:.3g} A in the first 10 s: the first voltages are near rest"
        return Ability("start from rest", "yes", text)
    return Ability("start from rest", "no", f"up to {at_start:.3g} A in the first 10 s")


def _rests(log: Log) -> Ability:
    """Assess the rests, which show the rest voltage and an offset of the current sensor."""
    topic = "rest voltage"
    peak = float(np.max(np.abs(log.current_a)))
    still = np.abs(log.current_a) <= REST_SHARE * peak
    edges = np.flatnonzero(np.diff(np.concatenate(([False], still, [False])).astype(np.int8)))
    first, last = edges[::2], edges[1::2] - 1
    length = log.time_s[last] - log.time_s[first]
    rests = int((length >= REST_S).sum())
    longest = float(length.max()) if length.size else 0.0
    text = f"{rests} rests of 5 min or more, the longest {longest / 60.0:.1f} min"
    return Ability(topic, "yes" if rests >= 3 else "partly" if rests else "no", text)
