"""Extended model: without effects, order of effects, combinations, slope over SoC."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from stepping import EFFECTS, MODEL, irregular_signals, middle, online_of, step_through

from cangauge.bus.recording import read_log
from cangauge.identify.rows import fit_rows
from cangauge.identify.starts import with_start
from cangauge.logs.log import Log
from cangauge.model.effects.base import Signals
from cangauge.model.effects.library import LIBRARY
from cangauge.model.effects.signals import COUNTS
from cangauge.model.effects.voltages import VOLTAGES
from cangauge.model.extended import ExtendedModel
from cangauge.model.inverse import soc_from_ocv
from cangauge.model.published import CAPACITY_AH
from cangauge.types import Sample
from synthetic import synthetic_log, voltage_of, within_c

ALL = tuple((effect, middle(effect)) for effect in EFFECTS)


def signals_of(log: Log) -> Signals:
    return Signals(log.time_s, log.current_a, log.voltage_v, log.temperature_c)


def assert_equals_the_voltage_model(log: Log, capacity_ah: float, start_pct: float) -> None:
    rows = fit_rows(with_start(log, start_pct), capacity_ah, low_pass_s=())
    expected = voltage_of(MODEL, rows.soc_pct, rows.temperature_c, rows.current_columns_a)
    at = np.searchsorted(log.time_s, rows.time_s)
    found = ExtendedModel(MODEL, capacity_ah).predict(signals_of(log), start_pct, at)
    assert np.array_equal(found.soc_pct[at], rows.soc_pct)
    np.testing.assert_allclose(found.voltage_v, expected, rtol=0.0, atol=1e-9)
    assert np.array_equal(found.residual_v, rows.voltage_v - found.voltage_v)


def test_without_effects_it_equals_the_voltage_model() -> None:
    log = synthetic_log(rate_hz=10.0, hours=0.7, start_pct=90.0, end_pct=60.0)
    assert_equals_the_voltage_model(log, CAPACITY_AH, 90.0)


@pytest.mark.real
def test_without_effects_it_equals_the_model_on_a_real_trip(shared_data: Path) -> None:
    log = read_log(shared_data / "bmw_i3" / "TripA05.csv.gz")
    assert_equals_the_voltage_model(log, 61.75, 80.0)


def test_without_effects_the_online_form_equals_the_model() -> None:
    online = online_of(ExtendedModel(MODEL, CAPACITY_AH))
    assert online.capacity_ah == CAPACITY_AH
    reading = Sample(1.0, 50.0, 370.0, 20.0)
    assert online.correct(reading) == (reading,)
    assert online.counted(-33.3) == -33.3
    assert online.initial_soc_pct(88.8) == 88.8
    online.advance(1.0, 50.0, 20.0)
    for soc in np.linspace(-10.0, 110.0, 57).tolist():
        assert online.pseudo_ocv_at(soc) == MODEL.pseudo_ocv_at(soc)


def test_soc_may_be_anchored_at_any_row() -> None:
    signals = irregular_signals(500)
    extended = ExtendedModel(MODEL, CAPACITY_AH)
    first = extended.predict(signals, 80.0, np.array([0]))
    again = extended.predict(signals, float(first.soc_pct[300]), np.array([0]), initial_row=300)
    np.testing.assert_allclose(again.soc_pct, first.soc_pct, atol=1e-10)


def test_the_given_order_of_effects_does_not_matter() -> None:
    signals = irregular_signals(600)
    rows = np.arange(600)
    forward = ExtendedModel(MODEL, CAPACITY_AH, ALL).predict(signals, 80.0, rows)
    backward = ExtendedModel(MODEL, CAPACITY_AH, ALL[::-1]).predict(signals, 80.0, rows)
    assert np.array_equal(forward.voltage_v, backward.voltage_v)


def test_an_offset_is_corrected_before_a_gain() -> None:
    signals = irregular_signals(50)
    extended = ExtendedModel(
        MODEL,
        CAPACITY_AH,
        (
            (LIBRARY["current_gain"], {"gain_pct": 5.0}),
            (LIBRARY["current_offset"], {"offset_a": 2.0}),
        ),
    )
    found = extended.predict(signals, 80.0, np.arange(50)).signals.current_a
    np.testing.assert_allclose(found, (signals.current_a - 2.0) / 1.05, rtol=1e-12)


def test_a_sample_that_no_effect_corrects_is_passed_on() -> None:
    """Without arrays of one row, which take a tenth of a step."""
    effects = tuple((effect, middle(effect)) for effect in (*COUNTS, *VOLTAGES))
    sample = Sample(0.0, 10.0, 370.0, 20.0)
    assert online_of(ExtendedModel(MODEL, CAPACITY_AH, effects)).correct(sample)[0] is sample


@given(st.sets(st.sampled_from(sorted(LIBRARY)), min_size=2, max_size=6), st.integers(0, 99))
def test_combined_effects_agree_offline_and_online(chosen: set[str], seed: int) -> None:
    signals = irregular_signals(400, seed)
    effects = tuple((LIBRARY[key], middle(LIBRARY[key])) for key in sorted(chosen))
    extended = ExtendedModel(MODEL, CAPACITY_AH, effects)
    batch = extended.predict(signals, 85.0, np.arange(400))
    online = step_through(extended, signals, 85.0)
    n = len(online.readings)
    assert n >= 200
    # The SoC is that of the counter, so the slope of the knee magnifies rounding.
    np.testing.assert_allclose(online.soc_pct, batch.soc_pct[:n], atol=1e-8)
    np.testing.assert_allclose(online.voltage_v, batch.voltage_v[:n], atol=1e-6)


def test_slope_is_the_derivative_and_positive() -> None:
    extended = ExtendedModel(MODEL, CAPACITY_AH, ALL)
    online = online_of(extended)
    for time_s, current in enumerate((60.0, 0.0, -40.0, -200.0)):
        online.advance(float(time_s), current, 5.0)
        for soc in np.linspace(1.0, 99.0, 50).tolist():
            slope = online.pseudo_ocv_at(soc)[1]
            step = 0.01
            above, below = (online.pseudo_ocv_at(soc + d)[0] for d in (step, -step))
            numeric = (above - below) / (2.0 * step)
            assert slope > 0.0
            if numeric > 0.05:
                assert slope == pytest.approx(numeric, rel=0.02, abs=0.01)


def test_slope_stays_positive_where_the_voltage_falls() -> None:
    """Strong charging near empty: with rising SoC the voltage over the resistance falls faster."""
    values = {"at_empty": 3.0, "at_full": 0.0, "width_pct": 10.0, "delayed": 1.0}
    online = online_of(ExtendedModel(MODEL, CAPACITY_AH, ((LIBRARY["resistance_soc"], values),)))
    online.advance(0.0, -200.0, 20.0)
    (low, slope), (high, _) = online.pseudo_ocv_at(14.0), online.pseudo_ocv_at(15.0)
    assert high < low
    assert 0.0 < slope < 0.1


@given(st.floats(-400.0, 400.0), st.floats(-30.0, 50.0), st.floats(0.0, 100.0), st.floats(0.0, 1.0))
@example(-157.0, 0.0, 99.99999999999999, 0.0)  # a last step beyond 100 %
def test_newton_finds_a_root_with_all_effects(
    current: float, temperature: float, soc: float, part: float
) -> None:
    """Even where an effect makes the curve fall, the root reproduces the voltage."""
    values = {"at_empty": 3.0 * part, "at_full": 1.0, "width_pct": 10.0, "delayed": 1.0}
    effects = tuple(
        (effect, values if effect.id == "resistance_soc" else middle(effect)) for effect in EFFECTS
    )
    wide = within_c(MODEL, -30.0, 50.0)
    online = online_of(ExtendedModel(wide, 51.5, effects))
    online.advance(0.0, current, temperature)
    wanted = online.pseudo_ocv_at(soc)[0]
    found_pct, inside = soc_from_ocv(online.pseudo_ocv_at, wanted)
    assert 0.0 <= found_pct <= 100.0
    if inside:
        assert online.pseudo_ocv_at(found_pct)[0] == pytest.approx(wanted, abs=1e-6)
