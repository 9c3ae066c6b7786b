"""The loop: rates, silence and ends on a simulated clock; senders and failures on buses."""

from __future__ import annotations

import errno
import itertools
import os
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pytest

from cangauge.bus.connection import BusConnection, BusError
from cangauge.bus.open import (
    UNKNOWN_INTERFACE,
    BackendCapabilities,
    Stamps,
    backend_capabilities,
    bus_address,
    open_bus,
)
from cangauge.bus.publish import SocDetail, SocEstimate, SocReader
from cangauge.bus.time_source import ClockFrames
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.replay.encoder import FrameEncoder
from cangauge.service import loop
from cangauge.service.loop import Loop, LoopSettings, OwnFrames
from cangauge.service.output import Output
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.types import Estimate, Reason, Sample, Status
from live import (
    BrokenBus,
    Rows,
    Service,
    frames_of,
    leaf_model,
    network_down,
    never,
    short_log,
    unpack_error,
    virtual_port,
    virtual_service,
    waits,
)
from selection import nightly_except

BEGAN_S = 5000.0
GENERIC = Vehicle.load("generic")
Serve = Callable[..., "SimulatedPort"]


class SimulatedPort:
    """Port and clock in one: receiving advances the clock to the next frame or the time-out."""

    capabilities = UNKNOWN_INTERFACE
    queue_drops = None
    name = "simulated"

    def __init__(self, frames: list[tuple[float, can.Message]]) -> None:
        self.now_s = BEGAN_S
        self._frames = [(BEGAN_S + at_s, frame) for at_s, frame in frames]
        self.sent: list[tuple[float, can.Message]] = []
        self.work_s: Callable[[float], float] = lambda _: 0.0
        self.suspended_s: tuple[float, float] | None = None

    @property
    def since_s(self) -> float:
        return self.now_s - BEGAN_S

    @property
    def is_drained(self) -> bool:
        return not self._frames or self._frames[0][0] > self.now_s

    def receive_pending(self, timeout_s: float) -> list[can.Message]:
        if self.suspended_s is not None and self.since_s >= self.suspended_s[0]:
            self.now_s += self.suspended_s[1]
            self.suspended_s = None
        work_s = self.work_s(self.since_s)
        if self._frames and self._frames[0][0] <= self.now_s + timeout_s:
            at_s, frame = self._frames.pop(0)
            self.now_s = max(self.now_s, at_s) + work_s
            return [frame]
        self.now_s += max(timeout_s, 1e-6)
        return []

    def post(self, frame: can.Message, _within_s: float) -> None:
        self.sent.append((self.since_s, frame))

    def set_filters(self, _filters: object) -> None:
        pass

    @property
    def published(self) -> list[tuple[float, SocEstimate]]:
        reader = SocReader()
        read = [(at_s, reader.read(frame)) for at_s, frame in self.sent]
        return [(at_s, content) for at_s, content in read if isinstance(content, SocEstimate)]


def frames_every(
    step_s: float, until_s: float, stamp_rate: float = 1.0, from_s: float = 0.0
) -> list[tuple[float, can.Message]]:
    encoder = FrameEncoder(GENERIC)
    times = [from_s + number * step_s for number in range(int((until_s - from_s) / step_s))]
    return [
        (at_s, frame)
        for at_s in times
        for frame in encoder.encode(Sample(1.7e9 + stamp_rate * at_s, 10.0, 370.0, 20.0))
    ]


@pytest.fixture
def serve(monkeypatch: pytest.MonkeyPatch) -> Serve:
    """Run the loop on a simulated port."""

    def run(port: SimulatedPort, settings: LoopSettings | float, **more: Any) -> SimulatedPort:
        clock = SimpleNamespace(
            monotonic=lambda: port.now_s,
            time=lambda: 1.7e9 + port.since_s,
            process_time=time.process_time,
        )
        monkeypatch.setattr(loop, "time", clock)
        monkeypatch.setattr(loop, "steady_s", lambda: port.now_s)
        given = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
        if isinstance(settings, float):
            settings = LoopSettings(duration_s=settings)
        pipeline = Pipeline(GENERIC, leaf_model(), given)
        Loop(port, pipeline, settings, **more).run(never)  # type: ignore[arg-type] # has what a port is used for
        return port

    return run


