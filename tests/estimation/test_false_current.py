"""A current beyond the fit's is believed where the voltage drops as modelled, and not elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cangauge
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import EstimateTable, run_estimator, samples_of, step_all
from cangauge.estimation.settings import EstimatorSettings
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.model.published import leaf_2012_model_file
from cangauge.types import Reason, Status
from synthetic import synthetic_log

MODEL = leaf_2012_model_file()
LOG = synthetic_log(start_pct=90.0, end_pct=60.0, noise_v=0.8, seed=4, hours=0.6)
FALSE_S = (605.0, 625.0)
"""Within one block of 30 s, which corrects the filter at its end."""


def within(model: Model, low_a: float, high_a: float) -> Model:
    """The same model, identified within other currents."""
    known = model.range.model_copy(update={"current_a": (low_a, high_a)})
    return model.model_copy(update={"range": known})


def stated(log: Log, current_a: float | np.ndarray) -> Log:
    """The log with another current for a while."""
    is_false = (log.time_s >= FALSE_S[0]) & (log.time_s < FALSE_S[1])
    return replace(log, current_a=np.where(is_false, current_a, log.current_a))


def run(log: Log, model: Model) -> EstimateTable:
    assert log.soc_pct is not None
    start_pct = log.soc_pct[np.isfinite(log.soc_pct)][0]
    return run_estimator(log, model, EstimatorSettings(initial_soc_pct=float(start_pct)))


@pytest.mark.parametrize("current_a", [500.0, 1500.0, -400.0])
def test_a_false_current_is_not_valid_from_its_second_row(current_a: float) -> None:
    table = run(stated(LOG, current_a), MODEL)
    before = LOG.time_s < FALSE_S[0]
    assert np.any(table.status[before] == Status.VALID)
    after = (LOG.time_s >= FALSE_S[0] + 1.0) & (LOG.time_s < FALSE_S[1] + 300.0)
    assert not np.any(table.status[after] == Status.VALID)


def test_a_wrong_scale_is_not_valid() -> None:
    table = run(stated(LOG, 10.0 * LOG.current_a), MODEL)
    beyond = np.abs(stated(LOG, 10.0 * LOG.current_a).current_a) > 250.0
    assert np.sum(beyond) > 5
    assert not np.any(table.status[beyond] == Status.VALID)


@pytest.mark.parametrize(
    ("current_a", "least_a"), [(500.0, -50.0), (-400.0, -50.0), (-300.0, 15.0)]
)
def test_both_implementations_contradict_the_same_rows(current_a: float, least_a: float) -> None:
    model = within(MODEL, least_a, 200.0)
    log, settings = stated(LOG, current_a), EstimatorSettings(initial_soc_pct=90.0)
    python = step_all(Estimator(model, settings), samples_of(log))
    compiled = run_estimator(log, model, settings)
    np.testing.assert_array_equal(compiled.reasons, python.reasons)
    assert np.any(python.reasons & Reason.INNOVATION_LARGE)


@pytest.mark.parametrize("make", [Estimator, make_estimator])
def test_a_soc_counted_without_a_voltage_is_not_valid(
    make: Callable[..., Estimator],
) -> None:
    """Current and voltage change places for three minutes: 370 A are counted."""
    assert LOG.soc_pct is not None
    is_swapped = (LOG.time_s >= 605.0) & (LOG.time_s < 785.0)
    current_a = np.where(is_swapped, LOG.voltage_v, LOG.current_a)
    voltage_v = np.where(is_swapped, LOG.current_a, LOG.voltage_v)
    swapped = replace(LOG, current_a=current_a, voltage_v=voltage_v)
    estimator = make(MODEL, EstimatorSettings(initial_soc_pct=90.0))
    table = step_all(estimator, samples_of(swapped))
    after = LOG.time_s >= 605.0
    error_pct = np.abs(table.soc_pct - LOG.soc_pct)
    assert error_pct[after].max() > 30.0
    is_wrong = after & (error_pct > 3.0 * table.soc_std_pct)
    assert not np.any(table.status[is_wrong] == Status.VALID)
    assert np.any(table.status[~after] == Status.VALID)


@pytest.mark.parametrize("make", [Estimator, make_estimator])
def test_a_voltage_that_returns_counts_from_the_end_of_its_block(
    make: Callable[..., Estimator],
) -> None:
    samples = [
        each._replace(voltage_v=float("nan")) if 605.0 <= each.time_s < 785.0 else each
        for each in samples_of(LOG)
    ]
    table = step_all(make(MODEL, EstimatorSettings(initial_soc_pct=90.0)), samples)
    is_missing = (table.reasons & Reason.VOLTAGE_MISSING) != 0
    assert np.array_equal(is_missing, (LOG.time_s >= 605.0) & (LOG.time_s < 810.0))
    assert table.status[LOG.time_s == 810.0] == Status.VALID


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_true_high_current_changes_nothing(seed: int) -> None:
    """A model that was identified within ±20 A, and a drive of up to 100 A."""
    log = synthetic_log(start_pct=90.0, end_pct=50.0, noise_v=0.8, seed=seed, hours=0.6)
    assert np.mean(np.abs(log.current_a) > 20.0) > 0.5
    known, unknown = run(log, within(MODEL, -1e3, 1e3)), run(log, within(MODEL, -20.0, 20.0))
    np.testing.assert_array_equal(unknown.status, known.status)
    assert np.mean(known.status == Status.VALID) > 0.8


@pytest.mark.real
@pytest.mark.parametrize("folder", ["bmw_i3", "batic_car1"])
def test_a_model_of_calm_logs_stays_valid_on_the_others(shared_data: Path, folder: str) -> None:
    logs = [cangauge.read_log(path) for path in sorted((shared_data / folder).glob("*.csv.gz"))]
    logs = sorted(logs[:12], key=_largest_a)
    model = cangauge.fit(logs[:1], capacity_ah="from-soc").model
    for whole in logs[-3:]:
        log = whole.rows(slice(0, None, max(1, len(whole) // 6000)))
        assert _largest_a(log) > max(np.abs(model.range.current_a))
        known, unknown = run(log, within(model, -1e3, 1e3)), run(log, model)
        np.testing.assert_array_equal(unknown.status, known.status)


def _largest_a(log: Log) -> float:
    return float(np.max(np.abs(log.current_a)))
