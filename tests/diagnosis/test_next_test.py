"""The next test: limits, profiles, and what is expected of a test."""

from __future__ import annotations

import csv
import io
from dataclasses import replace

import numpy as np
import pytest
from days import more_volts, short_day
from hypothesis import given, settings
from hypothesis import strategies as st

from cangauge.diagnosis.bayes_factors import scores
from cangauge.diagnosis.hypotheses import Hypotheses
from cangauge.diagnosis.linear_gaussian import ErrorModel, Posterior
from cangauge.diagnosis.next_test import (
    Outcomes,
    PlannedTest,
    design_of,
    expected_of,
    nats_by_effect,
)
from cangauge.diagnosis.posterior import EffectEvidence, Evidence
from cangauge.diagnosis.problem import build_problem
from cangauge.diagnosis.profiles import Limits, Profile, library_of_tests
from cangauge.diagnosis.verdict import decide
from cangauge.errors import InputError
from cangauge.inference.time_scales import SCALES
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import discharged_ah
from cangauge.model.effects.base import Pack
from cangauge.model.effects.library import LIBRARY, candidates
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH, leaf_2012_model

PACK = Pack.of(leaf_2012_model(), CAPACITY_AH)
LIMITS = Limits(100.0, 60.0, (30.0, 80.0), (0.0, 25.0))
CHOICES = tuple(
    candidates([LIBRARY[name]], PACK, np.arange(1000.0))[0]
    for name in ("voltage_offset", "voltage_gain")
)
CAUSES = tuple(choice.effect.id for choice in CHOICES)
WIDTH = np.array([np.ptp(choice.bounds) for choice in CHOICES]) / 4.0


def library(limits: Limits = LIMITS) -> list[Profile]:
    return library_of_tests(limits, PACK, usual_c=20.0, lead_s=70.0)


def information(nats: float, correlation: float) -> np.ndarray:
    """Curvature of two amplitudes, each known with `nats` at half the width of its prior."""
    correlated = np.array([[1.0, correlation], [correlation, 1.0]])
    return 8.0 * nats * correlated / WIDTH / WIDTH[:, None]


def expected(added: np.ndarray) -> PlannedTest:
    """What is expected of a test after logs that see the sum of two effects alone."""
    curvature = information(10.0, 0.999)
    now = Posterior(
        Hypotheses(CHOICES, None, np.ones(1)),
        ErrorModel((0.25,) * SCALES, (), 0.5, overdispersion=dict.fromkeys(CAUSES, 1.0)),
        curvature @ (0.5 * WIDTH * [1.0, 0.0]), curvature, 0.0, np.zeros(1), np.zeros((1, 2)),
        np.eye(1),
    )  # fmt: skip
    outcomes = Outcomes.of(now, CAUSES, np.random.default_rng(0))
    return expected_of(library()[0], now, added, outcomes, judged(now))


def judged(now: Posterior) -> Evidence:
    """Evidence on logs whose error both effects explain equally well."""
    nats = nats_by_effect(now, now.gradient[None], now.curvature)
    effects = tuple(
        EffectEvidence(score, float(nats[score.effect_id][0]), 10.0, 1.0) for score in scores(now)
    )
    return Evidence(effects, 10.0, 50.0, 4.0, 10.0, 1.0)


def test_a_test_without_information_changes_nothing() -> None:
    found, now = expected(np.zeros((2, 2))), expected(np.zeros((2, 2)))
    assert found.information_nats == pytest.approx(0.0, abs=1e-9)
    assert found.expected == now.expected
    assert sum(found.expected.values()) < 1.0


def test_a_test_that_sees_causes_apart_names_the_true_one() -> None:
    found = expected(information(60.0, 0.0))
    assert min(found.expected.values()) > 0.9


def test_more_of_what_cannot_separate_them_does_not_help() -> None:
    same, apart = expected(information(20.0, 0.999)), expected(information(20.0, 0.0))
    assert max(same.expected.values()) < 0.65
    assert min(apart.expected.values()) > max(same.expected.values()) + 0.2
    assert same.information_nats < 0.3 * apart.information_nats


@settings(max_examples=30)
@given(
    discharge_a=st.floats(1.0, 400.0),
    charge_a=st.floats(0.0, 300.0),
    low=st.floats(0.0, 60.0),
    width=st.floats(2.0, 40.0),
    minutes=st.floats(10.0, 60.0),
)
def test_every_profile_keeps_the_limits(
    discharge_a: float, charge_a: float, low: float, width: float, minutes: float
) -> None:
    limits = Limits(discharge_a, charge_a, (low, low + width), (0.0, 25.0), minutes)
    for profile in library(limits):
        current = profile.current_a
        assert current.max() <= discharge_a
        assert current.min() >= -charge_a
        second_pct = 100.0 * max(discharge_a, charge_a) / 3600.0 / CAPACITY_AH
        assert profile.soc_pct.min() >= low - second_pct
        assert profile.soc_pct.max() <= low + width + second_pct
        assert not current[:70].any()
        out_ah = discharged_ah(profile.time_s, current)[-1]
        moved_pct = profile.soc_pct[0] - profile.soc_pct[-1]
        assert moved_pct == pytest.approx(100.0 * out_ah / CAPACITY_AH, abs=second_pct)


def test_library_leaves_out_what_the_limits_exclude() -> None:
    def names(**changes: float) -> set[str]:
        return {profile.name for profile in library(replace(LIMITS, **changes))}

    assert "cold start and drive" in names()
    assert "cold start and drive" not in names(temperature_c=(18.0, 25.0))
    assert {"rest", "drive"} < names(charge_a=0.0)
    assert not {"regeneration pulses", "warm-up by alternating pulses"} & names(charge_a=0.0)


def test_a_further_log_is_as_if_diagnosed_from_the_start(
    model: Model, short_references: list[Log]
) -> None:
    """What a plan predicts is what a diagnosis of both logs is made of."""
    first, test = (more_volts(short_day(seed), 3.0) for seed in (21, 22))
    problem = build_problem([first], model, short_references)
    joined = replace(problem, diagnosed=(*problem.diagnosed, design_of(problem, test)))
    whole = build_problem([first, test], model, short_references)
    assert decide(joined).probabilities == pytest.approx(decide(whole).probabilities, abs=1e-6)


def test_csv_says_where_to_start_and_gives_every_second() -> None:
    profile = next(each for each in library() if each.name.startswith("pulse ladder"))
    rows = list(csv.DictReader(io.StringIO(profile.to_csv())))
    assert [float(row["time_s"]) for row in rows] == profile.time_s.tolist()
    assert np.allclose([float(row["current_a"]) for row in rows], profile.current_a, atol=0.01)
    assert "start at 80 % SoC and 20 °C" in rows[0]["comment"]
    assert {"pulse", "discharge to the second level"} <= {row["comment"] for row in rows}


@pytest.mark.parametrize(
    ("given", "field"),
    [("current=1", "LOW:HIGH"), ("soc=20:120", "within 0 … 100"), ("speed=3", "unknown limit"),
     ("soc=60:40", "lower limit"), ("minutes=2", "a number"), ("soc=a:b", "LOW:HIGH")],
)  # fmt: skip
def test_limits_that_cannot_be_are_refused(given: str, field: str) -> None:
    with pytest.raises(InputError, match=field):
        LIMITS.changed(given)


def test_limits_of_the_user_replace_the_defaults() -> None:
    found = LIMITS.changed("current=-20:50,soc=40:60,minutes=30")
    assert found == Limits(50.0, 20.0, (40.0, 60.0), (0.0, 25.0), 30.0)
