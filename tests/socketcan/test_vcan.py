"""Replay and service on a real SocketCAN interface: filters, counts, bits, loss."""

from __future__ import annotations

import shutil
import socket
import struct
import subprocess
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from cangauge.bus.connection import BusConnection
from cangauge.bus.open import BusAddress, bus_address, has_socketcan, open_bus
from cangauge.bus.publish import (
    standard_filter,
)
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimation.offline import run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.replay.player import play
from cangauge.replay.steps import LogSource, quantization_bound
from cangauge.service.offline import estimate_capture
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.record import Recorder
from live import (
    Command,
    Service,
    leaf_model,
    leaf_model_path,
    loop_config,
    never,
    run_to_end,
    same_frames,
    short_log,
    waits,
)

pytestmark = pytest.mark.socketcan

VCAN = BusAddress("socketcan", "vcan0")
SOC_FRAMES = [standard_filter(0x5A0), standard_filter(0x5A1)]
MAX: dict[str, Any] = {"speed": float("inf"), "acknowledge_s": 20.0}


@pytest.fixture(autouse=True)
def _vcan0() -> None:
    if not has_socketcan("vcan0"):
        pytest.skip("no SocketCAN interface vcan0 on this machine (see tests/socketcan)")


@pytest.fixture
def replay_port() -> Iterator[BusConnection]:
    with BusConnection(open_bus(VCAN, SOC_FRAMES), VCAN) as port:
        yield port


def service(preset: str, settings: PipelineSettings, record: Recorder | None = None) -> Service:
    pipeline = Pipeline(Vehicle.load(preset), leaf_model(), settings)
    return Service(
        BusConnection(open_bus(VCAN, pipeline.filters), VCAN), pipeline, loop_config(), record
    )


@pytest.mark.parametrize("filters", [None, SOC_FRAMES], ids=["all", "filtered"])
@pytest.mark.parametrize("options", [{"fd": True}, {"fd": False}], ids=["fd", "classic"])
def test_received_frames_equal_those_of_python_can(
    options: dict[str, bool], filters: list[can.typechecking.CanFilter] | None
) -> None:
    address = BusAddress("socketcan", "vcan0", {**options, "receive_own_messages": True})
    standard = {"arbitration_id": 0x5A0, "is_extended_id": False}
    sent = [
        can.Message(**standard, data=bytes(range(8))),
        can.Message(**standard, is_remote_frame=True, dlc=3),
        can.Message(arbitration_id=0x5A0, data=b"12"),
        can.Message(arbitration_id=0x7FF, is_extended_id=False),
    ]
    if options["fd"]:
        sent += [
            can.Message(**standard, data=bytes(64), is_fd=True, bitrate_switch=True),
            can.Message(**standard, data=bytes(12), is_fd=True, error_state_indicator=True),
        ]
    with (
        open_bus(address, filters) as theirs,
        open_bus(address, filters) as ours,
        open_bus(address, []) as sender,
        socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw,
    ):
        for frame in sent:
            sender.send(frame)
        ours.send(sent[0])  # an own frame, received as an echo
        raw.bind(("vcan0",))
        raw.send(struct.pack("=IB3x8s", 0x20000040, 8, bytes(8)))  # bus-off
        expected = []
        while (message := theirs.recv(0.5)) is not None:
            expected.append(message)
        port, found = BusConnection(ours, VCAN), []
        while frames := port.receive_pending(0.2) or port.receive_pending(0.0):
            found += frames
    # The kernel's filters drop two of the sent frames, and no error frame.
    assert len(expected) == len(sent) + 2 - (0 if filters is None else 2)
    assert [each.is_error_frame for each in expected].count(True) == 1
    assert port.error_frames == 1
    assert same_frames(found, [each for each in expected if not each.is_error_frame])


def test_the_default_bus_is_vcan0() -> None:
    assert str(bus_address()) == "socketcan vcan0"


