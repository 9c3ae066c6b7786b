"""Run what is too long for the suite, in parts of at most 35 minutes.

    python benchmarks/nightly.py [PART…] [--data FOLDER] [--socketcan COMMAND]

inputs   the tests of `tests/nightly`: any frames on the bus, damaged files, wrong use of commands
process  the service as a process: killed, stopped for ten minutes, disk or memory full, clock set
faults   the table of faults on a live bus
grade    the estimator on recorded packs, and the diagnosis on its frozen cases (need --data)
suite    the score cards of three gauges: our service, a counter, filterpy's filter
tests    what `make test` leaves out: tests marked nightly, and 300 examples of each property
         (20 there) that states no number of its own
lowest   the lowest versions that pyproject.toml allows
long     restarts by SIGKILL; load, timing and memory of the service; attacks on its page, status
         and MQTT
load     half an hour at 12,000 frames/s, or what a bare loop carries here: no loss, memory flat
vcan     ten minutes of the same on a real vcan0, and the gateway as a process, directly or in a
         guest (needs --socketcan)

Each part writes `out/nightly/PART.json`: state (passed, failed, skipped), reason, seconds and the
last lines of each of its commands. Exit status 1 if a part failed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console

ROOT = Path(__file__).resolve().parents[1]
LIMIT_S = 35 * 60.0
"""Longest part [s]."""
SHOWN_LINES = 60
OWN_GAUGE = (
    "run --interface {interface} --channel {channel} --bus-option port={port} -m {model}"
    " --initial-soc {soc} --time-source replay-clock"
)
PROCESSES = "tests/nightly/test_whole_processes.py"
AT_ONCE = "-n 3 --dist worksteal"
"""Ten minutes of one of these tests are idle: the others run meanwhile."""
GATEWAY = "-m socketcan tests/nightly/test_gateway_process.py"
VCAN = "--interface socketcan --channel vcan0 --minutes 10 --bare-minutes 1 --highest 12000"
LOAD = "--only loss --wanted 0.05 --highest 12000 --minutes 29 --bare-minutes 1"

console = Console(highlight=False)


def commands(data: Path | None, socketcan: str) -> dict[str, list[list[str]] | str]:
    """Return the commands of each part, or the reason for which it cannot run."""
    python = sys.executable
    bus = ["--socketcan", socketcan] if socketcan else []
    suite, bus_of = (
        ["-m", "cangauge", "judge", "--suite", "--"],
        ["{interface}", "{channel}", "{port}"],
    )
    missing = "no folder of recorded logs: --data FOLDER"
    return {
        "inputs": [[python, "-m", "pytest", "tests/nightly", f"--ignore={PROCESSES}"]],
        "process": [[python, "-m", "pytest", *AT_ONCE.split(), PROCESSES]],
        "faults": [[python, "-m", "faults", *bus]],
        "grade": [
            [python, "-m", "packs", "--data", str(data)],
            [python, "-m", "benchmarks.weights", "check", "--data", str(data)],
        ]
        if data is not None
        else missing,
        "suite": [
            [
                python,
                *suite,
                python,
                "examples/gauge_coulomb.py",
                *bus_of,
                "{capacity_ah}",
                "{soc}",
            ],
            [
                python,
                *suite,
                python,
                "examples/gauge_filterpy.py",
                *bus_of,
                "{model}",
                "{soc}",
            ],
            [python, *suite, python, "-m", "cangauge", *OWN_GAUGE.split()],
        ],
        "tests": [
            [python, "-m", "pytest", "-n", "auto", "--dist", "loadfile", "-m", "nightly", "tests"],
            [python, "-m", "pytest", "-m", "hypothesis", "--hypothesis-profile=nightly", "tests"],
        ],
        "lowest": [[".ci/lowest"]],
        "long": [
            [python, "benchmarks/restarts.py"],
            [python, "benchmarks/bus_load.py"],
            [python, "benchmarks/wall.py"],
        ],
        "load": [
            [python, "benchmarks/latency.py", *LOAD.split()],
        ],
        "vcan": [
            [*socketcan.split(), python, "benchmarks/latency.py", *VCAN.split()],
            [*socketcan.split(), python, "-m", "pytest", *GATEWAY.split()],
        ]
        if socketcan
        else "no command that provides SocketCAN: --socketcan COMMAND",
    }


def run(part: str, lines: list[list[str]] | str) -> dict[str, Any]:
    """Run the commands of a part until one fails; return what is written of it."""
    if isinstance(lines, str):
        return {"part": part, "state": "skipped", "reason": lines, "seconds": 0.0, "commands": []}
    environment = os.environ | {
        "PYTHONPATH": str(ROOT / "benchmarks"),
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    began, done, reason = time.monotonic(), [], ""
    for command in lines:
        left_s = LIMIT_S - (time.monotonic() - began)
        try:
            ended = subprocess.run(
                command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
                timeout=max(left_s, 1.0),
            )  # fmt: skip
            code, text = ended.returncode, ended.stdout + ended.stderr
        except subprocess.TimeoutExpired as error:
            code, text = -1, (error.stdout or b"").decode(errors="replace")
            reason = f"longer than {LIMIT_S / 60:.0f} min"
        done.append({"command": command[1:], "exit": code, "end": text.splitlines()[-SHOWN_LINES:]})
        if code:
            reason = reason or f"exit status {code}"
            break
    state = "failed" if reason else "passed"
    seconds = time.monotonic() - began
    return {"part": part, "state": state, "reason": reason, "seconds": seconds, "commands": done}


def main() -> int:
    """Run the chosen parts."""
    known = tuple(commands(None, ""))
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("parts", nargs="*", choices=[[], *known], metavar="PART")
    parser.add_argument("--data", type=Path, help="folder of the recorded logs")
    parser.add_argument("--socketcan", default="", help="command that provides vcan0")
    options = parser.parse_args()
    data = options.data if options.data is not None and options.data.is_dir() else None
    folder = ROOT / "out" / "nightly"
    folder.mkdir(parents=True, exist_ok=True)
    failed = 0
    for part in options.parts or known:
        console.print(f"{part}: at most {LIMIT_S / 60:.0f} min …")
        result = run(part, commands(data, options.socketcan)[part])
        (folder / f"{part}.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
        console.print(f"{part}: {result['state']} in {result['seconds']:.0f} s {result['reason']}")
        failed += result["state"] == "failed"
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
