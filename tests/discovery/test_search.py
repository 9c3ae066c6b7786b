"""Current and voltage are found by physics: simulated drives of seven makes, captures of cars."""

from __future__ import annotations

from functools import cache
from itertools import islice
from pathlib import Path

import can
import numpy as np
import pytest

from cangauge.bus.captures import open_capture
from cangauge.extras.discovery.candidate import Candidate
from cangauge.extras.discovery.proposal import Proposal
from cangauge.extras.discovery.search import search
from cangauge.extras.discovery.streams import collect
from drive_captures import CARS, Bits, Car, Frame, capture
from init_makes import HELD_OUT, evaluate
from selection import nightly_except

SEARCHED = {car.name: car for car in CARS}
FIRST = ("hyundai_kia", "tesla_3", "mitsubishi")
"""Makes of which the pack's own pair comes first, before that of the inverter."""


@cache
def searched(name: str) -> Proposal:
    return search(capture(SEARCHED[name]))


def rank(found: list[Candidate], wanted: tuple[int, Bits]) -> int:
    """Return the place of a signal among candidates, 99 if it is not there; zeros above may be."""
    number, bits = wanted
    last = int(bits.places()[-1])
    for place, each in enumerate(found, 1):
        lowest = each.place.last if each.place.is_motorola else None
        same_end = (
            lowest == last if bits.motorola else each.place.start(each.stream.length) == bits.start
        )
        if (
            each.stream.arbitration_id == number
            and each.place.is_motorola == bits.motorola
            and same_end
        ):
            return place
    return 99


@pytest.mark.parametrize("name", nightly_except(("hyundai_kia", "tesla_3"), FIRST))
def test_the_packs_pair_is_first(name: str) -> None:
    car, found = SEARCHED[name], searched(name)
    assert (
        rank(found.candidates["current"], car.current)
        == rank(found.candidates["voltage"], car.voltage)
        == 1
    )
    current, voltage = found.candidates["current"][0], found.candidates["voltage"][0]
    assert current.scale == pytest.approx(car.current[1].scale)
    assert voltage.scale == pytest.approx(car.voltage[1].scale)
    assert current.sign == (-1 if car.charge_positive else 1)
    assert current.resistance_ohm == pytest.approx(car.ohm, rel=0.1)
    assert current.halves_ohm == pytest.approx((car.ohm, car.ohm), rel=0.15)


@pytest.mark.parametrize(
    "name", nightly_except(("renault_zoe",), ("vw_meb", "renault_zoe", "chevrolet_bolt"))
)
def test_unaligned_or_separate_pairs_are_among_three(name: str) -> None:
    car, found = SEARCHED[name], searched(name)
    assert rank(found.candidates["current"], car.current) <= 3
    assert rank(found.candidates["voltage"], car.voltage) <= 3


def test_a_stated_voltage_decides_the_scale() -> None:
    car = SEARCHED["mitsubishi"]
    found = search(capture(car, seconds=30.0), nominal_v=165.0)
    assert rank(found.candidates["voltage"], car.voltage) == 1
    assert found.candidates["voltage"][0].scale == pytest.approx(0.05)


@pytest.mark.real
@pytest.mark.nightly
def test_a_real_drive_is_found_among_a_cars_signals(shared_data: Path) -> None:
    make = next(each for each in HELD_OUT if each.name == "stellantis_van")
    result = evaluate(shared_data, make)
    assert (result.current, result.voltage) == (1, 1)
    assert result.findings.candidates["current"][0].sign == -1
    assert result.findings.candidates["soc_reference"][0].name == "0x4F4 15|10@0+"


def test_the_sign_follows_the_bus() -> None:
    car = SEARCHED["hyundai_kia"]
    turned = Car(car.name, car.frames, car.current, car.voltage, charge_positive=True)
    assert searched(car.name).candidates["current"][0].sign == 1
    assert search(capture(turned)).candidates["current"][0].sign == -1


