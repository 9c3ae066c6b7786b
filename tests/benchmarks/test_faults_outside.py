"""Faults that are no effect of the library, as `benchmarks/weights` injects them."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.weights.outside import OUTSIDE, inject_outside, is_active

from cangauge import simulate
from cangauge.extras.validation.twin.injection import fit_surrogate_pack
from cangauge.extras.validation.twin.pack import TwinPack
from cangauge.extras.validation.twin.recording import rms
from cangauge.logs.log import Log

SENSED = {
    "current_clipping": "current_a",
    "current_remanence": "current_a",
    "temperature_stuck": "temperature_c",
}
"""Faults that change another signal than the voltage."""


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(seed=4, pack="leaf24", hours=0.3, start_soc_pct=80.0).log


@pytest.fixture(scope="module")
def surrogate(log: Log) -> TwinPack:
    return fit_surrogate_pack([log], capacity_ah=60.0, cells=96)


@pytest.mark.parametrize("effect", OUTSIDE)
def test_each_changes_its_signal_alone_and_opens_a_gap(
    effect: str, log: Log, surrogate: TwinPack
) -> None:
    _, largest = OUTSIDE[effect].limits(surrogate)
    changed, gap_v = inject_outside(log, surrogate, effect, largest, seed=2)
    assert rms(gap_v) > 0.3
    own = SENSED.get(effect, "voltage_v")
    for name in ("current_a", "voltage_v", "temperature_c"):
        same = np.allclose(getattr(changed, name), getattr(log, name))
        assert same is (name != own)


def test_a_hidden_load_discharges_the_pack(log: Log, surrogate: TwinPack) -> None:
    _, gap_v = inject_outside(log, surrogate, "parasitic_switching", 15.0, seed=2)
    assert gap_v.min() < -0.3
    assert gap_v.max() < 0.05


def test_intermittent_is_active_for_its_share() -> None:
    on = is_active(np.arange(0.0, 4e5, 1.0), 3, on_s=100.0, off_s=300.0)
    assert not on[0]
    assert np.mean(on) == pytest.approx(0.25, abs=0.03)
    # Long logs too: it still switches at the end.
    assert 0 < np.mean(on[-40000:]) < 0.6
