"""Whatever the input: no exception, no NaN once the SoC is known, nothing outside 0–100 %."""

from __future__ import annotations

import math
import sys
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cangauge.estimation.estimator import Estimator
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.effects.library import LIBRARY
from cangauge.model.model_file import Model
from cangauge.model.published import leaf_2012_model_file
from cangauge.settings import FullCharge, LongRest
from cangauge.types import Estimate, Reason, Sample, Status
from estimation.test_snapshot import extended_by
from selection import nightly_except

PLAIN = leaf_2012_model_file()
TOGETHER = [
    "current_offset", "current_gain", "voltage_gain", "time_skew", "temperature_lag",
    "core_temperature", "resistance_temperature", "resistance_soc", "charge_transfer",
    "fast_polarization", "slow_diffusion", "hysteresis", "entropic_coefficient", "weak_cell",
]  # fmt: skip
MODELS = {
    "plain": PLAIN,
    "together": extended_by(TOGETHER),
    **{effect_id: extended_by([effect_id]) for effect_id in LIBRARY},
}

HUGE = [1e12, 1e100, 1e154, 1e155, 1e308, sys.float_info.max, math.inf]
TINY = [0.0, 5e-324, 2.2e-308, 1e-200, 1e-12]
ODD = [sign * value for value in HUGE + TINY for sign in (1.0, -1.0)] + [math.nan]
odd = st.one_of(st.sampled_from(ODD), st.floats())


def mostly(usual: st.SearchStrategy[float]) -> st.SearchStrategy[float]:
    return st.one_of(usual, usual, usual, odd)


# Steps: usual rates, duplicates, reordering, gaps, unobserved intervals, clock jumps.
steps = st.one_of(
    st.sampled_from([0.01, 0.1, 0.1, 1.0, 1.0, 0.0, -0.01, -0.5, 5e-324, 1e-7, 1e-6]),
    st.sampled_from([3.0, 59.0, 61.0, 601.0, 7200.0, 3e5, 1e8, -2.0, -100.0, -86400.0, -1e9]),
    st.floats(-10.0, 100.0),
)
times = st.one_of(st.just(None), st.just(None), st.just(None), st.just(None), odd)
rows = st.tuples(
    steps,
    times,
    mostly(st.sampled_from([-120.0, -5.0, 0.0, 0.3, 20.0, 150.0])),
    mostly(st.sampled_from([250.0, 320.0, 360.0, 385.0, 403.0, 560.0])),
    mostly(st.sampled_from([-40.0, 0.0, 21.0, 25.0, 60.0])),
)
repeats = st.sampled_from([1, 1, 1, 2, 8, 80])
inputs = st.lists(st.tuples(rows, repeats), max_size=25)


def samples_of_rows(drawn: Any) -> list[Sample]:
    time_s = 1.7e9
    samples = []
    for (step_s, stamp_s, current_a, voltage_v, temperature_c), times_ in drawn:
        for _ in range(times_):
            time_s += step_s
            stamp = time_s if stamp_s is None else stamp_s
            samples.append(Sample(stamp, current_a, voltage_v, temperature_c))
    return samples


def check(estimate: Estimate, method: str, was_known: bool) -> bool:
    """Check one estimate; return whether the SoC is known."""
    known = math.isfinite(estimate.soc_pct)
    assert known or math.isnan(estimate.soc_pct)
    assert not known or 0.0 <= estimate.soc_pct <= 100.0
    assert not known or 0.0 <= estimate.soc_std_pct < math.inf
    assert known or math.isnan(estimate.soc_std_pct)
    assert known == (not estimate.reasons & Reason.NO_INITIAL_SOC)
    assert known or estimate.status is Status.INITIALISING
    if method != "newton":  # the inverse has a SoC only where there is a voltage
        assert known or not was_known
    for soc in (estimate.soc_newton_pct, estimate.soc_coulomb_pct):
        assert math.isnan(soc) or 0.0 <= soc <= 100.0
    assert known or math.isnan(estimate.voltage_model_v)
    assert not math.isinf(estimate.residual_v)
    return known


