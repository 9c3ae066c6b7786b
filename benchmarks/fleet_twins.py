"""Simulated fleets for the benchmarks of `cangauge fleet`: vehicles of one type, which differ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from cangauge.extras.validation.cases import Scenario
from cangauge.extras.validation.twin.plant import TwinPlant
from cangauge.extras.validation.twin.recording import record_drive
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log

CAPACITY_SPREAD, RESISTANCE_SPREAD = 0.01, 0.03
"""Standard deviations between new cells of one type, relative (Baumhöfer et al., J. Power Sources
247 (2014) 332: capacity 0.5–1.2 %; Rumpf et al., J. Energy Storage 14 (2017) 224: resistance
2–4 %)."""


def vehicle_logs(scenario: Scenario, vehicle: int, number: int, hours: float) -> list[Log]:
    """Return healthy logs of one vehicle of the scenario's type.

    Parameters
    ----------
    scenario : Scenario
    vehicle : int
        Seeds the vehicle's pack and drives.
    number : int
        Number of logs.
    hours : float
        Duration of each [h].
    """
    rng = np.random.default_rng([scenario.seed, 17, vehicle])
    pack = scenario.pack
    resistance = 1.0 + RESISTANCE_SPREAD * rng.standard_normal()
    own = replace(
        pack,
        capacity_ah=pack.capacity_ah * (1.0 + CAPACITY_SPREAD * rng.standard_normal()),
        ohmic_ohm=pack.ohmic_ohm * resistance,
        exchange_a=pack.exchange_a / resistance,
    )
    plant = TwinPlant(own)
    return [
        record_drive(plant, drive, (), name=f"trip{k}").log
        for k, drive in enumerate(scenario.draw_drives(rng, number, hours))
    ]


def write_fleet(scenario: Scenario, folder: Path, vehicles: int, logs: int, hours: float) -> None:
    """Write `logs` logs of each vehicle to FOLDER/VEHICLE/trip….parquet."""
    for vehicle in range(vehicles):
        own = folder / f"car{vehicle:04d}"
        own.mkdir(parents=True)
        for log in vehicle_logs(scenario, vehicle, logs, hours):
            write_log(log, own / f"{log.name}.parquet")
