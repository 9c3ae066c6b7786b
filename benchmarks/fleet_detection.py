"""Smallest fault that a diagnosis can see, against the number of healthy logs of the fleet.

    python benchmarks/fleet_detection.py [--references 1 3 10 30 100 300 1000] [--figure FILE]

Simulated vehicles of one type, each with its own capacity and resistance; healthy logs of unseen
vehicles are diagnosed, one each. First with a model of ten logs and a growing number of references,
each of another vehicle; then with ten references and a model of a growing number of logs
(`--models`). The smallest visible size is that of which the evidence reaches the limit of the
diagnosis (`EffectEvidence.visible`), in % of the effect's physical range; median of the vehicles.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from cangauge.diagnosis import diagnose, learn_references
from cangauge.extras.validation.cases import Scenario, draw_scenario
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
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
    parser.add_argument("--references", type=int, nargs="*", default=[1, 3, 10, 30, 100, 300, 1000])
    parser.add_argument("--models", type=int, nargs="*", default=[])
    parser.add_argument("--tested", type=int, default=TESTED, help="vehicles that are diagnosed")
    parser.add_argument("--json", type=Path, help="file of the sizes, a row for each number")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="draw them (PNG)")
    options = parser.parse_args()
    scenario = draw_scenario(SEED)
    tested = [vehicle_logs(scenario, 10_000 + k, 1, HOURS)[0] for k in range(options.tested)]
    sys.stdout.write(f"{'':26}{'  '.join(SHOWN)}\n")
    model = _model(scenario, MODEL_LOGS)
    rows = []
    for number in options.references:
        row = _row(f"{number} references", tested, model, _healthy(scenario, number, 5000))
        rows.append({"references": number, **row})
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    if options.figure:
        draw(rows, options.figure)
    references = _healthy(scenario, REFERENCES, 5000)
    for number in options.models:
        _row(f"model of {number} logs", tested, _model(scenario, number), references)


def _healthy(scenario: Scenario, number: int, first: int) -> list[Log]:
    return [vehicle_logs(scenario, first + k, 1, HOURS)[0] for k in range(number)]


def _model(scenario: Scenario, number: int) -> Model:
    logs = [scenario.training[0].log, *_healthy(scenario, number - 1, 0)]
    return fit(logs, capacity_ah=scenario.pack.capacity_ah).model


def _row(
    label: str, tested: Sequence[Log], model: Model, references: Sequence[Log]
) -> dict[str, float]:
    """Print and return sizes [%], P(none), and the processor time [s] of both steps."""
    began = time.process_time()
    learned = learn_references(references, model)
    learned_at = time.process_time()
    sizes: dict[str, list[float]] = {name: [] for name in SHOWN}
    healthy = []
    for log in tested:
        found = diagnose([log], model, learned)
        healthy.append(found.posterior.probabilities["none"])
        for name in SHOWN:
            item = found.evidence.effects[name]
            sizes[name].append(min(100.0 * item.visible / item.trial.bound, 100.0))
    row = {name: _median(sizes[name]) for name in SHOWN} | {
        "p_none": _median(healthy),
        "learning_s": learned_at - began,
        "diagnosis_s": (time.process_time() - learned_at) / len(tested),
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }
    cells = "  ".join(f"{row[name]:{len(name)}.1f}" for name in SHOWN)
    sys.stdout.write(
        f"{label:26}{cells}   P(none) {row['p_none']:.2f}, {row['learning_s']:.0f} s to learn,"
        f" {row['diagnosis_s']:.1f} s a diagnosis, {row['memory_mb']:.0f} MB\n"
    )
    sys.stdout.flush()
    return row


def draw(rows: Sequence[dict[str, float]], path: Path) -> None:
    """Draw the smallest visible sizes over the number of references."""
    import matplotlib as mpl  # noqa: PLC0415 - of the extra `figures`

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415

    chart, axes = plt.subplots(figsize=(8, 4.4), dpi=110)
    numbers = [row["references"] for row in rows]
    for name in SHOWN:
        axes.plot(numbers, [row[name] for row in rows], marker="o", label=name.replace("_", " "))
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("references, each of another vehicle")
    axes.set_ylabel("smallest visible size [% of physical range]")
    for axis, ticks in ((axes.xaxis, numbers), (axes.yaxis, (2, 5, 10, 20, 50, 100))):
        axis.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
        axis.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    chart.tight_layout()
    chart.savefig(path)


def _median(values: Sequence[float]) -> float:
    ordered = sorted(values)
    middle = len(ordered) // 2
    return ordered[middle] if len(ordered) % 2 else 0.5 * (ordered[middle - 1] + ordered[middle])


if __name__ == "__main__":
    main()
