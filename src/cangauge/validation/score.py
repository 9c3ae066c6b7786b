"""95 % intervals: Wilson's for shares, bootstrap percentiles for what is no share.

A true fault in the terms of the diagnosis: which parameter, which value.

Only faults whose size is a quantity that a diagnosis can state. The twin and the library of
effects name and sign them each in their own way.

One label beside one answer.

All outcomes → the figures of the check, each with its 95 % interval.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.validation.cases import EFFECTS, is_outside
from cangauge.validation.twin.faults import fault_kinds
from cangauge.validation.workers import Task

# --- 95 % intervals: Wilson's for shares, bootstrap percentiles for what is no share

_Z: Final = 1.959963984540054
_DRAWS: Final = 2000


@dataclass(frozen=True)
class Share:
    """How many of how many."""

    hits: int
    of: int

    @property
    def value(self) -> float | None:
        """Share, or None of nothing."""
        return self.hits / self.of if self.of else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """Wilson's 95 % interval (Wilson 1927)."""
        if not self.of:
            return None
        share, n = self.hits / self.of, self.of
        middle = (share + _Z**2 / (2.0 * n)) / (1.0 + _Z**2 / n)
        half = math.sqrt(share * (1.0 - share) / n + _Z**2 / (4.0 * n**2)) * _Z / (1.0 + _Z**2 / n)
        return max(0.0, middle - half), min(1.0, middle + half)

    def to_dict(self) -> dict[str, Any]:
        """Return value, interval and counts."""
        interval = self.interval
        return {
            "value": self.value,
            "ci": None if interval is None else list(interval),
            "hits": self.hits,
            "of": self.of,
        }


def share(flags: Sequence[bool]) -> Share:
    """Return how many flags are set."""
    return Share(sum(flags), len(flags))


def estimate(values: Sequence[float], statistic: Callable[[FloatArray], float]) -> dict[str, Any]:
    """Return a statistic with its bootstrap interval; the draws are always the same.

    Parameters
    ----------
    values : sequence of float
    statistic : callable
        Array → number, such as the median.
    """
    data = np.asarray(values, dtype=np.float64)
    if data.size == 0:
        return {"value": None, "ci": None, "of": 0}
    rng = np.random.default_rng(0)
    draws = [statistic(data[rng.integers(data.size, size=data.size)]) for _ in range(_DRAWS)]
    low, high = np.quantile(draws, (0.025, 0.975)).tolist()
    return {"value": float(statistic(data)), "ci": [low, high], "of": int(data.size)}


# --- A true fault in the terms of the diagnosis: which parameter, which value

_Values = Callable[[float, Mapping[str, float]], dict[str, float]]

_EXPECTED: Final[Mapping[str, _Values]] = {
    "current_offset": lambda size, _shape: {"offset_a": size},
    "current_gain": lambda size, _shape: {"gain_pct": 100.0 * size},
    "voltage_offset": lambda size, _shape: {"offset_v": size},
    "voltage_gain": lambda size, _shape: {"gain_pct": 100.0 * size},
    "time_skew": lambda size, _shape: {"skew_s": size},
    "capacity": lambda size, _shape: {"change_pct": -100.0 * size},
    "initial_soc": lambda size, _shape: {"offset_pct": size},
    "coulombic_efficiency": lambda size, _shape: {"efficiency": 1.0 - size},
    "resistance_asymmetry": lambda size, _shape: {"charging_ohm": size},
    "resistance_step": lambda size, shape: {"step_ohm": size, "start_s": shape["at_s"]},
}

COMPARABLE: Final = tuple(_EXPECTED)


def expected_parameters(fault: Mapping[str, Any]) -> dict[str, float]:
    """Return the parameters that a perfect diagnosis of a fault would state.

    Parameters
    ----------
    fault : mapping
        As in a label: `id`, `size`, `shape`.

    Returns
    -------
    dict of str to float
        Parameter of the effect → value in its unit; empty where the size cannot be compared.
    """
    rule = _EXPECTED.get(fault["id"])
    return {} if rule is None else rule(float(fault["size"]), fault["shape"])


