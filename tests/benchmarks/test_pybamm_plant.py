"""PyBaMM plant: parameter sets and faults."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.extras.validation.twin.condition import HEALTHY, Condition, WeakCells
from cangauge.extras.validation.twin.drive import Drive, draw_drive
from cangauge.extras.validation.twin.pack import draw_pack
from cangauge.extras.validation.twin.recording import simulate_truth
from pybamm_plant import PARAMETER_SETS, PybammPlant, draw_pybamm_plant
from selection import nightly_except

needs_pybamm = pytest.mark.skipif(
    importlib.util.find_spec("pybamm") is None, reason="pybamm is not installed"
)


@pytest.fixture(scope="module")
def plant() -> PybammPlant:
    rng = np.random.default_rng(5)
    return draw_pybamm_plant(rng, draw_pack(rng, "leaf40"), "Mohtat2020")


@pytest.fixture(scope="module")
def drive(plant: PybammPlant) -> Drive:
    return draw_drive(
        np.random.default_rng(6), plant.pack, hours=0.3, ambient_c=15.0, start_soc=0.6
    )


@needs_pybamm
@pytest.mark.parametrize("parameter_set", nightly_except(PARAMETER_SETS[:1], PARAMETER_SETS))
def test_every_parameter_set_simulates_a_drive(parameter_set: str) -> None:
    rng = np.random.default_rng(5)
    plant = draw_pybamm_plant(rng, draw_pack(rng, "leaf24"), parameter_set)
    drive = draw_drive(rng, plant.pack, hours=0.2, ambient_c=20.0, start_soc=0.7)
    truth = simulate_truth(plant, drive)
    assert truth.rows == drive.time_s.size
    # Near rest the voltage is the open-circuit voltage of the table.
    assert truth.voltage_v[0] + plant.pack.resistance_ohm * drive.current_a[0] == pytest.approx(
        truth.equilibrium_v[0], abs=3.0
    )
    # Fast changes of the current see the resistance.
    moved, answer = np.diff(drive.current_a), -np.diff(truth.voltage_v)
    slope = np.sum(moved * answer) / np.sum(moved**2)
    assert 0.4 < slope / plant.pack.resistance_ohm < 1.3


@needs_pybamm
def test_faults_change_the_voltage(plant: PybammPlant, drive: Drive) -> None:
    clean = simulate_truth(plant, drive)
    rms = {}
    for name, condition in (
        ("none", HEALTHY),
        ("capacity", Condition(capacity_factor=0.9)),
        ("kinetics", Condition(transfer_slowdown=1.0)),
        ("contact", Condition(step_ohm=0.02, step_at_s=300.0)),
        ("weak", Condition(weak=WeakCells(2, 0.3, 0.05))),
    ):
        gap = simulate_truth(plant, drive, condition, clean).voltage_v - clean.voltage_v
        rms[name] = float(np.sqrt(np.mean(gap**2)))
    assert rms["none"] < 1e-6
    assert all(size > 0.02 for name, size in rms.items() if name != "none")


@pytest.mark.skipif(importlib.util.find_spec("pybamm") is not None, reason="pybamm is installed")
def test_missing_extra_is_reported() -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(InputError, match="pip install pybamm"):
        draw_pybamm_plant(rng, draw_pack(rng))
