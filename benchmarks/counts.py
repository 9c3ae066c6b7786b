"""What cangauge costs in counts that do not depend on the machine's load, against those kept.

    python benchmarks/counts.py [--keep]

instructions   of a wanted frame, an unwanted one, a reading of the latest estimate and a row
               offline (compiled), and of the start of two commands, by callgrind; left out without
memory [MiB]   peak of importing the service, of `cangauge --help`, and of `inspect` of 200 rows
modules        imported by the service and by `cangauge --help`

Exit status 1 if a count is 20 % above the kept one. `--keep` writes them to `counts.json`.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import can
import numpy as np
from rich.table import Table

from cangauge._resources import shared_file
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.pipeline import Pipeline
from figures import publish

HERE: Final = Path(__file__).parent
KEPT: Final = HERE / "counts.json"
WORSE: Final = 1.2
"""Factor on a kept count from which the check fails."""
TIMES: Final = {
    "wanted frame": 10_000,
    "unwanted frame": 100_000,
    "reading of the latest estimate": 50_000,
    "row offline": 1_000_000,
}
"""Counted work → its repetitions: together some 4e8 instructions, ten times what two starts of the
same process differ by."""
START: Final = "import sys; from cangauge.cli.app import main; main()"
SERVICE: Final = "import cangauge.service.run"
PEAK: Final = "\nprint([x for x in open('/proc/self/status') if 'VmHWM' in x][0].split()[1])"
"""Print the peak memory of the process [KiB] (Linux)."""
MODULES: Final = "\nimport sys; print(len(sys.modules))"


def drive(rows: int) -> Log:
    """Return a drive at 10 Hz."""
    time_s = 0.1 * np.arange(float(rows))
    current_a = 20.0 + 10.0 * np.sin(time_s)
    return Log(time_s, current_a, 380.0 - 0.1 * current_a, np.full(rows, 23.0))


def work(name: str, times: int) -> None:
    """Do a work so many times, after a preparation that is the same for all works."""
    encoder = FrameEncoder(Vehicle.load("generic"))
    frames = [
        frame
        for sample in samples_of(drive(TIMES["wanted frame"]))
        for frame in encoder.encode(sample)
    ]
    other = can.Message(arbitration_id=0x7A5, is_extended_id=False, data=bytes(8))
    model = Model.load(shared_file("replay", "leaf2012_published_model.json"))
    pipeline = Pipeline(Vehicle.load("generic"), model)
    for frame in frames[:3]:
        pipeline.handle(frame)
    if name == "row offline":
        run_estimator(drive(times), model, EstimatorSettings())
    for place in range(times):
        if name == "wanted frame":
            pipeline.handle(frames[place])
        elif name == "unwanted frame":
            pipeline.handle(other)
        elif name == "reading of the latest estimate":
            pipeline.latest  # noqa: B018 - the reading is what is counted


def callgrind(code: str, *arguments: str) -> int:
    """Return the instructions of a Python process."""
    command = ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null", sys.executable]
    run = subprocess.run(
        [*command, "-c", code, *arguments],
        env=os.environ | {"PYTHONHASHSEED": "0", "PYTHONPATH": str(HERE)},
        capture_output=True,
        text=True,
        check=True,
    )
    found = re.search(r"Collected : (\d+)", run.stderr)
    if found is None:
        raise SystemExit(f"callgrind counts nothing: {run.stderr[-400:]}")
    return int(found[1])


def instructions() -> dict[str, int]:
    """Return instructions by work and by start."""
    code = "import sys, counts; counts.work(sys.argv[1], int(sys.argv[2]))"
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        before = pool.submit(callgrind, code, "row offline", "2")
        after = {
            name: pool.submit(callgrind, code, name, str(times)) for name, times in TIMES.items()
        }
        starts = {
            f"start of cangauge {name}": pool.submit(callgrind, START, *name.split())
            for name in ("--help", "run --help")
        }
    found = {
        name: (after[name].result() - before.result()) // times for name, times in TIMES.items()
    }
    return found | {name: start.result() for name, start in starts.items()}


def printed(code: str, *arguments: str) -> int:
    """Return the last number that a Python process prints."""
    command = [sys.executable, "-c", code, *arguments]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    return int(run.stdout.split()[-1])


def others() -> dict[str, int]:
    """Return memory [MiB] and modules."""
    whole = f"import atexit\natexit.register(lambda: exec({PEAK!r}))\n{START}"
    modules = f"import atexit\natexit.register(lambda: exec({MODULES!r}))\n{START}"
    with TemporaryDirectory() as folder:
        log = Path(folder, "log.csv")
        write_log(drive(200), log)
        inspect = ("inspect", str(log))
        return {
            "memory of importing the service [MiB]": printed(SERVICE + PEAK) // 1024,
            "memory of cangauge --help [MiB]": printed(whole, "--help") // 1024,
            "memory of cangauge inspect, 200 rows [MiB]": printed(whole, *inspect) // 1024,
            "modules of the service": printed(SERVICE + MODULES),
            "modules of cangauge --help": printed(modules, "--help"),
        }


def main() -> int:
    """Count, print, keep or compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--keep", action="store_true", help=f"write the counts to {KEPT.name}")
    options = parser.parse_args()
    found = others()
    if shutil.which("valgrind"):
        found = instructions() | found
    else:
        sys.stderr.write("instructions are left out: valgrind is not installed\n")
    kept = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}
    table = Table("count", "now", "stored")
    for name, count in found.items():
        table.add_row(name, f"{count:,}", f"{kept[name]:,}" if name in kept else "–")
    if options.keep:
        KEPT.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    publish("counts", [table], ["src/cangauge", "core"], keeps=options.keep)
    lines = worse(found, kept)
    sys.stderr.writelines(f"{line}\n" for line in lines)
    return 1 if lines and not options.keep else 0


def worse(found: dict[str, int], kept: dict[str, int]) -> list[str]:
    """Return a line for each count that is too far above the kept one."""
    return [
        f"{name}: {count:,}, more than 20 % above {kept[name]:,}"
        for name, count in found.items()
        if count > WORSE * kept.get(name, count)
    ]


if __name__ == "__main__":
    sys.exit(main())
