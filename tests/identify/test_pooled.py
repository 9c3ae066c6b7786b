"""The fit of summaries of blocks and logs is the fit of their rows, in bounded memory."""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from cangauge.extras.validation.cases import Scenario, draw_scenario
from cangauge.extras.validation.twin.recording import record_drive
from cangauge.identify import passes
from cangauge.identify.fit import Identification, fit
from cangauge.identify.log_errors import (
    errors_of,
    held_out_error,
    slope_resistances,
    summed,
    with_std_errors,
)
from cangauge.identify.voltage_fit import (
    LEVELS_AT_MOST,
    LogInformation,
    design_matrix,
    fit_information,
    information_of,
    pooled,
)
from cangauge.inference import rows as row_rules
from cangauge.inference.least_squares import CLUSTER_S, solve, triangular_factor
from cangauge.inference.linearized import SLOPE_CHECKS
from cangauge.inference.rows import FitOptions, FitRows, block_numbers, fit_rows
from cangauge.logs.log import Log
from cangauge.model.voltage_model import SLOPE_AT_LEAST, ocv_basis_slope

SAME = 1e-9


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return draw_scenario(5, n_reference=3, climate="mild")


@pytest.fixture(scope="module")
def logs(scenario: Scenario) -> list[Log]:
    drives = scenario.draw_drives(np.random.default_rng(3), 4, 0.5)
    trips = [
        record_drive(scenario.plant, drive, (), name=f"trip{k}").log
        for k, drive in enumerate(drives)
    ]
    return [scenario.training[0].log, *trips]


@pytest.fixture(scope="module")
def options(scenario: Scenario) -> FitOptions:
    return FitOptions(scenario.pack.capacity_ah)


@pytest.fixture(scope="module")
def plain(logs: list[Log], options: FitOptions) -> Identification:
    return fit(logs, capacity_ah=options.capacity_ah)


@pytest.fixture(scope="module")
def rows(logs: list[Log], options: FitOptions) -> list[FitRows]:
    return [fit_rows(log, options) for log in logs]


@pytest.fixture(scope="module")
def parts(rows: list[FitRows], options: FitOptions) -> list[LogInformation]:
    return [information_of(item, options, with_levels=True) for item in rows]


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4], [3, 1, 4, 0, 2]])
def test_coefficients_are_those_of_the_rows(
    plain: Identification, parts: list[LogInformation], options: FitOptions, order: Sequence[int]
) -> None:
    some = [parts[k] for k in order]
    model, solution = fit_information(pooled([pooled(some[:2]), pooled(some[2:])]), options)
    apart = solution.coefficients - plain.solution.coefficients
    assert np.abs(apart / plain.solution.std_error).max() < SAME
    soc = np.linspace(*model.soc_range_pct, 50)
    assert np.allclose(model.pseudo_ocv(soc), plain.voltage_model.pseudo_ocv(soc), rtol=SAME)
    for name in ("soc_range_pct", "temperature_range_c", "current_range_a"):
        assert getattr(model, name) == getattr(plain.voltage_model, name)


def test_standard_errors_and_slope_are_those_of_the_rows(
    plain: Identification,
    parts: list[LogInformation],
    rows: list[FitRows],
    options: FitOptions,
) -> None:
    whole = pooled(parts)
    model, solution = fit_information(whole, options)
    errors = summed(
        [errors_of(item, options, model, solution, mean_c=whole.mean_c) for item in rows]
    )
    found = with_std_errors(solution, errors.sums, errors.scores)
    assert np.allclose(found.std_error, plain.solution.std_error, rtol=SAME)
    slopes = slope_resistances(errors, model.resistance_ohm)
    assert np.allclose(slopes, (plain.slope_ohm, plain.slope_expected_ohm), rtol=SAME)


def test_the_fit_is_the_least_squares_of_all_rows(
    plain: Identification, rows: list[FitRows], options: FitOptions
) -> None:
    """All rows in one matrix with the row of kt's prior, by singular value decomposition."""
    found, prior = plain.solution, plain.solution.kt_prior
    assert prior is not None
    assert found.constrained
    columns = [design_matrix(item, options.epsilon, options.t_ref_c) for item in rows]
    prior_row = np.zeros((1, columns[0].shape[1]))
    prior_row[0, 8] = prior.row_weight
    volts = np.concatenate([*(item.voltage_v for item in rows), [0.0]])
    block = block_numbers(rows, CLUSTER_S)
    grid = np.linspace(*plain.voltage_model.soc_range_pct, SLOPE_CHECKS)
    slopes = np.pad(ocv_basis_slope(grid, options.epsilon), ((0, 0), (0, len(prior_row[0]) - 8)))
    expected = solve(
        np.vstack([*columns, prior_row]),
        volts,
        np.append(block, block.max() + 1),
        slopes,
        SLOPE_AT_LEAST * float(np.median(volts[:-1])),
    )
    apart = found.coefficients - expected.coefficients
    assert np.abs(apart / expected.std_error).max() < SAME
    more = prior.posterior_std_v_per_k**2 - expected.std_error[8] ** 2
    shift = prior.shift_per_kt + np.eye(len(apart))[8]
    std_error = np.sqrt(expected.std_error**2 + max(more, 0.0) * shift**2)
    assert np.allclose(found.std_error, std_error, rtol=SAME)


