"""Diagnosis of real cold: i3 winter trips against the summer model, LG cells at 0 and 10 °C.

    python benchmarks/gap_cold.py --data FOLDER [--json]

FOLDER holds `bmw_i3` and `lg_hg2`. Each winter trip is left out in turn: the other winter trips are
diagnosed against the model of the summer trips A01, A03 … A21 with all of these as references, and
the extended model predicts the one left out: voltage by the counted SoC, and SoC by the EKF with
the initial SoC withheld, after 5 minutes. The LG cell's model is fitted on its drive cycles at
25 °C, four cold ones of each temperature are diagnosed together, each
judged with its own rows left out.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from cangauge.estimate.estimator import EstimatorSettings
from cangauge.estimate.offline import run_estimator, samples_of
from cangauge.gap.columns import prepare_log, residual
from cangauge.gap.diagnose import diagnose
from cangauge.gap.extend import model_file_of
from cangauge.identify.fit import FitOptions, fit
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.model_file import ModelFile
from real_trips import DATA, SETTLED_S, TRAINING, identify, read_trips

WINTER = ("B03", "B05", "B06", "B16", "B17", "B18", "B19", "B20")
LG_TRAINED = ("25degC__551_LA92", "25degC__551_US06", "25degC__552_Mixed3", "25degC__552_Mixed5")
LG_REFERENCES = ("25degC__551_Mixed1", "25degC__551_Mixed2", "25degC__552_Mixed7")
LG_COLD = {
    0: ("0degC__589_LA92", "0degC__589_Mixed1", "0degC__589_US06", "0degC__590_Mixed5"),
    10: ("10degC__567_Mixed1", "10degC__567_US06", "10degC__571_Mixed5", "10degC__571_Mixed7"),
}
LG_CAPACITY_AH = 2.78
"""Charge of a full discharge at 25 °C in these files [Ah]."""


def options_of(model: ModelFile) -> FitOptions:
    """Return the options that a model's rows are made with."""
    return FitOptions(
        capacity_ah=model.capacity_ah, rate_hz=model.rate_hz, delay_s=tuple(model.delays_s)
    )


def errors_v(log: Log, model: ModelFile) -> np.ndarray:
    """Return measured minus predicted voltage at the counted SoC [V]."""
    return residual(prepare_log(log, options_of(model)), model.extended_model())


def rms(values: Sequence[np.ndarray]) -> float:
    """Return the root mean square of all values."""
    return float(np.sqrt(np.mean(np.concatenate(list(values)) ** 2)))


def soc_error(log: Log, model: ModelFile) -> np.ndarray:
    """Return the EKF's error against the reference, SoC withheld, after 5 minutes [%]."""
    table = run_estimator(samples_of(log), model, EstimatorSettings())
    if log.soc_pct is None:
        return np.zeros(0)
    keep = np.isfinite(log.soc_pct) & (log.time_s - log.time_s[0] >= SETTLED_S)
    return (table.soc_pct - log.soc_pct)[keep]


def winter(folder: Path, console: Console) -> dict[str, Any]:
    """Return the figures of the i3's winter trips, each left out in turn."""
    training = read_trips(folder, TRAINING)
    model = identify(training).model
    trips = read_trips(folder, WINTER)
    rows = []
    for left_out in trips:
        console.print(f"leaving out {left_out.name} …")
        found = diagnose([trip for trip in trips if trip is not left_out], model, training)
        better = model_file_of(found.extension, model, found.extended_rmse_v)
        rows.append(
            {
                "trip": left_out.name,
                "verdict": found.verdict.cause,
                "probability": found.verdict.probability,
                "plain": errors_v(left_out, model),
                "extended": errors_v(left_out, better),
                "plain_soc": soc_error(left_out, model),
                "extended_soc": soc_error(left_out, better),
            }
        )
    return _figures(rows)


