"""Resampling of fast logs keeps charge, gaps and times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cangauge.logs.log import Log
from cangauge.logs.resample import ENOUGH_HZ, resample
from cangauge.model.coulomb_counting import discharged_ah


def drive(rate_hz: float, seconds: float = 120.0, gap_s: float = 0.0) -> Log:
    time_s = 1.7e9 + np.arange(0.0, seconds, 1.0 / rate_hz)
    time_s[time_s.size // 2 :] += gap_s
    current = 40.0 + 60.0 * np.sin((time_s - time_s[0]) / 3.0)
    voltage = 380.0 - 0.1 * current
    return Log(time_s, current, voltage, np.full_like(time_s, 25.0), 80.0 - current / 1e3)


@pytest.mark.parametrize("rate_hz", [0.5, 1.0, 10.0, 20.0, 39.0])
def test_a_slow_log_is_unchanged(rate_hz: float) -> None:
    log = drive(rate_hz)
    assert resample(log) is log


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 333.0])
def test_a_fast_log_keeps_its_charge_and_alignment(rate_hz: float) -> None:
    log = drive(rate_hz, gap_s=50.0)
    few = resample(log)
    assert len(few) == pytest.approx(120.0 * ENOUGH_HZ, abs=2)
    assert np.all(np.diff(few.time_s) > 0.0)
    assert np.sum(np.diff(few.time_s) > 40.0) == 1
    np.testing.assert_allclose(few.voltage_v, 380.0 - 0.1 * few.current_a)
    kept, whole = (discharged_ah(each.time_s, each.current_a)[-1] for each in (few, log))
    assert kept == pytest.approx(whole, rel=2e-3)
    assert few.soc_pct is not None
    assert log.soc_pct is not None
    assert few.soc_pct[0] == log.soc_pct[0]


def test_a_soc_slower_than_the_current_is_kept() -> None:
    log = drive(100.0)
    known = np.where(np.arange(len(log)) % 100 == 3, log.soc_pct, np.nan)
    few = resample(replace(log, soc_pct=known))
    assert few.soc_pct is not None
    assert np.isfinite(few.soc_pct).sum() == np.isfinite(known).sum()
    assert few.first_soc() == (0, known[3])


def test_a_log_of_one_row_is_unchanged() -> None:
    log = drive(1.0, seconds=1.0)
    assert resample(log) is log
