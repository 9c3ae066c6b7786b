"""Coulomb counting over irregular samples, unobserved intervals, and the estimator's time.

Steps up to `gap_s` count by the trapezoidal rule. A change of the current between two samples may
have come at any time between them, the more so the longer they are apart: each step adds

    ½·((1 − exp(−Δt/HELD_S))·ΔI·Δt)²

to the variance of the charge. Longer steps up to `BRIDGE_S` count as well, but their charge is
uncertain by the whole recent current.

A longer step is an *unobserved interval*: the bus was asleep, or the service not running. No charge
is counted, and there are two hypotheses. *Parked*: self-discharge and
small consumers only, so the SoC has hardly changed. *Moved*: the car was charged or driven, by at
most the rate of a fast charger. The voltages after the interval test both (see `start`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from cangauge.logs.gaps import BRIDGE_S

USE_S: Final = 120.0
"""Time for which the current before an unobserved interval may have continued into it [s]: two
minutes of unrecorded driving."""

UNKNOWN_STD_PCT: Final = math.sqrt(2000.0)
"""Standard deviation of an unknown SoC [%]: wider than 0–100 % (uniform: 29 %), so that the voltage
decides."""

DRAIN_PCT_PER_HOUR: Final = 0.05
DRAIN_AT_MOST_PCT: Final = 5.0
"""Self-discharge and consumers of a parked car [% per hour; %]: 1.2 % a day. More than
the 5 % is left to the hypothesis that the car was used."""

FASTEST_PCT_PER_HOUR: Final = 150.0
"""Fastest unobserved change of SoC [% per hour]: a fast charger, from empty to full in 40 min."""

MEAN_SQUARE_MEMORY_S: Final = 300.0
"""Memory of the mean square current, from which a gap's uncertainty follows [s]: long against a
manoeuvre, short against a drive."""

HELD_S: Final = 5.0
"""Correlation time of the current of a drive [s]: pedal and traffic change it within seconds."""


def parked_std_pct(seconds: float, rms_pct_per_s: float) -> float:
    """Return the standard deviation of a parked car's change of SoC [%].

    Parameters
    ----------
    seconds : float
        Length of the interval [s].
    rms_pct_per_s : float
        Recent RMS current before it [% of capacity per s].
    """
    drain_pct = min(DRAIN_PCT_PER_HOUR * seconds / 3600.0, DRAIN_AT_MOST_PCT)
    use_pct = min(rms_pct_per_s * min(seconds, USE_S), UNKNOWN_STD_PCT)
    return math.sqrt(drain_pct * drain_pct + use_pct * use_pct)


def moved_std_pct(seconds: float) -> float:
    """Return the standard deviation of the SoC [%] if the car was charged or driven."""
    return min(FASTEST_PCT_PER_HOUR * seconds / 3600.0, UNKNOWN_STD_PCT)


OFFSET_STD_PER_AH: Final = 0.025
CAPACITY_STD: Final = 0.05
"""Standard deviations of the sensor's offset [A/Ah] and of the capacity [relative], for counting
alone: 1.5 A at 60 Ah, within the offsets of data sheets (`ekf.OFFSET_STD_A`), and some years of
ageing."""


def count_std_pct(start_var_pct2: float, seconds: float, moved_pct: float) -> float:
    """Return the standard deviation of the SoC by counting alone [%].

    Parameters
    ----------
    start_var_pct2 : float
        Variance of the SoC that counting started from, and of gaps [%²].
    seconds, moved_pct : float
        Time [s] and charge moved in either direction [%] since.
    """
    offset_pct = OFFSET_STD_PER_AH * seconds * 100.0 / 3600.0
    capacity_pct = CAPACITY_STD * moved_pct
    return math.sqrt(start_var_pct2 + offset_pct * offset_pct + capacity_pct * capacity_pct)


@dataclass
class CoulombCounter:
    """Charge since the first sample, in % of capacity.

    Parameters
    ----------
    capacity_ah : float
        Charge from 100 to 0 % [Ah].
    gap_s : float
        Longer steps between samples are gaps [s].
    """

    capacity_ah: float
    gap_s: float
    time_s: float = math.nan
    """Time of the last sample [s]; NaN before the first."""
    current_a: float = 0.0
    """Current of the last sample [A]."""
    mean_square_a2: float = 0.0
    """Running mean square of the current [A²]."""
    turned_a2: float = 0.0
    """Variance of the current between the last two samples [A²]."""
    discharged_pct: float = 0.0
    """Net charge taken out since the first sample [% of capacity]."""
    moved_pct: float = 0.0
    """Charge moved in either direction since the first sample [% of capacity]."""
    counted_s: float = 0.0
    """Time since the first sample in which charge was counted [s]."""
    gap_var_pct2: float = 0.0
    """Variance of the charge between samples since the first [%²]."""
    away_s: float = 0.0
    """Length of the unobserved interval before the last sample [s]; 0 without."""
    parked_std_pct: float = 0.0
    """Standard deviation of its charge if the car was parked [%]."""

    @property
    def pct_per_as(self) -> float:
        """Change of the SoC by a charge [% per As]."""
        return 100.0 / (3600.0 * self.capacity_ah)

    def step(self, time_s: float, current_a: float) -> float:
        """Count one sample, later than the last one; return the time since that [s].

        Parameters
        ----------
        time_s : float
        current_a : float
            Positive discharges [A].
        """
        last_s, last_a = self.time_s, self.current_a
        self.time_s, self.current_a = time_s, current_a
        self.away_s = self.parked_std_pct = 0.0
        if math.isnan(last_s):
            self.mean_square_a2 = current_a * current_a
            return 0.0
        seconds, pct_per_as = time_s - last_s, self.pct_per_as
        across_a = 0.5 * (current_a + last_a)
        kept = math.exp(-seconds / MEAN_SQUARE_MEMORY_S)
        # At the start of a drive the mean square lags: the currents at the ends of the gap bound it
        # from below.
        mean_square_a2 = self.mean_square_a2
        self.mean_square_a2 = kept * mean_square_a2 + (1.0 - kept) * (current_a * current_a)
        # Of a slow log the usual step may exceed a minute; as offline (`logs.gaps.bridge_s`).
        if seconds > max(BRIDGE_S, self.gap_s):
            rms_a = math.sqrt(max(mean_square_a2, last_a * last_a))
            self.away_s, self.parked_std_pct = seconds, parked_std_pct(seconds, rms_a * pct_per_as)
            return seconds
        self.counted_s += seconds
        out_pct = across_a * seconds * pct_per_as
        self.discharged_pct += out_pct
        self.moved_pct += abs(out_pct)
        self.turned_a2 = 0.5 * (-math.expm1(-seconds / HELD_S) * (current_a - last_a)) ** 2
        self.gap_var_pct2 += self.turned_a2 * (seconds * pct_per_as) ** 2
        if seconds > self.gap_s:
            across_a2 = 0.5 * (current_a * current_a + last_a * last_a)
            gap_pct = math.sqrt(max(mean_square_a2, across_a2)) * seconds * pct_per_as
            self.gap_var_pct2 += gap_pct * gap_pct
        return seconds

    def since(self, before: CoulombCounter) -> tuple[float, float, float]:
        """Return time [s], charge taken out [%] and its variance [%²] since a copy was made."""
        return (
            self.counted_s - before.counted_s,
            self.discharged_pct - before.discharged_pct,
            self.gap_var_pct2 - before.gap_var_pct2,
        )

    def uncounted_std_pct(self, seconds: float) -> float:
        """Return the standard deviation of the charge since the last sample [%]."""
        if math.isnan(self.time_s):
            return 0.0
        rms_a = math.sqrt(max(self.mean_square_a2, self.current_a * self.current_a))
        return min(rms_a * seconds * self.pct_per_as, UNKNOWN_STD_PCT)


LATEST_S: Final = 1e11
"""Largest stamp accepted [s] (the year 5138)."""

SHORTEST_STEP_S: Final = 1e-7
"""Samples closer than this have the same time [s]; stamps are whole microseconds."""

SET_BACK_S: Final = 1.0
"""A stamp this much before the last one may come from a clock that was set back [s]: more than the
jitter of any gateway."""

SET_BACK_SAMPLES: Final = 5
"""Number of consecutive, increasing stamps of that kind that prove it; time then continues from
the last sample. Fewer are late or damaged samples, and refused."""

EARLY_S: Final = 5.0
"""Tolerance of the stamps against the known length of an interruption [s]: the time of a
state is that of its writing, its last stamp that of the sample before."""

SHORTEST_INTERRUPTION_S: Final = 1e-3
LONGEST_INTERRUPTION_S: Final = 30.0 * 86400.0
"""Bounds of an interruption's length [s]; a longer step may be a faulty clock."""

