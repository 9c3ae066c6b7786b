"""`inspect_capture`: frames, protection and presets, on a virtual pack and on real cars."""

from __future__ import annotations

import math
from pathlib import Path

import can
import pytest

from cangauge.bus.protection import RULES
from cangauge.bus.vehicle import Vehicle
from cangauge.inspect.capture import inspect_capture
from cangauge.replay.encoder import FrameEncoder
from cangauge.types import Sample
from selection import nightly_except

CURRENT_ID, VOLTAGE_ID, TEMPERATURE_ID = 0x400, 0x401, 0x402


@pytest.fixture(scope="module")
def generic() -> Vehicle:
    return Vehicle.load("generic")


def drive(vehicle: Vehicle, seconds: float = 20.0, start_s: float = 1000.0) -> list[can.Message]:
    """A drive at 10 Hz with steps of current, as frames."""
    encoder, frames = FrameEncoder(vehicle), []
    for n in range(round(10 * seconds)):
        current_a = 40.0 * (n // 20 % 2)
        sample = Sample(start_s + n / 10.0, current_a, 380.0 - 0.1 * current_a, 20.0 + n / 1000.0)
        for frame in encoder.encode(sample, 80.0 - n / 100.0):
            frame.channel = "can0"
            frames.append(frame)
    return frames


def record(path: Path, frames: list[can.Message]) -> Path:
    with can.CanutilsLogWriter(path) as writer:
        for frame in frames:
            writer.on_message_received(frame)
    return path


def test_inspection_lists_frames_protection_and_vehicle(tmp_path: Path, generic: Vehicle) -> None:
    frames = drive(generic)
    frames = [f for f in frames if not 1005.0 < f.timestamp < 1007.95]
    frames.append(can.Message(timestamp=1021.0, is_error_frame=True, channel="can0"))
    frames.append(
        can.Message(
            timestamp=1021.0,
            arbitration_id=5,
            is_remote_frame=True,
            is_extended_id=False,
            dlc=1,
            channel="can0",
        )
    )
    path = record(tmp_path / "x.log", frames)
    found = inspect_capture(path)
    assert found.matching == ("generic",)
    assert found.duration_s == pytest.approx(21.0, abs=0.01)
    assert (found.error_frames, found.remote_frames) == (1, 1)
    assert [(g["start_s"], round(g["length_s"], 3)) for g in found.gaps] == [
        (1005.0, 3.0),
        (1019.9, 1.1),
    ]
    current = next(each for each in found.ids if each.id == "400")
    assert (current.protection, current.bytes, current.bus) == ("generic", "6", "can0")
    assert current.period_s == pytest.approx(0.1)
    assert current.longest_s == pytest.approx(3.0)
    assert (current.crc_errors, current.counter_jumps) == (0, 1)
    assert current.frames_lost == 29 % 16
    match = next(each for each in found.presets if each.preset == "generic")
    assert match.current_a == (0.0, 40.0)
    assert match.voltage_v == (376.0, 380.0)
    assert found.log is None
    assert found.to_dict()["matching_presets"] == "generic"


def test_inspection_with_a_vehicle_has_the_log_too(tmp_path: Path, generic: Vehicle) -> None:
    path = record(tmp_path / "x.log", drive(generic))
    found = inspect_capture(path, generic)
    assert found.log is not None
    assert found.log.rows == 200
    assert found.to_dict()["log"]["rows"] == 200


def test_inspection_of_unknown_frames(tmp_path: Path) -> None:
    frames = [
        can.Message(
            timestamp=n / 10,
            arbitration_id=0x100 + n % 3,
            is_extended_id=n % 3 == 0,
            data=bytes([n % 256, n // 256]),
            channel="can0",
        )
        for n in range(300)
    ]
    constant = RULES["leaf"].protect(bytes(8), 0)  # a CRC that is right by chance
    frames += [
        can.Message(
            timestamp=30.0 + n,
            arbitration_id=7,
            is_extended_id=False,
            data=constant,
            channel="can0",
        )
        for n in range(100)
    ]
    found = inspect_capture(record(tmp_path / "x.log", frames))
    assert found.matching == ()
    assert [each.id for each in found.ids] == ["007", "00000100", "101", "102"]
    assert all(each.protection == "" for each in found.ids)
    assert all(not match.because.startswith("all") for match in found.presets)
    assert not math.isnan(found.duration_s)


def test_repeated_and_damaged_frames_are_counted(tmp_path: Path, generic: Vehicle) -> None:
    frames = drive(generic)
    current = [frame for frame in frames if frame.arbitration_id == CURRENT_ID]
    for k in (60, 90, 120):  # the same counter once more, with another value
        again = can.Message(
            timestamp=current[k].timestamp + 0.001, arbitration_id=CURRENT_ID,
            is_extended_id=False, data=current[k].data, channel="can0",
        )  # fmt: skip
        frames.append(again)
    current[150].data[0] ^= 1
    frames.sort(key=lambda frame: frame.timestamp)
    found = {each.id: each for each in inspect_capture(record(tmp_path / "x.log", frames)).ids}
    assert (found["400"].counter_repeats, found["400"].crc_errors) == (3, 1)
    assert (found["401"].counter_repeats, found["401"].crc_errors) == (0, 0)


# ---- captures of real cars: each matches its own preset

PRESETS = {
    "10bars.csv.gz": "leaf_ze0",
    "12bars95.csv.gz": "leaf_ze0",
    "62kWh-Battery-only-EVcan.txt.gz": "leaf_ze1",
    "AZE0w40kWhv2.48.log.gz": "leaf_aze0",
    "EV-CANeplus2.log.gz": "leaf_ze1_polled",  # a tester's replies have the temperature
    "ZE0_Shift_P_D_ECO_N.log.gz": "leaf_ze0",
    "ZE0w24kWhstock.log.gz": "leaf_ze0",
    "env200-2015-with-40kWh-startup-nobridge.crtd.gz": "leaf_aze0",
    "leaf_2012_orig_start_stop.csv.gz": "leaf_ze0",
}
IN_SUITE = ("10bars.csv.gz", "62kWh-Battery-only-EVcan.txt.gz", "AZE0w40kWhv2.48.log.gz")


@pytest.mark.real
@pytest.mark.parametrize("name", nightly_except(IN_SUITE, PRESETS))
def test_each_capture_matches_its_own_car_only(shared_data: Path, name: str) -> None:
    assert inspect_capture(shared_data / "leaf_can" / name).matching == (PRESETS[name],)


@pytest.mark.real
def test_other_protected_ids_are_found(shared_data: Path) -> None:
    ids = inspect_capture(shared_data / "leaf_can" / "10bars.csv.gz").ids
    found = {each.id: each for each in ids}
    protected = {name for name, each in found.items() if each.protection == "leaf"}
    assert protected == {"11A", "1D4", "1DA", "1DB", "1DC", "50C", "55B"}
    assert found["1DB"].counter_repeats == found["1DB"].frames_lost == 0
    assert found["1D4"].crc_errors == 0
    assert found["1D4"].counter_repeats is None  # its counter is in other bits
    assert found["50C"].counter_repeats is None
