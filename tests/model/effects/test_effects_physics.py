"""Each effect against analytical results."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from stepping import MODEL, PACK, irregular_signals, online_of, step_through

from cangauge.model.effects.base import Inputs, Signals, Values
from cangauge.model.effects.library import LIBRARY
from cangauge.model.extended import ExtendedModel
from cangauge.model.first_order import Lag, decaying_sum, low_passed
from cangauge.model.published import CAPACITY_AH
from cangauge.types import Sample


@dataclass
class PackState:
    """Inputs of an added voltage, and the SoC."""

    time_s: np.ndarray
    current_a: np.ndarray
    temperature_c: np.ndarray
    soc_pct: np.ndarray
    drop_v: np.ndarray


def corrected(effect_id: str, signals: Signals, values: Values) -> Signals:
    """A whole log as ideal sensors would have shown it."""
    effect = LIBRARY[effect_id]
    return effect.correct(
        signals, values, effect.context(values, MODEL, PACK)._replace(is_whole=True)
    )


def steady(
    seconds: float, current_a: float, *, soc_pct: float = 50.0, temperature_c: float = 23.0
) -> PackState:
    """A constant current from 0 s on, at 1 Hz, at one SoC."""
    time_s = np.arange(0.0, seconds + 1.0)
    current = np.full_like(time_s, current_a)
    drop = current * sum(MODEL.loads.resistance_ohm)
    return PackState(
        time_s, current, np.full_like(time_s, temperature_c), np.full_like(time_s, soc_pct), drop
    )


def extra(effect_id: str, state: PackState, values: Values) -> np.ndarray:
    """The extra voltage [V]; parameters not given are neutral."""
    effect = LIBRARY[effect_id]
    values = {**effect.neutral(PACK), **values}
    inputs = Inputs(state.time_s, state.current_a, state.temperature_c, state.drop_v)
    drive = effect.drive(inputs, values, effect.context(values, MODEL, PACK))
    assert drive is not None
    return drive * effect.over_soc(state.soc_pct, values, MODEL)


def with_current(state: PackState, current_a: np.ndarray) -> PackState:
    return replace(state, current_a=current_a, drop_v=current_a * sum(MODEL.loads.resistance_ohm))


@pytest.mark.parametrize(
    ("effect_id", "values", "channel", "wrong"),
    [
        ("current_offset", {"offset_a": 2.5}, "current_a", lambda x: x + 2.5),
        ("current_gain", {"gain_pct": 4.0}, "current_a", lambda x: x * 1.04),
        ("voltage_offset", {"offset_v": -3.0}, "voltage_v", lambda x: x - 3.0),
        ("voltage_gain", {"gain_pct": -1.5}, "voltage_v", lambda x: x * 0.985),
    ],
)
def test_a_linear_sensor_error_is_undone(
    effect_id: str, values: Values, channel: str, wrong: Callable[[np.ndarray], np.ndarray]
) -> None:
    true = irregular_signals(200)
    shown = true._replace(**{channel: wrong(getattr(true, channel))})
    found = corrected(effect_id, shown, values)
    np.testing.assert_allclose(getattr(found, channel), getattr(true, channel), rtol=1e-12)


@pytest.mark.parametrize("skew_s", [-1.2, -0.3, 0.3, 1.2])
def test_a_skewed_current_is_realigned(skew_s: float) -> None:
    """The current is linear between 0.1 s rows, so interpolation loses nothing."""
    time_s = np.arange(0.0, 300.0, 0.1)
    rng = np.random.default_rng(5)
    current = np.interp(time_s, np.arange(0.0, 301.0, 0.5), rng.normal(20.0, 40.0, 602))
    late = np.interp(time_s - skew_s, time_s, current)
    shown = Signals(time_s, late, np.full_like(time_s, 370.0), np.full_like(time_s, 20.0))
    found = corrected("time_skew", shown, {"skew_s": skew_s})
    inner = slice(20, -20)
    np.testing.assert_allclose(found.current_a[inner], current[inner], atol=1e-9)


def test_online_a_voltage_waits_just_for_its_late_current() -> None:
    signals = irregular_signals(2000, gaps=False)
    extended = ExtendedModel(MODEL, CAPACITY_AH).with_effect(LIBRARY["time_skew"], {"skew_s": 0.8})
    times = [reading.time_s for reading in step_through(extended, signals, 90.0).readings]
    known = signals.time_s + 0.8 <= signals.time_s[-1]
    assert times == signals.time_s[known].tolist()


def test_online_a_voltage_leaves_with_the_sample_of_its_current() -> None:
    online = online_of(
        ExtendedModel(MODEL, CAPACITY_AH).with_effect(LIBRARY["time_skew"], {"skew_s": 0.5})
    )
    assert online.correct(Sample(10.0, 1.0, 371.0, 20.0)) == []
    assert online.correct(Sample(10.25, 2.0, 372.0, 20.0)) == []
    assert online.correct(Sample(10.5, 3.0, 373.0, 20.0)) == [Sample(10.0, 3.0, 371.0, 20.0)]


@pytest.mark.parametrize("skew_s", [-1.5, 1.5])
def test_memory_of_the_skew_is_bounded(skew_s: float) -> None:
    online = online_of(
        ExtendedModel(MODEL, CAPACITY_AH).with_effect(LIBRARY["time_skew"], {"skew_s": skew_s})
    )
    for k in range(5_000):
        online.correct(Sample(0.01 * k, float(k % 7), 370.0, 20.0))
    assert len(online.state()[1]) < 8 * 150


def test_temperature_lag_is_undone_on_a_ramp() -> None:
    """On a ramp of 10 K/h a lag of 600 s reads 1.67 K low once settled."""
    time_s = np.arange(0.0, 7200.0)
    true = 20.0 + time_s * 10.0 / 3600.0
    shown = low_passed(time_s, true, 600.0, 20.0)
    signals = Signals(time_s, np.zeros_like(time_s), np.full_like(time_s, 370.0), shown)
    found = corrected("temperature_lag", signals, {"tau_s": 600.0})
    assert true[-1] - shown[-1] == pytest.approx(600.0 * 10.0 / 3600.0, abs=1e-3)
    assert found.temperature_c[-1] == pytest.approx(true[-1], abs=1e-3)


def test_core_rises_with_the_square_of_the_current() -> None:
    values = {"rise_k": 4.0, "late": 0.0, "tau_s": 1000.0}
    for c_rate, sign in ((1.0, 1.0), (2.0, -1.0)):
        state = steady(20_000.0, sign * c_rate * PACK.capacity_ah)
        signals = Signals(
            state.time_s, state.current_a, np.full_like(state.time_s, 370.0), state.temperature_c
        )
        found = corrected("core_temperature", signals, values)
        rise = found.temperature_c - 23.0
        assert rise[0] == 0.0
        assert rise[1000] == pytest.approx(4.0 * c_rate**2 * (1.0 - math.exp(-1.0)), rel=1e-6)
        assert rise[-1] == pytest.approx(4.0 * c_rate**2, rel=1e-6)


def test_core_lags_a_surface_that_warms_from_outside() -> None:
    """On a ramp of 10 K/h by its time constant, 2.78 K once settled, or a fraction of it."""
    time_s = np.arange(0.0, 20_000.0)
    outside = -5.0 + time_s * 10.0 / 3600.0
    signals = Signals(time_s, np.zeros_like(time_s), np.full_like(time_s, 370.0), outside)
    for late in (1.0, 0.5):
        values = {"rise_k": 4.0, "late": late, "tau_s": 1000.0}
        core = corrected("core_temperature", signals, values).temperature_c
        assert core[0] == -5.0
        behind = late * 1000.0 * 10.0 / 3600.0
        assert outside[1000] - core[1000] == pytest.approx(behind * (1.0 - math.exp(-1.0)))
        assert outside[-1] - core[-1] == pytest.approx(behind)


def counted(effect_id: str, values: Values, current_a: float, hours: float) -> float:
    state = steady(3600.0 * hours, current_a)
    signals = Signals(state.time_s, state.current_a, state.current_a, state.temperature_c)
    extended = ExtendedModel(MODEL, 50.0).with_effect(LIBRARY[effect_id], values)
    return float(extended.predict(signals, 60.0, np.array([0])).soc_pct[-1])


def test_charge_effects_change_the_count() -> None:
    assert counted("capacity", {"change_pct": -20.0}, 10.0, 1.0) == pytest.approx(60.0 - 25.0)
    assert counted("initial_soc", {"offset_pct": 5.0}, 10.0, 1.0) == pytest.approx(65.0 - 20.0)
    for current, expected in ((-10.0, 60.0 + 19.0), (10.0, 60.0 - 20.0)):
        found = counted("coulombic_efficiency", {"efficiency": 0.95}, current, 1.0)
        assert found == pytest.approx(expected)


def test_effects_do_not_change_a_capacity_set_by_the_user() -> None:
    extended = ExtendedModel(MODEL, 50.0).with_effect(LIBRARY["capacity"], {"change_pct": -20.0})
    assert online_of(extended).capacity_ah == pytest.approx(40.0)
    assert online_of(extended, 47.0).capacity_ah == 47.0


def at_onset(current_a: float, **state: float) -> PackState:
    """A current that has just started: only the undelayed resistance, 0.4 of the sum, drops."""
    just = steady(5.0, current_a, **state)
    return replace(just, drop_v=0.4 * just.drop_v)


def test_a_share_of_the_drop_follows_arrhenius() -> None:
    values = {
        "share": 0.7, "activation_k": 4000.0, "delayed": 1.0, "reference_c": 23.0
    }  # fmt: skip
    at_23 = extra("resistance_temperature", steady(10.0, 50.0, temperature_c=23.0), values)
    np.testing.assert_allclose(at_23, 0.0, atol=1e-12)
    cold = steady(10.0, 50.0, temperature_c=0.0)
    factor = math.exp(4000.0 * (1.0 / 273.15 - 1.0 / 296.15))
    assert 2.5 < factor < 3.5
    found = extra("resistance_temperature", cold, values)
    np.testing.assert_allclose(found, 0.7 * cold.drop_v * (factor - 1.0), rtol=1e-12)


@pytest.mark.parametrize(
    ("effect_id", "values", "rise"),
    [
        ("resistance_temperature",
         {"share": 0.5, "activation_k": 2500.0, "reference_c": 23.0},
         0.5 * math.expm1(2500.0 * (1.0 / 278.15 - 1.0 / 296.15))),
        ("resistance_soc", {"at_empty": 2.0, "at_full": 0.0, "width_pct": 10.0}, 2.0 / math.e),
    ],
)  # fmt: skip
def test_an_undelayed_effect_scales_current_times_all_resistance(
    effect_id: str, values: Values, rise: float
) -> None:
    """For a current that has just started, a delayed effect scales only the drop so far."""
    state = at_onset(50.0, soc_pct=10.0, temperature_c=5.0)
    whole_v = sum(MODEL.loads.resistance_ohm) * 50.0
    assert whole_v < 0.0
    for delayed, part in ((0.0, 1.0), (1.0, 0.4), (0.25, 0.85)):
        found = extra(effect_id, state, {**values, "delayed": delayed})
        np.testing.assert_allclose(found, rise * part * whole_v, rtol=1e-12)


def test_resistance_rises_toward_empty_and_full() -> None:
    values = {"at_empty": 2.0, "at_full": 0.5, "width_pct": 10.0, "delayed": 1.0}
    for soc, share in ((0.0, 2.0), (100.0, 0.5), (10.0, 2.0 / math.e), (50.0, 0.0168)):
        state = steady(3.0, 50.0, soc_pct=soc)
        np.testing.assert_allclose(
            extra("resistance_soc", state, values) / state.drop_v, share, rtol=3e-3
        )


def test_asymmetry_acts_on_charging_current_only() -> None:
    values = {"charging_ohm": 0.05}
    assert not np.any(extra("resistance_asymmetry", steady(5.0, 40.0), values))
    np.testing.assert_allclose(extra("resistance_asymmetry", steady(5.0, -40.0), values), 2.0)


def test_a_step_persists_from_its_change_point() -> None:
    state = steady(1000.0, 40.0)
    moved = replace(state, time_s=state.time_s + 5e5)
    found = extra("resistance_step", moved, {"step_ohm": 0.05, "start_s": 300.0})
    np.testing.assert_array_equal(found[:300], 0.0)
    np.testing.assert_allclose(found[300:], -2.0)


@pytest.mark.parametrize("activation_k", [0.0, 5000.0])
@pytest.mark.parametrize("bend_only", [0.0, 1.0])
@pytest.mark.parametrize("temperature_c", [-15.0, 25.0, 40.0])
def test_the_exchange_current_follows_arrhenius_from_25_c(
    temperature_c: float, bend_only: float, activation_k: float
) -> None:
    """I₀(T) = I₀·exp(B·(1/298.15 − 1/T)): with B = 5000 K 13 times smaller at −15 °C."""
    exchange_a = 3.0 * math.exp(activation_k * (1.0 / 298.15 - 1.0 / (temperature_c + 273.15)))
    assert (exchange_a == 3.0) == (temperature_c == 25.0 or activation_k == 0.0)
    one_c = PACK.capacity_ah
    for current in (-80.0, 7.0, 150.0):
        state = with_current(steady(2.0, 0.0, temperature_c=temperature_c), np.full(3, current))
        bend = math.asinh(current / (2.0 * exchange_a))
        bend -= bend_only * current / one_c * math.asinh(one_c / (2.0 * exchange_a))
        values = {
            "scale_v": 5.0, "exchange_a": 3.0, "bend_only": bend_only, "activation_k": activation_k
        }  # fmt: skip
        found = extra("charge_transfer", state, values)
        np.testing.assert_allclose(found, -5.0 * bend, rtol=1e-12)


POLARISATIONS = pytest.mark.parametrize("effect_id", ["fast_polarization", "slow_diffusion"])


@POLARISATIONS
def test_polarisation_follows_arrhenius_from_25_c(effect_id: str) -> None:
    tau = 5.0 if effect_id == "fast_polarization" else 400.0
    for temperature_c, activation_k in ((25.0, 3000.0), (0.0, 3000.0), (-10.0, 6000.0), (0.0, 0.0)):
        state = steady(3.0 * tau, 50.0, temperature_c=temperature_c)
        values = {"ohm": 0.02, "tau_s": tau, "activation_k": activation_k}
        colder = math.exp(activation_k * (1.0 / (temperature_c + 273.15) - 1.0 / 298.15))
        expected = -1.0 * colder * -np.expm1(-state.time_s / tau)
        np.testing.assert_allclose(extra(effect_id, state, values), expected, rtol=1e-9, atol=1e-12)


def test_polarisation_scales_with_the_present_temperature() -> None:
    """The resistance rises in the cold; the time constant does not."""
    state = steady(3000.0, 50.0, temperature_c=25.0)
    warming = replace(state, temperature_c=np.where(state.time_s < 2999.5, 0.0, 25.0))
    values = {"ohm": 0.02, "tau_s": 400.0, "activation_k": 3000.0}
    cold, warm = extra("slow_diffusion", warming, values), extra("slow_diffusion", state, values)
    assert cold[-1] == warm[-1]
    assert cold[-2] == pytest.approx(
        warm[-2] * math.exp(3000.0 * (1.0 / 273.15 - 1.0 / 298.15)), rel=1e-12
    )


def test_polarisation_has_decayed_after_a_night() -> None:
    time_s = np.concatenate([np.arange(0.0, 3600.0), 3600.0 + 8 * 3600.0 + np.arange(10.0)])
    current = np.full_like(time_s, 50.0)
    state = PackState(time_s, current, current, current, current)
    values = {"ohm": 0.02, "tau_s": 1000.0, "activation_k": 0.0}
    found = extra("slow_diffusion", state, values)
    assert found[3599] == pytest.approx(-1.0 * (1.0 - math.exp(-3.599)), rel=1e-3)
    assert abs(found[3600]) < 1e-6


def test_particle_diffusion_follows_the_slope_of_the_ocv() -> None:
    """Like a shift of the surface charge: U(S − δ) − U(S), with δ ∝ current."""
    drops = []
    for soc_pct in (15.0, 50.0, 85.0):
        state = steady(20_000.0, 50.0, soc_pct=soc_pct)
        values = {"ohm": 0.02, "tau_s": 500.0, "activation_k": 0.0}
        uniform = extra("slow_diffusion", state, values)[-1]
        steep = extra("slow_diffusion", state, values | {"by_slope": 1.0})[-1]
        half = extra("slow_diffusion", state, values | {"by_slope": 0.5})[-1]
        assert half == pytest.approx(0.5 * (uniform + steep), rel=1e-12)
        drops.append(steep)
    shifted = [
        float(MODEL.pseudo_ocv(soc - 0.01)[0] - MODEL.pseudo_ocv(soc)[0])
        for soc in (15.0, 50.0, 85.0)
    ]
    assert np.ptp(shifted) > 0.2 * abs(shifted[0])
    np.testing.assert_allclose(
        np.array(drops) / drops[0], np.array(shifted) / shifted[0], rtol=0.01
    )


def test_hysteresis_reverses_with_charge_and_persists_at_rest() -> None:
    values = {"half_width_v": 2.0, "travel_pct": 2.0}
    per_hour = PACK.capacity_ah
    time_s = np.concatenate([np.arange(0.0, 10_000.0), 50_000.0 + np.arange(10_000.0)])
    current = np.select([time_s < 3600.0, time_s < 55_000.0], [per_hour * 0.2, 0.0], -per_hour)
    state = with_current(replace(steady(1.0, 0.0), time_s=time_s), current)
    found = extra("hysteresis", state, values)
    # 20 % of discharge is ten times the travel: from the middle to the lower branch.
    assert found[0] == 0.0
    assert found[360] == pytest.approx(-2.0 * (1.0 - math.exp(-1.0)), rel=1e-3)
    assert found[3700] == pytest.approx(-2.0, rel=1e-3)
    resting = (time_s > 3700.0) & (time_s < 54_999.0)
    assert np.ptp(found[resting]) == 0.0
    # One travel of charge: from −1 to 1 − 2/e.
    assert found[np.searchsorted(time_s, 55_000.0 + 72.0)] == pytest.approx(
        2.0 * (1.0 - 2.0 / math.e), abs=0.03
    )


def test_entropy_bounds_are_tenths_of_a_mv_per_k_and_cell() -> None:
    effect = LIBRARY["entropic_coefficient"]
    for parameter in effect.amplitudes:
        low, high = parameter.bounds(PACK)
        assert -low == high
        assert 1e-4 < high / 100.0 < 5e-4
    warm = steady(3.0, 0.0, soc_pct=100.0, temperature_c=MODEL.loads.t_ref_c + 10.0)
    found = extra(
        "entropic_coefficient",
        warm,
        {"level_v_per_k": 0.0, "slope_v_per_k": 0.01, "curve_v_per_k": 0.02},
    )
    np.testing.assert_allclose(found, 10.0 * 0.03)


def test_the_entropic_level_is_constant_over_soc() -> None:
    values = {"level_v_per_k": 0.02, "slope_v_per_k": 0.0, "curve_v_per_k": 0.0}
    for soc_pct in (0.0, 37.0, 100.0):
        for kelvin in (-12.0, 0.0, 10.0):
            state = steady(3.0, 60.0, soc_pct=soc_pct, temperature_c=MODEL.loads.t_ref_c + kelvin)
            found = extra("entropic_coefficient", state, values)
            np.testing.assert_allclose(found, 0.02 * kelvin, rtol=1e-12, atol=1e-15)


def test_entropic_slope_and_curve_average_to_zero_over_soc() -> None:
    """Legendre polynomials: the level alone is the mean over SoC."""
    soc = np.linspace(0.0, 100.0, 2001)
    state = replace(steady(2000.0, 0.0, temperature_c=MODEL.loads.t_ref_c + 10.0), soc_pct=soc)
    for name in ("slope_v_per_k", "curve_v_per_k"):
        values = dict.fromkeys(("level_v_per_k", "slope_v_per_k", "curve_v_per_k"), 0.0)
        found = extra("entropic_coefficient", state, values | {name: 0.02})
        assert np.abs(found).max() == pytest.approx(0.2)
        assert abs(np.trapezoid(found, soc)) / 100.0 < 1e-6


def test_weak_cells_advance_the_knee_of_a_rising_ocv() -> None:
    soc = np.linspace(0.0, 100.0, 1001)
    state = replace(
        steady(1000.0, 0.0), soc_pct=soc, temperature_c=np.full(1001, MODEL.loads.t_ref_c)
    )
    found = extra("weak_cell", state, {"fraction": 0.1, "deficit_pct": 15.0})
    assert found[-1] == 0.0
    assert np.all(found <= 0.0)
    assert np.argmin(found) < 150
    assert np.all(np.diff(MODEL.pseudo_ocv(soc) + found) > 0.0)


@given(
    st.lists(st.tuples(st.floats(1e-3, 1e4), st.floats(-500.0, 500.0)), min_size=1, max_size=60),
    st.floats(0.2, 3000.0),
    st.floats(-100.0, 100.0),
    st.sampled_from([60.0, math.inf]),
)
def test_array_and_sample_forms_of_the_lag_agree(
    rows: list[tuple[float, float]], tau_s: float, start: float, rest_s: float
) -> None:
    time_s = np.cumsum([step for step, _ in rows])
    values = np.array([value for _, value in rows])
    lag = Lag(tau_s, start, rest_s)
    expected = [float(lag.step(time_s[k : k + 1], values[k : k + 1])[0]) for k in range(len(rows))]
    np.testing.assert_allclose(
        low_passed(time_s, values, tau_s, start, rest_s), expected, rtol=1e-9, atol=1e-9
    )


def test_lag_solves_its_equation_on_a_ramp() -> None:
    """y' = (x − y)/τ with x = t and y(0) = 0: y = t − τ·(1 − e^(−t/τ)), at any sampling."""
    time_s = np.array([0.0, 0.1, 0.5, 3.0, 3.001, 20.0, 400.0])
    found = low_passed(time_s, time_s, 7.0, 0.0)
    np.testing.assert_allclose(found, time_s - 7.0 * -np.expm1(-time_s / 7.0), atol=1e-12)


@given(st.lists(st.floats(0.0, 2000.0), min_size=1, max_size=80), st.integers(0, 1000))
def test_decaying_sum_equals_its_recursion(decay: list[float], seed: int) -> None:
    drive = np.random.default_rng(seed).normal(0.0, 100.0, len(decay))
    expected = [5.0]
    for k, d in zip(decay, drive.tolist(), strict=True):
        expected.append(math.exp(-k) * expected[-1] + d)
    found = decaying_sum(np.array(decay), drive, 5.0)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
