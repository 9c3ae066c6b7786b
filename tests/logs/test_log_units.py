"""Wrong units are recognised from the values of any battery; correct ones pass."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cangauge.errors import InputError
from cangauge.logs.draft import DraftLog
from cangauge.logs.log import Log
from cangauge.logs.units import convert, refuse_wrong_units


def drive(
    *, voltage_v: float = 380.0, peak_a: float = 100.0, interval_s: float = 0.1
) -> dict[str, np.ndarray]:
    rows = 3000
    time = np.arange(rows) * interval_s
    current = peak_a * np.sin(np.arange(rows) / 40.0) + 0.1 * peak_a
    return {
        "time_s": time,
        "current_a": current,
        "voltage_v": voltage_v * (1.0 - 0.02 * current / peak_a),
        "temperature_c": np.full(rows, 20.0),
        "soc_pct": np.linspace(80.0, 70.0, rows),
    }


def checked(values: dict[str, np.ndarray]) -> tuple[str, ...]:
    return Log(**DraftLog("drive", "drive.csv", values).checked()).remarks


@settings(max_examples=50)
@given(
    voltage_v=st.floats(1.2, 1000.0),
    peak_a=st.floats(0.05, 1700.0),
    interval_s=st.sampled_from([0.01, 0.1, 1.0, 10.0]),
)
def test_cells_and_packs_pass(voltage_v: float, peak_a: float, interval_s: float) -> None:
    assert checked(drive(voltage_v=voltage_v, peak_a=peak_a, interval_s=interval_s)) == ()


@pytest.mark.parametrize(
    ("field", "wrong", "words", "cure"),
    [
        ("voltage_v", lambda v: v * 1000.0, "millivolts", "1000"),
        ("voltage_v", lambda v: v / 1000.0, "kilovolts", "volts"),
        ("voltage_v", lambda v: -v, "median voltage is not positive", "polarity"),
        ("current_a", lambda v: v * 1000.0, "milliamperes", "1000"),
        ("temperature_c", lambda v: v + 273.15, "kelvin", "273.15"),
        ("temperature_c", lambda v: v * 30.0, "not a battery's temperature", "°C"),
        ("time_s", lambda v: v * 1000.0, "milliseconds", "1000"),
        ("time_s", lambda v: 1.7e12 + v * 1000.0, "milliseconds since 1970", "1000"),
        ("time_s", lambda v: v / 3600.0, "hours or days", "seconds"),
        ("soc_pct", lambda v: v / 100.0, "fraction of 1", "100"),
        ("soc_pct", lambda v: v * 100.0, "not within 0–100 %", "%"),
    ],
)
def test_a_wrong_unit_names_field_value_and_cure(
    field: str, wrong: object, words: str, cure: str
) -> None:
    values = drive()
    values[field] = wrong(values[field])  # type: ignore[operator]  # a parameter of the test
    with pytest.raises(InputError, match=words) as caught:
        checked(values)
    error = caught.value
    assert (error.source, error.field) == ("drive.csv", field)
    assert error.value is not None
    assert cure in (error.cure or "")


def test_a_fast_log_in_milliseconds_is_known_by_its_charge() -> None:
    """100 Hz in ms looks like rows every 10 s, but moves hours of the peak current."""
    values = drive(interval_s=0.01)
    values["time_s"] = np.rint(np.arange(200_000) * 10.0)
    values["current_a"] = np.where(np.arange(200_000) % 1000 < 200, 150.0, 10.0)
    values["voltage_v"] = 380.0 - 0.1 * values["current_a"]
    values["temperature_c"] = np.full(200_000, 20.0)
    del values["soc_pct"]
    with pytest.raises(InputError, match="time looks like milliseconds"):
        checked(values)


def test_weeks_of_a_parked_cars_drain_pass() -> None:
    rows = 40_000  # four weeks, a row every minute
    values = {
        "time_s": np.arange(rows) * 60.0,
        "current_a": np.full(rows, 0.03) + 0.001 * (np.arange(rows) % 2),
        "voltage_v": np.linspace(12.9, 12.5, rows),
        "temperature_c": np.full(rows, 5.0),
    }
    assert checked(values) == ()


def test_a_cell_in_millivolts_and_a_pack_code_for_not_available() -> None:
    with pytest.raises(InputError, match="millivolts"):
        checked(drive(voltage_v=3700.0))
    values = drive()
    values["voltage_v"][7] = 6553.5
    with pytest.raises(InputError, match="row 8 is not a battery's voltage"):
        checked(values)
    values = drive()
    values["temperature_c"][7] = 215.0
    with pytest.raises(InputError, match="row 8 is not a battery's temperature"):
        checked(values)
    values = drive()
    values["current_a"][7] = 3276.7
    with pytest.raises(InputError, match="row 8 is not a battery's current"):
        checked(values)


def test_degrees_fahrenheit_are_suspected() -> None:
    values = drive()
    values["temperature_c"] = np.full(3000, 68.0)
    assert "°F" in checked(values)[0]


@pytest.mark.parametrize(
    ("field", "unit", "stored", "canonical"),
    [
        ("time_s", "ms", 1500.0, 1.5),
        ("time_s", "min", 2.0, 120.0),
        ("current_a", "mA", -250.0, -0.25),
        ("voltage_v", "mV", 3700.0, 3.7),
        ("temperature_c", "K", 300.0, 26.85),
        ("temperature_c", "°F", 212.0, 100.0),
        ("temperature_c", "degC", 21.0, 21.0),
        ("soc_pct", "-", 0.5, 50.0),
        ("voltage_v", "", 380.0, 380.0),
    ],
)
def test_units_that_a_heading_states(
    field: str, unit: str, stored: float, canonical: float
) -> None:
    values, _ = convert(np.array([stored]), field, unit, source="x", label="X")
    assert values[0] == pytest.approx(canonical)


def test_an_unknown_unit_lists_the_known_ones() -> None:
    with pytest.raises(
        InputError, match=r"x: V x \[kelvin\].*\(got 'kelvin'\).*v, volt, volts, mv"
    ):
        convert(np.ones(1), "voltage_v", "kelvin", source="x", label="V x [kelvin]")


def test_a_capture_of_a_fast_replay_is_not_in_hours() -> None:
    values = drive()
    values["time_s"] = values["time_s"] / 3600.0
    assert refuse_wrong_units(values, source="a.log", labels={}, in_seconds=True) == ()
