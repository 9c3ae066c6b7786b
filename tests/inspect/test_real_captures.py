"""Captures of real cars: each matches its own preset; protected ids are found."""

from __future__ import annotations

from pathlib import Path

import pytest

from cangauge.inspect.capture import inspect_capture
from selection import nightly_except

pytestmark = pytest.mark.real

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


@pytest.mark.parametrize("name", nightly_except(IN_SUITE, PRESETS))
def test_each_capture_matches_its_own_car_only(shared_data: Path, name: str) -> None:
    assert inspect_capture(shared_data / "leaf_can" / name).matching == (PRESETS[name],)


def test_other_protected_ids_are_found(shared_data: Path) -> None:
    ids = inspect_capture(shared_data / "leaf_can" / "10bars.csv.gz").ids
    found = {each.id: each for each in ids}
    protected = {name for name, each in found.items() if each.protection == "leaf"}
    assert protected == {"11A", "1D4", "1DA", "1DB", "1DC", "50C", "55B"}
    assert found["1DB"].counter_repeats == found["1DB"].frames_lost == 0
    assert found["1D4"].crc_errors == 0
    assert found["1D4"].counter_repeats is None  # its counter is in other bits
    assert found["50C"].counter_repeats is None
