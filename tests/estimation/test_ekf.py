"""The Kalman filter: identities of a linear problem."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.estimation.ekf import (
    FUNCTIONS_TIME_S,
    LEVEL,
    LEVEL_TIME_S,
    OFFSET_STD_A,
    OUTSIDE_PCT_PER_K,
    SocFilter,
)
from cangauge.estimation.health import CAPACITY_STD, RESISTANCE_STD
from cangauge.estimation.start import WRONG_PRIOR, WRONG_STD_PCT, Hypotheses
from cangauge.estimation.state import Block

CAPACITY_AH = 60.0
LOAD = np.array([1.0, -40.0])
LOAD_COEFFICIENTS = np.array([0.3, 0.1])
NO_EFFECTS = np.zeros(1)
START_STD_PCT = 20.0


class LinearModel:
    """A voltage model that is linear in the SoC and in two functions."""

    capacity_ah = CAPACITY_AH
    model = SimpleNamespace(usual_c=20.0, range=SimpleNamespace(temperature_c=(10.0, 30.0)))
    functions = SimpleNamespace(number=2, row=lambda _, load: np.array([0.9, 0.01 * load[1]]))
    load_coefficients = LOAD_COEFFICIENTS
    noise = SimpleNamespace(
        level_std_v=0.8, slow_std_v=0.6, slow_time_s=300.0, fast_std_v=0.3, soc_std_pct=0.3,
        cold=lambda temperature_c: 1.0 if temperature_c > 10.0 else 1.4,
    )  # fmt: skip

    def pseudo_ocv_at(self, soc_pct: float, drives: Any = None) -> tuple[float, float]:
        return 300.0 + 0.7 * soc_pct, 0.7

    def unknown_temperature_v(self, load: np.ndarray) -> float:
        return 5.0


def block(number: int, voltage_v: float, discharged_pct: float, load_a: float = 40.0) -> Block:
    load = np.array([1.0, -load_a])
    return Block(
        30.0 * number, discharged_pct, voltage_v, 20.0, 0.1 * load[1], 0.0, load, NO_EFFECTS
    )


def voltages(count: int, seed: int) -> list[tuple[float, float, float]]:
    """Voltage [V], charge since the last block [%] and current [A] of some blocks."""
    rng = np.random.default_rng(seed)
    current_a = rng.normal(20.0, 30.0, count)
    volts = 340.0 + 4.0 * rng.normal(size=count)
    return list(zip(volts, current_a * 30.0 / 36.0 / CAPACITY_AH, current_a, strict=True))


def run(filter_: Any, rows: list[tuple[float, float, float]]) -> None:
    for number, (volts, charge_pct, current_a) in enumerate(rows):
        filter_.predict(30.0, charge_pct)
        filter_.update(block(number, volts, 0.0, current_a))


def augmented(
    rows: list[tuple[float, float, float]], start_pct: float, *, with_biases: bool
) -> tuple[np.ndarray, np.ndarray, float]:
    """State, covariance and log-likelihood of the whole problem at once, by dense conditioning.

    The unknowns are (S, o, w, c, c, g, r) after the last block. w and c are processes that return
    to zero; o, w and c have a value at the start and at every block.
    """
    noise, count = LinearModel.noise, len(rows)
    times = np.arange(count + 1)
    gap = np.abs(np.subtract.outer(times, times))
    time_s = [np.inf, LEVEL_TIME_S, FUNCTIONS_TIME_S, FUNCTIONS_TIME_S]
    sizes = [OFFSET_STD_A, 1.0, 1.0, 1.0]
    processes = [
        size**2 * np.exp(-30.0 / tau_s * gap) for size, tau_s in zip(sizes, time_s, strict=True)
    ]
    slow = noise.slow_std_v**2 * np.exp(-30.0 / noise.slow_time_s * gap[1:, 1:])
    drift = 1e-6 * 30.0 * np.minimum.outer(times[1:], times[1:])
    rate = 100.0 * 30.0 / 3600.0 / CAPACITY_AH
    slope = 0.7
    seen = np.zeros((4, count, count + 1))
    of_biases = np.zeros((count, 2))
    expected, charge = np.empty(count), 0.0
    for k, (_, charge_pct, current_a) in enumerate(rows, start=1):
        charge += charge_pct
        load = np.array([1.0, -current_a])
        seen[0, k - 1, :k] = slope * rate
        level = np.hypot(noise.level_std_v, noise.soc_std_pct * slope)
        seen[1:, k - 1, k] = level, 0.9, 0.01 * load[1]
        of_biases[k - 1] = -slope * charge, 0.1 * load[1]
        expected[k - 1] = 300.0 + slope * (start_pct - charge) + load @ LOAD_COEFFICIENTS
    biases = np.array([CAPACITY_STD, RESISTANCE_STD]) if with_biases else np.zeros(2)
    fast = noise.fast_std_v**2 + (noise.soc_std_pct * slope) ** 2
    covariance = slow + slope**2 * drift + fast * np.eye(count) + (slope * START_STD_PCT) ** 2
    covariance += (of_biases * biases**2) @ of_biases.T
    for each, process in zip(seen, processes, strict=True):
        covariance += each @ process @ each.T
    cross = [process[-1] @ each.T for each, process in zip(seen, processes, strict=True)]
    cross = np.vstack([np.zeros(count), *cross, (of_biases * biases**2).T])
    error = np.array([volts for volts, _, _ in rows]) - expected
    solved = np.linalg.solve(covariance, np.column_stack([error, cross.T]))
    prior = np.diag(np.r_[0.0, np.array(sizes) ** 2, biases**2])
    logdet = np.linalg.slogdet(covariance)[1]
    evidence = -0.5 * (error @ solved[:, 0] + logdet)
    return cross @ solved[:, 0], prior - cross @ solved[:, 1:], evidence


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_linear_filter_equals_the_batch_solution(seed: int) -> None:
    rows = voltages(25, seed)
    filter_ = SocFilter(LinearModel(), 60.0, START_STD_PCT)
    run(filter_, rows)
    mean, covariance, evidence = augmented(rows, 60.0, with_biases=False)
    found = filter_.x[[1, 3, 4, 5]]
    np.testing.assert_allclose(found, mean[[1, 2, 3, 4]], atol=1e-8)
    np.testing.assert_allclose(
        np.sqrt(np.diag(filter_.P))[[1, 3, 4, 5]], np.sqrt(np.diag(covariance))[1:5], rtol=1e-6
    )
    assert filter_.evidence == pytest.approx(evidence, rel=1e-9)


@pytest.mark.parametrize("seed", [1, 2])
def test_separate_biases_equal_the_augmented_problem(seed: int) -> None:
    rows = voltages(25, seed)
    filter_ = SocFilter(LinearModel(), 60.0, START_STD_PCT)
    run(filter_, rows)
    mean, covariance, _ = augmented(rows, 60.0, with_biases=True)
    x, P = filter_.joint()
    np.testing.assert_allclose(x[[1, 3, 4, 5, 6, 7]], mean[1:], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(
        np.sqrt(np.diag(P))[[1, 3, 4, 5, 6, 7]], np.sqrt(np.diag(covariance))[1:], rtol=1e-3
    )


@given(st.integers(0, 10_000), st.floats(1.0, 40.0))
def test_covariance_stays_positive_and_shrinks(seed: int, start_std_pct: float) -> None:
    filter_ = SocFilter(LinearModel(), 50.0, start_std_pct)
    for number, (volts, charge_pct, current_a) in enumerate(voltages(12, seed)):
        filter_.predict(30.0, charge_pct)
        before = np.diag(filter_.P).copy()
        filter_.update(block(number, volts, 0.0, current_a))
        assert np.array_equal(filter_.P, filter_.P.T)
        assert np.linalg.eigvalsh(filter_.P).min() > -1e-12
        assert np.all(np.diag(filter_.P) <= before + 1e-12)
        assert np.all(np.linalg.eigvalsh(filter_.bias.P) > 0.0)


def test_prediction_between_blocks_equals_the_filters_own() -> None:
    filter_ = SocFilter(LinearModel(), 60.0, 5.0)
    run(filter_, voltages(5, 4))
    soc_pct, variance = filter_.soc_moments_after(17.0, 0.4, 0.02)
    by_biases_pct2 = filter_.bias.soc_error_pct2
    filter_.predict(17.0, 0.4, 0.02)
    assert soc_pct == pytest.approx(filter_.x[0], abs=1e-12)
    assert variance == pytest.approx(filter_.P[0, 0] + by_biases_pct2, abs=1e-12)


def test_the_variance_of_the_soc_is_its_mean_square_error_under_all_that_is_learned() -> None:
    filter_ = SocFilter(LinearModel(), 60.0, 5.0)
    run(filter_, voltages(5, 4))
    x, P = filter_.joint()
    soc_pct, variance = filter_.soc_moments_after(0.0, 0.0)
    assert variance == pytest.approx(P[0, 0] + (x[0] - soc_pct) ** 2, abs=1e-12)


@pytest.mark.parametrize("wrong_pct", [0.0, 3.0, 30.0])
def test_odds_of_a_given_start_are_those_of_all_voltages_at_once(wrong_pct: float) -> None:
    rows = [
        (300.0 + 0.7 * (60.0 - 0.2 * k) + LOAD @ LinearModel.load_coefficients, 0.2, 40.0)
        for k in range(1, 5)
    ]
    hypotheses = Hypotheses(LinearModel(), 60.0 + wrong_pct, 20.0)
    run(hypotheses, rows)
    narrow = augmented(rows, 60.0 + wrong_pct, with_biases=False)[2]
    wide = SocFilter(LinearModel(), 60.0 + wrong_pct, WRONG_STD_PCT)
    run(wide, rows)
    expected = np.log(WRONG_PRIOR / (1.0 - WRONG_PRIOR)) + wide.evidence - narrow
    assert hypotheses.log_odds == pytest.approx(expected, abs=1e-9)
    p = 1.0 / (1.0 + np.exp(-expected))
    means = [each.x[0] for each in hypotheses.filters]
    assert hypotheses.soc_after(0.0, 0.0)[0] == pytest.approx((1.0 - p) * means[0] + p * means[1])


def test_a_rejected_start_leaves_only_the_wide_hypothesis() -> None:
    rows = [(300.0 + 0.7 * 80.0, 0.0, 0.0)] * 20
    hypotheses = Hypotheses(LinearModel(), 20.0, 1.0)
    run(hypotheses, rows)
    assert (len(hypotheses.filters), hypotheses.decision) == (1, 1)
    assert abs(hypotheses.soc_after(0.0, 0.0)[0] - 80.0) < 3.0


def test_what_is_learned_returns_to_the_prior_while_the_car_is_away() -> None:
    filter_ = SocFilter(LinearModel(), 60.0, START_STD_PCT)
    run(filter_, voltages(25, 1))
    filter_.predict(0.0, 0.0, away_s=30.0 * FUNCTIONS_TIME_S)
    fresh = SocFilter(LinearModel(), 60.0, START_STD_PCT)
    np.testing.assert_allclose(filter_.x[2:], fresh.x[2:], atol=1e-9)
    np.testing.assert_allclose(filter_.P[2:, 2:], fresh.P[2:, 2:], atol=1e-9)


def test_an_unknown_temperature_and_one_outside_the_fit_widen_what_lasts() -> None:
    filter_ = SocFilter(LinearModel(), 60.0, START_STD_PCT)
    known = block(1, 340.0, 0.0)
    level_v = filter_.measurement(filter_.x, known)[1][LEVEL]
    outside_v = filter_.measurement(filter_.x, known._replace(temperature_c=40.0))[1][LEVEL]
    unknown_v = filter_.measurement(filter_.x, known._replace(temperature_c=np.nan))[1][LEVEL]
    assert outside_v == pytest.approx(np.hypot(level_v, OUTSIDE_PCT_PER_K * 10.0 * 0.7))
    assert unknown_v == pytest.approx(np.hypot(level_v, 5.0))


def test_doubt_keeps_the_odds_of_an_open_question() -> None:
    hypotheses = Hypotheses(LinearModel(), 60.0, 1.0)
    hypotheses.doubt(10.0, 3600.0, 0.1)
    p = 1.0 / (1.0 + np.exp(-hypotheses.log_odds))
    assert p == pytest.approx(1.0 - (1.0 - WRONG_PRIOR) ** 2)
    narrow, wide = hypotheses.filters
    assert narrow.P[0, 0] == pytest.approx(1.0 + 0.01)
    assert wide.P[0, 0] == pytest.approx(WRONG_STD_PCT**2 + 100.0)


class SteppedModel(LinearModel):
    """A flat curve with a step of 1.4 V at 60 %, as that of 100 LFP cells."""

    functions = SimpleNamespace(number=0, row=lambda *_: np.zeros(0))
    noise = SimpleNamespace(
        level_std_v=0.3, slow_std_v=0.3, slow_time_s=300.0, fast_std_v=0.1, soc_std_pct=3.0,
        cold=lambda _: 1.0,
    )  # fmt: skip

    def pseudo_ocv_at(self, soc_pct: float, drives: Any = None) -> tuple[float, float]:
        step = np.tanh((soc_pct - 60.0) / 3.0)
        return 340.0 + 0.01 * soc_pct + 0.7 * step, 0.01 + 0.7 / 3.0 * (1.0 - step**2)


@pytest.mark.parametrize(("start_pct", "is_right"), [(55.0, False), (70.0, True)])
def test_a_step_of_the_curve_proves_no_wrong_start(start_pct: float, is_right: bool) -> None:
    hypotheses, model = Hypotheses(SteppedModel(), start_pct, 1.0), SteppedModel()
    for number in range(80):
        voltage_v = model.pseudo_ocv_at(70.0 - 0.1 * (number + 1))[0]
        drive = block(number, voltage_v + LOAD @ model.load_coefficients, 0.0)
        hypotheses.predict(30.0, 0.1)
        hypotheses.update(drive)
    soc_pct, std_pct = hypotheses.soc_after(0.0, 0.0)
    assert abs(soc_pct - 62.0) < 2.0 * std_pct
    assert (std_pct < 3.0) == is_right
    assert hypotheses.decision in ((0, -1) if is_right else (0, 1))
