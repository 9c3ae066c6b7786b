"""Real trips: the figures of `benchmarks/real_trips.py` meet their targets."""

from __future__ import annotations

from pathlib import Path

import pytest
from rich.console import Console

from real_trips import CHECKED, checks, judge

pytestmark = [pytest.mark.real, pytest.mark.slow]

MISSED = {"given: 2σ coverage ≤"}
"""Documented: there the band is too wide (99.03 %)."""


@pytest.fixture(scope="module")
def result(shared_data: Path) -> dict[str, object]:
    return judge(shared_data / "bmw_i3", Console(quiet=True), chains=CHECKED)


def test_every_target_but_the_known_miss_is_met(result: dict[str, object]) -> None:
    missed = {f"{row['name']} {row['sign']}" for row in checks(result) if not row["met"]}
    assert missed == MISSED


def test_capacity_comes_from_the_training_trips(result: dict[str, object]) -> None:
    assert result["capacity_ah"] == pytest.approx(61.73, abs=0.05)


def test_chain_lasts_at_least_three_hours(result: dict[str, object]) -> None:
    assert result["chain_hours"] >= 3.0
