"""The Kona's preset on its recorded power-on: `hyundai_kona_64` expects 98 cells at 36 %."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cangauge import read_log
from cangauge.bus.vehicle import Vehicle
from cangauge.inspect.capture import inspect_capture


@pytest.mark.real
def test_the_voltage_falls_with_the_current(shared_data: Path) -> None:
    path = shared_data / "can_captures" / "kona_2019_power_on_gvret.csv.gz"
    log = read_log(path, vehicle=Vehicle.load("hyundai_kona_64", temperature_c=20.0))
    assert log.current_a.min() == 0.0
    assert log.current_a.max() == pytest.approx(3.4)
    assert np.all((log.voltage_v / 98 > 3.55) & (log.voltage_v / 98 < 3.70))
    slope_ohm = np.polyfit(log.current_a, log.voltage_v, 1)[0]
    assert -0.2 < slope_ohm < -0.02  # a pack of 64 kWh; positive current discharges


@pytest.mark.real
def test_it_is_recognised_and_no_other_capture_is_taken_for_it(shared_data: Path) -> None:
    for name in ("kona_2019_power_on_gvret.csv.gz", "bmw_i3_battery_only.trc.gz"):
        path = shared_data / "can_captures" / name
        matches = [each.preset for each in inspect_capture(path).presets if each.matches]
        is_kona = path.name.startswith("kona_2019")
        assert ("hyundai_kona_64" in matches) is is_kona, path.name
