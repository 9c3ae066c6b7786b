"""Cost of the estimator's core: step in Python and compiled, and on a Cortex-M4F.

    python benchmarks/core_cost.py [--bits FOLDER] [--json]

step    processor time of a step, at 10 Hz and at 1 Hz (at 1 Hz every step uses a voltage), of the
        published Leaf model: the reference in Python, the compiled one sample by sample as in the
        service, and over columns as offline. Median of five interleaved rounds.
target  flash of core, model and frames, memory, and instructions of a step with floats, from the
        exported sources on QEMU's mps2-an386, of a curve of knots as `fit` writes it and of the
        published equation. `filter`: prediction and update by one voltage, beside the same filter
        in generic matrix code (matrix_ekf.c). Left out without gcc-arm-none-eabi or QEMU.
bits    estimates of every judged log of the recorded packs in a folder, by Python, by the compiled
        step (numbers that differ by more than 1e-9) and by the exported sources with floats
        (largest difference of the SoC [%]).
line    the same difference on trips of the i3 at 10 Hz, by the period that the delay line has
        memory for.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.table import Table

from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.estimation.compiled import CompiledEstimator, make_estimator
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.embedded.embedded import PERIOD_S, export_c
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.model.published import leaf_2012_model_file
from cangauge.types import Sample
from packs.recorded import Pack, load

MODEL: Final = leaf_2012_model_file()
SETTINGS: Final = EstimatorSettings(initial_soc_pct=80.0)
SAMPLES: Final = 20000
ROUNDS: Final = 5
PERIODS_S: Final = (0.1, 0.5, 1.0)


def drive(step_s: float) -> list[Sample]:
    """Return a drive of load steps from 80 to 20 % with a white error of 0.5 V."""
    rng = np.random.default_rng(1)
    voltage = MODEL.voltage_model()
    current = np.repeat(rng.uniform(-40.0, 60.0, SAMPLES // 50 + 1), 50)[:SAMPLES]
    soc = np.linspace(80.0, 20.0, SAMPLES)
    volts = voltage.pseudo_ocv(soc) + sum(voltage.resistance_ohm) * current
    volts += rng.normal(0.0, 0.5, SAMPLES)
    rows = zip(step_s * np.arange(SAMPLES), current, volts, np.full(SAMPLES, 22.0), strict=True)
    return [Sample(*map(float, row)) for row in rows]


def step_costs() -> list[dict[str, Any]]:
    """Measure the processor time of a step [µs]."""
    found = []
    for rate_hz in (10.0, 1.0):
        samples = drive(1.0 / rate_hz)
        columns = list(np.array(samples).T.copy())

        def each(estimator: Estimator, samples: list[Sample] = samples) -> None:
            for sample in samples:
                estimator.update(sample)

        def whole(estimator: Estimator, columns: list[np.ndarray] = columns) -> None:
            assert isinstance(estimator, CompiledEstimator)  # noqa: S101
            estimator.run(columns)

        ways: dict[str, tuple[Callable[..., Estimator], Callable[[Estimator], None]]] = {
            "python": (Estimator, each),
            "compiled": (make_estimator, each),
            "compiled, columns": (make_estimator, whole),
        }
        took: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(ROUNDS):
            for name, (make, run) in ways.items():
                estimator = make(MODEL, SETTINGS)
                began = time.process_time()
                run(estimator)
                took[name].append(1e6 * (time.process_time() - began) / SAMPLES)
        found += [
            {"rate_hz": rate_hz, "way": name, "us": statistics.median(values)}
            for name, values in took.items()
        ]
    return found


def target_costs(model: Model) -> dict[str, Any]:
    """Measure flash, memory [B] and instructions on a Cortex-M4F."""

    def make_arm() -> str:
        done = subprocess.run(
            ["make", "arm"],  # noqa: S607
            cwd=folder, capture_output=True, text=True, check=True,
        )  # fmt: skip
        return done.stdout

    with tempfile.TemporaryDirectory() as folder:
        export_c(model, Path(folder))
        output = make_arm()
        of_filter = {}
        if model.equation == "knots":  # the published equation has no states of its curve
            shutil.copy(Path(__file__).with_name("matrix_ekf.c"), Path(folder, "test.c"))
            numbers = re.findall(r"filter .*: core (\d+), matrices (\d+)", make_arm())
            names = ("filter_instructions", "filter_bytes")
            of_filter = {
                name: f"{a}, matrices {b}" for name, (a, b) in zip(names, numbers, strict=True)
            }
    sizes = re.findall(r"^ *(\d+)(?:\s+\w+){4}\s+(\w+)\.o$", output, re.MULTILINE)
    text = {name: int(size) for size, name in sizes}
    parts = dict(re.findall(r"(state|delay line|constants) (\d+)", output))
    steps = re.search(r"instructions: (\d+) a sample, (\d+) .* most (\d+)", output)
    assert steps is not None  # noqa: S101
    return {
        "flash_core": sum(text[name] for name in text if name.startswith("cangauge")),
        "flash_model": text["pack_model"],
        "flash_frames": text["frames"],
        "ram_state": int(parts["state"]),
        "ram_delay_line": int(parts["delay line"]),
        "instructions_sample": int(steps[1]),
        "instructions_voltage": int(steps[2]),
        "instructions_at_most": int(steps[3]),
        **of_filter,
    }  # fmt: skip


def fitted(pack: Pack) -> Model:
    """Return the model of the first three training logs."""
    training = pack.training[:3]
    model = fit(training, capacity_ah=pack.capacity_of(training)).model
    model.extended_model()
    return model


def float_error_pct(model: Model, logs: Sequence[Log], period_s: float = PERIOD_S) -> float:
    """Return the largest difference of the exported sources, with floats, from Python [% SoC]."""
    worst = 0.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        export_c(model, folder, period_s=period_s)
        build = ["make", "example", "CC=cc -DCANGAUGE_REAL=float"]
        subprocess.run(build, cwd=folder, capture_output=True, check=True)
        for log in logs:
            rows = "".join(",".join(map(repr, sample)) + "\n" for sample in samples_of(log))
            lines = subprocess.run(
                ["./example"], cwd=folder, input=rows, capture_output=True, text=True, check=True
            ).stdout.splitlines()
            soc_pct = np.array([float(line.split()[1]) for line in lines])
            expected = run_estimator(log, model, EstimatorSettings()).soc_pct
            worst = max(worst, float(np.nanmax(np.abs(soc_pct - expected))))
    return worst


def line_errors(folder: Path) -> dict[str, float]:
    """Return the difference of the SoC on trips at 10 Hz, by the delay line's period [%]."""
    model = fitted(load(folder, ["i3"])[0])
    trips = [read_log(folder / "bmw_i3" / f"TripA0{k}.csv.gz") for k in (2, 4, 6, 7, 8)]
    return {f"{period_s:g} s": float_error_pct(model, trips, period_s) for period_s in PERIODS_S}


