"""CRC, alive counter, E2E profiles: rules in code and in map files, and successive frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import crccheck.crc
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.bus.database import BitField
from cangauge.bus.protection import (
    RULES,
    Anomaly,
    CounterRule,
    E2eRule,
    FrameChecker,
    Protection,
    ProtectionRule,
)
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError

GOOD: None = None
LOSS: Final = "counter_jumps"
WRONG: Final = "crc_errors"
REPEATED: Final = "counter_repeats"
IDS = tuple(range(0x40, 0x50))
TRIED: dict[str, Protection] = {
    "leaf": RULES["leaf"],
    "generic": RULES["generic"],
    "first byte": ProtectionRule(polynomial=0x2F, initial=0xFF, crc_byte=0, counter_byte=1),
    "middle": ProtectionRule(polynomial=0x07, crc_byte=3, counter_byte=-1, counter_shift=4),
    "01": E2eRule("e2e_01", data_id=0x123),
    "01 alternating": E2eRule("e2e_01", data_id=0x123, data_id_mode="alternating"),
    "01 low": E2eRule("e2e_01", data_id=0x123, data_id_mode="low"),
    "01 nibble": E2eRule("e2e_01", data_id=0x123, data_id_mode="nibble"),
    "01 at 3": E2eRule("e2e_01", data_id=0x123, header_byte=3),
    "02": E2eRule("e2e_02", data_id_list=IDS),
    "04": E2eRule("e2e_04", data_id=0x12345678),
    "05": E2eRule("e2e_05", data_id=0x1234),
    "05 in part": E2eRule("e2e_05", data_id=0x1234, protected_bytes=6),
    "06": E2eRule("e2e_06", data_id=0x1234),
    "07": E2eRule("e2e_07", data_id=0x12345678),
    "11": E2eRule("e2e_11", data_id=0x123),
    "11 nibble": E2eRule("e2e_11", data_id=0x123, data_id_mode="nibble"),
    "counter": CounterRule(BitField(4, 4, big_endian=False), 15),
}
MODULI = {"leaf": 4, "generic": 16, "first byte": 16, "middle": 16, "counter": 15, "01": 15,
          "02": 16, "04": 1 << 16, "05": 256, "06": 256, "07": 1 << 32, "11": 15}  # fmt: skip
each_rule = pytest.mark.parametrize("name", list(TRIED))


def frame(name: str, counter: int, content: bytes = bytes(24)) -> bytes:
    return TRIED[name].protect(content[: 24 if name in {"04", "07"} else 8], counter)


@each_rule
def test_successive_frames_are_good_across_a_wrap(name: str) -> None:
    rule, checker = TRIED[name], FrameChecker(TRIED[name], 0.01)
    assert rule.modulus == MODULI.get(name, MODULI.get(name[:2]))
    start = rule.modulus - 3
    for step in range(20):
        data = frame(name, start + step)
        assert rule.counter(data) == (start + step) % rule.modulus
        assert checker.check(data, 0.01 * step) is GOOD


@each_rule
@given(st.binary(min_size=24, max_size=24), st.integers(0, 2**40), st.data())
def test_a_protected_frame_is_whole_and_any_flipped_bit_is_not(
    name: str, content: bytes, counter: int, draw: st.DataObject
) -> None:
    rule, data = TRIED[name], bytearray(frame(name, counter, content))
    assert rule.is_whole(data)
    assert rule.protect(data, counter) == data
    changed = [old ^ new for old, new in zip(content, data, strict=False)]
    if isinstance(rule, ProtectionRule):  # nothing but CRC and counter changes
        crc, place = rule.crc_byte % len(data), rule.counter_byte % len(data)
        own = (rule.modulus - 1) << rule.counter_shift
        assert not any(x for n, x in enumerate(changed) if n not in {crc, place})
        assert not changed[place] & ~own
    covered = 6 if name == "05 in part" else 0 if name == "counter" else len(data)
    bit = draw.draw(st.integers(0, 8 * len(data) - 1))
    data[bit // 8] ^= 1 << bit % 8
    if name != "counter":
        assert rule.is_whole(data) is (bit // 8 >= covered)


@each_rule
def test_a_repeated_counter_is_refused_and_a_jump_is_a_loss(name: str) -> None:
    checker, steps = FrameChecker(TRIED[name], 0.01), 3 if name == "leaf" else 5
    assert checker.check(frame(name, 1), 0.00) is GOOD
    assert checker.check(frame(name, 1), 0.01) is REPEATED
    assert checker.check(frame(name, 1 + steps), 0.05) is LOSS
    assert checker.lost == steps - 1


@pytest.mark.parametrize("name", [name for name in TRIED if name[0] in "01"])
def test_the_crc_covers_the_data_id(name: str) -> None:
    rule = TRIED[name]
    assert isinstance(rule, E2eRule)
    # In either byte: profile 1 alternates.
    data_id = None if rule.data_id is None else rule.data_id ^ 0x101
    data_ids = rule.data_id_list and tuple(each ^ 1 for each in rule.data_id_list)
    stranger = replace(rule, data_id=data_id, data_id_list=data_ids)
    assert not any(stranger.is_whole(frame(name, counter)) for counter in range(4))


class LeafCrc(crccheck.crc.Crc8Base):
    _poly, _initvalue, _xor_output = 0x85, 0x00, 0x00


class Crc8OfProfile1(crccheck.crc.Crc8Base):
    """CRC-8 SAE J1850 with initial value 0 and no final XOR, as in profile 1."""

    _poly = 0x1D


@given(st.binary(min_size=2, max_size=64))
def test_crcs_agree_with_crccheck(payload: bytes) -> None:
    assert TRIED["leaf"].crc(payload) == LeafCrc.calc(payload[:-1])
    assert TRIED["generic"].crc(payload) == crccheck.crc.Crc8SaeJ1850.calc(payload[:-1])


def test_published_check_values() -> None:
    assert TRIED["generic"].crc(b"123456789?") == 0x4B
    # AUTOSAR, E2E Protocol Specification: all data 0, first message, data ids of its examples.
    assert frame("01", 0).hex() == "cc00000000000000"
    assert frame("05", 0).hex() == "1cca000000000000"
    for counter in range(16):
        data = TRIED["02"].protect(b"\0\xa0battry", counter)
        assert data[1] == 0xA0 | counter
        assert crccheck.crc.Crc8Autosar.calc(data[1:] + bytes([IDS[counter]])) == data[0]
    for name in ("01", "11"):  # they leave counter 15 out
        for counter in (14, 15):
            rest = bytes([counter, *b"abcdef"])
            data = bytes([Crc8OfProfile1.calc(b"\x23\x01" + rest), *rest])
            assert TRIED[name].is_whole(data) is (counter == 14)


def checked(
    rule: Protection, period_s: float | None, *frames: tuple[float, int]
) -> list[Anomaly | None]:
    checker = FrameChecker(rule, period_s)
    return [checker.check(rule.protect(bytes(24), n), time_s) for time_s, n in frames]


def test_a_counter_that_may_have_wrapped_is_a_loss() -> None:
    repeated = [(0.01 * n, 2) for n in range(50)]
    assert checked(TRIED["leaf"], 0.01, *repeated, (0.5, 3)) == [GOOD, *[REPEATED] * 49, GOOD]
    # After half a wrap three frames are missing; without a period only a silence ends repetition.
    assert checked(TRIED["leaf"], 0.01, (0.0, 2), (0.0199, 2)) == [GOOD, REPEATED]
    assert checked(TRIED["leaf"], 0.01, (0.0, 2), (0.0399, 2)) == [GOOD, LOSS]
    silence = [(0.0, 2), (1.5, 2), (3.0, 2), (103.0, 2)]
    assert checked(TRIED["generic"], None, *silence) == [GOOD, REPEATED, REPEATED, LOSS]


def test_a_wide_counter_that_restarts_is_no_loss() -> None:
    assert checked(TRIED["04"], 0.01, (1.0, 700), (1.01, 0)) == [GOOD, GOOD]
    assert checked(TRIED["05"], 0.01, (0.0, 100), (2.06, 50)) == [GOOD, LOSS]


def test_a_damaged_frame_is_not_counted_as_lost_too() -> None:
    checker = FrameChecker(TRIED["generic"])
    good = [TRIED["generic"].protect(bytes(6), n) for n in range(4)]
    assert checker.check(good[0], 0.0) is GOOD
    assert checker.check(bytes([*good[1][:-1], good[1][-1] ^ 1]), 0.1) is WRONG
    assert checker.check(good[2], 0.2) is GOOD
    assert checker.lost == 0


def test_without_a_counter_only_the_crc_counts() -> None:
    data = RULES["crc_only"].protect(b"abcdefgh", 5)
    assert data[:-1] == b"abcdefg"
    assert checked(RULES["crc_only"], None, (0.0, 1), (0.0, 1)) == [GOOD, GOOD]


@pytest.mark.parametrize(
    ("name", "length", "fits"),
    [("generic", 1, False), ("generic", 2, True), ("04", 8, False), ("04", 12, True),
     ("07", 16, False), ("07", 20, True), ("01 at 3", 4, False), ("05 in part", 5, False),
     ("middle", 4, False), ("middle", 5, True)],
)  # fmt: skip
def test_a_rule_fits_into_enough_bytes(name: str, length: int, fits: bool) -> None:
    assert TRIED[name].fits(length) is fits


DBC = """VERSION ""