# --- One label beside one answer

NONE, UNKNOWN, CRASHED = "none", "unknown", "crashed"
FAMILY: Final = {kind.id: kind.family for kind in fault_kinds()}

LEAST_GAP: Final = 0.45
"""A gap below this many floors is out of the check's range: physics allowed no larger one."""

ROUNDING: Final = 1e-9
"""Part of a true value by which the twin's and the library's units may round it apart."""


@dataclass(frozen=True)
class Covered:
    """Whether an interval holds the true value of a parameter."""

    effect: str
    parameter: str
    true: float
    value: float
    low: float
    high: float

    @property
    def holds(self) -> bool:
        """Whether it does, but for rounding: the truth may be at a bound, where intervals end."""
        rounding = ROUNDING * abs(self.true)
        return self.low - rounding <= self.true <= self.high + rounding


@dataclass(frozen=True)
class Outcome:
    """What a diagnosis said of a case whose cause is known.

    Parameters
    ----------
    task, case, protocol : str
    truth : tuple of str
        Effects that are there; empty for a healthy pack.
    leave_out : tuple of str
        Effects that the library was without.
    gap_in_floors : float, optional
        RMS gap that the faults open, over what the model misses on clean days.
    verdict : str
        An effect, `none`, `unknown`, or `crashed`.
    probability : float
        Of the verdict being right; 0 of a crash.
    ambiguous_with, accepted, ranked : tuple of str
    closed : dict of str to float
        Closed part of the squared gap, by the floor it is counted to.
    covered : tuple of Covered
    seconds, peak_mib : float, optional
    error : str
        Why there is no verdict.
    """

    task: str
    case: str
    protocol: str
    truth: tuple[str, ...]
    leave_out: tuple[str, ...]
    gap_in_floors: float | None
    verdict: str
    probability: float
    ambiguous_with: tuple[str, ...] = ()
    accepted: tuple[str, ...] = ()
    ranked: tuple[str, ...] = ()
    closed: Mapping[str, float] | None = None
    covered: tuple[Covered, ...] = ()
    seconds: float | None = None
    peak_mib: float | None = None
    error: str = ""

    @property
    def right(self) -> str:
        """The verdict that is right of a case with one cause or none."""
        if not self.truth:
            return NONE
        if is_outside(self.truth) or set(self.truth) & set(self.leave_out):
            return UNKNOWN
        return self.truth[0]

    @property
    def is_decoy(self) -> bool:
        """Whether an effect was left out of the library that is not the cause."""
        return bool(self.leave_out) and not set(self.truth) & set(self.leave_out)

    @property
    def strict(self) -> bool:
        """Whether the verdict is right (of several causes: one of them)."""
        if len(self.truth) > 1 and not self.leave_out:
            return self.verdict in self.truth
        return self.verdict == self.right

    @property
    def within_pair(self) -> bool:
        """Whether the truth is the verdict or the one effect that it could not be told from."""
        return self.strict or (
            self.names_effect
            and len(self.ambiguous_with) == 1
            and self.right in self.ambiguous_with
        )

    @property
    def names_effect(self) -> bool:
        """Whether the verdict is an effect."""
        return self.verdict in FAMILY

    @property
    def within_two(self) -> bool:
        """Whether an effect is named and the truth is among the first two."""
        return self.names_effect and self.right in self.ranked[:2]

    @property
    def family(self) -> bool:
        """Whether the family is right."""
        return self.names_effect and FAMILY[self.verdict] == FAMILY.get(self.right)

    @property
    def in_range(self) -> bool:
        """Whether the gap is one of the check's sizes."""
        return self.gap_in_floors is None or self.gap_in_floors >= LEAST_GAP

    def to_dict(self) -> dict[str, Any]:
        """Return everything, for `--json`."""
        return {
            "task": self.task,
            "case": self.case,
            "protocol": self.protocol,
            "truth": list(self.truth),
            "leave_out": list(self.leave_out),
            "gap_in_floors": self.gap_in_floors,
            "verdict": self.verdict,
            "right": self.strict,
            "probability": self.probability,
            "ambiguous_with": list(self.ambiguous_with),
            "accepted": list(self.accepted),
            "ranked": list(self.ranked[:5]),
            "closed": None if self.closed is None else dict(self.closed),
            "parameters": [{**vars(item), "holds": item.holds} for item in self.covered],
            "seconds": self.seconds,
            "peak_mib": self.peak_mib,
            "error": self.error,
        }


