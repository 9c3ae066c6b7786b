"""Captures of real cars: every format, every CRC, plausible values."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from cangauge._resources import shared_file
from cangauge.bus.captures.capture import is_capture, open_capture
from cangauge.bus.database import load_dbc
from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.protection import LEAF_RULE
from cangauge.bus.recording import capture_samples, capture_to_log
from cangauge.bus.vehicle import Vehicle
from cangauge.inspect.capture import inspect_capture

pytestmark = pytest.mark.real

# file: (format, preset, frames, frames of 0x1DB, 0x1DC, 0x55B)
CAPTURES = {
    "10bars.csv.gz": ("seconds, id, length, bytes", "leaf_ze0", 6161, 789, 789, 79),
    "12bars95.csv.gz": ("seconds, id, length, bytes", "leaf_ze0", 7159, 917, 917, 91),
    "62kWh-Battery-only-EVcan.txt.gz": ("candump without stamps", "leaf_ze1", 2041, 458, 458, 46),
    "AZE0w40kWhv2.48.log.gz": ("tab-separated table", "leaf_aze0", 8927, 1128, 1127, 113),
    "EV-CANeplus2.log.gz": ("tab-separated table", "leaf_ze1", 25832, 1893, 1893, 190),
    "ZE0_Shift_P_D_ECO_N.log.gz": ("tab-separated table", "leaf_ze0", 12507, 1638, 1638, 163),
    "ZE0w24kWhstock.log.gz": ("tab-separated table", "leaf_ze0", 59966, 7781, 7781, 778),
    "env200-2015-with-40kWh-startup-nobridge.crtd.gz": (
        "CRTD (OVMS)",
        "leaf_aze0",
        55489,
        1911,
        1780,
        165,
    ),
    "leaf_2012_orig_start_stop.csv.gz": (
        "seconds, id, length, bytes",
        "leaf_ze0",
        9517,
        1245,
        1245,
        124,
    ),
}
LOSSY = "env200-2015-with-40kWh-startup-nobridge.crtd.gz"

# file: current [A] (positive = discharge), voltage [V], temperature [°C], SoC [%], as decoded
VALUES = {
    "10bars.csv.gz": ((7.0, 11.5), (372.5, 374.5), (10.0, 11.0), (79.7, 79.7)),
    "12bars95.csv.gz": ((-1.5, 3.0), (388.0, 390.0), (10.0, 10.0), (93.9, 94.0)),
    "62kWh-Battery-only-EVcan.txt.gz": ((0.0, 0.0), (388.5, 389.0), None, (86.6, 86.6)),
    "AZE0w40kWhv2.48.log.gz": ((0.0, 0.5), (400.5, 400.5), (-2.0, -2.0), (95.7, 95.7)),
    "EV-CANeplus2.log.gz": ((-40.0, 482.5), (367.5, 393.5), None, (93.0, 93.5)),
    "ZE0_Shift_P_D_ECO_N.log.gz": ((0.5, 11.5), (376.5, 378.5), (12.0, 12.0), (51.0, 51.1)),
    "ZE0w24kWhstock.log.gz": ((-2.0, 3.0), (385.0, 386.5), (2.0, 3.0), (75.1, 75.2)),
    LOSSY: ((0.0, 1.5), (360.0, 360.0), (19.0, 19.0), (59.9, 59.9)),
    "leaf_2012_orig_start_stop.csv.gz": ((-1.5, 3.5), (378.5, 380.0), (6.0, 6.0), (48.8, 48.9)),
}
WAKE_UP = {  # file: (currents, voltages) not available in 0x1DB
    "12bars95.csv.gz": (1, 4),
    "ZE0w24kWhstock.log.gz": (1, 4),
    "leaf_2012_orig_start_stop.csv.gz": (1, 4),
    LOSSY: (1, 16),
}
VEHICLES = {
    "leaf_ze0": Vehicle.load("leaf_ze0"),
    "leaf_aze0": Vehicle.load("leaf_aze0"),
    "leaf_ze1": Vehicle.load("leaf_ze1", temperature_c=20.0),
}


def vehicle_of(name: str) -> Vehicle:
    return VEHICLES[CAPTURES[name][1]]


@pytest.fixture
def folder(shared_data: Path) -> Path:
    return shared_data / "leaf_can"


def test_no_capture_is_forgotten(folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == set(CAPTURES)


@pytest.mark.parametrize("name", list(CAPTURES))
def test_every_frame_is_read_and_every_crc_agrees(folder: Path, name: str) -> None:
    kind, _, frames, *protected = CAPTURES[name]
    counts = dict.fromkeys((0x1DB, 0x1DC, 0x55B), 0)
    capture = open_capture(folder / name)
    for message in capture:
        if message.arbitration_id in counts:
            assert LEAF_RULE.crc(message.data) == message.data[7]
            counts[message.arbitration_id] += 1
    info = capture.info
    assert (info.format, info.frames, info.malformed, info.cut_off) == (kind, frames, 0, False)
    assert list(counts.values()) == protected


@pytest.mark.parametrize("name", list(CAPTURES))
def test_stamps_increase_and_0x1db_has_a_10_ms_period(folder: Path, name: str) -> None:
    capture = open_capture(folder / name)
    stamps = np.array([m.timestamp for m in capture if m.arbitration_id == 0x1DB])
    assert (np.diff(stamps) > 0.0).all()
    assert np.median(np.diff(stamps)) == pytest.approx(0.010, abs=0.0005)
    expected = {"tab-separated table": "ms", "candump without stamps": "none"}
    assert capture.stamps == expected.get(CAPTURES[name][0], "us")


@pytest.mark.parametrize("name", list(CAPTURES))
def test_values_are_those_of_the_car(folder: Path, name: str) -> None:
    log = capture_to_log(folder / name, vehicle_of(name))
    assert log.soc_pct is not None
    current, voltage, temperature, soc = VALUES[name]
    assert (log.current_a.min(), log.current_a.max()) == current
    assert (log.voltage_v.min(), log.voltage_v.max()) == voltage
    assert (log.temperature_c.min(), log.temperature_c.max()) == (temperature or (20.0, 20.0))
    found = (np.nanmin(log.soc_pct), np.nanmax(log.soc_pct))
    assert found == pytest.approx(soc, abs=1e-9)
    assert log.temperature_source == ("unknown" if temperature is None else "pack")


@pytest.mark.parametrize("name", list(CAPTURES))
def test_each_capture_matches_its_own_car_only(folder: Path, name: str) -> None:
    # In one capture a tester polls the battery: its replies have the temperature.
    wanted = "leaf_ze1_polled" if name == "EV-CANeplus2.log.gz" else CAPTURES[name][1]
    assert inspect_capture(folder / name).matching == (wanted,)


def test_other_protected_ids_are_found(
    folder: Path,
) -> None:
    found = {each.id: each for each in inspect_capture(folder / "10bars.csv.gz").ids}
    assert {name for name, each in found.items() if each.protection == "leaf"} == {
        "11A",
        "1D4",
        "1DA",
        "1DB",
        "1DC",
        "50C",
        "55B",
    }
    assert found["1DB"].counter_repeats == found["1DB"].frames_lost == 0
    assert found["1D4"].crc_errors == 0
    assert found["1D4"].counter_repeats is None  # its counter is in other bits
    assert found["50C"].counter_repeats is None


def test_jumps_with_valid_crcs_are_losses_not_refusals(folder: Path) -> None:
    samples = capture_samples(folder / LOSSY, vehicle_of(LOSSY))
    fate = samples.statistics.messages[0x1DB]
    assert (fate.wanted, fate.crc_errors, fate.counter_repeats) == (1911, 0, 0)
    assert fate.counter_jumps == 488
    # 89 counters repeat after 4 periods or more: 3 or more frames are missing there.
    assert fate.frames_lost == 787
    assert len(samples) == 1910  # one has no current


@pytest.mark.parametrize("name", [name for name in CAPTURES if name != LOSSY])
def test_the_other_captures_lost_nothing(folder: Path, name: str) -> None:
    counters = capture_samples(folder / name, vehicle_of(name)).statistics
    assert (counters.counter_jumps, counters.counter_repeats, counters.crc_errors) == (0, 0, 0)


@pytest.mark.parametrize("name", list(CAPTURES))
def test_codes_of_wake_up_never_become_values(folder: Path, name: str) -> None:
    currents, voltages = WAKE_UP.get(name, (0, 0))
    samples = capture_samples(folder / name, vehicle_of(name))
    fate = samples.statistics.messages[0x1DB]
    assert fate.not_available == currents + voltages
    assert len(samples) == CAPTURES[name][3] - currents
    assert np.count_nonzero(np.isnan(samples.voltage_v)) == voltages - currents
    assert np.abs(samples.current_a).max() < 511.0
    assert np.nanmax(samples.voltage_v) < 511.0


def test_maximum_energy_alternates_with_present_energy(folder: Path) -> None:
    leaf = load_dbc(shared_file("dbc", "nissan_leaf.dbc"))
    present, maximum = [], []
    for message in open_capture(folder / "EV-CANeplus2.log.gz"):
        if message.arbitration_id == 0x5BC:
            values = leaf.decode_message(0x5BC, bytes(message.data))
            present += [values["remaining_energy_wh"]] if "remaining_energy_wh" in values else []
            maximum += [values["maximum_energy_wh"]] if "maximum_energy_wh" in values else []
    assert len(present) == len(maximum) == 95
    assert set(maximum) == {60_000}
    assert 52_000 < min(present) <= max(present) < 54_000


def test_a_capture_decodes_the_same_frame_by_frame(folder: Path) -> None:
    """The log has the decoder's samples, bit for bit."""
    name = "10bars.csv.gz"
    decoder = SampleDecoder(vehicle_of(name))
    made = [s for m in open_capture(folder / name) if (s := decoder.handle(m)) is not None]
    log = capture_to_log(folder / name, vehicle_of(name))
    assert [each.time_s for each in made] == log.time_s.tolist()
    assert [each.current_a for each in made] == log.current_a.tolist()
    assert [each.voltage_v for each in made] == log.voltage_v.tolist()
    assert math.isnan(made[0].temperature_c)  # the first 0x5C0 comes later