@pytest.mark.parametrize(
    ("step_s", "stamp_rate"),
    nightly_except(
        ((0.0007, 1.0), (0.137, 1.0), (100.0, 1.0), (0.02, -3.0)),
        ((0.0007, 1.0), (0.03, 1.0), (0.137, 1.0), (1.0, 1.0), (100.0, 1.0), (0.02, -3.0),
         (0.02, 40.0)),
    ),
)  # fmt: skip
def test_publishes_every_100_ms_at_any_input_rate(
    serve: Serve, step_s: float, stamp_rate: float
) -> None:
    port = serve(SimulatedPort(frames_every(step_s, 5.0, stamp_rate)), 5.05)
    published = [at_s for at_s, _ in port.published if at_s < 5.05]
    assert len(published) == 51
    for number, at_s in enumerate(published):
        assert 0.1 * number - 1e-9 <= at_s <= 0.1 * number + 0.0101
    details = [f for _, f in port.sent if isinstance(SocReader().read(f), SocDetail)]
    assert len(details) == 6


def test_heartbeat_waits_briefly_for_the_next_sample(serve: Serve) -> None:
    port = serve(SimulatedPort(frames_every(0.1, 5.0, from_s=0.004)), 5.0)
    expected = [pytest.approx(0.1 * number + 0.004) for number in range(1, 10)]
    assert [round(at_s, 3) for at_s, _ in port.published[1:10]] == expected
    read = [SocReader().read(frame) for _, frame in port.sent]
    assert [each.samples for each in read if isinstance(each, SocDetail)][:5] == [1, 11, 21, 31, 41]


def test_a_waiting_current_is_stale_after_a_silence(serve: Serve) -> None:
    current = GENERIC.current.key
    frames = [
        (at_s, frame)
        for at_s, frame in frames_every(0.1, 2.1)
        if at_s < 1.95 or frame.arbitration_id == current
    ]
    port = serve(SimulatedPort(frames), 10.0)
    last = port.published[-1][1]
    assert last.status is Status.INVALID
    assert last.reasons & Reason.INPUT_STALE
    assert last.age_s >= 7.0


def test_missed_heartbeats_are_skipped_on_the_grid(serve: Serve) -> None:
    port = SimulatedPort([*frames_every(0.1, 2.0), *frames_every(0.1, 12.0, from_s=9.0)])
    port.suspended_s = (2.0, 5.678)
    serve(port, 12.0)
    published = [at_s for at_s, _ in port.published]
    steps = [b - a for a, b in itertools.pairwise(published)]
    assert sum(step > 0.2 for step in steps) == 1
    assert min(steps) > 0.02
    assert all(abs(at_s * 10.0 - round(at_s * 10.0)) < 0.11 for at_s in published[-20:])


def test_old_and_unknown_soc_are_distinguished(serve: Serve) -> None:
    port = serve(SimulatedPort(frames_every(0.1, 4.0, from_s=1.0)), 40.0)
    unknown = [content for at_s, content in port.published if at_s < 0.9]
    assert {each.status for each in unknown} == {Status.INITIALISING}
    assert all(np.isnan(each.soc_pct) and np.isnan(each.age_s) for each in unknown)
    old = [(at_s, content) for at_s, content in port.published if at_s > 6.0]
    assert {each.status for _, each in old} == {Status.INVALID}
    assert all(each.reasons & Reason.INPUT_STALE for _, each in old)
    assert len({each.soc_pct for _, each in old}) == 1
    assert {each.age_s for at_s, each in old if at_s > 34.5} == {30.0}
    assert next(each.age_s for at_s, each in old if at_s > 10.0) == 6.0


def test_silence_is_stale_until_input_returns(serve: Serve) -> None:
    port = SimulatedPort([*frames_every(0.1, 3.0), *frames_every(0.1, 7.0, from_s=5.0)])
    serve(port, LoopSettings(timeout_s=0.3, duration_s=7.0))
    stale = [at_s for at_s, each in port.published if each.reasons & Reason.INPUT_STALE]
    assert [at_s for at_s in stale if at_s > 0.2] == [
        pytest.approx(0.1 * number, abs=0.012) for number in range(32, 50)
    ]
    assert port.published[-1][1].status is Status.DEGRADED  # its delay line is still filling


