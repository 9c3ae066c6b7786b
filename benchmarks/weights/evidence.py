"""Evidence of drawn cases, saved so that weights refit in seconds."""

from __future__ import annotations

import pickle
import time
from pathlib import Path

from benchmarks.weights import engine
from benchmarks.weights.cases import EFFECTS, Split
from benchmarks.weights.fit import Example


def examples_of(split: Split) -> list[Example]:
    """Analyse every case of a split; one with an effect counts again with its effect taken out."""
    learned = engine.learn(split.references, split.capacity_ah)
    out = []
    for case in split.cases:
        began = time.process_time()
        found = engine.evidence(learned, case.logs)
        seconds = time.process_time() - began
        effect = case.truth["effect"]
        truth = "none" if effect is None else effect if effect in EFFECTS else "unknown"
        for without in [(), (effect,)] if effect in EFFECTS else [()]:
            f = engine.features(*found, without)
            out.append(
                Example(split.pack, split.world, f.names, f.inner, f.outer, "unknown" if without else truth,
                        case.truth.get("reached", 0.0), bool(without),
                        more={"size": case.truth.get("size"), "found": dict(zip(f.names, f.sizes, strict=True)), "seconds": seconds, "effect": effect})
            )  # fmt: skip
    return out


def gather(folder: Path, again: bool = False) -> list[Example]:
    """Return the examples of all drawn splits of a folder, from its cache where it is current."""
    out: list[Example] = []
    for file in sorted(folder.glob("[0-9]*.pkl")):
        cache = file.with_suffix(".features")
        if again or not cache.exists() or cache.stat().st_mtime < file.stat().st_mtime:
            cache.write_bytes(pickle.dumps(examples_of(pickle.loads(file.read_bytes()))))
        out += pickle.loads(cache.read_bytes())
    return out
