"""`cangauge gap` with `--plan` and `--add-test`: a plan to run, and what the test changed."""

from __future__ import annotations

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
        hours=0.4, start_pct=start_pct, end_pct=start_pct - 12.0, noise_v=0.5, seed=seed,
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


def test_plan_goes_to_text_file_json_and_page(
    run: Run, command: list[object], tmp_path: Path
) -> None:
    profile, page = tmp_path / "test.csv", tmp_path / "gap.html"
    ran = run(*command, "--plan-file", profile, "--limits", "current=0:60,minutes=10",
              "--report", page, "--json")  # fmt: skip
    assert ran.code == 0
    found = json.loads(ran.out)["plan"]
    assert found["file"] == str(profile)
    assert found["sentence"] in page.read_text(encoding="utf-8").replace("&#39;", "'")
    assert found["limits"]["discharge_a"] == 60.0
    gained = [test["information_nats"] for test in found["tests"]]
    assert gained == sorted(gained, reverse=True)
    assert found["probability_expected"] >= found["probability_now"] - 0.02
    lines = profile.read_text(encoding="utf-8").splitlines()
    assert len(lines) == 2 + 10 * 60
    assert f"start at {found['start_soc_pct']:.0f} % SoC" in lines[1]
    currents = [float(line.split(",")[1]) for line in lines[1:]]
    assert min(currents) == 0.0
    assert max(currents) <= 60.0


def test_added_test_reports_its_change(run: Run, command: list[object], tmp_path: Path) -> None:
    write_log(drive(22, 55.0, 4.0), tmp_path / "further.csv")
    ran = run(*command, "--add-test", tmp_path / "further.csv", "--json")
    assert ran.code == 0
    found = json.loads(ran.out)
    before, after = found["added_test"]["before"], found["added_test"]["after"]
    assert found["added_test"]["logs"] == ["further"]
    assert [log["name"] for log in found["inputs"]["logs"]] == ["trip", "further"]
    assert after["probabilities"]["voltage_offset"] == next(
        item["probability"] for item in found["cause"]["candidates"]
        if item["effect"] == "voltage_offset"
    )  # fmt: skip
    sensing = ("voltage_offset", "voltage_gain")
    assert sum(after["probabilities"][name] for name in sensing) > sum(
        before["probabilities"][name] for name in sensing
    )


@pytest.mark.parametrize("given", ["current=lots", "current=60:-60", "current=0:0", "soc=50:50.5"])
def test_limits_are_checked_before_the_logs_are_read(
    run: Run, command: list[object], given: str
) -> None:
    ran = run(*command, "--limits", given)
    assert ran.code == 2
    assert given in ran.err
    assert "--limits" in ran.err
    assert "learning" not in ran.err
