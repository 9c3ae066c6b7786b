"""AUTOSAR E2E profiles and plain counters, in code, map files and configurations."""

from __future__ import annotations

from pathlib import Path

import crccheck.crc
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.bus.database import Field
from cangauge.bus.mapping import CheckMap, MessageMap, Overrides
from cangauge.bus.protection import (
    LEAF_RULE,
    PROFILES,
    CounterRule,
    E2eRule,
    FrameChecker,
    Protection,
    Verdict,
)
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError

IDS = bytes(range(0x40, 0x50))
RULES: dict[str, Protection] = {
    "01 both": E2eRule("e2e_01", data_id=0x123),
    "01 alternating": E2eRule("e2e_01", data_id=0x123, data_id_mode="alternating"),
    "01 low": E2eRule("e2e_01", data_id=0x123, data_id_mode="low"),
    "01 nibble": E2eRule("e2e_01", data_id=0x123, data_id_mode="nibble"),
    "01 at 3": E2eRule("e2e_01", data_id=0x123, header_byte=3),
    "02": E2eRule("e2e_02", data_ids=IDS),
    "04": E2eRule("e2e_04", data_id=0x12345678),
    "05": E2eRule("e2e_05", data_id=0x1234),
    "05 in part": E2eRule("e2e_05", data_id=0x1234, protected_bytes=6),
    "06": E2eRule("e2e_06", data_id=0x1234),
    "07": E2eRule("e2e_07", data_id=0x12345678),
    "11": E2eRule("e2e_11", data_id=0x123),
    "11 nibble": E2eRule("e2e_11", data_id=0x123, data_id_mode="nibble"),
    "counter": CounterRule("counter", Field(4, 4, big_endian=False), 8, 15),
}
MODULI = {"01": 15, "02": 16, "04": 1 << 16, "05": 256, "06": 256, "07": 1 << 32, "11": 15}
each_rule = pytest.mark.parametrize("name", list(RULES))
each_profile = pytest.mark.parametrize("name", [name for name in RULES if name != "counter"])


def length_of(name: str) -> int:
    return 24 if name in {"04", "07"} else 8


def frames(name: str, counters: list[int]) -> list[bytes]:
    return [RULES[name].protect(bytes(length_of(name)), counter) for counter in counters]


@each_rule
def test_successive_frames_are_good_across_a_wrap(name: str) -> None:
    rule = RULES[name]
    checker = FrameChecker(rule, 0.01)
    start = rule.modulus - 3
    for step, frame in enumerate(frames(name, [start + step for step in range(20)])):
        assert rule.counter(frame) == (start + step) % rule.modulus
        assert checker.check(frame, 0.01 * step) is Verdict.GOOD
    assert rule.modulus == MODULI.get(name[:2], 15)


