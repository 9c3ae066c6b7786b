"""Processor time of `cangauge fleet estimate` beside a loop of the same function.

    python benchmarks/fleet_cost.py [--logs 40] [--hours 0.5]

Prints seconds of processor time, all processes counted. The loop is one Python process; `fleet` has
a process for each core, and each imports the package.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import cangauge
from cangauge.logs.canonical import write_log

LOOP = """
import sys, cangauge
model = cangauge.Model.load(sys.argv[1])
for path in sys.argv[2:]:
    cangauge.estimate(path, model)
"""


def cpu_s(*command: object) -> float:
    """Run a command; return the processor time of it and its children [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *map(str, command)], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Write the logs, run both, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=40)
    parser.add_argument("--hours", type=float, default=0.5, help="of each log")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        logs = [folder / f"drive{number}.parquet" for number in range(options.logs)]
        for number, path in enumerate(logs):
            write_log(cangauge.simulate(seed=3, drive=number, hours=options.hours).log, path)
        model = folder / "type.json"
        cangauge.fit(logs[:3], capacity_ah=60.0).model.save(model)
        loop_s = cpu_s("-c", LOOP, model, *logs)
        fleet_s = cpu_s(
            "-m", "cangauge", "fleet", "estimate", *logs, "-m", model, "-o", folder / "out.parquet"
        )
    print(f"| {options.logs} logs of {options.hours} h | processor time [s] |\n|---|---|")
    print(f"| a loop in one process | {loop_s:.1f} |\n| `fleet estimate` | {fleet_s:.1f} |")


if __name__ == "__main__":
    main()
