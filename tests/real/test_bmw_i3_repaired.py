"""Real trips with `--effects auto`: one model meets every target but the documented ones."""

from __future__ import annotations

from pathlib import Path

import pytest
from rich.console import Console

from real_trips import CHECKED, checks, judge

pytestmark = [pytest.mark.real, pytest.mark.slow]


MISSED = {"chain_offset: 2σ coverage ≥", "chain_capacity_low: 2σ coverage ≥"}
"""Documented: over hours of chained trips the band is too narrow (81 %, at least 90 %)."""


def test_one_model_meets_every_other_target(shared_data: Path) -> None:
    repaired = judge(shared_data / "bmw_i3", Console(quiet=True), ("auto",), CHECKED)
    assert repaired["effects"]
    assert {f"{row['name']} {row['sign']}" for row in checks(repaired) if not row["met"]} == MISSED
