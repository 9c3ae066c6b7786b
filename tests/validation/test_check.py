"""A small withheld check end to end: drawn, diagnosed, scored, kept and scored again."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from cangauge.cli.app import main
from cangauge.extras.validation.check import diagnose_tasks, draw_all, load_files, score_answers
from cangauge.extras.validation.plan import EFFECTS, Sizes, plan

SIZES = {"simulated": Sizes(per_effect=1, healthy=1, effects=1)}
ABOUT = {"seed": 5, "final": False}


def no_progress(_number: int) -> None:
    """Progress callback."""


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kept")
    groups = plan(SIZES, seed=5, final=False)
    draw_all(groups, folder, data=None, jobs=1, open_set=1, about=ABOUT, progress=no_progress)
    return folder


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "cangauge", "gap-check", *arguments],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def ran(kept: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    page = tmp_path_factory.mktemp("page") / "check.html"
    done = command("--cases", str(kept), "--jobs", "1", "--json", "--report", str(page))
    assert done.returncode == 0, done.stderr
    return {"json": json.loads(done.stdout), "stderr": done.stderr, "page": page.read_text()}


def test_open_files_reveal_no_cause(kept: Path) -> None:
    # Healthy and faulty cases share the model.
    assert len({path.read_bytes() for path in (kept / "open").glob("*/model.json")}) == 1
    for path in (kept / "open").rglob("*"):
        content = path.read_bytes() if path.is_file() and path.name != "model.json" else b""
        content = content.replace(b"capacity_ah", b"")
        assert not any(effect.encode() in content for effect in EFFECTS), path
    assert sorted(path.name for path in (kept / "withheld").iterdir()) == ["labels.json"]


def test_case_folder_holds_logs_and_model(kept: Path) -> None:
    for place in (kept / "open").iterdir():
        assert {path.name for path in place.iterdir()} == {
            "case.json", "model.json", "training_1.parquet", "reference_1.parquet",
            "reference_2.parquet", "reference_3.parquet", "log_1.parquet",
        }  # fmt: skip
        for path in place.glob("*.parquet"):
            assert set(pq.read_table(path).column_names) == {
                "time_s", "current_a", "voltage_v", "temperature_c", "soc_pct",
            }  # fmt: skip


def test_labels_have_floors_and_gaps(kept: Path) -> None:
    labels = json.loads((kept / "withheld" / "labels.json").read_text())["labels"]
    assert len(labels) == 2
    for label in labels:
        # The error of a 13-coefficient model exceeds that of the sensors.
        assert label["floor_sensor_v"] < label["floor_v"] < 0.05 * label["pack"]["nominal_v"]
        if label["effects"]:
            assert 0.45 <= label["gap_v"] / label["floor_v"] <= 5.5


def test_every_case_and_the_open_set_are_diagnosed(ran: dict[str, Any]) -> None:
    result = ran["json"]
    protocols = [item["protocol"] for item in result["cases"]]
    assert sorted(protocols) == ["open-set", "open-set", "simulated", "simulated"]
    assert result["crashed"] == []
    left_out = [item for item in result["cases"] if item["truth"] and item["leave_out"]]
    assert [item["truth"] == item["leave_out"] for item in left_out].count(True) == 1
    for item in result["cases"]:
        assert not set(item["leave_out"]) & {item["verdict"], *item["ranked"]}
        assert 0.0 < item["seconds"] < 120.0
    assert result["cost"]["peak_mib"] is None or 50.0 < result["cost"]["peak_mib"]["max"] < 1024.0


def test_hash_is_printed_before_the_diagnosis(ran: dict[str, Any]) -> None:
    stderr = ran["stderr"]
    assert stderr.index(ran["json"]["labels_sha256"]) < stderr.index("diagnosing")


def test_page_shows_matrix_reliability_and_targets(ran: dict[str, Any]) -> None:
    for words in (
        "Verdict against truth",
        "Reliability",
        "Detection by size of the gap",
        "false alarms",
    ):
        assert words in ran["page"]
    assert "default-src 'none'" in ran["page"]


def test_kept_answers_have_the_same_scores(kept: Path, ran: dict[str, Any]) -> None:
    again = command("--cases", str(kept), "--score-only", "--json")
    assert again.returncode == 0, again.stderr
    for key in ("protocols", "reliability", "cases"):
        assert json.loads(again.stdout)[key] == ran["json"][key]


def test_interrupted_check_is_scored(
    kept: Path, ran: dict[str, Any], capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    path = kept / "answers.jsonl"
    before = path.read_text()
    # Interrupted in the last line.
    path.write_text("".join(before.splitlines(keepends=True)[:3]) + '{"task": "task_0')
    monkeypatch.setattr(
        sys, "argv", ["cangauge", "gap-check", "--cases", str(kept), "--score-only", "--json"]
    )
    try:
        with pytest.raises(SystemExit) as left:
            main()
    finally:
        path.write_text(before)
    assert left.value.code == 0
    printed = capsys.readouterr()
    assert len(json.loads(printed.out)["cases"]) == 3
    assert "3 of 4" in printed.err


def test_another_diagnosis_keeps_earlier_answers(kept: Path, ran: dict[str, Any]) -> None:
    path = kept / "answers.jsonl"
    before = path.read_text()
    assert diagnose_tasks(load_files(kept), (), 1, no_progress) == {}
    aside = kept / "answers-1.jsonl"
    assert aside.read_text() == before
    assert not path.read_text()
    aside.rename(path)


def test_undrawn_cases_count_in_their_protocol(tmp_path: Path) -> None:
    groups = plan({"real-lg_hg2": Sizes(healthy=1)}, seed=1, final=False)
    drawn = draw_all(
        groups, tmp_path, data=None, jobs=1, open_set=0, about=ABOUT, progress=no_progress
    )
    assert len(score_answers(drawn, (), {})) == 1
    assert len(score_answers(drawn, (), {}, ["real-lg_hg2"])) == 1
    assert not score_answers(drawn, (), {}, ["simulated"])


def test_changed_label_is_refused(kept: Path, ran: dict[str, Any]) -> None:
    path = kept / "withheld" / "labels.json"
    before = path.read_text()
    path.write_text(before.replace('"seed"', '"Seed"', 1))
    try:
        done = command("--cases", str(kept), "--score-only")
    finally:
        path.write_text(before)
    assert done.returncode == 2
    assert "labels changed" in done.stderr


def test_seed_determines_causes_and_tasks(kept: Path, tmp_path: Path) -> None:
    groups = plan(SIZES, seed=5, final=False)
    again = draw_all(
        groups, tmp_path, data=None, jobs=1, open_set=1, about=ABOUT, progress=no_progress
    )
    assert again.sha256 == load_files(kept).sha256
    assert again.tasks == load_files(kept).tasks


def test_undrawn_case_is_listed_as_a_crash(tmp_path: Path) -> None:
    # Missing recorded logs.
    groups = plan({"real-lg_hg2": Sizes(healthy=1)}, seed=1, final=False)
    draw_all(groups, tmp_path, data=None, jobs=1, open_set=0, about=ABOUT, progress=no_progress)
    done = command("--cases", str(tmp_path), "--json")
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["crashed"]) == 1
    assert "lg_hg2" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--protocol", "imagined"), "unknown protocol"),
        (("--part", "huge"), "unknown part"),
        (("--protocol", "real-lg_hg2"), "--data"),
        (("--final", "--seed", "3"), "final seeds are fixed"),
        (("--cases", "nowhere"), "no cases"),
        (("--cases", "nowhere", "--protocol", "imagined"), "unknown protocol"),
        (("--cases", "nowhere", "--per-effect", "2"), "drawn already"),
        (("--score-only",), "--cases"),
    ],
)
def test_invalid_options_are_refused_first(
    arguments: tuple[str, ...],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["cangauge", "gap-check", *arguments])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    assert words in capsys.readouterr().err


@pytest.mark.real
@pytest.mark.slow
def test_laboratory_case_of_hysteresis(shared_data: Path, tmp_path: Path) -> None:
    groups = plan({"hysteresis-a123_lfp": Sizes(laboratory=1)}, seed=1, final=False)
    draw_all(
        groups, tmp_path, data=shared_data, jobs=1, open_set=0, about=ABOUT, progress=no_progress
    )
    (label,) = json.loads((tmp_path / "withheld" / "labels.json").read_text())["labels"]
    assert label["effects"] == ["hysteresis"]
    # The model of the drives fits the discharge: 13 mV of 3.3 V.
    assert label["floor_v"] < 0.02
