"""The estimator with effects in its model: the voltages of the offline model, a better SoC."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.offline import estimate_log, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.logs.log import Log
from cangauge.model.effects.base import Signals
from cangauge.model.effects.library import LIBRARY, effect_entries
from cangauge.model.model_file import Model
from cangauge.model.published import leaf_2012_model_file
from estimation.test_snapshot import half_way
from selection import nightly_except
from synthetic import synthetic_log

START_PCT = 90.0
IN_SUITE = (
    "current_gain", "voltage_gain", "resistance_temperature", "slow_diffusion", "hysteresis",
    "weak_cell",
)  # fmt: skip
"""An effect of each way to act; the others run in `make nightly`."""


@cache
def log_and_model(effect_id: str) -> tuple[Log, Model]:
    """A log that only the effect explains, and the published model with the effect."""
    effect = LIBRARY[effect_id]
    values = half_way(effect)
    plain = leaf_2012_model_file()
    wide = {"soc_pct": (0.0, 100.0), "temperature_c": (-30.0, 60.0), "current_a": (-300.0, 300.0)}
    raw = plain.model_dump() | {"effects": effect_entries([(effect, values)]), "range": wide}
    model = Model.model_validate(raw)
    log = synthetic_log(hours=0.7, rate_hz=2.0, start_pct=START_PCT, end_pct=15.0, seed=7)
    signals = Signals(log.time_s, log.current_a, log.voltage_v, log.temperature_c - 12.0)
    found = model.extended_model().predict(signals, START_PCT, np.arange(len(log)))
    shown = found.voltage_v + values.get("offset_v", 0.0)
    if effect.id == "voltage_gain":
        shown = shown * (1.0 + values["gain_pct"] / 100.0)
    return replace(
        log, voltage_v=shown, temperature_c=signals.temperature_c, soc_pct=found.soc_pct
    ), model


@pytest.mark.parametrize("effect_id", LIBRARY)
def test_online_voltage_equals_offline_voltage(effect_id: str) -> None:
    log, model = log_and_model(effect_id)
    table, _ = estimate_log(
        log, model, EstimatorSettings(method="coulomb", initial_soc_pct=START_PCT)
    )
    known = np.isfinite(table.residual_v)
    second = np.floor(log.time_s - log.time_s[0] + 1e-6)
    is_first = np.diff(second, prepend=-1.0) > 0.0
    assert np.all(known[10:] == is_first[10:]) or effect_id == "time_skew"
    assert np.abs(table.residual_v[known]).max() < 1e-6
    late = 2 if effect_id == "time_skew" else 0
    np.testing.assert_allclose(
        table.soc_coulomb_pct[late:], log.soc_pct[: len(log) - late], atol=1e-7
    )


@pytest.mark.parametrize("effect_id", nightly_except(IN_SUITE, LIBRARY))
def test_effect_improves_soc_over_plain_model(effect_id: str) -> None:
    log, model = log_and_model(effect_id)
    plain = Model.model_validate(model.model_dump() | {"effects": []})
    settings = EstimatorSettings(initial_soc_pct=START_PCT)
    extended = estimate_log(log, model, settings)[1]
    missed = estimate_log(log, plain, settings)[1]
    assert extended.soc_mae_pct < 0.05
    # With a skew, estimates are a sample or two late: 0.03 % here, as much as the effect costs.
    assert extended.soc_mae_pct < 0.5 * missed.soc_mae_pct or effect_id == "time_skew"
    assert extended.voltage_mae_pct < missed.voltage_mae_pct


def test_offset_is_found_with_polarisation_effect() -> None:
    """After a rest, as what currents before the log left in the effect is not known."""
    log, model = log_and_model("slow_diffusion")
    rest_s = np.arange(-3600.0, 0.0, 2.0)
    constant = np.ones(rest_s.size)
    rest_v = (
        model.extended_model()
        .predict(
            Signals(rest_s, 0.0 * constant, constant, log.temperature_c[0] * constant),
            START_PCT,
            np.arange(rest_s.size),
        )
        .voltage_v
    )
    log = replace(
        log,
        time_s=np.append(rest_s, log.time_s),
        current_a=np.append(0.0 * constant, log.current_a) + 3.0,
        voltage_v=np.append(rest_v, log.voltage_v),
        temperature_c=np.append(log.temperature_c[0] * constant, log.temperature_c),
        soc_pct=np.append(START_PCT * constant, log.soc_pct),
    )
    estimator = make_estimator(model, EstimatorSettings(initial_soc_pct=START_PCT))
    for sample, soc_pct in zip(samples_of(log), log.soc_pct, strict=True):
        found = estimator.step(sample)
        assert abs(found.soc_pct - soc_pct) < 2.0 * found.soc_std_pct
    assert abs(found.soc_coulomb_pct - soc_pct) > 5.0
    health = estimator.health
    assert abs(health.offset_a - 3.0) < 2.0 * health.offset_std_a
    assert health.offset_std_a < 0.9
