"""Time of a step and accuracy beside other packages, each fitted to the same training logs.

    make bench DATA=FOLDER                          # or
    python benchmarks/peers.py --data FOLDER --peers ENVIRONMENT/bin/python [--keep]

The peers' versions are in peers.txt. Packs: the i3's even trips, and every second piece of car1, at
1 Hz, with models of ten training logs. The peers' circuit is the `equivalent_circuit` of the model
of those logs; PyBatterySE identifies its own from them, and takes only the curve. All begin from
the first voltage, σ 10 %; the MAE counts from the fifth minute on. Times are of the processor, of
one process at a time, in turn, the median of the rounds. A sample at 10 Hz is 0.1 s; our filter
uses the voltage once a second.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from equivalent_circuit import equivalent_circuit
from figures import publish
from packs.recorded import load, one_hz

PACKS = ("i3", "car1")
TRAINING_LOGS, SEED = 10, 0
SETTLED_S = 300.0
"""Excluded start of a log [s]."""
TIMED = "TripA06.csv.gz"
"""Log of the timings, at 10 Hz."""
TIMED_ROWS = 2000
PEERS = ("filterpy EKF", "thevenin step", "PyBatterySE EKF", "PyBaMM Thevenin step", "ProgPy UKF")
OURS = "cangauge"

Result = dict[str, Any]


def step_us(
    make: Callable[..., Estimator], model: Model, log: Log, rows: int = TIMED_ROWS
) -> float:
    """Return the time of a sample with its estimate [µs]."""
    estimator = make(model, EstimatorSettings())
    samples = list(samples_of(log.rows(slice(0, rows))))
    began = time.process_time()
    for sample in samples:
        estimator.update(sample)
        estimator.estimate  # noqa: B018 - the reading is what is timed
    return 1e6 * (time.process_time() - began) / len(samples)


def prepare(data: Path) -> tuple[Result, dict[str, list[Log]], dict[str, Model]]:
    """Fit the models; return what the peers are given, the judged logs and our models."""
    work: Result = {"packs": {}}
    judged, models = {}, {}
    for pack in load(data, PACKS):
        _, training, judged[pack.name] = next(pack.draws(TRAINING_LOGS, 1, SEED))
        models[pack.name] = fit(
            training,
            capacity_ah=pack.capacity_of(training),
            chemistry=pack.chemistry,
            cells=pack.cells,
            effects="none",
        ).model
        tables = _tables(models[pack.name])
        work["packs"][pack.name] = {
            "tables": tables,
            "training": [_columns(one_hz(log)) for log in training],
            "judged": [_columns(log) for log in judged[pack.name]],
        }
    fast = read_log(data / "bmw_i3" / TIMED)
    slow = fast.rows(slice(0, None, 10))
    logs = {"10 Hz": fast, "1 Hz": slow}
    judged["timing"] = list(logs.values())
    work["timing"] = {
        "tables": work["packs"]["i3"]["tables"],
        "rows": TIMED_ROWS,
        "logs": {rate: _columns(log.rows(slice(0, TIMED_ROWS))) for rate, log in logs.items()},
    }
    return work, judged, models


def _tables(model: Model) -> Result:
    return equivalent_circuit(model) | {"noise_v": model.noise.voltage_rmse_v}


def _columns(log: Log) -> Result:
    names = ("time_s", "current_a", "voltage_v", "soc_pct")
    columns = {name: np.asarray(getattr(log, name)).tolist() for name in names}
    start = log.first_soc()
    means = {"mean_c": float(np.mean(log.temperature_c))}
    return columns | means | {"start_pct": None if start is None else start[1]}


def mae_pct(soc_pct: Sequence[Sequence[float]], logs: Sequence[Log]) -> float:
    """Return the mean absolute error of all logs after their start [% SoC]."""
    errors = []
    for soc, log in zip(soc_pct, logs, strict=True):
        known = np.isfinite(log.soc_pct) & (log.time_s - log.time_s[0] >= SETTLED_S)
        errors.append(np.abs(np.asarray(soc) - log.soc_pct)[known])
    return float(np.concatenate(errors).mean())


def compare(folder: Path, python: Path, rounds: int) -> Result:
    """Return times [µs] and errors [% SoC] of all, by name."""
    sys.stderr.write("fitting the models of both packs …\n")
    work, judged, models = prepare(folder)
    timed = dict(zip(work["timing"]["logs"], judged.pop("timing"), strict=True))
    kinds = {f"{OURS}, pure Python": Estimator, OURS: make_estimator}
    found: Result = {name: {"us": {}, "mae_pct": {}} for name in (*PEERS, *kinds)}
    with tempfile.TemporaryDirectory() as made:
        path = Path(made) / "work.json"
        path.write_text(json.dumps(work), encoding="utf-8")
        for number in range(rounds):
            sys.stderr.write(f"round {number + 1} of {rounds} …\n")
            for name, make in kinds.items():
                for rate, log in timed.items():
                    us = step_us(make, models["i3"], log)
                    found[name]["us"].setdefault(rate, []).append(us)
            for name in PEERS:
                _add_peer(found[name], name, [python, path], judged if number == 0 else {})
            for data in work["packs"].values():  # the accuracy needs one round
                data["judged"] = data["judged"][:1]
            path.write_text(json.dumps(work), encoding="utf-8")
    for row in found.values():
        row["us"] = {rate: float(np.median(values)) for rate, values in row["us"].items()}
    for pack, logs in judged.items():
        tables = [run_estimator(log, models[pack], EstimatorSettings()) for log in logs]
        for name in kinds:  # the same bits
            found[name]["mae_pct"][pack] = mae_pct([table.soc_pct for table in tables], logs)
    return found


def _add_peer(
    row: Result, name: str, command: Sequence[Path], judged: dict[str, list[Log]]
) -> None:
    """Run a peer once; add its times, and its errors."""
    python, work = command
    script = Path(__file__).with_name("peer_filters.py")
    done = subprocess.run([python, script, name, work], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines()
        row["failure"] = lines[-1] if lines else f"exit code {done.returncode}"
        return
    result = json.loads(done.stdout)
    for rate, us in result["us"].items():
        row["us"].setdefault(rate, []).append(us)
    row["mae_pct"] |= {
        pack: mae_pct(soc_pct, judged[pack])
        for pack, soc_pct in result["soc_pct"].items()
        if pack in judged
    }


def table_of(found: Result) -> Table:
    """Return the table."""
    ours = found[OURS]["us"]
    table = Table()
    for heading in (
        "",
        "10 Hz [µs]",
        "ratio, 10 Hz",
        "1 Hz [µs]",
        "ratio, 1 Hz",
        "MAE i3 [%]",
        "MAE car1 [%]",
    ):
        table.add_column(heading, justify="right" if heading else "left")
    for name, row in found.items():
        cells = []
        for rate in ("10 Hz", "1 Hz"):
            us = row["us"].get(rate)
            cells += ["–", "–"] if us is None else [f"{us:.1f}", f"{us / ours[rate]:.1f}"]
        cells += [_percent(row["mae_pct"].get(pack)) for pack in PACKS]
        table.add_row(name + (f" ({row['failure']})" if "failure" in row else ""), *cells)
    return table


def draw(found: Result, path: Path) -> None:
    """Draw time of a step against error; models without a filter have no error."""
    import matplotlib as mpl  # noqa: PLC0415 - of the extra `figures`

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415

    figure, axes = plt.subplots(figsize=(9, 4.2), dpi=110)
    names = list(found)
    places = np.arange(len(names))
    for offset, rate in ((-0.2, "10 Hz"), (0.2, "1 Hz")):
        times = [row["us"].get(rate, np.nan) for row in found.values()]
        axes.barh(places + offset, times, height=0.38, label=f"samples at {rate}")
    for place, row in zip(places, found.values(), strict=True):
        errors = ", ".join(f"{pack} {_percent(row['mae_pct'].get(pack))} %" for pack in PACKS)
        longest = max(row["us"].values(), default=1.0)
        axes.text(1.15 * longest, place, errors if row["mae_pct"] else "no filter", va="center")
    axes.set(
        xscale="log", yticks=places, yticklabels=names, xlabel="processor time per sample [µs]",
        title="A sample with its estimate, and the mean error of the SoC",
    )  # fmt: skip
    axes.set_xlim(right=60.0 * axes.get_xlim()[1])
    axes.invert_yaxis()
    axes.legend(loc="lower right")
    figure.tight_layout()
    figure.savefig(path)


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def main() -> None:
    """Compare, print, and keep as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of the recorded logs")
    parser.add_argument("--peers", type=Path, required=True, help="Python with the peers")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--keep", action="store_true", help="keep the figures for the page")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="draw them (PNG)")
    options = parser.parse_args()
    try:
        found = compare(options.data, options.peers, options.rounds)
    except InputError as error:
        parser.error(str(error))
    if options.figure:
        draw(found, options.figure)
    describes = [f"src/cangauge/{name}" for name in ("model", "estimation")]
    publish("peers", [table_of(found)], [*describes, "core"], keeps=options.keep)


if __name__ == "__main__":
    main()
