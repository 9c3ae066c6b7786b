"""The estimator's own arithmetic against filterpy's, and the smoothed SoC."""

from __future__ import annotations

import builtins
import math

import numpy as np
import pytest

from cangauge.estimation.offline import estimate, run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH
from synthetic import synthetic_log


@pytest.fixture(scope="module")
def model() -> Model:
    logs = [
        synthetic_log(start_pct=start, end_pct=start - 25.0, hours=0.7, noise_v=0.5, seed=start)
        for start in (95, 75)
    ]
    return fit(logs, capacity_ah=CAPACITY_AH).model


def drive() -> Log:
    log = synthetic_log(start_pct=85.0, end_pct=60.0, hours=0.8, noise_v=0.5, seed=21)
    keep = (log.time_s < 900.0) | (log.time_s >= 1500.0)  # and an unobserved interval
    return log.rows(keep)


@pytest.mark.parametrize("start_pct", [None, 85.0, 60.0])
def test_own_filter_equals_filterpy(model: Model, start_pct: float | None) -> None:
    found, reference = (
        run_estimator(
            samples_of(drive()),
            model,
            EstimatorSettings(initial_soc_pct=start_pct, filter=which),  # type: ignore[arg-type] # both of them
        )
        for which in ("own", "reference")
    )
    np.testing.assert_allclose(found.soc_pct, reference.soc_pct, atol=1e-9)
    np.testing.assert_allclose(found.soc_std_pct, reference.soc_std_pct, atol=1e-9)
    assert np.array_equal(found.reasons, reference.reasons)


def test_a_step_needs_no_sum_that_depends_on_python(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> float:
        raise AssertionError("its last bits depend on the version of Python or of libm")

    monkeypatch.setenv("CANGAUGE_PURE_PYTHON", "1")
    expected = run_estimator(samples_of(drive()), model, EstimatorSettings(initial_soc_pct=85.0))
    monkeypatch.setattr(builtins, "sum", refuse)
    monkeypatch.setattr(math, "hypot", refuse)
    found = run_estimator(samples_of(drive()), model, EstimatorSettings(initial_soc_pct=85.0))
    monkeypatch.undo()
    assert np.array_equal(found.soc_pct, expected.soc_pct)


def test_smoothed_soc_ends_at_the_filter_and_is_closer_before(model: Model) -> None:
    log = synthetic_log(start_pct=85.0, end_pct=60.0, hours=0.8, noise_v=0.5, seed=21)
    table = estimate(log, model, initial_soc_pct="auto", smooth=True)
    assert table.soc_smooth_pct is not None
    assert table.soc_smooth_std_pct is not None
    plain = estimate(log, model, initial_soc_pct="auto")
    assert np.array_equal(plain.soc_pct, table.soc_pct)
    assert table.soc_smooth_pct[-1] == pytest.approx(table.soc_pct[-1], abs=1e-6)
    assert np.all(table.soc_smooth_std_pct <= table.soc_std_pct + 1e-6)
    early = slice(0, 70)
    error = [
        np.abs(each - log.soc_pct)[early].mean() for each in (table.soc_smooth_pct, table.soc_pct)
    ]
    assert error[0] < error[1]
    assert {"soc_smooth_pct", "soc_smooth_std_pct"} <= set(table.to_arrow().column_names)


def test_two_passes_of_a_linear_problem_equal_the_batch_solution() -> None:
    """A random walk observed with noise: smoothing against dense Gaussian conditioning."""
    rng = np.random.default_rng(2)
    size, start_var, walk_var, noise_var = 30, 9.0, 0.25, 1.0
    truth = np.cumsum(rng.normal(0.0, 0.5, size))
    observed = truth + rng.normal(0.0, 1.0, size)
    log = np.minimum.outer(np.arange(size), np.arange(size)) * walk_var + start_var
    expected = log @ np.linalg.solve(log + noise_var * np.eye(size), observed)
    ekf = _scalar_filter(start_var)
    for k in range(size):
        if k:
            ekf.predict(1.0, 0.0, 0.0, walk_var)
        ekf.correct(50.0 + float(observed[k]), noise_var**0.5)
    found, _ = ekf.smoothed()
    np.testing.assert_allclose(found[1:] - 50.0, expected[1:], atol=1e-6)


def _scalar_filter(start_var: float):  # type: ignore[no-untyped-def]
    from cangauge.estimation.smoothing import RecordingEkf  # noqa: PLC0415
    from cangauge.model.published import leaf_2012_model, leaf_2012_model_file  # noqa: PLC0415

    ekf = RecordingEkf(leaf_2012_model(), -0.1, 1e9, leaf_2012_model_file().noise)
    ekf.start(50.0, start_var**0.5)
    ekf._p[1][1] = 0.0  # no offset
    return ekf