@each_profile
def test_any_flipped_bit_of_the_protected_bytes_is_refused(name: str) -> None:
    rule = RULES[name]
    frame = frames(name, [5])[0]
    protected = 6 if name == "05 in part" else len(frame)
    for bit in range(8 * len(frame)):
        broken = bytearray(frame)
        broken[bit // 8] ^= 1 << bit % 8
        assert rule.is_whole(broken) is (bit // 8 >= protected)


@each_profile
@given(st.binary(min_size=24, max_size=24), st.integers(0, 2**40))
def test_the_crc_covers_content_and_data_id(name: str, content: bytes, counter: int) -> None:
    rule = RULES[name]
    assert isinstance(rule, E2eRule)
    frame = rule.protect(content[: length_of(name)], counter)
    checked = bytearray(frame)
    assert rule.is_whole(frame)
    assert rule.is_whole(checked)
    assert checked == frame  # looked at, not written to
    assert rule.counter(frame) == counter % rule.modulus
    if rule.data_ids:
        stranger = E2eRule(rule.name, data_ids=bytes(each ^ 1 for each in rule.data_ids))
    else:
        stranger = E2eRule(
            rule.name,
            data_id=rule.data_id ^ 0x101,  # in either byte: profile 1 may take them in turns
            data_id_mode=rule.data_id_mode,
            header_byte=rule.header_byte,
            protected_bytes=rule.protected_bytes,
        )
    assert not stranger.is_whole(frame)


@each_rule
def test_a_repeated_counter_is_refused_and_a_jump_is_a_loss(name: str) -> None:
    checker = FrameChecker(RULES[name], 0.01)
    first, copy, later = frames(name, [1, 1, 5])
    assert checker.check(first, 0.00) is Verdict.GOOD
    assert checker.check(copy, 0.01) is Verdict.REPEATED
    assert checker.check(later, 0.05) is Verdict.AFTER_LOSS
    assert checker.lost == 3


def test_a_wide_counter_that_restarts_is_no_loss() -> None:
    checker = FrameChecker(RULES["04"], 0.01)
    last, anew = frames("04", [700, 0])
    assert checker.check(last, 1.0) is Verdict.GOOD
    assert checker.check(anew, 1.01) is Verdict.GOOD
    # With enough time in between it is a loss.
    checker = FrameChecker(RULES["05"], 0.01)
    last, later = frames("05", [100, 50])
    checker.check(last, 0.0)
    assert checker.check(later, 2.06) is Verdict.AFTER_LOSS
    assert checker.lost == 205


class Crc8OfProfile1(crccheck.crc.Crc8Base):
    """CRC-8 SAE J1850 with initial value 0 and no final XOR, as in profile 1."""

    _poly = 0x1D


@pytest.mark.parametrize("name", ["01 both", "11"])
def test_counters_of_profiles_1_and_11_leave_15_out(name: str) -> None:
    for counter in (14, 15):
        rest = bytes([counter, *b"abcdef"])
        frame = bytes([Crc8OfProfile1.calc(b"\x23\x01" + rest), *rest])
        assert RULES[name].is_whole(frame) is (counter == 14)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        # AUTOSAR, E2E Protocol Specification: all data 0, first message, data ids of its examples.
        ("01 both", "cc00000000000000"),
        ("05", "1cca000000000000"),
    ],
)
def test_frames_are_those_of_the_specification(name: str, expected: str) -> None:
    assert frames(name, [0])[0].hex() == expected


def test_profile_2_agrees_with_crccheck() -> None:
    for counter in range(16):
        frame = RULES["02"].protect(b"\0\xa0battry", counter)
        assert frame[1] == 0xA0 | counter
        assert crccheck.crc.Crc8Autosar.calc(frame[1:] + IDS[counter : counter + 1]) == frame[0]


def test_profiles_4_and_7_need_can_fd() -> None:
    assert not RULES["04"].fits(8)
    assert RULES["04"].fits(12)
    assert not RULES["07"].fits(16)
    assert RULES["07"].fits(20)
    assert not RULES["01 at 3"].fits(4)
    assert not RULES["05 in part"].fits(5)


@pytest.mark.parametrize(
    ("figures", "field"),
    [
        ({"name": "e2e_03"}, "protection"),
        ({"name": "e2e_05", "data_id": 1 << 16}, "data_id"),
        ({"name": "e2e_05", "data_id_mode": "low"}, "data_id_mode"),
        ({"name": "e2e_11", "data_id_mode": "low"}, "data_id_mode"),
        ({"name": "e2e_02", "data_ids": b"123"}, "data_id_list"),
        ({"name": "e2e_02", "data_ids": IDS, "header_byte": 1}, "header_byte"),
        ({"name": "e2e_05", "data_ids": IDS}, "data_id_list"),
        ({"name": "e2e_05", "protected_bytes": 2}, "protected_bytes"),
        ({"name": "e2e_05", "header_byte": -1}, "header_byte"),
    ],
)
def test_values_that_a_profile_does_not_allow_are_refused(
    figures: dict[str, object], field: str
) -> None:
    with pytest.raises(InputError) as caught:
        E2eRule(**figures)  # type: ignore[arg-type] # parametrised
    assert caught.value.field == field


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
[current]
signal = "Current"
[voltage]
signal = "Voltage"
[temperature]
signal = "Temperature"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "car.dbc").write_text(DBC)
    return tmp_path


