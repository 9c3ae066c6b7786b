"""Bayes factors against quadrature, and faults that physical bounds exclude."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from days import short_day
from hypothesis import given
from hypothesis import strategies as st

from cangauge.diagnosis import diagnose
from cangauge.diagnosis.bayes_factors import PRIOR_WIDTHS, scores
from cangauge.diagnosis.hypotheses import Hypotheses
from cangauge.diagnosis.linear_gaussian import ErrorModel, Posterior
from cangauge.inference.time_scales import SCALES
from cangauge.logs.log import Log
from cangauge.model.effects.base import Pack
from cangauge.model.effects.first_order import low_passed
from cangauge.model.effects.library import LIBRARY, Candidate, candidates
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH, leaf_2012_model

PACK = Pack.of(leaf_2012_model(), CAPACITY_AH)
ERROR = ErrorModel((0.25,) * SCALES, (), 0.5)


def alone(choice: Candidate, gradient: float, curvature: float, error: ErrorModel) -> Posterior:
    """The posterior of one candidate with one amplitude: ln p(a) = g·a − S·a²/2."""
    return Posterior(
        hypotheses=Hypotheses((choice,), None, np.ones(1)),
        error=error,
        gradient=np.array([gradient]),
        curvature=np.array([[curvature]]),
        chi_square=0.0,
        mean=np.zeros(1),
        sensitivity=np.zeros((1, 1)),
        precision=np.eye(1),
    )


def candidate(effect_id: str) -> Candidate:
    return candidates([LIBRARY[effect_id]], PACK, np.arange(1000.0))[0]


@pytest.mark.parametrize("effect_id", ["slow_diffusion", "voltage_offset", "coulombic_efficiency"])
@given(
    st.floats(-6.0, 6.0).map(lambda value: round(value, 6)),
    st.floats(0.1, 100.0),
    st.floats(1.0, 5.0),
)
def test_bayes_factor_is_the_mean_over_the_prior(
    effect_id: str, toward: float, sharpness: float, overdispersion: float
) -> None:
    """Against quadrature over a normal prior within the bounds of the amplitude.

    `sharpness` is the width of the bounds' prior over that of the likelihood, `toward` the distance
    of its peak from zero in standard deviations; the peak may lie outside the bounds.
    """
    choice = candidate(effect_id)
    (low, high) = choice.bounds[0].tolist()
    width = (high - low) / 4.0
    curvature = (sharpness / width) ** 2
    gradient = toward * sharpness / width
    error = replace(ERROR, overdispersion={effect_id: overdispersion})
    scaled = overdispersion * gradient, overdispersion * curvature
    (found,) = scores(alone(choice, *scaled, error))

    # A grid finer than likelihood and narrowest prior; the integrand is smooth.
    amplitude = np.linspace(low, high, 400_001)
    likelihood = gradient * amplitude - 0.5 * curvature * amplitude**2
    factors = []
    for part in PRIOR_WIDTHS:
        prior = np.exp(-0.5 * (amplitude / (part * width)) ** 2)
        factors.append(
            np.trapezoid(prior * np.exp(likelihood), amplitude) / np.trapezoid(prior, amplitude)
        )
    assert found.log_bayes_factor == pytest.approx(np.log(np.mean(factors)), rel=1e-4, abs=1e-4)


@given(st.floats(0.0, 30.0), st.floats(0.5, 100.0))
def test_a_forbidden_sign_is_no_evidence(toward: float, sharpness: float) -> None:
    """A polarisation cannot be negative: the more negative, the less evidence."""
    choice = candidate("slow_diffusion")
    width = float(choice.bounds[0, 1]) / 4.0
    wrong, worse = (
        scores(alone(choice, -by * sharpness / width, (sharpness / width) ** 2, ERROR))[0]
        for by in (toward, toward + 1.0)
    )
    assert wrong.log_bayes_factor <= 1e-12
    assert worse.log_bayes_factor < wrong.log_bayes_factor
    assert wrong.amplitude.tolist() == [0.0]
    assert wrong.explained == 0.0


def polarised(log: Log, ohm: float) -> Log:
    lagged = low_passed(log.time_s, log.current_a, 400.0, 0.0)
    return replace(log, voltage_v=log.voltage_v - ohm * lagged)


def efficient(log: Log, part: float) -> Log:
    """Charge with an efficiency of 1 + part."""
    gained = np.concatenate(
        ([0.0], np.cumsum(np.diff(log.time_s) * np.maximum(-log.current_a[1:], 0.0)))
    )
    volts = 0.5 * part * 100.0 * gained / 3600.0 / CAPACITY_AH
    return replace(log, voltage_v=log.voltage_v + volts)


@pytest.mark.parametrize(
    ("effect_id", "change"),
    [
        ("slow_diffusion", lambda log: polarised(log, -0.08)),
        ("coulombic_efficiency", lambda log: efficient(log, 0.6)),
    ],
)
def test_a_fault_outside_its_bounds_is_not_named(
    effect_id: str, change: Callable[[Log], Log], model: Model, short_references: list[Log]
) -> None:
    """Its opposite may be; every effect found keeps its bounds."""
    found = diagnose([change(short_day(seed)) for seed in (21, 22)], model, short_references)
    assert effect_id not in {found.verdict.cause, *found.verdict.ambiguous_with}
    (mine,) = [item for item in found.verdict.candidates if item.effect_id == effect_id]
    assert mine.log_bayes_factor < 0.5
    # Bounds of the diagnosed model: the extended one's coefficients differ a little.
    pack = model.extended_model().pack
    for effect, values in found.extension.model.effects:
        for parameter in effect.parameters:
            low, high = parameter.bounds(pack)
            rounding = 1e-6 * (high - low)
            assert low - rounding <= values[parameter.name] <= high + rounding