def test_logs_are_no_captures(shared_data: Path) -> None:
    logs = [
        path
        for path in shared_data.rglob("*")
        if path.is_file()
        and path.parent.name not in {"leaf_can", "can_captures"}
        and path.suffix != ".md"
    ]
    assert len(logs) > 100
    assert [path.name for path in logs if is_capture(path)] == []


# file: its format, frames and duration [s]
OTHER_CARS = {
    "bmw_i3.log.gz": ("CAN Hacker log", 42089, 29.766),
    "bmw_i3_battery_only.trc.gz": ("CARBUS Analyzer trace", 1149, 7.460046),
    "bmw_i3_startcharge_gvret.csv.gz": ("SavvyCAN GVRET CSV", 80740, 58.082),
    "kona_2019_power_on_gvret.csv.gz": ("SavvyCAN GVRET CSV", 39546, 10.8404),
    "kona_2020_heating_gvret.csv.gz": ("SavvyCAN GVRET CSV", 27982, 23.935817),
}

# file: frames of 0x112, current [A] (positive charges), voltage [V], SoC [%]
I3_VALUES = {
    "bmw_i3.log.gz": (2972, (-9.8, 0.0), (375.7, 376.7), (43.7, 43.8)),
    "bmw_i3_battery_only.trc.gz": (747, (0.0, 0.0), (377.7, 377.7), (51.3, 51.3)),
    "bmw_i3_startcharge_gvret.csv.gz": (5794, (-13.4, 3.8), (389.1, 391.4), (77.0, 77.1)),
}


