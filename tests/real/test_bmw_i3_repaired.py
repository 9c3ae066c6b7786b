"""Real trips with `--effects auto`: one model meets every target."""

from __future__ import annotations

from pathlib import Path

import pytest
from rich.console import Console

from real_trips import CHECKED, checks, judge

pytestmark = [pytest.mark.real, pytest.mark.slow]


def test_one_model_meets_every_target(shared_data: Path) -> None:
    repaired = judge(shared_data / "bmw_i3", Console(quiet=True), ("auto",), CHECKED)
    assert repaired["effects"]
    assert [row for row in checks(repaired) if not row["met"]] == []
