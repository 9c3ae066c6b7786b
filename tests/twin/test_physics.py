"""Physics of the healthy twin: charge, energy, heat, relaxation, temperature, repeatability."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lsim

from cangauge.extras.validation.twin.drive import Drive, draw_drive
from cangauge.extras.validation.twin.pack import KINDS, TwinPack, draw_pack
from cangauge.extras.validation.twin.physics import lagged, relax, simulate_truth, temperatures
from processor import at_most


def constant_drive(
    current_a: np.ndarray, *, start_soc: float = 0.6, celsius: float = 25.0, step_s: float = 0.5
) -> Drive:
    """A drive with a given current at one temperature."""
    time_s = np.arange(current_a.size) * step_s
    return Drive(time_s, current_a, np.full_like(time_s, celsius), celsius, start_soc, seed=1)


def test_charge_is_the_integral_of_the_current(pack: TwinPack, drive: Drive) -> None:
    truth = simulate_truth(pack, drive)
    moved_ah = np.trapezoid(drive.current_a, drive.time_s) / 3600.0
    assert truth.soc[0] - truth.soc[-1] == pytest.approx(moved_ah / pack.capacity_ah, rel=1e-9)


def test_chemical_energy_is_work_plus_heat(pack: TwinPack, drive: Drive) -> None:
    truth = simulate_truth(pack, drive)
    step = drive.step_s
    chemical = np.sum(truth.equilibrium_v * drive.current_a) * step
    work = np.sum(truth.voltage_v * drive.current_a) * step
    kelvin = truth.core_c + 273.15
    soc = pack.chemistry.entropy(truth.soc)
    reversible = -np.sum(drive.current_a * kelvin * pack.cells * soc) * step
    heat = np.sum(truth.heat_w) * step
    assert chemical - work == pytest.approx(heat - reversible, rel=0.01)
    assert 0.005 * work < chemical - work < 0.2 * work


def test_heat_is_stored_or_lost_to_ambient(pack: TwinPack, drive: Drive) -> None:
    truth = simulate_truth(pack, drive)
    core, surface = temperatures(pack, drive, truth.heat_w)
    assert np.max(np.abs(core - truth.core_c)) < 0.05  # temperatures and heat are consistent
    stored = pack.core_j_k * (core[-1] - core[0]) + pack.surface_j_k * (surface[-1] - surface[0])
    lost = np.sum(pack.surface_ambient_w_k * (surface - drive.ambient_c)) * drive.step_s
    made = np.sum(truth.heat_w) * drive.step_s
    assert drive.conditioning_w == 0.0
    assert stored + lost == pytest.approx(made, rel=0.01)


def test_voltage_drops_in_a_pulse_and_relaxes(pack: TwinPack) -> None:
    current = np.zeros(7200)
    current[200:1400] = pack.capacity_ah
    truth = simulate_truth(pack, constant_drive(current))
    volts = truth.voltage_v
    rest, at_once, later = volts[199], volts[202], volts[1399]
    assert rest - at_once == pytest.approx(pack.resistance_ohm * pack.capacity_ah, rel=0.35)
    assert later < at_once - 0.2  # diffusion and discharge continue
    after = volts[[1402, 1600, 2400, 7199]]
    assert np.all(np.diff(after) > -1e-3)
    assert volts[-1] == pytest.approx(truth.equilibrium_v[-1], abs=0.05)


def test_resistance_rises_in_the_cold(pack: TwinPack) -> None:
    current = np.zeros(200)
    current[100:] = 0.5 * pack.capacity_ah

    def drop(celsius: float) -> float:
        volts = simulate_truth(pack, constant_drive(current, celsius=celsius)).voltage_v
        return float(volts[99] - volts[119])

    assert 1.8 < drop(-10.0) / drop(25.0) < 6.0
    assert drop(35.0) < drop(25.0)


def test_kinetic_overpotential_grows_less_than_linearly(pack: TwinPack) -> None:
    def drop(amperes: float) -> float:
        current = np.zeros(60)
        current[20:] = amperes
        volts = simulate_truth(pack, constant_drive(current, celsius=0.0)).voltage_v
        return float(volts[19] - volts[24])

    one_c = pack.capacity_ah
    assert drop(3.0 * one_c) < 0.99 * 3.0 * drop(one_c)
    assert drop(one_c) > 0.0 > drop(-one_c)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_pack_stays_in_its_voltage_range(kind: str) -> None:
    rng = np.random.default_rng(11)
    pack = draw_pack(rng, kind)
    drive = draw_drive(rng, pack, hours=0.6)
    truth = simulate_truth(pack, drive)
    rows = slice(0, truth.rows)
    cell_v = truth.voltage_v[rows] / pack.cells
    assert np.all((cell_v > 2.0) & (cell_v < 4.4))
    assert np.all(np.abs(drive.current_a) < 4.5 * pack.capacity_ah)
    assert np.all((truth.core_c > -15.0) & (truth.core_c < 60.0))


def test_seed_determines_the_simulation() -> None:
    def run(seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        pack = draw_pack(rng, "compact")
        return simulate_truth(pack, draw_drive(rng, pack, hours=0.3)).voltage_v

    assert np.array_equal(run(5), run(5))
    assert not np.array_equal(run(5), run(6))


def test_long_drive_takes_under_two_seconds(pack: TwinPack) -> None:
    rng = np.random.default_rng(2)
    drive = draw_drive(rng, pack, hours=2.5, start_soc_pct=100, end_soc_pct=2, discharge=True)
    with at_most(2.0):  # usually about 0.1 s
        simulate_truth(pack, drive)


@settings(deadline=None)
@given(st.floats(0.2, 500.0), st.floats(0.1, 1.0), st.integers(0, 1000))
def test_relaxation_matches_scipys_exact_solution(tau_s: float, step_s: float, seed: int) -> None:
    signal = np.random.default_rng(seed).normal(0.0, 50.0, 40)
    signal[0] = 0.0
    time_s = np.arange(signal.size) * step_s
    _, expected, _ = lsim(([1.0], [tau_s, 1.0]), signal, time_s)
    result = relax(signal, step_s, np.full((signal.size, 1), tau_s))[:, 0]
    np.testing.assert_allclose(result, expected, atol=1e-9)


def test_relaxation_follows_a_change_of_tau() -> None:
    step = np.ones(400)
    step[0] = 0.0
    taus = np.where(np.arange(400) < 200, 100.0, 10.0)[:, None]
    result = relax(step, 1.0, taus)[:, 0]
    assert result[199] == pytest.approx(1.0 - np.exp(-1.99), abs=0.01)
    assert 1.0 - result[230] == pytest.approx((1.0 - result[199]) * np.exp(-3.1), rel=0.02)


def test_lagged_ramp_is_late_by_the_lag() -> None:
    ramp = np.arange(2000) * 0.01
    assert ramp[-1] - lagged(ramp, 1.0, 50.0)[-1] == pytest.approx(0.5, rel=0.02)
    assert np.array_equal(lagged(ramp, 1.0, 0.0), ramp)
