"""Frames → samples: acceptance, pairing, cells, and the signals of known cars."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest
from can.interfaces.socketcan.constants import CAN_EFF_FLAG
from hypothesis import given
from hypothesis import strategies as st

from cangauge._resources import shared_file
from cangauge.bus.decoder import Pairing, SampleDecoder
from cangauge.bus.open import bus_address
from cangauge.bus.protection import RULES
from cangauge.bus.vehicle import Vehicle, pgn_mask
from cangauge.errors import InputError
from cangauge.replay.encoder import FrameEncoder
from cangauge.types import Sample
from cells_bus import CAR, CELLS_DBC, cell_frames, numbered_frames
from fd_pack import estimates_from_64_bytes

CURRENT_ID, VOLTAGE_ID, TEMPERATURE_ID, SOC_ID = 0x400, 0x401, 0x402, 0x403
GENERIC, LEAF = Vehicle.load("generic"), Vehicle.load("leaf_ze0")


def frames_of(vehicle: Vehicle, count: int = 10, step_s: float = 0.1) -> list[can.Message]:
    encoder, frames = FrameEncoder(vehicle), []
    for n in range(count):
        frames += encoder.encode(Sample(n * step_s, float(n), 380.0 + n, 20.0), 50.0)
    return frames


def feed(decoder: SampleDecoder, frames: list[can.Message]) -> list[Sample]:
    return [sample for frame in frames if (sample := decoder.handle(frame)) is not None]


def currents(decoder: SampleDecoder, frames: list[can.Message]) -> list[float]:
    return [each.current_a for each in feed(decoder, frames)]


def frame(number: int, data: bytes, time_s: float = 1.0, *, wide: bool = False) -> can.Message:
    return can.Message(timestamp=time_s, arbitration_id=number, is_extended_id=wide, data=data)


def leaf_frame(hex_data: str, time_s: float, counter: int) -> can.Message:
    return frame(0x1DB, RULES["leaf"].protect(bytes.fromhex(hex_data), counter), time_s)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("is_extended_id", True),
        ("is_remote_frame", True),
        ("is_error_frame", True),
        ("arbitration_id", 0x123),
    ],
)
def test_other_frames_are_counted_and_skipped(name: str, value: object) -> None:
    decoder = SampleDecoder(GENERIC)
    for each in frames_of(GENERIC):
        setattr(each, name, value)
        assert decoder.handle(each) is None
    assert decoder.flush() is None
    assert (decoder.statistics.frames, decoder.statistics.wanted) == (22, 0)


def test_damaged_and_short_frames_are_refused_and_counted() -> None:
    frames = [each for each in frames_of(GENERIC) if each.arbitration_id == CURRENT_ID]
    frames[3].data[0] ^= 0x10
    frames[5].data = frames[5].data[:-1]
    decoder = SampleDecoder(GENERIC)
    found = currents(decoder, frames)
    last = decoder.flush()
    assert last is not None
    assert [*found, last.current_a] == [0.0, 1.0, 2.0, 4.0, 6.0, 7.0, 8.0, 9.0]
    fate = decoder.statistics.messages[CURRENT_ID]
    assert (fate["crc_errors"], fate["short"]) == (1, 1)
    # The short one counts as lost for the alive counter; the damaged one does not.
    assert (fate["counter_jumps"], fate["frames_lost"]) == (1, 1)


def test_repeated_frames_are_refused_and_longer_ones_cut() -> None:
    decoder, frames = SampleDecoder(GENERIC), frames_of(GENERIC, 5)
    for each in frames:
        each.data += b"\x00\x00"
    assert currents(decoder, [each for each in frames for _ in range(2)]) == [0, 1, 2, 3, 4]
    assert decoder.statistics.counter_repeats == len(frames)


def test_repeated_frames_do_not_stop_recovery() -> None:
    decoder, frames = SampleDecoder(GENERIC), frames_of(GENERIC, 12)
    frames = [each for each in frames if each.arbitration_id == CURRENT_ID]
    for each in frames[1:6]:
        each.data[0] ^= 0x10
    # Two of the good values after the damage are held back.
    twice = [each for each in frames for _ in range(2)]
    assert [*currents(decoder, twice), 11.0] == [0.0, 8.0, 9.0, 10.0, 11.0]


@pytest.mark.parametrize("is_set_back", [False, True])
def test_temperature_and_soc_are_used_until_their_time_out(is_set_back: bool) -> None:
    """From a clock that is set back on, an old value has the age of the first new one."""
    decoder, first = SampleDecoder(GENERIC), frames_of(GENERIC, 1)
    assert math.isnan(decoder.reference_soc_pct)
    for each in first:
        each.timestamp = 5000.0 if is_set_back else 2.0
    feed(decoder, first)
    later = [
        each
        for each in frames_of(GENERIC, 25, step_s=1.0)
        if each.arbitration_id in {CURRENT_ID, VOLTAGE_ID} and each.timestamp > 2.0
    ]
    known = [each.time_s for each in feed(decoder, later) if each.temperature_c == 20.0]
    assert known == [float(n) for n in range(3, 14 if is_set_back else 13)]
    assert math.isnan(decoder.reference_soc_pct)
    fixed = SampleDecoder(Vehicle.load("generic", temperature_c=12.5))
    assert {each.temperature_c for each in feed(fixed, later)} == {12.5}


def test_a_log_that_starts_again_is_decoded_again() -> None:
    decoder = SampleDecoder(GENERIC)
    first = feed(decoder, frames_of(GENERIC, 16))  # so that the counters go on
    assert feed(decoder, frames_of(GENERIC, 16)) == first


# --- Pairing

WITHIN_S = 0.020


def paired(frames: list[tuple[float, str, float]]) -> list[tuple[float, float, float | None]]:
    pairing, samples = Pairing(WITHIN_S), []
    for time_s, kind, value in frames:
        is_voltage, current = kind == "U", Sample(time_s, value, math.nan, 20.0)
        samples.append(pairing.voltage(time_s, value) if is_voltage else pairing.current(current))
    found = [each for each in [*samples, pairing.flush()] if each is not None]
    return [(t, i, None if math.isnan(u) else u) for t, i, u, _ in found]


@pytest.mark.parametrize(
    ("frames", "samples"),
    [
        ([(1.0, "I", 5), (1.01, "U", 400)], [(1.0, 5, 400)]),
        ([(1.0, "U", 400), (1.01, "I", 5)], [(1.01, 5, 400)]),  # at the current's time
        ([(1.0, "I", 5), (1.021, "U", 400)], [(1.0, 5, None)]),
        ([(1e9, "I", 5), (1e9 + 0.02, "U", 400)], [(1e9, 5, 400)]),
        (
            [(0.0, "I", 1), (0.001, "U", 400), (0.002, "I", 2), (0.003, "I", 3)],
            [(0.0, 1, 400), (0.002, 2, None), (0.003, 3, None)],  # each value is used once
        ),
        (
            [(0.0, "I", 1), (0.1, "U", 400), (0.11, "I", 2)],
            [(0.0, 1, None), (0.11, 2, 400)],  # a late voltage releases the current
        ),
        (
            [(100.0, "I", 1), (0.0, "U", 400), (0.01, "I", 2)],
            [(100.0, 1, None), (0.01, 2, 400)],  # none across a step back in time
        ),
    ],
)
def test_currents_and_voltages_pair(
    frames: list[tuple[float, str, float]], samples: list[tuple[float, float, float | None]]
) -> None:
    assert paired(frames) == samples


@given(st.lists(st.tuples(st.integers(0, 60), st.sampled_from("IU")), min_size=1, max_size=60))
def test_no_current_is_lost_doubled_or_out_of_order(steps: list[tuple[int, str]]) -> None:
    times = np.cumsum([step for step, _ in steps]) / 1000.0
    frames = [(float(t), kind, float(n)) for n, (t, (_, kind)) in enumerate(zip(times, steps))]  # noqa: B905
    samples = paired(frames)
    assert [each[:2] for each in samples] == [(t, v) for t, kind, v in frames if kind == "I"]
    used = {voltage: t for t, _, voltage in samples if voltage is not None}
    assert len(used) == sum(voltage is not None for _, _, voltage in samples)
    at = {value: t for t, kind, value in frames if kind == "U"}
    assert all(abs(at[voltage] - t) <= WITHIN_S + 1e-6 for voltage, t in used.items())


# --- Cars


def test_leaf_inverts_the_sign_and_refuses_wake_up_codes() -> None:
    decoder = SampleDecoder(LEAF)
    assert decoder.handle(leaf_frame("7FE0FFC000000000", 0.00, 0)) is None
    without = decoder.handle(leaf_frame("FFE0FFC000000000", 0.01, 1))
    assert without is not None
    assert (without.current_a, math.isnan(without.voltage_v)) == (0.5, True)
    sample = decoder.handle(leaf_frame("FDA0BAAA00000000", 0.02, 2))
    assert sample is not None
    assert (sample.time_s, sample.current_a, sample.voltage_v) == (0.02, 9.5, 373.0)
    assert decoder.statistics.not_available == 3


def test_leaf_uses_the_average_multiplexed_temperature() -> None:
    decoder = SampleDecoder(LEAF)
    for n, payload in enumerate(("405068003A000000", "805656003CD40002", "C06060003AD40000")):
        decoder.handle(frame(0x5C0, bytes.fromhex(payload), 0.1 * n))
    sample = decoder.handle(leaf_frame("FDA0BAAA00000000", 0.3, 2))
    assert sample is not None
    assert sample.temperature_c == 0x56 / 2 - 40
    assert decoder.health["temperature"].latest_s == 0.1


def test_codes_and_signs_of_a_bmw_i3() -> None:
    car = Vehicle.load("bmw_i3", temperature_c=20.0)
    assert car.soc_reference is not None
    payload = bytes.fromhex("ee1fb40eb571c55e")
    signals = (car.current, car.voltage, car.soc_reference)
    assert [each.codec.decode(payload) for each in signals] == pytest.approx([1.8, 376.4, 43.7])
    asleep = bytes.fromhex("ffffffffff7ff5ff")
    assert np.isnan([each.codec.decode(asleep) for each in car.signals]).all()


def test_an_extended_id_of_the_dbc_is_wanted() -> None:
    signal = replace(GENERIC.current, key=0x18FF0001 | CAN_EFF_FLAG)
    messages = {**GENERIC.messages, signal.key: GENERIC.messages[CURRENT_ID]}
    vehicle = replace(GENERIC, current=signal, messages=messages)
    assert vehicle.wanted_ids[0] == 0x18FF0001
    wanted = {"can_id": 0x18FF0001, "can_mask": 0x1FFFFFFF, "extended": True}
    assert vehicle.filters[0] == wanted
    assert len(feed(SampleDecoder(vehicle), frames_of(vehicle))) == 10


def test_a_service_on_udp_takes_64_bytes(tmp_path: Path) -> None:
    port = 20_000 + (os.getpid() + 77) % 20_000
    address = bus_address("udp_multicast", options={"port": port, "fd": True})
    estimates_from_64_bytes(address, tmp_path)


PGN_ID = 0x18F01D27  # PGN 0xF01D from source 0x27
TRUCK = f"""VERSION "1"
BU_: V
BO_ {PGN_ID | CAN_EFF_FLAG} HVESSD1: 8 V
 SG_ Voltage : 0|16@1+ (0.05,0) [0|0] "V" V
 SG_ Current : 16|16@1+ (0.05,-1600) [0|0] "A" V