def test_counters_and_crcs_are_no_candidates() -> None:
    found = searched("tesla_3")
    counters = {(0x101, byte) for byte in (6, 7)} | {(0x109, 0), (0x109, 7)}
    for each in (
        *found.candidates["current"],
        *found.candidates["voltage"],
        *found.candidates["soc_reference"],
    ):
        touched = {(number, bit // 8) for number, _, bit in each.bits}
        assert not touched & counters


def test_a_parked_car_is_said_to_have_no_current() -> None:
    frame = Frame(0x100, 0.01, 8, {"aux": Bits(0, 8, False, 0.1)})
    parked = Car("parked", (frame, Frame(0x200, 0.1, 8, {"limit": Bits(0, 10, False, 0.25)})),
                 (0x100, Bits(0, 8, False, 1.0)), (0x100, Bits(0, 8, False, 1.0)))  # fmt: skip
    found = search(capture(parked, seconds=20.0))
    assert "current" not in found.clear
    assert any("current" in remark for remark in found.remarks)


def test_multiplexed_frames_are_taken_apart() -> None:
    messages = []
    for step in range(400):
        value = step % 4
        data = bytes([value, 17 * value, 200 - 31 * value, 90 * value % 251, 0, 0, 0, 0])
        messages.append(can.Message(timestamp=0.01 * step, arbitration_id=5, data=data))
    streams = collect(messages)
    selected = [each.selected for each in streams if each.selector is not None]
    assert selected == [0, 1, 2, 3]


def test_data_that_follow_a_multiplexer_are_not_taken_for_it() -> None:
    rng = np.random.default_rng(2)
    drift = 3000 + np.cumsum(rng.integers(-2, 3, 600))
    messages = []
    for step, level in enumerate(drift.tolist()):
        value = step % 3
        words = [level + 700 * value, 9 * level % 4001 + 1300 * (2 - value)]
        data = bytes([value]) + b"".join(word.to_bytes(2, "big") for word in words)
        messages.append(can.Message(timestamp=0.01 * step, arbitration_id=5, data=data))
    streams = collect(messages)
    assert [each.selected for each in streams] == [0, 1, 2]
    assert {each.selector.first // 8 for each in streams} == {0}


LEAF = (
    "10bars.csv.gz", "12bars95.csv.gz", "ZE0_Shift_P_D_ECO_N.log.gz", "ZE0w24kWhstock.log.gz",
    "leaf_2012_orig_start_stop.csv.gz",
)  # fmt: skip


@pytest.mark.real
@pytest.mark.parametrize("name", nightly_except(("10bars.csv.gz",), LEAF))
def test_a_leafs_pair_is_found(shared_data: Path, name: str) -> None:
    found = search(open_capture(shared_data / "leaf_can" / name))
    current, voltage = Bits(7, 11, True, 0.5), Bits(23, 10, True, 0.5)
    assert (
        rank(found.candidates["current"], (0x1DB, current))
        == rank(found.candidates["voltage"], (0x1DB, voltage))
        == 1
    )
    assert (found.candidates["current"][0].scale, found.candidates["voltage"][0].scale) == (
        0.5,
        0.5,
    )


@pytest.mark.real
@pytest.mark.nightly
@pytest.mark.parametrize("name", ["bmw_i3.log.gz", "bmw_i3_startcharge_gvret.csv.gz"])
def test_an_i3s_pair_is_found_with_its_offset(shared_data: Path, name: str) -> None:
    found = search(open_capture(shared_data / "can_captures" / name))
    current, voltage = found.candidates["current"][0], found.candidates["voltage"][0]
    assert (current.name, voltage.name) == ("0x112 0|16@1+", "0x112 16|16@1+")
    assert (current.scale, current.offset, current.sign) == (0.1, pytest.approx(-819.2), -1)
    assert voltage.scale == 0.1
    assert voltage.not_available == (65535,)
    assert "current" in found.clear
    assert "voltage" in found.clear


@pytest.mark.real
def test_a_still_capture_is_not_decided(shared_data: Path) -> None:
    found = search(open_capture(shared_data / "leaf_can" / "AZE0w40kWhv2.48.log.gz"))
    assert "current" not in found.clear
    assert any("record while driving" in remark for remark in found.remarks)


def test_the_generators_layouts_decode_to_the_drive() -> None:
    car = SEARCHED["renault_zoe"]
    frames = [each for each in capture(car) if each.arbitration_id == 0x155]
    payloads = np.array([list(each.data) for each in islice(frames, 50)], np.uint8)
    bits = np.unpackbits(payloads, axis=1)[:, car.current[1].places()]
    raw = bits.astype(int) @ (1 << np.arange(11, -1, -1))
    assert np.all(np.abs(0.25 * raw - 500.0) < 250.0)


MODULE = {
    "voltage": Bits(7, 16, True, 0.01),
    "current": Bits(23, 16, True, 0.1, signed=True),
}


def test_a_low_voltage_modules_scale_is_among_the_levels_or_stated() -> None:
    frames = (Frame(0x618, 0.1, 8, MODULE), Frame(0x300, 0.01, 8, {"speed": Bits(0, 8, True, 1.0)}))
    module = Car("module", frames, *((0x618, MODULE[each]) for each in ("current", "voltage")),
                 volts=52.0, ohm=0.01)  # fmt: skip
    open_scale = search(capture(module)).candidates["voltage"][0].levels
    assert any(each.scale == 0.01 and 45.0 < each.value < 54.0 for each in open_scale)
    stated = search(capture(module), nominal_v=52.0)
    assert stated.candidates["voltage"][0].scale == 0.01
    assert "voltage" in stated.clear
    assert "current" in stated.clear
    # Of a long capture all ids are looked at over one time, which is said.
    part = search(capture(module), nominal_v=52.0, at_most=3300)
    assert part.remarks[-1] == "ranges and steps are those of the first 30 s"
