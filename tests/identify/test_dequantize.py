"""A quantized temperature is interpolated between its steps, and only there."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cangauge.identify.rows import dequantize
from cangauge.logs.log import Log

FloatArray = NDArray[np.float64]


def log_of(temperature_c: FloatArray, pause_s: float = 0.0) -> Log:
    time_s = 1.7e9 + np.arange(float(temperature_c.size))
    time_s[time_s.size // 2 :] += pause_s
    return Log(time_s, np.zeros_like(time_s), np.full_like(time_s, 380.0), temperature_c)


def warming(seconds: int = 7200) -> FloatArray:
    time_s = np.arange(float(seconds))
    return 18.3 + 6.0 * (1.0 - np.exp(-time_s / 3000.0)) + 0.4 * np.sin(time_s / 900.0)


def reported(temperature_c: FloatArray, step_c: float, noise_c: float) -> FloatArray:
    noise = np.random.default_rng(3).normal(0.0, noise_c, temperature_c.size)
    return np.round((temperature_c + noise) / step_c) * step_c


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("step_c", [0.25, 0.5, 1.0])
@pytest.mark.parametrize("noise_c", [0.0, 0.03])
def test_most_of_the_steps_error_is_gone(step_c: float, noise_c: float) -> None:
    true = warming()
    seen = reported(true, step_c, noise_c)
    read = dequantize(log_of(seen)).temperature_c
    assert rms(read - true) < 0.6 * rms(seen - true)


@pytest.mark.parametrize("pause_s", [0.0, 600.0, 86_400.0])
def test_it_is_never_further_from_the_report_than_half_a_step(pause_s: float) -> None:
    """In particular where the temperature jumped during an unobserved interval."""
    seen = reported(np.concatenate((warming() + 15.0, warming())), 0.5, 0.01)
    read = dequantize(log_of(seen, pause_s)).temperature_c
    assert np.max(np.abs(read - seen)) <= 0.25 + 1e-9


def test_a_fine_or_constant_temperature_stays_what_it_is() -> None:
    true = warming()
    np.testing.assert_allclose(dequantize(log_of(true)).temperature_c, true, atol=1e-3)
    log = log_of(np.full(100, 21.0))
    assert dequantize(log) is log
