"""Smallest fault that a diagnosis can see, against the number of healthy logs of the fleet.

    python benchmarks/fleet_detection.py [--references 1 3 10 30 100] [--models 10 100 1000]

Simulated vehicles of one type, each with its own capacity and resistance; one healthy log of an
unseen vehicle is diagnosed. First with a model of ten logs and a growing number of references, each
of another vehicle; then with ten references and a model of a growing number of logs. The smallest
visible size is that of which the evidence reaches the limit of the diagnosis
(`Diagnosis.observability`), in % of the effect's physical range.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Sequence

from cangauge.diagnosis import diagnose
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.validation.cases import Scenario, draw_scenario
from fleet_twins import vehicle_logs

SEED, HOURS, TESTED = 5, 0.4, 3
MODEL_LOGS, REFERENCES = 10, 10
SHOWN = (
    "voltage_offset", "current_offset", "capacity", "resistance_step", "slow_diffusion",
    "hysteresis", "weak_cell",
)  # fmt: skip


def main() -> None:
    """Print one row for each number of references, and of logs of the model."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--references", type=int, nargs="*", default=[1, 3, 10, 30, 100])
    parser.add_argument("--models", type=int, nargs="*", default=[10, 100, 1000])
    parser.add_argument("--tested", type=int, default=TESTED, help="vehicles that are diagnosed")
    options = parser.parse_args()
    scenario = draw_scenario(SEED, climate="mild")
    tested = [vehicle_logs(scenario, 10_000 + k, 1, HOURS)[0] for k in range(options.tested)]
    sys.stdout.write(f"{'':26}{'  '.join(SHOWN)}\n")
    model = _model(scenario, MODEL_LOGS)
    for number in options.references:
        _row(f"{number} references", tested, model, _healthy(scenario, number, 5000))
    references = _healthy(scenario, REFERENCES, 5000)
    for number in options.models:
        _row(f"model of {number} logs", tested, _model(scenario, number), references)


def _healthy(scenario: Scenario, number: int, first: int) -> list[Log]:
    return [vehicle_logs(scenario, first + k, 1, HOURS)[0] for k in range(number)]


def _model(scenario: Scenario, number: int) -> Model:
    logs = [scenario.training[0].log, *_healthy(scenario, number - 1, 0)]
    return fit(logs, capacity_ah=scenario.pack.capacity_ah).model


def _row(label: str, tested: Sequence[Log], model: Model, references: Sequence[Log]) -> None:
    began = time.process_time()
    sizes: dict[str, list[float]] = {name: [] for name in SHOWN}
    healthy = []
    for log in tested:
        found = diagnose([log], model, references)
        healthy.append(found.verdict.probabilities["none"])
        for item in found.observability:
            name = str(item["effect"])
            if name in sizes:
                sizes[name].append(100.0 * (1.0 - float(str(item["visible"]))))
    spent_s = (time.process_time() - began) / len(tested)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    cells = "  ".join(f"{_median(sizes[name]):{len(name)}.1f}" for name in SHOWN)
    sys.stdout.write(
        f"{label:26}{cells}   P(none) {_median(healthy):.2f}, {spent_s:.0f} s, {memory:.0f} MB\n"
    )
    sys.stdout.flush()


def _median(values: Sequence[float]) -> float:
    ordered = sorted(values)
    middle = len(ordered) // 2
    return ordered[middle] if len(ordered) % 2 else 0.5 * (ordered[middle - 1] + ordered[middle])


if __name__ == "__main__":
    main()
