"""Decoding of frames into samples."""

from __future__ import annotations

import math
from dataclasses import replace

import can
import pytest

from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.protection import LEAF_RULE
from cangauge.bus.vehicle import EXTENDED, Vehicle
from cangauge.types import Sample

CURRENT_ID, VOLTAGE_ID, TEMPERATURE_ID, SOC_ID = 0x400, 0x401, 0x402, 0x403


@pytest.fixture(scope="module")
def generic() -> Vehicle:
    return Vehicle.load("generic")


@pytest.fixture(scope="module")
def leaf() -> Vehicle:
    return Vehicle.load("leaf_ze0")


def frames_of(
    vehicle: Vehicle, count: int = 10, step_s: float = 0.1, soc: float | None = 50.0
) -> list[can.Message]:
    encoder = FrameEncoder(vehicle)
    frames = []
    for n in range(count):
        frames += encoder.encode(Sample(n * step_s, float(n), 380.0 + n, 20.0), soc)
    return frames


def feed(decoder: SampleDecoder, frames: list[can.Message]) -> list[Sample]:
    return [sample for frame in frames if (sample := decoder.handle(frame)) is not None]


def leaf_frame(hex_data: str, time_s: float, counter: int) -> can.Message:
    data = LEAF_RULE.protect(bytes.fromhex(hex_data), counter)
    return can.Message(timestamp=time_s, arbitration_id=0x1DB, is_extended_id=False, data=data)


def test_every_sample_arrives_with_its_temperature_and_soc(generic: Vehicle) -> None:
    decoder = SampleDecoder(generic)
    samples = feed(decoder, frames_of(generic))
    assert [each.current_a for each in samples] == [float(n) for n in range(10)]
    assert all(each.temperature_c == 20.0 for each in samples)
    assert decoder.reference_soc_pct == 50.0
    assert decoder.statistics.samples == 10
    assert {role: each.latest_s for role, each in decoder.health.items()} == {
        "current": 0.9,
        "voltage": 0.9,
        "temperature": 0.0,
        "soc_reference": 0.0,
    }


def test_unwanted_ids_are_skipped(generic: Vehicle) -> None:
    decoder = SampleDecoder(generic)
    assert generic.wanted_ids == (CURRENT_ID, VOLTAGE_ID, TEMPERATURE_ID, SOC_ID)
    strange = can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\xff" * 8)
    assert decoder.handle(strange) is None
    assert decoder.statistics.frames == 1
    assert decoder.statistics.wanted == 0


@pytest.mark.parametrize("kind", ["is_extended_id", "is_remote_frame", "is_error_frame"])
def test_extended_remote_and_error_frames_are_skipped(generic: Vehicle, kind: str) -> None:
    decoder = SampleDecoder(generic)
    for frame in frames_of(generic):
        setattr(frame, kind, True)
        assert decoder.handle(frame) is None
    assert decoder.flush() is None
    assert decoder.statistics.wanted == 0
    assert decoder.statistics.ignored == (0 if kind == "is_extended_id" else 22)


def test_damaged_and_short_frames_are_refused_and_counted(generic: Vehicle) -> None:
    frames = [frame for frame in frames_of(generic) if frame.arbitration_id == CURRENT_ID]
    frames[3].data[0] ^= 0x10
    frames[5].data = frames[5].data[:-1]
    decoder = SampleDecoder(generic)
    samples = feed(decoder, frames)
    last = decoder.flush()
    assert last is not None
    currents = [each.current_a for each in (*samples, last)]
    assert currents == [0.0, 1.0, 2.0, 4.0, 6.0, 7.0, 8.0, 9.0]
    fate = decoder.statistics.messages[CURRENT_ID]
    assert (fate.crc_errors, fate.short) == (1, 1)
    # The short one counts as lost for the alive counter; the damaged one does not.
    assert (fate.counter_jumps, fate.frames_lost) == (1, 1)


def test_repeated_frames_are_refused(generic: Vehicle) -> None:
    frames = frames_of(generic, 5)
    decoder = SampleDecoder(generic)
    samples = feed(decoder, [frame for frame in frames for _ in range(2)])
    assert [each.current_a for each in samples] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert decoder.statistics.counter_repeats == len(frames)


def test_neighbours_of_lost_frames_are_used(generic: Vehicle) -> None:
    frames = [
        frame
        for frame in frames_of(generic)
        if not (0.25 < frame.timestamp < 0.55 and frame.arbitration_id in {CURRENT_ID, VOLTAGE_ID})
    ]
    decoder = SampleDecoder(generic)
    samples = feed(decoder, frames)
    assert [each.current_a for each in samples] == [0.0, 1.0, 2.0, 6.0, 7.0, 8.0, 9.0]
    assert decoder.statistics.counter_jumps == 2
    assert decoder.statistics.frames_lost == 6


def test_longer_frames_are_cut_to_the_messages_length(generic: Vehicle) -> None:
    frames = frames_of(generic, 3)
    for frame in frames:
        frame.data += b"\x00\x00"
    assert len(feed(SampleDecoder(generic), frames)) == 3


def test_currents_without_voltage_are_kept(generic: Vehicle) -> None:
    frames = [
        frame
        for frame in frames_of(generic)
        if not (frame.arbitration_id == VOLTAGE_ID and 0.25 < frame.timestamp < 0.65)
    ]
    samples = feed(SampleDecoder(generic), frames)
    assert [each.current_a for each in samples] == [float(n) for n in range(10)]
    assert [math.isnan(each.voltage_v) for each in samples] == [3 <= n <= 6 for n in range(10)]


