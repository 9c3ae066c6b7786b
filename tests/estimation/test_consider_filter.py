"""The filter and its two hypotheses against the exact posterior of all voltages at once."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cangauge.estimation.ekf import UNKNOWN_SOC_STD_PCT, SocEkf
from cangauge.estimation.hypothesis_filter import WRONG_LOG_ODDS, HypothesisFilter
from cangauge.estimation.measurement_noise import Measurement
from cangauge.estimation.state import ChargeSinceUpdate
from cangauge.model.model_file import CurveNoise, ModelNoise

SLOPE_V, FAST_V = 2.0, 0.5
LEVEL_V, TILT_V = 3.0, 0.05
"""Error of the curve: of its level [V], and per % SoC [V]."""
CAPACITY_AH = 1e4
"""So large that the current's offset does not move the SoC within a test."""


class Straight:
    """A straight pseudo-OCV, on which the extended filter is exact."""

    def pseudo_ocv_at(self, soc_pct: float) -> tuple[float, float]:
        return 300.0 + SLOPE_V * soc_pct, SLOPE_V


def make_ekf() -> SocEkf:
    noise = ModelNoise(
        fast_std_v=FAST_V,
        fast_time_s=0.0,
        slow_std_v=1e-6,
        slow_time_s=600.0,
        lasting_std_v=1e-6,
        curve=CurveNoise(
            soc_pct=[0.0, 100.0],
            functions_v=[[LEVEL_V, LEVEL_V], [-50.0 * TILT_V, 50.0 * TILT_V]],
            temperature_c=20.0,
            kt_std_v_per_k=0.0,
            resistance_std_per_k=0.0,
        ),
        voltage_mae_pct=0.1,
        voltage_rmse_v=0.5,
        judged_on="",
    )
    return SocEkf(Straight(), -1e-9, CAPACITY_AH, noise)


def drive(seed: int, steps: int, discharged_pct: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the true SoC and voltages of a drive with its own error of the curve."""
    rng = np.random.default_rng(seed)
    soc_pct = rng.normal(50.0, 1.0) - discharged_pct * np.arange(steps) / steps
    level, tilt = rng.standard_normal(2)
    error_v = LEVEL_V * level + TILT_V * tilt * (soc_pct - 50.0)
    return soc_pct, 300.0 + SLOPE_V * soc_pct + error_v + FAST_V * rng.standard_normal(steps)


def log_evidence(voltage_v: np.ndarray, mean_pct: float, std_pct: float) -> float:
    """Return the log density of voltages at a constant SoC, up to a constant."""
    n = voltage_v.size
    common_v2 = (SLOPE_V * std_pct) ** 2 + LEVEL_V**2
    covariance = common_v2 * np.ones((n, n)) + FAST_V**2 * np.eye(n)
    error_v = voltage_v - 300.0 - SLOPE_V * mean_pct
    return -0.5 * float(
        np.linalg.slogdet(covariance)[1] + error_v @ np.linalg.solve(covariance, error_v)
    )


# Above 6 % the voltages of the first hypothesis are outliers, which are no longer Gaussian.
@pytest.mark.parametrize("wrong_pct", [0.0, 2.0, 4.0, 6.0])
def test_odds_equal_those_of_all_voltages_at_once(wrong_pct: float) -> None:
    _, voltage_v = drive(seed=1, steps=50, discharged_pct=0.0)
    voltage_v += SLOPE_V * wrong_pct
    newton_pct = float(voltage_v[0] - 300.0) / SLOPE_V
    two = HypothesisFilter(make_ekf)
    two.start(50.0, 1.0)
    for value in voltage_v:
        two.predict(ChargeSinceUpdate(seconds=1.0))
        measurement = Measurement(float(value), 0.0, newton_pct, FAST_V, 0.0, 0.0)
        two.update(measurement, ChargeSinceUpdate(seconds=1.0))
    exact = WRONG_LOG_ODDS + log_evidence(voltage_v, newton_pct, UNKNOWN_SOC_STD_PCT)
    exact -= log_evidence(voltage_v, 50.0, 1.0)
    # The tilt of the curve is the filter's alone; it is small at 50 %.
    assert two.snapshot().log_odds == pytest.approx(exact, abs=0.3)


@pytest.mark.parametrize(
    ("start_std_pct", "discharged_pct"), [(1.0, 0.0), (1.0, 10.0), (30.0, 10.0)]
)
def test_error_has_the_stated_deviation(start_std_pct: float, discharged_pct: float) -> None:
    steps, draws = 100, 200
    errors = []
    for seed in range(draws):
        soc_pct, voltage_v = drive(seed, steps, discharged_pct)
        ekf = make_ekf()
        ekf.start(50.0, start_std_pct)
        for k, value in enumerate(voltage_v):
            moved = discharged_pct / steps if k else 0.0
            ekf.predict(1.0, moved, moved, 0.0)
            ekf.update(Measurement(float(value), 0.0, 50.0, FAST_V, 0.0, 0.0), 1.0)
        errors.append(ekf.soc_pct - soc_pct[-1])
    stated = ekf.summary(0.0)[1]
    rmse = math.sqrt(float(np.mean(np.square(errors))))
    # Four standard errors of an RMSE of 200 draws; the drawn capacity is exact, the stated is not.
    assert rmse < stated * (1.0 + 4.0 / math.sqrt(2.0 * draws))
    # A given start is never worse than counting, whose error is that of the start.
    if start_std_pct == 1.0:
        assert rmse < 1.05


@pytest.mark.parametrize("wrong_pct", [4.0, 6.0])
def test_open_hypotheses_never_make_the_estimate_jump(wrong_pct: float) -> None:
    _, voltage_v = drive(seed=1, steps=1200, discharged_pct=0.0)
    voltage_v += SLOPE_V * wrong_pct
    two = HypothesisFilter(make_ekf)
    two.start(50.0, 1.0)
    stated = []
    for value in voltage_v:
        since = ChargeSinceUpdate(seconds=1.0)
        two.predict(since)
        two.update(Measurement(float(value), 0.0, 50.0 + wrong_pct, FAST_V, 0.0, 0.0), since)
        stated.append(two.soc_after(ChargeSinceUpdate()))
    assert np.abs(np.diff(stated[600:], axis=0)).max() < 0.05  # noise of single voltages