def outcome_of(task: Task, label: Mapping[str, Any], answer: Mapping[str, Any]) -> Outcome:
    """Return what an answer is worth.

    Parameters
    ----------
    task : Task
    label : mapping
        From the sealed file.
    answer : mapping
        From the diagnosing process.
    """
    about: dict[str, Any] = {
        "task": task.id,
        "case": task.case,
        "protocol": task.protocol,
        "truth": tuple(label["effects"]),
        "leave_out": task.leave_out,
        "gap_in_floors": _gap_in_floors(label),
        "seconds": answer.get("seconds"),
        "peak_mib": answer.get("peak_mib"),
    }
    if "error" in answer:
        return Outcome(**about, verdict=CRASHED, probability=0.0, error=str(answer["error"]))
    cause, gap = answer["result"]["cause"], answer["result"]["gap"]
    verdict = str(cause["verdict"])
    ranked = [item["effect"] for item in cause["candidates"]]
    if verdict in ranked:
        ranked = [verdict, *(effect for effect in ranked if effect != verdict)]
    return Outcome(
        **about,
        verdict=verdict,
        probability=float(cause["probability"]),
        ambiguous_with=tuple(cause["ambiguous_with"]),
        accepted=tuple(item["effect"] for item in cause["accepted"]),
        ranked=tuple(ranked),
        closed=_closed(gap, label, verdict),
        covered=_covered(cause, label),
    )


def _gap_in_floors(label: Mapping[str, Any]) -> float | None:
    if not label["effects"] or "gap_v" not in label:
        return None
    return float(label["gap_v"]) / float(label["floor_v"])


def _closed(gap: Mapping[str, Any], label: Mapping[str, Any], verdict: str) -> dict[str, float]:
    """Return the closed part of the gap: as the diagnosis reckons it, and by the truth's floors.

    `clean`: what a model of training and references misses on the same days without the fault;
    `sensor`: what noise, steps and start of a perfect model leave. Without a cause nothing is
    closed.
    """
    result: dict[str, float] = {}
    has_cause = verdict not in {NONE, UNKNOWN}
    if not has_cause or gap.get("closed_fraction") is not None:
        result["reported"] = float(gap["closed_fraction"]) if has_cause else 0.0
    for name in ("clean", "sensor"):
        floor = label.get(f"floor_{name}_v")
        if floor is None:
            continue
        there = float(gap["baseline_rmse_v"]) ** 2 - float(floor) ** 2
        if there <= 0.0:
            continue  # the model as given has no gap above this floor
        shrunk = float(gap["baseline_rmse_v"]) ** 2 - float(gap["extended_rmse_v"]) ** 2
        result[name] = min(shrunk / there, 1.0) if has_cause else 0.0
    return result


def _covered(cause: Mapping[str, Any], label: Mapping[str, Any]) -> tuple[Covered, ...]:
    """Return the intervals of the true cause's parameters, where the verdict named it."""
    found = []
    for fault in label["faults"]:
        if fault["id"] != cause["verdict"]:
            continue
        candidate = next(
            (item for item in cause["candidates"] if item["effect"] == fault["id"]), None
        )
        stated = {} if candidate is None else candidate["parameters"]
        for name, true in expected_parameters(fault).items():
            item = stated.get(name)
            if item is None or item.get("ci") is None:
                continue
            low, high = item["ci"]
            found.append(
                Covered(fault["id"], name, true, float(item["value"]), float(low), float(high))
            )
    return tuple(found)


