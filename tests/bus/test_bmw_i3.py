"""The BMW i3 preset on captures of the car: ranges, codes for no value, sign, no temperature."""

from __future__ import annotations

import numpy as np
import pytest

from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError

# file: frames used, current [A] (positive = discharge), voltage [V], SoC [%]


def test_a_temperature_must_be_given() -> None:
    with pytest.raises(InputError, match="--temperature"):
        Vehicle.load("bmw-i3")
    assert Vehicle.load("bmw-i3", temperature_c=21.0).fixed_temperature_c == 21.0


def test_codes_and_signs_of_a_frame() -> None:
    car = Vehicle.load("bmw_i3", temperature_c=20.0)
    payload = bytes.fromhex("ee1fb40eb571c55e")
    assert car.current.codec.decode(payload) == pytest.approx(1.8)
    assert car.voltage.codec.decode(payload) == pytest.approx(376.4)
    assert car.soc_reference is not None
    assert car.soc_reference.codec.decode(payload) == pytest.approx(43.7)
    asleep = bytes.fromhex("ffffffffff7ff5ff")
    assert np.isnan([each.codec.decode(asleep) for each in car.signals]).all()
