"""The service's loop on a bus: rates, silence, ends, bus failures."""

from __future__ import annotations

import errno
import itertools
import time
from pathlib import Path

import can
import pytest

from cangauge.bus.connection import BusConnection, BusError
from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.publish import SocDetail, SocEstimate, SocReader
from cangauge.bus.time_source import ClockFrames
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import samples_of
from cangauge.service.loop import LoopSettings
from cangauge.service.offline import estimate_capture
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.record import Recorder
from cangauge.types import Reason, Status
from live import (
    BrokenBus,
    Service,
    collect,
    leaf_model,
    network_down,
    short_log,
    unpack_error,
    virtual_port,
    virtual_service,
    waits,
)


def send_log(port: BusConnection, seconds: float, pause_s: float = 0.0) -> None:
    encoder = FrameEncoder(Vehicle.load("generic"))
    for sample in samples_of(short_log(seconds)):
        for frame in encoder.encode(sample):
            port.send(frame)
        time.sleep(pause_s)


def test_initialising_is_published_before_any_frame() -> None:
    with virtual_port("quiet") as listener, virtual_service("quiet"):
        frames = collect(listener, 1.25)
    reader = SocReader()
    contents = [reader.read(frame) for frame in frames]
    estimates = [each for each in contents if isinstance(each, SocEstimate)]
    assert 11 <= len(estimates) <= 14
    assert {each.status for each in estimates} == {Status.INITIALISING}
    assert sum(isinstance(each, SocDetail) for each in contents) == 2


def test_publishes_every_100_ms_with_slower_samples() -> None:
    with virtual_port("slow") as port, virtual_service("slow"):
        for sample in samples_of(short_log(2.0, rate_hz=2.0)):
            for frame in FrameEncoder(Vehicle.load("generic")).encode(sample):
                port.send(frame)
            time.sleep(0.5)
        frames = [each for each in collect_queue(port) if each.arbitration_id == 0x5A0]
    steps = [b.timestamp - a.timestamp for a, b in itertools.pairwise(frames)]
    assert max(steps) < 0.16
    assert 18 <= len(frames) <= 30


def collect_queue(port: BusConnection) -> list[can.Message]:
    found = []
    while (message := port.receive(0.01)) is not None:
        found.append(message)
        if len(found) > 500:
            break
    return found


def test_silence_is_stale_until_input_returns() -> None:
    loop = LoopSettings(timeout_s=0.3)
    reader = SocReader()
    with virtual_port("stale") as port, virtual_service("stale", loop=loop) as service:
        send_log(port, 10.0)
        assert waits(lambda: service.pipeline.samples == 100)
        collect_queue(port)
        contents = [reader.read(frame) for frame in collect(port, 0.8)]
        estimates = [each for each in contents if isinstance(each, SocEstimate)]
        assert estimates[0].status is Status.DEGRADED  # its delay line is still filling
        assert estimates[-1].status is Status.INVALID
        assert estimates[-1].reasons & Reason.INPUT_STALE
        send_log(port, 1.0, pause_s=0.02)
        contents = [reader.read(frame) for frame in collect_queue(port)]
        estimates = [each for each in contents if isinstance(each, SocEstimate)]
        assert estimates[-1].status is Status.DEGRADED
        assert not estimates[-1].reasons & Reason.INPUT_STALE


def test_recording_and_table_equal_the_live_estimates(tmp_path: Path) -> None:
    path = tmp_path / "live.log"
    with (
        Recorder(path) as recorder,
        virtual_port("record") as port,
        virtual_service("record", record=recorder) as service,
    ):
        send_log(port, 20.0)
        assert waits(lambda: service.pipeline.samples == 200)
    recorded = estimate_capture(path, Vehicle.load("generic"), leaf_model())
    assert recorded.table.soc_pct.tolist() == [each.soc_pct for _, each in service.rows]
    assert recorded.table.residual_v.tolist() == [each.residual_v for _, each in service.rows]
    assert recorded.time_source == "receive"


def test_ends_after_duration_or_when_idle() -> None:
    with virtual_service("brief", loop=LoopSettings(duration_s=0.3)) as service:
        service.join(2.0)
    assert service.summary is not None
    assert service.summary.seconds == pytest.approx(0.3, abs=0.15)
    loop = LoopSettings(until_idle_s=0.3)
    with virtual_port("idle") as port, virtual_service("idle", loop=loop) as service:
        time.sleep(0.5)  # idle before the first sample does not end it
        send_log(port, 3.0)
        service.join(3.0)
    assert service.pipeline.samples == 30


def test_ignored_replay_clock_is_warned_of_once(tmp_path: Path) -> None:
    path = tmp_path / "receive.log"
    with (
        Recorder(path) as recorder,
        virtual_port("clock") as port,
        virtual_service("clock", record=recorder) as service,
    ):
        for _ in range(3):
            port.send(ClockFrames().at(5_000_000))
        send_log(port, 2.0)
        assert waits(lambda: service.pipeline.samples == 20)
    assert len(service.warnings) == 1
    assert "--time-source replay-clock" in service.warnings[0]
    assert "#" in path.read_text()
    assert "5AF#" not in path.read_text()


def serve_on(bus: BrokenBus, seconds: float) -> Service:
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model(), PipelineSettings())
    port = BusConnection(bus, "fake bus")  # type: ignore[arg-type] # has what a bus is used for
    with Service(port, pipeline, LoopSettings(duration_s=seconds)) as service:
        service.join(5.0)
    return service


def test_garbled_packets_are_skipped() -> None:
    service = serve_on(BrokenBus([unpack_error(), unpack_error()]), 0.25)
    assert service.error is None
    assert service.port.garbled == 2


def test_error_frames_are_counted() -> None:
    service = serve_on(BrokenBus([can.Message(is_error_frame=True)]), 0.2)
    assert service.port.error_frames == 1
    assert service.pipeline.counts.frames == 0


@pytest.mark.parametrize("error", [network_down(), OSError(errno.ENODEV, "No such device")])
def test_lost_bus_ends_the_service_with_one_line(error: BaseException) -> None:
    service = serve_on(BrokenBus([error]), 5.0)
    assert isinstance(service.error, BusError)
    assert "fake bus: receiving failed" in str(service.error)
    assert service.error.exit_code == 1


def test_full_transmit_queue_costs_frames_only() -> None:
    full = can.CanOperationError("Failed to transmit: No buffer space", errno.ENOBUFS)
    service = serve_on(BrokenBus([], sending=full), 0.5)
    assert service.error is None
    assert service.port.unsent > 2


def test_failed_sending_ends_the_service() -> None:
    service = serve_on(BrokenBus([], sending=network_down()), 5.0)
    assert isinstance(service.error, BusError)
    assert "sending failed" in str(service.error)
