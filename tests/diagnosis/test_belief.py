"""Beliefs: probabilities that know no names, and fall or rise with what speaks for an effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.diagnosis.bayes_factors import Score
from cangauge.diagnosis.posterior import Compared, Witness, believe

CLEAN_V, BEFORE_V, EXCESS, EXPECTED_V = 0.5, 1.5, 1000.0, 0.6

evidence = st.floats(-3.0, 3000.0)
left = st.floats(0.05, 3.0)


def witness(effect_id: str, log_bayes: float, left_v: float, left_excess: float) -> Witness:
    score = Score(effect_id, log_bayes, (0,), np.zeros(1), np.eye(1), 0.0)
    return Witness(score, log_bayes, 3.0 * log_bayes, left_v, left_excess)


def compared(*witnesses: Witness, before_v: float = BEFORE_V) -> Compared:
    return Compared(witnesses, before_v, CLEAN_V, EXCESS, EXPECTED_V)


@st.composite
def comparisons(draw: st.DrawFn) -> Compared:
    number = draw(st.integers(1, 6))
    return compared(
        *(
            witness(f"effect_{k}", draw(evidence), draw(left), draw(st.floats(0.0, 2.0 * EXCESS)))
            for k in range(number)
        ),
        before_v=draw(st.floats(0.0, 10.0)),
    )


@given(comparisons())
def test_beliefs_are_probabilities(given_: Compared) -> None:
    belief = believe(given_)
    assert belief.shares.sum() == pytest.approx(1.0)
    assert (np.diff(belief.shares) <= 0.0).all()
    assert 0.0 <= belief.none <= 1.0
    assert 0.0 <= belief.best <= 1.0
    assert belief.none + belief.best <= 1.0 + 1e-12


@given(comparisons(), st.randoms())
def test_neither_names_nor_their_order_matter(given_: Compared, random: object) -> None:
    shuffled = list(given_.witnesses)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    renamed = tuple(
        replace(each, score=replace(each.score, effect_id=f"other_{each.score.effect_id}"))
        for each in shuffled
    )
    one, other = believe(given_), believe(replace(given_, witnesses=renamed))
    np.testing.assert_allclose(one.shares, other.shares)
    assert one.none == pytest.approx(other.none)
    assert one.best == pytest.approx(other.best)


def test_of_equals_the_one_that_leaves_less_is_first_whatever_their_order() -> None:
    """Below what is weighed, they are equals; what is explained still tells them apart."""
    more, less = witness("more", 0.0, 1.0, 1.0), witness("less", 0.0, 1.0, 0.0)
    beliefs = [believe(compared(*pair, before_v=0.0)) for pair in ((more, less), (less, more))]
    for belief in beliefs:
        assert [each.score.effect_id for each in belief.witnesses] == ["less", "more"]
    assert beliefs[0].none == beliefs[1].none


def test_of_two_with_like_evidence_the_one_that_takes_the_volts_away_is_believed() -> None:
    """Evidence counts what is certain; a cause must also be large enough."""
    small, large = witness("small", 50.0, 1.4, 500.0), witness("large", 49.5, 0.5, 500.0)
    belief = believe(compared(small, large))
    assert [each.score.effect_id for each in belief.witnesses] == ["large", "small"]


def test_more_evidence_that_explains_more_leaves_less_to_chance() -> None:
    beside = witness("beside", 0.0, 1.5, 950.0)
    beliefs = [
        believe(compared(witness("cause", log_bayes, left_v, left_excess), beside))
        for log_bayes, left_v, left_excess in (
            (0.0, 1.4, 900.0),
            (5.0, 1.0, 600.0),
            (50.0, 0.7, 300.0),
            (500.0, 0.5, 20.0),
        )
    ]
    assert (np.diff([belief.none for belief in beliefs]) < 0.0).all()
    assert (np.diff([belief.best for belief in beliefs]) > 0.0).all()
    assert beliefs[0].none > 10.0 * beliefs[-1].none
    assert beliefs[-1].best > 0.6


def test_two_that_cannot_be_told_apart_share() -> None:
    """However certain that one of them is it, neither is."""
    alike = [witness(name, 500.0, 0.5, 20.0) for name in ("one", "other")]
    belief = believe(compared(*alike))
    assert belief.shares[0] == pytest.approx(belief.shares[1])
    alone = believe(compared(alike[0], witness("beside", 0.0, 1.5, 950.0)))
    assert belief.best < alone.best
    assert belief.none < 0.1


def test_what_is_too_small_for_volts_is_explained_in_units_of_chance() -> None:
    seen = compared(witness("cause", 50.0, 0.75, 900.0))
    assert seen.explained(seen.witnesses[0]) == pytest.approx(
        (1.5**2 - 0.75**2) / (1.5**2 - 0.5**2)
    )
    unseen = compared(witness("cause", 50.0, 0.5, 250.0), before_v=0.52)
    assert unseen.explained(unseen.witnesses[0]) == pytest.approx(0.75)
