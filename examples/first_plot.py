"""Measure the time from a clean clone to the first SoC plot of one's own logs.

    python examples/first_plot.py                             # three simulated drives
    python examples/first_plot.py a.csv b.csv c.csv --capacity-ah 60

Clones this checkout into a temporary folder, installs it into a fresh environment, fits a model to
all logs but the last, and estimates that one. Prints the seconds of each step and their sum; where
that is far above the time of computing, the machine or the network was busy with something else.
Exit code 1 if a step fails or the sum is over the goal.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

GOAL_S = 90.0
"""A reader's patience, as the project states it [s]."""


def write_as_a_logger(path: Path, drive: int) -> Path:
    """Write a simulated drive under headings, units and a sign that are not cangauge's own."""
    import cangauge

    log = cangauge.simulate(seed=5, drive=drive, hours=1.0).log
    assert log.soc_pct is not None
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, delimiter=";")
        table.writerow(["Zeit [ms]", "I_Batt [mA]", "U_Batt [V]", "T1 [°C]", "SoC [%]"])
        columns = (1e3 * log.time_s, -1e3 * log.current_a, log.voltage_v, log.temperature_c)
        table.writerows(zip(*columns, log.soc_pct, strict=True))
    return path


def main() -> int:
    """Run the steps and print their times; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("logs", nargs="*", type=Path, help="your logs; the last is estimated")
    parser.add_argument("--capacity-ah", default="from-soc", help="of the pack, or from-soc")
    parser.add_argument("--keep", type=Path, default=Path("soc.html"), help="the page to write")
    options = parser.parse_args()
    if len(options.logs) == 1:
        parser.error("give two logs at least: one to fit, one to estimate")
    project = Path(__file__).resolve().parent.parent
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        logs = [path.resolve() for path in options.logs] or [
            write_as_a_logger(folder / f"drive{number}.csv", number) for number in (1, 2, 3)
        ]
        clone, environment, model = folder / "clone", folder / "env", folder / "pack.json"
        programs = environment / ("Scripts" if sys.platform == "win32" else "bin")
        cangauge, page = programs / "cangauge", options.keep.resolve()
        capacity = ("--capacity-ah", options.capacity_ah)
        table = folder / "soc.csv"
        steps: dict[str, tuple[object, ...]] = {
            "clone": ("git", "clone", "--quiet", "--depth", "1", project.as_uri(), clone),
            "environment": (sys.executable, "-m", "venv", environment),
            "install": (programs / "python", "-m", "pip", "install", "--quiet", f"{clone}[report]"),
            "inspect": (cangauge, "inspect", logs[-1]),
            "fit": (cangauge, "fit", *logs[:-1], "-o", model, *capacity),
            "estimate": (
                cangauge,
                "estimate",
                logs[-1],
                "-m",
                model,
                "-o",
                table,
                "--report",
                page,
            ),
        }
        total_s = 0.0
        for step, command in steps.items():
            begin_s = time.monotonic()
            done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
            seconds = time.monotonic() - begin_s
            total_s += seconds
            print(f"{step:12}{seconds:6.1f} s", flush=True)
            if done.returncode:
                print(done.stderr, file=sys.stderr)
                return 1
    used = os.times()
    busy_s = used.children_user + used.children_system
    print(f"{'together':12}{total_s:6.1f} s, {busy_s:.0f} s of them computing", end="")
    print(f" (goal: under {GOAL_S:.0f} s); plot: {page}")
    return int(total_s > GOAL_S)


if __name__ == "__main__":
    sys.exit(main())
