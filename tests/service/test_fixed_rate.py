"""Rate of publishing, on a simulated monotonic clock of the loop."""

from __future__ import annotations

import itertools
import time
from types import SimpleNamespace

import can
import pytest

from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.open import UNKNOWN_INTERFACE, BackendCapabilities, Stamps
from cangauge.bus.publish import SocDetail, SocEstimate, SocReader
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.settings import EstimatorSettings
from cangauge.service import loop
from cangauge.service.loop import LoopSettings
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.types import Reason, Sample, Status
from live import leaf_model, never


class SimulatedPort:
    """Port and clock in one: receiving advances the clock to the next frame or the time-out."""

    capabilities = UNKNOWN_INTERFACE
    queue_drops = None
    name = "simulated"

    def __init__(self, frames: list[tuple[float, can.Message]], began_s: float = 5000.0) -> None:
        self.now_s = began_s
        self._frames = [(began_s + at_s, frame) for at_s, frame in frames]
        self.sent: list[tuple[float, can.Message]] = []
        self.work_s = 0.0
        self._began_s = began_s

    @property
    def is_drained(self) -> bool:
        return not self._frames or self._frames[0][0] > self.now_s

    def receive_pending(self, timeout_s: float) -> list[can.Message]:
        if self._frames and self._frames[0][0] <= self.now_s + timeout_s:
            at_s, frame = self._frames.pop(0)
            self.now_s = max(self.now_s, at_s) + self.work_s
            return [frame]
        self.now_s += max(timeout_s, 1e-6)
        return []

    def post(self, frame: can.Message, _within_s: float) -> None:
        self.sent.append((self.now_s - self._began_s, frame))

    def set_filters(self, _filters: object) -> None:
        pass


def frames_every(
    step_s: float, until_s: float, stamp_rate: float = 1.0, from_s: float = 0.0
) -> list[tuple[float, can.Message]]:
    encoder = FrameEncoder(Vehicle.load("generic"))
    times = [from_s + number * step_s for number in range(int((until_s - from_s) / step_s))]
    return [
        (at_s, frame)
        for at_s in times
        for frame in encoder.encode(Sample(1.7e9 + stamp_rate * at_s, 10.0, 370.0, 20.0))
    ]


def served(
    monkeypatch: pytest.MonkeyPatch, frames: list[tuple[float, can.Message]], seconds: float
) -> SimulatedPort:
    port = SimulatedPort(frames)
    clock = SimpleNamespace(
        monotonic=lambda: port.now_s,
        process_time=time.process_time,
    )
    monkeypatch.setattr(loop, "time", clock)
    monkeypatch.setattr(loop, "steady_s", lambda: port.now_s)
    given = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model(), given)
    loop.Loop(port, pipeline, LoopSettings(duration_s=seconds)).run(never)  # type: ignore[arg-type] # has what a port is used for
    return port


def published_on(port: SimulatedPort) -> list[tuple[float, SocEstimate]]:
    reader = SocReader()
    read = [(at_s, reader.read(frame)) for at_s, frame in port.sent]
    return [(at_s, content) for at_s, content in read if isinstance(content, SocEstimate)]


@pytest.mark.parametrize("step_s", [0.0007, 0.01, 0.03, 0.1, 0.137, 1.0, 100.0])
def test_publishes_every_100_ms_at_any_input_rate(
    monkeypatch: pytest.MonkeyPatch, step_s: float
) -> None:
    port = served(monkeypatch, frames_every(step_s, 5.0), 5.05)
    published = [at_s for at_s, _ in published_on(port) if at_s < 5.05]
    assert len(published) == 51
    for number, at_s in enumerate(published):
        assert 0.1 * number - 1e-9 <= at_s <= 0.1 * number + 0.0101
    details = [f for _, f in port.sent if isinstance(SocReader().read(f), SocDetail)]
    assert len(details) == 6


