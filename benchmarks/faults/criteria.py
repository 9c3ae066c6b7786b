"""Pass criteria: observation of a run → verdict, and the table of verdicts.

A fault passes if all of these hold (`tests/nightly/faults` makes each fail):

- After recovery (the last part of the run) each valid SoC is within 1.5 of its own published
  standard deviations of the undisturbed run at the same bus time; and something is published.
- The service did not end by itself, ended with status 0 on SIGTERM, and printed no traceback.
- No estimate was valid for longer than its time-out after the last good current, voltage or
  temperature was sent.
- It was never silent for longer than `MAX_SILENCE_S` while it ran and the bus was up.
- Where the fault names a reason: it was published while it lasted, and no estimate was valid from
  `REPORTED_S` after its start to its end; the last estimate is valid again.

The undisturbed run must itself be valid where it is compared, or nothing is judged.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cangauge._typing import FloatArray
from cangauge.types import Reason, reason_name
from faults.fault import Fault

MAX_SOC_ERROR_STD: Final = 1.5
"""Largest error of a valid estimate after recovery, in its published standard deviations: a service
that lost its state knows less than the undisturbed one, and says so."""

MAX_SILENCE_S: Final = 3.0
STALE_SLACK_S: Final = 0.6
"""Tolerance of the time-outs: a publishing period, and delays of a busy machine [s]."""

TRANSPORT_S: Final = 0.5
"""Largest age of a published frame when it is received [s]."""

RECOVERED_SHARE: Final = 0.9
"""The SoC is judged after this fraction of the run."""

TIMEOUT_S: Final = {"current": 2.0, "voltage": 2.0, "temperature": 10.0}
"""Time-outs of the values: documented defaults of the service [s]."""

REPORTED_S: Final = 5.0
"""Longest time from the start of a fault to its reason [s]: the SoC of a drive changes by 0.1 %."""

INITIALISING, VALID, DEGRADED, INVALID = range(4)
STATUS: Final = ("initialising", "valid", "degraded", "invalid")


@dataclass(frozen=True, slots=True)
class Estimate:
    """One received SOC_ESTIMATE."""

    time_s: float
    """Monotonic [s]."""
    soc_pct: float
    """NaN: not available."""
    status: int
    reason: int
    soc_std_pct: float


@dataclass
class Observation:
    """Observation of one run; monotonic times [s].

    Parameters
    ----------
    published : list of Estimate
    sent_s, bus_s : list of float
        Times of sent frames, and their bus time.
    good_sent_s : dict of str to list of float
        Times of good frames, by role.
    fault_s : tuple of float
        Start and end of the fault.
    began_s, ended_s : float
        Times of the first and last frame.
    recovered_from_s : float
        From here on the service must have recovered.
    expected_silence_s : list of tuple
        Periods without expected frames (service starting, bus down).
    incidents : list of str
        Unexpected ends of the process, errors of the harness.
    stop_s : float
        Longest time from SIGTERM to the end [s].
    late_s : float
        Largest delay of the harness between two frames [s].
    """

    published: list[Estimate] = field(default_factory=list)
    sent_s: list[float] = field(default_factory=list)
    bus_s: list[float] = field(default_factory=list)
    good_sent_s: dict[str, list[float]] = field(default_factory=dict)
    fault_s: tuple[float, float] = (math.nan, math.nan)
    began_s: float = math.nan
    ended_s: float = math.nan
    recovered_from_s: float = math.nan
    expected_silence_s: list[tuple[float, float]] = field(default_factory=list)
    incidents: list[str] = field(default_factory=list)
    stop_s: float = math.nan
    late_s: float = 0.0


@dataclass(frozen=True)
class Verdict:
    """Figures of a run; SoC in %, times in s of real time."""

    soc_error_pct: float
    """Error of the valid estimate after recovery that exceeds 1.5 of its standard deviations most,
    or comes closest to it; NaN: none was valid."""
    std_pct: float
    """Standard deviation published with it."""
    worst_error_pct: float
    """Largest error of a valid estimate in the whole run."""
    last_status: str
    worst_status: str
    """From the start of the fault."""
    not_valid_s: float
    """Time without a valid estimate from the start of the fault."""
    stale_valid_s: float
    """Time for which an estimate stayed valid beyond a time-out."""
    silent_s: float
    stop_s: float
    failures: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether all criteria are met."""
        return not self.failures


