"""`cangauge gap`: JSON, files, texts, refusals; a plan of tests, and what an added test changed."""

from __future__ import annotations

import html
from dataclasses import replace
from pathlib import Path

import pytest

from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from live import in_process, refused, succeeds
from synthetic import synthetic_log


def drive(seed: int, start_pct: float, extra_v: float = 0.0) -> Log:
    end_pct = start_pct - 20.0
    log = synthetic_log(hours=0.6, start_pct=start_pct, end_pct=end_pct, noise_v=0.5, seed=seed)
    return replace(log, voltage_v=log.voltage_v + extra_v, name=f"drive {seed}")


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with three drives without a fault, and one on which the voltage reads 8 V too high."""
    folder = tmp_path_factory.mktemp("drives")
    for seed in (11, 12, 13):
        write_log(drive(seed, 85.0), folder / f"good{seed}.parquet")
    write_log(drive(21, 85.0, 8.0), folder / "trip.csv")
    return folder


@pytest.fixture
def faulty(made: Path, drives: Path) -> list[object]:
    """`gap` on the drive with the fault, beside the others."""
    references = sorted(drives.glob("good*.parquet"))
    words: list[object] = ["gap", drives / "trip.csv", "-m", made / "model.json"]
    return words + [word for path in references for word in ("--reference", path)]


def test_json_report_plan_and_a_model_that_runs(
    faulty: list[object], drives: Path, tmp_path: Path
) -> None:
    better, page = tmp_path / "better.json", tmp_path / "gap.html"
    options = ("--plan", "--extended", better, "--report", page, "--json")
    found = succeeds(*faulty, *options).json
    assert found["schema"] == 4
    assert found["faults"][0]["fault"] == "voltage_reading"
    assert found["correction"] == {"accepted": True, "why_not": None, "path": str(better)}
    step = found["next_step"]
    assert step["between"][0] == "voltage_reading"
    assert 0.0 <= step["probability_now"] <= step["probability_after"] <= 1.0
    text = html.unescape(page.read_text(encoding="utf-8"))
    answer = found["answer"]
    assert answer["text"].splitlines()[0] in text
    assert answer["check_first"] in answer["text"]
    assert f"Corrected model: {better}" in answer["text"]
    assert "How far it shrinks" in text
    assert [entry["id"] for entry in Model.load(better).effects]
    succeeds("estimate", drives / "trip.csv", "-m", better, "-o", tmp_path / "soc.csv")


def test_an_added_test_reports_its_change(faulty: list[object], tmp_path: Path) -> None:
    write_log(drive(21, 85.0, 4.0), tmp_path / "trip.csv")
    write_log(drive(22, 84.0, 4.0), tmp_path / "further.csv")
    again = ("gap", tmp_path / "trip.csv", *faulty[2:])
    found = succeeds(*again, "--add-test", tmp_path / "further.csv", "--json").json
    assert found["added_test"]["logs"] == ["further"]
    assert [log["name"] for log in found["inputs"]["logs"]] == ["trip", "further"]
    assert found["gap"]["on"] == "left-out log"
    assert found["faults"][0]["fault"] == "voltage_reading"
    before = found["added_test"]["before"]
    assert set(before) == {"none", *(item["fault"] for item in found["faults"])}
    assert before["voltage_reading"] == max(before.values())


def test_text_begins_with_the_answer(made: Path, drives: Path, tmp_path: Path) -> None:
    given = (drives / "good11.parquet", "-m", made / "model.json")
    ran = succeeds("gap", *given, "--extended", tmp_path / "same.json")
    assert not (tmp_path / "same.json").exists()
    assert "no corrected model: no fault is stated" in ran.err
    assert ran.out.startswith("No significant gap")
    assert "P(no fault) " in ran.out
    assert "Without references" in ran.out
    table = {line.split()[0] for line in ran.out.splitlines() if line.strip()}
    assert {"voltage", "current", "wrong", "capacity", "clock", "weak"} <= table


def test_the_alarm_is_a_choice_of_the_user(made: Path, drives: Path) -> None:
    given = ("gap", drives / "good11.parquet", "-m", made / "model.json", "--json", "--alarm")
    never, always = (succeeds(*given, alarm).json["answer"] for alarm in ("0", "1"))
    assert never["level"] != "gap"
    assert always["level"] == "gap"
    assert never["probability_none"] == always["probability_none"]
    assert in_process(*given, "2").code == 2


def test_a_log_that_is_its_own_reference_or_too_short_is_refused(
    made: Path, faulty: list[object], drives: Path, tmp_path: Path
) -> None:
    options = ("--reference", drives / "trip.csv", "--extended", tmp_path / "never.json")
    refused(in_process(*faulty, *options), "trip.csv", "either as LOG or as reference")
    assert not (tmp_path / "never.json").exists()
    write_log(drive(21, 80.0).rows(slice(0, 60)), tmp_path / "stub.csv")
    ran = in_process("gap", tmp_path / "stub.csv", "-m", made / "model.json")
    refused(ran, "too short for a diagnosis")


def test_an_output_that_cannot_be_written_is_refused_before_a_log_is_read(
    made: Path, tmp_path: Path
) -> None:
    given = ("gap", tmp_path / "missing.csv", "-m", made / "model.json", "--extended")
    refused(in_process(*given, tmp_path / f"{'a' * 250}.json"), "the file name is too long")
    refused(in_process(*given, tmp_path / "nowhere" / "better.json"), "does not exist")
    refused(in_process(*given, "/proc/better.json"), "error: ")