@pytest.mark.parametrize("stamps", ["kernel", "driver"])
def test_backlog_is_stale_until_it_is_processed(serve: Serve, stamps: Stamps) -> None:
    """The service is suspended from 3.0 to 9.0 s, then reads the backlog within two seconds."""
    port = SimulatedPort(frames_every(0.02, 14.0))
    port.capabilities = BackendCapabilities(stamps, echoes=False, has_error_classes=False)
    port.suspended_s = (3.0, 6.0)
    # The backlog is six seconds of fifty samples of two frames, plus what arrives meanwhile.
    port.work_s = lambda since_s: 0.0025 if 9.0 <= since_s < 11.0 else 0.0
    serve(port, 14.0)
    fresh = [content for at_s, content in port.published if 0.5 < at_s < 3.0 or at_s > 13.0]
    assert not any(each.reasons & Reason.INPUT_STALE for each in fresh)
    behind = [content for at_s, content in port.published if 9.0 < at_s < 9.9]
    assert len(behind) >= 9
    if stamps == "kernel":
        assert {each.status for each in behind} == {Status.INVALID}
        assert all(each.reasons & Reason.INPUT_STALE for each in behind)
        assert behind[0].age_s == 6.0  # falls by three seconds a second
        assert behind[-1].age_s == 3.0
    else:  # without kernel stamps the lag is not known
        assert not any(each.reasons & Reason.INPUT_STALE for each in behind[1:])


def test_ends_after_duration_or_when_idle(serve: Serve) -> None:
    port = serve(SimulatedPort([]), LoopSettings(duration_s=0.3, until_idle_s=0.1))
    assert port.since_s == pytest.approx(0.3, abs=0.1)  # idle before the first sample: no end
    frames = frames_every(0.1, 3.0, from_s=1.0)
    port = serve(SimulatedPort(frames), LoopSettings(until_idle_s=0.5))
    assert port.since_s == pytest.approx(3.4, abs=0.11)


def test_checkpoints_come_soon_periodically_and_at_the_end(serve: Serve) -> None:
    port, asked = SimulatedPort([]), list[float]()
    settings = LoopSettings(duration_s=2.6, checkpoint_every_s=1.2)
    serve(port, settings, checkpoint=lambda: asked.append(port.since_s))
    assert asked == [pytest.approx(at_s, abs=0.11) for at_s in (1.0, 2.2, 2.6)]


# --- On a virtual bus


def send_log(port: BusConnection, seconds: float) -> None:
    for frame in frames_of(short_log(seconds)):
        port.send(frame)


def test_a_replay_clock_that_is_no_input_is_told_once() -> None:
    with virtual_port("clock") as port, virtual_service("clock") as service:
        for _ in range(3):
            port.send(ClockFrames().at(5_000_000))
        send_log(port, 1.0)
        assert waits(lambda: service.pipeline.samples == 10)
    assert len(service.warnings) == 1
    assert "--time-source replay-clock" in service.warnings[0]


def serve_on(bus: BrokenBus, seconds: float) -> tuple[Service, list[int]]:
    """Return the ended service and the checkpoints that it asked for."""
    saved = list[int]()
    pipeline = Pipeline(GENERIC, leaf_model(), PipelineSettings())
    port = BusConnection(bus, "fake bus")  # type: ignore[arg-type] # has what a bus is used for
    settings = LoopSettings(duration_s=seconds)
    with Service(port, pipeline, settings, checkpoint=lambda: saved.append(1)) as service:
        service.join(60.0)
    return service, saved


def test_garbled_packets_error_frames_and_a_full_queue_are_counted() -> None:
    events = [unpack_error(), can.Message(is_error_frame=True), unpack_error()]
    full = can.CanOperationError("Failed to transmit: No buffer space", errno.ENOBUFS)
    service, _ = serve_on(BrokenBus(events, sending=full), 0.5)
    assert service.error is None
    assert (service.port.garbled, service.port.error_frames) == (2, 1)
    assert service.port.unsent > 2
    assert service.pipeline.counts.frames == 0


@pytest.mark.parametrize(
    ("bus", "say"),
    [
        (BrokenBus([network_down()]), "receiving failed"),
        (BrokenBus([OSError(errno.ENODEV, "No such device")]), "receiving failed"),
        (BrokenBus([], sending=network_down()), "sending failed"),
    ],
)
def test_a_lost_bus_ends_the_loop_with_one_line_and_saves_the_state(
    bus: BrokenBus, say: str
) -> None:
    service, saved = serve_on(bus, 5.0)
    assert isinstance(service.error, BusError)
    assert f"fake bus: {say}" in str(service.error)
    assert service.error.exit_code == 1
    assert saved == [1]


