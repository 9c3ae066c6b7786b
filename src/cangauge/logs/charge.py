"""Charge against the log's own SoC: the capacity that both imply, and whether they agree at all.

Momentary currents count the charge between two rows only as well as the current is smooth. The
deviation of each current from the mean of its neighbours measures that, so that a capacity has a
standard deviation: sampling of the current, and resolution of the SoC.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from operator import itemgetter
from typing import Final, NamedTuple

import numpy as np

from cangauge._text import rounded
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.gaps import bridge_s, discharged_ah, split_where_moved
from cangauge.logs.log import Log
from cangauge.logs.quantities import QUANTITIES

MIN_SPAN_PCT: Final = 5.0
"""Least span of the reference SoC for a capacity [%]: below, its quantization dominates."""
CONTRADICTION: Final = 2.0
"""Ratio of two capacities from which charge and SoC contradict each other [-]."""
SURE: Final = 3.0
"""Standard deviations by which a contradiction exceeds the error by sampling [-]."""
COUNTER_SHARE: Final = 0.02
"""Difference of a counter from the charge of the current, by two sensors' gains [-]."""
JUMP_PCT: Final = 3.0
"""Least step of a SoC that its gauge corrected [%]: no dashboard shows coarser steps …"""
USUAL_STEPS: Final = 5.0
"""… and the number of its usual steps that a correction exceeds [-]."""


@dataclass(frozen=True, slots=True)
class ImpliedCapacity:
    """Charge per 100 % of reference SoC, with its standard deviation [Ah].

    Negative where the SoC rises as charge is taken out.
    """

    capacity_ah: float
    std_ah: float

    def contradicts(self, other_ah: float) -> bool:
        """Return whether another capacity [Ah] differs by a factor of two, beyond the error."""
        least_ah = self.capacity_ah - SURE * self.std_ah
        most_ah = self.capacity_ah + SURE * self.std_ah
        return least_ah > CONTRADICTION * other_ah or CONTRADICTION * most_ah < other_ah


class _Count(NamedTuple):
    """SoC [%] without jumps and discharged charge [Ah] at the rows with a SoC, shape (k,).

    `std_ah` is the error of the charge by sampling, `step_pct` the resolution of the SoC.
    """

    soc_pct: FloatArray
    out_ah: FloatArray
    std_ah: float
    step_pct: float

    @property
    def span_pct(self) -> float:
        return float(np.ptp(self.soc_pct))

    def part(self, first: int, end: int) -> _Count:
        """Return the rows from `first` to the one before `end`."""
        return self._replace(soc_pct=self.soc_pct[first:end], out_ah=self.out_ah[first:end])

    def halves(self) -> tuple[_Count, _Count]:
        """Return the parts before and after half of the movement of the SoC."""
        moved_pct = np.cumsum(np.abs(np.diff(self.soc_pct)))
        middle = 1 + int(np.searchsorted(moved_pct, 0.5 * moved_pct[-1]))
        return self.part(0, middle + 1), self.part(middle, self.soc_pct.size)


def implied_capacity(logs: Sequence[Log], least_pct: float = MIN_SPAN_PCT) -> ImpliedCapacity:
    """Return the capacity that charge and SoC imply, by regression pooled over the logs.

    Parameters
    ----------
    logs : sequence of Log
        Gaps over which the SoC moved, and jumps of it, are left out.
    least_pct : float
        Least span of a SoC that counts [%].

    Raises
    ------
    InputError
        If no log has a reference SoC with this span.
    """
    found = _implied([count for log in logs for count in _counts(log, least_pct)])
    if found is None:
        raise InputError(
            f"no log has a reference SoC that moves by {least_pct:g} % or more",
            field="soc_pct",
            cure="give the capacity in Ah with --capacity-ah",
        )
    return found


