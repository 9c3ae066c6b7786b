"""Diagnosis with a model from `fit --effects`: its effects stay and are no new cause."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cangauge.diagnosis import diagnose
from cangauge.diagnosis.design_matrix import design_matrix
from cangauge.diagnosis.problem import build_problem
from cangauge.diagnosis.references import with_wider_range
from cangauge.diagnosis.verdict import decide
from cangauge.identify.fit import fit
from cangauge.inference.linearized import residual
from cangauge.inference.rows import FitOptions, sample_log
from cangauge.logs.log import Log
from cangauge.model.effects.base import Signals
from cangauge.model.effects.library import LIBRARY, candidates
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH, leaf_2012_model
from synthetic import synthetic_log

COLD = {"share": 0.8, "activation_k": 3500.0, "delayed": 1.0, "reference_c": 20.0, "lag_s": 0.0}
TRUTH = ExtendedModel(
    replace(leaf_2012_model(), temperature_range_c=(-20.0, 40.0)),
    CAPACITY_AH,
    ((LIBRARY["resistance_temperature"], COLD),),
)
OPTIONS = FitOptions(capacity_ah=CAPACITY_AH)


def day(seed: int, temperature_c: float, offset_a: float = 0.0) -> Log:
    """A drive at some temperature; the current sensor reads `offset_a` too much."""
    log = synthetic_log(hours=0.6, start_pct=85.0, end_pct=60.0, seed=seed, name=f"day {seed}")
    log = replace(log, temperature_c=log.temperature_c - 23.0 + temperature_c)
    signals = Signals(log.time_s, log.current_a, np.zeros(len(log)), log.temperature_c)
    volts = TRUTH.predict(signals, 85.0, np.arange(len(log))).voltage_v
    noise = np.random.default_rng(seed).normal(0.0, 0.5, len(log))
    return replace(log, voltage_v=volts + noise, current_a=log.current_a + offset_a)


@pytest.fixture(scope="module")
def model() -> Model:
    logs = [day(1, 8.0), day(2, 15.0), day(3, 22.0), day(4, 29.0)]
    effects = ("resistance_temperature",)
    return fit(logs, capacity_ah=CAPACITY_AH, effects=effects, name="with effects").model


def test_a_wider_temperature_range_does_not_change_effects(model: Model) -> None:
    given = model.extended_model()
    inside = sample_log(day(5, 18.0), OPTIONS)
    wider = with_wider_range(given, [day(6, -12.0)])
    assert wider.model.temperature_range_c[0] < given.model.temperature_range_c[0] - 10.0
    assert np.array_equal(residual(inside, wider), residual(inside, given))


def test_structure_is_distinguished_from_the_models_effects() -> None:
    """Effects are in the library's order: the last need not be the one added."""
    plain = ExtendedModel(TRUTH.model, CAPACITY_AH)
    own = {"ohm": 0.02, "tau_s": 312.7, "spread": 0.0, "activation_k": 0.0, "by_slope": 0.0}
    given = plain.with_effect(LIBRARY["slow_diffusion"], own)
    item = sample_log(day(5, 18.0), OPTIONS)
    (piece, *_) = candidates([LIBRARY["resistance_soc"]], given.pack, item.log.time_s)
    amount = 0.1 * piece.bounds[:, 1]
    structured = given.with_effect(piece.effect, piece.values(amount))
    assert structured.effects[0][0].id == "resistance_soc"
    matrix = design_matrix(item, given, [piece], structured)
    expected = residual(item, structured) + matrix.effects[0] @ amount
    np.testing.assert_allclose(matrix.residual_v, expected, atol=1e-9)


@pytest.fixture(scope="module")
def references() -> list[Log]:
    return [day(seed, celsius) for seed, celsius in ((11, 9.0), (12, 18.0), (13, 27.0))]


def test_a_fault_is_named_beside_the_models_effects(model: Model, references: list[Log]) -> None:
    found = diagnose([day(21, 14.0, 4.0), day(22, 24.0, 4.0)], model, references)
    assert "current_offset" in {found.verdict.cause, *found.verdict.ambiguous_with}
    better = found.extended_model.extended_model()
    kept = [
        values
        for effect, values in better.effects
        if effect.id == "resistance_temperature" and values["delayed"] == 1.0
    ]
    (given,) = [values for _, values in model.extended_model().effects]
    assert given["reference_c"] in {values["reference_c"] for values in kept}


def test_the_models_effects_are_no_gap(model: Model, references: list[Log]) -> None:
    assert decide(build_problem([day(21, 8.0)], model, references)).cause == "none"
