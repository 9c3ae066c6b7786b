"""The posterior over all answers: its properties, and against integrals computed otherwise."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from days import more_volts, short_day
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import gamma

from cangauge.diagnosis.bayes_factors import Score
from cangauge.diagnosis.posterior import (
    FITTED,
    NONE,
    UNEXPLAINED,
    UNKNOWN,
    EffectEvidence,
    Evidence,
    posterior_of,
    probabilities,
    reference_level,
)
from cangauge.diagnosis.problem import build_problem
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

EXCESS, MEAN_V2, USUAL, USUAL_V2 = 1000.0, 2.25, 100.0, 0.25


def effect(effect_id: str, nats: float, excess: float, mean_v2: float) -> EffectEvidence:
    score = Score(effect_id, nats, (0,), np.zeros(1), np.eye(1), 2.0 * nats)
    return EffectEvidence(score, nats, excess, mean_v2)


def evidence(*effects: EffectEvidence, all_nats: float = 50.0) -> Evidence:
    return Evidence(effects, all_nats, EXCESS, MEAN_V2, USUAL, USUAL_V2)


positive = st.floats(0.0, 1e6)


@st.composite
def evidences(draw: st.DrawFn) -> Evidence:
    effects = [
        effect(f"effect_{k}", draw(positive), draw(positive), draw(positive))
        for k in range(draw(st.integers(1, 6)))
    ]
    usual = st.floats(1e-3, 1e4)
    return Evidence(
        tuple(effects), draw(positive), draw(positive), draw(positive), draw(usual), draw(usual)
    )


@given(evidences())
def test_the_answers_are_one_distribution(given_: Evidence) -> None:
    found = posterior_of(given_)
    assert set(found) == {NONE, UNKNOWN, *(each.score.effect_id for each in given_.effects)}
    assert sum(found.values()) == pytest.approx(1.0)
    assert all(0.0 <= value <= 1.0 for value in found.values())


@given(evidences(), st.randoms(), st.floats(1e-3, 1e3))
def test_names_order_and_units_do_not_matter(
    given_: Evidence, random: object, millivolts: float
) -> None:
    shuffled = list(given_.effects)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    other = replace(
        given_,
        effects=tuple(
            replace(
                each,
                score=replace(each.score, effect_id=f"other_{each.score.effect_id}"),
                mean_square_v2=millivolts * each.mean_square_v2,
            )
            for each in shuffled
        ),
        mean_square_v2=millivolts * given_.mean_square_v2,
        reference_v2=millivolts * given_.reference_v2,
    )
    before, after = posterior_of(given_), posterior_of(other)
    for name, value in before.items():
        renamed = name if name in {NONE, UNKNOWN} else f"other_{name}"
        assert after[renamed] == pytest.approx(value, abs=1e-9)


@given(positive, positive, positive)
def test_tails_are_mixtures_over_an_unknown_scale(
    nats: float, excess: float, mean_v2: float
) -> None:
    """(1 + x)^−h is an exponential whose rate has a gamma distribution of shape h."""

    def tail(x: float) -> float:
        density = gamma(FITTED.tail).pdf
        value, _ = quad(
            lambda log_rate: (
                math.exp(log_rate - math.exp(log_rate) * x) * density(math.exp(log_rate))
            ),
            -60.0,
            6.0,
            points=[-30.0, -math.log1p(x), 0.0],
            limit=400,
        )
        return float(value)

    cause = effect("cause", nats, excess, mean_v2)
    of = posterior_of(evidence(cause, all_nats=0.0))
    healthy = tail(nats) * tail(EXCESS / USUAL) * tail(MEAN_V2 / USUAL_V2)
    faulty = tail(excess / USUAL) * tail(mean_v2 / USUAL_V2)
    expected = math.exp(FITTED.log_none) * healthy / faulty
    assert of[NONE] / of["cause"] == pytest.approx(expected, rel=1e-3)


def test_more_evidence_makes_a_cause_more_probable() -> None:
    beside = effect("beside", 0.5, 950.0, 2.2)
    steps = ((0.5, 950.0, 2.0), (5.0, 600.0, 1.0), (50.0, 300.0, 0.5), (5000.0, 20.0, 0.25))
    found = [posterior_of(evidence(effect("cause", *step), beside)) for step in steps]
    assert (np.diff([each[NONE] for each in found]) < 0.0).all()
    assert (np.diff([each["cause"] for each in found]) > 0.0).all()
    assert found[0][NONE] > found[0]["cause"]
    assert found[-1]["cause"] > 0.9


def test_indistinguishable_effects_share_the_probability() -> None:
    """However certain that one of them is the cause, neither is."""
    alike = [effect(name, 500.0, 20.0, 0.3) for name in ("one", "other")]
    found = posterior_of(evidence(*alike))
    assert found["one"] == found["other"]
    assert found[NONE] < 0.02


def test_a_gap_that_nothing_explains_is_unknown() -> None:
    poor = [effect(name, 20.0, 5e5, 15.0) for name in ("one", "other", "third")]
    large = Evidence(tuple(poor), 2e5, 6e5, 20.0, USUAL, USUAL_V2)
    assert max(posterior_of(large).items(), key=lambda item: item[1])[0] == UNKNOWN
    # An effect that leaves no more than causes outside the library usually do is preferred.
    good = effect("good", 2e5, UNEXPLAINED * 6e5, UNEXPLAINED * 20.0)
    found = posterior_of(replace(large, effects=(*poor, good)))
    assert max(found.items(), key=lambda item: item[1])[0] == "good"


def test_few_references_count_beside_a_usual_pack() -> None:
    assert reference_level(()) == reference_level((reference_level(()),))
    few, many = reference_level((1000.0,)), reference_level((1000.0,) * 20)
    assert reference_level(()) < few < many < 1000.0


def test_the_order_of_logs_does_not_matter(model: Model, short_references: list[Log]) -> None:
    logs = [more_volts(short_day(seed), 3.0) for seed in (21, 22)]
    one = probabilities(build_problem(logs, model, short_references)).of
    other = probabilities(build_problem(logs[::-1], model, short_references[::-1])).of
    for name, value in one.items():
        assert other[name] == pytest.approx(value, abs=1e-6)
