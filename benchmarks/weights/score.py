"""Scores of probabilities against truths: a table by world and by size in floors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.weights.fit import GROUP_OF, GROUPS, Example

ALARM, STATED, NAMED = 0.05, 0.8, 0.6


def one(x: Example, p: dict[str, float]) -> dict[str, float]:
    """Return the marks of one case."""
    group = {g: sum(p.get(k, 0.0) for k in ks) for g, ks in GROUPS.items()}
    order = sorted(group, key=lambda g: -group[g])
    library = sum(group.values())
    effects = {k: v for k, v in p.items() if k not in ("none", "unknown")}
    ranked = sorted(effects, key=lambda k: -effects[k])
    verdict = max(p, key=lambda k: p[k])
    names = sorted(p, key=lambda k: -p[k])
    size = int(np.searchsorted(np.cumsum([p[k] for k in names]), 0.9) + 1)
    share = group[order[0]] / library
    inside = {k: p[k] / group[order[0]] for k in GROUPS[order[0]] if k in p}
    member = max(inside, key=lambda k: inside[k])
    true_group = GROUP_OF.get(x.truth)
    return dict(
        alarm=p["none"] <= ALARM, p_true=p.get(x.truth, 0.0), log=float(np.log(max(p.get(x.truth, 1e-12), 1e-12))),
        group=order[0] == true_group, group2=true_group in order[:2], stated=share >= STATED,
        stated_right=share >= STATED and order[0] == true_group, name=verdict == x.truth, rank=ranked[0] == x.truth,
        member=inside[member] >= NAMED, member_right=inside[member] >= NAMED and member == x.truth,
        set_size=size, set_holds=x.truth in names[:size], unknown=verdict == "unknown",
        misled=max(effects.values()) >= 0.5,
    )


def mean(marks: Sequence[dict[str, float]], key: str) -> float:
    return float(np.mean([m[key] for m in marks])) if marks else float("nan")


def table(examples: Sequence[Example], ps: Sequence[dict[str, float]]) -> str:
    """Return the table of all scores, by world and size."""
    marks = [(x, one(x, p)) for x, p in zip(examples, ps, strict=True)]
    lines = ["where                n  group in2  stated right  name  rank member right alarm  set  log"]

    def row(label: str, kept: list[dict[str, float]]) -> None:
        if not kept:
            return
        stated, member = [m for m in kept if m["stated"]], [m for m in kept if m["member"]]
        lines.append(
            f"{label:18s} {len(kept):4d}  {mean(kept, 'group'):.2f}  {mean(kept, 'group2'):.2f}  {mean(kept, 'stated'):.2f}"
            f"  {mean(stated, 'stated_right'):.2f}   {mean(kept, 'name'):.2f}  {mean(kept, 'rank'):.2f}  {mean(kept, 'member'):.2f}"
            f"  {mean(member, 'member_right'):.2f}  {mean(kept, 'alarm'):.2f}  {mean(kept, 'set_size'):4.1f} {mean(kept, 'log'):.2f}"
        )

    effects = [(x, m) for x, m in marks if x.truth in GROUP_OF and not x.cause_out]
    big = [(x, m) for x, m in effects if x.floors >= 1]
    for label, kept in (("all", effects), (">= 1 floor", big)):
        row(label, [m for _, m in kept])
        for world in sorted({x.world for x, _ in kept}):
            row(f"  {world}", [m for x, m in kept if x.world == world])
    for pack in sorted({x.pack for x, _ in big}):
        row(f"  >=1 {pack}", [m for x, m in big if x.pack == pack])
    for label, low, high in (("< 1 floor", 0, 1), ("1-2", 1, 2), ("> 2", 2, 99)):
        row(label, [m for x, m in effects if low <= x.floors < high])
    healthy = [m for x, m in marks if x.truth == "none"]
    lines.append(f"healthy {len(healthy)}: alarms {sum(m['alarm'] for m in healthy)}, unknown {sum(m['unknown'] for m in healthy)}, P(none) {mean(healthy, 'p_true'):.2f}, set {mean(healthy, 'set_size'):.1f}")
    for label, kept in (("cause out", [m for x, m in marks if x.cause_out and x.floors >= 1]), ("outside", [m for x, m in marks if x.truth == "unknown" and not x.cause_out])):
        lines.append(f"{label} {len(kept)}: misled {mean(kept, 'misled'):.2f}, unknown {mean(kept, 'unknown'):.2f}, alarm {mean(kept, 'alarm'):.2f}")
    inside = [m for x, m in marks if not x.cause_out and x.truth != "unknown"]
    lines.append(f"sets of 90 % hold {mean(inside, 'set_holds'):.2f}, mean size {mean(inside, 'set_size'):.1f}; log score {mean(inside, 'log'):.2f}; mean P(truth) {mean(inside, 'p_true'):.2f}")
    return "\n".join(lines)


def trade(examples: Sequence[Example], ps: Sequence[dict[str, float]]) -> str:
    """Return naming and the open set in a line."""
    marks = [(x, one(x, p)) for x, p in zip(examples, ps, strict=True)]
    known = [m for x, m in marks if x.truth in GROUP_OF and x.floors >= 1]
    lost = [m for x, m in marks if x.truth == "unknown" and x.floors >= 1]
    quiet = [m for x, m in marks if x.truth == "none"]
    return (
        f"named {mean(known, 'name'):.2f}, alarm {mean(known, 'alarm'):.2f}; open set misled"
        f" {mean(lost, 'misled'):.2f}; healthy alarms {sum(m['alarm'] for m in quiet)} of {len(quiet)}"
    )