def load(folder: Path, more: str = "", overrides: Overrides | None = None) -> Vehicle:
    (folder / "car.toml").write_text(MAP + more)
    return Vehicle.load(map=folder / "car.toml", overrides=overrides or Overrides())


def test_a_map_file_chooses_a_profile_for_each_message(folder: Path) -> None:
    vehicle = load(
        folder,
        '[messages.Fast]\nprotection = "e2e_01"\ndata_id = 291\ndata_id_mode = "nibble"\n'
        '[messages.Slow]\nprotection = "e2e_05"\ndata_id = 0x1234\nperiod_s = 0.5\n',
    )
    assert vehicle.messages[0x100].rule == RULES["01 nibble"]
    assert vehicle.messages[0x101].rule == RULES["05"]
    assert vehicle.messages[0x101].period_s == 0.5


def test_a_counter_is_named_by_its_signal(folder: Path) -> None:
    more = '[messages.Fast]\nprotection = "counter"\ncounter = "Alive"\ncounter_modulus = 15\n'
    rule = load(folder, more).messages[0x100].rule
    assert isinstance(rule, CounterRule)
    assert rule.counter(b"\0\x0e" + bytes(6)) == 14
    assert not rule.is_whole(b"\0\x0f" + bytes(6))


def test_a_configuration_overrides_the_map_file(folder: Path) -> None:
    more = '[messages.Fast]\nprotection = "e2e_01"\ndata_id = 291\nperiod_s = 0.1\n'
    overrides = Overrides(
        "run.toml",
        messages={"0x100": MessageMap(protection="e2e_02", data_id_list=tuple(IDS))},
        checks={"voltage": CheckMap(highest=410.0)},
    )
    vehicle = load(folder, more, overrides)
    assert vehicle.messages[0x100].rule == RULES["02"]
    assert vehicle.messages[0x100].period_s == 0.1
    assert vehicle.voltage.checks.highest == 410.0
    leaf = Vehicle.load(
        "leaf_aze0",
        overrides=Overrides("run.toml", messages={"BATTERY_1DB": MessageMap(period_s=0.02)}),
    )
    assert leaf.messages[0x1DB].rule is LEAF_RULE
    assert leaf.messages[0x1DB].period_s == 0.02


@pytest.mark.parametrize(
    ("more", "field", "text"),
    [
        ('protection = "e2e_05"', "data_id", "is missing"),
        ('protection = "e2e_02"', "data_id_list", "is missing"),
        ('protection = "e2e_02"\ndata_id_list = [1, 2]', "data_id_list", "at least 16"),
        ('protection = "e2e_05"\ndata_id = 65536', "data_id", "16 bits"),
        ('protection = "e2e_04"\ndata_id = 1', "protection", "8 bytes"),
        ('protection = "counter"', "counter", "is missing"),
        ('protection = "counter"\ncounter = "Nonsense"', "counter", "no such signal"),
        (
            'protection = "counter"\ncounter = "Alive"\ncounter_modulus = 17',
            "counter_modulus",
            "3 to 16",
        ),
        ('protection = "leaf"\ndata_id = 5', "data_id", "e2e profile"),
        ('protection = "e2e_05"\ndata_id = 5\ncounter = "Alive"', "counter", "belongs to"),
        ('protection = "e2e_03"', "protection", "e2e_11"),
    ],
)
def test_mistakes_in_protection_name_field_and_file(
    folder: Path, more: str, field: str, text: str
) -> None:
    with pytest.raises(InputError, match=text) as caught:
        load(folder, f"[messages.Fast]\n{more}\n")
    assert caught.value.field == f"messages.Fast.{field}"
    assert caught.value.source == str(folder / "car.toml")


def test_mistakes_in_a_configuration_name_its_file(folder: Path) -> None:
    overrides = Overrides("run.toml", messages={"Fast": MessageMap(protection="e2e_05")})
    with pytest.raises(InputError, match="data_id") as caught:
        load(folder, "", overrides)
    assert caught.value.source == "run.toml"


def test_every_profile_of_the_library_is_known() -> None:
    assert set(PROFILES) == {f"e2e_{number}" for number in MODULI}
