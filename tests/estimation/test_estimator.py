"""The estimator: inverse, counting, filter, status and table."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.errors import InputError
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.counting import CoulombCounter
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import (
    EstimateTable,
    estimate,
    estimate_log,
    run_estimator,
    samples_of,
)
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.inverse import soc_from_ocv
from cangauge.model.model_file import Model
from cangauge.model.published import leaf_2012_model, leaf_2012_model_file
from cangauge.types import Reason, Sample, Status
from synthetic import synthetic_log


@pytest.fixture(scope="module")
def model() -> Model:
    return leaf_2012_model_file()


@given(st.floats(0.0, 100.0), st.floats(0.0, 100.0))
def test_inverse_finds_the_soc_from_any_guess(soc: float, guess: float) -> None:
    truth = leaf_2012_model()
    found_pct, _ = soc_from_ocv(truth.pseudo_ocv_at, truth.pseudo_ocv_at(soc)[0], guess)
    assert found_pct == pytest.approx(soc, abs=1e-6)


@given(st.floats(-1e6, 1e6), st.floats(-50.0, 150.0))
def test_inverse_never_diverges(volts: float, guess: float) -> None:
    truth = leaf_2012_model()
    found_pct, inside = soc_from_ocv(truth.pseudo_ocv_at, volts, guess)
    assert 0.0 <= found_pct <= 100.0
    within = truth.pseudo_ocv_at(0.0)[0] <= volts <= truth.pseudo_ocv_at(100.0)[0]
    assert inside == within


def test_counter_integrates_irregular_steps_and_limits_gaps() -> None:
    counter = CoulombCounter(capacity_ah=10.0, gap_s=2.0)
    counter.step(0.0, 0.0)
    counter.step(1.0, 36.0)
    assert counter.discharged_pct == pytest.approx(18.0 / 36000.0 * 100.0)
    counter.step(21.0, 36.0)
    assert counter.discharged_pct == pytest.approx((18.0 + 36.0 * 20.0) / 36000.0 * 100.0)
    assert counter.gap_var_pct2 > 0.0
    before = counter.discharged_pct
    counter.step(21.0 + 8 * 3600.0, 36.0)
    assert counter.discharged_pct == before
    assert counter.away_s == 8 * 3600.0


@pytest.mark.parametrize(
    ("method", "within_pct"), [("ekf", 0.6), ("newton", 0.9), ("coulomb", 0.1)]
)
def test_each_method_follows_a_clean_log(model: Model, method: str, within_pct: float) -> None:
    log = synthetic_log(noise_v=0.2, seed=9)
    table, scores = estimate_log(
        log, model, EstimatorSettings(method=method, initial_soc_pct=100.0)
    )
    assert scores.soc_mae_pct is not None
    assert scores.soc_mae_pct < within_pct
    assert np.all((table.soc_pct >= 0.0) & (table.soc_pct <= 100.0))


@pytest.mark.parametrize("wrong_pct", [-60.0, -20.0, 15.0])
def test_wrong_start_is_covered_then_rejected_and_flagged(model: Model, wrong_pct: float) -> None:
    log = synthetic_log(start_pct=80.0, end_pct=70.0, noise_v=0.5, seed=11, hours=0.5)
    wrong, _ = estimate_log(log, model, EstimatorSettings(initial_soc_pct=80.0 + wrong_pct))
    withheld, _ = estimate_log(log, model, EstimatorSettings())
    assert wrong.soc_pct[0] == pytest.approx(80.0 + wrong_pct, abs=0.1)
    late = log.time_s > 300.0
    assert np.abs(wrong.soc_pct - withheld.soc_pct)[late].max() < 1.0
    marked = (wrong.reasons & Reason.INNOVATION_LARGE) != 0
    assert np.any(marked)
    assert not np.any(marked & (log.time_s > 500.0))
    error = np.abs(wrong.soc_pct - log.soc_pct)
    assert np.mean(error <= 2.0 * wrong.soc_std_pct) > 0.95 or abs(wrong_pct) > 50.0


@pytest.mark.parametrize("sigmas", [-2.0, 2.0])
def test_correct_initial_soc_survives_biased_voltages(model: Model, sigmas: float) -> None:
    bias_v = sigmas * model.noise.level_std_v
    log = synthetic_log(start_pct=80.0, end_pct=70.0, noise_v=0.5, seed=11, hours=0.5)
    samples = [item._replace(voltage_v=item.voltage_v + bias_v) for item in samples_of(log)]
    given, withheld = (
        run_estimator(samples, model, EstimatorSettings(initial_soc_pct=start))
        for start in (80.0, None)
    )
    late = log.time_s > 120.0
    error = np.abs(given.soc_pct - log.soc_pct)[late]
    assert error.max() < 1.5
    assert np.abs(withheld.soc_pct - log.soc_pct)[late].mean() > 2.0 * error.mean()
    assert not np.any(given.reasons & Reason.INNOVATION_LARGE)


def test_stated_deviation_of_the_start_is_used(model: Model) -> None:
    log = synthetic_log(start_pct=80.0, end_pct=79.0, noise_v=0.5, seed=11, hours=0.1)
    for std_pct, filters in ((0.5, 2), (30.0, 1)):
        estimator = Estimator(
            model, EstimatorSettings(initial_soc_pct=80.0, initial_soc_std_pct=std_pct)
        )
        assert len(estimator.hypotheses.filters) == filters
        assert estimator.hypotheses.filters[0].P[0, 0] == std_pct**2
        for sample in samples_of(log):
            last = estimator.step(sample)
        assert last.soc_std_pct == pytest.approx(max(std_pct, 0.6), rel=1.0)


def test_filter_learns_the_current_offset(model: Model) -> None:
    log = synthetic_log(start_pct=95.0, end_pct=20.0, noise_v=0.5, seed=12)
    samples = [item._replace(current_a=item.current_a + 2.0) for item in samples_of(log)]
    table = run_estimator(samples, model, EstimatorSettings(initial_soc_pct=95.0))
    fused = np.abs(table.soc_pct - log.soc_pct).mean()
    counted = np.abs(table.soc_coulomb_pct - log.soc_pct).mean()
    assert fused < 0.4 * counted


def test_offset_is_found_once_the_pack_is_charged_too(model: Model) -> None:
    """While it is only discharged, another capacity would give the same voltages."""
    estimator = make_estimator(model, EstimatorSettings(initial_soc_pct=80.0))
    drives = [(80.0, 30.0, 1), (30.0, 80.0, 2), (80.0, 30.0, 3), (30.0, 80.0, 4)]
    for k, (start_pct, end_pct, seed) in enumerate(drives):
        log = synthetic_log(start_pct=start_pct, end_pct=end_pct, noise_v=0.5, seed=seed, hours=1.0)
        for item in samples_of(log):
            shown = item._replace(time_s=item.time_s + 3600.0 * k, current_a=item.current_a + 2.0)
            estimator.step(shown)
    offset_a, std_a = estimator.health.offset_a, estimator.health.offset_std_a
    assert offset_a == pytest.approx(2.0, abs=0.5)
    assert abs(offset_a - 2.0) < 2.0 * std_a


def test_two_sigma_covers_the_reference(model: Model) -> None:
    inside = []
    for seed in range(20, 30):
        log = synthetic_log(start_pct=90.0, end_pct=50.0, noise_v=0.5, seed=seed, hours=1.0)
        table, _ = estimate_log(log, model, EstimatorSettings())
        error = (table.soc_pct - log.soc_pct)[300:]
        inside.append(np.abs(error) <= 2.0 * table.soc_std_pct[300:])
    assert np.mean(inside) >= 0.9


def test_first_block_gives_the_unknown_initial_soc(model: Model) -> None:
    log = synthetic_log(start_pct=70.0, end_pct=60.0, noise_v=0.2, seed=4, hours=0.5)
    table = run_estimator(log, model, EstimatorSettings())
    assert np.all(table.status[:30] == Status.INITIALISING)
    assert np.all(np.isnan(table.soc_pct[:30]))
    assert np.all(np.isfinite(table.soc_newton_pct))
    assert table.soc_pct[30] == pytest.approx(70.0, abs=2.0 * table.soc_std_pct[30])
    assert table.status[30] == Status.DEGRADED
    assert table.reasons[30] & Reason.DELAY_LINE_FILLING


def test_voltage_corrects_once_per_block_and_charge_on_every_sample(model: Model) -> None:
    log = synthetic_log(start_pct=70.0, end_pct=65.0, rate_hz=4.0, noise_v=0.5, seed=4, hours=0.2)
    estimator = Estimator(model, EstimatorSettings(initial_soc_pct=70.0))
    changes, before = [], estimator.hypotheses.filters[0].x
    for sample in samples_of(log):
        last = estimator.step(sample)
        if estimator.hypotheses.filters[0].x is not before:
            before = estimator.hypotheses.filters[0].x
            changes.append(sample.time_s)
    assert changes == [30.0 * k for k in range(1, len(changes) + 1)]
    assert last.time_s - changes[-1] < 30.0


def test_block_with_a_gap_is_dropped(model: Model) -> None:
    log = synthetic_log(start_pct=70.0, end_pct=65.0, noise_v=0.5, seed=4, hours=0.2)
    log = log.rows((log.time_s < 100.0) | (log.time_s > 104.0))
    estimator = Estimator(model, EstimatorSettings(initial_soc_pct=70.0))
    evidences = []
    for sample in samples_of(log):
        estimator.update(sample)
        evidences.append(estimator.hypotheses.filters[0].evidence)
    steps = log.time_s[1:][np.diff(evidences) != 0.0]
    assert steps[:4].tolist() == [30.0, 60.0, 90.0, 150.0]


def test_deviation_grows_between_blocks(model: Model) -> None:
    log = synthetic_log(start_pct=70.0, end_pct=65.0, noise_v=0.5, seed=4, hours=0.2)
    log = log.rows(log.time_s < 400.0)
    silent = [
        # Discharge alone: what an unknown capacity did to the SoC, charging takes back.
        each._replace(voltage_v=math.nan, current_a=abs(each.current_a))
        if each.time_s > 200.0
        else each
        for each in samples_of(log)
    ]
    table = run_estimator(silent, model, EstimatorSettings(initial_soc_pct=70.0))
    assert np.all(np.diff(table.soc_std_pct[241:]) > 0.0)


def test_status_is_valid_once_the_delay_line_is_full(model: Model) -> None:
    log = synthetic_log(start_pct=70.0, end_pct=60.0, noise_v=0.2, seed=4, hours=0.5)
    table, _ = estimate_log(log, model, EstimatorSettings())
    filling = (table.reasons & Reason.DELAY_LINE_FILLING) != 0
    assert np.array_equal(filling, log.time_s < 70.0)
    assert np.mean(table.status[~filling] == Status.VALID) > 0.95


def test_current_gap_degrades_for_the_longest_delay(model: Model) -> None:
    log = synthetic_log(start_pct=70.0, end_pct=60.0, noise_v=0.2, seed=4, hours=0.5)
    keep = (log.time_s < 600.0) | (log.time_s >= 605.0)
    table, _ = estimate_log(log.rows(keep), model, EstimatorSettings())
    gap = (table.reasons & Reason.CURRENT_GAP) != 0
    assert table.time_s[gap].min() == 605.0
    assert table.time_s[gap].max() == 674.0


def test_charge_is_counted_without_voltage_and_temperature(model: Model) -> None:
    log = synthetic_log(start_pct=70.0, end_pct=60.0, noise_v=0.2, seed=4, hours=0.5)
    samples = [
        item._replace(voltage_v=math.nan, temperature_c=math.nan) if item.time_s > 900 else item
        for item in samples_of(log)
    ]
    table = run_estimator(samples, model, EstimatorSettings(initial_soc_pct=70.0))
    assert np.abs(table.soc_pct - log.soc_pct).max() < 1.5
    late = table.reasons[table.time_s > 900]
    assert np.all(late & Reason.VOLTAGE_MISSING)
    assert np.all(late & Reason.TEMPERATURE_MISSING)


@pytest.mark.parametrize("make", [Estimator, make_estimator])
def test_deviation_without_voltage_contains_an_unknown_capacity(
    model: Model, make: Callable[..., Estimator]
) -> None:
    """A quarter of an hour at 100 A: 10 % of the charge (`health.CAPACITY_STD`) are unknown."""
    estimator = make(model, EstimatorSettings(initial_soc_pct=90.0))
    ocv_v = float(model.voltage_model().pseudo_ocv([90.0])[0])
    for second in range(300):
        seen = estimator.step(Sample(float(second), 0.0, ocv_v, 23.0))
    for second in range(300, 1200):
        unseen = estimator.step(Sample(float(second), 100.0, math.nan, 23.0))
    charge_pct = seen.soc_pct - unseen.soc_pct
    assert charge_pct > 40.0
    assert unseen.soc_std_pct > 0.1 * charge_pct


def test_time_that_does_not_increase_is_refused(model: Model) -> None:
    estimator = Estimator(model)
    estimator.step(Sample(1.0, 10.0, 380.0, 23.0))
    again = estimator.step(Sample(1.0, 5000.0, 380.0, 23.0))
    assert again.reasons & Reason.IMPLAUSIBLE_INPUT
    assert again.samples == 1


def test_temperature_source_mismatch_degrades(model: Model) -> None:
    estimator = Estimator(model, EstimatorSettings(temperature_source="cell"))
    estimate = estimator.step(Sample(0.0, 10.0, 380.0, 23.0))
    assert estimate.reasons & Reason.TEMPERATURE_SOURCE_MISMATCH


def test_setting_out_of_range_is_named() -> None:
    with pytest.raises(InputError, match="initial_soc_pct"):
        EstimatorSettings(initial_soc_pct=140.0)


@pytest.mark.parametrize("make", [Estimator, make_estimator])
def test_an_open_contactor_is_a_block_without_voltage(
    model: Model, make: Callable[..., Estimator]
) -> None:
    """The voltage behind it falls over a second: its filter capacitor discharges."""
    closed = [Sample(float(second), 0.0, 375.0, 23.0) for second in range(180)]
    opened, absent = list(closed), list(closed)
    opened[100:110] = [each._replace(voltage_v=3.0) for each in closed[100:110]]
    opened[100] = closed[100]._replace(voltage_v=250.0)
    absent[90:120] = [each._replace(voltage_v=math.nan) for each in closed[90:120]]
    settings_ = EstimatorSettings(initial_soc_pct=60.0)
    found, expected = (
        EstimateTable.of(map(make(model, settings_).step, samples)) for samples in (opened, absent)
    )
    assert np.array_equal(found.soc_pct, expected.soc_pct)
    assert np.all(found.reasons[101:110] & Reason.IMPLAUSIBLE_INPUT)
    assert not np.any(found.reasons & Reason.INNOVATION_LARGE)


def test_uncertain_soc_is_degraded(model: Model) -> None:
    log = synthetic_log(start_pct=70.0, end_pct=60.0, noise_v=0.2, seed=4, hours=0.5)
    wide, _ = estimate_log(log, model, EstimatorSettings(valid_std_pct=100.0))
    limit_pct = float(np.nanmedian(wide.soc_std_pct))
    table, _ = estimate_log(log, model, EstimatorSettings(valid_std_pct=limit_pct))
    uncertain = (table.reasons & Reason.SOC_UNCERTAIN) != 0
    assert np.array_equal(uncertain, table.soc_std_pct > limit_pct)
    assert 0.4 < np.mean(uncertain) <= 0.5
    assert not np.any(table.status[uncertain] == Status.VALID)
    # Only the status changes.
    assert np.array_equal(wide.soc_pct, table.soc_pct, equal_nan=True)
    assert not np.any(wide.reasons & Reason.SOC_UNCERTAIN)


def test_gap_uncertainty_includes_current_at_its_ends() -> None:
    counter = CoulombCounter(capacity_ah=10.0, gap_s=2.0)
    for second in range(60):
        counter.step(float(second), 0.0)
    counter.step(60.0, 30.0)
    counter.step(90.0, 30.0)
    gap_pct = math.sqrt(counter.gap_var_pct2)
    assert gap_pct == pytest.approx(100.0 * 30.0 * 30.0 / 36000.0, rel=1e-4)
    counter.step(190.0, 0.0)
    assert counter.parked_std_pct > 100.0 * 30.0 * 100.0 / 36000.0 - 0.1


def test_estimate_starts_from_the_logs_soc_and_scores_it(model: Model) -> None:
    log = synthetic_log(start_pct=70.0, end_pct=60.0, noise_v=0.2, seed=4, hours=0.5)
    table = estimate(log, model)
    expected, scores = estimate_log(log, model, EstimatorSettings(initial_soc_pct=70.0))
    assert np.array_equal(table.soc_pct, expected.soc_pct)
    assert table.scores is not None
    assert table.scores.soc_mae_pct == scores.soc_mae_pct
    withheld, _ = estimate_log(log, model, EstimatorSettings())
    found = estimate(log, model, initial_soc_pct="auto")
    assert np.array_equal(found.soc_pct, withheld.soc_pct, equal_nan=True)


def test_table_converts_to_arrow_with_words_and_nulls(model: Model) -> None:
    sample = Sample(0.0, 10.0, math.nan, 23.0)
    arrow = pa.table(run_estimator([sample], model, EstimatorSettings(initial_soc_pct=80.0)))
    assert arrow.column_names[:3] == ["time_s", "soc_pct", "soc_std_pct"]
    (row,) = arrow.to_pylist()
    assert row["soc_pct"] == 80.0
    assert row["residual_v"] is None
    assert row["status"] == "degraded"
    assert row["reasons"] == "delay line filling; voltage missing; soc uncertain"


def test_paths_and_frames_are_taken_for_logs_and_models(model: Model, tmp_path: Path) -> None:
    log = synthetic_log(start_pct=70.0, end_pct=68.0, noise_v=0.2, seed=4, hours=0.1)
    model.save(tmp_path / "pack.json")
    expected = estimate(log, model)
    found = estimate(pa.table(log), tmp_path / "pack.json")
    assert np.array_equal(found.soc_pct, expected.soc_pct)
    assert Estimator(tmp_path / "pack.json").capacity_ah == model.capacity_ah
