"""Time of `cangauge gap` on the slowest cases of a check, one at a time.

    python -m cangauge gap-check --protocol simulated --keep cases …
    python benchmarks/gap_time.py cases --slowest 10

A check diagnoses several cases in parallel and records their times. The slowest are diagnosed again
by the command, one at a time, including the start of Python and the reading of the logs.
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
    seconds_in_check: float
    """Time in the check, in parallel with others [s]."""
    seconds: float
    peak_mib: float


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("folders", type=Path, nargs="+", help="folder of `gap-check --keep`")
    parser.add_argument("--slowest", type=int, default=10, help="cases of each folder")
    options = parser.parse_args()
    table = Table(title="The slowest cases again, one at a time")
    headings = ("check", "case", "logs", "references", "in check [s]", "alone [s]", "peak [MiB]")
    for heading in headings:
        table.add_column(heading, justify="right")
    for folder in options.folders:
        slowest = _slowest(folder, options.slowest)
        runs = [
            _run(folder / "open" / case, before_s) for case, before_s in track(slowest, folder.name)
        ]
        for run in sorted(runs, key=lambda run: -run.seconds):
            table.add_row(
                folder.name, run.case, str(run.logs), str(run.references),
                f"{run.seconds_in_check:.1f}", f"{run.seconds:.1f}", f"{run.peak_mib:.0f}",
            )  # fmt: skip
        table.add_section()
    Console(width=100).print(table)


def _slowest(folder: Path, count: int) -> list[tuple[str, float]]:
    """Return the slowest cases with the whole library, with their times [s]."""
    tasks = {
        task["id"]: task
        for task in json.loads((folder / "tasks.json").read_text(encoding="utf-8"))["tasks"]
        if not task["leave_out"]
    }
    lines = (folder / "answers.jsonl").read_text(encoding="utf-8").splitlines()
    answers = [answer for line in lines if (answer := json.loads(line))["task"] in tasks]
    answers.sort(key=lambda answer: -answer["seconds"])
    return [(tasks[each["task"]]["case"], each["seconds"]) for each in answers[:count]]


def _run(case: Path, seconds_in_check: float) -> Run:
    listing = json.loads((case / "case.json").read_text(encoding="utf-8"))
    command = [sys.executable, "-m", "cangauge", "gap", *listing["logs"], "-m", "model.json"]
    for reference in listing["references"]:
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
        logs=len(listing["logs"]),
        references=len(listing["references"]),
        seconds_in_check=seconds_in_check,
        seconds=seconds,
        peak_mib=usage.ru_maxrss / 1024.0,
    )


if __name__ == "__main__":
    main()