def test_heartbeat_waits_briefly_for_the_next_sample(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    published = published_on(served(monkeypatch, frames_every(0.1, 5.0, from_s=0.004), 5.0))
    assert [round(at_s, 3) for at_s, _ in published[1:10]] == [
        pytest.approx(0.1 * number + 0.004) for number in range(1, 10)
    ]


def test_rate_is_independent_of_bus_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for rate in (40.0, -3.0):
        port = served(monkeypatch, frames_every(0.02, 5.0, stamp_rate=rate), 5.05)
        assert sum(at_s < 5.05 for at_s, _ in published_on(port)) == 51


def test_missed_heartbeats_are_skipped_on_the_grid(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frames = [*frames_every(0.1, 2.0), *frames_every(0.1, 12.0, from_s=9.0)]
    port = SimulatedPort(frames)
    receive = port.receive_pending

    def sleepy(timeout_s: float) -> list[can.Message]:
        if 2.0 < port.now_s - 5000.0 < 2.5:
            port.now_s += 5.678
        return receive(timeout_s)

    port.receive_pending = sleepy  # type: ignore[method-assign] # suspended once
    clock = SimpleNamespace(
        monotonic=lambda: port.now_s,
        process_time=time.process_time,
    )
    monkeypatch.setattr(loop, "time", clock)
    monkeypatch.setattr(loop, "steady_s", lambda: port.now_s)
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model(), PipelineSettings())
    loop.Loop(port, pipeline, LoopSettings(duration_s=12.0)).run(never)  # type: ignore[arg-type] # has what a port is used for
    published = [at_s for at_s, _ in published_on(port)]
    steps = [b - a for a, b in itertools.pairwise(published)]
    assert sum(step > 0.2 for step in steps) == 1
    assert min(steps) > 0.02
    assert all(abs(at_s * 10.0 - round(at_s * 10.0)) < 0.11 for at_s in published[-20:])


def test_old_and_unknown_soc_are_distinguished(monkeypatch: pytest.MonkeyPatch) -> None:
    published = published_on(served(monkeypatch, frames_every(0.1, 4.0, from_s=1.0), 40.0))
    unknown = [content for at_s, content in published if at_s < 0.9]
    assert {each.status for each in unknown} == {Status.INITIALISING}
    assert all(each.soc_pct != each.soc_pct and each.age_s != each.age_s for each in unknown)
    old = [(at_s, content) for at_s, content in published if at_s > 5.2]
    assert {each.status for _, each in old} == {Status.INVALID}
    assert all(each.reasons & Reason.INPUT_STALE for _, each in old)
    assert len({each.soc_pct for _, each in old}) == 1
    assert [each.age_s for at_s, each in old if at_s > 34.5] == [30.0] * len(
        [1 for at_s, _ in old if at_s > 34.5]
    )
    assert next(each.age_s for at_s, each in old if at_s > 10.0) == 6.0


@pytest.mark.parametrize("stamps", ["kernel", "driver"])
def test_backlog_is_stale_until_it_is_processed(
    monkeypatch: pytest.MonkeyPatch, stamps: Stamps
) -> None:
    """The service is suspended from 3.0 to 9.0 s, then reads the backlog within two seconds."""
    port = SimulatedPort(frames_every(0.02, 14.0))
    port.capabilities = BackendCapabilities(stamps, echoes=False, has_error_classes=False)
    receive = port.receive_pending

    def stopped(timeout_s: float) -> list[can.Message]:
        since_s = port.now_s - 5000.0
        if 3.0 <= since_s < 3.5:
            port.now_s += 6.0
        # The backlog is six seconds of fifty samples of two frames, plus what arrives meanwhile.
        port.work_s = 0.0025 if 9.0 <= since_s < 11.0 else 0.0
        return receive(timeout_s)

    port.receive_pending = stopped  # type: ignore[method-assign] # suspended once
    clock = SimpleNamespace(
        monotonic=lambda: port.now_s,
        time=lambda: 1.7e9 + port.now_s - 5000.0,
        process_time=time.process_time,
    )
    monkeypatch.setattr(loop, "time", clock)
    monkeypatch.setattr(loop, "steady_s", lambda: port.now_s)
    known = PipelineSettings(EstimatorSettings(initial_soc_pct=60.0))
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model(), known)
    loop.Loop(port, pipeline, LoopSettings(duration_s=14.0)).run(never)  # type: ignore[arg-type] # has what a port is used for
    published = published_on(port)
    fresh = [content for at_s, content in published if 0.5 < at_s < 3.0 or at_s > 13.0]
    assert not any(each.reasons & Reason.INPUT_STALE for each in fresh)
    behind = [content for at_s, content in published if 9.0 < at_s < 9.9]
    assert len(behind) >= 9
    if stamps == "kernel":
        assert {each.status for each in behind} == {Status.INVALID}
        assert all(each.reasons & Reason.INPUT_STALE for each in behind)
        assert behind[0].age_s == 6.0  # falls by three seconds a second
        assert behind[-1].age_s == 3.0
    else:  # without kernel stamps the lag is not known
        assert not any(each.reasons & Reason.INPUT_STALE for each in behind[1:])
