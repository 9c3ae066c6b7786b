"""Fit the three numbers of `cangauge.diagnosis.posterior` to labelled cases, and judge them.

    cangauge gap-check --protocol real-bmw_i3 --per-effect 1 --healthy 8 --seed 101 --keep cases …
    python benchmarks/posterior_numbers.py cases…

Only cases of development seeds are accepted, with one cause of at least the size that the check
counts, or none. Each case whose cause is in the library is diagnosed a second time without it,
where `unknown` is right, with a quarter of its weight. Causes outside the library are judged, but
not part of the fit. Protocols weigh by the square root of their number of cases. The printed table
is cross-validated in four folds by pack.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import pickle
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

import cangauge
from cangauge._typing import FloatArray
from cangauge.diagnosis.posterior import (
    FITTED,
    NONE,
    UNKNOWN,
    Calibration,
    Evidence,
    evidence_of,
    posterior_of,
)
from cangauge.diagnosis.problem import build_problem
from cangauge.diagnosis.verdict import ALARM_BELOW, credible_set
from cangauge.extras.validation.score import LEAST_GAP
from cangauge.logs.read import read_log
from cangauge.model.effects.library import LIBRARY
from cangauge.model.model_file import Model

OUTSIDE_WEIGHT = 0.25
"""Weight of a case without its cause: one fault in four is assumed to be outside the library."""

LEAST_PROBABILITY = 1e-4
"""A miss counts as no less probable, so that no single case decides."""

FOLDS = 4


@dataclass(frozen=True, eq=False)
class Case:
    """Evidence on one case, and its true answer."""

    protocol: str
    pack: str
    truth: str
    evidence: Evidence
    again: bool = False
    """A case that is used a second time, without its cause in the library."""
    weight: float = 1.0


def main() -> None:
    """Read or diagnose the cases, fit the numbers, and print them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("folders", nargs="+", type=Path, help="kept by cangauge gap-check --keep")
    cases = [case for folder in parser.parse_args().folders for case in read_cases(folder)]
    counts = Counter(case.protocol for case in cases if not case.again)
    cases = [
        replace(
            case,
            weight=(OUTSIDE_WEIGHT if case.again else 1.0) * counts[case.protocol] ** -0.5,
        )
        for case in cases
    ]
    print_cross_validation(cases)
    print(fit(cases))


def read_cases(folder: Path) -> list[Case]:
    """Return the cases of a folder; evidence is cached in its subfolder `evidence`."""
    about = folder / "tasks.json"
    if about.exists() and json.loads(about.read_text(encoding="utf-8"))["final"]:
        sys.exit(f"{folder}: cases of final seeds must not be used for a fit")
    labels = json.loads((folder / "withheld" / "labels.json").read_text(encoding="utf-8"))["labels"]
    usable = [label for label in labels if "failed" not in label and len(label["effects"]) < 2]
    (folder / "evidence").mkdir(exist_ok=True)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    return [
        case
        for label in usable
        if not label["effects"] or label.get("gap_v", np.inf) >= LEAST_GAP * label["floor_v"]
        for case in read_label(label, folder)
    ]


def read_label(label: dict[str, Any], folder: Path) -> list[Case]:
    """Return the case, and the same without its cause in the library."""
    protocol, cause = label["protocol"], (label["effects"] or [NONE])[0]
    # Recorded cases, warm or cold, are of one pack for each data set.
    seed, data_set = label.get("world_seed"), protocol.partition("-")[2]
    pack = f"{protocol} {seed}" if seed is not None else data_set
    known = cause in LIBRARY
    truth = cause if known or cause == NONE else UNKNOWN
    cases = [Case(protocol, pack, truth, read_evidence(label["name"], folder))]
    if known:
        without = read_evidence(label["name"], folder, cause)
        cases.append(Case(protocol, pack, UNKNOWN, without, again=True))
    return cases