@pytest.mark.parametrize("name", list(OTHER_CARS))
def test_captures_of_other_cars_are_read_whole(shared_data: Path, name: str) -> None:
    capture = open_capture(shared_data / "can_captures" / name)
    times = [message.timestamp for message in capture]
    kind, frames, seconds = OTHER_CARS[name]
    assert (capture.info.format, capture.info.frames) == (kind, frames)
    assert (capture.info.malformed, capture.info.cut_off) == (0, False)
    assert times[-1] - times[0] == pytest.approx(seconds, abs=1e-6)


@pytest.mark.parametrize("name", list(I3_VALUES))
def test_captures_of_the_i3_decode(shared_data: Path, name: str) -> None:
    frames = [
        message
        for message in open_capture(shared_data / "can_captures" / name)
        if message.arbitration_id == 0x112
    ]
    raw = [int.from_bytes(message.data, "little") for message in frames]
    current_a = [(each & 0xFFFF) / 10 - 819.2 for each in raw if each & 0xFFFF != 0xFFFF]
    voltage_v = [(each >> 16 & 0xFFFF) / 10 for each in raw if each >> 16 & 0xFFFF != 0xFFFF]
    soc_pct = [(each >> 32 & 0xFFF) / 10 for each in raw if each >> 32 & 0xFFF != 0xFFF]
    count, current, voltage, soc = I3_VALUES[name]
    assert len(frames) == count
    assert (min(current_a), max(current_a)) == pytest.approx(current, abs=1e-9)
    assert (min(voltage_v), max(voltage_v)) == pytest.approx(voltage)
    assert (min(soc_pct), max(soc_pct)) == pytest.approx(soc)
    times = np.array([message.timestamp for message in frames])
    assert np.median(np.diff(times)) == pytest.approx(0.01, abs=1e-4)
