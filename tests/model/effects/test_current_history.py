"""The cached history of a current is used for that current only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from stepping import CAPACITY_AH, MODEL

from cangauge.model.effects.base import Signals
from cangauge.model.effects.library import LIBRARY
from cangauge.model.extended import ExtendedModel

ROWS = np.arange(0, 3000, 7)


def signals() -> Signals:
    """Fifty minutes of changing current."""
    rng = np.random.default_rng(4)
    time_s = np.cumsum(rng.uniform(0.5, 1.5, 3000))
    current_a = np.repeat(rng.normal(20.0, 40.0, 100), 30)
    return Signals(time_s, current_a, np.full(3000, 370.0), 20.0 + 0.002 * time_s)


def extended(**values: dict[str, float]) -> ExtendedModel:
    """The model with some effects."""
    model = ExtendedModel(MODEL, CAPACITY_AH)
    for effect_id, given in values.items():
        effect = LIBRARY[effect_id]
        model = model.with_effect(effect, {**effect.neutral(model.pack), **given})
    return model


def test_the_cache_does_not_change_predictions() -> None:
    model = extended(
        slow_diffusion={"ohm": 0.05, "tau_s": 400.0, "spread": 1.0, "by_slope": 1.0},
        core_temperature={"rise_k": 5.0, "late": 0.5, "tau_s": 500.0},
    )
    kept = signals().with_history_cache()
    for _again in range(2):
        assert np.array_equal(
            model.predict(kept, 90.0, ROWS).voltage_v,
            model.predict(signals(), 90.0, ROWS).voltage_v,
        )


def test_a_corrected_current_does_not_use_the_cache() -> None:
    diffusion = {"ohm": 0.05, "tau_s": 400.0}
    plain = extended(slow_diffusion=diffusion)
    corrected = extended(slow_diffusion=diffusion, current_gain={"gain_pct": 10.0})
    kept = signals().with_history_cache()
    plain.predict(kept, 90.0, ROWS)  # fills the cache for the measured current
    assert np.array_equal(
        corrected.predict(kept, 90.0, ROWS).voltage_v,
        corrected.predict(signals(), 90.0, ROWS).voltage_v,
    )
    assert replace(kept, temperature_c=kept.temperature_c + 5.0).history is kept.history
    assert replace(kept, current_a=2.0 * kept.current_a).history is not kept.history
    assert replace(kept, time_s=2.0 * kept.time_s).history is not kept.history
