"""The rate of publishing, on a clock that the test turns: it is the loop's own."""

from __future__ import annotations

import itertools
import time
from types import SimpleNamespace

import can
import pytest

from cangauge.bus.connection import UNKNOWN_INTERFACE, BackendCapabilities, Stamps
from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.publish import SocDetail, SocEstimate, SocReader
from cangauge.bus.vehicle import load_vehicle
from cangauge.estimate.settings import EstimatorSettings
from cangauge.estimate.validity import Reason, Sample, Status
from cangauge.service import loop
from cangauge.service.loop import LoopSettings, Outputs, serve
from cangauge.service.pipeline import Pipeline, PipelineSettings
from live import leaf_model, never


class Desk:
    """A port and the clock in one: receiving waits until the next frame, or the time is up."""

    facts = UNKNOWN_INTERFACE
    queue_drops = None

    def __init__(self, frames: list[tuple[float, can.Message]], began_s: float = 5000.0) -> None:
        self.now_s = began_s
        self._frames = [(began_s + at_s, frame) for at_s, frame in frames]
        self.sent: list[tuple[float, can.Message]] = []
        self.work_s = 0.0
        self._began_s = began_s

    def receive_waiting(self, timeout_s: float) -> list[can.Message]:
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
    encoder = FrameEncoder(load_vehicle("generic"))
    times = [from_s + number * step_s for number in range(int((until_s - from_s) / step_s))]
    return [
        (at_s, frame)
        for at_s in times
        for frame in encoder.encode(Sample(1.7e9 + stamp_rate * at_s, 10.0, 370.0, 20.0))
    ]


def served(
    monkeypatch: pytest.MonkeyPatch, frames: list[tuple[float, can.Message]], seconds: float
) -> Desk:
    desk = Desk(frames)
    clock = SimpleNamespace(
        monotonic=lambda: desk.now_s,
        process_time=time.process_time,
    )
    monkeypatch.setattr(loop, "time", clock)
    pipeline = Pipeline(load_vehicle("generic"), leaf_model(), PipelineSettings())
    serve(desk, pipeline, LoopSettings(duration_s=seconds), Outputs(), never)  # type: ignore[arg-type] # has what a port is used for
    return desk


def beats(desk: Desk) -> list[tuple[float, SocEstimate]]:
    reader = SocReader()
    read = [(at_s, reader.read(frame)) for at_s, frame in desk.sent]
    return [(at_s, content) for at_s, content in read if isinstance(content, SocEstimate)]


@pytest.mark.parametrize("step_s", [0.0007, 0.01, 0.03, 0.1, 0.137, 1.0, 100.0])
def test_every_100_ms_whatever_comes(monkeypatch: pytest.MonkeyPatch, step_s: float) -> None:
    desk = served(monkeypatch, frames_every(step_s, 5.0), 5.05)
    told = [at_s for at_s, _ in beats(desk) if at_s < 5.05]
    assert len(told) == 51
    for number, at_s in enumerate(told):
        assert 0.1 * number - 1e-9 <= at_s <= 0.1 * number + 0.0101
    details = [f for _, f in desk.sent if isinstance(SocReader().read(f), SocDetail)]
    assert len(details) == 6


