"""Physics of the clean plant: charge, energy, heat, relaxation, temperature, repeatability."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lsim

from cangauge.validation.twin.condition import HEALTHY
from cangauge.validation.twin.day import Day, draw_day
from cangauge.validation.twin.pack import KINDS, Pack, draw_pack
from cangauge.validation.twin.plant import TwinPlant, lagged, relax, temperatures
from cangauge.validation.twin.simulate import simulate, true_soc_pct


def constant_day(
    current_a: np.ndarray, *, start_soc: float = 0.6, celsius: float = 25.0, step_s: float = 0.5
) -> Day:
    """A day of one given current, at one temperature."""
    time_s = np.arange(current_a.size) * step_s
    return Day(time_s, current_a, np.full_like(time_s, celsius), celsius, start_soc, seed=1)


def test_charge_is_the_integral_of_the_current(plant: TwinPlant, day: Day) -> None:
    truth = simulate(plant, day)
    moved_ah = np.trapezoid(truth.current_a, truth.time_s) / 3600.0
    soc = true_soc_pct(plant.pack, day, truth, HEALTHY)
    assert soc[0] - soc[-1] == pytest.approx(100.0 * moved_ah / plant.pack.capacity_ah, rel=1e-9)
    # The mean of the cells agrees, but for their spread in capacity.
    assert truth.soc[-1] == pytest.approx(soc[-1] / 100.0, abs=2e-3)


def test_chemical_energy_is_work_plus_heat(plant: TwinPlant, day: Day) -> None:
    truth = simulate(plant, day)
    step = day.step_s
    chemical = np.sum(truth.equilibrium_v * truth.current_a) * step
    work = np.sum(truth.voltage_v * truth.current_a) * step
    kelvin = truth.core_c + 273.15
    soc = plant.pack.chemistry.entropy(truth.soc)
    reversible = -np.sum(truth.current_a * kelvin * plant.pack.cells * soc) * step
    heat = np.sum(truth.heat_w) * step
    assert chemical - work == pytest.approx(heat - reversible, rel=0.01)
    assert 0.005 * work < chemical - work < 0.2 * work


def test_heat_goes_into_the_pack_or_out_of_it(pack: Pack, day: Day) -> None:
    truth = simulate(TwinPlant(pack), day)
    core, surface = temperatures(pack, day, truth.heat_w)
    assert np.max(np.abs(core - truth.core_c)) < 0.05  # temperatures and heat agree
    stored = pack.core_j_k * (core[-1] - core[0]) + pack.surface_j_k * (surface[-1] - surface[0])
    lost = np.sum(pack.surface_ambient_w_k * (surface - day.ambient_c)) * day.step_s
    made = np.sum(truth.heat_w) * day.step_s
    assert day.conditioning_w == 0.0
    assert stored + lost == pytest.approx(made, rel=0.01)


def test_a_pulse_drops_relaxes_and_comes_back(plant: TwinPlant) -> None:
    current = np.zeros(7200)
    current[200:1400] = plant.pack.one_c_a
    truth = simulate(plant, constant_day(current))
    volts = truth.voltage_v
    rest, at_once, later = volts[199], volts[202], volts[1399]
    assert rest - at_once == pytest.approx(plant.pack.resistance_ohm * plant.pack.one_c_a, rel=0.35)
    assert later < at_once - 0.2  # diffusion and charge go on
    after = volts[[1402, 1600, 2400, 7199]]
    assert np.all(np.diff(after) > -1e-3)
    assert volts[-1] == pytest.approx(truth.equilibrium_v[-1], abs=0.05)


def test_resistance_at_minus_ten_is_some_times_that_at_25(plant: TwinPlant) -> None:
    current = np.zeros(200)
    current[100:] = 0.5 * plant.pack.one_c_a

    def drop(celsius: float) -> float:
        volts = simulate(plant, constant_day(current, celsius=celsius)).voltage_v
        return float(volts[99] - volts[119])

    assert 1.8 < drop(-10.0) / drop(25.0) < 6.0
    assert drop(35.0) < drop(25.0)


def test_kinetics_are_milder_than_a_resistance_at_high_current(plant: TwinPlant) -> None:
    def drop(amperes: float) -> float:
        current = np.zeros(60)
        current[20:] = amperes
        volts = simulate(plant, constant_day(current, celsius=0.0)).voltage_v
        return float(volts[19] - volts[24])

    one_c = plant.pack.one_c_a
    assert drop(3.0 * one_c) < 0.99 * 3.0 * drop(one_c)
    assert drop(one_c) > 0.0 > drop(-one_c)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_pack_drives_within_its_voltage(kind: str) -> None:
    rng = np.random.default_rng(11)
    pack = draw_pack(rng, kind)
    day = draw_day(rng, pack, hours=0.6)
    truth = simulate(TwinPlant(pack), day)
    rows = slice(0, truth.rows)
    cell_v = truth.voltage_v[rows] / pack.cells
    assert np.all((cell_v > 2.0) & (cell_v < 4.4))
    assert np.all(np.abs(truth.current_a) < 4.5 * pack.one_c_a)
    assert np.all((truth.core_c > -15.0) & (truth.core_c < 60.0))


def test_the_same_seed_gives_the_same_numbers_and_another_does_not() -> None:
    def run(seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        pack = draw_pack(rng, "compact")
        return simulate(TwinPlant(pack), draw_day(rng, pack, hours=0.3)).voltage_v

    assert np.array_equal(run(5), run(5))
    assert not np.array_equal(run(5), run(6))


def test_two_and_a_half_hours_take_less_than_two_seconds(plant: TwinPlant) -> None:
    rng = np.random.default_rng(2)
    day = draw_day(rng, plant.pack, hours=2.5, start_soc=1.0, end_soc=0.02, discharge=True)
    began = time.perf_counter()
    simulate(plant, day)
    assert time.perf_counter() - began < 2.0  # about 0.1 s on the machine that it was written on


@settings(deadline=None)
@given(st.floats(0.2, 500.0), st.floats(0.1, 1.0), st.integers(0, 1000))
def test_relaxation_agrees_with_the_exact_solution_of_scipy(
    tau_s: float, step_s: float, seed: int
) -> None:
    signal = np.random.default_rng(seed).normal(0.0, 50.0, 40)
    signal[0] = 0.0
    time_s = np.arange(signal.size) * step_s
    _, expected, _ = lsim(([1.0], [tau_s, 1.0]), signal, time_s)
    result = relax(signal, step_s, np.full((signal.size, 1), tau_s))[:, 0]
    np.testing.assert_allclose(result, expected, atol=1e-9)


def test_a_warmer_relaxation_is_faster_from_then_on() -> None:
    step = np.ones(400)
    step[0] = 0.0
    taus = np.where(np.arange(400) < 200, 100.0, 10.0)[:, None]
    result = relax(step, 1.0, taus)[:, 0]
    assert result[199] == pytest.approx(1.0 - np.exp(-1.99), abs=0.01)
    assert 1.0 - result[230] == pytest.approx((1.0 - result[199]) * np.exp(-3.1), rel=0.02)


def test_a_lagged_ramp_stays_behind_by_the_lag() -> None:
    ramp = np.arange(2000) * 0.01
    assert ramp[-1] - lagged(ramp, 1.0, 50.0)[-1] == pytest.approx(0.5, rel=0.02)
    assert np.array_equal(lagged(ramp, 1.0, 0.0), ramp)
