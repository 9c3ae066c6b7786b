"""Identification: recovers the truth of simulated logs and refuses insufficient ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.identify.delays import search_delays
from cangauge.identify.fit import common_name, fit
from cangauge.inference.least_squares import solve
from cangauge.inference.rows import FitOptions
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import (
    capacity_from_full_discharge,
    capacity_from_reference,
    discharged_ah,
)
from cangauge.model.published import CAPACITY_AH, leaf_2012_model
from cangauge.model.voltage_model import VoltageModel
from synthetic import synthetic_log

TRUTH = leaf_2012_model()


def test_recovers_the_coefficients_of_a_noiseless_log() -> None:
    found = fit([synthetic_log()])
    model = found.voltage_model
    soc = np.linspace(*model.soc_range_pct, 200)
    assert model.pseudo_ocv(soc) == pytest.approx(TRUTH.pseudo_ocv(soc), abs=1e-5)
    assert model.resistance_ohm == pytest.approx(TRUTH.resistance_ohm, abs=1e-7)
    assert model.kt_v_per_k == pytest.approx(TRUTH.kt_v_per_k, abs=1e-6)
    assert found.voltage_mae_pct < 1e-6
    assert found.soc_newton_mae_pct < 1e-4
    assert found.model.capacity_ah == pytest.approx(CAPACITY_AH, rel=1e-3)


def test_irregular_time_stamps_give_the_same_model() -> None:
    log = synthetic_log(rate_hz=10.0, hours=1.0, end_pct=50.0)
    rng = np.random.default_rng(3)
    keep = np.sort(rng.choice(len(log), len(log) // 2, replace=False))
    # The current between the kept samples is unknown, but piecewise constant except for the steps.
    found = fit([log.rows(keep)], capacity_ah=CAPACITY_AH)
    soc = np.linspace(55.0, 98.0, 50)
    assert found.voltage_model.pseudo_ocv(soc) == pytest.approx(TRUTH.pseudo_ocv(soc), abs=0.1)


def test_standard_errors_cover_the_truth() -> None:
    truth = np.array([*TRUTH.ocv_v, TRUTH.kt_v_per_k, *TRUTH.resistance_ohm])
    inside = []
    for seed in range(30):
        log = synthetic_log(noise_v=1.0, seed=seed, hours=1.5)
        found = fit([log], capacity_ah=CAPACITY_AH)
        error = found.solution.coefficients - truth
        inside.append(np.abs(error[-5:]) < 2.0 * found.solution.std_error[-5:])
    # 150 draws of kt and R1…R4: 2 standard errors must hold about 95 % of them.
    assert 0.88 <= np.mean(inside) <= 1.0


def test_removes_start_up_and_shut_down_rows() -> None:
    log = synthetic_log(noise_v=0.2)
    voltage = log.voltage_v.copy()
    voltage[3000:3020] = np.linspace(150.0, 2.0, 20)
    broken = fit([replace(log, voltage_v=voltage)], capacity_ah=CAPACITY_AH)
    whole = fit([log], capacity_ah=CAPACITY_AH)
    assert broken.fits[0].rows.removed["start_up_or_shut_down"] == 24
    assert broken.voltage_mae_pct == pytest.approx(whole.voltage_mae_pct, rel=0.02)


def test_pseudo_ocv_rises_where_the_plain_fit_would_fall() -> None:
    rng = np.random.default_rng(0)
    log = synthetic_log(hours=0.6, start_pct=80.0, end_pct=72.0)
    slow = 3.0 * np.sin(np.linspace(0.0, 9.0, len(log))) + rng.normal(0.0, 0.3, len(log))
    found = fit([replace(log, voltage_v=log.voltage_v + slow)], capacity_ah=CAPACITY_AH)
    assert found.solution.constrained
    soc = np.linspace(0.0, 100.0, 500)
    assert np.all(np.diff(found.voltage_model.pseudo_ocv(soc)) > 0.0)
    assert np.ptp(found.voltage_model.pseudo_ocv(soc)) < 300.0


def test_slope_resistance_agrees_with_the_autocorrelation() -> None:
    found = fit([synthetic_log(noise_v=0.9)])
    assert found.slope_ohm == pytest.approx(found.slope_expected_ohm, rel=0.01)


def test_several_logs_cover_more_soc_than_each() -> None:
    logs = [
        synthetic_log(start_pct=start, end_pct=start - 30.0, hours=1.0, noise_v=0.3, seed=start)
        for start in (95, 70, 45)
    ]
    found = fit(logs, capacity_ah=CAPACITY_AH)
    soc = np.linspace(20.0, 90.0, 50)
    assert found.voltage_model.pseudo_ocv(soc) == pytest.approx(TRUTH.pseudo_ocv(soc), abs=0.3)
    assert found.model.noise.judged_on == "whole logs left out in turn"


def test_capacity_needs_a_log_from_full_to_empty() -> None:
    whole = replace(synthetic_log(end_pct=0.0), soc_pct=None)
    assert capacity_from_full_discharge([whole], 100.0) == pytest.approx(CAPACITY_AH, rel=0.005)
    part = replace(synthetic_log(end_pct=30.0), soc_pct=None)
    with pytest.raises(InputError, match="full to empty"):
        capacity_from_full_discharge([part], 100.0)
    referenced = synthetic_log(start_pct=90.0, end_pct=30.0)
    with pytest.raises(InputError, match="--capacity-ah"):
        fit([referenced])
    assert capacity_from_reference([referenced]) == pytest.approx(CAPACITY_AH, rel=1e-3)


@pytest.mark.parametrize(
    ("log", "words"),
    [
        (synthetic_log(hours=0.015, end_pct=99.0), "no rows are left"),
        (synthetic_log(hours=0.5, start_pct=80.0, end_pct=79.5), "too little for a voltage model"),
        (replace(synthetic_log(), current_a=np.full(9000, 20.0)), "current is constant"),
        (replace(synthetic_log(), current_a=-synthetic_log().current_a), "sign of current"),
    ],
)
def test_names_the_reason_why_a_log_identifies_nothing(log: Log, words: str) -> None:
    with pytest.raises(InputError, match=words):
        fit([log], capacity_ah=CAPACITY_AH)


def test_refuses_logs_with_different_temperature_sources() -> None:
    log = synthetic_log(hours=0.5)
    other = replace(synthetic_log(hours=0.5, seed=2), temperature_source="cell")
    with pytest.raises(InputError, match="different sources"):
        fit([log, other], capacity_ah=CAPACITY_AH)


def test_information_reproduces_the_solution() -> None:
    found = fit([synthetic_log(noise_v=0.5)])
    information = found.model.information
    assert information is not None
    x = np.linalg.solve(np.array(information.root), np.array(information.projected))
    x /= np.array(information.scale)
    assert not found.solution.constrained
    assert x == pytest.approx(found.solution.coefficients, rel=1e-6)


def test_delay_search_finds_the_true_delays() -> None:
    truth = VoltageModel(TRUTH.ocv_v, TRUTH.kt_v_per_k, (-0.1, -0.03, -0.03), (0.0, 20.0, 100.0))
    log = synthetic_log(model=truth, noise_v=0.3)
    found = search_delays([log], FitOptions(capacity_ah=CAPACITY_AH))
    assert found.delay_s == (0.0, 20.0, 100.0)
    assert found.held_out_rmse_v == pytest.approx(0.3, rel=0.1)


def test_an_indispensable_log_is_not_held_out() -> None:
    long = synthetic_log(hours=1.1, start_pct=95.0, end_pct=10.0, noise_v=0.5, name="long")
    short = [
        synthetic_log(hours=0.05, start_pct=60.0, end_pct=59.0, noise_v=0.5, seed=seed)
        for seed in (2, 3)
    ]
    found = fit([long, *short], capacity_ah=CAPACITY_AH)
    of_long, *of_short = found.held_out_error_v
    assert np.isnan(of_long).all()
    assert all(np.isfinite(errors).any() for errors in of_short)


def test_capacity_counts_from_the_first_known_soc() -> None:
    whole = synthetic_log(hours=1.5, end_pct=0.5)
    assert whole.soc_pct is not None
    at = 300
    reference = np.full(len(whole), np.nan)
    reference[at] = 100.0
    late = capacity_from_full_discharge([replace(whole, soc_pct=reference)], None)
    out_ah = discharged_ah(whole.time_s, whole.current_a)
    assert late == pytest.approx(out_ah[-1] - out_ah[at])


def test_trapezoidal_charge_on_irregular_steps() -> None:
    time_s = np.array([0.0, 1.0, 4.0, 10.0])
    current_a = np.array([0.0, 2.0, 8.0, 8.0])
    assert discharged_ah(time_s, current_a)[-1] * 3600.0 == pytest.approx(1.0 + 15.0 + 48.0)


def test_constrained_least_squares_is_optimal() -> None:
    rng = np.random.default_rng(2)
    columns, target = rng.normal(size=(200, 5)), rng.normal(size=200)
    bounds = rng.normal(size=(8, 5))
    block = np.arange(200) // 10
    found = solve(columns, target, block, bounds, 0.2)
    assert found.constrained
    assert np.all(bounds @ found.coefficients >= 0.2 - 1e-6)
    best = np.sum((columns @ found.coefficients - target) ** 2)
    for _ in range(500):
        other = found.coefficients + rng.normal(0.0, 0.05, 5)
        if np.all(bounds @ other >= 0.2):
            assert np.sum((columns @ other - target) ** 2) >= best - 1e-6


def test_keyword_arguments_suffice_for_a_fit_with_effects() -> None:
    logs = [
        synthetic_log(start_pct=start, end_pct=start - 30.0, hours=0.6, noise_v=0.3, seed=start)
        for start in (95, 85, 75)
    ]
    found = fit(logs, capacity_ah=CAPACITY_AH, delay_s=[0.0, 10.0, 30.0, 70.0], effects="auto")
    assert found.effects is not None
    assert found.model.made.options["effects"] == "auto"


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["TripA01", "TripA03", "TripA05", "TripA07", "TripA09"], "TripA (5 logs)"),
        (["TripA01"], "TripA01"),
        (["leaf2012_a", "leaf2012_b"], "leaf2012 (2 logs)"),
        (["drive 9", "drive 10"], "drive (2 logs)"),
        (["drive1", "drive12"], "drive (2 logs)"),
        (["cold", "cold"], "cold (2 logs)"),
        (["cold", "mild", "warm"], "cold and 2 more"),
        (["2024-01-05", "2024-01-06"], "2024-01 (2 logs)"),
        (["1", "2"], "1 and 1 more"),
    ],
)
def test_a_model_is_named_after_the_common_part_of_its_logs(
    names: list[str], expected: str
) -> None:
    assert common_name(names) == expected


def test_a_given_name_is_kept() -> None:
    log = synthetic_log(hours=0.5, name="day")
    assert fit([log], capacity_ah=CAPACITY_AH).model.name == "day"
    other = synthetic_log(hours=0.5, seed=2, name="day")
    assert fit([log, other], capacity_ah=CAPACITY_AH).model.name == "day (2 logs)"
    assert fit([log], capacity_ah=CAPACITY_AH, name="pack").model.name == "pack"