def contradiction(log: Log, capacity_ah: float | None = None) -> str | None:
    """Return a sentence if charge and SoC of a log contradict each other by a factor of two.

    Parameters
    ----------
    log : Log
    capacity_ah : float, optional
        Capacity of the pack [Ah]. Without it, the parts of the log are compared with each other.
    """
    counts = [*_counts(log, MIN_SPAN_PCT, at_ends=False)]
    whole = _implied(counts)
    if whole is None:
        return None
    problem = "charge and SoC contradict each other: {} Ah per 100 %"
    if capacity_ah is not None and whole.contradicts(capacity_ah):
        stated = f"the pack has {rounded(capacity_ah, 3)} Ah"
        return f"{problem.format(rounded(whole.capacity_ah, 3))}; {stated}"
    halves = [half for count in counts for half in count.halves() if half.span_pct >= MIN_SPAN_PCT]
    moved_pct = np.cumsum([half.span_pct for half in halves])
    middle = min(int(np.sum(moved_pct < 0.5 * moved_pct[-1:])) + 1, len(halves) - 1)
    first, second = _implied(halves[:middle]), _implied(halves[middle:])
    if first is None or second is None:
        return None
    if not (first.contradicts(second.capacity_ah) and second.contradicts(first.capacity_ah)):
        return None
    parts = f"in one part of the log, {rounded(second.capacity_ah, 3)} Ah in the next"
    return f"{problem.format(rounded(first.capacity_ah, 3))} {parts}"


def refuse_contradictions(logs: Sequence[Log], capacity_ah: float | None = None) -> None:
    """Raise InputError if charge and SoC of a log contradict each other by a factor of two."""
    for log in logs:
        found = contradiction(log, capacity_ah)
        if found is not None:
            cure = "check unit, scale and sign of the current, the SoC, and the capacity"
            raise InputError(found, source=log.source or log.name, field="current_a", cure=cure)


def with_own_count(log: Log, counters: Mapping[str, FloatArray]) -> Log:
    """Return a log with the charge that its own counter states, if one of its columns is one.

    A column, or the difference of two (discharged and charged), is the counter if it agrees with
    the charge that the current gives, within the error of momentary currents.

    Parameters
    ----------
    log : Log
    counters : mapping
        Columns in Ah by their headings, shape (n,).
    """
    out_ah = discharged_ah(log.time_s, log.current_a)
    counts = {label: count for label, count in counters.items() if np.isfinite(count).all()}
    for one, other in combinations([*counts], 2):
        counts[f"{one} − {other}"] = counts[one] - counts[other]
    found: list[tuple[float, str, FloatArray]] = []
    for label, count in counts.items():
        gained_ah = count - count[0]
        if np.sum(gained_ah * out_ah) < 0.0:
            gained_ah = -gained_ah
        if np.any(gained_ah):
            found.append((float(np.max(np.abs(gained_ah - out_ah))), label, gained_ah))
    if not found:
        return log
    apart_ah, label, counted_ah = min(found, key=itemgetter(0))
    moved_ah = float(np.ptp(out_ah))
    if apart_ah <= SURE * _sampling_std_ah(log) + COUNTER_SHARE * moved_ah:
        remark = f'charge for the capacity: counted by "{label}"'
        return replace(log, counted_ah=counted_ah, remarks=(*log.remarks, remark))
    remark = (
        f'no column in Ah counts this current: the nearest, "{label}", is up to'
        f" {rounded(apart_ah, 2)} Ah off, and the current moves {rounded(moved_ah, 3)} Ah"
    )
    return replace(log, remarks=(*log.remarks, remark))