def run(model: Model, chosen: EstimatorSettings, samples: list[Sample]) -> None:
    estimator = Estimator(model, chosen)
    known = False
    for sample in samples:
        known = check(estimator.step(sample), chosen.method, known)
        assert all(math.isfinite(each) for each in estimator.health)
    # Its state can be restored.
    again = Estimator(model, chosen)
    again.restore(estimator.snapshot())


METHODS = ("ekf", "newton", "coulomb")
RULES = {"full_charge": FullCharge(380.0, 10.0, 2.0), "long_rest": LongRest(60.0)}


@pytest.mark.parametrize(
    ("which", "method"),
    nightly_except(
        [("together", "ekf"), ("plain", "newton"), ("plain", "coulomb")],
        [(which, method) for which in ("plain", "together") for method in METHODS],
    ),
)
@settings(suppress_health_check=list(HealthCheck))
@given(drawn=inputs, with_rules=st.booleans(), start=st.sampled_from([None, 0.0, 50.0, 100.0]))
def test_estimates_stay_bounded_for_any_input(
    which: str, method: Any, drawn: Any, with_rules: bool, start: Any
) -> None:
    chosen = EstimatorSettings(
        method=method, initial_soc_pct=start, **(RULES if with_rules else {})
    )
    run(MODELS[which], chosen, samples_of_rows(drawn))


@pytest.mark.nightly
@pytest.mark.parametrize("effect_id", LIBRARY)
@settings(max_examples=4, suppress_health_check=list(HealthCheck))
@given(drawn=inputs)
def test_estimates_stay_bounded_with_each_effect(effect_id: str, drawn: Any) -> None:
    run(MODELS[effect_id], EstimatorSettings(), samples_of_rows(drawn))


@pytest.mark.parametrize("which", ["plain", "together"])
@settings(suppress_health_check=list(HealthCheck))
@given(drawn=st.lists(st.tuples(odd, odd, odd, odd), max_size=40))
def test_estimates_stay_bounded_for_extreme_numbers(which: str, drawn: Any) -> None:
    run(MODELS[which], EstimatorSettings(), [Sample(*row) for row in drawn])


@pytest.mark.parametrize(
    "zero", nightly_except(("all",), ("fast_std_v", "slow_std_v", "level_std_v", "all"))
)
def test_model_without_noise_is_accepted(zero: str) -> None:
    raw = PLAIN.model_dump()
    names = ["fast_std_v", "slow_std_v", "level_std_v"] if zero == "all" else [zero]
    raw["noise"] |= dict.fromkeys(names, 0.0)
    model = Model.model_validate(raw)
    samples = [Sample(0.5 * k, 20.0, 370.0 + (k % 7), 23.0) for k in range(400)]
    samples += [Sample(1000.0 + k, 0.0, 390.0, 23.0) for k in range(200)]
    run(model, EstimatorSettings(initial_soc_pct=50.0, initial_soc_std_pct=0.0), samples)


@pytest.mark.parametrize(
    ("which", "method"),
    nightly_except(
        [("plain", "coulomb"), ("time_skew", "newton"), ("together", "ekf")],
        [(which, method) for which in ("plain", "time_skew", "together") for method in METHODS],
    ),
)
@settings(suppress_health_check=list(HealthCheck))
@given(drawn=inputs, asked_every=st.sampled_from([2, 3, 17]))
def test_reading_the_estimate_changes_nothing(
    which: str, method: Any, drawn: Any, asked_every: int
) -> None:
    chosen = EstimatorSettings(method=method)
    often, seldom = Estimator(MODELS[which], chosen), Estimator(MODELS[which], chosen)
    for number, sample in enumerate(samples_of_rows(drawn)):
        estimate = often.step(sample)
        seldom.update(sample)
        if number % asked_every == 0:
            assert repr(seldom.estimate) == repr(estimate)  # NaN is NaN
    assert repr(seldom.snapshot()) == repr(often.snapshot())


def test_reading_changes_no_reason_of_a_held_sample() -> None:
    model = extended_by(["time_skew"])
    often, seldom = Estimator(model), Estimator(model)
    for time_s, voltage_v in [*((float(k), 370.0) for k in range(30)), (29.1, 9000.0)]:
        often.step(Sample(time_s, 20.0, voltage_v, 23.0))
        seldom.update(Sample(time_s, 20.0, voltage_v, 23.0))
    assert seldom.estimate.reasons == often.estimate.reasons
