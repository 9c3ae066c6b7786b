"""Properties of every effect: neutral values, offline = online, scaling of bounds, visibility."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from stepping import (
    EFFECTS,
    MODEL,
    PACK,
    irregular_signals,
    middle,
    online_of,
    step_through,
    within,
)

from cangauge.model.curve import PublishedCurve
from cangauge.model.effects.base import Effect, Pack, Signals
from cangauge.model.effects.library import LIBRARY
from cangauge.model.extended import ExtendedModel
from cangauge.model.published import CAPACITY_AH
from cangauge.types import Sample
from processor import at_most
from selection import nightly_except
from synthetic import synthetic_log, voltage_model, within_c

each_effect = pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)

CELL_OCV_V = (3.2, 0.0, 0.0, 0.0, 0.0, 0.9, 0.0, 0.0)
CELL = voltage_model(
    PublishedCurve(CELL_OCV_V),
    0.0005,
    (-0.02, -0.01),
    delays_s=(0.0, 10.0),
    t_ref_c=25.0,
    temperature_c=(0.0, 40.0),
)


@each_effect
def test_describes_itself(effect: Effect) -> None:
    parts = re.split(r"\*\*(?:Signature\.|Separated by|Source\.)\*\*", effect.about)
    assert len(parts) == 4
    for text in map(str.strip, (*parts[1:], effect.equation)):
        assert len(text) > 8 or text == "definition"
    assert effect.parameters
    assert len({parameter.name for parameter in effect.parameters}) == len(effect.parameters)
    for parameter in effect.parameters:
        assert parameter.low < parameter.high
        is_amplitude = parameter in effect.amplitudes
        assert not is_amplitude or parameter.low <= parameter.neutral <= parameter.high
        for value in parameter.grid:
            assert parameter.low <= value <= parameter.high
    assert {*effect.parameters} == {*effect.amplitudes, *effect.shapes}


@each_effect
def test_neutral_values_change_nothing(effect: Effect) -> None:
    signals = irregular_signals()
    rows = np.arange(0, signals.time_s.size, 3)
    plain = ExtendedModel(MODEL, CAPACITY_AH)
    expected = plain.predict(signals, 90.0, rows)
    for shape in range(max(len(item.grid) for item in effect.parameters) or 1):
        values = effect.neutral(PACK)
        for parameter in effect.parameters:
            if parameter.grid:
                trials = parameter.trials(PACK)
                values[parameter.name] = trials[shape % len(trials)]
        extended = plain.with_effect(effect, values)
        found = extended.predict(signals, 90.0, rows)
        assert np.array_equal(found.voltage_v, expected.voltage_v)
        assert np.array_equal(found.soc_pct, expected.soc_pct)
        for name in ("time_s", "current_a", "voltage_v", "temperature_c"):
            assert np.array_equal(getattr(found.signals, name), getattr(signals, name))
    few = irregular_signals(300)
    assert np.array_equal(
        step_through(extended, few, 90.0).voltage_v, step_through(plain, few, 90.0).voltage_v
    )


@each_effect
@pytest.mark.parametrize("part", nightly_except((0.3,), (0.3, 1.0)))
def test_offline_equals_online_on_irregular_samples(effect: Effect, part: float) -> None:
    signals = irregular_signals(1500, seed=int(10 * part) + 3)
    values = {item.name: within(item, part) for item in effect.parameters}
    if effect.id == "resistance_step":
        values["start_s"] = part * 3000.0
    extended = ExtendedModel(MODEL, CAPACITY_AH).with_effect(effect, values)
    every = np.arange(signals.time_s.size)
    batch = extended.predict(signals, 80.0, every)
    online = step_through(extended, signals, 80.0, batch.soc_pct)
    n = len(online.readings)
    assert n >= signals.time_s.size - 200 * (effect.id == "time_skew")
    found = np.array(online.readings)
    for k, name in enumerate(("time_s", "current_a", "voltage_v", "temperature_c")):
        expected = getattr(batch.signals, name)[:n]
        np.testing.assert_allclose(found[:, k], expected, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(online.soc_pct, batch.soc_pct[:n], rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(online.voltage_v, batch.voltage_v[:n], rtol=0.0, atol=1e-6)


LONG = synthetic_log(hours=1.5, start_pct=90.0, end_pct=8.0)


@each_effect
def test_mid_range_is_visible_on_a_drive(effect: Effect) -> None:
    log = LONG
    # A pack that warms up, or the interior's temperature would not matter.
    warming_c = log.temperature_c - 15.0 + np.linspace(0.0, 8.0, log.time_s.size)
    signals = Signals(log.time_s, log.current_a, log.voltage_v, warming_c)
    rows = np.arange(70, log.time_s.size)
    base = ExtendedModel(within_c(MODEL, -20.0, 60.0), CAPACITY_AH)
    plain = base.predict(signals, 90.0, rows).residual_v
    changed = base.with_effect(effect, middle(effect)).predict(signals, 90.0, rows).residual_v
    assert np.sqrt(np.mean((changed - plain) ** 2)) > 0.1


@each_effect
def test_amplitudes_enter_the_voltage_nearly_linearly(effect: Effect) -> None:
    signals = irregular_signals(gaps=False)
    rows = np.arange(100, signals.time_s.size)
    base = ExtendedModel(MODEL, CAPACITY_AH)
    neutral = effect.neutral(PACK)
    for parameter in () if effect.moves_time else effect.amplitudes:
        plain = base.predict(signals, 80.0, rows).residual_v
        changes = []
        for part in (0.01, 0.02):
            step = part * (middle(effect)[parameter.name] - neutral[parameter.name])
            values = neutral | {parameter.name: neutral[parameter.name] + step}
            extended = base.with_effect(effect, values)
            changes.append(extended.predict(signals, 80.0, rows).residual_v)
        once, twice = changes[0] - plain, changes[1] - plain
        assert np.linalg.norm(once) > 0.0
        assert np.linalg.norm(twice - 2.0 * once) < 0.05 * np.linalg.norm(twice)


@each_effect
def test_bounds_scale_with_the_pack(effect: Effect) -> None:
    """96 cells with 20 times the capacity: volts, amperes and ohms grow, ratios and times stay."""
    cell = Pack.of(CELL, 2.5)
    ohm = 96.0 / 20.0 * cell.resistance_ohm
    pack = Pack(96.0 * cell.voltage_v, 50.0, ohm, cell.temperature_c)
    ratio = {"V": 96.0, "V/K": 96.0, "A": 20.0, "ohm": 4.8}
    for parameter in effect.parameters:
        expected = np.array(parameter.bounds(cell)) * ratio.get(parameter.unit, 1.0)
        np.testing.assert_allclose(parameter.bounds(pack), expected, rtol=1e-12)
        np.testing.assert_allclose(
            parameter.trials(pack),
            np.array(parameter.trials(cell)) * ratio.get(parameter.unit, 1.0),
            rtol=1e-12,
        )


@each_effect
def test_effects_scale_from_cell_to_pack(effect: Effect) -> None:
    """At equal fractions of the bounds and equal C-rates, the relative effect is equal."""
    many = 96.0
    loads = CELL.loads
    pack_model = voltage_model(
        PublishedCurve(tuple(many * k for k in CELL_OCV_V)),
        many * loads.kt_v_per_k,
        tuple(many / 20.0 * r for r in loads.resistance_ohm),
        delays_s=loads.delays_s,
        t_ref_c=loads.t_ref_c,
        temperature_c=CELL.range.temperature_c,
    )
    big = irregular_signals(800)
    small = Signals(big.time_s, big.current_a / 20.0, big.voltage_v / many, big.temperature_c)
    rows = np.arange(800)
    found = []
    for model, capacity, signals in ((CELL, 2.5, small), (pack_model, 50.0, big)):
        values = middle(effect, Pack.of(model, capacity))
        extended = ExtendedModel(model, capacity).with_effect(effect, values)
        found.append(extended.predict(signals, 70.0, rows).residual_v)
    np.testing.assert_allclose(many * found[0], found[1], rtol=0.0, atol=1e-6)


MOST = max(len(effect.parameters) for effect in EFFECTS)

signal_rows = st.lists(
    st.tuples(
        st.floats(1e-3, 1e5), st.floats(-5000.0, 5000.0), st.floats(0.0, 1000.0),
        st.floats(-60.0, 120.0),
    ),
    min_size=1,
    max_size=25,
)  # fmt: skip


@given(
    st.sampled_from(EFFECTS),
    st.lists(st.floats(0.0, 1.0), min_size=MOST, max_size=MOST),
    signal_rows,
    st.floats(0.0, 100.0),
    st.booleans(),
)
def test_values_within_bounds_give_finite_voltages(
    effect: Effect,
    parts: list[float],
    rows: list[tuple[float, ...]],
    start_pct: float,
    leaf: bool,
) -> None:
    model, capacity = (MODEL, CAPACITY_AH) if leaf else (CELL, 2.5)
    pack = Pack.of(model, capacity)
    values = {
        item.name: within(item, part, pack)
        for item, part in zip(effect.parameters, parts, strict=False)
    }
    columns = np.array(rows)
    signals = Signals(np.cumsum(columns[:, 0]), columns[:, 1], columns[:, 2], columns[:, 3])
    extended = ExtendedModel(model, capacity).with_effect(effect, values)
    batch = extended.predict(signals, start_pct, np.arange(len(rows)))
    assert np.all(np.isfinite(batch.voltage_v))
    assert np.all(np.isfinite(batch.soc_pct))
    assert np.all(np.isfinite(batch.residual_v))
    stepped = step_through(extended, signals, start_pct)
    assert np.all(np.isfinite(stepped.voltage_v))
    assert np.all(np.isfinite(np.array(stepped.readings)))
    online = online_of(extended)
    online.advance(0.0, 10.0, 20.0)
    for soc in (-20.0, 0.0, 50.0, 100.0, 120.0):
        volts, slope = online.pseudo_ocv_at(soc)
        assert math.isfinite(volts)
        assert slope > 0.0


@each_effect
def test_missing_signals_affect_only_themselves(effect: Effect) -> None:
    signals = irregular_signals(400, gaps=False)
    missing = slice(100, 150)
    voltage, temperature = signals.voltage_v.copy(), signals.temperature_c.copy()
    voltage[missing], temperature[missing] = math.nan, math.nan
    online = online_of(ExtendedModel(MODEL, CAPACITY_AH).with_effect(effect, middle(effect)))
    found = []
    for row in zip(
        signals.time_s.tolist(), signals.current_a.tolist(), voltage.tolist(),
        temperature.tolist(), strict=True,
    ):  # fmt: skip
        found.extend(online.correct(Sample(*row)))
    found_rows = np.array(found)
    assert np.all(np.isfinite(found_rows[:, 1]))
    bad = np.isnan(found_rows[:, 2])
    assert np.array_equal(np.flatnonzero(bad), np.arange(100, 150))
    assert np.array_equal(bad, np.isnan(found_rows[:, 3]))


@pytest.mark.parametrize(
    "effect_id", nightly_except(("core_temperature", "slow_diffusion", "time_skew"), LIBRARY)
)
def test_is_fast_enough_for_a_search(effect_id: str) -> None:
    """90,000 rows (2.5 h at 10 Hz) take about 40 ms."""
    n = 90_000
    time_s = np.arange(n) * 0.1
    signals = Signals(
        time_s, 25.0 + 30.0 * np.sin(time_s / 7.0), np.full(n, 370.0), 20.0 + time_s / 2000.0
    )
    effect = LIBRARY[effect_id]
    extended = ExtendedModel(MODEL, CAPACITY_AH).with_effect(effect, middle(effect))
    with at_most(0.5):
        extended.predict(signals, 100.0, np.arange(0, n, 10))
