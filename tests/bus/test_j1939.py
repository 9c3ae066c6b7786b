"""J1939 messages are identified by their PGN where the map says so."""

from __future__ import annotations

from pathlib import Path

import can
import pytest

from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.vehicle import Vehicle, pgn_mask

EXTENDED = 1 << 31
ID = 0x18F01D27  # PGN 0xF01D from source 0x27
DBC = f"""VERSION "1"
NS_ :
BS_:
BU_: V
BO_ {ID | EXTENDED} HVESSD1: 8 V
 SG_ Voltage : 0|16@1+ (0.05,0) [0|0] "V" V
 SG_ Current : 16|16@1+ (0.05,-1600) [0|0] "A" V
"""
MAP = """[current]
signal = "Current"
[voltage]
signal = "Voltage"
[temperature]
fixed_c = 20
"""


def vehicle(folder: Path, extra: str) -> Vehicle:
    (folder / "truck.dbc").write_text(DBC)
    (folder / "map.toml").write_text(MAP + extra)
    return Vehicle.load(dbc=folder / "truck.dbc", map=folder / "map.toml")


def frame(number: int) -> can.Message:
    data = (13000).to_bytes(2, "little") + (32400).to_bytes(2, "little") + bytes(4)
    return can.Message(timestamp=1.0, arbitration_id=number, is_extended_id=True, data=data)


@pytest.mark.parametrize("number", [ID, 0x18F01DF3, 0x0CF01D27], ids=["own", "source", "priority"])
def test_any_source_and_priority_of_a_pgn_is_taken(tmp_path: Path, number: int) -> None:
    car = vehicle(tmp_path, "[messages.HVESSD1]\nj1939 = true\n")
    sample = SampleDecoder(car).handle(frame(number))
    assert sample is not None
    assert (sample.current_a, sample.voltage_v) == pytest.approx((20.0, 650.0))
    wanted = car.filters[0]
    assert number & wanted["can_mask"] == wanted["can_id"] & wanted["can_mask"]


def test_another_pgn_is_not_taken(tmp_path: Path) -> None:
    car = vehicle(tmp_path, "[messages.HVESSD1]\nj1939 = true\n")
    assert SampleDecoder(car).handle(frame(0x18F01E27)) is None


def test_without_the_key_the_whole_id_counts(tmp_path: Path) -> None:
    car = vehicle(tmp_path, "")
    assert SampleDecoder(car).handle(frame(0x18F01DF3)) is None
    assert car.filters[0]["can_mask"] == 0x1FFFFFFF


def test_a_destination_is_no_part_of_a_pgn() -> None:
    assert pgn_mask(0x18EA00F9) == 0x03FF0000
    assert pgn_mask(ID) == 0x03FFFF00