def _figures(rows: list[dict[str, Any]]) -> dict[str, Any]:
    def mae(name: str) -> float:
        return float(np.mean(np.abs(np.concatenate([row[name] for row in rows]))))

    return {
        "plain_rmse_v": rms(row["plain"] for row in rows),
        "extended_rmse_v": rms(row["extended"] for row in rows),
        "plain_soc_mae_pct": mae("plain_soc"),
        "extended_soc_mae_pct": mae("extended_soc"),
        "trips": [
            {
                "trip": row["trip"],
                "verdict": row["verdict"],
                "probability": row["probability"],
                "plain_rmse_v": rms([row["plain"]]),
                "extended_rmse_v": rms([row["extended"]]),
                "plain_soc_mae_pct": float(np.mean(np.abs(row["plain_soc"]))),
                "extended_soc_mae_pct": float(np.mean(np.abs(row["extended_soc"]))),
            }
            for row in rows
        ],
    }


def cells(folder: Path, console: Console) -> list[dict[str, Any]]:
    """Return the figures of the LG cell at 10 and 0 °C."""

    def read(names: Sequence[str]) -> list[Log]:
        return [read_log(folder / f"{name}.parquet") for name in names]

    console.print("fitting the LG cell at 25 °C …")
    options = FitOptions(capacity_ah=LG_CAPACITY_AH, initial_soc_pct=100.0)
    model = fit(read(LG_TRAINED), options).model
    references = read(LG_REFERENCES)
    result = []
    for temperature, names in LG_COLD.items():
        console.print(f"diagnosing {temperature} °C …")
        found = diagnose(read(names), model, references, initial_soc_pct=100.0)
        result.append(
            {
                "temperature_c": temperature,
                "verdict": found.verdict.cause,
                "probability": found.verdict.probability,
                "ambiguous_with": list(found.verdict.ambiguous_with),
                "baseline_rmse_v": found.baseline_rmse_v,
                "extended_rmse_v": found.extended_rmse_v,
                "floor_v": found.floor_v,
                "closed_fraction": found.closed,
            }
        )
    return result


def show(result: dict[str, Any], console: Console) -> None:
    """Print the tables."""
    table = Table(title="BMW i3, winter trips left out in turn (summer model → extended)")
    for heading in ("trip", "verdict", "RMSE [V]", "EKF MAE, withheld [%]"):
        table.add_column(heading)
    both = result["winter"]
    for row in [*both["trips"], {"trip": "all", "verdict": "", "probability": None, **both}]:
        table.add_row(
            row["trip"],
            row["verdict"] + ("" if row["probability"] is None else f" {row['probability']:.2f}"),
            f"{row['plain_rmse_v']:.2f} → {row['extended_rmse_v']:.2f}",
            f"{row['plain_soc_mae_pct']:.2f} → {row['extended_soc_mae_pct']:.2f}",
        )
    console.print(table)
    table = Table(title="LG HG2 cell, cold drive cycles against 25 °C, left out in turn")
    for heading in ("°C", "verdict", "not told from", "RMSE [mV]", "floor [mV]", "closed"):
        table.add_column(heading)
    for row in result["cells"]:
        closed = row["closed_fraction"]
        table.add_row(
            str(row["temperature_c"]),
            f"{row['verdict']} {row['probability']:.2f}",
            ", ".join(row["ambiguous_with"]),
            f"{1e3 * row['baseline_rmse_v']:.1f} → {1e3 * row['extended_rmse_v']:.1f}",
            f"{1e3 * row['floor_v']:.1f}",
            "–" if closed is None else f"{100.0 * closed:.0f} %",
        )
    console.print(table)


def main() -> int:
    """Run both."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=DATA.parent, help="folder of both data sets")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    if not (options.data / "bmw_i3").is_dir():
        sys.stderr.write(f"{options.data}: no bmw_i3 in this folder; give another with --data\n")
        return 2
    console = Console(stderr=True)
    result = {
        "winter": winter(options.data / "bmw_i3", console),
        "cells": cells(options.data / "lg_hg2", console),
    }
    if options.json:
        sys.stdout.write(json.dumps(result) + "\n")
    else:
        show(result, Console(width=120))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
