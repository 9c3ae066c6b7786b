"""Scores of probabilities against truths: a table by world and by size in floors."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from benchmarks.weights.engine import GROUP_OF, GROUPS
from benchmarks.weights.fit import Example

from cangauge.diagnosis.answer import ALARM, CREDIBLE, NAMED, STATED
from cangauge.diagnosis.extended import TANGENT_STD

FOUR_WAY = (
    ("current_offset",),
    ("current_gain", "capacity"),
    ("voltage_offset", "voltage_gain"),
    ("time_skew",),
)
"""The four faults of the comparison with published competitions: offset, gain or capacity, voltage
sensor, skew."""
MISLED = 0.5
"""Probability of a wrong effect from which a cause outside the library misleads."""

Marks = dict[str, float]


def one(x: Example, p: dict[str, float]) -> Marks:
    """Return the marks of one case."""
    group = {g: sum(p.get(k, 0.0) for k in ks) for g, ks in GROUPS.items()}
    order = sorted(group, key=lambda g: -group[g])
    share = group[order[0]] / sum(group.values())
    inside = {k: p[k] / group[order[0]] for k in GROUPS[order[0]] if k in p}
    member = max(inside, key=lambda k: inside[k])
    ranked = sorted(p, key=lambda k: -p[k])
    size = int(np.searchsorted(np.cumsum([p[k] for k in ranked]), CREDIBLE) + 1)
    effects = [k for k in ranked if k in GROUP_OF]
    true_group, truth = GROUP_OF.get(x.truth), p.get(x.truth, 0.0)
    best = p[ranked[0]]
    return {
        "alarm": p["none"] <= ALARM,
        "p_true": truth,
        "log": float(np.log(max(truth, 1e-6))),
        "group": order[0] == true_group,
        "in two": true_group in order[:2],
        "stated": share >= STATED,
        "stated right": order[0] == true_group,
        "name": ranked[0] == x.truth,
        "rank": effects[0] == x.truth,
        "member": inside[member] >= NAMED,
        "member right": member == x.truth,
        "set": size,
        "set holds": x.truth in ranked[:size],
        "unknown": ranked[0] == "unknown",
        "misled": p[effects[0]] >= MISLED,
        "best": best,
        "best right": ranked[0] == x.truth,
        "four": _four_way(x, p),
    }


def _four_way(x: Example, p: dict[str, float]) -> float:
    """Return the probability of the true one of four faults and `none`; NaN for other faults."""
    sums = [sum(p.get(k, 0.0) for k in kind) for kind in FOUR_WAY]
    mine = [s for s, kind in zip(sums, FOUR_WAY, strict=True) if x.truth in kind]
    return mine[0] / (sum(sums) + p["none"]) if mine else float("nan")


def mean(marks: Sequence[Marks], key: str) -> float:
    """Return the mean of a mark, NaN of nothing."""
    return float(np.nanmean([m[key] for m in marks])) if marks else float("nan")


def table(examples: Sequence[Example], ps: Sequence[dict[str, float]]) -> str:
    """Return the table of all scores, by world and size."""
    marks = [(x, one(x, p)) for x, p in zip(examples, ps, strict=True)]
    columns = ("group", "in two", "stated", "name", "rank", "member", "alarm", "set", "log")
    lines = [f"{'effects of the library':24s} cases {' '.join(f'{c:>12s}' for c in columns)}"]

    def row(label: str, kept: list[Marks]) -> None:
        if not kept:
            return
        cells = []
        for key in columns:
            text = f"{mean(kept, key):.1f}" if key == "set" else f"{mean(kept, key):.2f}"
            if key in {"stated", "member"}:
                right = mean([m for m in kept if m[key]], f"{key} right")
                text += f" r {right:.2f}"
            cells.append(f"{text:>12s}")
        lines.append(f"{label:24s} {len(kept):5d} {' '.join(cells)}")

    known = [(x, m) for x, m in marks if x.truth in GROUP_OF and not x.cause_out]
    sizes: list[tuple[str, Callable[[float], bool]]] = [
        ("all", lambda _: True),
        ("at least 1 floor", lambda f: f >= 1.0),
        ("below 1", lambda f: f < 1.0),
        ("1 to 2", lambda f: 1.0 <= f < 2.0),
        ("above 2", lambda f: f >= 2.0),
    ]
    for label, inside in sizes:
        row(label, [m for x, m in known if inside(x.floors)])
        if not label.startswith("a"):
            continue
        for world in ("trips", "cells", "simulated", "pybamm"):
            row(f"  {world}", [m for x, m in known if x.world == world and inside(x.floors)])
    for pack in sorted({x.pack for x, _ in known} - {"simulated", "pybamm"}):
        row(f"  {pack}, >= 1", [m for x, m in known if x.pack == pack and x.floors >= 1.0])
    return "\n".join([*lines, *_others(marks)])


def _others(marks: Sequence[tuple[Example, Marks]]) -> list[str]:
    """Return the lines on healthy logs, the open set, sets, calibration and sizes."""
    healthy = [m for x, m in marks if x.truth == "none"]
    packs = len({x.pack for x, _ in marks if x.truth == "none"})
    lines = [
        f"healthy: {len(healthy)} cases of {packs} data sets, {sum(m['alarm'] for m in healthy)}"
        f" alarms, {sum(m['unknown'] for m in healthy)} named unknown, mean P(none)"
        f" {mean(healthy, 'p_true'):.2f}"
    ]
    for label, kept in (
        ("own cause taken out", [m for x, m in marks if x.cause_out and x.floors >= 1.0]),
        (
            "cause outside the library",
            [m for x, m in marks if x.truth == "unknown" and not x.cause_out],
        ),
    ):
        lines.append(
            f"{label}: {len(kept)} cases, misled {mean(kept, 'misled'):.2f}, unknown"
            f" {mean(kept, 'unknown'):.2f}, alarm {mean(kept, 'alarm'):.2f}"
        )
    inside = [m for x, m in marks if x.truth in GROUP_OF or x.truth == "none"]
    lines.append(
        f"90 % sets hold {mean(inside, 'set holds'):.2f}, mean size {mean(inside, 'set'):.1f}; log"
        f" score {mean(inside, 'log'):.2f}; mean P(truth) {mean(inside, 'p_true'):.2f}"
    )
    every = [m for x, m in marks if not x.cause_out]
    bins = [(0.0, 0.3), (0.3, 0.5), (0.5, 0.7), (0.7, 0.9), (0.9, 1.01)]
    parts = []
    for low, high in bins:
        kept = [m for m in every if low <= m["best"] < high]
        if kept:
            parts.append(f"{mean(kept, 'best'):.2f} → {mean(kept, 'best right'):.2f} ({len(kept)})")
    lines.append(f"P(verdict) → frequency (cases): {', '.join(parts)}")
    four = [m for x, m in marks if not np.isnan(m["four"]) and x.floors >= 1.0 and not x.cause_out]
    lines.append(
        f"four-way task, at least 1 floor: mean P(right) {mean(four, 'four'):.2f} ({len(four)})"
    )
    cover = [c for x, _ in marks if (c := _covers(x)) is not None]
    if cover:
        lines.append(f"95 % intervals hold the size: {np.mean(cover):.2f} ({len(cover)})")
    return lines


_TO_ENGINE = {
    "current_offset": 1.0,
    "current_gain": 1.0,
    "voltage_offset": 1.0,
    "voltage_gain": 1.0,
    "time_skew": 1.0,
    "capacity": -1.0,
    "initial_soc": -1.0,
    "coulombic_efficiency": 1.0,
}
"""Effects with the same size in the twin and in the engine → the sign between them."""


def _covers(x: Example) -> bool | None:
    """Whether the interval of a case of at least one floor holds the injected size."""
    if x.cause_out or x.truth not in _TO_ENGINE or x.floors < 1.0:
        return None
    size, std = x.more["found"][x.truth]
    wide = float(np.hypot(std, TANGENT_STD * size))
    return abs(size - _TO_ENGINE[x.truth] * x.more["size"]) <= 1.96 * wide


def bounds(examples: Sequence[Example], ps: Sequence[dict[str, float]]) -> tuple[float, float]:
    """Return how often the right group is first (at least 1 floor), and healthy logs alarm."""
    marks = [(x, one(x, p)) for x, p in zip(examples, ps, strict=True) if not x.cause_out]
    first = mean([m for x, m in marks if x.truth in GROUP_OF and x.floors >= 1.0], "group")
    return first, mean([m for x, m in marks if x.truth == "none"], "alarm")


def trade(examples: Sequence[Example], ps: Sequence[dict[str, float]]) -> str:
    """Return naming and the open set in a line."""
    marks = [(x, one(x, p)) for x, p in zip(examples, ps, strict=True)]
    known = [m for x, m in marks if x.truth in GROUP_OF and x.floors >= 1.0]
    lost = [m for x, m in marks if x.truth == "unknown" and x.floors >= 1.0]
    quiet = [m for x, m in marks if x.truth == "none"]
    return (
        f"named {mean(known, 'name'):.2f}, alarm {mean(known, 'alarm'):.2f}, set"
        f" {mean(known, 'set'):.1f}, log {mean(known, 'log'):.2f}; open set misled"
        f" {mean(lost, 'misled'):.2f}; healthy alarms {sum(m['alarm'] for m in quiet)} of"
        f" {len(quiet)}"
    )
