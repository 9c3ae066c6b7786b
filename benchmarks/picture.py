"""Draw the picture of docs/results.md: chained real trips with a current sensor offset of 3 A.

python benchmarks/picture.py --data FOLDER -o docs/chain.png
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np

from cangauge.estimation.offline import run_estimator
from cangauge.estimation.settings import EstimatorSettings
from real_trips import DATA, JUDGED_S, OFFSET_A, TEST, TRAINING, chain, identify, read_trips

mpl.use("Agg")
from matplotlib import pyplot as plt


def main() -> None:
    """Identify on the odd trips, estimate the chained even ones, draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the i3 trips")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/chain.png"))
    options = parser.parse_args()
    model = identify(read_trips(options.data, TRAINING)).model
    trips = [trip for trip in read_trips(options.data, TEST) if trip.duration_s > JUDGED_S]
    samples, reference = chain(trips, model.capacity_ah, OFFSET_A)
    table = run_estimator(samples, model, EstimatorSettings(initial_soc_pct=float(reference[0])))
    known = np.isfinite(reference)
    counted = (table.soc_coulomb_pct - reference)[known]
    fused = (table.soc_pct - reference)[known]
    sys.stdout.write(
        f"error at the end by Coulomb counting {counted[-1]:+.1f} %;"
        f" largest error of the EKF {np.abs(fused).max():.1f} %\n"
    )
    hours, every = table.time_s / 3600.0, slice(None, None, 20)
    figure, axes = plt.subplots(figsize=(10, 4.2), dpi=110)
    axes.fill_between(
        hours[every],
        (table.soc_pct - 2.0 * table.soc_std_pct)[every],
        (table.soc_pct + 2.0 * table.soc_std_pct)[every],
        alpha=0.25,
        label="cangauge, ±2σ",
        linewidth=0,
    )
    axes.plot(hours[every], table.soc_pct[every], label="cangauge (EKF)", linewidth=1.6)
    axes.plot(hours[every], table.soc_coulomb_pct[every], label="Coulomb counting", color="tab:red")
    axes.plot(hours[every], reference[every], "k--", label="the car's own SoC", linewidth=1.2)
    axes.set(
        xlabel="time [h] (eight real trips of a BMW i3, chained)",
        ylabel="SoC [%]",
        ylim=(0, 100),
        xlim=(0, float(np.max(hours))),
        title=f"Current sensor offset {OFFSET_A:+.0f} A: the voltage model corrects the SoC",
    )
    axes.legend(loc="lower left", fontsize=9)
    axes.grid(alpha=0.3)
    figure.tight_layout()
    options.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.output)


if __name__ == "__main__":
    main()
