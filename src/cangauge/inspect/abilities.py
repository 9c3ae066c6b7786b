"""What a log can and cannot identify, in words with figures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from cangauge.inspect.charge import Charge, Resistance, Soc
from cangauge.inspect.sign import SignFinding, charge_ah, correlation, spaced_rows
from cangauge.inspect.timing import Timing
from cangauge.logs.log import Log

Verdict = Literal["yes", "partly", "no"]

DELAYS_S: Final = (10.0, 30.0, 70.0)
"""Delays of the published model [s]."""
SLOW_S: Final = 2.0
ALIKE: Final = 0.9
TEMPERATURE_SPAN_C: Final = 3.0
REST_SHARE: Final = 0.02
REST_S: Final = 300.0
WIDE_SOC_PCT: Final = 60.0


@dataclass(frozen=True, slots=True)
class Ability:
    """Whether a log can identify something.

    Parameters
    ----------
    topic : str
    verdict : {"yes", "partly", "no"}
    text : str
        Why, with figures.
    """

    topic: str
    verdict: Verdict
    text: str


def judge_abilities(
    log: Log,
    *,
    timing: Timing,
    charge: Charge,
    soc: Soc | None,
    resistance: Resistance | None,
    sign: SignFinding,
) -> tuple[Ability, ...]:
    """Say what the log can identify; the limits stand at the top of this module."""
    return (
        _sign(sign),
        _voltage_curve(charge, soc),
        _capacity(charge, soc),
        _resistance(resistance),
        *_delays(log, timing),
        _temperature(log),
        _start(log),
        _rests(log),
    )


def _sign(sign: SignFinding) -> Ability:
    return Ability("sign of current", "yes" if sign.sign else "no", sign.sentence)


def _voltage_curve(charge: Charge, soc: Soc | None) -> Ability:
    topic = "voltage curve over SoC"
    if soc is None:
        text = (
            f"no reference SoC; the charge state spans {charge.span_ah:.3g} Ah:"
            " give the capacity and the initial SoC"
        )
        return Ability(topic, "partly", text)
    span = soc.maximum_pct - soc.minimum_pct
    seen = f"SoC {soc.minimum_pct:.1f} … {soc.maximum_pct:.1f} % seen"
    if span >= WIDE_SOC_PCT:
        return Ability(topic, "yes", seen)
    if span >= 5.0:
        return Ability(topic, "partly", f"{seen}: only this part of the curve")
    return Ability(topic, "no", f"{seen}: too little for a curve")


def _capacity(charge: Charge, soc: Soc | None) -> Ability:
    if soc is None or soc.implied_capacity_ah is None:
        text = (
            f"no reference SoC that moves by 5 %; at least {charge.span_ah:.3g} Ah, which is the"
            " capacity if the log runs from full to empty"
        )
        return Ability("capacity", "no", text)
    span = soc.maximum_pct - soc.minimum_pct
    text = f"{soc.implied_capacity_ah:.4g} Ah per 100 % of reference, from {span:.1f} % of span"
    return Ability("capacity", "yes" if span >= WIDE_SOC_PCT else "partly", text)


def _resistance(resistance: Resistance | None) -> Ability:
    if resistance is None:
        return Ability("ohmic resistance", "no", "fewer than eight clear steps of current")
    text = (
        f"{resistance.median_ohm:.4g} Ω (quartiles {resistance.lower_ohm:.4g} …"
        f" {resistance.upper_ohm:.4g}) in {resistance.steps} steps within about a second"
    )
    spread = abs(resistance.upper_ohm - resistance.lower_ohm)
    steady = spread <= 0.5 * abs(resistance.median_ohm)
    return Ability("ohmic resistance", "yes" if steady else "partly", text)


def _delays(log: Log, timing: Timing) -> Iterator[Ability]:
    topic = "delayed current terms"
    longest = DELAYS_S[-1]
    if timing.interval_median_s is None or timing.duration_s < 10.0 * longest:
        text = f"{timing.duration_s:.0f} s is too short for delays up to {longest:.0f} s"
        yield Ability(topic, "no", text)
        return
    if timing.interval_median_s > SLOW_S:
        text = f"rows every {timing.interval_median_s:.3g} s are too slow for delays of 10 s"
        yield Ability(topic, "no", text)
        return
    alike = _alikeness(log)
    if alike is None:
        yield Ability(topic, "no", "current does not vary")
        return
    text = f"currents {DELAYS_S[0]:.0f} s apart correlate by {alike:.2f}"
    if alike > ALIKE:
        yield Ability(topic, "partly", f"{text}: the terms are hard to tell apart")
    else:
        yield Ability(topic, "yes", text)


def _alikeness(log: Log) -> float | None:
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
        "unknown": "; what it was measured on is not known",
    }.get(log.temperature_source, f" ({log.temperature_source})")
    if span == 0.0:
        return Ability(topic, "no", f"temperature never changes{where}")
    if span < TEMPERATURE_SPAN_C:
        return Ability(topic, "no", f"temperature spans only {span:.1f} K{where}")
    state = charge_ah(log)
    alike = correlation(state, log.temperature_c)
    text = f"temperature spans {span:.1f} K, correlated with charge by {alike:+.2f}{where}"
    verdict: Verdict = "partly" if abs(alike) > ALIKE or where.startswith(";") else "yes"
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
    """Rests of some minutes anchor the rest voltage, and show an offset of the current sensor."""
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
