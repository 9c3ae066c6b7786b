"""All outcomes → the figures of the check, each with its 95 % interval."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any, Final

import numpy as np

from cangauge.gapcheck.intervals import estimate, share
from cangauge.gapcheck.outcome import CRASHED, NONE, UNKNOWN, Outcome
from cangauge.gapcheck.plan import EFFECTS, is_outside

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
                "all": estimate(_closed(items, floor), _median),
                "detected": estimate(_closed((i for i in items if i.names_effect), floor), _median),
            }
            for floor in ("clean", "sensor", "reported")
        },
    }


def _closed(items: Iterable[Outcome], floor: str) -> list[float]:
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
