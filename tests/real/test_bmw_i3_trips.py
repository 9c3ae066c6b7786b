"""Real trips: capacity from the training trips; the figures are those of `benchmarks/packs`."""

from __future__ import annotations

from pathlib import Path

import pytest
from rich.console import Console

from real_trips import CHECKED, judge

pytestmark = [pytest.mark.real, pytest.mark.slow]


@pytest.fixture(scope="module")
def result(shared_data: Path) -> dict[str, object]:
    return judge(shared_data / "bmw_i3", Console(quiet=True), chains=CHECKED)


def test_capacity_comes_from_the_training_trips(result: dict[str, object]) -> None:
    assert result["capacity_ah"] == pytest.approx(61.73, abs=0.05)


def test_chain_lasts_at_least_three_hours(result: dict[str, object]) -> None:
    assert result["chain_hours"] >= 3.0
