"""Fit the weights of `cangauge.diagnosis.classifier` to labelled cases, and print them.

    cangauge gap-check --protocol simulated --per-effect 5 --healthy 150 --seed 32 --keep cases
    python benchmarks/classifier_weights.py cases…

The weights in use were fitted to 629 cases of seed 71, 267 of them healthy, with gaps of at least
the size that the check counts: `simulated` (--per-effect 7 --healthy 160), `equation` (4, 40),
`published` (3, 30), `real-bmw_i3` (3, 30), and 43 cases of `real-lg_hg2` (3, 16).

Only cases of development seeds are accepted. Each case whose cause is in the library is used a
second time with its cause removed from the comparison, where no effect is correct; these cases and
those with a cause outside the library have the weight `NO_CORRECT_EFFECT_WEIGHT`. The printed
shares are cross-validated in ten folds by pack.
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
from scipy.optimize import minimize

from cangauge._typing import FloatArray
from cangauge.diagnosis import classifier
from cangauge.diagnosis.classifier import (
    Classification,
    Comparison,
    compare_effects,
    stated_probabilities,
    with_outside_prior,
)
from cangauge.diagnosis.problem import build_problem
from cangauge.diagnosis.verdict import ALARM_BELOW, credible_set
from cangauge.logs.read import read_log
from cangauge.model.model_file import Model
from cangauge.validation.score import LEAST_GAP

NO_CORRECT_EFFECT_WEIGHT = 0.75
"""Weight of a case without a correct effect: a cause is more often in the library than not. A
larger weight names fewer effects with certainty, correct or not."""

RIDGE = 0.01
"""Weight of the sum of squares of all weights, for features of standard deviation 1."""

FOLDS = 10
NONE, BEST, ANOTHER = 0, 1, 2
"""Classes of the presence model: no cause, the best effect, another cause."""


@dataclass(frozen=True, eq=False)
class Case:
    """One diagnosis with its true cause."""

    protocol: str
    pack: str
    """Protocol and seed of the simulated pack."""
    truth: str
    """Effect, or "none"."""
    comparison: Comparison
    has_overdispersion: bool
    """Whether the references gave the overdispersion; other cases are not used."""

    @property
    def has_cause(self) -> bool:
        """Whether the cause is among the compared effects."""
        return self.truth in {each.score.effect_id for each in self.comparison.effects}

    def without_cause(self) -> Case:
        """Return the case with its cause removed from the comparison."""
        rest = tuple(w for w in self.comparison.effects if w.score.effect_id != self.truth)
        return replace(
            self,
            protocol=f"{self.protocol}, open",
            comparison=replace(self.comparison, effects=rest),
        )


def main() -> None:
    """Read or diagnose the cases, fit the weights, and print them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("folders", nargs="+", type=Path, help="kept by cangauge gap-check --keep")
    cases = [case for folder in parser.parse_args().folders for case in read_cases(folder)]
    cases = [case for case in cases if case.has_overdispersion]
    cases += [case.without_cause() for case in cases if case.has_cause]
    print_cross_validation(cases)
    effect_weights = fit_effect_weights(cases)
    presence_weights = fit_presence_weights(cases, effect_weights)
    print("EFFECT_WEIGHTS =", tuple(np.round(effect_weights, 3).tolist()))
    for name, weights in zip(("BEST_WEIGHTS", "OTHER_WEIGHTS"), presence_weights, strict=True):
        print(f"{name} =", tuple(np.round(weights, 3).tolist()))


def read_cases(folder: Path) -> list[Case]:
    """Return the cases of a folder; comparisons are cached in its subfolder `compared`."""
    about = folder / "tasks.json"
    if about.exists() and json.loads(about.read_text(encoding="utf-8"))["final"]:
        sys.exit(f"{folder}: cases of final seeds must not be used for training")
    labels = json.loads((folder / "withheld" / "labels.json").read_text(encoding="utf-8"))["labels"]
    labels = [label for label in labels if "failed" not in label and len(label["effects"]) < 2]
    labels = [
        label
        for label in labels
        if not label["effects"] or label["gap_v"] >= LEAST_GAP * label["floor_v"]
    ]
    (folder / "compared").mkdir(exist_ok=True)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with ProcessPoolExecutor() as pool:
        return list(pool.map(compare_case, labels, [folder] * len(labels)))