def _implied(counts: Sequence[_Count]) -> ImpliedCapacity | None:
    """Return the capacity by regression pooled over counts; None if no SoC moves in them."""
    covariance = variance = 0.0
    for count in counts:
        away_pct = count.soc_pct - count.soc_pct.mean()
        covariance += float(np.sum(away_pct * (count.out_ah - count.out_ah.mean())))
        variance += float(np.sum(away_pct**2))
    if not variance:
        return None
    capacity_ah = -100.0 * covariance / variance
    charge_ah = sum(float(np.ptp(count.out_ah)) for count in counts)
    span_pct = sum(count.span_pct for count in counts)
    by_sampling_ah = math.sqrt(sum(count.std_ah**2 for count in counts))
    # Two roundings, of the first value and of the last.
    by_steps_pct = math.sqrt(sum(count.step_pct**2 for count in counts) / 6.0)
    share = math.hypot(by_sampling_ah / charge_ah if charge_ah else 0.0, by_steps_pct / span_pct)
    return ImpliedCapacity(capacity_ah, abs(capacity_ah) * share)


def _counts(log: Log, least_pct: float, *, at_ends: bool = True) -> Iterator[_Count]:
    """Yield the counts of a log over which the SoC moves by `least_pct` or more [%].

    Each is of a day at most, if the SoC moves so far in one: a battery at home makes a cycle in it.
    Over weeks an offset moves more charge than the pack holds. Without `at_ends` charge that moves
    while the SoC stands at 0 or 100 % is left out: a gauge that is off stands there.
    """
    for piece in split_where_moved(log):
        if piece.soc_pct is None:
            return
        rows = np.flatnonzero(np.isfinite(piece.soc_pct))
        rows = rows[:: 1 + rows.size // 1_000_000]  # more show no more, and take memory
        soc_pct, time_s = piece.soc_pct[rows], piece.time_s[rows]
        steps = np.abs(np.diff(soc_pct))
        if not np.any(steps > 0.0):
            continue
        step_pct = float(np.median(steps[steps > 0.0]))
        out_ah, std_ah = piece.counted_ah, 0.0
        if out_ah is None:
            out_ah = discharged_ah(piece.time_s, piece.current_a)
            std_ah = _sampling_std_ah(piece)
        out_ah = out_ah[rows]
        if not at_ends:
            is_end = (soc_pct[1:] <= 0.0) | (soc_pct[1:] >= 100.0)
            counted_ah = np.where(is_end & (steps == 0.0), 0.0, np.diff(out_ah))
            out_ah = np.concatenate([[0.0], np.cumsum(counted_ah)])
        whole = _Count(_without_jumps(soc_pct, step_pct), out_ah, std_ah, step_pct)
        day_s, _ = QUANTITIES["time"].units["d"]
        days = np.unique((time_s - piece.time_s[0]) // day_s, return_index=True)[1].tolist()
        parts = [whole.part(*ends) for ends in pairwise([*days, soc_pct.size])]
        moved = [part for part in parts if part.span_pct >= least_pct]
        if len(parts) > 1 and moved:
            share = math.sqrt(1.0 / len(parts))
            yield from (part._replace(std_ah=share * std_ah) for part in moved)
        elif whole.span_pct >= least_pct:
            yield whole


def _without_jumps(soc_pct: FloatArray, usual_pct: float) -> FloatArray:
    """Return a SoC [%] less the steps by which its gauge corrected it."""
    steps = np.diff(soc_pct)
    jumps = np.abs(steps) > max(JUMP_PCT, USUAL_STEPS * usual_pct)
    corrected = np.cumsum(np.where(jumps, steps, 0.0))
    return np.concatenate([soc_pct[:1], soc_pct[1:] - corrected])


def _sampling_std_ah(log: Log) -> float:
    """Return the standard deviation of a log's charge by the sampling of its current [Ah].

    A current that is independent from row to row deviates from the mean of its neighbours by
    sqrt(3/2) of its standard deviation; each row stands for half of the two steps beside it.
    """
    apart_as = log.current_a[:-2] + log.current_a[2:]  # in place: a log may have millions of rows
    apart_as *= -0.5
    apart_as += log.current_a[1:-1]
    step_s = np.diff(log.time_s)
    step_s[step_s > bridge_s(log.time_s)] = 0.0
    apart_as *= 0.5 * (step_s[:-1] + step_s[1:])
    return float(np.sqrt(np.sum(np.square(apart_as, out=apart_as)) / 1.5) / 3600.0)
