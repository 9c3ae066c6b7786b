"""A small fleet of simulated vehicles, and a Dask cluster of two worker processes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cangauge.extras.fleet.sources import FleetLog, find_logs
from cangauge.extras.validation.cases import Scenario, draw_scenario
from cangauge.extras.validation.twin.recording import record_drive
from cangauge.identify.fit import fit
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.coulomb_counting import counted_soc_pct
from cangauge.model.model_file import Model
from fleet_cluster import Cluster, free_port

VEHICLES, LOGS = 4, 2


@pytest.fixture(scope="session")
def scenario() -> Scenario:
    return draw_scenario(5, n_reference=3, climate="mild")


@pytest.fixture(scope="session")
def folder(scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of a fleet, in a folder for each vehicle; SoC every ten minutes."""
    root = tmp_path_factory.mktemp("fleet")
    (root / "car0").mkdir()
    write_log(scenario.training[0].log, root / "car0" / "full.parquet")
    for vehicle in range(VEHICLES):
        drives = scenario.draw_drives(np.random.default_rng([7, vehicle]), LOGS, 0.4)
        (root / f"car{vehicle}").mkdir(exist_ok=True)
        for number, drive in enumerate(drives):
            recording = record_drive(scenario.plant, drive, (), name=f"trip{number}")
            soc_pct = np.full(len(recording.log), np.nan)
            soc_pct[::1200] = _true_soc(recording.log, scenario)[::1200]
            log = replace(recording.log, soc_pct=soc_pct)
            write_log(log, root / f"car{vehicle}" / f"trip{number}.parquet")
    return root


def _true_soc(log: Log, scenario: Scenario) -> Any:
    return np.clip(counted_soc_pct(log, scenario.pack.capacity_ah, None), 0.0, 100.0)


@pytest.fixture(scope="session")
def logs(folder: Path) -> list[FleetLog]:
    return find_logs([f"{folder}/*/*.parquet"])


@pytest.fixture(scope="session")
def model(logs: list[FleetLog], scenario: Scenario) -> Model:
    recorded = [read_log(log.url) for log in logs]
    return fit(recorded, capacity_ah=scenario.pack.capacity_ah, effects="none").model


@pytest.fixture(scope="session")
def storage_port() -> int:
    return free_port()


@pytest.fixture(scope="session")
def cluster(tmp_path_factory: pytest.TempPathFactory, storage_port: int) -> Iterator[Cluster]:
    """Scheduler and two workers, which find object storage at `storage_port`."""
    pytest.importorskip("distributed")
    from distributed import Client  # noqa: PLC0415

    port = free_port()
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "FSSPEC_S3_ENDPOINT_URL": f"http://127.0.0.1:{storage_port}",
    }
    found = Cluster(f"tcp://127.0.0.1:{port}", environment, tmp_path_factory.mktemp("dask"))
    found.start("scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
    found.add_worker()
    found.add_worker()
    try:
        with Client(found.address, timeout=30, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=30)
        yield found
    finally:
        for process in found.processes:
            process.kill()
            process.wait()
