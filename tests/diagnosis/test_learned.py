"""What references teach where structure acts on what coefficients multiply."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cangauge.diagnosis import references as learned_module
from cangauge.diagnosis.cross_validation import rms
from cangauge.diagnosis.extended_model import library_without
from cangauge.diagnosis.problem import DiagnosisProblem, build_problem
from cangauge.diagnosis.references import Learned
from cangauge.identify.fit import fit
from cangauge.inference.linearized import residual
from cangauge.inference.rows import sample_log
from cangauge.logs.log import Log
from cangauge.model.effects.first_order import low_passed
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH, leaf_2012_model
from synthetic import synthetic_log

NOISE_V = 0.3
KT_V_K = leaf_2012_model().kt_v_per_k


def day(seed: int) -> Log:
    return synthetic_log(hours=0.6, start_pct=85.0, end_pct=65.0, noise_v=NOISE_V, seed=seed)


def warm_inside(log: Log, rise_k: float) -> Log:
    """Cells that 30 A warm by `rise_k` beyond what the sensor tells."""
    rise = low_passed(log.time_s, rise_k * (log.current_a / 30.0) ** 2, 800.0, 0.0)
    return replace(log, voltage_v=log.voltage_v + KT_V_K * rise)


@pytest.fixture(scope="module")
def model() -> Model:
    """Of logs that say next to nothing of kt: it is a twentieth of the pack's."""
    logs = [synthetic_log(noise_v=NOISE_V, seed=seed) for seed in (1, 2, 3)]
    without = [
        replace(log, voltage_v=log.voltage_v - 0.95 * KT_V_K * (log.temperature_c - 20.0))
        for log in logs
    ]
    return fit(without, capacity_ah=CAPACITY_AH).model


def learned(model: Model, rise_k: float) -> DiagnosisProblem:
    references = [warm_inside(day(seed), rise_k) for seed in (11, 12, 13)]
    return build_problem([warm_inside(day(21), rise_k)], model, references, library_without([]))


@pytest.mark.parametrize("rise_k", [1.0, 3.0])
def test_a_rise_and_kt_are_told_apart(rise_k: float, model: Model) -> None:
    """In columns of the model's own kt the rise is twenty times too large."""
    settled = learned(model, rise_k)
    assert settled.model.model.kt_v_per_k == pytest.approx(KT_V_K, rel=0.05)
    assert settled.acting is not None
    another = sample_log(warm_inside(day(31), rise_k), settled.options)
    assert rms(residual(another, settled.acting)) < 1.15 * NOISE_V


def test_references_that_the_structure_explains_do_not_stray(model: Model) -> None:
    strays = [*learned(model, 1.0).error.strays.values()]
    assert np.exp(np.mean(np.log(strays))) < 2.0


def test_a_reference_has_its_own_moments(model: Model) -> None:
    """A moment is a part of a log's length: a short reference has all that a long log has."""
    short = synthetic_log(hours=0.3, start_pct=80.0, end_pct=70.0, noise_v=NOISE_V, seed=14)
    references = [day(11), day(12), short]
    settled = build_problem(
        [synthetic_log(hours=2.0, seed=5)], model, references, library_without([])
    )
    frame = settled.frame
    moments = [k for k, at in enumerate(frame.shown) if "start_s" in frame.choices[at].shape]
    assert moments
    for terms in settled.references:
        assert all(np.any(terms.effects[k] != 0.0) for k in moments)


def test_where_no_step_does_the_most_probable_is_taken(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps that go round in circles: the second of three was the best."""
    chances = iter([100.0, 50.0, 60.0, 55.0])
    steps: list[Learned] = []

    def step(*given: Any) -> Learned:
        steps.append(take_step(*given))
        return steps[-1]

    take_step = learned_module._step
    monkeypatch.setattr(learned_module, "log_likelihood", lambda *_: next(chances))
    monkeypatch.setattr(learned_module, "_step", step)
    settled = learned(model, 3.0)
    assert len(steps) == 3
    assert settled.acting is steps[1].acting
    assert settled.frame is steps[1].frame
    for terms, again in zip(settled.references, steps[1].references, strict=True):
        np.testing.assert_array_equal(terms.residual_v, again.residual_v)
