"""Voltage model: equation, slope, extrapolation, delay line."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.errors import InputError
from cangauge.model.curve import KNOTS_PCT, HermiteCurve, PublishedCurve, hermite_basis
from cangauge.model.delay_line import DelayLine, delayed_currents, filled_at
from cangauge.model.inverse import soc_from_ocv, socs_from_ocv
from cangauge.model.published import leaf_2012_model
from cangauge.model.voltage_model import Arrhenius
from synthetic import voltage_model, voltage_of

MODEL = leaf_2012_model()
K = (394.4, 48.89, -4.769, 0.2158, -0.003718, -54.59, 109.3, -3.141)


@given(
    st.floats(0.0, 100.0),
    st.floats(20.0, 26.0),
    st.lists(st.floats(-50.0, 200.0), min_size=4, max_size=4),
)
def test_is_the_published_equation(soc: float, temperature: float, current: list[float]) -> None:
    s = soc / 100.0 * 0.9 + 0.05
    expected = sum(k * s**-n for n, k in enumerate(K[:5]))
    expected += K[5] * s + K[6] * math.log(s) + K[7] * math.log(1.0 - s)
    expected += -0.7428 * (temperature - 20.0)
    expected += np.dot([-0.1032, -0.01501, -0.009697, -0.004652], current)
    assert voltage_of(MODEL, [soc], [temperature], [current])[0] == pytest.approx(
        expected, abs=1e-9
    )


@given(
    st.floats(-20.0, 120.0),
    st.floats(0.0, 50.0),
    st.lists(st.floats(-300, 300), min_size=4, max_size=4),
)
def test_scalar_and_array_forms_agree(soc: float, temperature: float, current: list[float]) -> None:
    volts, slope = MODEL.pseudo_ocv_at(soc)
    whole = voltage_of(MODEL, [soc], [temperature], [current])[0]
    beside = MODEL.load_columns([temperature], np.array([current]))[0] @ MODEL.load_coefficients
    assert volts + beside == pytest.approx(whole, abs=1e-9)
    assert slope == pytest.approx(MODEL.pseudo_ocv_slope([soc])[0], rel=1e-9)


@given(st.floats(0.5, 99.5))
def test_slope_is_the_derivative(soc: float) -> None:
    step = 1e-3
    numeric = np.diff(MODEL.pseudo_ocv([soc - step, soc + step]))[0] / (2.0 * step)
    assert MODEL.pseudo_ocv_slope([soc])[0] == pytest.approx(numeric, rel=1e-4)


def test_rises_and_stays_bounded_outside_the_identified_soc() -> None:
    curve = PublishedCurve(K, soc_range_pct=(40.0, 80.0))
    narrow = voltage_model(curve, -0.74, (-0.1,), delays_s=(0.0,))
    soc = np.linspace(-10.0, 110.0, 500)
    volts = narrow.pseudo_ocv(soc)
    assert np.all(np.diff(volts) > 0.0)
    # Three times the range at about its slope; the formula itself falls by hundreds of volts.
    assert np.ptp(volts) < 4.0 * np.ptp(narrow.pseudo_ocv([40.0, 80.0]))


def test_temperature_is_limited_to_its_range() -> None:
    far, farther = MODEL.pseudo_ocv([50.0, 50.0], [-20.0, -40.0])
    assert far == farther


def test_refuses_a_falling_pseudo_ocv() -> None:
    with pytest.raises(InputError, match="falls with SoC"):
        PublishedCurve((350.0, 0, 0, 0, 0, -20.0, 0, 0))


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"soc_range_pct": (50.0, 50.0)}, "soc_range_pct"),
        ({"soc_range_pct": (0.0, 5e-324)}, "soc_range_pct"),
    ],
)
def test_published_curve_names_the_invalid_field(change: dict[str, object], field: str) -> None:
    with pytest.raises(InputError) as error:
        PublishedCurve(**({"ocv_v": K} | change))
    assert error.value.field == field


VOLTS = 300.0 + 80.0 * np.sort(np.random.default_rng(3).uniform(0.0, 1.0, KNOTS_PCT.size))


@given(st.floats(-20.0, 120.0))
def test_forms_of_a_curve_of_knots_agree(soc: float) -> None:
    curve = HermiteCurve.rising(KNOTS_PCT, VOLTS)
    volts, slope = curve.at(soc)
    at = np.array([soc])
    assert volts == pytest.approx(curve.values(at)[0], abs=1e-9)
    assert slope == pytest.approx(curve.slopes(at)[0], abs=1e-9)
    assert slope > 0.0
    above, below = curve.at(soc + 1e-4)[0], curve.at(soc - 1e-4)[0]
    assert slope == pytest.approx((above - below) / 2e-4, rel=1e-3, abs=1e-3)


@given(st.floats(-20.0, 120.0))
def test_curve_of_knots_is_linear_in_its_values(soc: float) -> None:
    smooth = 300.0 + KNOTS_PCT * 0.8
    curve = HermiteCurve.rising(KNOTS_PCT, smooth)
    row = hermite_basis(np.array([soc]))[0]
    assert row @ smooth == pytest.approx(curve.at(soc)[0], abs=1e-9)


def test_curve_passes_its_knots_and_falling_values_are_raised() -> None:
    curve = HermiteCurve.rising(KNOTS_PCT, VOLTS)
    assert [curve.at(soc)[0] for soc in KNOTS_PCT.tolist()] == pytest.approx(VOLTS, abs=0.6)
    falling = VOLTS.copy()
    falling[10] -= 30.0
    raised = HermiteCurve.rising(KNOTS_PCT, falling)
    volts = raised.values(np.linspace(-10.0, 110.0, 2401))
    assert np.all(np.diff(volts) > 0.0)


@given(st.integers(0, 10**6))
def test_a_curve_rises_between_its_knots_too(seed: int) -> None:
    shares = np.random.default_rng(seed).dirichlet(np.full(KNOTS_PCT.size, 0.5))
    curve = HermiteCurve.rising(KNOTS_PCT, 300.0 + 80.0 * np.cumsum(shares))
    assert curve.slopes(np.linspace(-10.0, 110.0, 2401)).min() > 0.0


def test_load_columns_are_the_equation() -> None:
    model = voltage_model(
        HermiteCurve.rising(KNOTS_PCT, VOLTS),
        -0.02,
        (-0.06, -0.01, -0.02),
        delays_s=(0.0, 10.0),
        low_pass_s=(140.0,),
        arrhenius=Arrhenius(factor=0.9, resistance_ohm=(-0.05, -0.01, -0.02), mean_c=15.0),
    )
    current, celsius = np.array([[40.0, 30.0, 12.0]]), -5.0
    factor = math.exp(3000.0 * (1.0 / 268.15 - 1.0 / 288.15)) - 1.0
    expected = -0.02 * (celsius - 20.0) + current[0] @ [-0.06, -0.01, -0.02]
    expected += 0.9 * factor * (current[0] @ [-0.05, -0.01, -0.02])
    found = voltage_of(model, [37.0], [celsius], current)[0] - model.pseudo_ocv([37.0])[0]
    assert found == pytest.approx(expected, abs=1e-9)


def test_low_passed_currents_start_at_rest() -> None:
    curve = PublishedCurve(K)
    model = voltage_model(curve, 0.0, (-0.1, -0.1), delays_s=(0.0,), low_pass_s=(10.0,))
    time_s = np.arange(0.0, 100.0)
    currents = model.currents(time_s, np.full(100, 50.0), slice(None))
    assert currents[:, 0].tolist() == [50.0] * 100
    assert currents[:, 1] == pytest.approx(50.0 * -np.expm1(-time_s / 10.0), abs=1e-9)


@given(st.lists(st.tuples(st.floats(0.02, 1.9), st.floats(-100, 200)), min_size=2, max_size=300))
def test_ring_buffer_equals_interpolation_of_the_log(
    steps: list[tuple[float, float]],
) -> None:
    delays = (0.0, 10.0, 30.0, 70.0)
    time_s = np.cumsum([step for step, _ in steps])
    current_a = np.array([value for _, value in steps])
    expected = delayed_currents(time_s, current_a, delays, time_s)
    line = DelayLine(delays)
    for k, (time, current) in enumerate(zip(time_s.tolist(), current_a.tolist(), strict=True)):
        line.push(time, current)
        assert line.currents() == pytest.approx(expected[k].tolist(), abs=1e-6)
    full = filled_at(time_s, 70.0, time_s)
    assert (line.filled_s >= line.longest_s) == bool(full[-1])


def test_a_gap_empties_the_delay_line_in_both_forms() -> None:
    time_s = np.concatenate([np.arange(0.0, 100.0), np.arange(103.0, 300.0)])
    full = filled_at(time_s, 70.0, time_s)
    assert full[time_s < 100.0].sum() == 30
    assert time_s[time_s > 100.0][np.argmax(full[time_s > 100.0])] == 173.0
    line = DelayLine((0.0, 70.0))
    for time in time_s[time_s < 173.0].tolist():
        line.push(time, 1.0)
    assert line.filled_s < line.longest_s
    line.push(173.0, 1.0)
    assert line.filled_s >= line.longest_s


def test_memory_is_bounded_at_any_rate() -> None:
    line = DelayLine((0.0, 70.0))
    for k in range(400_000):
        line.push(k * 1e-3, float(k))
    assert len(line._times) < 2 * 70.0 / 0.009
    assert line.currents()[1] == pytest.approx(399_999 - 70_000, abs=0.01)


@given(st.lists(st.floats(200.0, 500.0), max_size=40))
def test_voltages_are_inverted_together_as_one_by_one(volts: list[float]) -> None:
    knots = HermiteCurve.rising(KNOTS_PCT, VOLTS)
    for model in (MODEL, voltage_model(knots, 0.0, (0.0,), delays_s=(0.0,))):
        expected = [soc_from_ocv(model.pseudo_ocv_at, value)[0] for value in volts]
        assert socs_from_ocv(model, np.array(volts)) == pytest.approx(expected, abs=1e-6)
