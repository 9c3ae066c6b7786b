"""Replay to a service on one bus: no loss, recorded timing, errors without a receiver."""

from __future__ import annotations

import itertools
import math
import random
import re
import threading
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from cangauge.bus.connection import BusConnection
from cangauge.bus.open import BusAddress, open_bus
from cangauge.bus.publish import SocPublisher, standard_filter
from cangauge.bus.time_source import is_clock
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import CangaugeError, InputError
from cangauge.estimation.offline import run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.replay.encoder import FrameEncoder
from cangauge.replay.player import ReplayState, play
from cangauge.replay.steps import CaptureSource, LogSource, quantization_bound
from cangauge.service.pipeline import NOTHING_YET, PipelineSettings
from cangauge.service.record import Recorder
from cangauge.settings import FrameIds
from live import (
    PATIENCE_S,
    Service,
    leaf_model,
    never,
    quantized,
    short_log,
    virtual_port,
    virtual_service,
    waits,
)
from selection import nightly_except

NOWHERE = BusAddress("virtual", "x")

MAX: dict[str, Any] = {"speed": math.inf, "acknowledge_s": 3.0}
REPLAYED = PipelineSettings(time_source="replay-clock")
SOC_FRAMES = [standard_filter(0x5A0), standard_filter(0x5A1)]


def play_log(
    channel: str, seconds: float, settings: dict[str, Any], preset: str = "generic"
) -> ReplayState:
    with virtual_port(channel, SOC_FRAMES) as port:
        source = LogSource(short_log(seconds), Vehicle.load(preset))
        return play(port, source, **settings, stop=never)


@pytest.mark.parametrize(
    ("preset", "method"),
    nightly_except(
        [("generic", "newton"), ("leaf_aze0", "ekf")],
        [("generic", "ekf"), ("generic", "newton"), ("generic", "coulomb"), ("leaf_aze0", "ekf")],
    ),
)
def test_replayed_soc_is_offline_soc_within_the_bound(preset: str, method: str) -> None:
    vehicle, log, model = Vehicle.load(preset), short_log(200.0), leaf_model()
    estimator = EstimatorSettings(method=method, initial_soc_pct=80.0)  # type: ignore[arg-type] # parametrised
    settings = PipelineSettings(estimator, "replay-clock")
    with virtual_service(f"{preset}{method}", settings, vehicle=vehicle) as service:
        state = play_log(f"{preset}{method}", 200.0, MAX, preset)
    assert state.acknowledged == state.samples == len(log) == len(service.rows)
    assert service.pipeline.counts["lost"] == 0
    offline = run_estimator(samples_of(log), model, estimator).soc_pct
    live = np.array([estimate.soc_pct for _, estimate in service.rows])
    bound = quantization_bound(vehicle, model, log)
    worst = float(np.max(np.abs(live - offline)))
    assert worst <= bound[method] + 1e-9
    # The bound is tight: quantization shows, not far below it.
    assert worst > bound[method] / 200.0


def test_the_bound_follows_its_equation() -> None:
    log, model = short_log(200.0), leaf_model()
    bound = quantization_bound(Vehicle.load("leaf_aze0"), model, log)
    # 0.25 A over the log's length; no stamp of this log needs rounding.
    assert bound["coulomb"] == pytest.approx(0.25 * log.duration_s / 36.0 / 51.5, rel=1e-6)
    resistance = 0.1032 + 0.01501 + 0.009697 + 0.004652
    volts = 0.25 + 0.7428 * 0.25 + 0.25 * resistance
    slope = min(model.voltage_model().pseudo_ocv_at(soc)[1] for soc in np.arange(0.0, 100.1, 0.1))
    assert bound["newton"] == pytest.approx(volts / slope, rel=1e-3)
    assert bound["ekf"] == bound["coulomb"] + bound["newton"]