"""


@pytest.mark.parametrize(
    ("j1939", "number", "is_taken"),
    [
        (True, PGN_ID, True),
        (True, 0x18F01DF3, True),  # another source
        (True, 0x0CF01D27, True),  # another priority
        (True, 0x18F01E27, False),
        (False, PGN_ID, True),
        (False, 0x18F01DF3, False),
    ],
)
def test_a_pgn_identifies_where_the_map_says_so(
    tmp_path: Path, j1939: bool, number: int, is_taken: bool
) -> None:
    (tmp_path / "truck.dbc").write_text(TRUCK)
    text = 'current = "Current"\nvoltage = "Voltage"\ntemperature.fixed_c = 20\n'
    more = "messages.HVESSD1.j1939 = true\n" if j1939 else ""
    (tmp_path / "map.toml").write_text(text + more)
    car = Vehicle.load(dbc=tmp_path / "truck.dbc", map=tmp_path / "map.toml")
    data = (13000).to_bytes(2, "little") + (32400).to_bytes(2, "little") + bytes(4)
    sample = SampleDecoder(car).handle(frame(number, data, wide=True))
    assert (sample is not None) is is_taken
    assert sample is None or sample[1:3] == pytest.approx((20.0, 650.0))
    wanted = car.filters[0]
    assert (number & wanted["can_mask"] == wanted["can_id"] & wanted["can_mask"]) is is_taken


def test_a_destination_is_no_part_of_a_pgn() -> None:
    assert pgn_mask(0x18EA00F9) == 0x03FF0000
    assert pgn_mask(PGN_ID) == 0x03FFFF00


# --- Cells

CELLS_V = [round(3.6 + 0.003 * number, 3) for number in range(12)]
ARRAY = '[cells]\nsignal = "CELL_{n}_V"\ncount = 12\n'
GROUPS = (
    '[cells]\nmessage = "CELL_GROUPS"\nindex = "group_number"\ncount = 11\n'
    'signals = ["cell_a", "cell_b", "cell_c"]\n'
)


def cell_car(folder: Path, cells: str) -> Vehicle:
    (folder / "cells.dbc").write_text(CELLS_DBC)
    (folder / "car.toml").write_text(CAR + cells)
    return Vehicle.load(dbc=shared_file("dbc", "generic_pack.dbc"), map=folder / "car.toml")


def cells_after(car: Vehicle, frames: list[can.Message]) -> list[float]:
    decoder = SampleDecoder(car)
    feed(decoder, frames)
    assert decoder.cells is not None
    return decoder.cells.take(frames[-1].timestamp)[0]


def test_cells_come_as_an_array_or_in_groups(tmp_path: Path) -> None:
    car = cell_car(tmp_path, ARRAY)
    assert {"can_id": 0x440, "can_mask": 0x7FF, "extended": False} in car.filters
    assert cells_after(car, cell_frames(CELLS_V)) == pytest.approx(CELLS_V)
    partly = cells_after(car, cell_frames(CELLS_V)[:2])
    assert partly[:6] == pytest.approx(CELLS_V[:6])
    assert all(math.isnan(each) for each in partly[6:])
    # The last group is filled up: a twelfth cell does not exist.
    car = cell_car(tmp_path, GROUPS)
    assert cells_after(car, numbered_frames(CELLS_V)) == pytest.approx(CELLS_V[:11])
    car = cell_car(tmp_path, GROUPS + "first_index = 1\n")
    assert cells_after(car, numbered_frames(CELLS_V, first=1)) == pytest.approx(CELLS_V[:11])


def test_old_implausible_and_missing_voltages_are_not_used(tmp_path: Path) -> None:
    decoder = SampleDecoder(cell_car(tmp_path, ARRAY + "lowest = 2.5\ntimeout_s = 3\n"))
    cells = decoder.cells
    assert cells is not None
    feed(decoder, cell_frames([1.0, math.nan, *CELLS_V[2:]], time_s=10.0))
    volts, times = cells.take(11.0)
    assert [math.isnan(each) for each in volts[:3]] == [True, True, False]
    assert times[2] == 10.0
    # Each value is used once, and not once it is old.
    assert np.isnan(cells.take(11.5)[0]).all()
    feed(decoder, cell_frames(CELLS_V, time_s=20.0))
    assert np.isnan(cells.take(24.0)[0]).all()


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        (ARRAY.replace("12", "13"), "CELL_13_V"),
        (ARRAY.replace("{n}", ""), "{n}"),
        (ARRAY.replace("{n}", "{m}"), "{n}"),
        (ARRAY.replace("{n}", "{n[0]}"), "is not a name with {n}"),
        (ARRAY.replace("{n}", "{n:>999999}"), "is not a name with {n}"),
        ("[cells]\ncount = 12\n", "either signal"),
        ('[cells]\nindex = "group_number"\ncount = 12\n', "signals and message"),
        (GROUPS.replace("CELL_GROUPS", "NOTHING"), "NOTHING"),
        (ARRAY.replace("12", "1"), "count"),
        (ARRAY.replace("12", "5000"), "count"),
    ],
)
def test_a_wrong_map_of_cells_names_the_field(tmp_path: Path, cells: str, words: str) -> None:
    with pytest.raises(InputError) as refused:
        cell_car(tmp_path, cells)
    assert words in str(refused.value)
    assert "cells" in str(refused.value)


TURNS = """VERSION ""
BU_: BMS
BO_ 256 Pack: 3 BMS
 SG_ part M : 0|8@1+ (1,0) [0|1] "" X
 SG_ I m0 : 8|16@1- (0.1,0) [-1000|1000] "A" X
 SG_ U m1 : 8|16@1+ (0.1,0) [0|1000] "V" X
