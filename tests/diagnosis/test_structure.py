"""Structure learned from references, also where it acts on what coefficients multiply."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from days import short_day

from cangauge.diagnosis import rms, structure
from cangauge.diagnosis.extended_model import extend
from cangauge.diagnosis.problem import DiagnosisProblem, build_problem
from cangauge.diagnosis.structure import ReferenceModel, reference_matrix, select_structure
from cangauge.identify.fit import fit
from cangauge.inference.linearized import residual
from cangauge.inference.rows import sample_log
from cangauge.logs.log import Log
from cangauge.model.effects.first_order import low_passed
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH, leaf_2012_model
from synthetic import synthetic_log

NOISE_V = 0.3
POLARISED_OHM = 0.1
KT_V_K = leaf_2012_model().kt_v_per_k


def day(seed: int) -> Log:
    return short_day(seed, NOISE_V)


def warm_inside(log: Log, rise_k: float) -> Log:
    """Cells that 30 A warm by `rise_k` above the sensor."""
    rise = low_passed(log.time_s, rise_k * (log.current_a / 30.0) ** 2, 800.0, 0.0)
    return replace(log, voltage_v=log.voltage_v + KT_V_K * rise)


@pytest.fixture(scope="module")
def kt_model() -> Model:
    """A model whose kt is a twentieth of the pack's."""
    logs = [synthetic_log(noise_v=NOISE_V, seed=seed) for seed in (1, 2, 3)]
    without = [
        replace(log, voltage_v=log.voltage_v - 0.95 * KT_V_K * (log.temperature_c - 20.0))
        for log in logs
    ]
    return fit(without, capacity_ah=CAPACITY_AH).model


def learned(kt_model: Model, rise_k: float) -> DiagnosisProblem:
    references = [warm_inside(day(seed), rise_k) for seed in (11, 12, 13)]
    return build_problem([warm_inside(day(21), rise_k)], kt_model, references)


@pytest.fixture(scope="module")
def slightly_warm(kt_model: Model) -> DiagnosisProblem:
    return learned(kt_model, 1.0)


@pytest.fixture(scope="module")
def very_warm(kt_model: Model) -> DiagnosisProblem:
    return learned(kt_model, 3.0)


@pytest.mark.parametrize(("name", "rise_k"), [("slightly_warm", 1.0), ("very_warm", 3.0)])
def test_a_temperature_rise_and_kt_are_distinguished(
    name: str, rise_k: float, request: pytest.FixtureRequest
) -> None:
    """With columns of the model's own kt the rise comes out twenty times too large."""
    problem = request.getfixturevalue(name)
    assert problem.model.model.kt_v_per_k == pytest.approx(KT_V_K, rel=0.05)
    assert problem.structured is not None
    another = sample_log(warm_inside(day(31), rise_k), problem.options)
    assert rms(residual(another, problem.structured)) < 1.15 * NOISE_V


def test_explained_references_are_not_overdispersed(slightly_warm: DiagnosisProblem) -> None:
    overdispersion = [*slightly_warm.error.overdispersion.values()]
    assert np.exp(np.mean(np.log(overdispersion))) < 2.0


def test_a_short_reference_has_all_onsets(kt_model: Model) -> None:
    """Onsets scale with the length of a log."""
    short = synthetic_log(hours=0.3, start_pct=80.0, end_pct=70.0, noise_v=NOISE_V, seed=14)
    references = [day(11), day(12), short]
    problem = build_problem([synthetic_log(hours=2.0, seed=5)], kt_model, references)
    hypotheses = problem.hypotheses
    onsets = [
        k
        for k, at in enumerate(hypotheses.reference_columns)
        if "start_s" in hypotheses.candidates[at].shape
    ]
    assert onsets
    for sampled in problem.references:
        matrix = reference_matrix(sampled, problem.model, hypotheses, problem.structured)
        assert all(np.any(matrix.effects[k] != 0.0) for k in onsets)


def test_without_convergence_the_best_step_is_taken(
    kt_model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second of three steps has the most probable references."""
    probabilities = iter([100.0, 50.0, 60.0, 55.0])
    steps: list[ReferenceModel] = []

    def step(*given: Any) -> ReferenceModel:
        steps.append(take_step(*given))
        return steps[-1]

    take_step = structure._step
    monkeypatch.setattr(structure, "log_likelihood", lambda *_: next(probabilities))
    monkeypatch.setattr(structure, "_step", step)
    problem = learned(kt_model, 3.0)
    assert len(steps) == 3
    assert problem.structured is steps[1].structured
    assert problem.hypotheses is steps[1].hypotheses
    np.testing.assert_array_equal(problem.reference_equations.products, steps[1].total.products)


def polarised(log: Log) -> Log:
    """A polarisation of 400 s, which no delay of the model can follow."""
    slow = low_passed(log.time_s, log.current_a, 400.0, 0.0)
    return replace(log, voltage_v=log.voltage_v - POLARISED_OHM * slow)


def selected(problem: DiagnosisProblem) -> set[str]:
    pieces = select_structure(problem.hypotheses, problem.reference_equations, problem.error)
    return {problem.hypotheses.candidates[k].effect.id for k in pieces}


def test_a_pack_that_obeys_the_model_needs_no_structure(
    model: Model, short_references: list[Log]
) -> None:
    problem = build_problem([short_day(21)], model, short_references)
    assert selected(problem) == set()
    assert extend(problem, []).model.effects == ()


def test_the_references_structure_is_in_the_extended_model(
    model: Model, short_references: list[Log]
) -> None:
    references = [polarised(log) for log in short_references]
    problem = build_problem([polarised(short_day(21))], model, references)
    assert "slow_diffusion" in selected(problem)
    extended = extend(problem, []).model
    assert "slow_diffusion" in {effect.id for effect, _ in extended.effects}
    another = sample_log(polarised(short_day(31)), problem.options)
    assert rms(residual(another, extended)) < 1.1 * 0.5
    assert rms(residual(another, model.extended_model())) > 1.5 * 0.5