def differing_bits(folder: Path) -> dict[str, dict[str, Any]]:
    """Compare all on every judged log of the recorded packs."""
    found: dict[str, dict[str, Any]] = {}
    for pack in load(folder):
        try:
            model = fitted(pack)
        except InputError as error:
            found[pack.name] = {"numbers": 0, "differ": 0, "failed": str(error)}
            continue
        numbers = differ = 0
        for log in pack.judged:
            table = run_estimator(log, model, EstimatorSettings())
            reference = Estimator(model, EstimatorSettings())
            expected = np.array([reference.step(sample)[1:7] for sample in samples_of(log)])
            names = ("soc_pct", "soc_std_pct", "soc_newton_pct", "soc_coulomb_pct",
                     "voltage_model_v", "residual_v")  # fmt: skip
            columns = np.column_stack([getattr(table, name) for name in names])
            both = np.isclose(columns, expected, rtol=1e-9, atol=1e-9, equal_nan=True)
            numbers += both.size
            differ += int((~both).sum())
        float_pct = float_error_pct(model, pack.judged)
        found[pack.name] = {"numbers": numbers, "differ": differ, "float_pct": float_pct}
    return found


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bits", type=Path, metavar="FOLDER", help="recorded packs to compare on")
    parser.add_argument("--json", action="store_true", help="print JSON")
    given = parser.parse_args()
    result: dict[str, Any] = {"step": step_costs()}
    if shutil.which("arm-none-eabi-gcc") and shutil.which("qemu-system-arm"):
        result["knots"] = target_costs(Model.prior("oxide", 96, 60.0))
        result["published"] = target_costs(MODEL)
    if given.bits is not None:
        result["line"] = line_errors(given.bits)
        result["bits"] = differing_bits(given.bits)
    if given.json:
        print(json.dumps(result, indent=1))
        return
    console = Console()
    table = Table("rate [Hz]", "step", "µs", title="Processor time of a step")
    for row in result["step"]:
        table.add_row(f"{row['rate_hz']:g}", row["way"], f"{row['us']:.2f}")
    console.print(table)
    for name in ("knots", "published", "line", "bits"):
        if result.get(name):
            table = Table(name, "", title=name)
            for key, value in result[name].items():
                table.add_row(key, str(value))
            console.print(table)


if __name__ == "__main__":
    main()