UNKNOWN_INTERRUPTION_S: Final = 86400.0
"""Assumed length of an interruption that no clock measured [s]: a day, in which any charge may have
flowed (`FASTEST_PCT_PER_HOUR`)."""


@dataclass
class EstimatorClock:
    """Maps the samples' stamps to a time that always increases."""

    last_s: float = math.nan
    """Time of the last accepted sample [s]; NaN before the first."""
    shift_s: float = 0.0
    """Time minus stamp [s]."""
    behind: int = 0
    """Consecutive samples stamped before the last accepted one."""
    behind_s: float = math.nan
    """Stamp of the latest of these [s]."""
    age_s: float | None = None
    """Of a restored state, until the first sample: its minimum age [s], which overrides stamps that
    show less; NaN if no clock measured it, None without an interruption."""

    def time_of(self, stamp_s: float) -> float | None:
        """Return a stamp's time [s], later than the last; None to refuse the sample."""
        if not abs(stamp_s) <= LATEST_S:  # NaN too
            return None
        age_s, self.age_s = self.age_s, None
        if math.isnan(self.last_s):
            self.last_s = stamp_s
            return stamp_s
        shift_s = self.shift_s
        step_s = stamp_s + shift_s - self.last_s
        if age_s is not None and math.isnan(age_s):
            age_s = UNKNOWN_INTERRUPTION_S
        if age_s is not None and not step_s >= max(age_s - EARLY_S, SHORTEST_STEP_S):
            # The stamps restarted, or their clock was set back or stopped.
            shift_s += max(age_s, SHORTEST_INTERRUPTION_S) - step_s
        elif step_s < SHORTEST_STEP_S:
            if not self._is_set_back(stamp_s, step_s):
                return None
            shift_s += stamp_s - self.behind_s - step_s
        elif step_s > LONGEST_INTERRUPTION_S:
            shift_s += LONGEST_INTERRUPTION_S - step_s
        time_s = stamp_s + shift_s
        if time_s - self.last_s < SHORTEST_STEP_S:
            return None
        self.shift_s = shift_s
        self.behind, self.behind_s = 0, math.nan
        self.last_s = time_s
        return time_s

    def _is_set_back(self, stamp_s: float, step_s: float) -> bool:
        if step_s > -SET_BACK_S:
            return False
        if stamp_s - self.behind_s < SHORTEST_STEP_S:
            self.behind = 0
        if self.behind + 1 >= SET_BACK_SAMPLES:
            return True
        self.behind += 1
        self.behind_s = stamp_s
        return False
