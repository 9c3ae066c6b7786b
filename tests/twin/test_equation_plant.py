"""The plant of the published form: healthy it obeys the equation, and every fault shows."""

from __future__ import annotations

import numpy as np
import pytest

from cangauge.validation.cases import identify
from cangauge.validation.twin.faults import Fault, fault_kind, fault_kinds
from cangauge.validation.twin.simulate import Truth, simulate
from cangauge.validation.twin.world import World, draw_world, record_day, rms


@pytest.fixture(scope="module")
def world() -> World:
    return draw_world(8, kind="leaf40", plant_name="equation")


@pytest.fixture(scope="module")
def healthy(world: World) -> Truth:
    return simulate(world.plant, world.reference_days[0])


def test_a_healthy_log_is_explained_to_the_sensors_floor(world: World) -> None:
    training = world.training[0]
    fitted = identify([training.log], world.pack.capacity_ah)
    assert fitted.voltage_rmse_v < 1.3 * rms(training.floor_v)


def test_a_gauge_that_knows_the_core_sees_every_clean_day_explained() -> None:
    world = draw_world(8, kind="leaf40", plant_name="published")
    clean = (*world.training, *world.references)
    fitted = identify([recording.log for recording in clean], world.pack.capacity_ah)
    floor_v = rms(np.concatenate([recording.floor_v for recording in clean]))
    assert fitted.voltage_rmse_v < 1.05 * floor_v


def test_a_core_that_sheds_its_heat_worse_shows_there_too() -> None:
    world = draw_world(8, kind="leaf40", plant_name="published")
    day = world.reference_days[0]
    fault = Fault("core_temperature", 5.0, seed=2)
    recording = record_day(world.plant, day, (fault,))
    assert rms(recording.gap_v) > 0.1


def test_the_open_circuit_voltage_rises_from_below_empty_to_above_full(world: World) -> None:
    assert np.all(np.diff(world.pack.chemistry.ocv_table_v) > 0.0)


@pytest.mark.parametrize("fault_id", [kind.id for kind in fault_kinds()])
def test_every_named_fault_shows(fault_id: str, world: World, healthy: Truth) -> None:
    _, largest = fault_kind(fault_id).limits(world.pack)
    fault = Fault(fault_id, largest, seed=2)
    recording = record_day(world.plant, world.reference_days[0], (fault,), healthy=healthy)
    assert rms(recording.gap_v) > 0.002
