"""The script behind the measured tables of docs/logs.md and docs/captures.md, on short drives."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.nightly

PROJECT = Path(__file__).parents[2]


@pytest.mark.parametrize("kind", ["CARBUS trace", "UTF-16 text"])
def test_from_file_to_soc_plot_in_three_commands(tmp_path: Path, kind: str) -> None:
    ended = subprocess.run(
        [sys.executable, PROJECT / "examples" / "own_data.py", tmp_path, "--kind", kind,
         "--hours", "0.3"],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    commands = [line for line in ended.stdout.splitlines() if line.startswith("  cangauge ")]
    assert len(commands) == 3
    assert "soc_mae_pct" in ended.stdout
    page = next(tmp_path.glob("*/soc.html")).read_text(encoding="utf-8")
    assert "State of charge of trip" in page
