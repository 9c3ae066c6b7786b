"""Voltage error at other temperatures of models fitted to few logs, with and without the kt prior.

    python benchmarks/other_temperatures.py --data FOLDER

FOLDER holds `lg_hg2` (drive cycles of a cell, scaled to a pack of 96 × 17) and `bmw_i3` (trips of a
car). Each model is fitted to one to three logs, or to all. The table gives the median over the
models of the voltage RMSE on other logs, within the SoC range of the model, and the range of kt.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from cangauge.identify.passes import fit_voltage_model
from cangauge.inference.rows import FitOptions, fit_rows
from rich.console import Console
from rich.table import Table

from cangauge.errors import InputError
from cangauge.extras.validation.recordings import (
    LG_25C,
    LG_CAPACITY_AH,
    LG_PARALLEL,
    LG_SERIES,
    summer_held_out,
    summer_training,
)
from cangauge.extras.validation.twin.injection import scaled_to_pack, with_initial_soc
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.coulomb_counting import capacity_from_reference
from cangauge.model.voltage_model import VoltageModel

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
COLDER_AND_WARMER = ("0", "10", "40")
LOGS_EACH = 5
ROWS_AT_LEAST = 100


def main() -> None:
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recorded logs")
    folder = parser.parse_args().data
    table = Table(title="Voltage error on other logs, median over the models [V]")
    for heading in (
        "model of", "tested on", "models", "without prior", "with prior", "better with prior",
        "kt without prior [V/K]", "kt with prior [V/K]",
    ):  # fmt: skip
        table.add_column(heading, justify="right")
    at_25c = [_pack(folder / "lg_hg2" / f"{name}.parquet") for name in LG_25C]
    of_cells = FitOptions(capacity_ah=LG_CAPACITY_AH * LG_PARALLEL)
    others = {
        each: [_pack(path) for path in sorted((folder / "lg_hg2").glob(f"{each}degC*"))[:LOGS_EACH]]
        for each in COLDER_AND_WARMER
    }
    ones = [[log] for log in at_25c]
    for each, logs in {"25": at_25c, **others}.items():
        table.add_row("LG, 1 at 25 °C", f"{each} °C", *evaluated(ones, logs, of_cells))
    for each, logs in others.items():
        table.add_row("LG, 8 at 25 °C", f"{each} °C", *evaluated([at_25c], logs, of_cells))
    summer, held_out = summer_training(folder / "bmw_i3"), summer_held_out(folder / "bmw_i3")
    of_car = FitOptions(capacity_ah=capacity_from_reference(summer))
    for number in (1, 2, 3, len(summer)):
        runs = [summer[k : k + number] for k in range(len(summer) - number + 1)]
        title = f"i3, {number} in summer"
        table.add_row(title, "other summer trips", *evaluated(runs, held_out, of_car))
    Console().print(table)


def evaluated(
    models: Sequence[Sequence[Log]], logs: Sequence[Log], options: FitOptions
) -> tuple[str, ...]:
    """Return the cells of a row, starting with the number of models."""
    found, kt = [], []
    for training in models:
        rows = [fit_rows(log, options) for log in training]
        try:
            two = [
                fit_voltage_model(rows, options, with_kt_prior=with_prior)[0]
                for with_prior in (False, True)
            ]
        except InputError:  # SoC range too small
            continue
        kt.append([model.kt_v_per_k for model in two])
        found.append([error_v([log for log in logs if log not in training], options, model)
                      for model in two])  # fmt: skip
    without, with_ = np.array(found).T
    return (
        str(len(found)),
        f"{np.median(without):.2f}",
        f"{np.median(with_):.2f}",
        f"{np.sum(with_ < without)} of {len(found)}",
        *(f"{min(each):.2f} … {max(each):.2f}" for each in zip(*kt, strict=True)),
    )


def error_v(logs: Sequence[Log], options: FitOptions, model: VoltageModel) -> float:
    """Return the RMSE over logs, equally weighted [V]."""
    squares = []
    low, high = model.soc_range_pct
    for rows in (fit_rows(log, options) for log in logs):
        inside = (rows.soc_pct >= low) & (rows.soc_pct <= high)
        if inside.sum() >= ROWS_AT_LEAST:
            volts = model.voltage(rows.soc_pct, rows.temperature_c, rows.delayed_current_a)
            squares.append(np.mean((rows.voltage_v - volts)[inside] ** 2))
    return float(np.sqrt(np.mean(squares))) if squares else float("nan")


def _pack(path: Path) -> Log:
    pack = scaled_to_pack(read_log(path), series=LG_SERIES, parallel=LG_PARALLEL)
    return with_initial_soc(pack, 100.0)


if __name__ == "__main__":
    main()