def compare_case(label: dict[str, Any], folder: Path) -> Case:
    """Diagnose one case up to the comparison of effects."""
    kept = folder / "compared" / f"{label['name']}.pkl"
    if not kept.exists():
        place = folder / "open" / label["name"]
        logs, references = (
            [read_log(path) for path in sorted(place.glob(f"{kind}_*.parquet"))]
            for kind in ("log", "reference")
        )
        problem = build_problem(logs, Model.load(place / "model.json"), references)
        comparison = compare_effects(problem)
        kept.write_bytes(pickle.dumps((comparison, bool(problem.error.overdispersion))))
    comparison, has_overdispersion = pickle.loads(kept.read_bytes())  # noqa: S301 - own cache
    truth = label["effects"][0] if label["effects"] else "none"
    pack = f"{label['protocol']} {label.get('world_seed', label['seed'])}"
    return Case(label["protocol"], pack, truth, comparison, has_overdispersion)


def fit_effect_weights(cases: Sequence[Case]) -> FloatArray:
    """Return the weights that make the true causes most probable, given that there is one."""
    known = [
        (classifier.effect_features(case.comparison), at)
        for case in cases
        if (at := index_of_cause(case)) >= 0
    ]

    def loss(weights: FloatArray) -> tuple[float, FloatArray]:
        total, slope = 0.0, np.zeros_like(weights)
        for features, at in known:
            utility = features @ weights
            chances = np.exp(utility - utility.max())
            chances /= chances.sum()
            total -= np.log(chances[at] + 1e-300)
            slope -= features[at] - chances @ features
        n = len(known)
        return total / n + RIDGE * weights @ weights, slope / n + 2.0 * RIDGE * weights

    return minimum_of(loss, len(classifier.EFFECT_WEIGHTS))


def index_of_cause(case: Case) -> int:
    """Return the index of the cause among the effects, −1 if it is not among them."""
    names = [each.score.effect_id for each in case.comparison.effects]
    return names.index(case.truth) if case.truth in names else -1


def ranked(case: Case, effect_weights: FloatArray) -> tuple[list[str], FloatArray, FloatArray]:
    """Return the effects, best first, their shares, and the presence features of the best."""
    effects, shares = classifier.rank_effects(case.comparison, effect_weights)
    names = [each.score.effect_id for each in effects]
    features = classifier.presence_features(case.comparison, effects[0], float(shares[0]))
    return names, shares, features


def fit_presence_weights(cases: Sequence[Case], effect_weights: FloatArray) -> FloatArray:
    """Return the weights of "the best effect" and "another cause", shape (2, features)."""
    found = [ranked(case, effect_weights) for case in cases]
    features = np.array([each[2] for each in found])
    answers = np.array([class_of(case, each[0]) for case, each in zip(cases, found, strict=True)])
    counts = np.array([weight_of(case) for case in cases])
    mean, spread = features.mean(axis=0), features.std(axis=0)
    mean[0], spread[0] = 0.0, 1.0
    scaled, target = (features - mean) / spread, np.eye(3)[answers]

    def loss(flat: FloatArray) -> tuple[float, FloatArray]:
        weights = flat.reshape(2, -1)
        logits = np.column_stack([np.zeros(len(scaled)), scaled @ weights.T])
        chances = np.exp(logits - logits.max(axis=1, keepdims=True))
        chances /= chances.sum(axis=1, keepdims=True)
        error = ((chances - target) * counts[:, None])[:, 1:].T @ scaled / counts.sum()
        shrunk = weights * (np.arange(weights.shape[1]) > 0)  # all but the intercept
        total = -np.sum(counts * np.log(np.sum(chances * target, axis=1) + 1e-300)) / counts.sum()
        return total + RIDGE * np.sum(shrunk**2), (error + 2.0 * RIDGE * shrunk).ravel()

    weights = minimum_of(loss, 2 * features.shape[1]).reshape(2, -1) / spread
    weights[:, 0] -= (weights * mean)[:, 1:].sum(axis=1)
    return weights


