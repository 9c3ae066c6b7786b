"""Diagnosis of real logs with faults put in: what `cangauge gap` says was done to them.

    python benchmarks/gap_injected.py --data FOLDER [--cases 4] [--healthy 40] [--seed 1] [--json]

FOLDER holds the BMW i3 trips of `real_trips.py`. The model is fitted on A01, A03 … A21; references
are eight of those trips, drawn anew for each case; the diagnosed logs are four of A02, A04 … A22.
A fault of the twin (`cangauge.twin.inject`, which shares no code with the effects of the diagnosis)
is put into all four with a size that opens a gap of 0.5 to 5 times the model's held-out error;
healthy groups are the same trips untouched. The diagnosing process sees the logs alone.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from cangauge.gap.diagnose import diagnose
from cangauge.logs.log import Log
from cangauge.model.effects.library import LIBRARY
from cangauge.model.model_file import ModelFile
from cangauge.twin.faults import Fault, fault_kinds
from cangauge.twin.inject import inject, scale_injection
from cangauge.twin.survey import survey_pack
from real_trips import DATA, TEST, TRAINING, identify, read_trips

CELLS = 96
AT_LEAST_S = 600.0
REFERENCES, LOGS = 8, 4
GAP_IN_FLOORS = (0.5, 5.0)
EVERY = 5
"""Rows of the 10 Hz logs that are kept: 2 Hz shows every effect but the finest time skew."""


@dataclass(frozen=True)
class Outcome:
    """What the diagnosis said of one group of logs."""

    truth: str
    gap_in_floors: float
    verdict: str
    probability: float
    ranked: tuple[str, ...]
    ambiguous_with: tuple[str, ...]
    closed: float | None


@dataclass(frozen=True, eq=False)
class Trips:
    """The trips of a folder, and the model that is diagnosed."""

    references: tuple[Log, ...]
    held_out: tuple[Log, ...]
    model: ModelFile


@cache
def trips(folder: Path) -> Trips:
    """Read and fit once in each process."""
    training = read_trips(folder, TRAINING)
    return Trips(
        tuple(_thinned(log) for log in training if log.duration_s > AT_LEAST_S),
        tuple(_thinned(log) for log in read_trips(folder, TEST) if log.duration_s > AT_LEAST_S),
        identify(training).model,
    )


def _thinned(log: Log) -> Log:
    return log.rows(slice(None, None, EVERY))


def outcome(job: tuple[Path, str, int]) -> Outcome:
    """Draw a group of logs, put the fault in, and diagnose it."""
    folder, truth, seed = job
    data = trips(folder)
    rng = np.random.default_rng([seed, *truth.encode()])
    references = [data.references[k] for k in _draw(rng, len(data.references), REFERENCES)]
    logs = [data.held_out[k] for k in _draw(rng, len(data.held_out), LOGS)]
    gap = 0.0
    if truth != "none":
        logs, gap = _with_fault(data, logs, truth, seed, rng)
    found = diagnose(logs, data.model, references)
    verdict = found.verdict
    return Outcome(
        truth=truth,
        gap_in_floors=gap,
        verdict=verdict.cause,
        probability=verdict.probability,
        ranked=tuple(score.effect_id for score in verdict.candidates[:3]),
        ambiguous_with=verdict.ambiguous_with,
        closed=found.closed,
    )


def _draw(rng: np.random.Generator, total: int, number: int) -> list[int]:
    return sorted(rng.choice(total, min(number, total), replace=False).tolist())


def _with_fault(
    data: Trips, logs: Sequence[Log], truth: str, seed: int, rng: np.random.Generator
) -> tuple[list[Log], float]:
    pack = survey_pack(data.references, capacity_ah=data.model.capacity_ah, cells=CELLS)
    floor = data.model.noise.voltage_rmse_v
    kind = next(kind for kind in fault_kinds() if kind.id == truth)
    low, _ = kind.limits(pack)
    sign = -1.0 if low < 0.0 and rng.random() < 0.5 else 1.0
    wanted = floor * math.exp(rng.uniform(*np.log(GAP_IN_FLOORS)))
    scaled = scale_injection(logs, Fault(truth, sign, seed=seed), wanted, pack, seed=seed)
    injected = [inject(log, (scaled.fault,), pack, seed=seed) for log in logs]
    gap = math.sqrt(float(np.mean(np.concatenate([item.gap_v for item in injected]) ** 2)))
    return [item.log for item in injected], gap / floor


def summary(outcomes: Sequence[Outcome]) -> dict[str, object]:
    """Return the figures over all cases, and over those whose gap exceeds the floor."""
    faulty = [item for item in outcomes if item.truth != "none"]
    healthy = [item for item in outcomes if item.truth == "none"]
    clear = [item for item in faulty if item.gap_in_floors >= 1.0]
    detected = [item for item in faulty if item.verdict != "none"]

    def share(items: Sequence[Outcome], what: str) -> float | None:
        if not items:
            return None
        hits = {
            "top1": lambda i: i.ranked[0] == i.truth,
            "top2": lambda i: i.truth in i.ranked[:2],
            "family": lambda i: _family(i.ranked[0]) == _family(i.truth),
            "verdict": lambda i: i.verdict == i.truth,
            "verdict_or_pair": lambda i: (
                i.verdict == i.truth
                or (i.verdict not in {"none", "unknown"} and i.ambiguous_with == (i.truth,))
            ),
        }[what]
        return sum(map(hits, items)) / len(items)

    kinds = ("top1", "top2", "family", "verdict", "verdict_or_pair")
    return {
        "cases": len(faulty),
        "all": {kind: share(faulty, kind) for kind in kinds},
        "gap_above_floor": {"cases": len(clear), **{kind: share(clear, kind) for kind in kinds}},
        "detected": {"cases": len(detected), **{kind: share(detected, kind) for kind in kinds}},
        "healthy_groups": len(healthy),
        "false_alarms": sum(item.verdict != "none" for item in healthy),
    }


def _family(effect_id: str) -> str:
    return LIBRARY[effect_id].family


def show(outcomes: Sequence[Outcome], result: dict[str, object], console: Console) -> None:
    """Print the table of verdicts and the figures."""
    table = Table(title="Faults put into real trips: what the diagnosis said")
    for heading in ("truth", "cases", "gap [floors]", "verdicts"):
        table.add_column(heading)
    groups: dict[str, list[Outcome]] = defaultdict(list)
    for item in outcomes:
        groups[item.truth].append(item)
    for truth, items in groups.items():
        said = Counter(item.verdict for item in items)
        gaps = [item.gap_in_floors for item in items]
        table.add_row(
            truth,
            str(len(items)),
            f"{min(gaps):.1f} … {max(gaps):.1f}",
            ", ".join(f"{verdict} {count}" for verdict, count in said.most_common()),
        )
    console.print(table)
    console.print_json(json.dumps(result))


def main() -> int:
    """Run the check."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the i3 trips")
    parser.add_argument("--cases", type=int, default=4, help="cases per effect")
    parser.add_argument("--healthy", type=int, default=40, help="groups without a fault")
    parser.add_argument("--seed", type=int, default=1, help="of the draw")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    if not options.data.is_dir():
        sys.stderr.write(f"{options.data}: no such folder; give the trips' with --data\n")
        return 2
    jobs = [
        (options.data, kind.id, 1000 * options.seed + number)
        for kind in fault_kinds()
        for number in range(options.cases)
    ]
    jobs += [(options.data, "none", 1000 * options.seed + n) for n in range(options.healthy)]
    outcomes = []
    with (
        Progress(console=Console(stderr=True)) as progress,
        ProcessPoolExecutor(options.jobs) as pool,
    ):
        task = progress.add_task("diagnosing", total=len(jobs))
        for item in pool.map(outcome, jobs):
            outcomes.append(item)
            progress.advance(task)
    result = summary(outcomes)
    if options.json:
        cases = [asdict(item) for item in outcomes]
        sys.stdout.write(json.dumps({"summary": result, "cases": cases}) + "\n")
    else:
        show(outcomes, result, Console(width=130))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