def read_evidence(name: str, folder: Path, *leave_out: str) -> Evidence:
    """Diagnose a case up to the evidence, or read it as this version of the package found it."""
    kept = folder / "evidence" / ".".join([name, *leave_out, sources_hash(), "pkl"])
    if not kept.exists():
        place = folder / "open" / name
        logs, references = (
            [read_log(path) for path in sorted(place.glob(f"{kind}_*.parquet"))]
            for kind in ("log", "reference")
        )
        model = Model.load(place / "model.json")
        problem = build_problem(logs, model, references, leave_out=leave_out)
        kept.write_bytes(pickle.dumps(evidence_of(problem)))
    return pickle.loads(kept.read_bytes())  # type: ignore[no-any-return]  # noqa: S301 - own cache


@cache
def sources_hash() -> str:
    """Return a short hash of the package's sources."""
    sources = sorted(Path(cangauge.__file__).parent.rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]


def fit(cases: Sequence[Case]) -> Calibration:
    """Return the numbers that make the true answers most probable."""
    cases = [case for case in cases if case.again or case.truth != UNKNOWN]
    weights = np.array([case.weight for case in cases])

    def loss(numbers: FloatArray) -> float:
        by = Calibration(float(np.exp(numbers[0])), float(numbers[1]), float(numbers[2]))
        of = [posterior_of(case.evidence, by).get(case.truth, 0.0) for case in cases]
        return -float(weights @ np.log(np.maximum(of, LEAST_PROBABILITY)) / weights.sum())

    start = [np.log(FITTED.tail), FITTED.log_none, FITTED.log_unknown]
    tail, none, unknown = minimize(loss, start, method="Nelder-Mead").x.tolist()
    return Calibration(float(np.exp(tail)), none, unknown)


def print_cross_validation(cases: Sequence[Case]) -> None:
    """Print the answers on packs held out of the fit."""
    packs = sorted({case.pack for case in cases})
    order = np.random.default_rng(1).permutation(len(packs)).tolist()
    fold_of = {pack: place % FOLDS for pack, place in zip(packs, order, strict=True)}
    by_protocol: dict[str, list[tuple[str, dict[str, float]]]] = {}
    for fold in range(FOLDS):
        training = [case for case in cases if fold_of[case.pack] != fold]
        left_out = [case for case in cases if fold_of[case.pack] == fold and not case.again]
        if not training or not left_out:
            continue
        by = fit(training)
        for case in left_out:
            by_protocol.setdefault(case.protocol, []).append(
                (case.truth, posterior_of(case.evidence, by))
            )
    head = "cases  top 1  alarms  false alarms  set holds  set size  p of truth  log score  misled"
    print(f"{'':24s}{head}")
    for protocol, rows in sorted(by_protocol.items()):
        print(f"{protocol:24s}{len(rows):5d}", *(f"{each:7.2f}" for each in shares_of(rows)))


def shares_of(rows: Sequence[tuple[str, dict[str, float]]]) -> list[float]:
    """Return top 1 of faults, alarms, false alarms, set coverage and size, p, log score, misled.

    The last is the part in which a wrong effect has a probability above one half.
    """
    faults = [row for row in rows if row[0] != NONE]
    healthy = [row for row in rows if row[0] == NONE]
    sets = [credible_set(of) for _, of in rows]
    truth = np.array([of.get(right, 0.0) for right, of in rows])
    return [
        _mean([max(of, key=of.__getitem__) == right for right, of in faults]),
        _mean([of[NONE] <= ALARM_BELOW for _, of in faults]),
        _mean([of[NONE] <= ALARM_BELOW for _, of in healthy]),
        _mean([right in chosen for (right, _), chosen in zip(rows, sets, strict=True)]),
        _mean([len(chosen) for chosen in sets]),
        float(truth.mean()),
        float(np.log(np.maximum(truth, LEAST_PROBABILITY)).mean()),
        _mean(
            [
                max(of[name] for name in of if name not in {NONE, UNKNOWN, right}) > 0.5
                for right, of in rows
            ]
        ),
    ]


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else float("nan")


if __name__ == "__main__":
    main()
