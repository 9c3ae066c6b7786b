"""Classifier: probabilities that depend on the features of effects, not on their names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.diagnosis.bayes_factors import Score
from cangauge.diagnosis.classifier import (
    TRAINED_OUTSIDE,
    Comparison,
    EffectFeatures,
    classify,
    stated_probabilities,
    with_outside_prior,
)

REFERENCE_V, BASELINE_V, EXCESS, EXPECTED_V = 0.5, 1.5, 1000.0, 0.6

evidence = st.floats(-3.0, 3000.0)
rmse = st.floats(0.05, 3.0)


def effect(effect_id: str, log_bayes: float, rmse_v: float, excess: float) -> EffectFeatures:
    score = Score(effect_id, log_bayes, (0,), np.zeros(1), np.eye(1), 0.0)
    return EffectFeatures(score, log_bayes, 3.0 * log_bayes, rmse_v, excess)


def comparison(*effects: EffectFeatures, baseline_v: float = BASELINE_V) -> Comparison:
    return Comparison(effects, baseline_v, REFERENCE_V, EXCESS, EXPECTED_V)


@st.composite
def comparisons(draw: st.DrawFn) -> Comparison:
    number = draw(st.integers(1, 6))
    return comparison(
        *(
            effect(f"effect_{k}", draw(evidence), draw(rmse), draw(st.floats(0.0, 2.0 * EXCESS)))
            for k in range(number)
        ),
        baseline_v=draw(st.floats(0.0, 10.0)),
    )


@given(comparisons())
def test_results_are_probabilities(given_: Comparison) -> None:
    found = classify(given_)
    assert found.shares.sum() == pytest.approx(1.0)
    assert (np.diff(found.shares) <= 0.0).all()
    assert 0.0 <= found.none <= 1.0
    assert 0.0 <= found.best <= 1.0
    assert found.none + found.best <= 1.0 + 1e-12


@given(comparisons(), st.randoms())
def test_names_and_order_of_effects_do_not_matter(given_: Comparison, random: object) -> None:
    shuffled = list(given_.effects)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    renamed = tuple(
        replace(each, score=replace(each.score, effect_id=f"other_{each.score.effect_id}"))
        for each in shuffled
    )
    one, other = classify(given_), classify(replace(given_, effects=renamed))
    np.testing.assert_allclose(one.shares, other.shares)
    assert one.none == pytest.approx(other.none)
    assert one.best == pytest.approx(other.best)


def test_ties_go_to_the_effect_that_leaves_less() -> None:
    """Below the resolution of the features, what remains still orders them."""
    more, less = effect("more", 0.0, 1.0, 1.0), effect("less", 0.0, 1.0, 0.0)
    both = [classify(comparison(*pair, baseline_v=0.0)) for pair in ((more, less), (less, more))]
    for found in both:
        assert [each.score.effect_id for each in found.effects] == ["less", "more"]
    assert both[0].none == both[1].none


def test_of_equal_evidence_the_larger_effect_is_first() -> None:
    """Evidence measures certainty; a cause must also be large enough."""
    small, large = effect("small", 50.0, 1.4, 500.0), effect("large", 49.5, 0.5, 500.0)
    found = classify(comparison(small, large))
    assert [each.score.effect_id for each in found.effects] == ["large", "small"]


def test_more_evidence_makes_a_cause_more_probable() -> None:
    beside = effect("beside", 0.0, 1.5, 950.0)
    found = [
        classify(comparison(effect("cause", log_bayes, rmse_v, excess), beside))
        for log_bayes, rmse_v, excess in (
            (0.0, 1.4, 900.0),
            (5.0, 1.0, 600.0),
            (50.0, 0.7, 300.0),
            (500.0, 0.5, 20.0),
        )
    ]
    assert (np.diff([each.none for each in found]) < 0.0).all()
    assert (np.diff([each.best for each in found]) > 0.0).all()
    assert found[0].none > 10.0 * found[-1].none
    assert found[-1].best > 0.6


def test_indistinguishable_effects_share_the_probability() -> None:
    """However certain that one of them is the cause, neither is."""
    alike = [effect(name, 500.0, 0.5, 20.0) for name in ("one", "other")]
    found = classify(comparison(*alike))
    assert found.shares[0] == pytest.approx(found.shares[1])
    alone = classify(comparison(alike[0], effect("beside", 0.0, 1.5, 950.0)))
    assert found.best < alone.best
    assert found.none < 0.1


def test_a_gap_too_small_for_volts_is_judged_by_its_excess() -> None:
    seen = comparison(effect("cause", 50.0, 0.75, 900.0))
    assert seen.explained(seen.effects[0]) == pytest.approx((1.5**2 - 0.75**2) / (1.5**2 - 0.5**2))
    unseen = comparison(effect("cause", 50.0, 0.5, 250.0), baseline_v=0.52)
    assert unseen.explained(unseen.effects[0]) == pytest.approx(0.75)


@given(comparisons(), st.floats(0.01, 0.99))
def test_the_prior_of_unknown_causes_moves_no_odds_within(
    given_: Comparison, outside: float
) -> None:
    before = stated_probabilities(classify(given_))
    after = with_outside_prior(before, outside)
    assert sum(after.values()) == pytest.approx(1.0)
    effects = [name for name in before if name not in {"none", "unknown"}]
    for name in effects:
        assert after[name] * before[effects[0]] == pytest.approx(
            before[name] * after[effects[0]], abs=1e-12
        )
    same = with_outside_prior(before, TRAINED_OUTSIDE)
    assert same == pytest.approx(before)


def test_a_rarer_unknown_cause_needs_more_evidence() -> None:
    before = stated_probabilities(classify(comparison(effect("cause", 5.0, 1.3, 800.0))))
    rare, common = (with_outside_prior(before, outside) for outside in (0.05, 0.6))
    assert rare["unknown"] < before["unknown"] < common["unknown"]
    assert rare["cause"] > common["cause"]
