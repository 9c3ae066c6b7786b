"""Steps of logs and captures: frames and log time."""

from __future__ import annotations

from contextlib import closing
from itertools import islice
from pathlib import Path

import can
import pytest

from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.publish import SocPublisher
from cangauge.bus.recording import capture_samples
from cangauge.bus.time_source import clock_frame
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.replay.steps import CaptureSource, LogSource
from cangauge.service.pipeline import NOTHING_YET
from cangauge.service.record import Recorder
from live import short_log


def frame(time_s: float, frame_id: int = 0x123, data: bytes = b"\x01") -> can.Message:
    return can.Message(timestamp=time_s, arbitration_id=frame_id, is_extended_id=False, data=data)


def write(path: Path, frames: list[can.Message]) -> Path:
    with closing(Recorder(path)) as recorder:
        for each in frames:
            recorder.on_frame(each)
    return path


@pytest.mark.parametrize("preset", ["generic", "leaf_aze0"])
def test_each_row_is_one_sample_at_its_time(preset: str) -> None:
    log = short_log(10.0)
    steps = list(LogSource(log, Vehicle.load(preset)).steps(loop=False))
    assert [step.time_us for step in steps] == [round(1e6 * t) for t in log.time_s]
    assert [step.samples for step in steps] == list(range(1, len(log) + 1))


def test_time_and_counters_continue_in_a_loop() -> None:
    log = short_log(2.0)
    source = LogSource(log, Vehicle.load("generic"))
    steps = list(islice(source.steps(loop=True), 3 * len(log)))
    times = [step.time_us for step in steps]
    assert times == [100_000 * number for number in range(60)]
    assert steps[-1].samples == 60
    currents = [each for step in steps for each in step.frames if each.arbitration_id == 0x400]
    assert [each.data[-2] >> 4 for each in currents] == [number % 16 for number in range(60)]


def test_a_value_out_of_range_is_refused_before_sending() -> None:
    log = short_log(2.0)
    high = log.voltage_v + 300.0
    too_high = type(log)(log.time_s, log.current_a, high, log.temperature_c, log.soc_pct)
    with pytest.raises(InputError, match="voltage_v"):
        LogSource(too_high, Vehicle.load("leaf_aze0"))


def test_a_captures_frames_are_sent_unchanged(tmp_path: Path) -> None:
    frames = [frame(1.7e9 + 0.013 * n, 0x100 + n % 3, bytes([n])) for n in range(30)]
    path = write(tmp_path / "a.log", frames)
    steps = list(CaptureSource(path).steps(loop=False))
    assert [bytes(step.frames[0].data) for step in steps] == [bytes([n]) for n in range(30)]
    assert [step.frames[0].arbitration_id for step in steps] == [0x100 + n % 3 for n in range(30)]
    assert steps[-1].time_us - steps[0].time_us == 29 * 13_000
    assert all(step.is_wanted for step in steps)


def test_own_frames_of_a_capture_only_give_its_time(
    tmp_path: Path,
) -> None:
    publisher = SocPublisher()
    frames = []
    for number in range(5):
        mark = clock_frame(1_000_000 * number)
        published = publisher.estimate_frame(NOTHING_YET)
        for each in (mark, frame(0.0, data=bytes([number])), published):
            each.timestamp = 1.7e9 + 1e-3 * len(frames)
            frames.append(each)
    source = CaptureSource(write(tmp_path / "a.log", frames))
    steps = list(source.steps(loop=False))
    assert [step.time_us for step in steps] == [1_000_000 * number for number in range(5)]
    assert {step.frames[0].arbitration_id for step in steps} == {0x123}
    assert source.dropped == 10


def test_several_replays_in_one_capture_are_refused(tmp_path: Path) -> None:
    frames = []
    for time_us in (0, 50_000_000, 0, 50_000_000):
        frames += [clock_frame(time_us), frame(0.0)]
    for number, each in enumerate(frames):
        each.timestamp = 1.7e9 + number
    with pytest.raises(InputError, match="several consecutive replays"):
        list(CaptureSource(write(tmp_path / "a.log", frames)).steps(loop=False))


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "preset"),
    [("10bars.csv.gz", "leaf_ze0"), ("EV-CANeplus2.log.gz", "leaf_ze1_polled")],
)
def test_samples_of_a_real_capture_are_counted_as_the_receiver_does(
    shared_data: Path, name: str, preset: str
) -> None:
    path, vehicle = shared_data / "leaf_can" / name, Vehicle.load(preset)
    steps = list(CaptureSource(path, vehicle).steps(loop=False))
    assert steps[-1].samples == len(capture_samples(path, vehicle))
    # The clock goes ahead of them: also of a reply over ISO-TP.
    wanted = {each.frames[0].arbitration_id for each in steps if each.is_wanted}
    assert wanted == set(vehicle.wanted_ids)


def test_each_frame_of_a_reply_gets_the_clock(tmp_path: Path) -> None:
    reply = ("100F610402011401", "21FF14020C13020E", "2213130000000000")
    frames = [
        frame(1.5 * ask + 0.01 * number, 0x7BB, bytes.fromhex(data))
        for ask in range(40)
        for number, data in enumerate(reply)
    ]
    path, vehicle = (
        write(tmp_path / "a.log", [*frames, frame(60.0)]),
        Vehicle.load("leaf_ze1_polled"),
    )
    live, clock_s = SampleDecoder(vehicle), 0.0
    for step in CaptureSource(path, vehicle).steps(loop=False):
        clock_s = 1e-6 * step.time_us if step.is_wanted else clock_s
        step.frames[0].timestamp = clock_s
        live.handle(step.frames[0])
        assert step.is_wanted is (step.frames[0].arbitration_id != 0x123)
    assert sum(each["wanted"] for each in live.statistics.messages.values()) == 40
    assert live.health["temperature"].latest == 20.0


def test_a_pgn_is_wanted_from_any_address(tmp_path: Path) -> None:
    dbc = f'VERSION ""\nBO_ {0x98FF0B7E} HVESSD1: 8 X\n'
    dbc += ' SG_ U : 0|16@1+ (0.05,0) [0|0] "V" X\n SG_ I : 16|16@1- (0.05,0) [0|0] "A" X\n'
    (tmp_path / "car.dbc").write_text(dbc)
    (tmp_path / "car.toml").write_text(
        'dbc = "car.dbc"\ncurrent = "I"\nvoltage = "U"\ntemperature = {fixed_c = 20}\n'
        "[messages.HVESSD1]\nj1939 = true\n"
    )
    ids = (0x18FF0B7E, 0x18FF0B11, 0x18FF0C7E)
    path = write(
        tmp_path / "a.log",
        [can.Message(timestamp=1.0, arbitration_id=each, data=bytes(8)) for each in ids],
    )
    steps = CaptureSource(path, Vehicle.load(map=tmp_path / "car.toml")).steps(loop=False)
    assert [step.is_wanted for step in steps] == [True, True, False]


def test_a_captures_repetition_follows_10_ms_later(tmp_path: Path) -> None:
    path = write(tmp_path / "a.log", [frame(1.7e9 + 0.5 * n) for n in range(3)])
    times = [step.time_us for step in islice(CaptureSource(path).steps(loop=True), 6)]
    assert [time_us - times[0] for time_us in times] == [
        0, 500_000, 1_000_000, 1_010_000, 1_510_000, 2_010_000
    ]  # fmt: skip