BO_ 257 Cell: 1 BMS
 SG_ T : 0|8@1+ (1,-40) [-40|215] "degC" X
"""


def test_current_and_voltage_take_turns_in_one_message(tmp_path: Path) -> None:
    (tmp_path / "car.dbc").write_text(TURNS)
    (tmp_path / "car.toml").write_text(
        '[current]\nsignal = "I"\n[voltage]\nsignal = "U"\n[temperature]\nsignal = "T"\n'
    )
    decoder = SampleDecoder(Vehicle.load(dbc=tmp_path / "car.dbc", map=tmp_path / "car.toml"))
    payloads = ((257, bytes([60])), (256, bytes([0, 100, 0])), (256, bytes([1, 0x74, 0x0E])))
    turns = [frame(number, data, 0.1 * turn) for turn in range(10) for number, data in payloads]
    samples = feed(decoder, turns)
    assert [each[1:] for each in samples] == [(10.0, 370.0, 20.0)] * 10


def test_a_sample_uses_the_temperature_of_its_own_frame(tmp_path: Path) -> None:
    (tmp_path / "car.dbc").write_text(
        "BO_ 256 Pack: 4 BMS\n"
        ' SG_ T : 0|8@1+ (1,0) [0|255] "degC" X\n'
        ' SG_ I : 8|8@1- (1,0) [-128|127] "A" X\n'
        ' SG_ U : 16|16@1+ (0.1,0) [0|1000] "V" X\n'
    )
    (tmp_path / "car.toml").write_text('current = "I"\nvoltage = "U"\ntemperature = "T"\n')
    decoder = SampleDecoder(Vehicle.load(dbc=tmp_path / "car.dbc", map=tmp_path / "car.toml"))
    frames = [frame(256, bytes([warm, 100, 0x74, 0x0E]), 0.1 * warm) for warm in (20, 21)]
    assert [each.temperature_c for each in feed(decoder, frames)] == [20.0, 21.0]
