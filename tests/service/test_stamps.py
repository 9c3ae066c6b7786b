"""A live service whose frames have impossible stamps: time, freshness, and the recording."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random

import can
import pytest

from cangauge.bus.connection import BusConnection
from cangauge.bus.open import BackendCapabilities, BusAddress, open_bus
from cangauge.bus.publish import SocEstimate, SocReader
from cangauge.bus.recording import capture_samples
from cangauge.bus.time_source import ClockFrames
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.loop import LoopSettings
from cangauge.service.offline import estimate_capture
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.record import Recorder
from cangauge.types import Reason, Sample, Status
from live import Service, frames_of, leaf_model, short_log, virtual_port, virtual_service, waits

KERNEL = BackendCapabilities("kernel", echoes=False, has_error_classes=False)
PACE_S = 0.02
GIVEN = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
"""A start: drives of seconds have no block of voltages."""


class RestampedBus:
    """A virtual bus whose stamps are changed."""

    protocol = can.CanProtocol.CAN_20

    def __init__(self, channel: str, stamp: Callable[[float], float]) -> None:
        self._bus = open_bus(BusAddress("virtual", channel))
        self._stamp = stamp
        self.set_filters, self.send = self._bus.set_filters, self._bus.send
        self.shutdown = self._bus.shutdown

    def recv(self, timeout: float | None) -> can.Message | None:
        message = self._bus.recv(timeout)
        if message is not None:
            message.timestamp = self._stamp(message.timestamp)
        return message

    def fileno(self) -> int:
        raise NotImplementedError


def run(
    channel: str, stamp: Callable[[float], float], seconds: float, path: Path
) -> tuple[Service, list[SocEstimate]]:
    """Feed a service in real time; return it and its published estimates."""
    reader, found = SocReader(), []
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model(), GIVEN)
    bus = RestampedBus(channel, stamp)
    port = BusConnection(bus, "restamped", KERNEL)  # type: ignore[arg-type] # has what is used
    samples = iter(samples_of(short_log(seconds, 1.0 / PACE_S)))
    with (
        Recorder(path) as recorder,
        virtual_port(channel) as car,
        Service(port, pipeline, LoopSettings(), recorder) as service,
    ):
        encoder, due_s = FrameEncoder(Vehicle.load("generic")), time.monotonic()
        for sample in samples:
            for frame in encoder.encode(sample):
                car.send(frame)
            due_s += PACE_S
            while (message := car.receive(max(due_s - time.monotonic(), 0.0))) is not None:
                if isinstance(estimate := reader.read(message), SocEstimate):
                    found.append(estimate)
        assert waits(lambda: pipeline.samples >= round(seconds / PACE_S))
    return service, found


def assert_recording_agrees(path: Path, service: Service) -> None:
    recorded = estimate_capture(path, Vehicle.load("generic"), leaf_model(), GIVEN.estimator)
    assert recorded.table.soc_pct.tolist() == [each.soc_pct for _, each in service.rows]
    assert recorded.table.reasons.tolist() == [int(each.reasons) for _, each in service.rows]
    assert recorded.table.time_s.tolist() == [each.time_s for _, each in service.rows]


@pytest.mark.parametrize("kind", ["still", pytest.param("random", marks=pytest.mark.nightly)])
def test_impossible_stamps_are_replaced_and_reported(kind: str, tmp_path: Path) -> None:
    rng = Random(1)  # noqa: S311 - must be repeatable
    began_s = time.time()

    def stamp(true_s: float) -> float:
        if kind == "still":
            return min(true_s, began_s + 0.5)
        return true_s + rng.uniform(-0.9, 0.9)

    service, published = run(f"stamps-{kind}", stamp, 4.0, tmp_path / "bus.log")
    taken = service.pipeline.taken
    assert taken > 0.9 * service.pipeline.samples
    times = [time_s for time_s, _ in service.rows]
    assert times[-1] - times[0] == pytest.approx(4.0, abs=0.3)
    assert max(each.age_s for each in published if each.age_s == each.age_s) <= 1.0
    last = published[-1]
    assert last.reasons & Reason.TIME_UNCERTAIN
    assert last.status is Status.DEGRADED
    assert not last.reasons & Reason.INPUT_STALE
    assert sum("contradict the monotonic clock" in line for line in service.warnings) == 1
    assert_recording_agrees(tmp_path / "bus.log", service)


def test_clock_set_in_mid_drive_costs_nothing(tmp_path: Path) -> None:
    set_s = time.time() + 1.0

    def stamp(true_s: float) -> float:
        return true_s if true_s < set_s else true_s + 86_400.0

    service, published = run("stamps-set", stamp, 2.5, tmp_path / "bus.log")
    times = [time_s for time_s, _ in service.rows]
    assert times[-1] - times[0] == pytest.approx(2.5, abs=0.3)
    assert all(two >= one for one, two in pairwise(times))
    reasons = published[-1].reasons
    assert not reasons & (Reason.TIME_UNCERTAIN | Reason.CURRENT_GAP | Reason.INPUT_STALE)
    assert any("was set by +86400.0 s" in line for line in service.warnings)
    assert_recording_agrees(tmp_path / "bus.log", service)
    # A state refers to the stamps as they come after a restart.
    state = service.pipeline.snapshot()
    assert state is not None
    later = Pipeline(Vehicle.load("generic"), leaf_model(), GIVEN)
    later.restore(state, 1.0)
    for frame in FrameEncoder(later.vehicle).encode(
        Sample(time.time() + 86_401.0, 1.0, 380.0, 20.0)
    ):
        later.handle(frame)
    assert later.taken == 1
    assert not later.latest.reasons & Reason.CURRENT_GAP


def test_samples_that_are_refused_do_not_make_it_fresh() -> None:
    reader = SocReader()
    settings = replace(GIVEN, time_source="replay-clock")
    loop = LoopSettings(timeout_s=0.3)
    found: list[SocEstimate] = []
    with (
        virtual_port("standing") as car,
        virtual_service("standing", settings, loop) as service,
    ):
        encoder, clock = FrameEncoder(Vehicle.load("generic")), ClockFrames()
        for number, sample in enumerate(samples_of(short_log(4.0, 20.0))):
            car.send(clock.at(min(round(sample.time_s * 1e6), 1_000_000)))
            for frame in encoder.encode(sample):
                car.send(frame)
            time.sleep(0.01 if number < 20 else 0.03)
        while (message := car.receive(0.0)) is not None:
            if isinstance(estimate := reader.read(message), SocEstimate):
                found.append(estimate)
        assert service.pipeline.samples > service.pipeline.taken + 30
    assert found[-1].status is Status.INVALID
    assert found[-1].reasons & Reason.INPUT_STALE
    assert found[-1].age_s >= 1.0


def test_uncertainty_grows_while_no_charge_is_counted() -> None:
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    for each in frames_of(short_log(100.0)):
        pipeline.handle(each)
    published = []
    for silent_s in (0.0, 1.0, 10.0, 60.0):
        pipeline.heartbeat(silent_s, 0.5)
        published.append(pipeline.published.soc_std_pct)
    assert published[0] == pipeline.latest.soc_std_pct
    assert published == sorted(published)
    # A minute of the drive's mean square current.
    assert published[-1] > published[0] + 0.1
    pipeline.heartbeat()
    assert pipeline.published.soc_std_pct == published[0]


def capture_of(path: Path, buses: dict[str, Callable[[float], float]]) -> Path:
    """Write a minute of a drive as received on several buses, each with its own stamps."""
    lines = [
        f"({1e9 + stamp(each.timestamp):.6f}) {bus} {each.arbitration_id:03X}#{each.data.hex()}"
        for each in frames_of(short_log(60.0))
        for bus, stamp in buses.items()
    ]
    path.write_text("\n".join([*lines, ""]))
    return path


def test_two_adapters_in_a_capture_keep_their_own_time(tmp_path: Path) -> None:
    buses = {"can0": lambda time_s: time_s, "can1": lambda time_s: time_s - 3.0}
    path = capture_of(tmp_path / "two.log", buses)
    found = estimate_capture(path, Vehicle.load("generic"), leaf_model())
    assert found.recorded.duration_s == pytest.approx(59.9)
    read = capture_samples(path, Vehicle.load("generic"))
    assert read.time_s[-1] - read.time_s[0] == pytest.approx(59.9)
