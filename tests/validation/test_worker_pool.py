"""Diagnosing processes: their inputs, crashes and timeouts."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cangauge.extras.validation import worker_pool
from cangauge.extras.validation.plan import EFFECTS
from cangauge.extras.validation.worker_pool import Task, diagnose_all

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
    received = {
        "argv": sys.argv, "environment": dict(os.environ), "cwd": os.getcwd(), "line": line,
        "files": {str(path): path.read_text() for path in home.iterdir()}, "pid": os.getpid(),
    }
    print(json.dumps({"received": received}), flush=True)
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
    withheld = tmp_path / "kept" / "withheld"
    withheld.mkdir()
    (withheld / "labels.json").write_text("hysteresis")
    return folder


@pytest.fixture
def ask(
    cases: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., dict[str, dict[str, Any]]]:
    spy = tmp_path / "spy.py"
    spy.write_text(SPY)
    monkeypatch.setattr(worker_pool, "COMMAND", (sys.executable, str(spy)))
    monkeypatch.setenv("GAP_TRUTH", "hysteresis")

    def run(*tasks: Task, jobs: int = 1) -> dict[str, dict[str, Any]]:
        return {task.id: answer for task, answer in diagnose_all(tasks, cases, jobs)}

    return run


def test_process_gets_logs_and_model_only(
    ask: Callable[..., dict[str, dict[str, Any]]], cases: Path
) -> None:
    task = Task("task_1", "case_0", "simulated")
    received = ask(task)["task_1"]["received"]
    everything = json.dumps(received)
    for effect in EFFECTS:
        assert effect not in everything
    # Neither origin, name and protocol of the case, nor the folder of the labels.
    for secret in (str(cases.parent), "withheld", "case_0", "task_1", "simulated"):
        assert secret not in everything
    assert json.loads(received["line"]).keys() == {
        "model", "logs", "references", "leave_out", "extended",
    }  # fmt: skip
    assert {Path(path).name for path in received["files"]} == {
        "model.json", "log_1.parquet", "reference_1.parquet",
    }  # fmt: skip
    assert received["environment"]["OMP_NUM_THREADS"] == "1"


def test_folder_is_removed_afterwards(ask: Callable[..., dict[str, dict[str, Any]]]) -> None:
    received = ask(Task("a", "case_0", "simulated"))["a"]["received"]
    assert not Path(received["cwd"]).exists()
    assert not any(Path(path).exists() for path in received["files"])


def test_crashed_process_is_replaced(
    ask: Callable[..., dict[str, dict[str, Any]]],
) -> None:
    first, bad, last = (Task(f"t{k}", f"case_{n}", "simulated") for k, n in enumerate((0, 1, 3)))
    found = ask(first, bad, last)
    assert "code 3" in found["t1"]["error"]
    assert found["t0"]["received"]["pid"] != found["t2"]["received"]["pid"]


def test_hanging_process_is_stopped(
    ask: Callable[..., dict[str, dict[str, Any]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_pool, "TIMEOUT_S", 1.0)
    found = ask(Task("a", "case_2", "simulated"), Task("b", "case_0", "simulated"))
    assert "ended" in found["a"]["error"]
    assert "received" in found["b"]


def test_several_processes_share_the_tasks(ask: Callable[..., dict[str, dict[str, Any]]]) -> None:
    tasks = [Task(f"t{k}", f"case_{k % 2 * 3}", "simulated") for k in range(12)]
    found = ask(*tasks, jobs=2)
    assert len(found) == 12
    assert len({answer["received"]["pid"] for answer in found.values()}) <= 2


def test_case_without_files_is_a_crash(ask: Callable[..., dict[str, dict[str, Any]]]) -> None:
    found = ask(Task("a", "case_9", "simulated"), Task("b", "case_0", "simulated"))
    assert "error" in found["a"]
    assert "received" in found["b"]
