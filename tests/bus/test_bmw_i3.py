"""The BMW i3 preset on captures of the car: ranges, codes for no value, sign, no temperature."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cangauge.bus.recording import capture_to_log
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.inspect.capture import inspect_capture

# file: frames used, current [A] (positive = discharge), voltage [V], SoC [%]
CAPTURES = {
    "bmw_i3.log.gz": ((0.0, 9.8), (375.7, 376.7), (43.7, 43.8)),
    "bmw_i3_battery_only.trc.gz": ((0.0, 0.0), (377.7, 377.7), (51.3, 51.3)),
    "bmw_i3_startcharge_gvret.csv.gz": ((-3.8, 13.4), (389.1, 391.4), (77.0, 77.1)),
}


def test_a_temperature_must_be_given() -> None:
    with pytest.raises(InputError, match="--temperature"):
        Vehicle.load("bmw-i3")
    assert Vehicle.load("bmw-i3", temperature_c=21.0).fixed_temperature_c == 21.0


def test_codes_and_signs_of_a_frame() -> None:
    car = Vehicle.load("bmw_i3", temperature_c=20.0)
    payload = bytes.fromhex("ee1fb40eb571c55e")
    assert car.current.decode(payload) == pytest.approx(1.8)
    assert car.voltage.decode(payload) == pytest.approx(376.4)
    assert car.soc_reference is not None
    assert car.soc_reference.decode(payload) == pytest.approx(43.7)
    asleep = bytes.fromhex("ffffffffff7ff5ff")
    assert np.isnan([each.decode(asleep) for each in car.signals]).all()


@pytest.mark.real
@pytest.mark.parametrize("name", list(CAPTURES))
def test_values_are_those_of_the_car(shared_data: Path, name: str) -> None:
    car = Vehicle.load("bmw_i3", temperature_c=20.0)
    log = capture_to_log(shared_data / "can_captures" / name, car)
    current, voltage, soc = CAPTURES[name]
    assert (log.current_a.min(), log.current_a.max()) == pytest.approx(current, abs=1e-9)
    assert (log.voltage_v.min(), log.voltage_v.max()) == pytest.approx(voltage, abs=1e-9)
    assert log.soc_pct is not None
    assert (np.nanmin(log.soc_pct), np.nanmax(log.soc_pct)) == pytest.approx(soc, abs=1e-9)


@pytest.mark.real
@pytest.mark.parametrize("name", list(CAPTURES))
def test_only_the_i3_preset_matches(shared_data: Path, name: str) -> None:
    assert inspect_capture(shared_data / "can_captures" / name).matching == ("bmw_i3",)