def weight_of(case: Case) -> float:
    """Return the weight of a case in the fit of the presence weights."""
    return 1.0 if case.has_cause or case.truth == "none" else NO_CORRECT_EFFECT_WEIGHT


def class_of(case: Case, names: Sequence[str]) -> int:
    """Return the true class of a case whose effects are ranked."""
    if case.truth == "none":
        return NONE
    return BEST if names[0] == case.truth else ANOTHER


def minimum_of(loss: Callable[[FloatArray], tuple[float, FloatArray]], size: int) -> FloatArray:
    """Return the minimum of a convex loss, given with its gradient."""
    return np.asarray(minimize(loss, np.zeros(size), jac=True, method="L-BFGS-B").x)


def print_cross_validation(cases: Sequence[Case]) -> None:
    """Print the answers on packs held out of the fit."""
    packs = sorted({case.pack for case in cases})
    folds = np.random.default_rng(1).integers(FOLDS, size=len(packs))
    fold_of = dict(zip(packs, folds.tolist(), strict=True))
    by_protocol: dict[str, list[tuple[str, dict[str, float]]]] = {}
    for fold in range(FOLDS):
        training = [case for case in cases if fold_of[case.pack] != fold]
        effect_weights = fit_effect_weights(training)
        presence_weights = fit_presence_weights(training, effect_weights)
        for case in (case for case in cases if fold_of[case.pack] == fold):
            stated = answer(case, effect_weights, presence_weights)
            right = case.truth if case.truth in stated else "unknown"
            by_protocol.setdefault(case.protocol, []).append((right, stated))
    print(f"{'':28s}cases  top 1  alarms  false alarms  set holds  set size  p of truth  log score")
    for protocol, rows in sorted(by_protocol.items()):
        print(f"{protocol:28s}{len(rows):5d}", *(f"{each:>7s}" for each in shares_of(rows)))
    everything = [row for rows in by_protocol.values() for row in rows]
    largest = sorted(
        (max(p.values()), max(p, key=p.__getitem__) == right) for right, p in everything
    )
    for number, group in enumerate(np.array_split(np.array(largest), 8)):
        print(
            f"octile {number + 1}: stated {group[:, 0].mean():.2f},"
            f" correct {group[:, 1].mean():.2f}"
        )


def answer(
    case: Case, effect_weights: FloatArray, presence_weights: FloatArray
) -> dict[str, float]:
    """Return the probabilities of all answers by some weights."""
    effects, shares = classifier.rank_effects(case.comparison, effect_weights)
    features = classifier.presence_features(case.comparison, effects[0], float(shares[0]))
    logits = np.array([0.0, *(presence_weights @ features)])
    none, best, _ = np.exp(logits - logits.max()) / np.exp(logits - logits.max()).sum()
    found = Classification(effects, shares, float(none), float(best))
    return with_outside_prior(stated_probabilities(found))


def shares_of(rows: Sequence[tuple[str, dict[str, float]]]) -> list[str]:
    """Return the figures of a protocol as texts."""
    faulty = [row for row in rows if row[0] != "none"]
    healthy = [row for row in rows if row[0] == "none"]
    sets = [credible_set(stated) for _, stated in rows]
    of_truth = np.array([stated[right] for right, stated in rows])
    return [
        share([max(stated, key=stated.__getitem__) == right for right, stated in faulty]),
        share([stated["none"] <= ALARM_BELOW for _, stated in faulty]),
        share([stated["none"] <= ALARM_BELOW for _, stated in healthy]),
        share([right in found for (right, _), found in zip(rows, sets, strict=True)]),
        f"{np.mean([len(found) for found in sets]):.1f}",
        f"{of_truth.mean():.2f}",
        f"{np.log(np.maximum(of_truth, 1e-6)).mean():.2f}",
    ]


def share(flags: Sequence[bool]) -> str:
    """Return a share in per cent."""
    return f"{100.0 * sum(flags) / len(flags):.0f} %" if flags else "–"


if __name__ == "__main__":
    main()
