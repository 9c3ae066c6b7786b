"""How long `cangauge gap` takes on the slowest cases of a check, one at a time.

    python -m cangauge gap-check --protocol simulated --keep cases …
    python benchmarks/gap_time.py cases --slowest 10

A check diagnoses several cases side by side, and writes down how long each took. Here the slowest
of them are diagnosed again, each by the command itself with nothing beside it: start of Python,
reading of the logs and the estimator's two runs included.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import track
from rich.table import Table


@dataclass(frozen=True)
class Run:
    """One diagnosis."""

    case: str
    logs: int
    references: int
    seconds_beside: float
    """As the check measured it, others running beside it."""
    seconds: float
    peak_mib: float


def main() -> None:
    """Find the slowest, run them, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("folders", type=Path, nargs="+", help="what `gap-check --keep` kept")
    parser.add_argument("--slowest", type=int, default=10, help="so many of each folder")
    asked = parser.parse_args()
    table = Table(title="The slowest cases again, one at a time")
    headings = ("check", "case", "logs", "references", "then [s]", "alone [s]", "peak [MiB]")
    for heading in headings:
        table.add_column(heading, justify="right")
    for folder in asked.folders:
        slowest = _slowest(folder, asked.slowest)
        runs = [_run(folder / "open" / case, then) for case, then in track(slowest, folder.name)]
        for run in sorted(runs, key=lambda run: -run.seconds):
            table.add_row(
                folder.name, run.case, str(run.logs), str(run.references),
                f"{run.seconds_beside:.1f}", f"{run.seconds:.1f}", f"{run.peak_mib:.0f}",
            )  # fmt: skip
        table.add_section()
    Console(width=100).print(table)


def _slowest(folder: Path, count: int) -> list[tuple[str, float]]:
    """Return the cases that took longest with the whole library, and how long [s]."""
    tasks = {
        task["id"]: task
        for task in json.loads((folder / "tasks.json").read_text(encoding="utf-8"))["tasks"]
        if not task["leave_out"]
    }
    lines = (folder / "answers.jsonl").read_text(encoding="utf-8").splitlines()
    answers = [answer for line in lines if (answer := json.loads(line))["task"] in tasks]
    answers.sort(key=lambda answer: -answer["seconds"])
    return [(tasks[each["task"]]["case"], each["seconds"]) for each in answers[:count]]


def _run(case: Path, seconds_beside: float) -> Run:
    told = json.loads((case / "case.json").read_text(encoding="utf-8"))
    command = [sys.executable, "-m", "cangauge", "gap", *told["logs"], "-m", "model.json"]
    for reference in told["references"]:
        command += ["--reference", reference]
    began = time.perf_counter()
    process = subprocess.Popen(
        [*command, "--json"], cwd=case, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - began
    if status != 0:
        raise SystemExit(f"{case.name}: `{' '.join(command[1:])}` failed")
    return Run(
        case=case.name,
        logs=len(told["logs"]),
        references=len(told["references"]),
        seconds_beside=seconds_beside,
        seconds=seconds,
        peak_mib=usage.ru_maxrss / 1024.0,
    )


if __name__ == "__main__":
    main()
