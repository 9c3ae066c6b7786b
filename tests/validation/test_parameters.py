"""True faults in the terms of the diagnosis: unit and sign of every one, by what they do.

The diagnosis is not asked. The twin records a day with and without a fault; with the effect and
the mapped parameters, the model must see on the faulty day what it sees on the clean one.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cangauge.logs.log import Log
from cangauge.model.effects.base import Signals
from cangauge.model.effects.library import LIBRARY
from cangauge.model.extended import ExtendedModel
from cangauge.validation.cases import identify
from cangauge.validation.score import COMPARABLE, expected_parameters
from cangauge.validation.twin.case import CaseOptions
from cangauge.validation.twin.day import Day
from cangauge.validation.twin.faults import Fault, fault_kinds
from cangauge.validation.twin.world import World, record_day, rms

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
def world() -> World:
    return CaseOptions(kind="leaf24", climate="mild", chemistry_name="nmc").draw_world(12)


@pytest.fixture(scope="module")
def model(world: World) -> ExtendedModel:
    logs = [recording.log for recording in (*world.training, *world.references)]
    return identify(logs, world.pack.capacity_ah).model.extended_model()


@pytest.fixture(scope="module")
def day(world: World) -> Day:
    return world.draw_days(np.random.default_rng(3), 1, hours=1.5)[0]


def errors_v(model: ExtendedModel, log: Log) -> NDArray[np.float64]:
    start = log.first_soc()
    assert start is not None
    signals = Signals(log.time_s, log.current_a, log.voltage_v, log.temperature_c)
    rows = np.flatnonzero(log.time_s - log.time_s[0] >= 70.0)
    return model.predict(signals, start[1], rows, anchor_row=start[0]).residual_v


def test_all_comparable_faults_are_mapped_and_no_others() -> None:
    assert set(COMPARABLE) == {kind.id for kind in fault_kinds() if kind.physical} == set(SIZES)
    assert expected_parameters({"id": "hysteresis", "size": 1.0, "shape": {}}) == {}


@pytest.mark.parametrize("effect", SIZES)
def test_the_mapped_parameters_take_the_fault_out(
    effect: str, world: World, model: ExtendedModel, day: Day
) -> None:
    shape = {"at_s": 1500.0} if effect == "resistance_step" else {}
    fault = Fault(effect, SIZES[effect], shape)
    clean = record_day(world.plant, day, ()).log
    faulty = record_day(world.plant, day, (fault,)).log
    values = expected_parameters({"id": effect, "size": fault.size, "shape": fault.full_shape()})
    library = LIBRARY[effect]
    assert set(values) == {parameter.name for parameter in library.parameters}
    rows = min(len(clean), len(faulty))
    seen = errors_v(model, clean)[: rows - 1200]

    def away(parameters: dict[str, float] | None) -> float:
        known = model if parameters is None else model.with_effect(library, parameters)
        return rms(errors_v(known, faulty)[: seen.size] - seen)

    turned = {
        name: (2.0 - value if name == "efficiency" else value if name == "start_s" else -value)
        for name, value in values.items()
    }
    assert away(values) < 0.45 * away(None)
    assert away(turned) > 1.3 * away(None)
