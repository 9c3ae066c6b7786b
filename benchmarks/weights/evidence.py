"""Evidence of drawn cases, saved so that weights refit in seconds."""

from __future__ import annotations

import pickle
import time
from collections.abc import Collection
from pathlib import Path

from benchmarks.weights import engine
from benchmarks.weights.cases import EFFECTS, Split
from benchmarks.weights.fit import Example


def examples_of(split: Split) -> list[Example]:
    """Analyse every case of a split; one with an effect counts again with its effect taken out."""
    known = engine.references(split.references, split.capacity_ah)
    out = []
    for case in split.cases:
        began = time.process_time()
        found = engine.evidence(known, case.logs, split.capacity_ah)
        seconds = time.process_time() - began
        effect = case.truth["effect"]
        truth = "none" if effect is None else effect if effect in EFFECTS else "unknown"
        more = dict(
            case.truth,
            seconds=seconds,
            found={k: (e.size, e.std) for k, e in found.effects.items()},
            left_over={k: (e.left_v2 / known.healthy_v2) ** 0.5 for k, e in found.effects.items()},
        )
        for without in [(), (effect,)] if effect in EFFECTS else [()]:
            f = engine.features(known, found, without)
            of = "unknown" if without else truth
            floors = case.truth.get("reached", 0.0)
            out.append(
                Example(
                    split.pack,
                    split.world,
                    f.names,
                    f.inner,
                    f.outer,
                    of,
                    floors,
                    bool(without),
                    more=more,
                )
            )
    return out


def gather(folder: Path, numbers: Collection[int]) -> list[Example]:
    """Return the examples of drawn splits of a folder, from its cache where it is current."""
    out: list[Example] = []
    for file in sorted(folder.glob("[0-9]*.pkl")):
        if int(file.name[:3]) not in numbers:
            continue
        cache = file.with_suffix(".features")
        if not cache.exists() or cache.stat().st_mtime < file.stat().st_mtime:
            cache.write_bytes(pickle.dumps(examples_of(pickle.loads(file.read_bytes()))))
        out += pickle.loads(cache.read_bytes())
    return out
