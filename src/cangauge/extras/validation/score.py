"""Score of the withheld check: labels and answers → figures with 95 % intervals.

Intervals are Wilson's for shares and bootstrap percentiles for medians and means.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np

from cangauge.extras.validation.plan import EFFECTS, is_outside
from cangauge.extras.validation.twin.faults import fault_kinds
from cangauge.extras.validation.worker_pool import Task

NONE, UNKNOWN, CRASHED = "none", "unknown", "crashed"
FAMILY: Final = {kind.id: kind.family for kind in fault_kinds()}

LEAST_GAP: Final = 0.45
"""Gaps below this multiple of the floor are out of range: physical limits allow no larger one."""
_CONFIDENT: Final = 0.5
_GAP_EDGES: Final = (0.0, 0.5, 1.0, 2.0, 5.5)
_PROBABILITY_BINS: Final = 10
_LEAST_PROBABILITY: Final = 1e-3
"""A smaller probability of the truth counts as this in the log score, as one miss would decide it
otherwise."""
_RESAMPLES: Final = 2000
_ROUNDING: Final = 1e-9
"""Relative rounding between the units of the twin and of the effects library."""
_RECORDED: Final = "real-"
"""Prefix of protocols on recorded logs, which are scored each and together."""

Figures = dict[str, Any]


def proportion(hits: int, of: int) -> Figures:
    """Return a share with its 95 % interval (Wilson 1927)."""
    from scipy.stats import binomtest  # noqa: PLC0415 - half a second to import

    interval = None
    if of:
        interval = list(binomtest(hits, of).proportion_ci(0.95, method="wilson"))
    return {"value": hits / of if of else None, "ci": interval, "hits": hits, "of": of}


def share(flags: Sequence[bool]) -> Figures:
    """Return the share of set flags with its interval."""
    return proportion(sum(flags), len(flags))


def bootstrapped(values: Sequence[float], statistic: Callable[..., Any]) -> Figures:
    """Return a statistic with its bootstrap percentile interval (fixed seed).

    Parameters
    ----------
    values : sequence of float
    statistic : callable
        `np.median` or `np.mean`: takes an array and an axis.
    """
    from scipy.stats import bootstrap  # noqa: PLC0415 - half a second to import

    data = np.asarray(values, dtype=np.float64)
    if data.size == 0:
        return {"value": None, "ci": None, "of": 0}
    value = float(statistic(data))
    interval = [value, value]
    if data.size > 1:
        resampled = bootstrap(
            (data,),
            statistic,
            n_resamples=_RESAMPLES,
            method="percentile",
            random_state=np.random.default_rng(0),
        )
        interval = [float(limit) for limit in resampled.confidence_interval]
    return {"value": value, "ci": interval, "of": int(data.size)}


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
"""Faults whose size a diagnosis can state; twin and effects library differ in name and sign."""


def expected_parameters(fault: Mapping[str, Any]) -> dict[str, float]:
    """Return the parameters of the effect that reproduces a fault; empty if not comparable.

    `fault` has `id`, `size` and `shape`, as in a label.
    """
    rule = _EXPECTED.get(fault["id"])
    return {} if rule is None else rule(float(fault["size"]), fault["shape"])


class Interval(NamedTuple):
    """Stated interval of a parameter, and its true value."""

    effect: str
    parameter: str
    true: float
    value: float
    low: float
    high: float

    @property
    def holds(self) -> bool:
        """Whether the interval contains the true value; both may lie at a bound."""
        rounding = _ROUNDING * abs(self.true)
        return self.low - rounding <= self.true <= self.high + rounding


@dataclass(frozen=True)
class Outcome:
    """Verdict on a case whose cause is known.

    Parameters
    ----------
    task, case, protocol : str
    truth : tuple of str
        True effects; empty for a healthy pack.
    leave_out : tuple of str
        Effects that were removed from the library.
    gap_in_floors : float, optional
        RMS gap of the faults in multiples of the floor, the model's error on healthy logs.
    verdict : str
        An effect, `none`, `unknown` or `crashed`.
    probability : float
        Stated probability of the verdict; 0 for a crash.
    detected : bool
        Whether there was an alarm.
    probability_of_truth : float
        Stated probability of the correct answer; 0 for a crash.
    credible_set : tuple of str
    ceiling : float, optional
        Probability that an ideal observer would name the right effect, if the verdict is true.
    ambiguous_with, accepted, ranked : tuple of str
    closed : dict of str to float
        Closed fraction of the squared gap, by the floor it is counted from.
    intervals : tuple of Interval
    seconds, peak_mib : float, optional
    error : str
        Reason of a crash.
    """

    task: str
    case: str
    protocol: str
    truth: tuple[str, ...]
    leave_out: tuple[str, ...]
    gap_in_floors: float | None
    verdict: str
    probability: float
    detected: bool = False
    probability_of_truth: float = 0.0
    credible_set: tuple[str, ...] = ()
    ceiling: float | None = None
    ambiguous_with: tuple[str, ...] = ()
    accepted: tuple[str, ...] = ()
    ranked: tuple[str, ...] = ()
    closed: Mapping[str, float] | None = None
    intervals: tuple[Interval, ...] = ()
    seconds: float | None = None
    peak_mib: float | None = None
    error: str = ""

    @property
    def right(self) -> str:
        """Correct verdict of a case with at most one cause."""
        if not self.truth:
            return NONE
        if is_outside(self.truth) or set(self.truth) & set(self.leave_out):
            return UNKNOWN
        return self.truth[0]

    @property
    def is_control(self) -> bool:
        """Whether the library lacks an effect that is not the cause."""
        return bool(self.leave_out) and not set(self.truth) & set(self.leave_out)

    @property
    def strict(self) -> bool:
        """Whether the verdict is correct (of several causes: one of them)."""
        if len(self.truth) > 1 and not self.leave_out:
            return self.verdict in self.truth
        return self.verdict == self.right

    @property
    def within_pair(self) -> bool:
        """Whether the truth is the verdict or the single effect that it is ambiguous with."""
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
        """Whether an effect is named and the truth is among the two most probable."""
        return self.names_effect and self.right in self.ranked[:2]

    @property
    def family(self) -> bool:
        """Whether the family is correct."""
        return self.names_effect and FAMILY[self.verdict] == FAMILY.get(self.right)

    @property
    def in_range(self) -> bool:
        """Whether the gap is large enough to be scored."""
        return self.gap_in_floors is None or self.gap_in_floors >= LEAST_GAP

    def to_dict(self) -> dict[str, Any]:
        """Return the outcome as JSON."""
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
            "detected": self.detected,
            "probability_of_truth": self.probability_of_truth,
            "credible_set": list(self.credible_set),
            "ceiling": self.ceiling,
            "ambiguous_with": list(self.ambiguous_with),
            "accepted": list(self.accepted),
            "ranked": list(self.ranked[:5]),
            "closed": None if self.closed is None else dict(self.closed),
            "parameters": [{**item._asdict(), "holds": item.holds} for item in self.intervals],
            "seconds": self.seconds,
            "peak_mib": self.peak_mib,
            "error": self.error,
        }


def outcome_of(task: Task, label: Mapping[str, Any], answer: Mapping[str, Any]) -> Outcome:
    """Compare the answer of a diagnosing process with the label of its case."""
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
    ceiling = answer["result"]["ceiling"]
    stated = {item["effect"]: float(item["probability"]) for item in cause["candidates"]}
    stated |= {name: float(cause[f"probability_{name}"]) for name in (NONE, UNKNOWN)}
    outcome = Outcome(
        **about,
        verdict=verdict,
        probability=float(cause["probability"]),
        detected=bool(cause["detected"]),
        credible_set=tuple(cause["credible_set"]),
        ceiling=None if ceiling is None else float(ceiling["probability_of_best"]),
        ambiguous_with=tuple(cause["ambiguous_with"]),
        accepted=tuple(item["effect"] for item in cause["accepted"]),
        ranked=tuple(ranked),
        closed=_closed(gap, label, verdict),
        intervals=_intervals(cause, label),
    )
    return replace(outcome, probability_of_truth=stated.get(outcome.right, 0.0))


def _gap_in_floors(label: Mapping[str, Any]) -> float | None:
    if not label["effects"] or "gap_v" not in label:
        return None
    return float(label["gap_v"]) / float(label["floor_v"])


def _closed(gap: Mapping[str, Any], label: Mapping[str, Any], verdict: str) -> dict[str, float]:
    """Return the closed fraction of the gap, as reported and relative to true floors.

    `clean`: error of a model of training and references on the same drives without the fault;
    `sensor`: error of a perfect model. Without a cause nothing is closed.
    """
    result: dict[str, float] = {}
    has_cause = verdict not in {NONE, UNKNOWN}
    if not has_cause or gap.get("closed_fraction") is not None:
        result["reported"] = float(gap["closed_fraction"]) if has_cause else 0.0
    for name in ("clean", "sensor"):
        floor = label.get(f"floor_{name}_v")
        if floor is None:
            continue
        total = float(gap["baseline_rmse_v"]) ** 2 - float(floor) ** 2
        if total <= 0.0:
            continue  # no gap above this floor
        closed = float(gap["baseline_rmse_v"]) ** 2 - float(gap["extended_rmse_v"]) ** 2
        result[name] = min(closed / total, 1.0) if has_cause else 0.0
    return result


def _intervals(cause: Mapping[str, Any], label: Mapping[str, Any]) -> tuple[Interval, ...]:
    """Return the parameter intervals of the true cause, if the verdict names it."""
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
                Interval(fault["id"], name, true, float(item["value"]), float(low), float(high))
            )
    return tuple(found)


def score(outcomes: Sequence[Outcome]) -> Figures:
    """Return all figures of the check."""
    by_protocol: dict[str, list[Outcome]] = defaultdict(list)
    for item in outcomes:
        by_protocol[item.protocol].append(item)
    recorded = [item for item in outcomes if item.protocol.startswith(_RECORDED)]
    if recorded:
        by_protocol["real"] = recorded
    return {
        "protocols": {name: _protocol(items) for name, items in sorted(by_protocol.items())},
        "reliability": reliability(outcomes),
        "cost": _cost(outcomes),
        "crashed": [item.to_dict() for item in outcomes if item.verdict == CRASHED],
    }


def _protocol(everything: Sequence[Outcome]) -> Figures:
    controls = [i for i in everything if i.is_control]
    items = [i for i in everything if not i.is_control]
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
            "false_alarms": share([i.detected or i.verdict == CRASHED for i in healthy]),
            "named_an_effect": share([i.names_effect for i in healthy]),
        }
    if unnamed:
        result["open_set"] = _open_set(unnamed)
    if pairs:
        result["pairs"] = {
            "first_is_one_of_both": share([i.verdict in i.truth for i in pairs]),
            "both": share([set(i.accepted) == set(i.truth) for i in pairs]),
            "both_among_three": share(
                [i.names_effect and set(i.truth) <= set(i.ranked[:3]) for i in pairs]
            ),
        }
    if controls:
        # The cause is still in the library: does removing another effect change the verdict?
        result["decoys"] = share([i.strict for i in controls])
    result["posterior"] = _posterior([i for i in items if len(i.truth) < 2 and i.in_range])
    result["confusion"] = confusion(items)
    result["cost"] = _cost(items)
    return result


def _accuracy(items: Sequence[Outcome]) -> Figures:
    def rate(is_hit: Callable[[Outcome], bool]) -> Figures:
        return share([is_hit(item) for item in items])

    correct = [item for item in items if item.strict]
    return {
        "cases": len(items),
        "detected": rate(lambda i: i.detected),
        "top1": rate(lambda i: i.strict),
        "top1_pair": rate(lambda i: i.within_pair),
        "top2": rate(lambda i: i.within_two),
        "family": rate(lambda i: i.family),
        "unknown": rate(lambda i: i.verdict == UNKNOWN),
        "ranked_first": rate(lambda i: i.ranked[:1] == (i.right,)),
        "ranked_in_two": rate(lambda i: i.right in i.ranked[:2]),
        "correct_and_confident": share([i.probability >= _CONFIDENT for i in correct]),
        "closed": {
            floor: {
                "all": bootstrapped(_closed_share(items, floor), np.median),
                "detected": bootstrapped(
                    _closed_share((i for i in items if i.names_effect), floor), np.median
                ),
            }
            for floor in ("clean", "sensor", "reported")
        },
    }


def _posterior(items: Sequence[Outcome]) -> Figures:
    """Return how good the stated probabilities are: proper scores, and the credible set.

    The log score is ln of the probability of the correct answer, at least `_LEAST_PROBABILITY`.
    """
    of_truth = np.maximum([i.probability_of_truth for i in items], _LEAST_PROBABILITY)
    return {
        "probability_of_truth": bootstrapped([i.probability_of_truth for i in items], np.mean),
        "log_score": bootstrapped(np.log(of_truth).tolist(), np.mean),
        "set_covers": share([i.right in i.credible_set for i in items]),
        "set_size": bootstrapped([float(len(i.credible_set)) for i in items], np.mean),
        "ceiling": bootstrapped([i.ceiling for i in items if i.ceiling is not None], np.mean),
    }


def _closed_share(items: Iterable[Outcome], floor: str) -> list[float]:
    return [i.closed[floor] for i in items if i.closed is not None and floor in i.closed]


def _by_gap(items: Sequence[Outcome]) -> list[Figures]:
    result = []
    for low, high in pairwise(_GAP_EDGES):
        there = [i for i in items if i.gap_in_floors is not None and low <= i.gap_in_floors < high]
        result.append(
            {
                "gap_in_floors": [low, high],
                "detected": share([i.detected for i in there]),
                "top1": share([i.strict for i in there]),
                "top1_pair": share([i.within_pair for i in there]),
            }
        )
    return result


def _by_effect(items: Sequence[Outcome]) -> Figures:
    groups: dict[str, list[Outcome]] = defaultdict(list)
    for item in items:
        groups[item.truth[0]].append(item)
    return {
        effect: {
            "top1": share([i.strict for i in there]),
            "top1_pair": share([i.within_pair for i in there]),
            "verdicts": dict(Counter(i.verdict for i in there).most_common()),
        }
        for effect, there in sorted(groups.items())
    }


def _coverage(items: Sequence[Outcome]) -> Figures:
    covered = [item for outcome in items for item in outcome.intervals]
    groups: dict[str, list[bool]] = defaultdict(list)
    for item in covered:
        groups[f"{item.effect}.{item.parameter}"].append(item.holds)
    return {
        "all": share([item.holds for item in covered]),
        "by_parameter": {name: share(flags) for name, flags in sorted(groups.items())},
    }


def _open_set(items: Sequence[Outcome]) -> Figures:
    return {
        "cases": len(items),
        "unknown": share([i.verdict == UNKNOWN for i in items]),
        "none": share([i.verdict == NONE for i in items]),
        "named_an_effect": share([i.names_effect for i in items]),
        "confidently_wrong": share([i.names_effect and i.probability >= _CONFIDENT for i in items]),
    }


def reliability(outcomes: Sequence[Outcome]) -> Figures:
    """Return the reliability diagram and the Brier score of the stated probabilities.

    Cases of two causes, which have no single correct verdict, and crashes are excluded.
    """
    stated = [i for i in outcomes if len(i.truth) <= 1 and i.verdict != CRASHED and i.in_range]
    bins = []
    for number in range(_PROBABILITY_BINS):
        low, high = number / _PROBABILITY_BINS, (number + 1) / _PROBABILITY_BINS
        there = [
            i
            for i in stated
            if low <= i.probability < high or (high == 1.0 and i.probability >= 1.0)
        ]
        bins.append(
            {
                "probability": [low, high],
                "stated": float(np.mean([i.probability for i in there])) if there else None,
                "right": share([i.strict for i in there]),
            }
        )
    squares = [(i.probability - float(i.strict)) ** 2 for i in stated]
    return {"brier": bootstrapped(squares, np.mean), "bins": bins}


def confusion(items: Sequence[Outcome]) -> Figures:
    """Return the verdict counts of each truth, for at most one cause."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for item in items:
        if len(item.truth) <= 1:
            counts[item.truth[0] if item.truth else NONE][item.verdict] += 1
    return {truth: dict(verdicts.most_common()) for truth, verdicts in sorted(counts.items())}


def _cost(outcomes: Sequence[Outcome]) -> Figures:
    result: Figures = {}
    for name in ("seconds", "peak_mib"):
        values = [value for i in outcomes if (value := getattr(i, name)) is not None]
        result[name] = (
            {"median": float(np.median(values)), "max": float(np.max(values))} if values else None
        )
    return result
