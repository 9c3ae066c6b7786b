"""The fit of summaries of logs is the fit of their rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from cangauge.identify.fit import Identification, fit
from cangauge.identify.log_errors import (
    errors_of,
    slope_resistances,
    summed,
    with_std_errors,
)
from cangauge.identify.voltage_fit import (
    LEVELS_AT_MOST,
    LogInformation,
    fit_information,
    information_of,
    pooled,
)
from cangauge.inference.rows import FitOptions, FitRows, fit_rows
from cangauge.logs.log import Log
from cangauge.validation.cases import Scenario, draw_scenario
from cangauge.validation.twin.recording import record_drive

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
