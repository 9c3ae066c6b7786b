"""Identification: recovers the truth of simulated logs and refuses insufficient ones."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cangauge
from cangauge._typing import FloatArray
from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.identify.fit import common_name, fit
from cangauge.identify.identification import Identification
from cangauge.identify.least_squares import (
    ADDED_STD,
    B_LEFT_STD,
    SECONDS_PER_DATUM,
    log_sums,
    row_features,
    row_weights,
    solve,
    solve_scaled,
)
from cangauge.identify.rows import CHUNK, FitRows, fit_rows
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import (
    capacity_from_full_discharge,
    capacity_from_reference,
    discharged_ah,
)
from cangauge.model.curve import KNOTS_PCT, HermiteCurve
from cangauge.model.prior import CHEMISTRIES, ChemistryName, PackPrior
from cangauge.model.published import CAPACITY_AH, leaf_2012_model
from cangauge.model.voltage_model import VoltageModel
from cangauge.types import Reason
from synthetic import synthetic_log, voltage_model

TRUTH = leaf_2012_model()
OXIDE = CHEMISTRIES["oxide"]
PACK = PackPrior(OXIDE, CAPACITY_AH)

CELLS = voltage_model(
    HermiteCurve.rising(KNOTS_PCT, 96.0 * OXIDE.curve_v), -0.02, (-0.07, -0.01, -0.01, -0.005)
)
"""A pack of typical cells."""


def trips(number: int, *, model: VoltageModel = CELLS, noise_v: float = 0.3) -> list[Log]:
    return [
        synthetic_log(
            start_pct=95.0 - 6.0 * k, end_pct=60.0 - 6.0 * k, hours=0.6, noise_v=noise_v,
            seed=k + 1, model=model, name=f"trip{k + 1}",
        )
        for k in range(number)
    ]  # fmt: skip


def test_recovers_curve_and_resistance_of_a_pack() -> None:
    found = fit(trips(4), capacity_ah=CAPACITY_AH)
    soc = np.linspace(45.0, 92.0, 50)
    assert found.voltage_model.pseudo_ocv(soc) == pytest.approx(CELLS.pseudo_ocv(soc), abs=0.3)
    assert sum(found.voltage_model.loads.resistance_ohm) == pytest.approx(-0.095, rel=0.05)
    assert found.voltage_rmse_v == pytest.approx(0.3, rel=0.05)
    assert found.model.noise.judged_on == "whole logs left out in turn"
    assert found.model.noise.voltage_rmse_v == pytest.approx(0.3, rel=0.1)


def curve_std_v(found: Identification, soc_pct: FloatArray) -> FloatArray:
    functions = found.model.functions
    zero = np.zeros(len(found.voltage_model.load_coefficients))
    return np.array([np.linalg.norm(functions.row(soc, zero)) for soc in soc_pct.tolist()])


def test_beyond_its_logs_the_curve_follows_the_typical_cell() -> None:
    found = fit(trips(1), capacity_ah=CAPACITY_AH)
    soc = np.linspace(5.0, 50.0, 20)
    error_v = found.voltage_model.pseudo_ocv(soc) - CELLS.pseudo_ocv(soc)
    assert np.abs(error_v).max() < 5.0
    assert np.all(np.abs(error_v) < 3.0 * curve_std_v(found, soc))
    assert "Add a drive below" in found.verdict
    assert "there the curve follows the typical cell" in found.verdict


@pytest.mark.parametrize("curve_v", [OXIDE.curve_v, OXIDE.other_v], ids=["layered", "spinel"])
@pytest.mark.parametrize("start_pct", [95.0, 60.0])
def test_either_typical_cell_is_a_usual_one(curve_v: FloatArray, start_pct: float) -> None:
    cells = replace(CELLS, curve=HermiteCurve.rising(KNOTS_PCT, 96.0 * curve_v))
    log = synthetic_log(
        start_pct=start_pct, end_pct=start_pct - 15.0, hours=0.6, noise_v=0.3, model=cells
    )
    found = fit(log, capacity_ah=CAPACITY_AH, cells=96)
    soc = np.linspace(15.0, 100.0, 20)
    error_v = np.abs(found.voltage_model.pseudo_ocv(soc) - cells.pseudo_ocv(soc))
    assert np.all(error_v < 1.2 * curve_std_v(found, soc))


def test_is_the_weighted_least_squares_of_all_rows() -> None:
    """The sums of the logs against one dense system with a column for the level of each log."""
    long = synthetic_log(start_pct=92.0, end_pct=30.0, hours=6.0, model=CELLS)
    rows = [fit_rows(log, CAPACITY_AH) for log in [*trips(2), long]]
    assert len(rows[-1]) > CHUNK
    found = solve([log_sums(item, OXIDE) for item in rows], PACK)
    size, logs = found.coefficients.size, len(rows)
    weight = np.concatenate([row_weights(r.soc_pct, r.row_s, OXIDE) for r in rows])
    columns = np.concatenate([row_features(r) @ found.select.T for r in rows])
    owner = np.repeat(np.arange(logs), [len(r) for r in rows])
    table = np.column_stack([columns, owner[:, None] == np.arange(logs)])
    volts = np.concatenate([r.voltage_v for r in rows])
    soc = np.concatenate([r.soc_pct for r in rows])
    prior = PACK.coefficients(found.mean_v, float(weight @ soc / weight.sum()))
    precision = np.zeros((size + logs, size + logs))
    precision[:size, :size] = np.linalg.inv(prior.covariance)
    precision[size:, size:] = np.eye(logs) / (OXIDE.level_std * found.mean_v) ** 2
    datum = (found.residual_v**2 + (ADDED_STD * found.mean_v) ** 2) * SECONDS_PER_DATUM
    mean = np.r_[prior.coefficients, np.zeros(logs)]
    normal = (table * weight[:, None]).T @ table / datum + precision
    right = (table * weight[:, None]).T @ (volts - table @ mean) / datum
    expected = mean + np.linalg.solve(normal, right)
    # The noise variance of the last step is within 1e-3 of its fixed point.
    std = np.sqrt(np.diag(found.covariance))
    assert np.abs(found.coefficients - expected[:size]).max() < 2e-3 * std.max()
    covariance = np.linalg.inv(normal)[:size, :size]
    covariance[-1, -1] += B_LEFT_STD**2
    assert np.diag(found.covariance) == pytest.approx(np.diag(covariance), rel=5e-3)


def test_left_out_logs_widen_the_covariance() -> None:
    logs = trips(6)

    def scale(levels_v: float) -> float:
        moved = [
            replace(log, voltage_v=log.voltage_v + levels_v * (-1.0) ** k)
            for k, log in enumerate(logs)
        ]
        sums = [log_sums(fit_rows(log, CAPACITY_AH), OXIDE) for log in moved]
        return solve_scaled(sums, PACK)[0].scale

    assert scale(0.0) == 1.0
    assert scale(10.0) > 3.0


@pytest.mark.parametrize("noise_v", [0.3, 1.0])
def test_like_logs_lower_the_strain_that_a_model_allows(noise_v: float) -> None:
    """Another pack is flagged by the model of logs that agree, and its own further logs are not."""
    model = fit(trips(6, noise_v=noise_v), capacity_ah=CAPACITY_AH, cells=96).model
    noise = model.noise.model_copy(update={"left_out_strain": 1.0})
    lenient = model.model_copy(update={"noise": noise})
    assert 0.4 <= model.noise.left_out_strain < 0.45  # never below the prior's two fifths
    volts = 96.0 * OXIDE.curve_v + 0.08 * (50.0 - KNOTS_PCT)
    loads = CELLS.loads.model_copy(update={"resistance_ohm": (-0.12, -0.01, -0.01, -0.005)})
    other = replace(CELLS, curve=HermiteCurve.rising(KNOTS_PCT, volts), loads=loads)

    def mismatch(log: Log, its_model: cangauge.Model) -> bool:
        table = cangauge.estimate(replace(log, soc_pct=None), its_model)
        return bool(((table.reasons & Reason.MODEL_MISMATCH) != 0).any())

    foreign = trips(4, model=other, noise_v=noise_v)
    assert all(mismatch(log, model) for log in foreign)
    assert not all(mismatch(log, lenient) for log in foreign)
    assert not any(mismatch(log, model) for log in trips(9, noise_v=noise_v)[6:])


def test_many_like_logs_allow_a_drive_that_differs() -> None:
    sums = [log_sums(fit_rows(log, CAPACITY_AH), OXIDE) for log in trips(6)]
    assert 0.4 <= solve_scaled(sums * 7, PACK)[0].strain < 0.45


def test_too_few_logs_keep_the_strain_of_the_prior() -> None:
    assert fit(trips(2), capacity_ah=CAPACITY_AH).model.noise.left_out_strain == 1.0


def test_a_slow_log_weighs_by_its_time() -> None:
    log = synthetic_log(hours=2.0, start_pct=90.0, end_pct=40.0, model=CELLS, noise_v=0.2)
    fast = fit_rows(log, CAPACITY_AH)
    slow = fit_rows(log.rows(slice(None, None, 10)), CAPACITY_AH)
    assert slow.row_s == 10.0

    def total(rows: FitRows) -> float:
        return float(row_weights(rows.soc_pct, rows.row_s, OXIDE).sum())

    assert total(slow) == pytest.approx(total(fast), rel=0.02)


def test_a_long_log_needs_memory_for_few_numbers_a_row() -> None:
    log = synthetic_log(start_pct=92.0, end_pct=30.0, hours=50.0, model=CELLS)
    tracemalloc.start()
    fit(log, capacity_ah=CAPACITY_AH)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2000 * CHUNK + 80 * len(log)  # all columns of all rows would be 328 bytes a row


def test_chemistry_is_given_guessed_or_assumed_and_said() -> None:
    log = trips(1)[0]
    assert fit(log, capacity_ah=50.0, chemistry="lfp").model.chemistry == "lfp"
    guessed = fit(log, capacity_ah=CAPACITY_AH, cells=96)
    assert (guessed.model.chemistry, guessed.model.cells) == ("oxide", 96)
    assert any("chemistry oxide by 3.9" in text for text in guessed.remarks)
    flat = fit(log, capacity_ah=CAPACITY_AH, cells=115)
    assert flat.model.chemistry == "lfp"
    whole = synthetic_log(model=CELLS, noise_v=0.3)  # from full, where both chemistries are high
    assert fit(whole, capacity_ah=CAPACITY_AH, cells=96).model.chemistry == "oxide"
    assumed = fit(log, capacity_ah=CAPACITY_AH)
    assert assumed.model.chemistry == "oxide"
    assert any("Pass --cells N" in text for text in assumed.remarks)


@pytest.mark.parametrize(("cells", "chemistry"), [(72, None), (115, "oxide"), (96, "lfp")])
def test_a_number_of_cells_that_the_voltage_denies_is_refused(
    cells: int, chemistry: ChemistryName | None
) -> None:
    with pytest.raises(InputError, match=r"no (oxide|lfp) cell has") as caught:
        fit(trips(1), capacity_ah=CAPACITY_AH, cells=cells, chemistry=chemistry)
    assert caught.value.field == "cells"


def test_published_equation_recovers_its_coefficients() -> None:
    found = fit([synthetic_log()], equation="published")
    model = found.voltage_model
    soc = np.linspace(*model.range.soc_pct, 200)
    assert model.pseudo_ocv(soc) == pytest.approx(TRUTH.pseudo_ocv(soc), abs=1e-4)
    assert model.loads.resistance_ohm == pytest.approx(TRUTH.loads.resistance_ohm, abs=1e-6)
    assert model.loads.kt_v_per_k == pytest.approx(TRUTH.loads.kt_v_per_k, abs=1e-5)
    assert found.soc_newton_mae_pct < 1e-3
    assert found.model.capacity_ah == pytest.approx(CAPACITY_AH, rel=1e-3)


def test_published_coefficients_come_with_every_fit_that_identifies_them() -> None:
    log = synthetic_log(noise_v=0.5)
    knots, published = fit([log]), fit([log], equation="published")
    assert knots.model.equation == "knots"
    assert knots.model.coefficients == published.model.coefficients
    coefficients = knots.to_dict()["coefficients"]
    assert isinstance(coefficients, dict)
    assert coefficients["R1"]["value"] == pytest.approx(-0.1032, rel=0.02)
    flat = synthetic_log(hours=0.5, start_pct=80.0, end_pct=79.0)
    assert fit([flat], capacity_ah=CAPACITY_AH).model.coefficients == {}


def test_standard_errors_cover_the_truth() -> None:
    truth = np.array([TRUTH.loads.kt_v_per_k, *TRUTH.loads.resistance_ohm])
    inside = []
    for seed in range(10):
        log = synthetic_log(noise_v=1.0, seed=seed, hours=1.5)
        found = fit([log], capacity_ah=CAPACITY_AH, equation="published").model.coefficients
        values = [found[name] for name in ("kt", "R1", "R2", "R3", "R4")]
        error = np.array([item.value for item in values]) - truth
        inside += (np.abs(error) < 2.0 * np.array([item.std_error for item in values])).tolist()
    # Rows of a minute count as one, so that white noise is more than covered.
    assert np.mean(inside) >= 0.95


def test_published_options_move_with_the_equation() -> None:
    changed = {"resistance_ohm": (-0.1, -0.03, -0.03), "delays_s": (0.0, 20.0, 100.0)}
    truth = replace(TRUTH, loads=TRUTH.loads.model_copy(update=changed))
    log = synthetic_log(model=truth, noise_v=0.1)
    found = fit([log], equation="published", delay_s=(0.0, 20.0, 100.0), t_ref_c=15.0)
    assert found.voltage_model.loads.resistance_ohm == pytest.approx((-0.1, -0.03, -0.03), rel=0.02)
    assert found.voltage_model.loads.t_ref_c == 15.0


@pytest.mark.parametrize("epsilon", [0.0, 0.5, 0.7, float("nan")])
def test_an_epsilon_where_the_logarithms_diverge_is_refused(epsilon: float) -> None:
    with pytest.raises(InputError, match=r"epsilon: must lie between 0 and 0\.5"):
        fit([synthetic_log(hours=0.6)], equation="published", epsilon=epsilon)


def test_falling_published_curve_is_refused() -> None:
    log = synthetic_log(hours=0.6, start_pct=80.0, end_pct=72.0)
    slow = 6.0 * np.sin(np.linspace(0.0, 9.0, len(log)))
    moved = replace(log, voltage_v=log.voltage_v + slow)
    with pytest.raises(InputError, match="do not identify the published equation"):
        fit([moved], capacity_ah=CAPACITY_AH, equation="published")
    found = fit([moved], capacity_ah=CAPACITY_AH)
    volts = found.voltage_model.pseudo_ocv(np.linspace(0.0, 100.0, 500))
    assert np.all(np.diff(volts) > 0.0)


def test_removes_start_up_and_shut_down_rows() -> None:
    log = synthetic_log(noise_v=0.2, model=CELLS)
    voltage = log.voltage_v.copy()
    voltage[3000:3020] = np.linspace(150.0, 2.0, 20)
    broken = fit([replace(log, voltage_v=voltage)], capacity_ah=CAPACITY_AH)
    whole = fit([log], capacity_ah=CAPACITY_AH)
    assert broken.fits[0].rows.removed["start_up_or_shut_down"] == 24
    assert broken.voltage_mae_pct == pytest.approx(whole.voltage_mae_pct, rel=0.02)


def test_capacity_needs_a_log_from_full_to_empty() -> None:
    whole = replace(synthetic_log(end_pct=0.0), soc_pct=None)
    assert capacity_from_full_discharge([whole], [100.0]) == pytest.approx(CAPACITY_AH, rel=0.005)
    part = replace(synthetic_log(end_pct=30.0), soc_pct=None)
    with pytest.raises(InputError, match="full to empty") as caught:
        capacity_from_full_discharge([part], [100.0])
    assert caught.value.cure == "give --capacity-ah A"  # no SoC that could give it
    referenced = synthetic_log(start_pct=90.0, end_pct=30.0)
    with pytest.raises(InputError, match="--capacity-ah A, or --capacity-ah from-soc"):
        fit([referenced])
    with pytest.raises(InputError, match='capacity_ah A, or capacity_ah="from-soc"'):
        cangauge.fit([referenced])
    assert capacity_from_reference([referenced]) == pytest.approx(CAPACITY_AH, rel=1e-3)
    model = fit(referenced, capacity_ah="from-soc").model
    assert model.capacity_ah == capacity_from_reference([referenced])
    assert len(repr(model).splitlines()) <= 10


@pytest.mark.parametrize(
    ("log", "words"),
    [
        (synthetic_log(hours=0.015, end_pct=99.0), "no rows are left"),
        (replace(synthetic_log(), current_a=-synthetic_log().current_a), "sign of the current"),
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


def test_refuses_logs_of_different_packs_by_name() -> None:
    """Otherwise a model of no pack, or a traceback where no model file can state its errors."""
    pack, cell = trips(2), trips(3)[2]
    cell = replace(cell, voltage_v=cell.voltage_v / 96.0)
    with pytest.raises(InputError, match=r"trip1: voltage_v: not of one pack with trip3") as error:
        fit([*pack, cell], capacity_ah=CAPACITY_AH)
    assert error.value.cure


def test_left_out_errors_are_missing_where_only_that_log_has_the_soc() -> None:
    long = synthetic_log(hours=1.1, start_pct=95.0, end_pct=10.0, noise_v=0.5, name="long")
    short = [
        synthetic_log(hours=0.05, start_pct=60.0, end_pct=59.0, noise_v=0.5, seed=seed)
        for seed in (2, 3)
    ]
    of_long, *of_short = fit([long, *short], capacity_ah=CAPACITY_AH).held_out_error_v
    assert np.isnan(of_long).mean() > 0.9
    assert all(np.isfinite(errors).all() for errors in of_short)


def test_capacity_counts_from_the_first_known_soc() -> None:
    whole = synthetic_log(hours=1.5, end_pct=0.5)
    at = 300
    reference = np.full(len(whole), np.nan)
    reference[at] = 100.0
    late = capacity_from_full_discharge([replace(whole, soc_pct=reference)], [None])
    out_ah = discharged_ah(whole.time_s, whole.current_a)
    assert late == pytest.approx(out_ah[-1] - out_ah[at])


def test_trapezoidal_charge_on_irregular_steps() -> None:
    time_s = np.array([0.0, 1.0, 4.0, 10.0])
    current_a = np.array([0.0, 2.0, 8.0, 8.0])
    assert discharged_ah(time_s, current_a)[-1] * 3600.0 == pytest.approx(1.0 + 15.0 + 48.0)


@pytest.mark.parametrize("step_k", [0.25, 1.0])
def test_quantized_temperature_is_interpolated(step_k: float) -> None:
    log = synthetic_log(hours=1.0, end_pct=60.0)
    slow_c = 20.0 + 3.0 * np.sin(log.time_s / 1500.0)
    rows = fit_rows(replace(log, temperature_c=np.round(slow_c / step_k) * step_k), CAPACITY_AH)
    assert np.abs(rows.dequantized_c - slow_c[rows.at]).mean() < 0.1 * step_k


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


@pytest.mark.real
def test_unseen_trips_are_predicted_better_than_by_the_published_equation(
    shared_data: Path,
) -> None:
    paths = sorted((shared_data / "bmw_i3").glob("TripA*.csv.gz"))[:11]
    knots = cangauge.fit(paths, capacity_ah=61.75, effects="none")
    published = cangauge.fit(paths, capacity_ah=61.75, equation="published")
    assert knots.model.noise.voltage_mae_pct < 0.15
    assert knots.model.noise.voltage_mae_pct < 0.7 * published.model.noise.voltage_mae_pct


@pytest.mark.real
def test_a_log_that_leaves_the_sign_of_the_resistance_open_is_fitted(
    shared_data: Path, tmp_path: Path
) -> None:
    """A slow charge of LFP cells: rising polarization looks like a negative resistance."""
    log = read_log(shared_data / "a123_lfp" / "A123_DYN_50_P25_s3.csv.gz")
    capacity_ah = float(np.ptp(discharged_ah(log.time_s, log.current_a)))
    found = cangauge.fit(log, capacity_ah=capacity_ah, initial_soc_pct=0.0, chemistry="lfp")
    assert sum(found.voltage_model.loads.resistance_ohm) > 0.0
    found.model.save(tmp_path / "m.json")
    table = cangauge.estimate(log, cangauge.Model.load(tmp_path / "m.json"))
    assert table.soc_pct[-1] == pytest.approx(100.0, abs=5.0)


def test_a_log_wholly_above_full_is_refused_by_name() -> None:
    trip = trips(1)[0].rows(slice(0, 90))  # of which 70 s fill the delay line
    soc_pct = np.full(len(trip), np.nan)
    soc_pct[0] = 100.4
    full = replace(trip, current_a=np.full(len(trip), -50.0), soc_pct=soc_pct, name="full")
    assert fit_rows(full, CAPACITY_AH).soc_pct.min() > 101.0  # within the tolerance
    with pytest.raises(InputError, match=r"full: soc_pct: the counted SoC stays outside 0–100 %"):
        fit([*trips(2), full], capacity_ah=CAPACITY_AH)
