"""Cost of the estimator's core: step in Python and compiled, and on a Cortex-M4F.

    python benchmarks/core_cost.py [--data FOLDER] [--keep]

step    processor time of a step, at 10 Hz and at 1 Hz (at 1 Hz every step uses a voltage), of the
        published Leaf model: the reference in Python, the compiled one sample by sample as in the
        service, and over columns as offline. Median of five interleaved rounds.
target  flash of core, model and frames, memory, and instructions of a step with floats, from the
        exported sources on QEMU's mps2-an386, of a curve of knots as `fit` writes it and of the
        published equation; beside them a plain filter (plain_ekf.c). Left out without
        gcc-arm-none-eabi or QEMU.
bits    estimates of every judged log of the recorded packs in a folder, by Python, by the compiled
        step (numbers that differ by more than 1e-9) and by the exported sources with floats
        (largest difference of the SoC [%]).
line    the same difference on trips of the i3 at 10 Hz, by the period that the delay line has
        memory for.
"""

from __future__ import annotations

import argparse
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
from rich.table import Table

from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.estimation.compiled import CompiledEstimator, make_estimator
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import run_estimator, samples_of, step_all
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.embedded.embedded import PERIOD_S, export_c
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.model.published import leaf_2012_model_file
from cangauge.types import Sample
from figures import publish
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
    volts = voltage.pseudo_ocv(soc) + sum(voltage.loads.resistance_ohm) * current
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


def run_arm(folder: Path) -> str:
    """Build an export for the Cortex-M4F, run it, and return what it prints."""
    done = subprocess.run(
        ["make", "arm"],  # noqa: S607
        cwd=folder, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return done.stdout


def target_costs(model: Model) -> list[int]:
    """Measure an export: bytes of flash and memory, and instructions; see `TARGET`."""
    with tempfile.TemporaryDirectory() as folder:
        export_c(model, Path(folder))
        output = run_arm(Path(folder))
    sizes = re.findall(r"^ *(\d+)(?:\s+\w+){4}\s+(\w+)\.o$", output, re.MULTILINE)
    text = {name: int(size) for size, name in sizes}
    parts = dict(re.findall(r"(state|delay line|constants) (\d+)", output))
    steps = re.search(r"instructions: (\d+) a sample, (\d+) .* most (\d+)", output)
    assert steps is not None  # noqa: S101
    core = sum(text[name] for name in text if name.startswith("cangauge"))
    flash = [core, text["pack_model"], text["frames"]]
    memory = [int(parts["state"]), int(parts["delay line"])]
    return [*flash, *memory, *map(int, steps.groups())]


def plain_costs(model: Model) -> list[int]:
    """Measure the plain filter: memory [B], mean and largest number of instructions."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        export_c(model, folder)
        shutil.copy(Path(__file__).with_name("plain_ekf.c"), folder / "test.c")
        output = run_arm(folder)
    found = re.search(r"plain filter: (\d+) instructions, at most (\d+); (\d+) bytes", output)
    assert found is not None  # noqa: S101
    mean, most, size = map(int, found.groups())
    return [size, mean, most]


TARGET: Final = (
    "flash of the core [B]",
    "flash of the model's constants [B]",
    "flash of the frame [B]",
    "memory of the state [B]",
    "memory of the delay line [B]",
    "instructions of a sample",
    "instructions of a sample whose voltage is used (one a second)",
    "instructions of the largest sample",
)


def target_table() -> Table:
    """Measure on the Cortex-M4F."""
    typical = Model.prior("oxide", 96, 60.0)
    knots, published = target_costs(typical), target_costs(MODEL)
    size, mean, most = plain_costs(typical)
    plain = ["", "", "", f"{size:,}", "", f"{mean:,}", f"{mean:,}", f"{most:,}"]
    table = Table("", "curve of knots", "published equation", "plain filter", title="Cortex-M4F")
    for name, a, b, c in zip(TARGET, knots, published, plain, strict=True):
        table.add_row(name, f"{a:,}", f"{b:,}", c)
    return table


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
            reference = step_all(Estimator(model, EstimatorSettings()), samples_of(log))
            names = ("soc_pct", "soc_std_pct", "soc_newton_pct", "soc_coulomb_pct",
                     "voltage_model_v", "residual_v")  # fmt: skip
            columns, expected = (
                np.column_stack([getattr(each, name) for name in names])
                for each in (table, reference)
            )
            both = np.isclose(columns, expected, rtol=1e-9, atol=1e-9, equal_nan=True)
            numbers += both.size
            differ += int((~both).sum())
        float_pct = float_error_pct(model, pack.judged)
        found[pack.name] = {"numbers": numbers, "differ": differ, "float_pct": float_pct}
    return found


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="recorded packs to compare on")
    parser.add_argument("--keep", action="store_true", help="keep the figures for the documents")
    given = parser.parse_args()
    tables = []
    if shutil.which("arm-none-eabi-gcc") and shutil.which("qemu-system-arm"):
        tables.append(target_table())
    steps = Table("rate [Hz]", "implementation", "µs", title="Processor time of a step")
    for row in step_costs():
        steps.add_row(f"{row['rate_hz']:g}", row["way"], f"{row['us']:.2f}")
    tables.append(steps)
    if given.data is not None:
        lines = Table(
            "memory for a sample in", "SoC [%]", title="Floats against Python, i3 at 10 Hz"
        )
        for period, error_pct in line_errors(given.data).items():
            lines.add_row(period, f"{error_pct:.4f}")
        bits = Table("pack", "numbers", "differ by 1e-9", "floats, SoC [%]", title="Against Python")
        for pack, found in differing_bits(given.data).items():
            error = found.get("failed") or f"{found['float_pct']:.4f}"
            bits.add_row(pack, f"{found['numbers']:,}", str(found["differ"]), error)
        tables += [lines, bits]
    publish("core-cost", tables, ["core"], keeps=given.keep)


if __name__ == "__main__":
    main()
