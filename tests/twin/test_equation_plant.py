"""Equation plant: it obeys the published equation while healthy, and shows every fault."""

from __future__ import annotations

import numpy as np
import pytest

from cangauge.extras.validation.cases import Scenario, draw_scenario
from cangauge.extras.validation.twin.faults import Fault, fault_kind, fault_kinds
from cangauge.extras.validation.twin.recording import GroundTruth, record_drive, rms, simulate_truth
from cangauge.identify.fit import fit
from selection import nightly_except

FAULTS = [kind.id for kind in fault_kinds()]
IN_SUITE = ("current_offset", "hysteresis")


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return draw_scenario(8, kind="leaf40", plant_name="equation")


@pytest.fixture(scope="module")
def healthy(scenario: Scenario) -> GroundTruth:
    return simulate_truth(scenario.plant, scenario.reference_drives[0])


def test_healthy_log_is_fitted_to_the_sensor_floor(scenario: Scenario) -> None:
    training = scenario.training[0]
    fitted = fit([training.log], capacity_ah=scenario.pack.capacity_ah, equation="published")
    assert fitted.voltage_rmse_v < 1.3 * rms(training.sensor_error_v)


def test_reported_core_fits_all_logs_to_the_floor() -> None:
    scenario = draw_scenario(8, kind="leaf40", plant_name="published")
    clean = (*scenario.training, *scenario.references)
    logs = [recording.log for recording in clean]
    fitted = fit(logs, capacity_ah=scenario.pack.capacity_ah, equation="published")
    sensor_floor_v = rms(np.concatenate([recording.sensor_error_v for recording in clean]))
    assert fitted.voltage_rmse_v < 1.05 * sensor_floor_v


def test_core_fault_shows_with_reported_core() -> None:
    scenario = draw_scenario(8, kind="leaf40", plant_name="published")
    drive = scenario.reference_drives[0]
    fault = Fault("core_temperature", 5.0, seed=2)
    recording = record_drive(scenario.plant, drive, (fault,))
    assert rms(recording.gap_v) > 0.1


def test_open_circuit_voltage_is_monotone(scenario: Scenario) -> None:
    assert np.all(np.diff(scenario.pack.chemistry.ocv_table_v) > 0.0)


@pytest.mark.parametrize("fault_id", nightly_except(IN_SUITE, FAULTS))
def test_every_fault_opens_a_gap(fault_id: str, scenario: Scenario, healthy: GroundTruth) -> None:
    _, largest = fault_kind(fault_id).limits(scenario.pack)
    fault = Fault(fault_id, largest, seed=2)
    recording = record_drive(
        scenario.plant, scenario.reference_drives[0], (fault,), healthy=healthy
    )
    assert rms(recording.gap_v) > 0.002
