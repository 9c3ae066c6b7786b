"""Fault sizes as parameters of effects: unit and sign of each, without a diagnosis.

The twin records a drive with and without a fault. With the effect and the mapped parameters, the
model must have the same residual on both.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cangauge.extras.validation.cases import CaseOptions, Scenario
from cangauge.extras.validation.score import COMPARABLE, expected_parameters
from cangauge.extras.validation.twin.drive import Drive
from cangauge.extras.validation.twin.faults import Fault, fault_kinds
from cangauge.extras.validation.twin.recording import record_drive, rms
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.effects.base import Signals
from cangauge.model.effects.library import LIBRARY
from cangauge.model.extended import ExtendedModel

SIZES = {
    "current_offset": 4.0,
    "current_gain": 0.08,
    "voltage_offset": 3.0,
    "voltage_gain": 0.01,
    "time_skew": 0.8,
    "capacity": 0.10,
    "initial_soc": -5.0,
    "coulombic_efficiency": 0.08,
    "resistance_asymmetry": 0.06,
    "resistance_step": 0.06,
}


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return CaseOptions(kind="leaf24", climate="mild", chemistry_name="nmc").draw_scenario(12)


@pytest.fixture(scope="module")
def model(scenario: Scenario) -> ExtendedModel:
    logs = [recording.log for recording in (*scenario.training, *scenario.references)]
    return fit(logs, capacity_ah=scenario.pack.capacity_ah).model.extended_model()


@pytest.fixture(scope="module")
def drive(scenario: Scenario) -> Drive:
    return scenario.draw_drives(np.random.default_rng(3), 1, hours=1.5)[0]


def errors_v(model: ExtendedModel, log: Log) -> NDArray[np.float64]:
    start = log.first_soc()
    assert start is not None
    signals = Signals(log.time_s, log.current_a, log.voltage_v, log.temperature_c)
    rows = np.flatnonzero(log.time_s - log.time_s[0] >= 70.0)
    return model.predict(signals, start[1], rows, initial_row=start[0]).residual_v


def test_comparable_faults_are_mapped() -> None:
    assert set(COMPARABLE) == {kind.id for kind in fault_kinds() if kind.comparable} == set(SIZES)
    assert expected_parameters({"id": "hysteresis", "size": 1.0, "shape": {}}) == {}


@pytest.mark.parametrize("effect", SIZES)
def test_mapped_parameters_remove_the_fault(
    effect: str, scenario: Scenario, model: ExtendedModel, drive: Drive
) -> None:
    shape = {"at_s": 1500.0} if effect == "resistance_step" else {}
    fault = Fault(effect, SIZES[effect], shape)
    clean = record_drive(scenario.plant, drive, ()).log
    faulty = record_drive(scenario.plant, drive, (fault,)).log
    values = expected_parameters({"id": effect, "size": fault.size, "shape": fault.full_shape()})
    library = LIBRARY[effect]
    assert set(values) == {parameter.name for parameter in library.parameters}
    rows = min(len(clean), len(faulty))
    healthy = errors_v(model, clean)[: rows - 1200]

    def away(parameters: dict[str, float] | None) -> float:
        known = model if parameters is None else model.with_effect(library, parameters)
        return rms(errors_v(known, faulty)[: healthy.size] - healthy)

    opposite = {
        name: (2.0 - value if name == "efficiency" else value if name == "start_s" else -value)
        for name, value in values.items()
    }
    assert away(values) < 0.45 * away(None)
    assert away(opposite) > 1.3 * away(None)
