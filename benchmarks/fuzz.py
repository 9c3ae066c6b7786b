"""Fuzz every reader of cangauge.

    python benchmarks/fuzz.py [--inputs 1000000] [--seed 1] [--target NAME]… [--json]
    python benchmarks/fuzz.py --again TARGET NUMBER      # one input, with its traceback

Inputs are mutants of small valid files of every format (bus frames, captures, logs, model and state
files, configurations, maps, DBC files). Each must be accepted, or refused by an
`InputError` with a one-line message. Anything else is a finding: another exception, a numpy
warning, more than 2 s of CPU time, more than 128 MB of memory, a SoC outside 0–100 %, a process
that dies or hangs. Exit status 1 on a finding. The same seed gives the same inputs.

Bombs, devices and pipes are tested by name in `tests/nightly/fuzz`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parent))

from fuzzing.supervise import CHUNK, Share, Tally, fuzz, input_of
from fuzzing.target import Target, attempt
from fuzzing.targets import targets

console = Console(stderr=True, highlight=False)


def main() -> int:
    """Run the command and return its exit status."""
    options = _options()
    by_name = {target.name: target for target in targets()}
    if options.again:
        name, number = options.again
        data = input_of(by_name[name], options.seed, int(number))
        print(repr(data[:4000]))
        print("accepted" if attempt(by_name[name], data) else "refused")
        return 0
    chosen = [by_name[name] for name in options.target or by_name]
    shares = plan(chosen, options.inputs)
    console.print(
        f"{options.inputs} inputs, seed {options.seed}, {options.workers} processes:"
        " a million took 11 minutes on two cores"
    )
    began_s = time.monotonic()
    columns = (
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console) as progress:
        total = sum((share.stop - share.start) * by_name[share.target].weight for share in shares)
        task = progress.add_task("fuzzing", total=total)
        tallies = fuzz(
            shares,
            options.seed,
            options.workers,
            lambda name, done: progress.update(task, advance=done, description=name),
        )
    seconds = time.monotonic() - began_s
    found = sum(len(tally.findings) for tally in tallies.values())
    if options.json:
        print(json.dumps(_as_json(tallies, options.seed, seconds)))
    else:
        _show(tallies, seconds)
    _save(tallies, by_name, options)
    return 1 if found else 0


def plan(chosen: Sequence[Target], inputs: int) -> list[Share]:
    """Divide a number of inputs among the targets, in interleaved shares."""
    whole = sum(target.share for target in chosen)
    of_targets: list[list[Share]] = []
    for target in chosen:
        calls = max(1, -(-round(inputs * target.share / whole) // target.weight))
        step = max(1, CHUNK // target.weight)
        starts = range(0, calls, step)
        of_targets.append([Share(target.name, at, min(at + step, calls)) for at in starts])
    longest = max(map(len, of_targets))
    # Spread evenly, so that all targets end together and the remaining time is predictable.
    order = [
        (place * longest / len(shares), share)
        for shares in of_targets
        for place, share in enumerate(shares)
    ]
    return [share for _, share in sorted(order, key=lambda item: item[0])]


def _options() -> argparse.Namespace:
    names = [target.name for target in targets()]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--target", action="append", choices=names)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--folder", type=Path, default=Path("out/fuzz"), help="folder of the findings"
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--again", nargs=2, metavar=("TARGET", "NUMBER"))
    return parser.parse_args()


def _show(tallies: dict[str, Tally], seconds: float) -> None:
    table = Table(title=f"Fuzzing: {seconds / 60.0:.1f} min")
    table.add_column("target")
    for heading in ("inputs", "accepted", "refused", "findings", "slowest [ms CPU]", "memory [MB]"):
        table.add_column(heading, justify="right")
    for name, tally in tallies.items():
        table.add_row(
            name,
            str(tally.inputs),
            str(tally.accepted),
            str(tally.refused),
            str(sum(example.count for example in tally.findings.values())),
            f"{1000.0 * tally.slowest_s:.0f}",
            f"{tally.peak_mb:.0f}",
        )
    table.add_section()
    table.add_row(
        "all",
        *(
            str(sum(getattr(tally, what) for tally in tallies.values()))
            for what in ("inputs", "accepted", "refused")
        ),
        str(sum(e.count for tally in tallies.values() for e in tally.findings.values())),
        "",
        "",
    )
    Console().print(table)
    for name, tally in tallies.items():
        for (what, where), example in tally.findings.items():
            print(
                f"{name} {example.number}: {what} at {where}, {example.count} times: {example.text}"
            )


def _as_json(tallies: dict[str, Tally], seed: int, seconds: float) -> dict[str, object]:
    return {
        "seed": seed,
        "seconds": seconds,
        "inputs": sum(tally.inputs for tally in tallies.values()),
        "findings": sum(len(tally.findings) for tally in tallies.values()),
        "targets": {
            name: {
                "inputs": tally.inputs,
                "accepted": tally.accepted,
                "refused": tally.refused,
                "slowest_s": tally.slowest_s,
                "slowest": tally.slowest,
                "peak_mb": tally.peak_mb,
                "findings": [
                    {"what": what, "where": where, **vars(example)}
                    for (what, where), example in tally.findings.items()
                ],
            }
            for name, tally in tallies.items()
        },
    }


def _save(
    tallies: dict[str, Tally], by_name: dict[str, Target], options: argparse.Namespace
) -> None:
    for name, tally in tallies.items():
        for example in tally.findings.values():
            options.folder.mkdir(parents=True, exist_ok=True)
            path = options.folder / f"{name}-{options.seed}-{example.number}"
            path.write_bytes(input_of(by_name[name], options.seed, example.number))
            console.print(f"saved: {path}")


if __name__ == "__main__":
    sys.exit(main())