def test_a_replay_waits_for_the_service_without_loss() -> None:
    result: list[ReplayState] = []
    player = threading.Thread(target=lambda: result.append(play_log("early", 30.0, MAX)))
    player.start()
    time.sleep(0.7)
    with virtual_service("early", REPLAYED) as service:
        player.join(10.0)
        assert service.pipeline.samples == 300
    assert result[0].acknowledged == 300


def test_successive_replays_give_equal_estimates() -> None:
    with virtual_service("twice", REPLAYED) as service:
        first = play_log("twice", 20.0, MAX)
        second = play_log("twice", 20.0, MAX)
    assert (first.acknowledged, second.acknowledged) == (200, 200)
    soc = [estimate.soc_pct for _, estimate in service.rows]
    assert repr(soc[:200]) == repr(soc[200:])  # NaN until the first block


def test_the_clock_may_have_another_id() -> None:
    ids = FrameIds(replay_clock=0x4AF)
    with virtual_service("moved", replace(REPLAYED, ids=ids)) as service:
        state = play_log("moved", 10.0, {**MAX, "ids": ids})
    assert state.acknowledged == state.clock_frames == service.pipeline.samples == 100


def test_the_last_samples_are_acknowledged() -> None:
    with virtual_service("prime", REPLAYED):
        assert play_log("prime", 10.1, MAX).acknowledged == 101


def test_a_missing_receiver_is_an_error_of_one_line() -> None:
    settings = {"speed": math.inf, "acknowledge_s": 0.4}
    with pytest.raises(CangaugeError, match="--time-source replay-clock") as caught:
        play_log("alone", 10.0, settings)
    assert caught.value.exit_code == 1
    assert "\n" not in str(caught.value)


def test_a_service_for_another_vehicle_is_an_error() -> None:
    settings = {"speed": math.inf, "acknowledge_s": 0.5}
    source = LogSource(short_log(100.0), Vehicle.load("generic"))
    with (
        virtual_port("other", SOC_FRAMES) as port,
        virtual_port("other", [standard_filter(0x5A1)]) as other,
        virtual_service("other", REPLAYED, vehicle=Vehicle.load("leaf_aze0")),
    ):
        assert other.receive(PATIENCE_S)  # the player waits less than SOC_DETAIL's interval
        with pytest.raises(CangaugeError, match=r"0 of \d+ samples sent have been processed"):
            play(port, source, **settings, stop=never)


class CrowdedBus:
    """A bus on which another program sends 500 samples after the tenth frame."""

    def __init__(self, channel: str) -> None:
        self._bus = open_bus(BusAddress("virtual", channel), SOC_FRAMES)
        self._intruder = open_bus(BusAddress("virtual", channel))
        self._encoder = FrameEncoder(Vehicle.load("generic"))
        self._sent = 0

    def send(self, message: can.Message) -> None:
        self._bus.send(message)
        self._sent += 1
        if self._sent == 10:
            for sample in samples_of(short_log(50.0)):
                for frame in self._encoder.encode(sample):
                    self._intruder.send(frame)

    def shutdown(self) -> None:
        self._bus.shutdown()
        self._intruder.shutdown()

    def __getattr__(self, name: str) -> object:
        return getattr(self._bus, name)


def test_a_second_sender_is_an_error_or_loses_samples_that_are_counted() -> None:
    """Its frames add samples, or spoil some."""
    port = BusConnection(CrowdedBus("crowd"), NOWHERE)  # type: ignore[arg-type] # has what is used
    source = LogSource(short_log(100.0), Vehicle.load("generic"))
    with virtual_service("crowd", REPLAYED), port:
        try:
            said = f"{play(port, source, **MAX, stop=never).lost} lost"
        except CangaugeError as error:
            said = str(error)
    assert re.search(r"another program|have been processed|[1-9]\d* lost", said)


class LossyBus:
    """Drops some of the frames sent."""

    def __init__(self, bus: can.BusABC, lose: set[int]) -> None:
        self._bus = bus
        self._lose = lose
        self._sent = 0

    def send(self, message: can.Message) -> None:
        self._sent += 1
        if self._sent not in self._lose:
            self._bus.send(message)

    def __getattr__(self, name: str) -> object:
        return getattr(self._bus, name)


