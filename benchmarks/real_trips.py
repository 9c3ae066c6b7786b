"""Real trips of a BMW i3: identify on odd trips, estimate on even ones, print every figure.

    python benchmarks/real_trips.py --data FOLDER [--report trips.html] [--json] [--only plain|auto]

FOLDER holds TripA01.csv.gz … TripA22.csv.gz of "Battery and Heating Data in Real Driving Cycles"
(IEEE DataPort). The model and the capacity come from A01, A03 … A21 alone; A02, A04 … A22 longer
than 15 minutes judge it. The car's own SoC is the reference. The data ends when the car stops, so
chained trips are connected by 12 minutes with a current but no voltage, whose charge equals the
SoC change of the car in each method's capacity, without offset. In the cases "counted" it is the
true charge, to be counted with the wrong capacity, as by a pipeline that is always on. All is done
twice: with the 13 coefficients, and with the effects that `--effects auto` finds on the same
training trips.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from cangauge.estimation.offline import EstimateTable, run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.identify.evaluate import LogFit, evaluate
from cangauge.identify.fit import Identification, fit
from cangauge.identify.rows import fit_rows
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.coulomb_counting import capacity_from_reference
from cangauge.model.model_file import Model
from cangauge.types import Sample

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "bmw_i3"
TRAINING = [f"A{number:02d}" for number in range(1, 22, 2)]
TEST = [f"A{number:02d}" for number in range(2, 23, 2)]
JUDGED_S = 15 * 60.0
"""Only longer test trips are evaluated [s]."""
SETTLED_S = 5 * 60.0
"""Excluded start of a trip without an initial SoC [s]."""
RECOVERED_S = 10 * 60.0
"""Excluded start of a trip with a wrong initial SoC [s]."""
SEAM_S, SEAM_CHARGING_S = 720, 600
"""Time between two chained trips, and its part with a current [s]."""
OFFSET_A = 3.0
CAPACITY_ERROR = 0.05
WRONG_PCT = 20.0
"""Error of a wrong initial SoC [%]."""


@dataclass(frozen=True)
class Figures:
    """Errors of one case against the reference, in % SoC."""

    rows: int
    mae_pct: float
    rmse_pct: float
    max_pct: float
    cover_2sigma: float
    mean_std_pct: float
    newton_mae_pct: float
    coulomb_mae_pct: float


def figures(table: EstimateTable, reference_pct: np.ndarray, after_s: float = 0.0) -> Figures:
    """Compare with the reference from `after_s` seconds after the start."""
    known = np.isfinite(reference_pct) & (table.time_s - table.time_s[0] >= after_s)
    error = (table.soc_pct - reference_pct)[known]
    std = table.soc_std_pct[known]
    return Figures(
        rows=int(known.sum()),
        mae_pct=float(np.abs(error).mean()),
        rmse_pct=float(np.sqrt(np.mean(error**2))),
        max_pct=float(np.abs(error).max()),
        cover_2sigma=float(np.mean(np.abs(error) <= 2.0 * std)),
        mean_std_pct=float(std.mean()),
        newton_mae_pct=float(np.nanmean(np.abs((table.soc_newton_pct - reference_pct)[known]))),
        coulomb_mae_pct=float(np.abs((table.soc_coulomb_pct - reference_pct)[known]).mean()),
    )


def pooled(parts: Sequence[Figures]) -> Figures:
    """Return the figures over all rows of several trips."""
    rows = np.array([part.rows for part in parts], dtype=float)

    def mean(name: str) -> float:
        return float(rows @ [getattr(part, name) for part in parts] / rows.sum())

    square = rows @ [part.rmse_pct**2 for part in parts] / rows.sum()
    return Figures(
        rows=int(rows.sum()),
        mae_pct=mean("mae_pct"),
        rmse_pct=math.sqrt(square),
        max_pct=max(part.max_pct for part in parts),
        cover_2sigma=mean("cover_2sigma"),
        mean_std_pct=mean("mean_std_pct"),
        newton_mae_pct=mean("newton_mae_pct"),
        coulomb_mae_pct=mean("coulomb_mae_pct"),
    )


def read_trips(folder: Path, names: Sequence[str]) -> list[Log]:
    """Read trips by name."""
    return [read_log(folder / f"Trip{name.removeprefix('Trip')}.csv.gz") for name in names]


def identify(
    training: Sequence[Log],
    effects: tuple[str, ...] = (),
) -> Identification:
    """Fit model, capacity and effects to the training trips."""
    return fit(
        training, capacity_ah=capacity_from_reference(training), chemistry="oxide",
        effects=effects or "none",
    )  # fmt: skip


def predict(identification: Identification, tests: Sequence[Log]) -> tuple[LogFit, ...]:
    """Return the fit of other trips by the model, on the rows that a fit uses."""
    model = identification.model
    extended = model.extended_model()
    return tuple(evaluate(extended, trip, fit_rows(trip, model.capacity_ah)) for trip in tests)


def estimate(log: Log, model: Model, initial_pct: float | None) -> EstimateTable:
    """Run the EKF over a trip, from an initial SoC (σ 1 %) or from the first voltages."""
    start = None if initial_pct is None else min(max(initial_pct, 0.0), 100.0)
    return run_estimator(samples_of(log), model, EstimatorSettings(initial_soc_pct=start))


def chain(
    trips: Sequence[Log], capacity_ah: float, offset_a: float
) -> tuple[list[Sample], np.ndarray]:
    """Chain trips; return samples and reference SoC [%] (NaN between trips).

    Parameters
    ----------
    trips : sequence of Log
    capacity_ah : float
        Capacity that converts the SoC changes between trips to charge [Ah].
    offset_a : float
        Added to the current of the trips [A].
    """
    samples: list[Sample] = []
    reference: list[np.ndarray] = []
    start_s, last_pct = 0.0, math.nan
    for trip in trips:
        soc = _reference(trip)
        if samples:
            seam = _seam(start_s, soc[0] - last_pct, capacity_ah, float(trip.temperature_c[0]))
            samples += seam
            reference.append(np.full(len(seam), np.nan))
            start_s += SEAM_S
        begin_s = start_s - trip.time_s[0]
        samples += [
            item._replace(time_s=item.time_s + begin_s, current_a=item.current_a + offset_a)
            for item in samples_of(trip)
        ]
        reference.append(soc)
        start_s, last_pct = samples[-1].time_s, soc[np.isfinite(soc)][-1]
    return samples, np.concatenate(reference)


def _seam(
    start_s: float, gained_pct: float, capacity_ah: float, temperature_c: float
) -> list[Sample]:
    time_s = start_s + np.arange(SEAM_S) + 0.5
    current_a = np.zeros(SEAM_S)
    current_a[10:SEAM_CHARGING_S] = 1.0
    moved_ah = float(np.trapezoid(current_a, time_s)) / 3600.0
    current_a *= -gained_pct / 100.0 * capacity_ah / moved_ah
    return [
        Sample(time, current, math.nan, temperature_c)
        for time, current in zip(time_s.tolist(), current_a.tolist(), strict=True)
    ]


def _reference(trip: Log) -> np.ndarray:
    if trip.soc_pct is None:
        raise SystemExit(f"{trip.name} has no reference SoC")
    return trip.soc_pct


CHAINS = {
    "chain": (0.0, 0.0, True),
    "chain_offset": (OFFSET_A, 0.0, True),
    "chain_capacity_high": (0.0, CAPACITY_ERROR, True),
    "chain_capacity_low": (0.0, -CAPACITY_ERROR, True),
    # True charge between trips, counted with the wrong capacity.
    "chain_capacity_high_counted": (0.0, CAPACITY_ERROR, False),
    "chain_capacity_low_counted": (0.0, -CAPACITY_ERROR, False),
}
"""Chain → current offset [A], relative capacity error, whether charge between trips is in the wrong
capacity."""

UNCHECKED = {"chain", "chain_capacity_high_counted", "chain_capacity_low_counted"}
"""Chains without a target."""

CHECKED = {name: errors for name, errors in CHAINS.items() if name not in UNCHECKED}


def judge(
    folder: Path,
    console: Console,
    effects: tuple[str, ...] = (),
    chains: Mapping[str, tuple[float, float, bool]] = CHAINS,
) -> dict[str, object]:
    """Run the comparison and return its figures."""
    console.print("reading 22 trips, fitting 11 of them …")
    began = time.perf_counter()
    identification = identify(read_trips(folder, TRAINING), effects)
    fit_seconds = time.perf_counter() - began
    model = identification.model
    all_tests = read_trips(folder, TEST)
    tests = [trip for trip in all_tests if trip.duration_s > JUDGED_S]
    voltage = predict(identification, tests)
    rows = sum(len(item.rows) for item in voltage)
    result: dict[str, object] = {
        "fit_seconds": fit_seconds,
        "effects": model.effects,
        "training_held_out_rmse_v": model.noise.voltage_rmse_v,
        "voltage_rmse_v": _rms(np.concatenate([item.residual_v for item in voltage])),
        "capacity_ah": model.capacity_ah,
        "training_voltage_mae_pct": identification.voltage_mae_pct,
        "voltage_mae_pct": sum(i.voltage_mae_pct * len(i.rows) for i in voltage) / rows,
        "soc_newton_mae_pct": sum(i.soc_newton_mae_pct * len(i.rows) for i in voltage) / rows,
    }
    trips = []
    for trip, item in zip(tests, voltage, strict=True):
        console.print(f"estimating {trip.name} in four ways …")
        soc = _reference(trip)
        cases = {
            "withheld": figures(estimate(trip, model, None), soc, SETTLED_S),
            "given": figures(estimate(trip, model, soc[0]), soc),
            "wrong_low": figures(estimate(trip, model, soc[0] - WRONG_PCT), soc, RECOVERED_S),
            "wrong_high": figures(estimate(trip, model, soc[0] + WRONG_PCT), soc, RECOVERED_S),
        }
        trips.append(
            {
                "trip": trip.name,
                "minutes": trip.duration_s / 60.0,
                "voltage_mae_pct": item.voltage_mae_pct,
                "voltage_bias_v": float(item.residual_v.mean()),
                "soc_newton_mae_pct": item.soc_newton_mae_pct,
                "cases": cases,
            }
        )
    result["trips"] = trips
    cases = {name: pooled([trip["cases"][name] for trip in trips]) for name in trips[0]["cases"]}
    for name, (offset_a, error, counts_with_capacity) in chains.items():
        console.print(f"estimating the {name.replace('_', ' ')} …")
        capacity_ah = model.capacity_ah * (1.0 + error)
        samples, soc = chain(
            tests, capacity_ah if counts_with_capacity else model.capacity_ah, offset_a
        )
        settings = EstimatorSettings(initial_soc_pct=float(soc[0]), capacity_ah=capacity_ah)
        table = run_estimator(samples, model, settings)
        cases[name] = figures(table, soc)
        result["chain_hours"] = (samples[-1].time_s - samples[0].time_s) / 3600.0
    result["cases"] = cases
    return result


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


TARGETS = (
    ("voltage MAE", "%", 0.25, lambda r: r["voltage_mae_pct"]),
    ("SoC MAE by Newton", "%", 2.0, lambda r: r["soc_newton_mae_pct"]),
    ("EKF, SoC withheld: MAE after 5 min", "%", 1.7, lambda r: r["cases"]["withheld"].mae_pct),
    (
        "EKF, start 20 % too low: MAE after 10 min against withheld",
        "%",
        lambda r: r["cases"]["withheld"].mae_pct,
        lambda r: r["cases"]["wrong_low"].mae_pct,
    ),
    (
        "EKF, start 20 % too high: MAE after 10 min against withheld",
        "%",
        lambda r: r["cases"]["withheld"].mae_pct,
        lambda r: r["cases"]["wrong_high"].mae_pct,
    ),
    *(
        (
            f"{case}: EKF MAE against the better of Newton and counting",
            "%",
            lambda r, case=case: min(
                r["cases"][case].newton_mae_pct, r["cases"][case].coulomb_mae_pct
            ),
            lambda r, case=case: r["cases"][case].mae_pct,
        )
        for case in ("chain_offset", "chain_capacity_high", "chain_capacity_low")
    ),
)
"""Targets: name, unit, limit or function of the result, value."""

WITH_EFFECTS = (
    ("with effects: SoC MAE by Newton", "%", 1.2, lambda r: r["soc_newton_mae_pct"]),
    (
        "with effects: EKF, SoC withheld: MAE after 5 min", "%", 1.2,
        lambda r: r["cases"]["withheld"].mae_pct,
    ),
)  # fmt: skip
"""Further targets of the model with effects."""


def checks(result: dict[str, object]) -> list[dict[str, object]]:
    """Return all targets with value and result."""
    rows: list[dict[str, object]] = []
    for name, unit, limit, value in (*TARGETS, *(WITH_EFFECTS if result["effects"] else ())):
        bound = limit(result) if callable(limit) else limit
        rows.append(_check(name, unit, value(result), "≤", bound))
    for case, item in result["cases"].items():
        if case in UNCHECKED:
            continue
        rows.append(_check(f"{case}: 2σ coverage", "", item.cover_2sigma, "≥", 0.90))
        rows.append(_check(f"{case}: 2σ coverage", "", item.cover_2sigma, "≤", 0.99))
        ratio = item.mean_std_pct / item.rmse_pct
        rows.append(_check(f"{case}: mean σ over RMSE", "", ratio, "≤", 1.5))
    return rows


def _check(name: str, unit: str, value: float, sign: str, bound: float) -> dict[str, object]:
    met = value <= bound if sign == "≤" else value >= bound
    return {
        "name": name, "unit": unit, "value": value, "sign": sign, "bound": bound, "met": met,
    }  # fmt: skip


def show(result: dict[str, object], console: Console) -> None:
    """Print the tables."""
    console.print(
        f"voltage MAE {result['voltage_mae_pct']:.3f} %, RMSE {result['voltage_rmse_v']:.3f} V"
        f" (training trips left out in turn: {result['training_held_out_rmse_v']:.3f} V); Newton"
        f" SoC MAE {result['soc_newton_mae_pct']:.2f} %; fitted in {result['fit_seconds']:.0f} s"
    )
    for effect in result["effects"]:
        values = ", ".join(f"{name} {value:.4g}" for name, value in effect["parameters"].items())
        console.print(f"  {effect['id']}: {values}")
    table = Table(title="Test trips over 15 minutes (errors in % SoC against the car's own)")
    for heading in ("trip", "min", "U MAE %", "U bias V", "Newton MAE"):
        table.add_column(heading, justify="right")
    for heading in ("withheld", "given", "20 % low", "20 % high"):
        table.add_column(f"{heading}\nMAE (2σ holds)", justify="right")
    for trip in result["trips"]:
        table.add_row(
            trip["trip"],
            f"{trip['minutes']:.0f}",
            f"{trip['voltage_mae_pct']:.3f}",
            f"{trip['voltage_bias_v']:+.2f}",
            f"{trip['soc_newton_mae_pct']:.2f}",
            *(f"{c.mae_pct:.2f} ({100 * c.cover_2sigma:.0f} %)" for c in trip["cases"].values()),
        )
    console.print(table)
    table = Table(title=f"All test trips; chained: {result['chain_hours']:.2f} h")
    for heading in ("case", "EKF MAE", "EKF RMSE", "max", "Newton MAE", "Coulomb MAE", "2σ holds",
                    "mean σ", "σ/RMSE"):  # fmt: skip
        table.add_column(heading, justify="right")
    for name, c in result["cases"].items():
        table.add_row(
            name.replace("_", " "),
            *(f"{v:.2f}" for v in (c.mae_pct, c.rmse_pct, c.max_pct, c.newton_mae_pct,
                                   c.coulomb_mae_pct)),
            f"{100 * c.cover_2sigma:.1f} %",
            f"{c.mean_std_pct:.2f}",
            f"{c.mean_std_pct / c.rmse_pct:.2f}",
        )  # fmt: skip
    console.print(table)
    table = Table(
        title=f"Targets (capacity from the training trips: {result['capacity_ah']:.2f} Ah)"
    )
    for heading in ("target", "value", "limit", "met"):
        table.add_column(heading)
    for row in result["checks"]:
        table.add_row(
            str(row["name"]),
            f"{row['value']:.3f} {row['unit']}",
            f"{row['sign']} {row['bound']:.3f}",
            "yes" if row["met"] else "NO",
        )
    console.print(table)


def draw(result: dict[str, object], folder: Path, path: Path) -> None:
    """Write one HTML page with SoC against the car's for each test trip."""
    from bokeh.layouts import gridplot  # noqa: PLC0415 - only with --report
    from bokeh.plotting import figure, output_file, save  # noqa: PLC0415
    from bokeh.resources import INLINE  # noqa: PLC0415

    identification = identify(read_trips(folder, TRAINING))
    plots = []
    for row in result["trips"]:
        trip = read_trips(folder, [row["trip"]])[0]
        soc = _reference(trip)
        table = estimate(trip, identification.model, None)
        every = slice(None, None, max(1, len(trip) // 1500))
        minutes = (trip.time_s - trip.time_s[0])[every] / 60.0
        low = np.clip(table.soc_pct - 2.0 * table.soc_std_pct, 0.0, 100.0)[every]
        high = np.clip(table.soc_pct + 2.0 * table.soc_std_pct, 0.0, 100.0)[every]
        plot = figure(
            width=620,
            height=300,
            title=f"{row['trip']}: SoC withheld, MAE after 5 min"
            f" {row['cases']['withheld'].mae_pct:.2f} %",
            x_axis_label="time [min]",
            y_axis_label="SoC [%]",
            y_range=(float(np.nanmin(soc)) - 8.0, float(np.nanmax(soc)) + 8.0),
        )
        plot.varea(minutes, low, high, fill_alpha=0.2, legend_label="EKF ±2σ")
        plot.line(minutes, table.soc_newton_pct[every], color="silver", legend_label="Newton")
        plot.line(minutes, table.soc_pct[every], line_width=2, legend_label="EKF")
        plot.line(minutes, soc[every], color="black", line_dash="dashed", legend_label="car")
        plot.legend.label_text_font_size = "8pt"
        plot.legend.background_fill_alpha = 0.5
        plots.append(plot)
    output_file(path, title="BMW i3 test trips", mode="inline")
    save(gridplot(plots, ncols=2), resources=INLINE)


def main() -> int:
    """Run the comparison."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the trips")
    parser.add_argument("--report", type=Path, help="write a page with a plot of each test trip")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--only", choices=["plain", "auto"], help="only this model")
    options = parser.parse_args()
    if not options.data.is_dir():
        sys.stderr.write(f"{options.data}: no such folder; give the trips' with --data\n")
        return 2
    console = Console(stderr=True)
    results: dict[str, dict[str, object]] = {}
    for name, effects in (("plain", ()), ("auto", ("auto",))):
        if options.only in {None, name}:
            results[name] = judge(options.data, console, effects)
            results[name]["checks"] = checks(results[name])
    if options.report and "plain" in results:
        draw(results["plain"], options.data, options.report)
        console.print(f"wrote {options.report}")
    if options.json:
        sys.stdout.write(json.dumps(results, default=asdict) + "\n")
        return 0
    titles = {"plain": "The 13 coefficients", "auto": "With --effects auto"}
    for name, result in results.items():
        out = Console(width=140)
        out.rule(titles[name])
        show(result, out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
