"""What cangauge costs in time, and how it grows.

    python benchmarks/cost.py [--only NAME]… [--keep]

ratios    a step at 10 and 1 Hz, a row offline, and a wanted frame, as multiples of what does the
          same at its barest in the same run (filterpy's extended Kalman filter of an equivalent
          circuit; receiving and decoding by python-can and cantools): the machine cancels.
growth    with delays, effects, cells, frames/s.
fit       processor time and memory of `cangauge fit` by rows, read from Parquet and from CSV.
diagnosis by its logs, references and effects.
start     `--help` of every command.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import can
import cantools
import numpy as np
from rich.table import Table

from cangauge import simulate
from cangauge._resources import shared_file
from cangauge.bus.recording import read_log
from cangauge.bus.vehicle import Vehicle
from cangauge.cli.app import COMMANDS
from cangauge.diagnosis import diagnose
from cangauge.estimation.cells import CellEstimator
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.offline import run_estimator
from cangauge.estimation.settings import EstimatorSettings
from cangauge.identify.fit import fit
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.model.model_file import Coefficient, Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.types import Sample
from equivalent_circuit import equivalent_circuit
from figures import publish
from peer_filters import Circuit, bare_ekf, run
from peers import step_us

ROUNDS = 7
ROWS = 2000
"""Rows of a timed log: 200 s at 10 Hz."""
FIT_ROWS = (100_000, 1_000_000, 5_000_000)
ROWS_A_LOG = 50_000
EFFECTS = (
    {"id": "fast_polarization", "parameters": {"ohm": 0.01, "tau_s": 3.0, "activation_k": 0.0}},
    {"id": "resistance_temperature", "parameters": {
        "share": 0.3, "activation_k": 2500.0, "delayed": 1.0, "reference_c": 23.0}},
    {"id": "resistance_soc", "parameters": {
        "at_empty": 0.5, "at_full": 0.1, "width_pct": 10.0, "delayed": 1.0}},
    {"id": "hysteresis", "parameters": {"half_width_v": 0.5, "travel_pct": 2.0}},
)  # fmt: skip

Result = dict[str, Any]


def model() -> Model:
    """Return the model of the timings: the published one."""
    return Model.load(shared_file("replay", "leaf2012_published_model.json"))


def drive(rate_hz: int) -> Log:
    """Return a drive at 10 Hz, or every tenth row of it."""
    log = read_log(shared_file("replay", "leaf2012_reconstruction_white.parquet"))
    return log.rows(slice(0, ROWS * 10 // rate_hz, 10 // rate_hz))


def bare_step_us(known: Model, log: Log) -> float:
    """Return the time of a step of a bare filter [µs]."""
    circuit = Circuit(equivalent_circuit(known) | {"noise_v": 1.0}, 23.0)
    columns = {
        name: np.asarray(getattr(log, name)).tolist()
        for name in ("time_s", "current_a", "voltage_v")
    }
    return 1e6 * run(bare_ekf(circuit, 0.9), columns, ROWS)[1]


def frame_us(handle: Callable[[can.Message], object], frames: list[can.Message]) -> float:
    """Return the time to receive and handle a frame on a virtual bus [µs]."""
    with (
        can.Bus(interface="virtual", channel="cost") as receiver,
        can.Bus(interface="virtual", channel="cost") as sender,
    ):
        for frame in frames:
            sender.send(frame)
        began = time.process_time()
        for _ in frames:
            handle(receiver.recv(1.0))
        return 1e6 * (time.process_time() - began) / len(frames)


def wanted_frames(count: int) -> list[can.Message]:
    """Return frames of current, voltage and temperature at 10 Hz."""
    encoder = FrameEncoder(Vehicle.load("generic"))
    frames: list[can.Message] = []
    number = 0
    while len(frames) < count:
        sample = Sample(1.7e9 + 0.1 * number, 20.0 + number % 7, 380.0, 25.0)
        frames += encoder.encode(sample)
        number += 1
    return frames


def live_frame_us(frames: list[can.Message]) -> tuple[float, float]:
    """Return the time of a wanted frame in the service, and at its barest [µs]."""
    pipeline = Pipeline(Vehicle.load("generic"), model(), PipelineSettings())
    database = cantools.database.load_file(shared_file("dbc", "generic_pack.dbc"))
    layouts = {message.frame_id: message for message in database.messages}

    def handle(frame: can.Message) -> None:
        if pipeline.handle(frame):
            pipeline.latest  # noqa: B018 - the reading is what is timed

    def decode(frame: can.Message) -> object:
        return layouts[frame.arbitration_id].decode(frame.data)

    return frame_us(handle, frames), frame_us(decode, frames)


def ratios(rounds: int = ROUNDS) -> Result:
    """Return each ratio to its barest form, the median of rounds, with both times [µs]."""
    known, fast, slow, frames = model(), drive(10), drive(1), wanted_frames(3000)
    found: dict[str, list[tuple[float, float, float]]] = {}
    for _ in range(rounds):
        bare = bare_step_us(known, fast)
        began = time.process_time()
        run_estimator(fast, known, EstimatorSettings())
        offline = 1e6 * (time.process_time() - began) / len(fast)
        times = {
            "step at 10 Hz": (step_us(make_estimator, known, fast), bare),
            "step at 1 Hz": (step_us(make_estimator, known, slow), bare),
            "offline row at 10 Hz": (offline, bare),
            "live frame": live_frame_us(frames),
        }
        for name, pair in times.items():
            found.setdefault(name, []).append((pair[0] / pair[1], *pair))
    medians = {
        name: [statistics.median(values) for values in zip(*rows, strict=True)]
        for name, rows in found.items()
    }
    return {
        name: dict(zip(("ratio", "us", "bare_us"), row, strict=True))
        for name, row in medians.items()
    }


def with_delays(known: Model, number: int) -> Model:
    """Return a model with another number of delays, of the same sum of resistances."""
    delays = [0.0, *np.linspace(10.0, 70.0, number - 1).tolist()][:number]
    others = {k: v for k, v in known.coefficients.items() if not k.startswith("R")}
    total = sum(v.value for k, v in known.coefficients.items() if k.startswith("R"))
    ohm = Coefficient(value=total / number, unit="ohm")
    given = others | {f"R{k}": ohm for k in range(1, number + 1)}
    return known.model_copy(update={"delays_s": delays, "coefficients": given})


def growth() -> Result:
    """Return how a step at 1 Hz grows with the model, and a tick with its cells [µs]."""
    known, log = model(), drive(1)

    def median_us(changed: Model) -> float:
        return statistics.median(step_us(make_estimator, changed, log) for _ in range(3))

    result: Result = {
        "step at 1 Hz, delays [µs]": {
            number: median_us(with_delays(known, number)) for number in (1, 4, 8)
        },
        "step at 1 Hz, effects [µs]": {
            number: median_us(known.model_copy(update={"effects": list(EFFECTS[:number])}))
            for number in range(len(EFFECTS) + 1)
        },
        "cells, a second [µs]": {count: cells_us(count) for count in (1, 12, 96)},
    }
    means = result.setdefault("live frame, mean over N frames [µs]", {})
    for count in (300, 3000, 30_000):
        means[count] = live_frame_us(wanted_frames(count))[0]
    return result


def cells_us(count: int) -> float:
    """Return the time of a second of a pack with so many cell voltages [µs]."""
    known = model()
    estimator = make_estimator(known, EstimatorSettings(initial_soc_pct=80.0))
    cells = CellEstimator(known.voltage_model(), count)
    volts = np.full(count, 380.0 / count)
    total_s, ticks = 0.0, 300
    for number in range(ticks):
        sample = Sample(float(number), 20.0, 380.0, 25.0)
        estimator.update(sample)
        began = time.process_time()
        if cells.is_due(sample.time_s):
            cells.update(estimator.pack_tick(sample), volts, np.zeros(count))
        total_s += time.process_time() - began
    return 1e6 * total_s / ticks


def fits() -> Result:
    """Return what `cangauge fit` takes by its rows: in logs of 50,000, and all in one."""
    found: Result = {}
    with TemporaryDirectory() as folder:
        for suffix, rows, whole in product(("parquet", "csv"), FIT_ROWS, (False, True)):
            paths = []
            for log in _long_logs(
                1 if whole else rows // ROWS_A_LOG, rows if whole else ROWS_A_LOG
            ):
                paths.append(str(Path(folder, f"{log.name}.{suffix}")))
                write_log(log, paths[-1])
            name = f"{suffix}, {rows:,} rows in {len(paths)} {'log' if whole else 'logs'}"
            found[name] = _fit(paths, Path(folder, "model.json"))
            sys.stderr.write(f"{name}: {found[name]}\n")
            for path in paths:
                Path(path).unlink()
    return found


_FIT = """
import atexit, pathlib, sys
def peak():
    status = pathlib.Path("/proc/self/status").read_text().split()
    pathlib.Path(sys.argv[sys.argv.index("-o") + 1] + ".peak").write_text(
        status[status.index("VmHWM:") + 1])
