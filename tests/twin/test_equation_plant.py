"""Equation plant: it obeys the published equation while healthy, and shows every fault."""

from __future__ import annotations

import numpy as np
import pytest
from test_faults import demanding_drive_of

from cangauge.extras.validation import simulate
from cangauge.extras.validation.twin.faults import Fault, fault_kind, fault_kinds
from cangauge.extras.validation.twin.recording import record_drive, rms
from cangauge.identify.fit import fit
from selection import nightly_except

FAULTS = [kind.id for kind in fault_kinds()]
IN_SUITE = ("current_offset", "hysteresis")


def test_healthy_log_is_fitted_to_the_sensor_floor() -> None:
    full = simulate(seed=8, pack="leaf40", plant="equation", discharge=True)
    capacity_ah = full.plant.pack.capacity_ah
    fitted = fit([full.recording.log], capacity_ah=capacity_ah, equation="published")
    assert fitted.voltage_rmse_v < 1.3 * rms(full.recording.sensor_error_v)
    assert np.all(np.diff(full.plant.pack.chemistry.ocv_table_v) > 0.0)


@pytest.mark.parametrize("fault_id", nightly_except(IN_SUITE, FAULTS))
def test_every_fault_opens_a_gap(fault_id: str) -> None:
    plant = simulate(seed=8, pack="leaf40", plant="equation", hours=0.1).plant
    drive = demanding_drive_of(plant.pack)
    _, largest = fault_kind(fault_id).limits(plant.pack)
    recording = record_drive(plant, drive, (Fault(fault_id, largest, seed=2),))
    assert rms(recording.gap_v) > 0.002
