"""`cangauge demo`: a new user's first command."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from live import in_process


@pytest.mark.nightly
def test_the_demo_ends_with_the_filter_ahead(tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "cangauge", "demo", "--folder", str(tmp_path), "--json"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    result = json.loads(ended.stdout)
    # Published: 0.25 % and 2.5 %.
    assert result["fit_voltage_mae_pct"] == pytest.approx(0.25, abs=0.005)
    assert result["fit_soc_newton_mae_pct"] < 2.5
    assert result["live_soc_mae_pct"] < result["live_soc_newton_mae_pct"]
    assert result["live_soc_mae_pct"] < result["live_soc_coulomb_mae_pct"]
    assert result["live_cover_2sigma"] > 0.9
    assert result["live_minus_offline_pct"] <= result["quantisation_bound_pct"]
    assert (tmp_path / "soc.html").stat().st_size > 100_000
    assert (tmp_path / "fit.html").stat().st_size > 100_000


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    ended = in_process("demo", "--folder", tmp_path / "file")
    assert ended.code == 2
    assert "--folder: cannot create this folder" in ended.err
    assert ended.err.count("\n") == 1