def test_a_log_at_full_speed_within_the_bound_and_bit_for_bit(
    replay_port: BusConnection, tmp_path: Path
) -> None:
    log, vehicle, path = short_log(60.0), Vehicle.load("leaf_aze0"), tmp_path / "vcan0.log"
    estimator = EstimatorSettings(initial_soc_pct=80.0)
    settings = PipelineSettings(estimator, "replay-clock")
    with closing(Recorder(path)) as recorder, service("leaf_aze0", settings, recorder) as live:
        state = play(replay_port, LogSource(log, vehicle), **MAX, stop=never)
    assert state.acknowledged == len(live.rows) == len(log)
    assert live.pipeline.counts["lost"] == live.pipeline.counts["crc_errors"] == 0
    soc = np.array([estimate.soc_pct for _, estimate in live.rows])
    residual = np.array([estimate.residual_v for _, estimate in live.rows])
    offline = run_estimator(samples_of(log), leaf_model(), estimator)
    worst = float(np.max(np.abs(soc - offline.soc_pct)))
    assert 0.0 < worst <= quantization_bound(vehicle, leaf_model(), log)["ekf"]
    recorded = estimate_capture(path, vehicle, leaf_model(), estimator)
    assert np.array_equal(recorded.table.soc_pct, soc)
    assert np.array_equal(recorded.table.residual_v, residual, equal_nan=True)


def test_real_time_uses_the_kernels_stamps(replay_port: BusConnection, tmp_path: Path) -> None:
    log, path = short_log(6.01), tmp_path / "vcan0.log"
    with (
        closing(Recorder(path)) as recorder,
        service("generic", PipelineSettings(), recorder) as live,
    ):
        state = play(replay_port, LogSource(log, Vehicle.load("generic")), stop=never)
        assert waits(lambda: live.pipeline.samples == len(log))
    assert state.seconds == pytest.approx(6.0, abs=0.1)
    times = np.array([time_s for time_s, _ in live.rows])
    assert np.max(np.abs(times - times[0] - log.time_s)) < 0.1
    recorded = estimate_capture(path, Vehicle.load("generic"), leaf_model())
    assert recorded.time_source == "receive"
    assert recorded.table.time_s.tolist() == times.tolist()
    live_pct = [each.soc_pct for _, each in live.rows]
    assert repr(recorded.table.soc_pct.tolist()) == repr(live_pct)  # NaN until the first block


def test_the_kernel_filters_the_wanted_ids() -> None:
    pipeline = Pipeline(Vehicle.load("leaf_aze0"), leaf_model())
    bus = open_bus(VCAN, pipeline.filters)
    raw = bus.socket.getsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, 64)  # type: ignore[attr-defined] # SocketcanBus
    assert len(raw) == 8 * 3
    sender = can.Bus("vcan0", interface="socketcan", ignore_config=True)
    for number in range(0x800):
        sender.send(can.Message(arbitration_id=number, is_extended_id=False))
    # An extended id of the same number is another message.
    sender.send(can.Message(arbitration_id=0x1DB, is_extended_id=True))
    received = []
    while (message := bus.recv(0.3)) is not None:
        received.append(message.arbitration_id)
    assert received == [0x1DB, 0x55B, 0x5C0]
    sender.shutdown()
    bus.shutdown()


def test_a_bus_that_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nosuch0") as caught:
        open_bus(BusAddress("socketcan", "nosuch0"))
    assert "vcan0" in str(caught.value)  # the existing one
    with pytest.raises(InputError, match="nosuch0"):
        bus_address(None, "nosuch0")


def test_both_commands_until_the_bus_goes_down(tmp_path: Path) -> None:
    """One test for both commands: processes start slowly in a guest."""
    from cangauge.logs.canonical import write_log  # noqa: PLC0415 - pyarrow, for this test alone

    log_path, record = tmp_path / "drive.parquet", tmp_path / "drive.log"
    write_log(short_log(20.0), log_path)
    live = Command(
        "run", "-m", leaf_model_path(), "--time-source", "replay-clock", "--record", record,
        "--json",
    )  # fmt: skip
    live.wait_for("service.ready")
    replayed = run_to_end("replay", log_path, "--speed", "max", "--json")
    assert replayed.code == 0, replayed.err
    assert replayed.json["bus"] == "socketcan vcan0"
    assert replayed.json["acknowledged"] == 200
    if shutil.which("ip") is None:
        live.process.terminate()
        assert live.end().code == 0
        pytest.skip("no `ip` command to take the interface down")
    subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
    try:
        live.wait_for("bus.lost")
        live.process.terminate()
        ended = live.end()
    finally:
        subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)
    assert ended.code == 0
    assert ended.json["bus_counts"]["losses"] == 1
    # The recording until then is complete.
    recorded = estimate_capture(record, Vehicle.load("generic"), leaf_model())
    assert recorded.table.soc_pct.size == 200
