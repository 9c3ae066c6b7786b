"""Planned cases and their seeds; labels are accepted unchanged only."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from pathlib import Path

import pytest

from cangauge.errors import InputError
from cangauge.extras.validation.check import LABELS, read_labels, write_labels
from cangauge.extras.validation.final_seeds import FINAL_SEED
from cangauge.extras.validation.plan import EFFECTS, FULL, Group, Sizes, plan

SIMULATED = {"simulated": FULL["simulated"]}


def test_full_check_has_20_per_effect_and_300_healthy() -> None:
    cases = [case for group in plan(SIMULATED, seed=1, final=False) for case in group.cases]
    counts = Counter(case.effects for case in cases)
    assert counts[()] == 300
    assert {effect: counts[effect,] for effect in EFFECTS} == dict.fromkeys(EFFECTS, 20)
    assert len({case.name for case in cases}) == len(cases) == 700


def seeds_of(groups: tuple[Group, ...]) -> set[int]:
    return {g.scenario_seed for g in groups} | {c.seed for g in groups for c in g.cases}


def test_final_and_development_seeds_are_disjoint() -> None:
    development = set().union(
        *(seeds_of(plan(SIMULATED, seed=number, final=False)) for number in range(5))
    )
    assert all(value % 2 == 0 for value in development)
    assert all(value % 2 == 1 for value in seeds_of(plan(SIMULATED, seed=1, final=True)))
    assert plan(SIMULATED, seed=1, final=False) != plan(SIMULATED, seed=2, final=False)


def test_final_seeds_are_frozen() -> None:
    groups = plan(FULL, seed=FINAL_SEED, final=True)
    content = json.dumps(
        [
            [
                group.protocol,
                group.scenario_seed,
                [[c.name, c.seed, c.effects] for c in group.cases],
            ]
            for group in groups
        ]
    )
    assert (
        hashlib.sha256(content.encode()).hexdigest()
        == "70ffd81ee8049fabb65e2d4aa5b2065b89b90b220fa9ccae392c1ccfb1c7923d"
    )


def test_names_and_order_reveal_nothing() -> None:
    groups = plan({"simulated": Sizes(per_effect=4, healthy=80)}, seed=3, final=False)
    cases = [case for group in groups for case in group.cases]
    by_name = [bool(case.effects) for case in sorted(cases, key=lambda case: case.name)]
    by_order = [bool(case.effects) for case in cases]
    for flags in (by_name, by_order):
        # Of 160 in random order about half of the first half are healthy (5 σ is 16).
        assert 24 <= sum(flags[:80]) <= 56


def test_seed_determines_the_plan() -> None:
    assert plan(FULL, seed=4, final=False) == plan(FULL, seed=4, final=False)


def test_changed_labels_are_refused(tmp_path: Path) -> None:
    labels = [{"name": "b", "effects": []}, {"name": "a", "effects": ["hysteresis"]}]
    sha256 = write_labels(labels, tmp_path)
    assert read_labels(tmp_path, sha256)["a"]["effects"] == ["hysteresis"]
    path = tmp_path / LABELS
    path.write_text(path.read_text().replace("hysteresis", "capacity"))
    with pytest.raises(InputError, match="hash"):
        read_labels(tmp_path, sha256)


def test_hash_depends_on_the_causes_alone(tmp_path: Path) -> None:
    labels = [{"name": "a", "effects": []}, {"name": "b", "effects": ["capacity"]}]
    (tmp_path / "x").mkdir()
    (tmp_path / "y").mkdir()
    assert write_labels(labels, tmp_path / "x") == write_labels(labels[::-1], tmp_path / "y")
    assert json.loads((tmp_path / "x" / LABELS).read_text())["labels"] == labels
