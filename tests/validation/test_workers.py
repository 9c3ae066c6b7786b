"""Diagnosing processes: what they are told, and that a dead one is replaced."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cangauge.validation import workers
from cangauge.validation.cases import EFFECTS
from cangauge.validation.workers import Task, diagnose_all

SPY = """
import json, os, sys
from pathlib import Path
for line in sys.stdin:
    request = json.loads(line)
    home = Path(request["model"]).parent
    text = Path(request["logs"][0]).read_text()
    if text == "die":
        os._exit(3)
    if text == "hang":
        import time
        time.sleep(60)
    told = {
        "argv": sys.argv, "environment": dict(os.environ), "cwd": os.getcwd(), "line": line,
        "files": {str(path): path.read_text() for path in home.iterdir()}, "pid": os.getpid(),
    }
    print(json.dumps({"told": told}), flush=True)
"""


@pytest.fixture
def cases(tmp_path: Path) -> Path:
    folder = tmp_path / "kept" / "open"
    for number, text in enumerate(("fine", "die", "hang", "fine")):
        place = folder / f"case_{number}"
        place.mkdir(parents=True)
        for name in ("model.json", "training_1.parquet", "reference_1.parquet"):
            (place / name).write_text("{}")
        (place / "log_1.parquet").write_text(text)
        listing = {"logs": ["log_1.parquet"], "references": ["reference_1.parquet"]}
        (place / "case.json").write_text(json.dumps(listing))
    sealed = tmp_path / "kept" / "sealed"
    sealed.mkdir()
    (sealed / "labels.json").write_text("hysteresis")
    return folder


@pytest.fixture
def ask(
    cases: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., dict[str, dict[str, Any]]]:
    spy = tmp_path / "spy.py"
    spy.write_text(SPY)
    monkeypatch.setattr(workers, "COMMAND", (sys.executable, str(spy)))
    monkeypatch.setenv("GAP_TRUTH", "hysteresis")

    def run(*tasks: Task, jobs: int = 1) -> dict[str, dict[str, Any]]:
        return {task.id: answer for task, answer in diagnose_all(tasks, cases, jobs)}

    return run


def test_the_process_is_told_of_logs_and_model_alone(
    ask: Callable[..., dict[str, dict[str, Any]]], cases: Path
) -> None:
    task = Task("task_1", "case_0", "simulated")
    told = ask(task)["task_1"]["told"]
    everything = json.dumps(told)
    for effect in EFFECTS:
        assert effect not in everything
    # Neither where the case came from, nor its name or protocol, nor the sealed folder.
    for secret in (str(cases.parent), "sealed", "case_0", "task_1", "simulated"):
        assert secret not in everything
    assert json.loads(told["line"]).keys() == {
        "model", "logs", "references", "leave_out", "extended",
    }  # fmt: skip
    assert {Path(path).name for path in told["files"]} == {
        "model.json", "log_1.parquet", "reference_1.parquet",
    }  # fmt: skip
    assert told["environment"]["OMP_NUM_THREADS"] == "1"


def test_its_folder_is_gone_afterwards(ask: Callable[..., dict[str, dict[str, Any]]]) -> None:
    told = ask(Task("a", "case_0", "simulated"))["a"]["told"]
    assert not Path(told["cwd"]).exists()
    assert not any(Path(path).exists() for path in told["files"])


def test_one_that_dies_is_a_crash_and_the_next_case_goes_on(
    ask: Callable[..., dict[str, dict[str, Any]]],
) -> None:
    first, bad, last = (Task(f"t{k}", f"case_{n}", "simulated") for k, n in enumerate((0, 1, 3)))
    found = ask(first, bad, last)
    assert "code 3" in found["t1"]["error"]
    assert found["t0"]["told"]["pid"] != found["t2"]["told"]["pid"]


def test_one_that_hangs_is_stopped(
    ask: Callable[..., dict[str, dict[str, Any]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "LONGEST_S", 1.0)
    found = ask(Task("a", "case_2", "simulated"), Task("b", "case_0", "simulated"))
    assert "ended" in found["a"]["error"]
    assert "told" in found["b"]


def test_several_processes_share_the_work(ask: Callable[..., dict[str, dict[str, Any]]]) -> None:
    tasks = [Task(f"t{k}", f"case_{k % 2 * 3}", "simulated") for k in range(12)]
    found = ask(*tasks, jobs=2)
    assert len(found) == 12
    assert len({answer["told"]["pid"] for answer in found.values()}) <= 2


def test_a_case_without_files_is_a_crash(ask: Callable[..., dict[str, dict[str, Any]]]) -> None:
    found = ask(Task("a", "case_9", "simulated"), Task("b", "case_0", "simulated"))
    assert "error" in found["a"]
    assert "told" in found["b"]