def test_lost_frames_are_counted_and_the_replay_goes_on() -> None:
    bus = LossyBus(open_bus(BusAddress("virtual", "lossy"), SOC_FRAMES), {200, 400, 401, 402})
    source = LogSource(short_log(30.0), Vehicle.load("leaf_aze0"))
    with virtual_service("lossy", REPLAYED, vehicle=Vehicle.load("leaf_aze0")) as service:
        port = BusConnection(bus, NOWHERE)  # type: ignore[arg-type] # has what is used of a bus
        with port:
            state = play(port, source, **MAX, stop=never)
        assert service.pipeline.counts["lost"] > 0
    assert state.acknowledged is not None
    assert 0 < state.lost <= 4
    assert state.acknowledged + state.lost == state.samples == 300


def test_a_receiver_that_processed_more_than_was_sent_is_an_error() -> None:
    """Another program sends to it too, or it was restarted."""
    publisher = SocPublisher(acknowledge_every=1)
    receiver = open_bus(BusAddress("virtual", "more"))

    def receive() -> None:
        receiver.send(publisher.detail_frame(NOTHING_YET, 0))
        while (message := receiver.recv(PATIENCE_S)) is not None:
            if message.arbitration_id == 0x401:
                receiver.send(publisher.detail_frame(NOTHING_YET, 1000))
                return

    thread = threading.Thread(target=receive)
    source = LogSource(short_log(50.0), Vehicle.load("generic"))
    said = pytest.raises(CangaugeError, match=r"processed 1000 samples where .* another program")
    with virtual_port("more", SOC_FRAMES) as port, said:
        thread.start()
        play(port, source, **MAX, stop=never)
    thread.join()
    receiver.shutdown()


def test_frames_under_way_are_bounded() -> None:
    """The receiver's queue stays below what a default socket buffer holds."""
    bus = open_bus(BusAddress("virtual", "window"), SOC_FRAMES)
    receiver = open_bus(BusAddress("virtual", "window"))
    publisher = SocPublisher(acknowledge_every=1)
    most, samples = 0, 0

    def receive() -> None:
        nonlocal most, samples
        receiver.send(publisher.detail_frame(NOTHING_YET, 0))
        while samples < 500:
            most = max(most, receiver.queue.qsize())  # type: ignore[attr-defined] # VirtualBus
            message = receiver.recv(1.0)
            if message is None:
                return
            if message.arbitration_id == 0x401:
                samples += 1
                time.sleep(0.0005)
                if samples % 4 == 0:
                    receiver.send(publisher.detail_frame(NOTHING_YET, samples))

    thread = threading.Thread(target=receive)
    with BusConnection(bus, NOWHERE) as port:
        thread.start()
        source = LogSource(short_log(50.0), Vehicle.load("generic"))
        state = play(port, source, **MAX, stop=never)
    thread.join()
    receiver.shutdown()
    assert state.acknowledged == 500
    assert 20 < most < 220


class QuietBus:
    """A bus with nobody else, on a clock of its own: waiting and hearing nothing are instant."""

    name, carries_fd = "quiet", False

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, late_s: float = 0.0) -> None:
        self.now_s = 0.0
        self.sent: list[tuple[float, can.Message]] = []
        self._late_s = late_s
        monkeypatch.setattr("cangauge.replay.player.time.monotonic", lambda: self.now_s)

    def receive(self, timeout_s: float) -> None:
        self.now_s += timeout_s

    def send(self, frame: can.Message) -> bool:
        self.sent.append((self.now_s, frame))
        if len(self.sent) == 3:
            self.now_s += self._late_s  # the machine is busy
        return True


