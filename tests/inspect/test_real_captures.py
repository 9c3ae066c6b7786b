"""Captures of real cars: every format, every CRC, plausible values."""

from __future__ import annotations

from pathlib import Path

import pytest

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


# file: its format, frames and duration [s]

# file: frames of 0x112, current [A] (positive charges), voltage [V], SoC [%]
