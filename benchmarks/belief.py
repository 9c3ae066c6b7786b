"""Learn the weights of `cangauge.diagnosis.classifier` from labelled cases, and print them.

    cangauge gap-check --protocol simulated --per-effect 5 --healthy 150 --seed 32 --keep cases
    python benchmarks/belief.py cases…

The weights in use were learned from 629 cases of seed 71, 267 of them healthy, with no gap below
what the check counts: `simulated` (--per-effect 7 --healthy 160), `equation` (4, 40), `published`
(3, 30), `real-bmw_i3` (3, 30), and 43 cases of `real-lg_hg2` (3, 16).

Only cases of development seeds are taken. Each faulty one counts a second time, a little, with its
cause out of the comparison, and so do those whose cause is outside the library: then no effect is
right. Shares are printed for packs left out of the fit (ten parts, no pack in two).
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from cangauge.diagnosis import classifier
from cangauge.diagnosis.classifier import (
    AMBIGUOUS_FROM,
    GAP_BELOW,
    NAMED_FROM,
    Comparison,
    compare_effects,
)
from cangauge.diagnosis.problem import build_problem
from cangauge.logs.read import read_log
from cangauge.model.model_file import Model
from cangauge.validation.score import LEAST_GAP

FloatArray = NDArray[np.float64]

OUTSIDE_COUNTS = 0.75
"""A case without the right effect counts so much: a cause is more often in the library than not.
The more, the less is named with certainty, rightly or not."""


HELD = 0.01
"""Weight of the sum of squares of all weights, for features of standard deviation 1."""

PARTS = 10
NONE, RIGHT, ANOTHER = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Case:
    """One diagnosis and what is true."""

    protocol: str
    world: str
    truth: str
    compared: Comparison
    learned: bool
    """Whether references have shown how far evidence strays: no other case is learned from."""

    @property
    def known(self) -> bool:
        """Whether the cause is among the effects that were compared."""
        return self.truth in {each.score.effect_id for each in self.compared.effects}

    def without_cause(self) -> Case:
        """Return the case with its cause out of the comparison."""
        rest = tuple(w for w in self.compared.effects if w.score.effect_id != self.truth)
        return replace(
            self, protocol=f"{self.protocol}, open", compared=replace(self.compared, effects=rest)
        )


def main() -> None:
    """Read or diagnose the cases, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("folders", nargs="+", type=Path, help="kept by cangauge gap-check --keep")
    cases = [case for folder in parser.parse_args().folders for case in cases_of(folder)]
    cases = [case for case in cases if case.learned]
    cases += [case.without_cause() for case in cases if case.known]
    judge(cases)
    which = fit_which(cases)
    whether = fit_whether(cases, which)
    print("EFFECT_WEIGHTS =", tuple(np.round(which, 3).tolist()))
    for name, weights in zip(("BEST_WEIGHTS", "OTHER_WEIGHTS"), whether, strict=True):
        print(f"{name} =", tuple(np.round(weights, 3).tolist()))


def cases_of(folder: Path) -> list[Case]:
    """Return the cases of a folder; what has been diagnosed once is read from `compared`."""
    about = folder / "tasks.json"
    if about.exists() and json.loads(about.read_text(encoding="utf-8"))["final"]:
        sys.exit(f"{folder}: cases of final seeds are not to be learned from")
    labels = json.loads((folder / "sealed" / "labels.json").read_text(encoding="utf-8"))["labels"]
    labels = [label for label in labels if "failed" not in label and len(label["effects"]) < 2]
    labels = [
        label
        for label in labels
        if not label["effects"] or label["gap_v"] >= LEAST_GAP * label["floor_v"]
    ]
    (folder / "compared").mkdir(exist_ok=True)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with ProcessPoolExecutor() as pool:
        return list(pool.map(case_of, labels, [folder] * len(labels)))


def case_of(label: dict[str, Any], folder: Path) -> Case:
    """Diagnose one case as far as the comparison of effects."""
    kept = folder / "compared" / f"{label['name']}.pkl"
    if not kept.exists():
        place = folder / "open" / label["name"]
        logs, references = (
            [read_log(path) for path in sorted(place.glob(f"{kind}_*.parquet"))]
            for kind in ("log", "reference")
        )
        problem = build_problem(logs, Model.load(place / "model.json"), references)
        compared = compare_effects(problem)
        kept.write_bytes(pickle.dumps((compared, bool(problem.error.overdispersion))))
    compared, learned = pickle.loads(kept.read_bytes())  # noqa: S301 - written just above
    truth = label["effects"][0] if label["effects"] else "none"
    world = f"{label['protocol']} {label.get('world_seed', label['seed'])}"
    return Case(label["protocol"], world, truth, compared, learned)


def fit_which(cases: Sequence[Case]) -> FloatArray:
    """Return the weights under which the causes are most probable among the effects."""
    seen = [
        (classifier.effect_features(case.compared), at)
        for case in cases
        if (at := place(case)) >= 0
    ]

    def loss(weights: FloatArray) -> tuple[float, FloatArray]:
        total, slope = 0.0, np.zeros_like(weights)
        for features, at in seen:
            utility = features @ weights
            chances = np.exp(utility - utility.max())
            chances /= chances.sum()
            total -= np.log(chances[at] + 1e-300)
            slope -= features[at] - chances @ features
        n = len(seen)
        return total / n + HELD * weights @ weights, slope / n + 2.0 * HELD * weights

    return lowest(loss, len(classifier.EFFECT_WEIGHTS))


