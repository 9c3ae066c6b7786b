"""`cangauge gap` with `--plan` and `--add-test`: a plan to run, and what the test changed."""

from __future__ import annotations

import html
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from synthetic import synthetic_log

Run = Callable[..., object]


def drive(seed: int, start_pct: float, volts: float = 0.0) -> Log:
    log = synthetic_log(
        hours=0.25, start_pct=start_pct, end_pct=start_pct - 8.0, noise_v=0.5, seed=seed,
        name=f"drive {seed}",
    )  # fmt: skip
    return replace(log, voltage_v=log.voltage_v + volts)


@pytest.fixture(scope="module")
def command(made: Path, tmp_path_factory: pytest.TempPathFactory) -> list[object]:
    """`gap` on a log whose voltage reads 4 V too high, with references from 40 to 85 % SoC."""
    folder = tmp_path_factory.mktemp("drives")
    write_log(drive(21, 80.0, 4.0), folder / "trip.csv")
    words: list[object] = ["gap", folder / "trip.csv", "-m", made / "model.json"]
    for seed, start_pct in ((11, 85.0), (12, 70.0), (13, 55.0)):
        write_log(drive(seed, start_pct), folder / f"good{seed}.parquet")
        words += ["--reference", folder / f"good{seed}.parquet"]
    return words


def test_plan_goes_to_text_json_and_page(run: Run, command: list[object], tmp_path: Path) -> None:
    page = tmp_path / "gap.html"
    ran = run(*command, "--plan", "--report", page, "--json")
    assert ran.code == 0
    found = json.loads(ran.out)
    plan = found["plan"]
    gains = [step["gain"] for step in plan["steps"]]
    assert gains == sorted(gains, reverse=True)
    assert len(plan["between"]) == 2
    assert all(0.0 <= step["after"] <= 1.0 for step in plan["steps"])
    text = html.unescape(page.read_text(encoding="utf-8"))
    assert plan["steps"][0]["name"] in text


def test_added_test_reports_its_change(run: Run, command: list[object], tmp_path: Path) -> None:
    write_log(drive(22, 55.0, 4.0), tmp_path / "further.csv")
    ran = run(*command, "--add-test", tmp_path / "further.csv", "--json")
    assert ran.code == 0
    found = json.loads(ran.out)
    assert found["added_test"]["logs"] == ["further"]
    assert [log["name"] for log in found["inputs"]["logs"]] == ["trip", "further"]
    after = {item["effect"]: item["probability"] for item in found["cause"]["candidates"]}
    sensing = ("voltage_offset", "voltage_gain")
    before = found["added_test"]["before"]
    assert sum(after[name] for name in sensing) > sum(before[name] for name in sensing)