class Reference:
    """The undisturbed run: SoC by bus time.

    Raises
    ------
    ValueError
        If it is not valid at the start of the fault or in its last part.
    """

    def __init__(self, observed: Observation) -> None:
        if observed.incidents:
            raise ValueError(f"the undisturbed run failed: {'; '.join(observed.incidents)}")
        valid = [each for each in observed.published if each.status == VALID]
        before = [each for each in observed.published if each.time_s <= observed.fault_s[0]][-1:]
        # The last ones may already be stale: no more frames are sent.
        ending = [
            each
            for each in observed.published
            if observed.recovered_from_s <= each.time_s <= observed.ended_s + TRANSPORT_S
        ]
        for name, there in (("start of the fault", before), ("end", ending)):
            bad = [each for each in there if each.status != VALID]
            if bad or not there:
                raise ValueError(f"the undisturbed run is not valid at the {name}: {bad[:1]}")
        self._bus_s = bus_time([each.time_s for each in valid], observed)
        self._soc_pct = np.array([each.soc_pct for each in valid])

    def between(self, first_s: float, last_s: float) -> tuple[float, float]:
        """Return the lowest and highest SoC between two bus times [s]."""
        ends = np.interp([first_s, last_s], self._bus_s, self._soc_pct)
        inside = self._soc_pct[(self._bus_s >= first_s) & (self._bus_s <= last_s)]
        both = np.append(inside, ends)
        return float(both.min()), float(both.max())


def bus_time(times_s: list[float], observed: Observation) -> FloatArray:
    """Return the bus time of the latest sent frame at monotonic times [s]."""
    found: FloatArray = np.interp(times_s, observed.sent_s, observed.bus_s)
    return found


def judge(
    observed: Observation,
    reference: Reference,
    *,
    reports: Reason = Reason.NONE,
    recovers: bool = False,
) -> Verdict:
    """Judge a run.

    Parameters
    ----------
    observed : Observation
    reference : Reference
    reports, recovers
        Of the fault.
    """
    errors = _errors(observed, reference)
    recovered = [
        (error, each.soc_std_pct)
        for each, error in zip(observed.published, errors, strict=True)
        if each.time_s >= observed.recovered_from_s and each.status == VALID
    ]
    # Without the estimates after the last frame.
    played = [each for each in observed.published if each.time_s <= observed.ended_s + TRANSPORT_S]
    after = [each for each in played if each.time_s >= observed.recovered_from_s]
    hit = [each for each in played if each.time_s >= observed.fault_s[0]]
    stale_s, stale = _stale(observed)
    silent_s = _silent(observed)
    error_pct, std_pct = max(
        recovered,
        key=lambda found: found[0] - MAX_SOC_ERROR_STD * found[1],
        default=(math.nan, math.nan),
    )
    failures = list(observed.incidents)
    if not after:
        failures.append("nothing published after the fault")
    if recovered and not error_pct <= MAX_SOC_ERROR_STD * std_pct:
        failures.append(f"SoC {error_pct:.1f} % off with σ {std_pct:.1f} %, valid after recovery")
    if stale_s > 0.0:
        failures.append(f"{stale} {stale_s:.1f} s beyond its time-out and valid")
    if reports:
        failures += _unreported(observed, reports)
    if recovers and not (after and after[-1].status == VALID):
        failures.append("not valid again")
    if silent_s > MAX_SILENCE_S:
        failures.append(f"silent for {silent_s:.1f} s")
    return Verdict(
        soc_error_pct=error_pct,
        std_pct=std_pct,
        worst_error_pct=max(
            (
                error
                for each, error in zip(observed.published, errors, strict=True)
                if each.status == VALID
            ),
            default=math.nan,
        ),
        last_status=STATUS[after[-1].status] if after else "none",
        worst_status=STATUS[max((_badness(each) for each in hit), default=(0, INITIALISING))[1]],
        not_valid_s=_not_valid(hit),
        stale_valid_s=stale_s,
        silent_s=silent_s,
        stop_s=observed.stop_s,
        failures=tuple(failures),
    )


def _badness(estimate: Estimate) -> tuple[int, int]:
    """Return a sort key: valid, degraded, initialising, invalid."""
    return (VALID, DEGRADED, INITIALISING, INVALID).index(estimate.status), estimate.status


def _errors(observed: Observation, reference: Reference) -> list[float]:
    """Return the error of each estimate against the undisturbed run, within the transport time."""
    times = [each.time_s for each in observed.published]
    first = bus_time([time_s - TRANSPORT_S for time_s in times], observed)
    last = bus_time(times, observed)
    errors = []
    for estimate, begin_s, end_s in zip(observed.published, first, last, strict=True):
        low, high = reference.between(float(begin_s), float(end_s))
        if math.isnan(estimate.soc_pct):
            # Valid without a number: the largest error.
            errors.append(100.0)
        else:
            errors.append(max(low - estimate.soc_pct, estimate.soc_pct - high, 0.0))
    return errors


