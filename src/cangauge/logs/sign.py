"""The sign of current of a log: positive discharges.

The first of these sources that is available determines it:

1. the user (`--sign`, or the factor of the column), or the format;
2. a column of words that says when the pack charges, if the current is never negative
   (`table.direct_by_state`);
3. the data (`sign_of_current`). `agreement` inverts the current if neither user nor format states
   its sign. If they do and the data contradict them, it remarks on it.

Three kinds of evidence are in the data:

- **steps**: when current rises by a step, the voltage of a discharging battery falls (ohmic drop).
  Every clear step is a vote; a sign test gives the probability of the votes by chance.
- **charge**: over hours, voltage follows the remaining charge.
- **SoC**: a reference SoC falls as charge is taken out.

The confidence follows from the sum of the three weights, one unit per decade of odds. It ranks
findings and is not a measured frequency; weights are capped, so that no kind overrules another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal, Self

import numpy as np
from scipy import special

from cangauge._typing import FloatArray, IntArray
from cangauge.errors import InputError
from cangauge.logs.gaps import discharged_ah
from cangauge.logs.log import Log
from cangauge.logs.quantities import LIMITS

Sign = Literal["charge", "discharge"]
"""What a positive current in the file does."""
SignSource = Literal["format", "user", "data"]
"""Source of the sign of a log's current."""

STEP_SPACING_S: Final = 1.0
"""Time between the rows whose difference is a step [s]."""
_STEP_SHARE: Final = 0.05
"""Smallest step, relative to the range of current [-]."""
_MAX_STEPS: Final = 400
_VOTES_PER_FREE_ONE: Final = 3.0
"""Votes that count as one independent vote; no wrong sign in random windows of real logs."""
_CLEAR_SHARE: Final = 0.75
"""Least share of agreeing votes for steps to count [-]."""
_SURE_WEIGHT: Final = 2.0
"""Least weight for a sign (confidence 0.99); below it the sign stays open."""


@dataclass(frozen=True, slots=True)
class SignEvidence:
    """One kind of evidence: decades of odds (positive: discharges), and the figures as a phrase."""

    kind: Literal["steps", "charge", "soc"]
    weight: float
    text: str


@dataclass(frozen=True, slots=True)
class SignFinding:
    """The sign convention of a log's current.

    Parameters
    ----------
    sign : {+1, -1, 0}
        +1: positive current discharges (as it should); -1: it charges; 0: undetermined.
    confidence : float
        0.5 (no evidence) to 0.9999 [-]; see the module's docstring.
    evidence : tuple of SignEvidence
    """

    sign: Literal[1, -1, 0]
    confidence: float
    evidence: tuple[SignEvidence, ...]

    @classmethod
    def of(cls, evidence: Sequence[SignEvidence]) -> Self:
        """Return the sign that evidence shows: open if it is weak, or part of it opposes."""
        weight = sum(each.weight for each in evidence)
        is_opposed = any(
            item.weight * weight < 0.0 and abs(item.weight) >= 1.0 for item in evidence
        )
        sign: Literal[1, -1, 0] = 1 if weight > 0.0 else -1
        if abs(weight) < _SURE_WEIGHT or is_opposed:
            sign = 0
        odds = 10.0 ** abs(weight)
        return cls(sign, min(float(odds / (1.0 + odds)), 0.9999), tuple(evidence))

    @property
    def strongest(self) -> SignEvidence:
        """The strongest evidence for the finding."""
        return max(self.evidence, key=lambda item: item.weight * (self.sign or 1))

    @property
    def sentence(self) -> str:
        """The finding and its evidence in one line."""
        finding = {
            1: "positive current discharges",
            -1: "positive current CHARGES: the sign is inverted",
            0: "the sign of current cannot be determined from this log",
        }[self.sign]
        evidence = "; ".join(item.text for item in self.evidence)
        return f"{finding} (confidence {self.confidence:.4g}): {evidence}"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {**asdict(self), "sentence": self.sentence}


def sign_of_current(log: Log) -> SignFinding:
    """Determine from the data whether positive current discharges; either sign is accepted."""
    taken_ah = discharged_ah(log.time_s, log.current_a)
    return SignFinding.of((_steps(log), _charge(log, taken_ah), _soc(log, taken_ah)))


def require_discharge_positive(log: Log, *, is_capture: bool = False) -> None:
    """Raise InputError if the data show clearly that positive current charges."""
    finding = sign_of_current(log)
    if finding.sign < 0:
        cure = "multiply the column by -1: positive current discharges (or give --sign charge)"
        if is_capture:  # recorded frames are never changed: the map inverts the sign
            cure = "use the preset of this car, or set sign = -1 under [current] of the map file"
        elif finding.strongest.kind == "soc":
            cure += "; or, if the current is right, correct soc_pct or leave it out"
        problem, where = f"the sign of current is inverted: {finding.strongest.text}", log.source
        raise InputError(problem, source=where or log.name, field="current_a", cure=cure)