def test_temperature_is_used_until_its_time_out(generic: Vehicle) -> None:
    decoder = SampleDecoder(generic)
    frames = [
        frame
        for frame in frames_of(generic, 25, step_s=1.0)
        if frame.arbitration_id != TEMPERATURE_ID or frame.timestamp == 2.0
    ]
    samples = feed(decoder, frames)
    known = [each.time_s for each in samples if each.temperature_c == 20.0]
    assert known == [float(n) for n in range(2, 13)]


def test_reference_soc_is_nan_when_it_is_old(generic: Vehicle) -> None:
    decoder = SampleDecoder(generic)
    assert math.isnan(decoder.reference_soc_pct)
    frames = frames_of(generic, 15, step_s=1.0)
    feed(decoder, [f for f in frames if f.arbitration_id != SOC_ID or f.timestamp == 0.0])
    assert math.isnan(decoder.reference_soc_pct)
    feed(decoder, frames_of(generic, 1))
    assert decoder.reference_soc_pct == 50.0


def test_fixed_temperature_needs_no_frame() -> None:
    vehicle = Vehicle.load("generic", temperature_c=12.5)
    decoder = SampleDecoder(vehicle)
    assert TEMPERATURE_ID not in vehicle.wanted_ids
    samples = feed(decoder, frames_of(Vehicle.load("generic"), 20, step_s=5.0))
    assert {each.temperature_c for each in samples} == {12.5}


def test_a_log_that_starts_again_is_decoded_again(generic: Vehicle) -> None:
    frames = frames_of(generic, 16)  # so that the counters go on
    decoder = SampleDecoder(generic)
    first = feed(decoder, frames)
    second = feed(decoder, frames_of(generic, 16))
    assert first == second
    assert decoder.statistics.time_reversals > 0


def test_old_values_time_out_after_a_step_back_in_time(generic: Vehicle) -> None:
    decoder = SampleDecoder(generic)
    late = frames_of(generic, 1)
    for frame in late:
        frame.timestamp = 5000.0
    feed(decoder, late)
    frames = frames_of(generic, 16, step_s=1.0)[8:]
    fast = [frame for frame in frames if frame.arbitration_id in {CURRENT_ID, VOLTAGE_ID}]
    samples = feed(decoder, fast)
    assert samples[0].time_s == 2.0
    assert [each.time_s for each in samples if each.temperature_c == 20.0] == [
        float(n) for n in range(2, 13)
    ]
    assert math.isnan(decoder.reference_soc_pct)


def test_leaf_inverts_the_sign_and_refuses_wake_up_codes(leaf: Vehicle) -> None:
    decoder = SampleDecoder(leaf)
    both = leaf_frame("7FE0FFC000000000", 0.00, 0)
    voltage = leaf_frame("FFE0FFC000000000", 0.01, 1)
    good = leaf_frame("FDA0BAAA00000000", 0.02, 2)
    assert decoder.handle(both) is None
    without = decoder.handle(voltage)
    assert without is not None
    assert without.current_a == 0.5
    assert math.isnan(without.voltage_v)
    sample = decoder.handle(good)
    assert sample is not None
    assert (sample.time_s, sample.current_a, sample.voltage_v) == (0.02, 9.5, 373.0)
    assert math.isnan(sample.temperature_c)
    assert decoder.statistics.not_available == 3
    assert decoder.statistics.current_unpaired == 1
    assert decoder.health["voltage"].latest_s == 0.02


def test_leaf_uses_the_average_multiplexed_temperature(leaf: Vehicle) -> None:
    decoder = SampleDecoder(leaf)
    for n, payload in enumerate(("405068003A000000", "805656003CD40002", "C06060003AD40000")):
        data = bytes.fromhex(payload)
        decoder.handle(
            can.Message(timestamp=0.1 * n, arbitration_id=0x5C0, is_extended_id=False, data=data)
        )
    sample = decoder.handle(leaf_frame("FDA0BAAA00000000", 0.3, 2))
    assert sample is not None
    assert sample.temperature_c == 0x56 / 2 - 40
    assert decoder.health["temperature"].latest_s == 0.1


def test_an_extended_id_of_the_dbc_is_wanted(generic: Vehicle) -> None:
    signal = replace(generic.current, key=0x18FF0001 | EXTENDED)
    messages = {**generic.messages, signal.key: generic.messages[CURRENT_ID]}
    vehicle = replace(generic, current=signal, messages=messages)
    decoder = SampleDecoder(vehicle)
    assert vehicle.wanted_ids[0] == 0x18FF0001
    assert vehicle.filters[0] == {
        "can_id": 0x18FF0001,
        "can_mask": 0x1FFFFFFF,
        "extended": True,
    }
    assert len(feed(decoder, frames_of(vehicle))) == 10


def test_totals_are_sums_over_the_messages(generic: Vehicle) -> None:
    decoder = SampleDecoder(generic)
    feed(decoder, frames_of(generic))
    statistics = decoder.statistics
    assert statistics.samples == 10
    assert statistics.wanted == statistics.frames == 22
    assert statistics.messages[CURRENT_ID].wanted == 10
