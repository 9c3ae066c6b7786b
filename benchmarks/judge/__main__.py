"""Chains of days with a faulty gauge: what the second opinion finds, and false alarms.

    cd benchmarks && python -m judge --seed 1 [--chains 10] [--faults …] [--data FOLDER] > lines
    python -m judge --table lines [--keep]

Each fault is drawn on `--chains` chains of recorded trips, cells and simulated storage, in equal
parts, and judged with a model of other logs of the pack and without one. Prints a line of JSON for
each judgement.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich import box
from rich.table import Table

import cangauge
from figures import publish
from judge.chains import FAULTS, HEALTHY, PACKS, Chain, healthy_chains

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
LARGE_PCT, SMALL_PCT = 5.0, 3.0


def run(arguments: argparse.Namespace) -> None:
    """Draw and judge; print a line for each judgement."""
    each = -(-arguments.chains // len(arguments.packs))
    for pack in arguments.packs:
        healthy = list(healthy_chains(pack, 2 * each, arguments.seed, arguments.data))
        for number, fault in enumerate(arguments.faults):
            for draw in range(each):
                base = healthy[(number + draw * 3) % len(healthy)]
                seed = [arguments.seed, PACKS.index(pack), list(FAULTS).index(fault), draw]
                chain = replace(
                    base,
                    logs=list(base.logs),
                    true_pct=[true.copy() for true in base.true_pct],
                    rng=np.random.default_rng(seed),
                    fault=fault,
                    causes=[],
                    resets=[],
                    cell_voltages=[],
                )
                FAULTS[fault](chain)
                for with_model in (True, False):
                    try:
                        print(json.dumps(judged(chain, with_model=with_model)), flush=True)
                    except cangauge.InputError as refused:
                        print(f"{pack}, {fault}: {refused}", file=sys.stderr)


def judged(chain: Chain, *, with_model: bool) -> dict[str, object]:
    """Return what is said of a chain beside the truth."""
    begun_s = time.process_time()
    pack = {"chemistry": chain.model.chemistry, "cells": chain.cells}
    judgement = cangauge.judge(
        chain.logs,
        chain.model if with_model else None,
        **({} if with_model else pack),
        capacity_ah=chain.capacity_ah,
        cell_voltages=chain.cell_voltages,
    )
    cpu_s = time.process_time() - begun_s
    found = judgement.to_dict()
    first_s = chain.logs[0].time_s[0]
    ends = [piece["until_s"] for piece in found["pieces"][:-1]]
    late_s = [min((abs(at - first_s - end) for end in ends), default=1e9) for at in chain.resets]
    return {
        "pack": chain.pack, "chain": chain.number, "fault": chain.fault, "model": with_model,
        "true_pct": chain.error_pct, "causes": [sorted(cause) for cause in chain.causes],
        "reset_off_s": late_s, "lack_pct": chain.lack_pct, "cpu_s": cpu_s,
        "now": found["now"], "faults": found["faults"], "text": found["text"],
    }  # fmt: skip


def share(values: Sequence[bool]) -> str:
    """Return a count of all."""
    return f"{sum(values)} of {len(values)}"


def summary(lines: Sequence[dict]) -> Table:
    """Return what is found, with a model of the pack and without."""
    table = Table(box=box.SIMPLE)
    for head in ("", "with a model", "without a model"):
        table.add_column(head)
    both = [[line for line in lines if line["model"] == of] for of in (True, False)]
    rows = [numbers(some) for some in both]
    for name in rows[0]:
        table.add_row(name, *(row[name] for row in rows))
    return table


def numbers(lines: Sequence[dict]) -> dict[str, str]:
    """Return the numbers of some lines."""
    healthy = [line for line in lines if line["fault"] in HEALTHY]
    large = [line for line in lines if abs(line["true_pct"]) > LARGE_PCT]
    small = [line for line in lines if abs(line["true_pct"]) < SMALL_PCT]
    faulty = [line for line in lines if line["causes"]]
    named = [line for line in faulty if line["faults"]]
    resets = [line for line in lines if line["fault"].startswith("self_reset")]
    weak = [line for line in lines if line["lack_pct"]]
    cpu_s = [line["cpu_s"] for line in lines]
    return {
        "Alarms on healthy chains": share([is_verdict(line, "off") for line in healthy]),
        'Wrong "off" (error below 3 %)': share([is_verdict(line, "off") for line in small]),
        'Wrong "agrees" (error above 5 %)': share([is_verdict(line, "agrees") for line in large]),
        'Right "off" (error above 5 %)': share([is_verdict(line, "off") for line in large]),
        "Stated error within 2σ of the true error": share([is_within(line) for line in lines]),
        "Faulty gauges with a named cause": share([bool(line["faults"]) for line in faulty]),
        "Named causes that are right and complete": share([is_right(line) for line in named]),
        "Interval contains the size of the weak cell": share([is_inside(line) for line in weak]),
        "Time of a self-reset right within ten minutes": share(
            [line["reset_off_s"][0] <= 600.0 for line in resets]
        ),
        "CPU time per chain: mean, maximum": f"{np.mean(cpu_s):.1f} s, {max(cpu_s):.1f} s",
    }


def is_verdict(line: dict, verdict: str) -> bool:
    """Return whether a line has a verdict."""
    return line["now"]["verdict"] == verdict


def is_within(line: dict) -> bool:
    """Return whether the error lies within 2σ."""
    now = line["now"]
    return abs(now["error_pct"] - line["true_pct"]) <= 2.0 * now["sigma_pct"]


def is_inside(line: dict) -> bool:
    """Return whether a weak cell is found, and its size inside its interval."""
    found = [fault["interval"] for fault in line["faults"] if fault["fault"] == "weak_cell"]
    return any(low <= line["lack_pct"] <= high for low, high in found)


def is_right(line: dict) -> bool:
    """Return whether all faults are named, and no other one."""
    names = {fault["fault"] for fault in line["faults"]}
    every = {name for cause in line["causes"] for name in cause}
    return names <= every and all(names & set(cause) for cause in line["causes"])


def main() -> None:
    """Run or tabulate."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--packs", nargs="+", choices=PACKS, default=list(PACKS))
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=list(FAULTS))
    parser.add_argument("--chains", type=int, default=10, help="of each fault, over all packs")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--table", type=Path, help="lines of a run")
    parser.add_argument("--keep", action="store_true", help="keep the first table as the page's")
    arguments = parser.parse_args()
    if arguments.table:
        lines = [json.loads(line) for line in arguments.table.read_text().splitlines()]
        describes = ["src/cangauge/extras/judge", "benchmarks/judge"]
        publish("judge", [summary(lines)], describes, keeps=arguments.keep)
    else:
        run(arguments)


if __name__ == "__main__":
    main()