# --- Another sender of the own ids


def multicast_service(port: int) -> Service:
    pipeline = Pipeline(GENERIC, leaf_model())
    address = bus_address("udp_multicast", options={"port": port})
    bus = open_bus(address, pipeline.filters)
    return Service(BusConnection(bus, str(address), backend_capabilities(address)), pipeline)


def test_two_services_with_the_same_ids_notice_each_other() -> None:
    with virtual_service("rivals") as one, virtual_service("rivals") as two:
        assert waits(lambda: bool(one.warnings) and bool(two.warnings))
        assert waits(lambda: bool(one.pipeline.published.reasons & Reason.DUPLICATE_SENDER))
    for service in (one, two):
        assert "sends 0x5A" in service.warnings[0]
        assert service.monitor.foreign >= 3
        assert service.pipeline.counts.frames == 0  # they are not input


def test_own_frames_that_the_bus_returns_are_not_foreign() -> None:
    with multicast_service(20_000 + (os.getpid() + 7919) % 20_000) as alone:
        time.sleep(0.5)  # five frames
    assert alone.warnings == []
    assert alone.monitor.foreign == 0


@pytest.mark.parametrize("echoes", [False, True])
def test_identical_foreign_frames_are_noticed(echoes: bool) -> None:
    own = OwnFrames(echoes=echoes)
    proofs = []
    for number in range(4):
        mine = can.Message(arbitration_id=0x5A0, is_extended_id=False, data=[number])
        own.note_sent(mine, 1.0)
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
        own.note_sent(can.Message(arbitration_id=0x5A0, is_extended_id=False, data=[number]), 1.0)
    assert own.is_echo(can.Message(arbitration_id=0x5A0, is_extended_id=False, data=[2]))
    assert own.foreign == 4


def test_false_frames_do_not_move_the_soc() -> None:
    """In the middle third of a drive a second sender puts 300 A and 300 V between the true ones."""
    settings = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
    pipeline = Pipeline(GENERIC, leaf_model(), settings, publishes=False)
    encoder, false, frames = FrameEncoder(GENERIC), FrameEncoder(GENERIC), list[can.Message]()
    for sample in samples_of(short_log(300.0)):
        frames += encoder.encode(sample)
        if 100.0 <= sample.time_s < 200.0:
            wrong = sample._replace(current_a=300.0, voltage_v=300.0, time_s=sample.time_s + 0.03)
            frames += false.encode(wrong)
    during, after = list[Estimate](), list[Estimate]()
    for each in sorted(frames, key=lambda each: each.timestamp):
        time_s = each.timestamp
        pipeline.handle(each)
        if 105.0 < time_s < 205.0:
            during.append(pipeline.estimate_now())
        elif time_s > 260.0:
            after.append(pipeline.estimate_now())
    assert all(each.reasons & Reason.DUPLICATE_SENDER for each in during)
    assert all(each.status is Status.INVALID for each in during)
    # 300 V alone would be an empty pack.
    assert max(abs(each.soc_pct - 79.0) for each in during) < 1.0
    assert all(abs(each.soc_pct - 77.2) < 3.0 * each.soc_std_pct for each in after)
    assert max(each.soc_std_pct for each in after) > 1.5 * during[0].soc_std_pct
    assert pipeline.counts.samples < 2200


# --- Outputs, checkpoints


class Failing(Output):
    def __init__(self) -> None:
        self.calls = 0

    def on_sample(self, sample: Sample, estimate: Estimate) -> None:
        self.calls += 1
        raise RuntimeError("broken")


def test_an_output_that_fails_is_told_nothing_more(caplog: pytest.LogCaptureFixture) -> None:
    pipeline = Pipeline(GENERIC, leaf_model())
    failing, rows = Failing(), Rows([])
    with virtual_port("fails", pipeline.filters) as port, virtual_port("fails") as sender:
        send_log(sender, 2.0)
        Loop(port, pipeline, outputs=[failing, rows]).run(lambda: pipeline.samples == 20)
    assert (failing.calls, len(rows.rows)) == (1, 20)
    assert "Failing has ended: RuntimeError('broken')" in caplog.text
