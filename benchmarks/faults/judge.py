"""What was seen of one fault → passed or not, and why. Pure; `tests/faults` makes it fail.

Passed is a fault when all of these hold:

- After recovery (in the last part of the run) the published SoC is within 1 % of the undisturbed
  run's at the same bus time, or not called valid. Something must be published there.
- The service did not end by itself, ended with status 0 when told to, and showed no traceback.
- No estimate was called valid for longer than its time-out after the last good current, voltage
  or temperature had been sent.
- It was never silent for longer than `SILENT_S` while it ran and the bus was up.

The undisturbed run must itself be valid where it is compared with, or nothing is judged.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np

from cangauge._typing import FloatArray

WITHIN_PCT: Final = 1.0
SILENT_S: Final = 3.0
STALE_SLACK_S: Final = 0.6
"""Besides the time-out: a publishing period, and what a busy machine takes [s]."""
TRANSPORT_S: Final = 0.5
"""A published frame may be so much older than when it was seen [s]."""
RECOVERED_SHARE: Final = 0.9
"""The SoC is judged in what follows this share of the run."""

TIMEOUT_S: Final = {"current": 2.0, "voltage": 2.0, "temperature": 10.0}
"""For so long may a value be used: the service's documented defaults [s]."""

INITIALISING, VALID, DEGRADED, INVALID = range(4)
STATUS: Final = ("initialising", "valid", "degraded", "invalid")


@dataclass(frozen=True, slots=True)
class Told:
    """One SOC_ESTIMATE as it was seen."""

    time_s: float
    """Monotonic [s]."""
    soc_pct: float
    """NaN: not available."""
    status: int
    reason: int
    soc_std_pct: float = math.nan


@dataclass
class Seen:
    """All that was seen of one run; monotonic times [s].

    Parameters
    ----------
    told : list of Told
    sent_s, bus_s : list of float
        When frames were sent, and in which bus time.
    good_s : dict of str to list of float
        By role: when frames were sent that an estimate may rest on.
    fault_s : tuple of float
        The fault acted from … to.
    began_s, ended_s : float
        First and last frame.
    judged_from_s : float
        After this it must have recovered.
    excused : list of tuple
        From … to: no frames were to be expected (service starting, bus down).
    troubles : list of str
        Ends of the process and the like.
    stop_s : float
        Longest time from SIGTERM to the end [s].
    late_s : float
        By so much at most were two frames further apart than meant: the harness was held up [s].
    """

    told: list[Told] = field(default_factory=list)
    sent_s: list[float] = field(default_factory=list)
    bus_s: list[float] = field(default_factory=list)
    good_s: dict[str, list[float]] = field(default_factory=dict)
    fault_s: tuple[float, float] = (math.nan, math.nan)
    began_s: float = math.nan
    ended_s: float = math.nan
    judged_from_s: float = math.nan
    excused: list[tuple[float, float]] = field(default_factory=list)
    troubles: list[str] = field(default_factory=list)
    stop_s: float = math.nan
    late_s: float = 0.0


