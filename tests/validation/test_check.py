"""The whole check in small: drawn, sealed, diagnosed apart, scored; kept and scored again."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from cangauge.cli.app import main
from cangauge.validation.cases import EFFECTS, Sizes, plan
from cangauge.validation.check import diagnose_tasks, draw_all, drawn_before, outcomes_of

SIZES = {"simulated": Sizes(per_effect=1, healthy=1, effects=1)}
ABOUT = {"seed": 5, "final": False}


def nothing(_number: int) -> None:
    """Stand in for a progress bar."""


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kept")
    groups = plan(SIZES, seed=5, final=False)
    draw_all(groups, folder, data=None, jobs=1, open_set=1, about=ABOUT, progress=nothing)
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


def test_what_the_diagnosis_gets_names_no_cause(kept: Path) -> None:
    # The model comes from the clean days that healthy and faulty cases share.
    assert len({path.read_bytes() for path in (kept / "open").glob("*/model.json")}) == 1
    for path in (kept / "open").rglob("*"):
        content = path.read_bytes() if path.is_file() and path.name != "model.json" else b""
        content = content.replace(b"capacity_ah", b"")
        assert not any(effect.encode() in content for effect in EFFECTS), path
    assert sorted(path.name for path in (kept / "sealed").iterdir()) == ["labels.json"]


def test_the_model_is_fitted_on_clean_days_and_the_floor_is_measured(kept: Path) -> None:
    labels = json.loads((kept / "sealed" / "labels.json").read_text())["labels"]
    assert len(labels) == 2
    for label in labels:
        # What a 13-coefficient model misses is more than the sensors' noise, less than a mess.
        assert label["floor_sensor_v"] < label["floor_v"] < 0.05 * label["pack"]["nominal_v"]
        if label["effects"]:
            assert 0.45 <= label["gap_v"] / label["floor_v"] <= 5.5


def test_every_case_is_diagnosed_and_the_open_set_too(ran: dict[str, Any]) -> None:
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


def test_the_hash_is_shown_before_the_diagnosis(ran: dict[str, Any]) -> None:
    stderr = ran["stderr"]
    assert stderr.index(ran["json"]["labels_sha256"]) < stderr.index("diagnosing")


def test_the_page_shows_matrix_reliability_and_targets(ran: dict[str, Any]) -> None:
    for words in ("What was said of what", "Reliability", "By size of the gap", "false alarms"):
        assert words in ran["page"]
    assert "default-src 'none'" in ran["page"]


def test_kept_answers_score_the_same(kept: Path, ran: dict[str, Any]) -> None:
    again = command("--cases", str(kept), "--score-only", "--json")
    assert again.returncode == 0, again.stderr
    for key in ("protocols", "reliability", "cases"):
        assert json.loads(again.stdout)[key] == ran["json"][key]


def test_a_check_that_was_stopped_is_scored_as_far_as_it_came(
    kept: Path, ran: dict[str, Any], capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    path = kept / "answers.jsonl"
    before = path.read_text()
    # Stopped while it wrote the last line.
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
    said = capsys.readouterr()
    assert len(json.loads(said.out)["cases"]) == 3
    assert "3 of 4" in said.err


def test_another_diagnosis_of_kept_cases_puts_the_answers_aside(
    kept: Path, ran: dict[str, Any]
) -> None:
    path = kept / "answers.jsonl"
    before = path.read_text()
    assert diagnose_tasks(drawn_before(kept), (), 1, nothing) == {}
    aside = kept / "answers-1.jsonl"
    assert aside.read_text() == before
    assert not path.read_text()
    aside.rename(path)


def test_cases_that_could_not_be_drawn_count_where_they_are_asked_for(tmp_path: Path) -> None:
    groups = plan({"real-lg_hg2": Sizes(healthy=1)}, seed=1, final=False)
    drawn = draw_all(groups, tmp_path, data=None, jobs=1, open_set=0, about=ABOUT, progress=nothing)
    assert len(outcomes_of(drawn, (), {})) == 1
    assert len(outcomes_of(drawn, (), {}, ["real-lg_hg2"])) == 1
    assert not outcomes_of(drawn, (), {}, ["simulated"])


def test_a_changed_label_is_refused(kept: Path, ran: dict[str, Any]) -> None:
    path = kept / "sealed" / "labels.json"
    before = path.read_text()
    path.write_text(before.replace('"seed"', '"Seed"', 1))
    try:
        done = command("--cases", str(kept), "--score-only")
    finally:
        path.write_text(before)
    assert done.returncode == 2
    assert "sealed file" in done.stderr


def test_the_same_seed_draws_the_same_causes(kept: Path, tmp_path: Path) -> None:
    groups = plan(SIZES, seed=5, final=False)
    again = draw_all(groups, tmp_path, data=None, jobs=1, open_set=1, about=ABOUT, progress=nothing)
    assert again.sha256 == drawn_before(kept).sha256
    assert again.tasks == drawn_before(kept).tasks


def test_what_cannot_be_drawn_is_listed_as_a_crash(tmp_path: Path) -> None:
    # Recorded logs that are not there.
    groups = plan({"real-lg_hg2": Sizes(healthy=1)}, seed=1, final=False)
    draw_all(groups, tmp_path, data=None, jobs=1, open_set=0, about=ABOUT, progress=nothing)
    done = command("--cases", str(tmp_path), "--json")
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["crashed"]) == 1
    assert "lg_hg2" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--protocol", "imagined"), "no such protocol"),
        (("--part", "huge"), "no such part"),
        (("--protocol", "real-lg_hg2"), "--data"),
        (("--final", "--seed", "3"), "final seeds are fixed"),
        (("--cases", "nowhere"), "no cases"),
        (("--cases", "nowhere", "--protocol", "imagined"), "no such protocol"),
        (("--cases", "nowhere", "--per-effect", "2"), "drawn already"),
        (("--score-only",), "--cases"),
    ],
)
def test_nonsense_is_refused_before_any_work(
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
def test_a_slow_charge_of_an_lfp_cell_shows_hysteresis_alone(
    shared_data: Path, tmp_path: Path
) -> None:
    groups = plan({"hysteresis-a123_lfp": Sizes(physical=1)}, seed=1, final=False)
    draw_all(groups, tmp_path, data=shared_data, jobs=1, open_set=0, about=ABOUT, progress=nothing)
    (label,) = json.loads((tmp_path / "sealed" / "labels.json").read_text())["labels"]
    assert label["effects"] == ["hysteresis"]
    # On the discharge the model of the drives is good: 13 mV of 3.3 V.
    assert label["floor_v"] < 0.02
