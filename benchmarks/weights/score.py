"""Scores of probabilities against truths, by world, by size and by number of logs."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from benchmarks.weights.cases import Split
from benchmarks.weights.fit import Example
from rich.table import Table
from threadpoolctl import threadpool_limits

from cangauge.diagnosis import FAULTS, NONE, diagnose, learn_references
from cangauge.diagnosis.posterior import ALARM, ALIKE, Posterior, features, shipped_weights
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

RIGHT = 0.95
"""How often a stated fault is right."""
LEAST_STATED = 20
"""Cases from which a level is judged."""
SIZED = {
    "voltage_offset": ("offset_v", 1.0),
    "voltage_gain": ("gain_pct", 100.0),
    "current_offset": ("offset_a", 1.0),
    "current_gain": ("gain_pct", 100.0),
    "initial_soc": ("offset_pct", 1.0),
    "time_skew": ("skew_s", 1.0),
    "capacity": ("change_pct", -100.0),
    "temperature_offset": ("offset_k", 1.0),
}
"""Effects with the same size in the twin and in the library → parameter, and the factor."""


def floor_v(references: Sequence[Log], capacity_ah: float) -> float:
    """Return the RMS error of left-out references [V]."""
    model = fit(references, capacity_ah=capacity_ah).model
    return learn_references(references, model).rmse_v


def examples(folder: Path, every: int = 1) -> list[Example]:
    """Diagnose the cases of drawn splits, each once: results are kept beside them."""
    found = []
    for file in sorted(folder.glob("[0-9]*.pkl"))[::every]:
        cache = file.with_suffix(".scored")
        if not cache.exists():
            cache.write_bytes(pickle.dumps(_examples_of(pickle.loads(file.read_bytes()))))
        found += pickle.loads(cache.read_bytes())
    return found


def _examples_of(split: Split) -> list[Example]:
    with threadpool_limits(1):
        model = fit(
            split.references,
            capacity_ah=split.capacity_ah,
            chemistry=split.chemistry,
            cells=split.cells,
        ).model
        healthy = learn_references(split.references, model)
        return [_example(split, case.logs, case.truth, model, healthy) for case in split.cases]


def _example(split: Split, logs: Sequence[Log], truth: dict, model: Model, healthy) -> Example:  # type: ignore[no-untyped-def,type-arg]
    answer = diagnose(list(logs), model, healthy)
    found = {
        "probabilities": dict(answer.posterior.probabilities),
        "closed": answer.closed[0],
        "accepted": answer.correction is not None,
        "better": answer.extended_rmse_v <= answer.baseline_rmse_v,
        "covers": _covers(answer, truth),
    }
    case = features(healthy, answer.rows, answer.evidence)
    return Example(split.pack, split.world, case, truth, len(logs), len(split.references), found)


def _covers(answer, truth: dict) -> bool | None:  # type: ignore[no-untyped-def,type-arg]
    """Whether the interval of the right effect holds its size; None where it has no counterpart."""
    effect = truth["effect"]
    if effect not in SIZED or truth["floors"] < 1.0:
        return None
    fault = truth["fault"]
    if answer.best_of(fault).shape.effect.id != effect:
        return None
    name, factor = SIZED[effect]
    low, high = answer.best_of(fault).parameters[name].ci
    return bool(low <= factor * truth["size"] <= high)


def stated_from(examples: Sequence[Example], found: Sequence[dict[str, float]]) -> float:
    """Return the lowest probability within the gap from which a stated fault is right in 95 %."""
    within, right = [], []
    for x, p in zip(examples, found, strict=True):
        one = Posterior(p, ALARM, 0.0)
        if one.level != "none":
            first = next(iter(one.faults))
            within.append(one.within_gap(first))
            right.append(first == x.truth["fault"])
    order = np.argsort(within)[::-1]
    share = np.cumsum(np.array(right)[order]) / np.arange(1, len(order) + 1)
    enough = np.flatnonzero((share >= RIGHT) & (np.arange(len(order)) + 1 >= LEAST_STATED))
    return round(float(np.array(within)[order][enough[-1]]), 2) if enough.size else 0.9


def tables(examples: Sequence[Example], found: Sequence[dict[str, float]]) -> list[Table]:
    """Return the scores of cases with a fault, by groups, and those of all cases."""
    stated = stated_level()
    rows = [(x, Posterior(p, ALARM, stated)) for x, p in zip(examples, found, strict=True)]
    known = [(x, p) for x, p in rows if x.truth["fault"] in FAULTS]
    groups: list[tuple[str, Callable[[Example], bool]]] = [
        ("recorded", lambda x: x.floors >= 1 and x.world != "simulated"),
        ("simulated", lambda x: x.floors >= 1 and x.world == "simulated"),
        ("1 to 2 floors", lambda x: 1 <= x.floors < 2),
        ("above 2 floors", lambda x: x.floors >= 2),
        ("below one floor", lambda x: x.floors < 1),
        ("10 references or more", lambda x: x.floors >= 1 and x.references >= 10),
        ("2 to 6 diagnosed logs", lambda x: x.floors >= 1 and x.logs > 1),
    ]
    packs = sorted({x.pack for x, _ in known if x.world != "simulated"})
    groups += [
        (k, lambda x, k=k: x.floors >= 1 and x.pack == k)  # type: ignore[misc]
        for k in packs
    ]
    by_group = Table(
        "group (one floor or more, unless stated)",
        "cases",
        "right fault first",
        "right fault first or second",
        "one fault stated",
        "stated fault right",
        "gap reported",
        "gap or likely gap",
    )
    for label, inside in groups:
        by_group.add_row(label, *_scores([(x, p) for x, p in known if inside(x)]))
    whole = Table("measure", "value")
    healthy = [p.level for x, p in rows if x.truth["fault"] == NONE]
    whole.add_row("healthy logs with a gap", f"{healthy.count('gap')} of {len(healthy)}")
    whole.add_row("healthy logs with a likely gap", f"{healthy.count('likely')} of {len(healthy)}")
    whole.add_row(
        "mean probability of the first fault → share of cases where it is right (number of cases)",
        _calibration(rows),
    )
    alike = [x.truth["fault"] in ALIKE[p.alike] for x, p in rows if p.alike is not None]
    whole.add_row(
        "named group of faults that look alike contains the right fault",
        f"{sum(alike)} of {len(alike)}",
    )
    for measure, value in _corrections(rows):
        whole.add_row(measure, value)
    return [by_group, whole]


def stated_level() -> float:
    """Return the level from which one fault is stated by the weights that ship."""
    return float(shipped_weights()["stated"])


def _scores(rows: Sequence[tuple[Example, Posterior]]) -> list[str]:
    if not rows:
        return ["0"]
    first = [next(iter(p.faults)) == x.truth["fault"] for x, p in rows]
    two = [x.truth["fault"] in list(p.faults)[:2] for x, p in rows]
    one = np.array([len(p.stated) == 1 for _, p in rows])
    right = np.array(first)[one]
    gap = [p.level == "gap" for _, p in rows]
    likely = [p.level != "none" for _, p in rows]
    return [
        str(len(rows)),
        f"{np.mean(first):.2f}",
        f"{np.mean(two):.2f}",
        f"{one.mean():.2f}",
        f"{right.sum()} of {right.size}",
        f"{np.mean(gap):.2f}",
        f"{np.mean(likely):.2f}",
    ]


def _calibration(rows: Sequence[tuple[Example, Posterior]]) -> str:
    """Return the probability of the likeliest fault against how often it is right."""
    parts = []
    for low, high in ((0.0, 0.3), (0.3, 0.5), (0.5, 0.7), (0.7, 0.9), (0.9, 1.01)):
        kept = [
            (p.faults[f], f == x.truth["fault"])
            for x, p in rows
            for f in [next(iter(p.faults))]
            if low <= p.faults[f] < high
        ]
        if kept:
            mean, share = np.mean(kept, axis=0)
            parts.append(f"{mean:.2f} → {share:.2f} ({len(kept)})")
    return ", ".join(parts)


def _corrections(rows: Sequence[tuple[Example, Posterior]]) -> list[tuple[str, str]]:
    told = [x for x, p in rows if p.level != "none" and x.truth["fault"] in FAULTS]
    offered = [x for x in told if x.found["accepted"]]
    closed = [x.found["closed"] for x in offered if x.found["closed"] is not None]
    covers = [x.found["covers"] for x, _ in rows if x.found["covers"] is not None]
    worse = sum(not x.found["better"] for x in offered)
    return [
        ("correction offered for a gap or likely gap", f"{len(offered)} of {len(told)}"),
        ("squared gap closed by the correction (median)", f"{np.median(closed):.2f}"),
        ("corrections that increase the error", str(worse)),
        (
            "95 % intervals that contain the injected size",
            f"{np.mean(covers):.2f} of {len(covers)}",
        ),
    ]
