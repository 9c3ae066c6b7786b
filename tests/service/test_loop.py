"""The service's loop on a bus: rates, silence, ends, bus failures."""

from __future__ import annotations

import errno
import itertools
import os
import time
from pathlib import Path

import can
import numpy as np
import pytest

from cangauge.bus.connection import BusConnection, BusError
from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.open import backend_capabilities, bus_address, open_bus
from cangauge.bus.publish import SocDetail, SocEstimate, SocReader
from cangauge.bus.time_source import ClockFrames
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.service.loop import Loop, LoopSettings, OwnFrames
from cangauge.service.offline import estimate_capture
from cangauge.service.output import Output
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.record import Recorder
from cangauge.types import Estimate, Reason, Sample, Status
from live import (
    BrokenBus,
    Rows,
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
    known = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
    with virtual_port("stale") as port, virtual_service("stale", known, loop) as service:
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
    for name in ("soc_pct", "residual_v", "reasons"):
        live = [getattr(each, name) for _, each in service.rows]
        assert np.array_equal(getattr(recorded.table, name), live, equal_nan=True), name
    assert recorded.time_source == "receive"


def test_ends_after_duration_or_when_idle() -> None:
    with virtual_service("brief", loop=LoopSettings(duration_s=0.3)) as service:
        service.join(60.0)
    assert service.summary is not None
    assert service.summary.seconds == pytest.approx(0.3, abs=5.0)
    loop = LoopSettings(until_idle_s=0.3)
    with virtual_port("idle") as port, virtual_service("idle", loop=loop) as service:
        time.sleep(0.5)  # idle before the first sample does not end it
        send_log(port, 3.0)
        service.join(60.0)
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
        service.join(60.0)
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


# --- Another sender of the own ids


def multicast_service(port: int) -> Service:
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    address = bus_address("udp_multicast", options={"port": port})
    bus = open_bus(address, pipeline.filters)
    return Service(BusConnection(bus, str(address), backend_capabilities(address)), pipeline)


def test_two_services_with_the_same_ids_notice_each_other() -> None:
    with virtual_service("rivals") as one, virtual_service("rivals") as two:
        assert waits(lambda: bool(one.warnings) and bool(two.warnings))
        assert waits(lambda: bool(one.pipeline.published.reasons & Reason.DUPLICATE_SENDER))
    for service in (one, two):
        assert "sends 0x5A" in service.warnings[0]
        assert service.summary is not None
        assert service.port.foreign == service.summary.foreign_frames >= 3
        assert service.pipeline.counts.frames == 0  # they are not input


def test_own_frames_that_the_bus_returns_are_not_foreign() -> None:
    port = 20_000 + (os.getpid() + 7919) % 20_000
    with multicast_service(port) as alone:
        time.sleep(1.0)
        assert alone.warnings == []
        with multicast_service(port) as second:
            assert waits(lambda: bool(alone.warnings) and bool(second.warnings))


@pytest.mark.parametrize("echoes", [False, True])
def test_identical_foreign_frames_are_noticed(echoes: bool) -> None:
    own = OwnFrames(echoes=echoes)
    proofs = []
    for number in range(4):
        mine = can.Message(arbitration_id=0x5A0, is_extended_id=False, data=[number])
        own.note_sent(mine)
        assert own.is_echo(mine) == echoes
        assert not own.is_echo(mine)
        proofs.append(own.proves_another(1.0 + number))
    assert proofs == [False, False, True, True]
    assert own.is_shared(5.0)
    assert not own.is_shared(60.0)


def test_rare_foreign_frames_prove_nothing_and_a_lost_echo_is_none() -> None:
    own = OwnFrames(echoes=True)
    assert [own.proves_another(10.0 * number) for number in range(4)] == [False] * 4
    for number in range(3):
        own.note_sent(can.Message(arbitration_id=0x5A0, is_extended_id=False, data=[number]))
    assert own.is_echo(can.Message(arbitration_id=0x5A0, is_extended_id=False, data=[2]))
    assert own.foreign == 4


# --- Outputs, checkpoints


class Failing(Output):
    def __init__(self) -> None:
        self.calls = 0

    def on_sample(self, sample: Sample, estimate: Estimate) -> None:
        self.calls += 1
        raise RuntimeError("broken")


def test_an_output_that_fails_is_told_nothing_more(caplog: pytest.LogCaptureFixture) -> None:
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    failing, rows = Failing(), Rows([])
    with virtual_port("fails", pipeline.filters) as port, virtual_port("fails") as sender:
        send_log(sender, 2.0)
        loop = Loop(port, pipeline, outputs=[failing, rows])
        loop.run(lambda: pipeline.samples == 20)
    assert (failing.calls, len(rows.rows)) == (1, 20)
    assert "Failing has ended: RuntimeError('broken')" in caplog.text


def test_checkpoints_come_soon_periodically_and_at_the_end() -> None:
    asked: list[float] = []
    loop = LoopSettings(duration_s=2.6, checkpoint_every_s=1.2)
    service = virtual_service("checkpoints", loop=loop)
    began = time.monotonic()
    service.checkpoint = lambda: asked.append(time.monotonic() - began)
    with service:
        service.join(60.0)
    # A busy machine may be late, never early.
    assert asked[0] > 0.95
    assert asked[1] - asked[0] > 1.15
    assert asked[-1] > 2.55


def test_a_lost_bus_still_saves_the_state() -> None:
    saved = []
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    port = BusConnection(BrokenBus([network_down()]), "fake bus")  # type: ignore[arg-type] # as above
    with Service(port, pipeline, checkpoint=lambda: saved.append(1)) as service:
        service.join(60.0)
    assert isinstance(service.error, BusError)
    assert saved == [1]
