"""Verdict: what follows from one posterior, and the ceiling against simulated logs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.diagnosis import Verdict
from cangauge.diagnosis.bayes_factors import Score
from cangauge.diagnosis.hypotheses import Hypotheses
from cangauge.diagnosis.linear_gaussian import ErrorModel, Posterior
from cangauge.diagnosis.verdict import SEPARATE_NATS, ceiling_of, credible_set
from cangauge.inference.time_scales import SCALES
from cangauge.model.effects.base import Pack
from cangauge.model.effects.library import LIBRARY, candidates
from cangauge.model.published import CAPACITY_AH, leaf_2012_model

PACK = Pack.of(leaf_2012_model(), CAPACITY_AH)
CHOICES = tuple(
    candidates([LIBRARY[name]], PACK, np.arange(1000.0))[0]
    for name in ("voltage_offset", "voltage_gain", "current_offset")
)


def verdict(alarm_below: float = 0.02, **stated: float) -> Verdict:
    cause = max(stated, key=stated.__getitem__)
    return Verdict(cause, stated, (), (), 0.5, alarm_below)


@given(st.lists(st.floats(0.001, 1.0), min_size=2, max_size=22))
def test_credible_set_is_the_smallest_that_holds_enough(weights: list[float]) -> None:
    total = sum(weights)
    stated = {f"answer {k}": weight / total for k, weight in enumerate(weights)}
    found = credible_set(stated)
    held = sum(stated[name] for name in found)
    assert held >= 0.9 - 1e-12
    assert held - min(stated[name] for name in found) < 0.9
    assert max(stated, key=stated.__getitem__) == found[0]


def test_alarm_and_name_are_two_questions() -> None:
    unclear = verdict(voltage_offset=0.35, none=0.25, voltage_gain=0.25, unknown=0.15)
    assert (unclear.cause, unclear.detected) == ("voltage_offset", False)
    sure = verdict(voltage_offset=0.35, none=0.01, voltage_gain=0.34, unknown=0.3)
    assert (sure.cause, sure.detected) == ("voltage_offset", True)
    assert verdict(0.3, voltage_offset=0.75, none=0.25, unknown=0.0).detected


def test_family_and_set_follow_from_the_posterior() -> None:
    found = verdict(
        voltage_offset=0.5, voltage_gain=0.3, unknown=0.12, current_offset=0.05, none=0.03
    )
    assert found.credible_set == ("voltage_offset", "voltage_gain", "unknown")
    assert found.ambiguous_with == ("voltage_gain",)
    assert found.family == "voltage_sensing"
    assert found.family_probability == pytest.approx(0.8)
    healthy = verdict(none=0.8, voltage_offset=0.2)
    assert healthy.ambiguous_with == ()
    assert healthy.family_probability == 0.8


def posterior(correlation: float, nats: float) -> tuple[Posterior, Score]:
    """The first effect at a size that none lacks by `nats`; the second correlates with it."""
    width = np.array([np.ptp(choice.bounds) for choice in CHOICES]) / 4.0
    amplitude = 0.5 * width[:1]
    correlated = np.eye(3)
    correlated[0, 1] = correlated[1, 0] = correlation
    information = 2.0 * nats / 0.25
    curvature = information * correlated / width / width[:, None]
    ones = dict.fromkeys((choice.effect.id for choice in CHOICES), 1.0)
    error = ErrorModel((0.25,) * SCALES, (), 0.5, overdispersion=ones)
    hypotheses = Hypotheses(CHOICES, None, np.ones(1))
    none = np.zeros(3)
    found = Posterior(
        hypotheses, error, none, curvature, 0.0, np.zeros(1), np.zeros((1, 3)), np.eye(1)
    )
    return found, Score("voltage_offset", nats, (0,), amplitude, np.eye(1), 0.0)


def test_ceiling_is_low_where_effects_look_alike() -> None:
    alike, apart = (ceiling_of(*posterior(correlation, 40.0)) for correlation in (1.0, 0.0))
    assert alike.probability_of_best == pytest.approx(0.5, abs=0.02)
    assert apart.probability_of_best > 0.99
    assert next(iter(alike.isolable_from)) == "voltage_gain"
    assert alike.isolable_from["voltage_gain"] < 1.0
    assert apart.isolable_from["voltage_gain"] == pytest.approx(40.0)


def test_expected_evidence_matches_the_correlation() -> None:
    found = ceiling_of(*posterior(0.6, 40.0))
    # The rival explains the square of the correlation of the first one's sum of squares.
    assert found.isolable_from["voltage_gain"] == pytest.approx(40.0 * (1.0 - 0.36), rel=0.02)
    part = found.parts_needed()["voltage_gain"]
    assert part == pytest.approx(math.sqrt(SEPARATE_NATS / 25.6), rel=0.02)


def test_ceiling_rises_with_the_size() -> None:
    found = [ceiling_of(*posterior(0.95, nats)) for nats in (2.0, 20.0, 200.0)]
    best = [each.probability_of_best for each in found]
    assert best[0] < best[1] < best[2]
    assert best[2] > 0.95
