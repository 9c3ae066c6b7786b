"""Two senders of one message: detection, and no false alarm by losses, bursts and restarts."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from random import Random

import can
import pytest

from cangauge.bus.decoder import HELD_UP_S, SURPLUS_S, SUSPECTED_FOR_S, SampleDecoder
from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.protection import Protection
from cangauge.bus.recording import capture_samples, open_vehicle_capture
from cangauge.bus.vehicle import Vehicle
from cangauge.inspect.capture import inspect_capture
from cangauge.service.record import Recorder
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


def attacked(
    vehicle: Vehicle, ahead: int, later: float, every: int = 1, first: int = FROM
) -> list[can.Message]:
    """Add a forged frame to every `every`-th current frame, `later` periods after it."""
    period_s, out, number = PERIODS_S[vehicle.name], [], 0
    for frame in true_frames(vehicle):
        out.append(frame)
        if frame.arbitration_id == vehicle.current.arbitration_id:
            number += 1
            if number > first and number % every == 0:
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


@pytest.mark.parametrize("vehicle", [LEAF, GENERIC], ids=lambda each: each.name)
@pytest.mark.parametrize("ahead", [0, 1, 2, 3])
@pytest.mark.parametrize("later", [-0.1, 0.3, 0.5, 0.8])
def test_second_sender_is_found_whatever_its_counter(
    vehicle: Vehicle, ahead: int, later: float
) -> None:
    decoder, first = decoded(vehicle, attacked(vehicle, ahead, later))
    assert FROM <= first <= FROM + 15
    assert decoder.reasons(decoder.now_s) & Reason.DUPLICATE_SENDER
    assert decoder.two_sender_messages == (vehicle.current.message,)
    # Nothing of the mixture is used.
    assert math.isnan(decoder.health["current"].value_at(decoder.now_s))


@pytest.mark.parametrize("vehicle", [LEAF, GENERIC], ids=lambda each: each.name)
@pytest.mark.parametrize(("ahead", "later"), [(0, -0.1), (1, 0.3), (2, 0.3)])
def test_few_forged_frames_are_found_too(vehicle: Vehicle, ahead: int, later: float) -> None:
    _, first = decoded(vehicle, attacked(vehicle, ahead, later, every=10))
    assert FROM <= first <= FROM + 200


def test_forged_frames_that_fill_the_counter_are_too_many() -> None:
    # Four forged frames, and the counter is again where the true sender continues.
    out = []
    for number, frame in enumerate(true_frames(LEAF, 2000)):
        out.append(frame)
        if number > 600 and frame.arbitration_id == LEAF.current.arbitration_id:
            out += [forged(frame, rule_of(LEAF), n, 0.002 * n) for n in range(1, 5)]
    decoder, first = decoded(LEAF, sorted(out, key=lambda each: each.timestamp))
    assert decoder.statistics.messages[LEAF.current.key].counter_jumps == 0
    assert first <= 600 + 400


def test_damaged_frames_with_its_id_do_not_stop_a_message() -> None:
    rng, out = Random(1), []  # noqa: S311 - must be repeatable
    for frame in true_frames(LEAF, 3000):
        noise = can.Message(
            arbitration_id=frame.arbitration_id, is_extended_id=False, data=rng.randbytes(8),
            timestamp=frame.timestamp + 0.003,
        )  # fmt: skip
        out += [frame, noise, noise]
    decoder, _ = decoded(LEAF, out)
    assert decoder.statistics.two_senders == 0
    assert not math.isnan(decoder.health["current"].value_at(decoder.now_s))


def test_second_sender_from_the_start_is_found() -> None:
    for vehicle in (LEAF, GENERIC):
        _, first = decoded(vehicle, attacked(vehicle, 2, 0.3, first=0))
        assert first <= 100


def test_message_is_used_again_after_the_second_sender() -> None:
    frames = attacked(LEAF, 0, -0.1)
    last_s = frames[-1].timestamp
    more = [each for each in true_frames(LEAF, 2500) if each.timestamp > last_s + 0.001]
    decoder = SampleDecoder(LEAF)
    samples = [sample for each in frames + more if (sample := decoder.handle(each)) is not None]
    gap_s, back_s = max((two.time_s - one.time_s, two.time_s) for one, two in pairwise(samples))
    assert gap_s == pytest.approx(SUSPECTED_FOR_S + 4.5, abs=0.2)
    assert back_s == pytest.approx(last_s + SUSPECTED_FOR_S, abs=0.1)
    assert not decoder.reasons(decoder.now_s)


def copies(frames: list[can.Message], rng: Random) -> Iterator[can.Message]:
    for frame in frames:
        yield frame
        if rng.random() < 0.5:
            yield frame


def lossy(frames: list[can.Message], rng: Random) -> Iterator[can.Message]:
    yield from (frame for frame in frames if rng.random() < 0.6)


def restarted(frames: list[can.Message], rng: Random) -> Iterator[can.Message]:
    # Bus-off every second: 0.2 s are missing, and the counter begins anywhere.
    for number, frame in enumerate(frames):
        if number % 100 < 80:
            yield frame
        elif number % 100 == 99 and frame.arbitration_id == LEAF.current.arbitration_id:
            yield forged(frame, rule_of(LEAF), rng.randrange(4), 0.0)


def wrong_counters(frames: list[can.Message], rng: Random) -> Iterator[can.Message]:
    for frame in frames:
        wrong = frame.arbitration_id == LEAF.current.arbitration_id and rng.random() < 0.2
        yield forged(frame, rule_of(LEAF), rng.randrange(4), 0.0) if wrong else frame


def swapped(frames: list[can.Message], _rng: Random) -> Iterator[can.Message]:
    mine = [each for each in frames if each.arbitration_id == LEAF.current.arbitration_id]
    for one, two in zip(mine[::2], mine[1::2], strict=True):
        one.timestamp, two.timestamp = two.timestamp, one.timestamp
        yield from (two, one)


def in_bursts(seconds: float) -> Callable[[list[can.Message], Random], Iterator[can.Message]]:
    def change(frames: list[can.Message], rng: Random) -> Iterator[can.Message]:
        for frame in frames:
            frame.timestamp = math.ceil(frame.timestamp / seconds) * seconds
            if rng.random() < 0.95:
                yield frame

    return change


LAWFUL = {
    "identical copies": copies,
    "40 % lost": lossy,
    "restarted": restarted,
    "wrong counters": wrong_counters,
    "swapped": swapped,
    "bursts of 20 ms": in_bursts(0.02),
    "bursts of 0.5 s": in_bursts(0.5),
}


@pytest.mark.parametrize("name", LAWFUL)
def test_one_sender_is_never_taken_for_two(name: str) -> None:
    for seed in range(5):
        rng = Random(seed)  # noqa: S311 - must be repeatable
        decoder, _ = decoded(LEAF, list(LAWFUL[name](true_frames(LEAF, 1500), rng)))
        assert decoder.statistics.two_senders == 0, f"seed {seed}"


def test_too_many_frames_without_counter_are_two_senders(tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    path.write_text(
        '[current]\nmessage = "BATTERY_1DB"\nsignal = "current_a"\nsign = -1\n'
        '[voltage]\nmessage = "BATTERY_1DB"\nsignal = "voltage_v"\n'
        "[messages.BATTERY_1DB]\nperiod_s = 0.01\n"
    )
    dbc = LEAF.dbc_files[0]
    vehicle = Vehicle.load(None, dbc, path, temperature_c=20.0)

    def first_s(doubled_from_s: float, until_s: float, period_s: float = 0.01) -> float | None:
        decoder, now_s = SampleDecoder(vehicle), 0.0
        while now_s < until_s:
            for later_s in (0.0, 0.3 * period_s)[: 1 + (now_s >= doubled_from_s)]:
                frame = can.Message(
                    arbitration_id=0x1DB, is_extended_id=False, data=bytes(8),
                    timestamp=BEGINS_S + now_s + later_s,
                )  # fmt: skip
                decoder.handle(frame)
                if decoder.reasons(decoder.now_s) & Reason.DUPLICATE_SENDER:
                    return now_s
            now_s += period_s
        return None

    found_s = first_s(30.0, 60.0)
    assert found_s is not None
    assert 30.0 + SURPLUS_S <= found_s <= 30.0 + 3.0 * SURPLUS_S
    assert first_s(math.inf, 60.0) is None
    # The stated period is wrong: nothing is known of the right number.
    assert first_s(math.inf, 30.0, period_s=0.005) is None


def test_remarks_and_inspection_name_the_second_sender(tmp_path: Path) -> None:
    path = tmp_path / "forged.log"
    with Recorder(path) as recorder:
        for frame in attacked(LEAF, 0, -0.1):
            recorder.write(frame)
    assert any("two senders" in remark for remark in capture_samples(path, LEAF).remarks)
    found = {each.id: each.two_senders for each in inspect_capture(path).ids}
    assert found["1DB"]
    assert not found["55B"]


@pytest.mark.real
@pytest.mark.parametrize("folder", ["leaf_can", "can_captures"])
def test_real_captures_have_one_sender_a_message(shared_data: Path, folder: str) -> None:
    vehicle = LEAF if folder == "leaf_can" else Vehicle.load("bmw_i3", temperature_c=20.0)
    for path in sorted((shared_data / folder).iterdir()):
        frames = [
            each
            for each in open_vehicle_capture(path, vehicle)
            if each.arbitration_id in vehicle.wanted_ids
        ]
        for batch_s in (0.0, 0.02, 0.1):
            decoders: dict[object, SampleDecoder] = {}
            for each in frames:
                time_s = each.timestamp
                each.timestamp = math.ceil(time_s / batch_s) * batch_s if batch_s else time_s
                decoders.setdefault(each.channel, SampleDecoder(vehicle)).handle(each)
                each.timestamp = time_s
            refused = {each.statistics.two_senders for each in decoders.values()}
            assert refused <= {0}, f"{path.name} in batches of {batch_s} s"
        if folder == "can_captures" or len(frames) < 1000:
            assert not any(each.two_senders for each in inspect_capture(path).ids), path.name


def test_constants_leave_room_for_bursts() -> None:
    assert HELD_UP_S > SURPLUS_S > 5.0
