"""Monitoring and recording on a real SocketCAN interface: kernel stamps, no loss."""

from __future__ import annotations

import threading
import time
import urllib.request
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from cangauge.bus.connection import BusConnection
from cangauge.bus.open import BusAddress, has_socketcan, open_bus
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import samples_of
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.loop import Loop
from cangauge.service.offline import estimate_capture
from cangauge.service.pipeline import Pipeline
from cangauge.service.record import Recorder
from cangauge.service.status import Monitor
from cangauge.types import Estimate
from live import Rows, leaf_model, loop_config, short_log, waits
from served import Served, Shown

pytestmark = pytest.mark.socketcan

VCAN = BusAddress("socketcan", "vcan0")


@pytest.fixture(autouse=True)
def _vcan0() -> None:
    if not has_socketcan("vcan0"):
        pytest.skip("no SocketCAN interface vcan0 on this machine (see tests/socketcan)")


def test_scraped_and_recorded_by_kernel_stamps(tmp_path: Path) -> None:
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    rows: list[tuple[float, Estimate]] = []
    stop = threading.Event()
    encoder = FrameEncoder(Vehicle.load("generic"))
    frames = [encoder.encode(sample) for sample in samples_of(short_log(50.0))]
    with (
        BusConnection(open_bus(VCAN, pipeline.filters), VCAN) as port,
        BusConnection(open_bus(VCAN, []), VCAN) as sender,
        closing(Recorder(tmp_path / "seen.log", part_mb=0.005)) as recorder,
    ):
        monitor = Monitor(pipeline, port, recorder=recorder)
        server = Served(monitor.latest, http="127.0.0.1:0")
        outputs = [Rows(rows), recorder, Shown(server)]
        loop = Loop(port, pipeline, loop_config(), outputs=outputs, monitor=monitor)
        thread = threading.Thread(target=loop.run, args=(stop.is_set,))
        thread.start()
        with closing(server):
            scrapes = 0
            for number, group in enumerate(frames, start=1):
                for frame in group:
                    sender.send(frame)
                time.sleep(0.002)
                if number % 50 == 0:
                    # Paced by the receiver: throughput is not tested here.
                    assert waits(lambda done=number: pipeline.samples >= done), pipeline.counters
                    url = f"http://127.0.0.1:{server.port}/metrics"
                    with urllib.request.urlopen(url, timeout=10.0) as answer:
                        scrapes += b"cangauge_samples_total" in answer.read()
        time.sleep(0.6)
        stop.set()
        thread.join(30.0)
    status = monitor.latest.status
    assert scrapes == len(frames) // 50
    assert status["samples"] == len(frames) == 500
    assert status["frames"]["lost"] == 0
    assert status["frames"]["used"] == status["frames"]["wanted"]
    # Relative to the kernel's stamps, the arrival.
    assert status["latency"]["count"] >= 10
    assert 0.0 < status["latency"]["mean_s"] < 1.0
    recorded = estimate_capture(recorder.written, Vehicle.load("generic"), leaf_model())
    assert len(list(tmp_path.iterdir())) > 1
    live = [each.soc_pct for _, each in rows]
    assert repr(recorded.table.soc_pct.tolist()) == repr(live)  # NaN until the first block
    residual = np.array([each.residual_v for _, each in rows])
    assert np.array_equal(recorded.table.residual_v, residual, equal_nan=True)
