"""A small fleet of simulated vehicles, and a Dask client of this process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cangauge.bus.recording import read_log
from cangauge.extras.fleet import run as fleet_run
from cangauge.extras.fleet.sources import FleetLog, find_logs
from cangauge.extras.validation.cases import Scenario, draw_scenario
from cangauge.extras.validation.twin.recording import record_drive
from cangauge.identify.fit import fit
from cangauge.logs.canonical import write_log
from cangauge.model.coulomb_counting import counted_soc_pct
from cangauge.model.model_file import Model

VEHICLES, LOGS = 4, 2


@pytest.fixture(scope="session")
def scenario() -> Scenario:
    return draw_scenario(5)


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
            log = record_drive(scenario.plant, drive, (), name=f"trip{number}").log
            soc_pct = np.full(len(log), np.nan)
            true_pct = counted_soc_pct(log, scenario.pack.capacity_ah)
            soc_pct[::1200] = np.clip(true_pct, 0.0, 100.0)[::1200]
            path = root / f"car{vehicle}" / f"trip{number}.parquet"
            write_log(replace(log, soc_pct=soc_pct), path)
    return root


@pytest.fixture(scope="session")
def logs(folder: Path) -> list[FleetLog]:
    return find_logs([f"{folder}/*/*.parquet"])


@pytest.fixture(scope="session")
def model(logs: list[FleetLog], scenario: Scenario) -> Model:
    recorded = [read_log(log.url) for log in logs]
    return fit(recorded, capacity_ah=scenario.pack.capacity_ah, effects="none").model


@pytest.fixture(scope="session")
def client() -> Iterator[Any]:
    """A scheduler and a worker as threads of this process, which share `memory://`."""
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    )
    with cluster, distributed.Client(cluster, set_as_default=False) as found:
        yield found


@pytest.fixture
def here(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Take this process for the cluster of the commands."""

    @contextmanager
    def connected(*_: object) -> Any:
        yield client

    monkeypatch.setattr(fleet_run, "connected", connected)
