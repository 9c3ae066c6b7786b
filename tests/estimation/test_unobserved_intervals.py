"""Unobserved intervals (parked or moved), lost filters, clocks, and external SoC references."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest

from cangauge.errors import InputError
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.counting import SET_BACK_SAMPLES
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.published import leaf_2012_model, leaf_2012_model_file
from cangauge.settings import FullCharge, LongRest
from cangauge.types import Estimate, Reason, Sample, Status
from selection import nightly_except
from synthetic import synthetic_log

MODEL = leaf_2012_model_file()
CURVE = leaf_2012_model()


def drive(start_pct: float, end_pct: float, begin_s: float, *, seed: int = 3, bias_v: float = 0.0,
          hours: float = 0.5) -> list[Sample]:  # fmt: skip
    log = synthetic_log(hours=hours, start_pct=start_pct, end_pct=end_pct, noise_v=0.5, seed=seed)
    return [
        each._replace(time_s=each.time_s + begin_s, voltage_v=each.voltage_v + bias_v)
        for each in samples_of(log)
    ]


def after_interval(
    hours: float, before_pct: float, after_pct: float, *, bias_v: float = 0.0, seed: int = 3
) -> tuple[Estimate, list[Estimate], Estimator]:
    """Return the last estimate before an unobserved interval, those after it, and the estimator."""
    estimator = make_estimator(MODEL, EstimatorSettings(initial_soc_pct=before_pct + 3.0))
    for sample in drive(before_pct + 3.0, before_pct, 0.0, seed=seed):
        last = estimator.step(sample)
    begin_s = last.time_s + 3600.0 * hours
    found = [
        estimator.step(each)
        for each in drive(after_pct, after_pct - 4.0, begin_s, seed=seed + 1, bias_v=bias_v)
    ]
    return last, found, estimator


def errors(found: list[Estimate], after_pct: float) -> list[float]:
    truth = synthetic_log(hours=0.5, start_pct=after_pct, end_pct=after_pct - 4.0, seed=4).soc_pct
    return [each.soc_pct - true for each, true in zip(found, truth.tolist(), strict=True)]


@pytest.mark.parametrize(
    ("hours", "bias_v"),
    nightly_except(
        [(0.03, 1.0), (8.0, -1.0)],
        [(hours, bias_v) for hours in (0.03, 0.5, 8.0, 24.0) for bias_v in (0.0, -1.0, 1.0)],
    ),
)
def test_parked_soc_stays_despite_biased_voltage(hours: float, bias_v: float) -> None:
    # 1 V is nearly 3 % SoC here; the standard deviation of the model's errors is 0.95 V.
    last, found, _ = after_interval(hours, 60.0, 60.0, bias_v=bias_v)
    steps = [abs(b.soc_pct - a.soc_pct) for a, b in itertools.pairwise([last, *found])]
    assert all(step < each.soc_std_pct for step, each in zip(steps, found, strict=True))
    wrong = errors(found, 60.0)
    # Without an interval the same voltage gives 1.9 % after half an hour.
    assert max(map(abs, wrong)) < 2.6
    outside = [abs(e) > 2.0 * each.soc_std_pct for e, each in zip(wrong, found, strict=True)]
    assert sum(outside) < 0.05 * len(outside)


@pytest.mark.parametrize(
    ("hours", "before_pct", "after_pct"),
    nightly_except(
        [(8.0, 30.0, 42.0), (24.0, 80.0, 20.0), (0.1, 40.0, 50.0)],
        [(8.0, 30.0, 90.0), (8.0, 30.0, 60.0), (8.0, 30.0, 42.0), (0.35, 20.0, 70.0),
         (24.0, 80.0, 20.0), (0.1, 40.0, 50.0)],
    ),
)  # fmt: skip
def test_unobserved_charge_is_found_within_minutes(
    hours: float, before_pct: float, after_pct: float
) -> None:
    _, found, _ = after_interval(hours, before_pct, after_pct)
    wrong = errors(found, after_pct)
    inside = [abs(e) < 3.0 * each.soc_std_pct for e, each in zip(wrong, found, strict=True)]
    # Until the delay line is full again no voltage shows it, and σ contains 95 % of what is likely.
    assert sum(inside[70:]) > 0.97 * len(inside[70:])
    assert max(map(abs, wrong[180:])) < 4.0
    if abs(after_pct - before_pct) > 20.0:
        assert found[-1].soc_std_pct < 5.0


def test_small_unobserved_charge_stays_within_uncertainty() -> None:
    """Charging 6 % at night is too little to prove by voltages that may be 3 % wrong."""
    _, found, _ = after_interval(8.0, 30.0, 36.0)
    wrong = errors(found, 36.0)
    assert abs(wrong[-1]) < 3.0
    assert all(abs(e) < 2.5 * f.soc_std_pct for e, f in zip(wrong[90:], found[90:], strict=True))


def test_offset_does_not_accumulate_while_unobserved() -> None:
    """An offset of 1 A counted over 10 h would be 19 % of the capacity."""
    estimator = make_estimator(MODEL, EstimatorSettings(initial_soc_pct=95.0))
    samples = drive(95.0, 45.0, 0.0, hours=2.0)
    for sample in samples:
        last = estimator.step(sample._replace(current_a=sample.current_a + 1.0))
    assert estimator.health.offset_a > 0.2
    after = estimator.step(Sample(last.time_s + 36000.0, 1.0, math.nan, 23.0))
    assert after.soc_pct == pytest.approx(last.soc_pct, abs=0.5)


def test_many_unobserved_intervals_keep_the_soc() -> None:
    estimator = make_estimator(MODEL, EstimatorSettings(initial_soc_pct=70.0))
    time_s = 0.0
    for number in range(30):
        for sample in drive(70.0, 69.9, time_s, hours=0.02, seed=number):
            last = estimator.step(sample)
        time_s = last.time_s + [61.0, 900.0, 30000.0][number % 3]
    assert last.soc_pct == pytest.approx(70.0, abs=2.5)
    assert last.soc_std_pct < 5.0


# --- lost filter ------------------------------------------------------------------------------


def test_swinging_voltage_is_a_mismatch_and_passes() -> None:
    """A loose wire: the voltage swings widely around a wrong mean."""
    estimator = make_estimator(MODEL, EstimatorSettings(initial_soc_pct=60.0))
    for sample in drive(60.0, 58.0, 0.0):
        last = estimator.step(sample)
    assert last.soc_std_pct < 2.0
    broken = [
        each._replace(voltage_v=each.voltage_v + (90.0 if number // 30 % 2 else -90.0))
        for number, each in enumerate(drive(58.0, 57.0, last.time_s + 1.0))
    ]
    found = [estimator.step(each) for each in broken]
    assert found[900].status is Status.INVALID
    assert all(0.0 <= each.soc_pct <= 100.0 for each in found)


def test_invalid_covariance_restarts_the_filter() -> None:
    estimator = Estimator(MODEL, EstimatorSettings(initial_soc_pct=60.0))
    samples = drive(60.0, 55.0, 0.0)
    for sample in samples[:601]:
        estimator.step(sample)
    for each in estimator.hypotheses.filters:
        each.P[0, 0] = -100.0
    found = [estimator.step(each) for each in samples[601:]]
    assert found[29].reasons & Reason.INNOVATION_LARGE
    assert found[-1].soc_pct == pytest.approx(55.0, abs=3.0)
    assert not found[-1].reasons & Reason.INNOVATION_LARGE


def test_single_outlier_after_interval_is_no_contradiction() -> None:
    estimator = make_estimator(MODEL, EstimatorSettings(initial_soc_pct=60.0))
    for sample in drive(60.0, 58.0, 0.0):
        last = estimator.step(sample)
    later = drive(58.0, 56.0, last.time_s + 90.0)
    later[0] = later[0]._replace(voltage_v=last.voltage_model_v - 60.0)
    found = [estimator.step(each) for each in later]
    assert not any(each.reasons & Reason.INNOVATION_LARGE for each in found)
    assert found[-1].soc_pct == pytest.approx(56.0, abs=1.5)


# --- clocks -----------------------------------------------------------------------------------


@pytest.mark.parametrize("jump_s", nightly_except((-1e6, -5.0), (-1e6, -3600.0, -5.0)))
def test_clock_set_back_is_followed(jump_s: float) -> None:
    whole = [make_estimator(MODEL, EstimatorSettings(initial_soc_pct=60.0)) for _ in range(2)]
    samples = drive(60.0, 50.0, 1e7)
    refused = 0
    for number, sample in enumerate(samples):
        true = whole[0].step(sample)
        shift_s = jump_s if number >= 900 else 0.0
        found = whole[1].step(sample._replace(time_s=sample.time_s + shift_s))
        refused += bool(found.reasons & Reason.IMPLAUSIBLE_INPUT)
    # At one sample a second the clock catches up with five seconds by itself.
    assert refused == SET_BACK_SAMPLES - 1 if jump_s < -5.0 else refused <= 5
    assert found.soc_pct == pytest.approx(true.soc_pct, abs=0.3)


def test_single_future_stamp_costs_a_few_samples() -> None:
    estimator = make_estimator(MODEL, EstimatorSettings(initial_soc_pct=60.0))
    samples = drive(60.0, 50.0, 1e7)
    samples[900] = samples[900]._replace(time_s=5e9)
    found = [estimator.step(each) for each in samples]
    assert sum(bool(each.reasons & Reason.IMPLAUSIBLE_INPUT) for each in found) < 6
    assert found[-1].soc_pct == pytest.approx(50.0, abs=1.5)


# --- external SoC references ------------------------------------------------------------------


def charging(estimator: Estimator, end_v: float, hold_s: int, current_a: float) -> list[Estimate]:
    """Estimate the end of a charge, with a tapering current."""
    rows = [Sample(float(k), -12.0, 389.0, 23.0) for k in range(120)]
    rows += [Sample(120.0 + k, current_a, end_v, 23.0) for k in range(hold_s)]
    return [estimator.step(each) for each in rows]


@pytest.mark.parametrize("method", ["ekf", "coulomb"])
def test_full_charge_rule_corrects_the_soc(method: Any) -> None:
    rule = FullCharge(voltage_v=388.0, current_a=2.0, hold_s=30.0, soc_std_pct=0.3)
    end_v = 388.2
    settings = {"method": method, "initial_soc_pct": 93.0, "initial_soc_std_pct": 2.0}
    found = charging(make_estimator(MODEL, EstimatorSettings(**settings, full_charge=rule)), end_v, 60, -1.5)  # fmt: skip  # noqa: E501
    without = charging(make_estimator(MODEL, EstimatorSettings(**settings)), end_v, 60, -1.5)
    assert [each.soc_pct for each in found[:150]] == [each.soc_pct for each in without[:150]]
    assert found[149].soc_pct < 98.5
    assert found[149].soc_std_pct > 0.4
    assert found[151].soc_pct > 99.5
    assert found[151].soc_std_pct < 0.35
    if method == "coulomb":
        assert without[151].soc_pct < 95.0
    brief = charging(make_estimator(MODEL, EstimatorSettings(**settings, full_charge=rule)), end_v, 29, -1.5)  # fmt: skip  # noqa: E501
    strong = charging(make_estimator(MODEL, EstimatorSettings(**settings, full_charge=rule)), end_v, 60, -2.5)  # fmt: skip  # noqa: E501
    assert max(each.soc_std_pct for each in brief[-2:]) > 0.4
    assert max(each.soc_std_pct for each in strong[-2:]) > 0.4


def test_long_rest_rule_corrects_the_count() -> None:
    rest_v = CURVE.pseudo_ocv([55.0], [23.0])[0]
    rows = [Sample(float(k), 0.2, rest_v, 23.0) for k in range(0, 3000, 5)]
    settings = {"method": "coulomb", "initial_soc_pct": 62.0, "initial_soc_std_pct": 5.0}
    rule = LongRest(after_s=1800.0, soc_std_pct=1.0)
    estimator = make_estimator(MODEL, EstimatorSettings(**settings, long_rest=rule))
    found = [estimator.step(each) for each in rows]
    assert found[350].soc_pct == pytest.approx(61.9, abs=0.1)
    assert found[370].soc_pct == pytest.approx(55.2, abs=0.3)
    assert found[370].soc_std_pct < 1.2
    # Once per rest, not at every sample.
    assert found[-1].soc_std_pct > 0.9


def test_reference_rules_validate_their_ranges() -> None:
    with pytest.raises(InputError, match=r"full_charge\.voltage_v"):
        FullCharge(voltage_v=math.nan, current_a=2.0)
    with pytest.raises(InputError, match=r"long_rest\.after_s"):
        LongRest(after_s=1.0)
