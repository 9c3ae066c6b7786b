"""Real trips of a BMW i3 over a CAN bus: the replayed SoC against the offline one.

    python benchmarks/bus_trips.py --data FOLDER [--trip A02]… [--vehicle generic] [--json]

FOLDER holds TripA01.csv.gz … TripA22.csv.gz of "Battery and Heating Data in Real Driving Cycles"
(IEEE DataPort). The model is fitted on A01, A03 … A21. Each of A02, A04 … A22 longer than 15
minutes is replayed at full speed on vcan0 (or udp_multicast) and estimated from the frames.
Prints for each trip the largest difference from the estimate of the log, its bound by the
quantization of the frames, and whether the estimate of the recorded frames equals the live one bit
for bit.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import threading
import time
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from cangauge.bus.connection import BusConnection
from cangauge.bus.open import BusAddress, bus_address, open_bus
from cangauge.bus.publish import standard_filter
from cangauge.bus.recording import read_log
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import capacity_from_reference
from cangauge.model.model_file import Model
from cangauge.replay.player import play
from cangauge.replay.steps import LogSource, quantization_bound
from cangauge.service.config import RunConfig
from cangauge.service.loop import Loop
from cangauge.service.offline import estimate_capture
from cangauge.service.output import Output
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.record import Recorder
from cangauge.types import Estimate, Sample

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "bmw_i3"
TRAINING = [f"A{number:02d}" for number in range(1, 22, 2)]
TEST = [f"A{number:02d}" for number in range(2, 23, 2)]
PLAYED_S = 15 * 60.0
"""Only longer trips are played [s]."""
NUMBERS = ("soc_pct", "soc_std_pct", "soc_newton_pct", "soc_coulomb_pct", "residual_v")
FULL_SPEED: dict[str, Any] = {"speed": math.inf, "acknowledge_s": 20.0}


@dataclass(frozen=True)
class Comparison:
    """Comparison of one trip."""

    trip: str
    samples: int
    lost: int
    seconds: float
    difference_pct: float
    bound_pct: float
    newton_difference_pct: float
    newton_bound_pct: float
    is_bit_for_bit: bool


class _Rows(Output):
    """Collect the estimate of each sample."""

    def __init__(self, rows: list[Estimate]) -> None:
        self._rows = rows

    def on_sample(self, sample: Sample, estimate: Estimate) -> None:
        del sample
        self._rows.append(estimate)


def read_trips(folder: Path, names: list[str]) -> list[Log]:
    """Read trips by name."""
    return [read_log(folder / f"Trip{name}.csv.gz") for name in names]


def identify(trips: list[Log]) -> Model:
    """Fit model and capacity to trips."""
    return fit(trips, capacity_ah=capacity_from_reference(trips), chemistry="oxide").model


def over_bus(
    log: Log, vehicle: Vehicle, model: Model, address: BusAddress, record: Path
) -> tuple[list[Estimate], Pipeline, float]:
    """Replay a log on a bus and estimate it; return estimates, pipeline and time [s]."""
    pipeline = Pipeline(vehicle, model, PipelineSettings(time_source="replay-clock"))
    rows: list[Estimate] = []
    done = threading.Event()
    bus = open_bus(address, pipeline.filters)
    with (
        BusConnection(bus, address) as receiver,
        BusConnection(open_bus(address, [standard_filter(0x5A1)]), address) as sender,
        closing(Recorder(record)) as recorder,
    ):
        outputs = [_Rows(rows), recorder]
        loop = Loop(receiver, pipeline, RunConfig(model="-"), outputs=outputs)
        service = threading.Thread(target=loop.run, args=(done.is_set,))
        service.start()
        began = time.monotonic()
        try:
            play(sender, LogSource(log, vehicle), **FULL_SPEED, stop=lambda: not service.is_alive())
        finally:
            done.set()
            service.join()
        return rows, pipeline, time.monotonic() - began


def compare(log: Log, vehicle: Vehicle, model: Model, address: BusAddress) -> Comparison:
    """Compare the estimate over the bus with that of the log."""
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "trip.log"
        rows, pipeline, seconds = over_bus(log, vehicle, model, address, record)
        recorded = estimate_capture(record, vehicle, model).table
    settings = EstimatorSettings(temperature_source=vehicle.temperature_source)
    offline = run_estimator(samples_of(log), model, settings)
    live = {name: np.array([getattr(each, name) for each in rows]) for name in NUMBERS}
    bound = quantization_bound(vehicle, model, log)

    def largest(name: str) -> float:
        return float(np.nanmax(np.abs(live[name] - getattr(offline, name))))

    return Comparison(
        trip=log.name,
        samples=len(rows),
        lost=len(log) - len(rows) + pipeline.counts["lost"],
        seconds=seconds,
        difference_pct=largest("soc_pct"),
        bound_pct=bound["ekf"],
        newton_difference_pct=largest("soc_newton_pct"),
        newton_bound_pct=bound["newton"],
        is_bit_for_bit=all(
            np.array_equal(live[name], getattr(recorded, name), equal_nan=True) for name in NUMBERS
        ),
    )


def show(rows: list[Comparison], address: BusAddress, vehicle: Vehicle) -> None:
    """Print the table."""
    table = Table(title=f"Real trips over {address} as {vehicle.name}, at full speed")
    headings = ("trip", "samples", "lost", "s", "EKF: largest difference [% SoC]", "bound",
                "Newton: largest", "bound", "recorded = live, bit for bit")  # fmt: skip
    for heading in headings:
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(
            row.trip, str(row.samples), str(row.lost), f"{row.seconds:.1f}",
            f"{row.difference_pct:.2e}", f"{row.bound_pct:.2e}",
            f"{row.newton_difference_pct:.2e}", f"{row.newton_bound_pct:.2e}",
            "yes" if row.is_bit_for_bit else "NO",
        )  # fmt: skip
    Console(width=150).print(table)


def main() -> int:
    """Run the comparison; exit 1 on lost samples, a difference above the bound, or changed bits."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the trips")
    parser.add_argument("--trip", action="append", help="only this trip; repeat for several")
    parser.add_argument("--vehicle", default="generic", help="preset of the frames")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    if not options.data.is_dir():
        sys.stderr.write(f"{options.data}: no such folder; give the trips' with --data\n")
        return 2
    sys.stderr.write("fitting the model on the training trips …\n")
    model = identify(read_trips(options.data, TRAINING))
    address, vehicle = bus_address(), Vehicle.load(options.vehicle)
    rows = []
    for trip in read_trips(options.data, options.trip or TEST):
        if trip.duration_s > PLAYED_S:
            sys.stderr.write(f"playing {trip.name} …\n")
            rows.append(compare(trip, vehicle, model, address))
    if options.json:
        result = {"bus": str(address), "trips": [asdict(row) for row in rows]}
        sys.stdout.write(json.dumps(result) + "\n")
    else:
        show(rows, address, vehicle)
    good = all(
        row.is_bit_for_bit and not row.lost and row.difference_pct <= row.bound_pct for row in rows
    )
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
