"""Attacks on the gateway, the suite and `[judge]`."""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import can
import numpy as np
import pytest
from can.interfaces.virtual import VirtualBus

from cangauge.bus.open import BusAddress
from cangauge.bus.reconnecting import ReconnectingBus
from cangauge.bus.recording import read_log
from cangauge.extras.inverter.gateway import Gateway, soc_fields
from cangauge.extras.judge import suite
from cangauge.extras.judge.live import LiveJudge
from cangauge.extras.judge.suite import FAULTS, Drive, run_suite
from cangauge.service.status_client import Snapshot
from cangauge.types import Estimate, Reason, Sample, Status
from live import LoggedLines, leaf_model, waits
from synthetic import synthetic_log

NONE = Estimate(*[0.0] * 7, Status.VALID, Reason.NONE, 1)


FRAMES = [
    can.Message(arbitration_id=0x355, is_extended_id=True, data=b"\x0b\x00\x5e\x00"),
    can.Message(arbitration_id=0x355, is_extended_id=False, is_remote_frame=True, dlc=8),
    can.Message(arbitration_id=0x355, is_extended_id=False, data=b""),
    can.Message(arbitration_id=0x355, is_extended_id=False, data=b"\x0b"),
    can.Message(arbitration_id=0x351, is_extended_id=False, data=bytes(8)),
]


@pytest.mark.parametrize("frame", FRAMES, ids=["extended", "remote", "empty", "short", "limits"])
def test_the_gateway_changes_nothing_else(frame: can.Message) -> None:
    gateway = Gateway.__new__(Gateway)
    gateway._fields, gateway._replaces = soc_fields("victron"), True
    gateway._soc, gateway._current_until_s = (70.0, 1.0), 1.0
    told = gateway.replaced(frame, 0.5)
    assert told.equals(frame, timestamp_delta=None)


@pytest.fixture
def gateway(request: pytest.FixtureRequest) -> Iterator[Gateway]:
    """Between the virtual buses of a battery, "b", and an inverter, "i"."""
    buses = [ReconnectingBus(BusAddress("virtual", f"{request.node.name} {side}"), [])
             for side in "bi"]  # fmt: skip
    for bus in buses:
        bus.open()
    with closing(Gateway(*buses, soc_fields("pylontech"))) as gateway:
        yield gateway


@pytest.mark.parametrize("soc_pct", [math.nan, math.inf, -5.0, 1e9])
def test_no_odd_soc_reaches_an_inverter(gateway: Gateway, soc_pct: float) -> None:
    for _ in range(3):
        gateway.on_sample(Sample(0.0, 1.0, 50.0, 20.0), NONE)
    status = {"status": "valid", "estimate": {"soc_pct": soc_pct}}
    gateway.on_snapshot(Snapshot(time.monotonic(), status))
    own = can.Message(arbitration_id=0x355, is_extended_id=False, data=b"\x0b\x00\x5e\x00")
    assert 0 <= gateway.replaced(own, time.monotonic()).data[0] <= 100


@pytest.mark.usefixtures("gateway")
def test_a_flood_on_the_batterys_bus_does_not_stop_the_inverters(
    request: pytest.FixtureRequest,
) -> None:
    with (
        # No frame is late by stamps of tomorrow, however busy this machine is.
        VirtualBus(f"{request.node.name} b", preserve_timestamps=True) as battery,
        VirtualBus(f"{request.node.name} i", preserve_timestamps=True) as inverter,
    ):
        tomorrow = time.time() + 86400.0
        inverter.send(can.Message(tomorrow, 0x305, is_extended_id=False, data=bytes(8)))
        for number in range(5000):
            data = number.to_bytes(8, "big")
            battery.send(can.Message(tomorrow, 0x7FF, is_extended_id=False, data=data))
        alive = battery.recv(5.0)
        assert alive is not None
        assert alive.arbitration_id == 0x305
        assert all(inverter.recv(5.0) is not None for _ in range(5000))


@pytest.fixture(scope="module")
def drive() -> Drive:
    log = synthetic_log(hours=0.02, rate_hz=1.0, start_pct=80.0, end_pct=79.0)
    return log, leaf_model()


GAUGE = """
import sys, can
bus = can.Bus(interface=sys.argv[1], channel=sys.argv[2], port=int(sys.argv[3]))
soc = can.Message(arbitration_id=0x5A0, is_extended_id=False, data=bytes(8))
bus.send(soc)
{script}
"""
GAUGES = {
    "floods": "while True: bus.send(can.Message(arbitration_id=0x123, is_extended_id=False))",
    "sends short frames": "while True:\n bus.recv(); soc.data = b'1'; bus.send(soc)",
    "prints without end": "while True: print('x' * 1000)",
}


def gauge(code: str) -> list[str]:
    return [sys.executable, "-c", code, "{interface}", "{channel}", "{port}"]


@pytest.mark.parametrize("script", GAUGES.values(), ids=GAUGES.keys())
def test_a_bad_gauge_is_silent_and_ends(
    monkeypatch: pytest.MonkeyPatch, drive: Drive, script: str
) -> None:
    monkeypatch.setattr(suite, "ANSWER_WITHIN_S", 0.3)
    began_s = time.monotonic()
    (score,) = run_suite(gauge(GAUGE.format(script=script)), [drive], FAULTS[:1])
    assert score["silent"] == 1.0
    assert np.isnan(score["mae_pct"])
    assert time.monotonic() - began_s < 60.0


def test_a_gauge_that_fails_to_start_again_is_silent(
    monkeypatch: pytest.MonkeyPatch, drive: Drive, tmp_path: Path
) -> None:
    monkeypatch.setattr(suite, "ANSWER_WITHIN_S", 0.3)
    mark = tmp_path / "mark"
    once = f"import os, sys\nif os.path.exists('{mark}'): sys.exit('{{}}')\nopen('{mark}', 'w')\n"
    scores = run_suite(gauge(once + GAUGE.format(script="")), [drive], FAULTS[:2])
    assert [score["silent"] for score in scores] == [1.0, 1.0]


def ten_minutes(judge: LiveJudge) -> None:
    for second in range(600):
        judge.on_sample(Sample(float(second), 10.0, 380.0, 20.0), NONE)


def test_a_folder_of_the_judge_that_goes_away_costs_the_opinion_only(tmp_path: Path) -> None:
    folder = tmp_path / "opinion"
    folder.mkdir()
    with (
        LoggedLines("cangauge.extras.judge") as lines,
        closing(LiveJudge(folder, 3, ("false",), lambda: 50.0)) as judge,
    ):
        shutil.rmtree(folder)
        ten_minutes(judge)
        judge._end_stretch()
        assert waits(lambda: any("was not judged" in line for line in lines.lines))
        folder.mkdir()
        (folder / "junk.parquet").write_bytes(b"PAR1")
        ten_minutes(judge)
        judge._end_stretch()
        assert waits(lambda: len(list(folder.glob("0*.parquet"))) == 1)


def test_a_battery_that_publishes_no_soc_leaves_a_log_that_can_be_read(tmp_path: Path) -> None:
    published = iter([50.0, 655.35, -1.0, math.nan] * 150)
    with closing(LiveJudge(tmp_path, 3, ("false",), lambda: next(published))) as judge:
        ten_minutes(judge)
    (stored,) = tmp_path.glob("*.parquet")
    soc_pct = read_log(stored).soc_pct
    assert soc_pct is not None
    assert np.nanmin(soc_pct) == np.nanmax(soc_pct) == 50.0