@pytest.mark.parametrize(("speed", "late_s"), [(1.0, 0.0), (20.0, 0.0), (1.0, 0.3)])
def test_recorded_timing_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, speed: float, late_s: float
) -> None:
    rng = random.Random(4)  # noqa: S311 - not for secrets
    times = list(itertools.accumulate(rng.uniform(0.001, 0.02) for _ in range(200)))
    path = tmp_path / "bus.log"
    with can.CanutilsLogWriter(path) as writer:
        for time_s in times:
            writer.on_message_received(can.Message(timestamp=1.7e9 + time_s, arbitration_id=0x1F0))
    bus = QuietBus(monkeypatch, late_s=late_s)
    state = play(bus, CaptureSource(path), speed=speed, stop=never)  # type: ignore[arg-type] # has what is used
    sent_s = np.array([at for at, frame in bus.sent if frame.arbitration_id == 0x1F0])
    clocks = [frame for _, frame in bus.sent if is_clock(frame)]
    assert len(sent_s) == len(times) == state.frames
    assert len(clocks) == state.clock_frames == (0 if speed == 1.0 else len(times))
    late = sent_s - sent_s[0] - (np.array(times) - times[0]) / speed
    caught_up = np.array(times) - times[0] > late_s + 0.02
    assert np.abs(late[caught_up]).max() < 2e-3  # a late frame does not delay the rest
    assert state.log_seconds == pytest.approx(times[-1] - times[0], abs=1e-6)
    assert (state.acknowledged, state.soc) == (None, {})


def test_a_long_wait_can_be_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = QuietBus(monkeypatch)
    source = LogSource(short_log(40.0), Vehicle.load("generic"))
    state = play(bus, source, speed=0.001, stop=lambda: bus.now_s > 100.0)  # type: ignore[arg-type] # as above
    assert bus.now_s < 101.0
    assert state.log_seconds <= 0.2


def test_the_estimate_does_not_depend_on_the_speed() -> None:
    log, model = short_log(40.0), leaf_model()
    with virtual_service("fast", REPLAYED) as service:
        state = play_log("fast", 40.0, {"speed": 40.0})
        assert waits(lambda: service.pipeline.samples == 400)
    assert state.acknowledged is None
    sent = quantized(Vehicle.load("generic"), log)
    offline = run_estimator(samples_of(sent), model, EstimatorSettings()).soc_pct
    live = [estimate.soc_pct for _, estimate in service.rows]
    assert repr(live) == repr(offline.tolist())  # NaN until the first block


def test_a_loop_runs_until_stopped() -> None:
    with virtual_service("loop", REPLAYED) as service, virtual_port("loop", SOC_FRAMES) as port:
        source = LogSource(short_log(5.0), Vehicle.load("generic"))
        settings = {"speed": math.inf, "loop": True}
        state = play(port, source, **settings, stop=lambda: service.pipeline.samples >= 220)
        assert state.samples >= 220
        assert service.pipeline.counts["beginnings"] == 0
        assert service.rows[219][0] == pytest.approx(21.9)


def test_full_speed_needs_the_vehicle_of_a_capture(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    with closing(Recorder(path)) as recorder:
        recorder.on_frame(can.Message(timestamp=1.0, arbitration_id=1, data=b"1"))
    with virtual_port("blind") as port, pytest.raises(InputError, match="--vehicle"):
        play(port, CaptureSource(path), **MAX, stop=never)


def test_fd_frames_need_an_fd_bus(tmp_path: Path) -> None:
    path = tmp_path / "fd.log"
    path.write_text("(1.000000) can0 123##000112233445566778899AABB\n")
    with virtual_port("classic") as port, pytest.raises(InputError, match="fd=true"):
        play(port, CaptureSource(path), stop=never)


@pytest.mark.real
def test_a_real_leafs_capture_at_full_speed(shared_data: Path) -> None:
    path = shared_data / "leaf_can" / "10bars.csv.gz"
    vehicle = Vehicle.load("leaf_ze0")
    with virtual_service("leaf", REPLAYED, vehicle=vehicle) as service:
        assert isinstance(service, Service)
        with virtual_port("leaf", SOC_FRAMES) as port:
            state = play(port, CaptureSource(path, vehicle), **MAX, stop=never)
    assert state.acknowledged == state.samples > 100
