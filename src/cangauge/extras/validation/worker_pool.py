"""Pool of diagnosing processes; each gets copies of a case's open files in an anonymous folder."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final

from cangauge._resources import THREADS

COMMAND: Final = (sys.executable, "-P", "-m", "cangauge.extras.validation.worker")
TIMEOUT_S: Final = 600.0
"""A longer diagnosis is stopped and counts as crashed [s]."""

_PASSED_ON: Final = (
    "PATH", "PYTHONPATH", "HOME", "LANG", "LC_ALL", "TMPDIR", "TEMP", "SYSTEMROOT",
    "LD_LIBRARY_PATH", "VIRTUAL_ENV",
)  # fmt: skip


@dataclass(frozen=True)
class Task:
    """One diagnosis to run.

    Parameters
    ----------
    id : str
    case : str
        Name of the folder with logs and model.
    protocol : str
    leave_out : tuple of str
        Effects to remove from the library.
    wants_model : bool
        Whether to return the extended model.
    """

    id: str
    case: str
    protocol: str
    leave_out: tuple[str, ...] = ()
    wants_model: bool = False


@dataclass(eq=False)
class _Worker:
    """One process, started on demand and again after a crash."""

    home: Path
    process: subprocess.Popen[str] | None = field(default=None)

    def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        process = self._running()
        if process.stdin is None or process.stdout is None:  # both are pipes
            return {"error": "the diagnosing process has no pipes"}
        timer = threading.Timer(TIMEOUT_S, process.kill)
        began = time.perf_counter()
        timer.start()
        try:
            process.stdin.write(json.dumps(request) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        finally:
            timer.cancel()
        if not line:
            code = process.wait()
            self.process = None
            seconds = time.perf_counter() - began
            return {"error": f"the diagnosing process ended with code {code}", "seconds": seconds}
        found: dict[str, Any] = json.loads(line)
        return found

    def _running(self) -> subprocess.Popen[str]:
        if self.process is None:
            self.process = subprocess.Popen(  # noqa: S603 - this very package
                COMMAND,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                encoding="utf-8",
                cwd=self.home,
                env=_environment(),
            )
        return self.process

    def stop(self) -> None:
        if self.process is None:
            return
        if self.process.stdin is not None:
            self.process.stdin.close()
        try:
            self.process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()


def _environment() -> dict[str, str]:
    """Return the environment of a diagnosing process: where Python is, one BLAS thread."""
    kept = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    return kept | dict.fromkeys(THREADS, "1")


def _request(task: Task, source: Path, home: Path) -> dict[str, Any]:
    """Copy the open files of a case to an empty folder and return the request for them."""
    listing = json.loads((source / "case.json").read_text(encoding="utf-8"))

    def copied(name: str) -> str:
        shutil.copyfile(source / name, home / name)
        return str(home / name)

    return {
        "model": copied("model.json"),
        "logs": [copied(name) for name in listing["logs"]],
        "references": [copied(name) for name in listing["references"]],
        "leave_out": list(task.leave_out),
        "extended": str(home / "extended.json") if task.wants_model else None,
    }


def diagnose_all(
    tasks: Sequence[Task], cases: Path, jobs: int
) -> Iterator[tuple[Task, dict[str, Any]]]:
    """Diagnose tasks; yield each with its answer in order of completion.

    Parameters
    ----------
    tasks : sequence of Task
    cases : Path
        Folder of the case folders.
    jobs : int
        Number of processes.
    """
    with tempfile.TemporaryDirectory(prefix="gap-") as top:
        workers = [_Worker(Path(top)) for _ in range(jobs)]
        free: SimpleQueue[_Worker] = SimpleQueue()
        for worker in workers:
            free.put(worker)

        def run(task: Task) -> dict[str, Any]:
            worker = free.get()
            home = Path(tempfile.mkdtemp(dir=top))
            try:
                found = worker.ask(_request(task, cases / task.case, home))
                if task.wants_model and "error" not in found:
                    text = (home / "extended.json").read_text(encoding="utf-8")
                    found["extended_model"] = json.loads(text)
            # Missing files of a kept case, a full disk, a truncated answer.
            except (OSError, ValueError) as error:
                return {"error": f"{type(error).__name__}: {error}"}
            else:
                return found
            finally:
                shutil.rmtree(home, ignore_errors=True)
                free.put(worker)

        try:
            with ThreadPoolExecutor(jobs) as pool:
                submitted = {pool.submit(run, task): task for task in tasks}
                try:
                    for future in as_completed(submitted):
                        yield submitted[future], future.result()
                finally:
                    for future in submitted:
                        future.cancel()
        finally:
            for worker in workers:
                worker.stop()