def place(case: Case) -> int:
    """Return where the cause is among the effects, −1 if it is not."""
    names = [each.score.effect_id for each in case.compared.effects]
    return names.index(case.truth) if case.truth in names else -1


def ranked(case: Case, which: FloatArray) -> tuple[list[str], FloatArray, FloatArray]:
    """Return effects, the best first, their shares, and what is weighed of the best."""
    effects, shares = classifier.rank_effects(case.compared, which)
    names = [each.score.effect_id for each in effects]
    return names, shares, classifier.presence_features(case.compared, effects[0], float(shares[0]))


def fit_whether(cases: Sequence[Case], which: FloatArray) -> FloatArray:
    """Return the weights of "the best is it" and "it is another", shape (2, features)."""
    found = [ranked(case, which) for case in cases]
    features = np.array([each[2] for each in found])
    answers = np.array([answer(case, each[0]) for case, each in zip(cases, found, strict=True)])
    counts = np.array([weight(case) for case in cases])
    mean, spread = features.mean(axis=0), features.std(axis=0)
    mean[0], spread[0] = 0.0, 1.0
    scaled, target = (features - mean) / spread, np.eye(3)[answers]

    def loss(flat: FloatArray) -> tuple[float, FloatArray]:
        weights = flat.reshape(2, -1)
        logits = np.column_stack([np.zeros(len(scaled)), scaled @ weights.T])
        chances = np.exp(logits - logits.max(axis=1, keepdims=True))
        chances /= chances.sum(axis=1, keepdims=True)
        error = ((chances - target) * counts[:, None])[:, 1:].T @ scaled / counts.sum()
        held = weights * (np.arange(weights.shape[1]) > 0)
        total = -np.sum(counts * np.log(np.sum(chances * target, axis=1) + 1e-300)) / counts.sum()
        return total + HELD * np.sum(held**2), (error + 2.0 * HELD * held).ravel()

    weights = lowest(loss, 2 * features.shape[1]).reshape(2, -1) / spread
    weights[:, 0] -= (weights * mean)[:, 1:].sum(axis=1)
    return weights


def weight(case: Case) -> float:
    """Return how much a case counts for whether there is a cause."""
    return 1.0 if case.known or case.truth == "none" else OUTSIDE_COUNTS


def answer(case: Case, names: Sequence[str]) -> int:
    """Return what is right to say of the best effect."""
    if case.truth == "none":
        return NONE
    return RIGHT if names[0] == case.truth else ANOTHER


def lowest(loss: Callable[[FloatArray], tuple[float, FloatArray]], size: int) -> FloatArray:
    """Return where a convex loss is lowest."""
    return np.asarray(minimize(loss, np.zeros(size), jac=True, method="L-BFGS-B").x)


def judge(cases: Sequence[Case]) -> None:
    """Print what packs left out of the fit say."""
    worlds = sorted({case.world for case in cases})
    parts = np.random.default_rng(1).integers(PARTS, size=len(worlds))
    part_of = dict(zip(worlds, parts.tolist(), strict=True))
    lines: dict[str, list[tuple[str, ...]]] = {}
    said: list[tuple[float, bool]] = []
    for part in range(PARTS):
        known = [case for case in cases if part_of[case.world] != part]
        which = fit_which(known)
        whether = fit_whether(known, which)
        for case in (case for case in cases if part_of[case.world] == part):
            names, shares, features = ranked(case, which)
            logits = np.array([0.0, *(whether @ features)])
            none, best, _ = np.exp(logits - logits.max()) / np.exp(logits - logits.max()).sum()
            verdict = names[0] if best >= NAMED_FROM else "unknown"
            verdict = verdict if none < GAP_BELOW else "none"
            pair = names[1] if shares[1] >= AMBIGUOUS_FROM * shares[0] > shares[2] else ""
            right = names[0] == case.truth
            said.append((best, right))
            lines.setdefault(case.protocol, []).append(
                (case.truth, verdict, names[0], pair, "sure" if best >= 0.5 else "")
            )
    print(f"{'':28s}cases  named  pairs  ranked  unknown  sure and wrong  sure of right  alarms")
    for protocol, rows in sorted(lines.items()):
        faulty = [row for row in rows if row[0] != "none"]
        healthy = [row for row in rows if row[0] == "none"]
        named = [row for row in faulty if row[1] == row[0]]
        shares_of = [
            share([row[1] == row[0] for row in faulty]),
            share([row[1] == row[0] or (row[1] == row[2] and row[3] == row[0]) for row in faulty]),
            share([row[2] == row[0] for row in faulty]),
            share([row[1] == "unknown" for row in faulty]),
            share([bool(row[4]) and row[1] == row[2] != row[0] for row in faulty]),
            share([bool(row[4]) for row in named]),
            share([row[1] != "none" for row in healthy]),
        ]
        print(f"{protocol:28s}{len(rows):5d}", *(f"{each:>7s}" for each in shares_of))
    said.sort()
    for number, group in enumerate(np.array_split(np.array(said), 8)):
        print(f"eighth {number + 1}: said {group[:, 0].mean():.2f}, right {group[:, 1].mean():.2f}")


def share(flags: Sequence[bool]) -> str:
    """Return a share in per cent."""
    return f"{100.0 * sum(flags) / len(flags):.0f} %" if flags else "–"


if __name__ == "__main__":
    main()
