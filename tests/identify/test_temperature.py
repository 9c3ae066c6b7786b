"""Temperature coefficient kt: identified where the logs allow it, else held by its prior."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cangauge.extras.validation.recordings import LG_CAPACITY_AH, LG_PARALLEL, LG_SERIES
from cangauge.extras.validation.twin.injection import scaled_to_pack, with_initial_soc
from cangauge.identify.fit import fit
from cangauge.identify.passes import fit_voltage_model
from cangauge.inference.rows import FitOptions, fit_rows
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.effects.first_order import low_passed
from cangauge.model.published import CAPACITY_AH, leaf_2012_model
from cangauge.model.voltage_model import VoltageModel
from synthetic import synthetic_log

OPTIONS = FitOptions(capacity_ah=CAPACITY_AH)
PUBLISHED = leaf_2012_model()
WITHOUT_KT = replace(PUBLISHED, kt_v_per_k=0.0)


def warming(log: Log, by_k: float) -> NDArray[np.float64]:
    """A temperature that rises with the low-passed heat of a log [°C]."""
    heat = low_passed(log.time_s, log.current_a**2, 2500.0, 0.0)
    return np.asarray(20.0 + by_k * heat / heat.max())


def at_temperature(log: Log, temperature_c: NDArray[np.float64], model: VoltageModel) -> Log:
    """The log as it would have been at another temperature."""
    change = model.kt_v_per_k * (temperature_c - log.temperature_c)
    return replace(log, temperature_c=temperature_c, voltage_v=log.voltage_v + change)


def diffusing(log: Log) -> Log:
    """The log with overvoltages of minutes to an hour, which the model lacks."""
    over = sum(
        0.04 * low_passed(log.time_s, log.current_a, tau_s, 0.0) for tau_s in (200.0, 800.0, 3200.0)
    )
    return replace(log, voltage_v=log.voltage_v - over)


def test_kt_is_found_where_a_log_identifies_it() -> None:
    found = fit([synthetic_log(noise_v=0.5)], capacity_ah=CAPACITY_AH)
    prior = found.solution.kt_prior
    assert prior is not None
    assert prior.shrinkage > 0.98
    assert found.voltage_model.kt_v_per_k == pytest.approx(PUBLISHED.kt_v_per_k, rel=0.03)
    assert not any("kt" in remark for remark in found.remarks)


def test_slow_model_errors_are_not_attributed_to_temperature() -> None:
    """A pack without kt, and an error as slow as its warming."""
    log = synthetic_log(noise_v=0.2, model=WITHOUT_KT)
    log = diffusing(at_temperature(log, warming(log, 4.0), WITHOUT_KT))
    rows = [fit_rows(log, OPTIONS)]
    plain, _ = fit_voltage_model(rows, OPTIONS, with_kt_prior=False)
    found = fit([log], capacity_ah=CAPACITY_AH)
    assert abs(plain.kt_v_per_k) > 0.2
    assert abs(found.voltage_model.kt_v_per_k) < 0.5 * abs(plain.kt_v_per_k)
    assert any("determine kt to" in remark for remark in found.remarks)
    # The standard error includes the slow errors.
    assert found.model.coefficients["kt"].std_error > 0.03


@pytest.mark.parametrize("constant_c", [20.0, 27.0])
def test_kt_is_zero_at_constant_temperature(constant_c: float) -> None:
    """Without the prior any coefficient fits equally well."""
    log = synthetic_log(noise_v=0.3)
    log = at_temperature(log, np.full(len(log), constant_c), PUBLISHED)
    found = fit([log], capacity_ah=CAPACITY_AH)
    assert abs(found.voltage_model.kt_v_per_k) < 1e-3
    assert found.voltage_rmse_v == pytest.approx(0.3, rel=0.05)
    assert any("determine kt to" in remark for remark in found.remarks)
    assert 0.05 < found.model.coefficients["kt"].std_error < 0.2


@pytest.mark.parametrize("step_k", [0.25, 0.5, 1.0])
def test_a_quantized_temperature_is_interpolated(step_k: float) -> None:
    """With the steps as reported kt would be too small: the voltage does not jump with them."""
    log = synthetic_log(noise_v=0.1)
    log = at_temperature(log, warming(log, 8.0), PUBLISHED)
    coarse = replace(log, temperature_c=np.round(log.temperature_c / step_k) * step_k)
    rows = [fit_rows(coarse, OPTIONS)]
    reported = [replace(item, dequantized_c=item.temperature_c) for item in rows]
    as_reported, _ = fit_voltage_model(reported, OPTIONS)
    between, _ = fit_voltage_model(rows, OPTIONS)
    off = [abs(each.kt_v_per_k - PUBLISHED.kt_v_per_k) for each in (as_reported, between)]
    assert off[1] < 0.6 * off[0]


def test_kt_of_one_drive_of_real_cells_holds_in_the_cold(shared_data: Path) -> None:
    """Plain least squares on one drive at 25 °C is wrong by tens of volts at 10 °C."""
    there, cold = (
        with_initial_soc(
            scaled_to_pack(
                read_log(shared_data / "lg_hg2" / f"{name}.parquet"),
                series=LG_SERIES,
                parallel=LG_PARALLEL,
            ),
            100.0,
        )
        for name in ("25degC__551_Mixed1", "10degC__567_Mixed1")
    )
    options = FitOptions(capacity_ah=LG_CAPACITY_AH * LG_PARALLEL)
    rows = [fit_rows(there, options)]
    row = fit_rows(cold, options)

    def missed_v(model: VoltageModel) -> float:
        everywhere = replace(model, temperature_range_c=(-40.0, 60.0))
        volts = everywhere.voltage(row.soc_pct, row.temperature_c, row.delayed_current_a)
        return float(np.sqrt(np.mean((row.voltage_v - volts) ** 2)))

    plain, held = (
        fit_voltage_model(rows, options, with_kt_prior=held)[0] for held in (False, True)
    )
    assert missed_v(held) < 0.5 * missed_v(plain)
