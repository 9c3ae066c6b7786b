"""References learned once serve any number of diagnoses."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from cangauge.diagnosis import build_problem, decide, learn_references
from cangauge.diagnosis import references as references_module
from cangauge.diagnosis import structure as structure_module
from cangauge.diagnosis.linear_gaussian import each_left_out, shared_equations
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from diagnosis.days import short_day


def test_a_learned_diagnosis_equals_one_with_the_logs(
    model: Model, short_references: list[Log]
) -> None:
    learned = pickle.loads(pickle.dumps(learn_references(short_references, model)))  # noqa: S301
    log = short_day(21)
    assert learned.covers([log])
    direct = decide(build_problem([log], model, short_references), 0.5)
    again = decide(build_problem([log], model, learned), 0.5)
    assert again.cause == direct.cause
    for name, probability in direct.probabilities.items():
        assert again.probabilities[name] == pytest.approx(probability, abs=1e-9)


def test_logs_beyond_the_references_are_not_covered(
    model: Model, short_references: list[Log]
) -> None:
    learned = learn_references(short_references[:1], model)
    log = short_day(21)
    assert not learned.covers([replace(log, temperature_c=log.temperature_c - 40.0)])
    assert not learned.covers([replace(log, soc_pct=None)])


def test_references_beyond_the_first_count_in_full(
    model: Model, short_references: list[Log], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their sum is exact; only the error model is learned on the first ones."""
    few = learn_references(short_references[:2], model)
    monkeypatch.setattr(references_module, "LEARNED_ON", 2)
    learned = learn_references(short_references, model)
    assert learned.equations.logs == len(short_references) == len(learned.references)
    assert learned.error.scale_v2 == few.error.scale_v2
    assert learned.healthy is not None
    assert len(learned.healthy.excess) == 2
    gained = np.diag(learned.equations.products)[:8] / np.diag(few.equations.products)[:8]
    assert np.all(gained > 1.0)


def test_leaving_one_out_sums_the_others(model: Model, short_references: list[Log]) -> None:
    problem = build_problem([short_day(21)], model, short_references)
    equations = list(
        structure_module.reference_equations(
            problem.references, problem.model, problem.hypotheses, problem.structured
        )
    )
    error = problem.error
    for k, others in enumerate(each_left_out(problem.hypotheses, equations, error)):
        rest = [each for number, each in enumerate(equations) if number != k]
        expected = shared_equations(problem.hypotheses, rest, error)
        assert others.logs == len(rest)
        np.testing.assert_allclose(others.products, expected.products, rtol=1e-9, atol=1e-9)
        assert others.log_det == pytest.approx(expected.log_det)


def test_nothing_is_learned_from_no_reference(model: Model) -> None:
    with pytest.raises(InputError, match="no references"):
        learn_references([], model)