# --- All outcomes → the figures of the check, each with its 95 % interval

CONFIDENT: Final = 0.5
GAP_EDGES: Final = (0.0, 0.5, 1.0, 2.0, 5.5)
_BINS: Final = 10

REAL: Final = "real-"
"""Protocols of faults put into recorded logs; they are scored each and all together."""

Figures = dict[str, Any]


def score(outcomes: Sequence[Outcome]) -> Figures:
    """Return every figure of the check.

    Parameters
    ----------
    outcomes : sequence of Outcome
    """
    by_protocol: dict[str, list[Outcome]] = defaultdict(list)
    for item in outcomes:
        by_protocol[item.protocol].append(item)
    recorded = [item for item in outcomes if item.protocol.startswith(REAL)]
    if recorded:
        by_protocol["real"] = recorded
    return {
        "protocols": {name: _protocol(items) for name, items in sorted(by_protocol.items())},
        "reliability": reliability(outcomes),
        "cost": _cost(outcomes),
        "crashed": [item.to_dict() for item in outcomes if item.verdict == CRASHED],
    }


def _protocol(everything: Sequence[Outcome]) -> Figures:
    decoys = [i for i in everything if i.is_decoy]
    items = [i for i in everything if not i.is_decoy]
    single = [i for i in items if len(i.truth) == 1 and not is_outside(i.truth)]
    closed_set = [i for i in single if i.right in EFFECTS and i.in_range]
    healthy = [i for i in items if not i.truth]
    unnamed = [i for i in items if i.right == UNKNOWN and i.in_range]
    pairs = [i for i in items if len(i.truth) == 2]
    result: Figures = {"cases": len(items), "below_range": sum(not i.in_range for i in items)}
    if closed_set:
        result["effects"] = _accuracy(closed_set)
        result["by_gap"] = _by_gap([i for i in single if i.right in EFFECTS])
        result["by_effect"] = _by_effect(closed_set)
        result["coverage"] = _coverage(closed_set)
    if healthy:
        result["healthy"] = {
            "false_alarms": share([i.verdict != NONE for i in healthy]).to_dict(),
            "named_an_effect": share([i.names_effect for i in healthy]).to_dict(),
        }
    if unnamed:
        result["open_set"] = _open_set(unnamed)
    if pairs:
        result["pairs"] = {
            "first_is_one_of_both": share([i.verdict in i.truth for i in pairs]).to_dict(),
            "both": share([set(i.accepted) == set(i.truth) for i in pairs]).to_dict(),
            "both_among_three": share(
                [i.names_effect and set(i.truth) <= set(i.ranked[:3]) for i in pairs]
            ).to_dict(),
        }
    if decoys:
        # The cause is still in the library, so these say whether leaving another out does harm.
        result["decoys"] = share([i.strict for i in decoys]).to_dict()
    result["confusion"] = confusion(items)
    result["cost"] = _cost(items)
    return result


def _accuracy(items: Sequence[Outcome]) -> Figures:
    def rate(is_hit: Callable[[Outcome], bool]) -> Figures:
        return share([is_hit(item) for item in items]).to_dict()

    correct = [item for item in items if item.strict]
    return {
        "cases": len(items),
        "detected": rate(lambda i: i.verdict not in {NONE, CRASHED}),
        "top1": rate(lambda i: i.strict),
        "top1_pair": rate(lambda i: i.within_pair),
        "top2": rate(lambda i: i.within_two),
        "family": rate(lambda i: i.family),
        "unknown": rate(lambda i: i.verdict == UNKNOWN),
        "ranked_first": rate(lambda i: i.ranked[:1] == (i.right,)),
        "ranked_in_two": rate(lambda i: i.right in i.ranked[:2]),
        "correct_and_confident": share([i.probability >= CONFIDENT for i in correct]).to_dict(),
        "closed": {
            floor: {
                "all": estimate(_closed_share(items, floor), _median),
                "detected": estimate(
                    _closed_share((i for i in items if i.names_effect), floor), _median
                ),
            }
            for floor in ("clean", "sensor", "reported")
        },
    }