def current_steps(log: Log) -> tuple[FloatArray, FloatArray]:
    """Return the clear steps, at most 400 of the largest: changes of current [A], voltage [V]."""
    rows = spaced_rows(log.time_s, STEP_SPACING_S)
    change_a = np.diff(log.current_a[rows])
    is_near = np.diff(log.time_s[rows]) <= LIMITS["interval_s"]
    is_clear = np.abs(change_a) >= _STEP_SHARE * np.ptp(log.current_a)
    steps = np.flatnonzero(is_near & is_clear & (change_a != 0.0))
    if steps.size > _MAX_STEPS:
        steps = steps[np.argpartition(-np.abs(change_a[steps]), _MAX_STEPS)[:_MAX_STEPS]]
    return change_a[steps], np.diff(log.voltage_v[rows])[steps]


def _steps(log: Log) -> SignEvidence:
    current_a, voltage_v = current_steps(log)
    votes = -np.sign(current_a * voltage_v)
    fell, rose = int((votes > 0).sum()), int((votes < 0).sum())
    if not fell + rose:
        return SignEvidence("steps", 0.0, "no clear step of current")
    way, larger, sign = ("against", fell, 1.0) if fell >= rose else ("with", rose, -1.0)
    share = larger / (fell + rose)
    # Successive steps share slow voltage changes: they are fewer independent votes.
    free = max(1, round((fell + rose) / _VOTES_PER_FREE_ONE))
    chance = 2.0 * float(special.bdtrc(round(share * free) - 1, free, 0.5))
    weight = min(6.0, -float(np.log10(chance))) if share >= _CLEAR_SHARE and chance < 1.0 else 0.0
    text = f"voltage moved {way} current in {larger} of {fell + rose} steps"
    return SignEvidence("steps", sign * weight, text)


def _charge(log: Log, taken_ah: FloatArray) -> SignEvidence:
    rows = spaced_rows(log.time_s, log.duration_s / 200.0)
    voltage, taken = log.voltage_v[rows], taken_ah[rows]
    span_v = float(np.ptp(voltage))
    if rows.size < 20 or np.ptp(taken) <= 0.0 or span_v <= 0.0:
        return SignEvidence("charge", 0.0, "no voltage trend over charge")
    rank = correlation(_ranks(taken), _ranks(voltage))
    weight = 3.0 if abs(rank) >= 0.9 else 1.5 if abs(rank) >= 0.7 else 0.0
    if span_v < 0.05 * float(np.median(voltage)):
        weight = 0.0
    text = f"voltage against charge taken out: rank correlation {rank:+.2f}"
    return SignEvidence("charge", -float(np.sign(rank)) * weight, text)


def _soc(log: Log, taken_ah: FloatArray) -> SignEvidence:
    if log.soc_pct is None:
        return SignEvidence("soc", 0.0, "no reference SoC")
    known = np.flatnonzero(np.isfinite(log.soc_pct))
    span_pct = float(np.ptp(log.soc_pct[known])) if known.size > 10 else 0.0
    if span_pct < 1.0 or np.ptp(taken_ah[known]) <= 0.0:
        return SignEvidence("soc", 0.0, f"reference SoC moves by only {span_pct:.1f} %")
    rows = known[:: 1 + known.size // 100_000]  # more rows show no more, and take memory
    alike = correlation(taken_ah[rows], log.soc_pct[rows])
    weight = 4.0 if abs(alike) >= 0.95 else 1.0 if abs(alike) >= 0.8 else 0.0
    way = "rises" if alike > 0.0 else "falls"
    text = f"reference SoC {way} as charge is taken out, correlation {alike:.2f}"
    return SignEvidence("soc", -float(np.sign(alike)) * weight, text)


def correlation(a: FloatArray, b: FloatArray) -> float:
    """Return the correlation of two arrays of shape (n,), 0 where one of them hardly moves."""
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt(np.sum(a * a)) * np.sqrt(np.sum(b * b)))
    tiny = np.finfo(np.float64).tiny
    return float(np.clip(np.sum(a * b) / size, -1.0, 1.0)) if size > tiny else 0.0


def _ranks(values: FloatArray) -> FloatArray:
    """Return ranks from 0; equal values share their mean rank."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(count) - (count + 1) / 2.0)[place], dtype=np.float64)


def spaced_rows(time_s: FloatArray, spacing_s: float) -> IntArray:
    """Return the first row of every slot of `spacing_s` that holds any."""
    if spacing_s <= 0.0:
        return np.zeros(1, dtype=np.intp)
    slot = np.floor((time_s - time_s[0]) / spacing_s)
    return np.concatenate(([0], np.flatnonzero(np.diff(slot) > 0.0) + 1)).astype(np.intp)
