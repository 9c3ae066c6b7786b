"""Swapped voltage and temperature are distinguished from a temperature in kelvin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.logs.units import follows_current
from synthetic import synthetic_log


def drive() -> Log:
    return synthetic_log(hours=0.3, start_pct=80.0, end_pct=72.0, noise_v=0.2)


def steady(volts: float) -> Log:
    """A cycler's discharge at constant current, with warming cells."""
    log = synthetic_log(hours=0.5, start_pct=80.0, end_pct=55.0)
    falling = np.linspace(1.02, 0.95, len(log))
    return replace(
        log,
        current_a=np.full(len(log), 50.0),
        voltage_v=volts * falling,
        temperature_c=np.linspace(24.0, 33.0, len(log)),
    )


def swapped(log: Log) -> Log:
    return replace(log, voltage_v=log.temperature_c, temperature_c=log.voltage_v)


def in_kelvin(log: Log) -> Log:
    return replace(log, temperature_c=log.temperature_c + 273.15)


def refusal(log: Log, folder: Path) -> InputError:
    write_log(log, folder / "log.csv")
    with pytest.raises(InputError) as caught:
        read_log(folder / "log.csv")
    return caught.value


@pytest.mark.parametrize(
    "log",
    [
        pytest.param(drive(), id="drive"),
        pytest.param(replace(drive(), temperature_c=drive().temperature_c - 23.0), id="freezing"),
        pytest.param(replace(drive(), temperature_c=drive().temperature_c - 40.0), id="winter"),
        pytest.param(replace(drive(), temperature_c=np.full(len(drive()), 20.0)), id="constant"),
        pytest.param(replace(drive(), voltage_v=2.0 * drive().voltage_v), id="800 V"),
        pytest.param(replace(drive(), voltage_v=1e3 * drive().voltage_v), id="millivolts"),
        pytest.param(replace(drive(), voltage_v=0.6 * drive().voltage_v), id="200 V"),
        pytest.param(replace(drive(), current_a=-drive().current_a), id="turned current"),
        pytest.param(steady(390.0), id="constant current"),
        pytest.param(steady(700.0), id="constant current, 800 V"),
    ],
)
def test_swapped_columns_are_refused(log: Log, tmp_path: Path) -> None:
    error = refusal(swapped(log), tmp_path)
    assert error.field == "temperature_c"
    assert error.value == pytest.approx(float(np.median(log.voltage_v)))
    assert "looks like a pack's voltage, and voltage_v like a temperature" in str(error)
    assert "the two columns (or signals) look swapped" in str(error)
    assert "kelvin" not in str(error)
    assert "273" not in str(error)


@pytest.mark.parametrize("volts", [3.7, 24.0, 48.0, 380.0, 700.0])
def test_kelvin_stays_kelvin_whatever_the_battery(volts: float, tmp_path: Path) -> None:
    log = drive()
    log = replace(log, voltage_v=log.voltage_v * volts / np.median(log.voltage_v))
    error = refusal(in_kelvin(log), tmp_path)
    assert (error.problem, error.cure) == ("temperature looks like kelvin", "subtract 273.15")


def test_without_a_varying_current_both_cures_are_named(tmp_path: Path) -> None:
    """300 and 24, almost constant: a module in kelvin, or an empty pack with swapped columns."""
    for log in (in_kelvin(steady(24.0)), swapped(steady(300.0))):
        error = refusal(log, tmp_path)
        assert error.problem == "temperature looks like kelvin"
        assert error.cure is not None
        assert error.cure.startswith("subtract 273.15, or exchange it with the voltage")
    error = refusal(in_kelvin(steady(390.0)), tmp_path)
    assert error.cure == "subtract 273.15"


def test_a_second_voltage_in_place_of_the_temperature(tmp_path: Path) -> None:
    log = drive()
    error = refusal(
        replace(log, temperature_c=log.voltage_v, voltage_v=log.voltage_v / 96), tmp_path
    )
    assert "moves when the current does, as a voltage" in str(error)
    assert "which column (or signal) is the temperature" in str(error)


def test_a_code_is_no_voltage(tmp_path: Path) -> None:
    log = replace(steady(3.7), temperature_c=np.full(len(steady(3.7)), 128.0))
    assert refusal(log, tmp_path).problem == "this is not a battery's temperature in °C"


def test_a_few_wrong_rows_do_not_decide() -> None:
    log = drive()
    voltage = log.voltage_v.copy()
    voltage[::50] = 6553.5
    assert follows_current(log.current_a, voltage)
    assert not follows_current(log.current_a, log.temperature_c)
    assert not follows_current(log.current_a[:15], log.voltage_v[:15])
    assert not follows_current(np.full(100, 5.0), np.arange(100.0))


@pytest.mark.real
@pytest.mark.parametrize("trip", ["TripA05", "TripB06"])
def test_a_real_trip(trip: str, shared_data: Path, tmp_path: Path) -> None:
    log = read_log(shared_data / "bmw_i3" / f"{trip}.csv.gz")
    assert "look swapped" in str(refusal(swapped(log), tmp_path))
    assert refusal(in_kelvin(log), tmp_path).cure == "subtract 273.15"


@pytest.mark.real
def test_a_real_cell_in_kelvin(shared_data: Path, tmp_path: Path) -> None:
    log = read_log(shared_data / "lg_hg2" / "25degC__551_US06.parquet")
    assert refusal(in_kelvin(log), tmp_path).cure == "subtract 273.15"