def test_a_beat_waits_a_little_to_tell_of_the_sample_that_is_about_to_come(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told = beats(served(monkeypatch, frames_every(0.1, 5.0, from_s=0.004), 5.0))
    assert [round(at_s, 3) for at_s, _ in told[1:10]] == [
        pytest.approx(0.1 * number + 0.004) for number in range(1, 10)
    ]


def test_bus_time_that_runs_faster_or_backwards_does_not_matter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for rate in (40.0, -3.0):
        desk = served(monkeypatch, frames_every(0.02, 5.0, stamp_rate=rate), 5.05)
        assert sum(at_s < 5.05 for at_s, _ in beats(desk)) == 51


def test_a_machine_that_slept_goes_on_the_grid_and_makes_up_for_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frames = [*frames_every(0.1, 2.0), *frames_every(0.1, 12.0, from_s=9.0)]
    desk = Desk(frames)
    receive = desk.receive_waiting

    def sleepy(timeout_s: float) -> list[can.Message]:
        if 2.0 < desk.now_s - 5000.0 < 2.5:
            desk.now_s += 5.678
        return receive(timeout_s)

    desk.receive_waiting = sleepy  # type: ignore[method-assign] # the machine sleeps once
    clock = SimpleNamespace(
        monotonic=lambda: desk.now_s,
        process_time=time.process_time,
    )
    monkeypatch.setattr(loop, "time", clock)
    pipeline = Pipeline(load_vehicle("generic"), leaf_model(), PipelineSettings())
    serve(desk, pipeline, LoopSettings(duration_s=12.0), Outputs(), never)  # type: ignore[arg-type] # has what a port is used for
    told = [at_s for at_s, _ in beats(desk)]
    steps = [b - a for a, b in itertools.pairwise(told)]
    assert sum(step > 0.2 for step in steps) == 1
    assert min(steps) > 0.02
    assert all(abs(at_s * 10.0 - round(at_s * 10.0)) < 0.11 for at_s in told[-20:])


def test_old_and_unknown_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    told = beats(served(monkeypatch, frames_every(0.1, 4.0, from_s=1.0), 40.0))
    unknown = [content for at_s, content in told if at_s < 0.9]
    assert {each.status for each in unknown} == {Status.INITIALISING}
    assert all(each.soc_pct != each.soc_pct and each.age_s != each.age_s for each in unknown)
    old = [(at_s, content) for at_s, content in told if at_s > 5.2]
    assert {each.status for _, each in old} == {Status.INVALID}
    assert all(each.reasons & Reason.INPUT_STALE for _, each in old)
    assert len({each.soc_pct for _, each in old}) == 1
    assert [each.age_s for at_s, each in old if at_s > 34.5] == [30.0] * len(
        [1 for at_s, _ in old if at_s > 34.5]
    )
    assert next(each.age_s for at_s, each in old if at_s > 10.0) == 6.0


@pytest.mark.parametrize("stamps", ["kernel", "driver"])
def test_a_backlog_is_old_until_it_is_worked_off(
    monkeypatch: pytest.MonkeyPatch, stamps: Stamps
) -> None:
    """Stopped from 3.0 to 9.0 s, the service then reads in two seconds what waited meanwhile."""
    desk = Desk(frames_every(0.02, 14.0))
    desk.facts = BackendCapabilities(stamps, echoes=False, has_error_classes=False)
    receive = desk.receive_waiting

    def stopped(timeout_s: float) -> list[can.Message]:
        since_s = desk.now_s - 5000.0
        if 3.0 <= since_s < 3.5:
            desk.now_s += 6.0
        # Working off six seconds of fifty samples, two frames each, and what comes meanwhile.
        desk.work_s = 0.0025 if 9.0 <= since_s < 11.0 else 0.0
        return receive(timeout_s)

    desk.receive_waiting = stopped  # type: ignore[method-assign] # is stopped once
    clock = SimpleNamespace(
        monotonic=lambda: desk.now_s,
        time=lambda: 1.7e9 + desk.now_s - 5000.0,
        process_time=time.process_time,
    )
    monkeypatch.setattr(loop, "time", clock)
    known = PipelineSettings(EstimatorSettings(initial_soc_pct=60.0))
    pipeline = Pipeline(load_vehicle("generic"), leaf_model(), known)
    serve(desk, pipeline, LoopSettings(duration_s=14.0), Outputs(), never)  # type: ignore[arg-type] # has what a port is used for
    told = beats(desk)
    fresh = [content for at_s, content in told if 0.5 < at_s < 3.0 or at_s > 13.0]
    assert not any(each.reasons & Reason.INPUT_STALE for each in fresh)
    behind = [content for at_s, content in told if 9.0 < at_s < 9.9]
    assert len(behind) >= 9
    if stamps == "kernel":
        assert {each.status for each in behind} == {Status.INVALID}
        assert all(each.reasons & Reason.INPUT_STALE for each in behind)
        assert behind[0].age_s == 6.0  # and falls by three seconds a second
        assert behind[-1].age_s == 3.0
    else:  # nobody can tell
        assert not any(each.reasons & Reason.INPUT_STALE for each in behind[1:])