@pytest.mark.parametrize("number", [1, 2, 5])
@pytest.mark.parametrize("block_rows", [64, 512, 1 << 20])
def test_blocks_of_any_size_give_the_same_fit(
    logs: list[Log], options: FitOptions, monkeypatch: pytest.MonkeyPatch,
    number: int, block_rows: int,
) -> None:  # fmt: skip
    expected = fit(logs[:number], capacity_ah=options.capacity_ah)
    monkeypatch.setattr(row_rules, "BLOCK_ROWS", block_rows)
    found = fit(logs[:number], capacity_ah=options.capacity_ah)
    apart = found.solution.coefficients - expected.solution.coefficients
    assert np.abs(apart / expected.solution.std_error).max() < 1e-7  # rounding: condition of 1e8
    assert np.allclose(found.solution.std_error, expected.solution.std_error, rtol=1e-7)
    for name in ("voltage_mae_pct", "voltage_rmse_v", "soc_newton_mae_pct", "slope_ohm"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=SAME)
    noise, expected_noise = found.model.noise, expected.model.noise
    for name in ("voltage_mae_pct", "voltage_rmse_v"):
        assert getattr(noise, name) == pytest.approx(getattr(expected_noise, name), rel=1e-6)
    for name in ("slow_std_v", "fast_std_v"):  # of a search that ends at 1 %
        assert getattr(noise, name) == pytest.approx(getattr(expected_noise, name), rel=1e-3)


def test_no_more_than_a_block_is_held_with_its_columns(
    logs: list[Log], options: FitOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(row_rules, "BLOCK_ROWS", 256)
    largest = []

    def watched(tables: Iterable[np.ndarray]) -> np.ndarray:
        given = list(tables)
        largest.append(max(map(len, given)))
        return triangular_factor(given)

    monkeypatch.setattr("cangauge.identify.voltage_fit.triangular_factor", watched)
    found = fit(logs, capacity_ah=options.capacity_ah)
    assert min(each.rows for each in found.figures) > 4 * 256
    assert max(largest) <= 256


def test_the_rows_of_one_log_are_held_at_a_time(
    logs: list[Log], options: FitOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[weakref.ref[FitRows]] = []
    alive = []

    def watched(log: Log, how: FitOptions) -> FitRows:
        rows = fit_rows(log, how)
        made.append(weakref.ref(rows))
        alive.append(sum(each() is not None for each in made))
        return rows

    monkeypatch.setattr(passes, "fit_rows", watched)
    fit(logs, capacity_ah=options.capacity_ah)
    assert len(made) == 2 * len(logs)  # two passes
    assert max(alive) <= 3  # iterators keep the ones before until they are replaced


def test_held_out_errors_are_those_of_a_fit_without_the_log(
    plain: Identification, logs: list[Log], rows: list[FitRows], options: FitOptions
) -> None:
    others = fit([log for k, log in enumerate(logs) if k != 2], capacity_ah=options.capacity_ah)
    expected = held_out_error(rows[2], [(None, others.voltage_model)])
    np.testing.assert_allclose(plain.held_out_error_v[2], expected, atol=1e-7)


def test_the_median_voltage_is_exact(rows: list[FitRows], parts: list[LogInformation]) -> None:
    volts = np.concatenate([item.voltage_v for item in rows])
    assert pooled(parts).nominal_v == np.median(volts)


def test_pooled_voltages_do_not_grow_with_the_logs(
    rows: list[FitRows], options: FitOptions
) -> None:
    rng = np.random.default_rng(2)
    noisy = [
        replace(item, voltage_v=item.voltage_v + rng.normal(0.0, 1e-3, len(item)))
        for item in rows * 2
    ]
    parts = [information_of(item, options, with_levels=True) for item in noisy]
    volts = np.concatenate([item.voltage_v for item in noisy])
    assert max(part.levels_v.size for part in parts) <= LEVELS_AT_MOST < np.unique(volts).size
    whole = pooled([pooled(parts[:3]), *parts[3:]])
    assert whole.levels_v.size <= LEVELS_AT_MOST
    assert whole.level_rows.sum() == volts.size
    assert whole.nominal_v == pytest.approx(np.median(volts), rel=1e-4)


def test_voltages_of_many_levels_are_rounded_for_the_median(options: FitOptions) -> None:
    rng = np.random.default_rng(1)
    n = 9000
    time_s = np.arange(float(n))
    log = Log(
        time_s, 20.0 * rng.normal(size=n), 350.0 + rng.normal(size=n), np.full(n, 20.0),
        soc_pct=np.where(time_s == 0.0, 60.0, np.nan),
    )  # fmt: skip
    rows = fit_rows(log, options)
    found = information_of(rows, options, with_levels=True).nominal_v
    assert found != np.median(rows.voltage_v)
    assert found == pytest.approx(np.median(rows.voltage_v), rel=1e-4)