@dataclass(frozen=True)
class Verdict:
    """A row of the table; SoC in %, times in s of the clock on the wall."""

    soc_error_pct: float
    """Largest error called valid after recovery; NaN: nothing was called valid."""
    std_pct: float
    """The standard deviation that was published with it."""
    worst_error_pct: float
    """The largest error called valid in the whole run."""
    last_status: str
    worst_status: str
    """From the fault's begin on."""
    not_valid_s: float
    """How long it was not valid from the fault's begin on."""
    stale_valid_s: float
    """How much longer than its time-out a stale estimate was called valid."""
    silent_s: float
    stop_s: float
    failures: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether nothing failed."""
        return not self.failures


class Reference:
    """The undisturbed run: SoC by bus time.

    Raises
    ------
    ValueError
        If it is no reference: it was not valid when the fault begins and in the last part.
    """

    def __init__(self, seen: Seen) -> None:
        if seen.troubles:
            raise ValueError(f"the undisturbed run failed: {'; '.join(seen.troubles)}")
        valid = [each for each in seen.told if each.status == VALID]
        before = [each for each in seen.told if each.time_s <= seen.fault_s[0]][-1:]
        # The very last ones may already be told of as stale: nothing more is sent.
        ending = [
            each
            for each in seen.told
            if seen.judged_from_s <= each.time_s <= seen.ended_s + TRANSPORT_S
        ]
        for name, there in (("fault's begin", before), ("end", ending)):
            bad = [each for each in there if each.status != VALID]
            if bad or not there:
                raise ValueError(f"the undisturbed run is not valid at the {name}: {bad[:1]}")
        self._bus_s = bus_time([each.time_s for each in valid], seen)
        self._soc_pct = np.array([each.soc_pct for each in valid])

    def between(self, first_s: float, last_s: float) -> tuple[float, float]:
        """Return lowest and highest SoC between two bus times [s]."""
        ends = np.interp([first_s, last_s], self._bus_s, self._soc_pct)
        inside = self._soc_pct[(self._bus_s >= first_s) & (self._bus_s <= last_s)]
        both = np.append(inside, ends)
        return float(both.min()), float(both.max())


def bus_time(times_s: list[float], seen: Seen) -> FloatArray:
    """Return the bus time at monotonic times [s]: that of the latest frame sent."""
    found: FloatArray = np.interp(times_s, seen.sent_s, seen.bus_s)
    return found


def judge(seen: Seen, reference: Reference) -> Verdict:
    """Judge a run."""
    errors = _errors(seen, reference)
    recovered = [
        (error, each.soc_std_pct)
        for each, error in zip(seen.told, errors, strict=True)
        if each.time_s >= seen.judged_from_s and each.status == VALID
    ]
    # What is told when nothing more was sent says nothing of the fault.
    played = [each for each in seen.told if each.time_s <= seen.ended_s + TRANSPORT_S]
    after = [each for each in played if each.time_s >= seen.judged_from_s]
    hit = [each for each in played if each.time_s >= seen.fault_s[0]]
    stale_s, stale = _stale(seen)
    silent_s = _silent(seen)
    error_pct, std_pct = max(recovered, default=(math.nan, math.nan))
    failures = list(seen.troubles)
    if not after:
        failures.append("nothing published after the fault")
    if recovered and not error_pct <= WITHIN_PCT:
        failures.append(f"SoC {error_pct:.1f} % off and valid after recovery")
    if stale_s > 0.0:
        failures.append(f"{stale} {stale_s:.1f} s beyond its time-out and valid")
    if silent_s > SILENT_S:
        failures.append(f"silent for {silent_s:.1f} s")
    return Verdict(
        soc_error_pct=error_pct,
        std_pct=std_pct,
        worst_error_pct=max(
            (error for each, error in zip(seen.told, errors, strict=True) if each.status == VALID),
            default=math.nan,
        ),
        last_status=STATUS[after[-1].status] if after else "none",
        worst_status=STATUS[max((_badness(each) for each in hit), default=(0, INITIALISING))[1]],
        not_valid_s=_not_valid(hit),
        stale_valid_s=stale_s,
        silent_s=silent_s,
        stop_s=seen.stop_s,
        failures=tuple(failures),
    )


def _badness(told: Told) -> tuple[int, int]:
    """Order of statuses: valid, degraded, initialising, invalid."""
    return (VALID, DEGRADED, INITIALISING, INVALID).index(told.status), told.status


def _errors(seen: Seen, reference: Reference) -> list[float]:
    """Return how far each estimate lies from the undisturbed run, transport allowed for."""
    times = [each.time_s for each in seen.told]
    first = bus_time([time_s - TRANSPORT_S for time_s in times], seen)
    last = bus_time(times, seen)
    errors = []
    for told, begin_s, end_s in zip(seen.told, first, last, strict=True):
        low, high = reference.between(float(begin_s), float(end_s))
        if math.isnan(told.soc_pct):
            # Valid, but without a number: as wrong as can be.
            errors.append(100.0)
        else:
            errors.append(max(low - told.soc_pct, told.soc_pct - high, 0.0))
    return errors


def _stale(seen: Seen) -> tuple[float, str]:
    """Return by how much the time-out was overrun at worst [s], and by what."""
    worst, what = 0.0, ""
    for role, times in seen.good_s.items():
        limit_s = TIMEOUT_S[role] + STALE_SLACK_S
        for told in seen.told:
            if told.status != VALID:
                continue
            place = bisect_right(times, told.time_s)
            age_s = told.time_s - (times[place - 1] if place else seen.began_s)
            if age_s - limit_s > worst:
                worst, what = age_s - limit_s, role
    return worst, what


def _silent(seen: Seen) -> float:
    """Return the longest time without a frame, where one was to be expected [s]."""
    times = [each.time_s for each in seen.told if each.time_s <= seen.ended_s]
    times = [seen.began_s, *times, seen.ended_s]
    worst = 0.0
    for one, two in pairwise(times):
        # Of the whole silence what was excused does not count.
        excused = sum(
            max(min(two, last) - max(one, first), 0.0) for first, last in _joined(seen.excused)
        )
        worst = max(worst, two - one - excused)
    return worst


def _joined(spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    out: list[tuple[float, float]] = []
    for first, last in sorted(spans):
        if out and first <= out[-1][1]:
            out[-1] = (out[-1][0], max(last, out[-1][1]))
        else:
            out.append((first, last))
    return out


def _not_valid(told: list[Told]) -> float:
    return sum(two.time_s - one.time_s for one, two in pairwise(told) if one.status != VALID)