atexit.register(peak)
from cangauge.cli.app import main
main()
"""
"""A fit that writes its peak memory [KiB] (Linux): that of `wait4` begins with its parent's."""


def _fit(paths: list[str], model_file: Path) -> Result:
    """Return processor time [s] and peak memory of a fit."""
    command = [sys.executable, "-c", _FIT, "fit", *paths, "-o", str(model_file)]
    process = subprocess.Popen([*command, "--capacity-ah", "60"], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit("the fit failed")
    peak_kib = float(model_file.with_name(f"{model_file.name}.peak").read_text(encoding="ascii"))
    return {"seconds": usage.ru_utime + usage.ru_stime, "peak_mib": peak_kib / 1024.0}


def _long_logs(number: int, rows: int) -> Iterator[Log]:
    """Yield logs at 1 Hz by the published equation with noise."""
    known = model().voltage_model()
    for seed in range(number):
        rng = np.random.default_rng(seed)
        time_s = np.arange(float(rows))
        pulses_a = 25.0 * rng.standard_normal(rows // 20)
        pairs_a = np.repeat(np.column_stack([pulses_a, -pulses_a]).ravel(), 10)
        current_a = 60.0 * 3600.0 * 0.9 / rows + pairs_a
        soc_pct = 95.0 - np.cumsum(current_a) / 36.0 / 60.0
        temperature_c = 23.0 + 2.0 * np.sin(time_s / 700.0)
        delayed = np.column_stack(
            [np.interp(time_s - d, time_s, current_a) for d in known.loads.delays_s]
        )
        loads = known.load_columns(temperature_c, delayed)
        volts = known.pseudo_ocv(soc_pct) + loads @ known.load_coefficients
        volts += rng.normal(0.0, 0.5, time_s.size)
        yield Log(time_s, current_a, volts, temperature_c, soc_pct, name=f"log {seed}")


def diagnoses() -> Result:
    """Return the time of a diagnosis by the numbers of logs and references [s]."""
    simulated = [simulate(seed=1, drive=day, hours=1.0).log for day in range(1, 9)]
    known = fit(simulated[:2], capacity_ah=60.0).model
    references = simulated[5:8]

    def seconds(logs: list[Log], references: list[Log]) -> float:
        began = time.process_time()
        diagnose(logs, known, references)
        return time.process_time() - began

    seconds(simulated[4:5], references)  # the first one imports the solvers
    return {
        "seconds by logs, 3 references": {
            number: seconds(simulated[5 - number : 5], references) for number in (1, 2, 4)
        },
        "seconds by references, one log": {
            number: seconds(simulated[4:5], references[:number]) for number in (0, 1, 2)
        },
    }


def starts() -> Result:
    """Return the processor's time for `--help` of every command [s], the least of three."""
    script = "import sys; from cangauge.cli.app import main; main()"
    found = {}
    for name in ("", *COMMANDS):
        command = [sys.executable, "-c", script, *([name] if name else []), "--help"]
        times = [_child_s(command) for _ in range(3)]
        found[name or "cangauge"] = min(times)
    return found


def _child_s(command: list[str]) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


PARTS: dict[str, Callable[[], Result]] = {
    "ratios": ratios, "growth": growth, "fit": fits, "diagnosis": diagnoses, "start": starts,
}  # fmt: skip


WORDS = {
    "": "{} s",
    "ratio": "{} × baseline",
    "us": "{} µs",
    "bare_us": "baseline {} µs",
    "seconds": "{} s",
    "peak_mib": "{} MiB",
}
"""Field of a result → its words; others stand before their value."""


def tables_of(result: Result) -> list[Table]:
    """Return each part as a table of names and values."""
    tables = []
    for part, rows in result.items():
        table = Table(part, "")
        for name, value in rows.items():
            fields = value if isinstance(value, dict) else {"": value}
            texts = (WORDS.get(key, f"{key}: {{}}").format(_short(x)) for key, x in fields.items())
            table.add_row(str(name), "; ".join(texts))
        tables.append(table)
    return tables


def _short(value: float) -> str:
    return f"{value:.3g}" if value < 1000.0 else f"{value:.0f}"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--only", action="append", choices=list(PARTS), help="default: all but fit")
    parser.add_argument("--keep", action="store_true", help="keep the figures for the page")
    options = parser.parse_args()
    found = {}
    for name in options.only or [part for part in PARTS if part != "fit"]:
        sys.stderr.write(f"measuring: {name} …\n")
        found[name] = PARTS[name]()
    name = "-".join(options.only or ["cost"])
    publish(name, tables_of(found), ["src/cangauge", "core"], keeps=options.keep)


if __name__ == "__main__":
    main()