BU_: BMS

BO_ 256 Fast: 8 BMS
 SG_ Crc : 0|8@1+ (1,0) [0|255] "" X
 SG_ Alive : 8|4@1+ (1,0) [0|14] "" X
 SG_ Current : 16|16@1- (0.1,0) [-3000|3000] "A" X
 SG_ Voltage : 32|16@1+ (0.1,0) [0|6000] "V" X

BO_ 257 Slow: 8 BMS
 SG_ Temperature : 24|8@1+ (1,-40) [-40|215] "degC" X
"""
MAP = """dbc = "car.dbc"
current = "Current"
voltage = "Voltage"
temperature = "Temperature"
"""


def load(folder: Path, more: str = "") -> Vehicle:
    (folder / "car.dbc").write_text(DBC)
    (folder / "car.toml").write_text(MAP + more)
    return Vehicle.load(map=folder / "car.toml")


def test_a_map_file_chooses_the_rule_of_each_message(tmp_path: Path) -> None:
    fast = '[messages.Fast]\nprotection = "e2e_01"\ndata_id = 291\ndata_id_mode = "nibble"\n'
    slow = '[messages.Slow]\nprotection = "e2e_05"\ndata_id = 0x1234\nperiod_s = 0.5\n'
    messages = load(tmp_path, fast + slow).messages
    assert messages[0x100].rule == TRIED["01 nibble"]
    assert messages[0x101] == (TRIED["05"], 0.5, b"", False, None, "e2e_05")
    counter = '[messages.Fast]\nprotection = "counter"\ncounter = "Alive"\ncounter_modulus = 15\n'
    rule = load(tmp_path, counter).messages[0x100].rule
    assert rule is not None
    assert rule.counter(b"\0\x0e" + bytes(6)) == 14
    assert not rule.is_whole(b"\0\x0f" + bytes(6))


@pytest.mark.parametrize(
    ("more", "field", "text"),
    [
        ('protection = "e2e_05"', "data_id", "is missing"),
        ('protection = "e2e_02"', "data_id_list", "is missing"),
        ('protection = "e2e_02"\ndata_id_list = [1, 2]', "data_id_list", "at least 16"),
        ('protection = "e2e_05"\ndata_id = 65536', "data_id", "16 bits"),
        ('protection = "e2e_04"\ndata_id = 1', "protection", "8 bytes"),
        ('protection = "e2e_11"\ndata_id = 1\ndata_id_mode = "low"', "data_id_mode", "both"),
        (f'protection = "e2e_02"\ndata_id_list = {[*IDS]}\nheader_byte = 1', "header_byte", "0"),
        (f'protection = "e2e_05"\ndata_id = 1\ndata_id_list = {[*IDS]}', "data_id_list", "one"),
        ('protection = "e2e_05"\ndata_id = 1\nprotected_bytes = 2', "protected_bytes", "3"),
        ('protection = "e2e_05"\ndata_id = 1\nheader_byte = -1', "header_byte", "at least 0"),
        ('protection = "counter"', "counter", "is missing"),
        ('protection = "counter"\ncounter = "Nonsense"', "counter", "no such signal"),
        ('protection = "counter"\ncounter = "Alive"\ncounter_modulus = 17', "counter_modulus",
         "3 to 16"),
        ('protection = "leaf"\ndata_id = 5', "data_id", "e2e profile"),
        ('protection = "e2e_05"\ndata_id = 5\ncounter = "Alive"', "counter", "belongs to"),
        ('protection = "e2e_03"', "protection", "e2e_11"),
    ],
)  # fmt: skip
def test_mistakes_in_protection_name_field_and_file(
    tmp_path: Path, more: str, field: str, text: str
) -> None:
    with pytest.raises(InputError, match=text) as caught:
        load(tmp_path, f"[messages.Fast]\n{more}\n")
    assert caught.value.field == f"messages.Fast.{field}"
    assert caught.value.source == str(tmp_path / "car.toml")


@pytest.mark.parametrize("missing", [1, 15, 17, 31, 33])
def test_losses_beyond_a_turn_of_the_counter_are_counted_by_the_stamps(missing: int) -> None:
    checker = FrameChecker(TRIED["generic"], period_s=0.01)
    for number in (0, 1, 2 + missing):
        frame = TRIED["generic"].protect(bytes(8), number)
        checker.check(frame, 0.01 * number)
    assert checker.lost == missing


def test_a_slower_sender_than_stated_loses_nothing() -> None:
    checker = FrameChecker(TRIED["leaf"], period_s=0.01)
    for number in range(50):
        assert checker.check(TRIED["leaf"].protect(bytes(8), number), 0.1 * number) is GOOD
