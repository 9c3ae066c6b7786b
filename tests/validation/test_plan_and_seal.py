"""What is drawn, under which seeds and names; sealing."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import pytest

from cangauge.errors import InputError
from cangauge.validation.cases import EFFECTS, FULL, Sizes, plan
from cangauge.validation.check import LABELS, seal, unseal

SIMULATED = {"simulated": FULL["simulated"]}


def test_the_full_check_has_twenty_of_each_effect_and_300_healthy() -> None:
    cases = [case for group in plan(SIMULATED, seed=1, final=False) for case in group.cases]
    counts = Counter(case.effects for case in cases)
    assert counts[()] == 300
    assert {effect: counts[effect,] for effect in EFFECTS} == dict.fromkeys(EFFECTS, 20)
    assert len({case.name for case in cases}) == len(cases) == 700


def test_final_and_development_seeds_never_meet() -> None:
    def seeds(final: bool, seed: int) -> set[int]:
        groups = plan(SIMULATED, seed=seed, final=final)
        return {g.world_seed for g in groups} | {c.seed for g in groups for c in g.cases}

    development = set().union(*(seeds(False, number) for number in range(5)))
    assert all(value % 2 == 0 for value in development)
    assert all(value % 2 == 1 for value in seeds(True, 1))
    assert seeds(False, 1) != seeds(False, 2)


def test_names_and_order_tell_nothing() -> None:
    groups = plan({"simulated": Sizes(per_effect=4, healthy=80)}, seed=3, final=False)
    cases = [case for group in groups for case in group.cases]
    by_name = [bool(case.effects) for case in sorted(cases, key=lambda case: case.name)]
    by_order = [bool(case.effects) for case in cases]
    for flags in (by_name, by_order):
        # Of 160 in random order about half of the first half are healthy (5 σ is 16).
        assert 24 <= sum(flags[:80]) <= 56


def test_the_same_seed_plans_the_same() -> None:
    assert plan(FULL, seed=4, final=False) == plan(FULL, seed=4, final=False)


def test_sealed_causes_come_back_only_untouched(tmp_path: Path) -> None:
    labels = [{"name": "b", "effects": []}, {"name": "a", "effects": ["hysteresis"]}]
    sha256 = seal(labels, tmp_path)
    assert unseal(tmp_path, sha256)["a"]["effects"] == ["hysteresis"]
    path = tmp_path / LABELS
    path.write_text(path.read_text().replace("hysteresis", "capacity"))
    with pytest.raises(InputError, match="hash"):
        unseal(tmp_path, sha256)


def test_the_hash_is_of_the_causes_alone(tmp_path: Path) -> None:
    labels = [{"name": "a", "effects": []}, {"name": "b", "effects": ["capacity"]}]
    (tmp_path / "x").mkdir()
    (tmp_path / "y").mkdir()
    assert seal(labels, tmp_path / "x") == seal(labels[::-1], tmp_path / "y")
    assert json.loads((tmp_path / "x" / LABELS).read_text())["labels"] == labels
