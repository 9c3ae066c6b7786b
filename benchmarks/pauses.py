"""Real trips with a night between: the SoC is kept where the car was parked, found where not.

    python benchmarks/pauses.py --data FOLDER [--hours 8] [--json]

Model and capacity come from the odd summer trips of a BMW i3, as in `real_trips`. Each odd trip is
driven (SoC given at its start, σ 1 %), then nobody sees the car for some hours, then the next even
trip is judged against the car's own SoC: once by the estimator that went through the pause, once by
one that begins with the first voltages and knows nothing else. How long the cars really stood is
not known; what the car's SoC did in between is, and says which were charged.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from cangauge.estimate.estimator import Estimator
from cangauge.estimate.offline import samples_of
from cangauge.estimate.settings import EstimatorSettings
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from real_trips import DATA, TEST, TRAINING, identify, read_trips

AT_S = (10.0, 120.0, 600.0)
PARKED_PCT = 2.0
"""A smaller change of the car's SoC is that of a parked car [%]."""


@dataclass(frozen=True)
class Pause:
    """One pause and the trip after it; errors against the car's SoC [%]."""

    trip: str
    before_pct: float
    after_pct: float
    kept: list[float]
    kept_std: list[float]
    fresh: list[float]
    verdict: str

    @property
    def was_parked(self) -> bool:
        """Whether the car's SoC stayed what it was."""
        return abs(self.after_pct - self.before_pct) < PARKED_PCT


def errors(
    estimator: Estimator, trip: Log, begin_s: float
) -> tuple[list[float], list[float], list[str]]:
    """Return error and standard deviation [%] at `AT_S` and at the end, and the last verdict."""
    at = [int(np.searchsorted(trip.time_s - trip.time_s[0], each)) for each in AT_S]
    at = [min(each, len(trip) - 1) for each in at] + [len(trip) - 1]
    reference = trip.soc_pct if trip.soc_pct is not None else np.full(len(trip), math.nan)
    found: dict[int, tuple[float, float]] = {}
    for number, sample in enumerate(samples_of(trip)):
        time_s = sample.time_s - trip.time_s[0] + begin_s
        estimate = estimator.step(sample._replace(time_s=time_s))
        if number in at:
            found[number] = (estimate.soc_pct - float(reference[number]), estimate.soc_std_pct)
    return [found[k][0] for k in at], [found[k][1] for k in at], [estimator.filter.verdict]


def judge(first: Log, second: Log, model: Model, hours: float) -> Pause:
    """Drive one trip, wait, drive the next."""
    soc = [trip.soc_pct[np.isfinite(trip.soc_pct)] for trip in (first, second)
           if trip.soc_pct is not None]  # fmt: skip
    through = Estimator(model, EstimatorSettings(initial_soc_pct=float(soc[0][0])))
    errors(through, first, 0.0)
    begin_s = float(first.time_s[-1] - first.time_s[0]) + 3600.0 * hours
    kept, stds, verdict = errors(through, second, begin_s)
    fresh, _, _ = errors(Estimator(model), second, 0.0)
    return Pause(
        second.name, float(soc[0][-1]), float(soc[1][0]), kept, stds, fresh, verdict[0] or "none"
    )


def table_of(pauses: list[Pause], hours: float) -> Table:
    """Return all pauses as a table."""
    table = Table(title=f"after {hours:g} h unseen: error of the SoC [%]", title_justify="left")
    for name in ("trip", "car's SoC", "judged"):
        table.add_column(name)
    for when in ("10 s", "2 min", "10 min", "end"):
        table.add_column(f"{when}: kept ± σ | fresh", justify="right")
    for pause in sorted(pauses, key=lambda each: not each.was_parked):
        cells = [
            f"{kept:+.1f} ± {std:.1f} | {fresh:+.1f}"
            for kept, std, fresh in zip(pause.kept, pause.kept_std, pause.fresh, strict=True)
        ]
        soc = f"{pause.before_pct:.1f} → {pause.after_pct:.1f}"
        table.add_row(pause.trip, soc, pause.verdict, *cells)
    for name, chosen in (
        ("parked", [each for each in pauses if each.was_parked]),
        ("moved", [each for each in pauses if not each.was_parked]),
    ):
        if chosen:
            cells = [
                f"{np.mean([abs(each.kept[k]) for each in chosen]):.1f}"
                f" | {np.mean([abs(each.fresh[k]) for each in chosen]):.1f}"
                for k in range(len(AT_S) + 1)
            ]
            table.add_row(f"{name}: mean |error|", f"{len(chosen)} trips", "", *cells)
    return table


def main() -> None:
    """Run, and print a table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--hours", type=float, default=8.0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    Console(stderr=True).print("reading 22 trips, fitting 11 of them: about a minute")
    odd, even = read_trips(options.data, TRAINING), read_trips(options.data, TEST)
    model = identify(odd).model
    pauses = [judge(*pair, model, options.hours) for pair in zip(odd, even, strict=True)]
    if options.json:
        print(json.dumps([asdict(each) for each in pauses]))
    else:
        Console().print(table_of(pauses, options.hours))


if __name__ == "__main__":
    main()