def _closed_share(items: Iterable[Outcome], floor: str) -> list[float]:
    return [i.closed[floor] for i in items if i.closed is not None and floor in i.closed]


def _median(values: np.ndarray) -> float:
    return float(np.median(values))


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values))


def _by_gap(items: Sequence[Outcome]) -> list[Figures]:
    result = []
    for low, high in pairwise(GAP_EDGES):
        there = [i for i in items if i.gap_in_floors is not None and low <= i.gap_in_floors < high]
        result.append(
            {
                "gap_in_floors": [low, high],
                "detected": share([i.verdict not in {NONE, CRASHED} for i in there]).to_dict(),
                "top1": share([i.strict for i in there]).to_dict(),
                "top1_pair": share([i.within_pair for i in there]).to_dict(),
            }
        )
    return result


def _by_effect(items: Sequence[Outcome]) -> Figures:
    groups: dict[str, list[Outcome]] = defaultdict(list)
    for item in items:
        groups[item.truth[0]].append(item)
    return {
        effect: {
            "top1": share([i.strict for i in there]).to_dict(),
            "top1_pair": share([i.within_pair for i in there]).to_dict(),
            "verdicts": dict(Counter(i.verdict for i in there).most_common()),
        }
        for effect, there in sorted(groups.items())
    }


def _coverage(items: Sequence[Outcome]) -> Figures:
    covered = [item for outcome in items for item in outcome.covered]
    groups: dict[str, list[bool]] = defaultdict(list)
    for item in covered:
        groups[f"{item.effect}.{item.parameter}"].append(item.holds)
    return {
        "all": share([item.holds for item in covered]).to_dict(),
        "by_parameter": {name: share(flags).to_dict() for name, flags in sorted(groups.items())},
    }


def _open_set(items: Sequence[Outcome]) -> Figures:
    return {
        "cases": len(items),
        "unknown": share([i.verdict == UNKNOWN for i in items]).to_dict(),
        "none": share([i.verdict == NONE for i in items]).to_dict(),
        "named_an_effect": share([i.names_effect for i in items]).to_dict(),
        "confidently_wrong": share(
            [i.names_effect and i.probability >= CONFIDENT for i in items]
        ).to_dict(),
    }


def reliability(outcomes: Sequence[Outcome]) -> Figures:
    """Return how often verdicts of each stated probability are right, and the Brier score.

    Cases with two causes are left out: what is right of them is not one verdict. A crash states
    nothing.

    Parameters
    ----------
    outcomes : sequence of Outcome
    """
    said = [i for i in outcomes if len(i.truth) <= 1 and i.verdict != CRASHED and i.in_range]
    bins = []
    for number in range(_BINS):
        low, high = number / _BINS, (number + 1) / _BINS
        there = [
            i for i in said if low <= i.probability < high or (high == 1.0 and i.probability >= 1.0)
        ]
        bins.append(
            {
                "probability": [low, high],
                "stated": _mean(np.array([i.probability for i in there])) if there else None,
                "right": share([i.strict for i in there]).to_dict(),
            }
        )
    squares = [(i.probability - float(i.strict)) ** 2 for i in said]
    return {"brier": estimate(squares, _mean), "bins": bins}


def confusion(items: Sequence[Outcome]) -> Figures:
    """Return how often each verdict was given of each truth (single causes and none)."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for item in items:
        if len(item.truth) <= 1:
            counts[item.truth[0] if item.truth else NONE][item.verdict] += 1
    return {truth: dict(said.most_common()) for truth, said in sorted(counts.items())}


def _cost(outcomes: Sequence[Outcome]) -> Figures:
    result: Figures = {}
    for name in ("seconds", "peak_mib"):
        values = [value for i in outcomes if (value := getattr(i, name)) is not None]
        result[name] = (
            {"median": float(np.median(values)), "max": float(np.max(values))} if values else None
        )
    return result