def _stale(observed: Observation) -> tuple[float, str]:
    """Return the longest excess over a time-out [s] and its role."""
    worst, what = 0.0, ""
    for role, times in observed.good_sent_s.items():
        limit_s = TIMEOUT_S[role] + STALE_SLACK_S
        for estimate in observed.published:
            # A missing temperature leaves the estimate valid, with this reason.
            is_said = role == "temperature" and estimate.reason & Reason.TEMPERATURE_MISSING
            if estimate.status != VALID or is_said:
                continue
            place = bisect_right(times, estimate.time_s)
            age_s = estimate.time_s - (times[place - 1] if place else observed.began_s)
            if age_s - limit_s > worst:
                worst, what = age_s - limit_s, role
    return worst, what


def _unreported(observed: Observation, reason: Reason) -> list[str]:
    """Return what is missing of the report of a fault."""
    first_s, last_s = observed.fault_s
    during = [each for each in observed.published if first_s <= each.time_s <= last_s]
    failures = []
    if not any(each.reason & reason for each in during):
        failures.append(f"no {reason_name(reason)} reported")
    late = [each for each in during if each.time_s > first_s + REPORTED_S and each.status == VALID]
    if late:
        failures.append(f"valid {late[0].time_s - first_s:.0f} s into the fault")
    return failures


def _silent(observed: Observation) -> float:
    """Return the longest time without an expected frame [s]."""
    times = [each.time_s for each in observed.published if each.time_s <= observed.ended_s]
    times = [observed.began_s, *times, observed.ended_s]
    worst = 0.0
    for one, two in pairwise(times):
        # Expected silence does not count.
        expected_silence_s = sum(
            max(min(two, last) - max(one, first), 0.0)
            for first, last in _joined(observed.expected_silence_s)
        )
        worst = max(worst, two - one - expected_silence_s)
    return worst


def _joined(spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    out: list[tuple[float, float]] = []
    for first, last in sorted(spans):
        if out and first <= out[-1][1]:
            out[-1] = (out[-1][0], max(last, out[-1][1]))
        else:
            out.append((first, last))
    return out


def _not_valid(published: list[Estimate]) -> float:
    return sum(two.time_s - one.time_s for one, two in pairwise(published) if one.status != VALID)


_CAPTION: Final = (
    "SoC error: against the undisturbed run, of the valid estimate after recovery that exceeds 1.5"
    " of its published σ most, or comes closest to it (–: none was valid); worst: in the whole run."
    " Not valid: time from the start of the fault. Stale: time valid beyond a time-out. Times are"
    " real; with the replay clock a second is 24 s of the log."
)


@dataclass(frozen=True)
class Row:
    """A fault and its result.

    Parameters
    ----------
    name, description, profile : str
        Of the fault.
    bus : str
        "udp" or "vcan".
    verdict : Verdict, optional
        None if it was skipped, or is void.
    reason : str
        Why it has none.
    """

    name: str
    description: str
    profile: str
    bus: str
    verdict: Verdict | None
    reason: str = ""

    @classmethod
    def of(cls, fault: Fault, bus: str, verdict: Verdict | None, reason: str = "") -> Row:
        """Return the row of a fault."""
        return cls(fault.name, fault.description, fault.profile.name, bus, verdict, reason)

    def as_json(self) -> dict[str, Any]:
        """Return the row as JSON, NaN as null."""
        row: dict[str, Any] = asdict(self)
        if self.verdict is not None:
            found = {
                key: None if isinstance(value, float) and math.isnan(value) else value
                for key, value in row["verdict"].items()
            }
            row["verdict"] = {"passed": self.verdict.passed, **found}
        return row

    def result(self) -> str:
        """Return the result in words."""
        if self.verdict is None:
            return self.reason
        return "pass" if self.verdict.passed else f"FAIL: {'; '.join(self.verdict.failures)}"


def show(rows: list[Row], console: Console) -> None:
    """Print the table."""
    table = Table(title="Faults on a live bus", caption=_CAPTION)
    for name in ("fault", "description", "bus, time"):
        table.add_column(name, overflow="fold")
    numbers = (
        "SoC error %",
        "σ %",
        "worst %",
        "status: worst, last",
        "not valid s",
        "stale s",
        "silent s",
    )
    for name in numbers:
        table.add_column(name, justify="right")
    table.add_column("", overflow="fold")
    for row in rows:
        found = row.verdict
        head = (row.name, row.description, f"{row.bus}, {row.profile}")
        if found is None:
            table.add_row(*head, *[""] * 7, Text(row.result(), "yellow"))
            continue
        table.add_row(
            *head,
            _number(found.soc_error_pct, 2),
            _number(found.std_pct, 2),
            _number(found.worst_error_pct, 2),
            f"{found.worst_status}, {found.last_status}",
            _number(found.not_valid_s, 1),
            _number(found.stale_valid_s, 1),
            _number(found.silent_s, 1),
            Text(row.result(), "green" if found.passed else "red"),
        )
    console.print(table)


def _number(value: float, digits: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f}"
