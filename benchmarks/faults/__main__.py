"""Inject faults on a live bus and print a table of the results.

    make faults
    PYTHONPATH=benchmarks python -m faults [--only NAME]… [--bus udp|vcan|both] [--json]

Prints the estimated time first. Exit status 1 if a fault failed, or if no run could be judged.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import threading
import time
from fnmatch import fnmatchcase
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from cangauge.bus.open import has_socketcan
from faults.catalogue import EVERYTHING, ON_ANY_BUS, ON_UDP, ON_VCAN
from faults.criteria import Row, show
from faults.fault import Fault
from faults.line import udp, vcan
from faults.process import prepare
from faults.run import Jobs, run_all, seconds

ERR = Console(stderr=True)


def main() -> int:
    """Run the faults and print the table."""
    options = _options()
    if options.list:
        for name, fault in EVERYTHING.items():
            sys.stdout.write(f"{name}: {fault.description}\n")
        return 0
    chosen = _chosen(options.only)
    prepare()
    rows: list[Row] = []
    if options.bus in {"udp", "both"}:
        faults = [fault for fault in ON_UDP if fault.name in chosen]
        on_vcan = None
        if options.bus == "both" and options.socketcan:
            on_vcan = _VcanRun(options, chosen)
        rows += _run("udp", faults, options)
        if on_vcan is not None:
            rows += on_vcan.rows()
    if options.bus == "vcan" or (options.bus == "both" and not options.socketcan):
        with_any = options.only and options.bus == "vcan"
        on_bus = [*ON_ANY_BUS, *ON_VCAN] if with_any else ON_VCAN
        faults = list({fault.name: fault for fault in on_bus if fault.name in chosen}.values())
        rows += _run("vcan", faults, options)
    failed = [row for row in rows if row.verdict is not None and not row.verdict.passed]
    judged = any(row.verdict is not None for row in rows)
    if options.json:
        found = {
            "seed": options.seed,
            "faults": len({row.name for row in rows}),
            "failed": len(failed),
            "skipped": sum(row.verdict is None for row in rows),
            "rows": [row.as_json() for row in rows],
        }
        sys.stdout.write(json.dumps(found) + "\n")
    else:
        console = Console(width=max(Console().width, 170))
        show(rows, console)
        skipped = sum(row.verdict is None for row in rows)
        console.print(
            f"{len(rows)} runs: {len(rows) - len(failed) - skipped} passed, {len(failed)} failed,"
            f" {skipped} skipped; seed {options.seed}"
        )
    return 1 if failed or not judged else 0


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
    parser.add_argument("--json", action="store_true", help="print one JSON object")
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
    able, rows = _able(bus, faults)
    if not able:
        return rows
    jobs = Jobs(options.jobs, options.jobs_real)
    takes = seconds(able, jobs) / 60
    ERR.print(f"{bus}: {len(able)} faults, about {takes:.0f} min ({os.cpu_count()} cores)")
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
               TimeElapsedColumn())  # fmt: skip
    with Progress(*columns, console=ERR) as progress:
        task = progress.add_task(
            bus, total=len(able) + len({fault.reference_key for fault in able})
        )

        def over(name: str) -> None:
            progress.update(task, advance=1, description=f"{bus}: {name}")
            if not ERR.is_terminal:
                ERR.print(f"{bus}: {name}: finished")

        lines = udp if bus == "udp" else vcan
        done = run_all(able, lines, jobs, options.seed, progress=over)
    return [Row.of(each.fault, bus, each.verdict, each.reason) for each in done] + rows


def _able(bus: str, faults: list[Fault]) -> tuple[list[Fault], list[Row]]:
    """Return the faults that can run here, and rows with the reason for the others."""
    lacking = _lacking(bus)
    able, rows = [], []
    for fault in faults:
        why = [lacking[need] for need in sorted(fault.needs) if need in lacking]
        if why:
            rows.append(Row.of(fault, bus, None, "; ".join(why)))
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


class _VcanRun:
    """The faults on vcan, run in parallel by this program under the --socketcan command."""

    def __init__(self, options: argparse.Namespace, chosen: set[str]) -> None:
        command = [
            *shlex.split(options.socketcan), sys.executable, "-m", "faults", "--bus", "vcan",
            "--json", "--seed", str(options.seed), "--jobs", "1", "--jobs-real", "3",
        ]  # fmt: skip
        for fault in ON_VCAN:
            if fault.name in chosen:
                command += ["--only", fault.name]
        self._out = b""
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        time.sleep(1.0)

    def _read(self) -> None:
        self._out, _ = self._process.communicate()

    def rows(self) -> list[Row]:
        """Wait for the rows."""
        self._thread.join()
        try:
            found: dict[str, Any] = json.loads(self._out)
        except ValueError:
            raise SystemExit(
                f"the run on vcan ended with status {self._process.returncode}"
            ) from None
        return [Row.from_json(row) for row in found["rows"]]


if __name__ == "__main__":
    raise SystemExit(main())
