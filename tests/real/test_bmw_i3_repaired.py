"""Real trips with the structure that `--effects auto` repairs: one model meets every target."""

from __future__ import annotations

from pathlib import Path

import pytest
from rich.console import Console

from real_trips import CHECKED, checks, judge

pytestmark = [pytest.mark.real, pytest.mark.slow]


def test_every_target_is_met_by_the_one_model(shared_data: Path) -> None:
    repaired = judge(shared_data / "bmw_i3", Console(quiet=True), ("auto",), CHECKED)
    assert repaired["effects"]
    assert [row for row in checks(repaired) if not row["met"]] == []
