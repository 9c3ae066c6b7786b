"""Inject faults on a live bus and print a table of the results.

    make faults
    PYTHONPATH=benchmarks python -m faults [--only NAME]… [--bus udp|vcan|both]

Prints the estimated time first, each verdict as soon as it is known, and the table at the end.
Writes each row to `out/faults/BUS.jsonl`. Exit status 1 if a fault failed, or if no run could be
judged.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import time
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

from rich.console import Console

from cangauge.bus.open import has_socketcan
from faults.catalogue import EVERYTHING, ON_ANY_BUS, ON_UDP, ON_VCAN
from faults.criteria import Row, show
from faults.fault import Fault
from faults.line import udp, vcan
from faults.process import prepare
from faults.run import Jobs, Result, run_all, seconds

ERR = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)
ROWS: Final = Path(__file__).resolve().parents[2] / "out" / "faults"
LIMIT_S: Final = 25 * 60.0
"""Time after which no run of a bus begins [s]; a part of the nightly has 35 min."""


def main() -> int:
    """Run the faults and print the table."""
    options = _options()
    if options.list:
        for name, fault in EVERYTHING.items():
            sys.stdout.write(f"{name}: {fault.description}\n")
        return 0
    chosen = _chosen(options.only)
    on_vcan = None
    if options.bus == "both" and options.socketcan:
        on_vcan = _start_on_vcan(options, chosen)
    prepare()
    rows: list[Row] = []
    if options.bus in {"udp", "both"}:
        rows += _run("udp", [fault for fault in ON_UDP if fault.name in chosen], options)
    if options.bus == "vcan" or (options.bus == "both" and not options.socketcan):
        with_any = options.only and options.bus == "vcan"
        on_bus = [*ON_ANY_BUS, *ON_VCAN] if with_any else ON_VCAN
        faults = list({fault.name: fault for fault in on_bus if fault.name in chosen}.values())
        rows += _run("vcan", faults, options)
    failed = sum(row.verdict is not None and not row.verdict.passed for row in rows)
    unjudged = sum(row.verdict is None for row in rows)
    console = Console(width=max(Console().width, 170))
    show(rows, console)
    console.print(
        f"{len(rows)} runs: {len(rows) - failed - unjudged} passed, {failed} failed,"
        f" {unjudged} skipped or void; seed {options.seed}"
    )
    failed_on_vcan = on_vcan is not None and _failed_on_vcan(on_vcan)
    return 1 if failed or failed_on_vcan or unjudged == len(rows) else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="faults", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--only", action="append", metavar="NAME", help="name or pattern with *; repeat for several"
    )
    parser.add_argument("--bus", choices=("udp", "vcan", "both"), default="both")
    parser.add_argument(
        "--socketcan", metavar="COMMAND", default="",
        help="command that provides SocketCAN, for faults that need vcan interfaces",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--jobs", type=int, default=Jobs.fast, help="parallel runs by the replay clock"
    )
    parser.add_argument(
        "--jobs-real", type=int, default=Jobs.real, help="parallel runs in real time"
    )
    parser.add_argument("--list", action="store_true", help="print the names of all faults")
    return parser.parse_args()


def _chosen(patterns: list[str] | None) -> set[str]:
    names = set(EVERYTHING)
    if patterns is None:
        return names
    found = {name for name in names if any(fnmatchcase(name, each) for each in patterns)}
    if not found:
        raise SystemExit(f"--only {patterns}: unknown fault (--list prints them)")
    return found


def _run(bus: str, faults: list[Fault], options: argparse.Namespace) -> list[Row]:
    """Run faults on a bus; say and write each row as soon as it is known."""
    able, rows = _able(bus, faults)
    if not able:
        return rows
    jobs = Jobs(options.jobs, options.jobs_real)
    ERR.print(
        f"{bus}: {len(able)} faults, about {seconds(able, jobs) / 60:.0f} min"
        f" ({os.cpu_count()} cores); no run begins after {LIMIT_S / 60:.0f} min"
    )
    began_s = time.monotonic()
    lines = udp if bus == "udp" else vcan
    ROWS.mkdir(parents=True, exist_ok=True)
    with (ROWS / f"{bus}.jsonl").open("w", encoding="utf-8", buffering=1) as written:
        for result in run_all(able, lines, jobs, options.seed, until_s=began_s + LIMIT_S):
            row = _row(bus, result)
            rows.append(row)
            written.write(json.dumps(row.as_json()) + "\n")
            ERR.print(f"{time.monotonic() - began_s:5.0f} s {bus}: {row.name}: {row.result()}")
    return rows


def _row(bus: str, result: Result) -> Row:
    return Row.of(result.fault, bus, result.verdict, f"void: {result.reason}")


def _able(bus: str, faults: list[Fault]) -> tuple[list[Fault], list[Row]]:
    """Return the faults that can run here, and rows with the reason for the others."""
    lacking = _lacking(bus)
    able, rows = [], []
    for fault in faults:
        why = [lacking[need] for need in sorted(fault.needs) if need in lacking]
        if why:
            rows.append(Row.of(fault, bus, None, f"skipped: {'; '.join(why)}"))
        else:
            able.append(fault)
    return able, rows


def _lacking(bus: str) -> dict[str, str]:
    lacking = {}
    if bus == "vcan" and not _can_make_vcan():
        lacking["vcan"] = "no vcan interface can be created here (see --socketcan)"
    if bus == "udp":
        lacking["vcan"] = "needs a vcan interface"
    if os.geteuid() != 0:
        lacking["root"] = "needs root"
    words = subprocess.run(
        [sys.executable, "-m", "cangauge", "run", "--help"],
        capture_output=True, text=True, check=True, env={**os.environ, "COLUMNS": "200"},
    ).stdout  # fmt: skip
    if "--state" not in words:
        lacking["state"] = "`cangauge run` has no --state"
    return lacking


def _can_make_vcan() -> bool:
    line = vcan(0)
    try:
        line.create()
    except Exception as error:  # noqa: BLE001 - any error means that there is no interface
        ERR.print(f"vcan: {error}")
    return has_socketcan(line.channel)


def _start_on_vcan(options: argparse.Namespace, chosen: set[str]) -> subprocess.Popen[bytes]:
    """Run the faults of vcan at the same time, by this program under the --socketcan command."""
    command = [
        *shlex.split(options.socketcan), sys.executable, "-m", "faults", "--bus", "vcan",
        "--seed", str(options.seed), "--jobs", "1", "--jobs-real", "3",
    ]  # fmt: skip
    for fault in ON_VCAN:
        if fault.name in chosen:
            command += ["--only", fault.name]
    return subprocess.Popen(command, stdout=subprocess.PIPE)


def _failed_on_vcan(process: subprocess.Popen[bytes]) -> bool:
    """Wait for the table of vcan and print it; return whether the run failed."""
    table, _ = process.communicate()
    sys.stdout.write(table.decode(errors="replace"))
    if process.returncode not in {0, 1}:
        ERR.print(f"the run on vcan ended with status {process.returncode}")
    return process.returncode != 0


if __name__ == "__main__":
    raise SystemExit(main())
