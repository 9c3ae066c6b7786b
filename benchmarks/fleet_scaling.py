"""Time and processor time of `cangauge fleet` with 1 and 2 workers, and what a million logs cost.

    python benchmarks/fleet_scaling.py [--logs 600] [--hours 0.5]

Prints for `fit` and `estimate`: logs a second by the wall clock, and processor time a log of all
processes, both without the start of the cluster, and how much faster two workers are. The wall
clock depends on what else the machine does, processor time hardly does. 600 logs take about a
minute and a half on two idle cores; with few logs the start of the cluster, which is subtracted,
hides them.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from cangauge.extras.validation.cases import Scenario, draw_scenario
from fleet_twins import write_fleet

SEED = 5
MILLION = 1_000_000
EURO_PER_CORE_HOUR = 0.04
"""List price of one virtual core on demand, general purpose, in a European region [€/h]; spot
prices are a third."""


def main() -> None:
    """Run every command with 1 and 2 workers; print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=600, help="logs, ten a vehicle")
    parser.add_argument("--hours", type=float, default=0.5, help="of each log")
    options = parser.parse_args()
    scenario = draw_scenario(SEED)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        write_fleet(scenario, root / "logs", options.logs // 10, 10, options.hours)
        size = sum(path.stat().st_size for path in root.rglob("*.parquet")) / options.logs
        sys.stdout.write(f"{options.logs} logs of {options.hours} h, {size / 1e3:.0f} kB each\n")
        walls: dict[tuple[str, int], float] = {}
        for workers in (1, 2):
            fitted = root / f"fit{workers}"
            spent = {"fit": _timed(root, "fit", scenario, workers, fitted)}
            # Starts the cluster, and finds every log known.
            empty = _timed(root, "fit", scenario, workers, fitted)
            out = root / f"estimate{workers}"
            spent["estimate"] = _timed(root, "estimate", scenario, workers, out)
            for command, each in spent.items():
                walls[command, workers] = each[0] - empty[0]
                _print(command, workers, options.logs, each, empty)
        for command in ("fit", "estimate"):
            gain = walls[command, 1] / walls[command, 2]
            sys.stdout.write(f"{command:9}2 workers are {gain:.2f} times as fast as 1\n")


def _print(
    command: str, workers: int, logs: int, spent: tuple[float, float], empty: tuple[float, float]
) -> None:
    wall_s, per_log_s = spent[0] - empty[0], (spent[1] - empty[1]) / logs
    hours = MILLION * per_log_s / 3600.0
    sys.stdout.write(
        f"{command:9}{workers} workers  {logs / wall_s:6.2f} logs/s  {per_log_s:6.3f} s CPU a log"
        f"  {hours:7.0f} core hours and € {EURO_PER_CORE_HOUR * hours:.2f} for 10⁶ logs\n"
    )
    sys.stdout.flush()


def _timed(
    root: Path, command: str, scenario: Scenario, workers: int, out: Path
) -> tuple[float, float]:
    """Return wall clock and processor time of a run with all its processes [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began = time.monotonic()
    _run(root, command, scenario, workers, out)
    wall_s = time.monotonic() - began
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall_s, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def _run(root: Path, command: str, scenario: Scenario, workers: int, out: Path) -> None:
    logs, model = f"{root}/logs/*/*.parquet", str(root / "type.json")
    arguments = ["fleet", command, logs, "-m", model, "-o", str(out)]
    if command == "fit":
        arguments += ["--capacity-ah", str(scenario.pack.capacity_ah)]
    subprocess.run(
        [sys.executable, "-m", "cangauge", *arguments, "--workers", str(workers), "--json"],
        check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip


if __name__ == "__main__":
    main()
