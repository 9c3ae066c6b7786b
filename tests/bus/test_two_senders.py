"""Two senders of one message: reported and refused; losses, bursts and restarts are no second."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from random import Random

import can
import pytest

from cangauge.bus.decoder import SUSPECTED_FOR_S, SampleDecoder
from cangauge.bus.protection import FrameChecker, Protection
from cangauge.bus.recording import capture_samples, open_vehicle_capture
from cangauge.bus.vehicle import Vehicle
from cangauge.replay.encoder import FrameEncoder
from cangauge.types import Reason, Sample

LEAF, GENERIC = Vehicle.load("leaf_aze0"), Vehicle.load("generic")
PERIODS_S = {LEAF.name: 0.01, GENERIC.name: 0.1}
BEGINS_S = 1e9
FROM = 150
"""First forged frame."""


def rule_of(vehicle: Vehicle) -> Protection:
    rule = vehicle.messages[vehicle.current.key].rule
    assert rule is not None
    return rule


def true_frames(vehicle: Vehicle, count: int = 600) -> list[can.Message]:
    """Return frames of a car whose current and voltage change all the time."""
    encoder, period_s, out = FrameEncoder(vehicle), PERIODS_S[vehicle.name], []
    for number in range(count):
        current_a = 40.0 * math.sin(number / 9.0)
        time_s = BEGINS_S + number * period_s
        out += encoder.encode(Sample(time_s, current_a, 380.0 - 0.1 * current_a, 20.0), 50.0)
    return out


def forged(frame: can.Message, rule: Protection, ahead: int, later_s: float) -> can.Message:
    """Return a frame of another value, with a valid CRC and a counter `ahead` of the true one."""
    data = bytearray(frame.data)
    data[0] ^= 0x15
    return can.Message(
        arbitration_id=frame.arbitration_id,
        is_extended_id=False,
        data=rule.protect(data, rule.counter(frame.data) + ahead),
        timestamp=frame.timestamp + later_s,
    )


def attacked(vehicle: Vehicle, ahead: int, later: float, begins: int = FROM) -> list[can.Message]:
    """Add a forged frame to every current frame from one on, `later` periods after it."""
    period_s, out, number = PERIODS_S[vehicle.name], [], 0
    for frame in true_frames(vehicle):
        out.append(frame)
        if frame.arbitration_id == vehicle.current.arbitration_id:
            number += 1
            if number > begins:
                out.append(forged(frame, rule_of(vehicle), ahead, later * period_s))
    return sorted(out, key=lambda each: each.timestamp)


def decoded(vehicle: Vehicle, frames: list[can.Message]) -> tuple[SampleDecoder, float]:
    """Return the decoder, and when the first frame was refused for two senders [periods]."""
    decoder, first = SampleDecoder(vehicle), math.nan
    for frame in frames:
        decoder.handle(frame)
        if decoder.statistics.two_senders and math.isnan(first):
            first = (frame.timestamp - BEGINS_S) / PERIODS_S[vehicle.name]
    return decoder, first


@pytest.mark.parametrize(
    ("vehicle", "ahead", "later", "begins", "within"),
    [
        *((LEAF, ahead, later, FROM, 30) for ahead in range(4) for later in (-0.1, 0.2, 0.5, 0.7)),
        # Without a stated period it is learned.
        (GENERIC, 0, -0.1, FROM, 60),
        (GENERIC, 1, 0.2, FROM, 60),
        (GENERIC, 2, 0.3, FROM, 60),
        (GENERIC, 7, 0.3, FROM, 60),
        *((GENERIC, ahead, 0.2, 0, 60) for ahead in (2, 3, 8)),
    ],
)
def test_a_second_sender_is_reported_whatever_its_counter(
    vehicle: Vehicle, ahead: int, later: float, begins: int, within: int
) -> None:
    decoder, first = decoded(vehicle, attacked(vehicle, ahead, later, begins))
    assert begins <= first <= begins + within
    assert decoder.reasons(decoder.now_s) & Reason.DUPLICATE_SENDER
    assert decoder.two_sender_messages == (vehicle.current.message,)
    # Nothing of the mixture is used.
    assert math.isnan(decoder.health["current"].value_at(decoder.now_s))


@pytest.mark.parametrize("begins", [0, FROM])
@pytest.mark.parametrize("vehicle", [LEAF, GENERIC])
@pytest.mark.parametrize(("times", "per"), [(2, 1), (5, 1), (10, 1), (1, 2), (1, 4), (1, 8)])
def test_a_flood_and_single_false_frames_are_reported(
    vehicle: Vehicle, times: int, per: int, begins: int
) -> None:
    period_s, rule, out, number = PERIODS_S[vehicle.name], rule_of(vehicle), [], 0
    counter = 7
    for frame in true_frames(vehicle):
        out.append(frame)
        number += frame.arbitration_id == vehicle.current.arbitration_id
        if out[-1].arbitration_id != vehicle.current.arbitration_id or number % per:
            continue
        for place in range(times if number > begins else 0):
            false = forged(frame, rule, 0, (place + 1) * period_s / (times + 1))
            counter += 1
            false.data[:] = rule.protect(bytearray(false.data), counter)
            out.append(false)
    decoder, first = decoded(vehicle, sorted(out, key=lambda each: each.timestamp))
    assert begins <= first <= begins + 30 * (per + 1)
    assert decoder.reasons(decoder.now_s) & Reason.DUPLICATE_SENDER


@pytest.mark.parametrize("vehicle", [LEAF, GENERIC])
@pytest.mark.parametrize("times", [2, 5, 10])
@pytest.mark.parametrize("ahead", [1, 2, 3])
def test_a_flood_that_begins_anew_at_each_true_frame_is_reported(
    vehicle: Vehicle, times: int, ahead: int
) -> None:
    begins = FROM  # the frames before it show the period
    period_s, rule, out, number = PERIODS_S[vehicle.name], rule_of(vehicle), [], 0
    for frame in true_frames(vehicle):
        out.append(frame)
        number += frame.arbitration_id == vehicle.current.arbitration_id
        if frame.arbitration_id == vehicle.current.arbitration_id and number > begins:
            out += [
                forged(frame, rule, ahead + place, (place + 1) * 0.4 * period_s / times)
                for place in range(times)
            ]
    decoder, first = decoded(vehicle, sorted(out, key=lambda each: each.timestamp))
    assert begins <= first <= begins + 200
    assert decoder.reasons(decoder.now_s) & Reason.DUPLICATE_SENDER


def test_message_is_used_again_after_the_second_sender() -> None:
    frames = attacked(LEAF, 0, 0.3)
    last_s = frames[-1].timestamp
    more = [each for each in true_frames(LEAF, 2500) if each.timestamp > last_s + 0.001]
    decoder = SampleDecoder(LEAF)
    samples = [sample for each in frames + more if (sample := decoder.handle(each)) is not None]
    gap_s, back_s = max((two.time_s - one.time_s, two.time_s) for one, two in pairwise(samples))
    assert back_s == pytest.approx(last_s + SUSPECTED_FOR_S, abs=0.1)
    assert gap_s > SUSPECTED_FOR_S
    assert not decoder.reasons(decoder.now_s)


def test_a_clock_that_is_set_back_ends_the_suspicion() -> None:
    decoder, _ = decoded(LEAF, attacked(LEAF, 0, 0.3))
    refused, more = decoder.statistics.two_senders, true_frames(LEAF, 100)
    for frame in more:
        frame.timestamp -= 3600.0
    samples = [sample for each in more if (sample := decoder.handle(each)) is not None]
    assert refused
    assert decoder.statistics.two_senders == refused
    assert len(samples) >= 98
    assert decoder.two_sender_messages == ()
    assert not decoder.reasons(decoder.now_s) & Reason.DUPLICATE_SENDER


def copies(frames: list[can.Message], rng: Random) -> Iterator[can.Message]:
    for frame in frames:
        yield frame
        if rng.random() < 0.5:
            yield frame


def lossy(frames: list[can.Message], rng: Random) -> Iterator[can.Message]:
    yield from (frame for frame in frames if rng.random() < 0.6)


def damaged(frames: list[can.Message], rng: Random) -> Iterator[can.Message]:
    for frame in frames:
        yield frame
        noise = rng.randbytes(8)
        yield can.Message(arbitration_id=frame.arbitration_id, is_extended_id=False, data=noise,
                          timestamp=frame.timestamp + 0.003)  # fmt: skip


def restarted(frames: list[can.Message], rng: Random) -> Iterator[can.Message]:
    # Bus-off every second: 0.2 s are missing, and the counter begins anywhere.
    for number, frame in enumerate(frames):
        if number % 100 < 80:
            yield frame
        elif number % 100 == 99 and frame.arbitration_id == LEAF.current.arbitration_id:
            yield forged(frame, rule_of(LEAF), rng.randrange(4), 0.0)


def stuck(frames: list[can.Message], _rng: Random) -> Iterator[can.Message]:
    for frame in frames:
        if frame.arbitration_id == LEAF.current.arbitration_id:
            data = rule_of(LEAF).protect(bytearray(frame.data), 2)
            frame.data[:] = data
        yield frame


def in_bursts(seconds: float) -> Callable[[list[can.Message], Random], Iterator[can.Message]]:
    def change(frames: list[can.Message], rng: Random) -> Iterator[can.Message]:
        for frame in frames:
            frame.timestamp = math.ceil(frame.timestamp / seconds) * seconds
            if rng.random() < 0.95:
                yield frame

    return change


def every(part: int, of: int) -> Callable[[list[can.Message], Random], Iterator[can.Message]]:
    """Keep the first `part` of each `of` frames of a message: a queue that overflows."""

    def change(frames: list[can.Message], _rng: Random) -> Iterator[can.Message]:
        yield from (frame for place, frame in enumerate(frames) if place // 2 % of < part)

    return change


def faster(frames: list[can.Message], rng: Random) -> Iterator[can.Message]:
    """Send three times as often as stated, with losses."""
    for frame in frames:
        frame.timestamp = BEGINS_S + (frame.timestamp - BEGINS_S) / 3.0
        if rng.random() < 0.98:
            yield frame


LAWFUL = {
    "faster than stated": faster,
    "identical copies": copies,
    "40 % lost": lossy,
    "damaged frames between": damaged,
    "restarted": restarted,
    "stuck counter": stuck,
    **{
        f"{part} of {of} kept": every(part, of)
        for of in range(2, 10)
        for part in {1, of // 2, of - 1}
    },
    "bursts of 20 ms": in_bursts(0.02),
    "bursts of 0.5 s": in_bursts(0.5),
}


@pytest.mark.parametrize("name", LAWFUL)
def test_one_sender_is_never_taken_for_two(name: str) -> None:
    for seed in range(3):
        rng = Random(seed)  # noqa: S311 - must be repeatable
        decoder, _ = decoded(LEAF, list(LAWFUL[name](true_frames(LEAF, 1500), rng)))
        assert decoder.statistics.two_senders == 0, f"seed {seed}"
        assert decoder.two_sender_messages == (), f"seed {seed}"


@pytest.mark.parametrize("period_s", [0.002, 0.005, 0.02, 0.1, 2.0])
@pytest.mark.parametrize("lost", [0.02, 0.05, 0.2])
def test_a_wrong_stated_period_makes_no_second_sender(period_s: float, lost: float) -> None:
    rng = Random(1)  # noqa: S311 - must be repeatable
    checker = FrameChecker(rule_of(GENERIC), period_s)
    for number in range(4000):
        data = rule_of(GENERIC).protect(number.to_bytes(8, "big"), number)
        if rng.random() > lost:
            checker.check(data, BEGINS_S + 0.01 * number)
            assert not checker.suspects_second_sender


def test_remarks_of_a_capture_name_it(tmp_path: Path) -> None:
    path = tmp_path / "forged.log"
    with can.CanutilsLogWriter(path) as writer:
        for frame in attacked(LEAF, 0, 0.3):
            frame.channel = "can0"
            writer.on_message_received(frame)
    assert any("two senders" in remark for remark in capture_samples(path, LEAF).remarks)


@pytest.mark.real
@pytest.mark.parametrize("batch_s", [0.01, 0.1])
def test_a_lossy_capture_in_batches_has_one_sender(shared_data: Path, batch_s: float) -> None:
    name = "env200-2015-with-40kWh-startup-nobridge.crtd.gz"  # 887 frames lost of 2,800
    decoder = SampleDecoder(LEAF)
    for frame in open_vehicle_capture(shared_data / "leaf_can" / name, LEAF):
        if frame.channel == 1:
            frame.timestamp = math.ceil(frame.timestamp / batch_s) * batch_s
            decoder.handle(frame)
    assert decoder.statistics.counter_jumps > 100
    assert decoder.statistics.two_senders == 0
