"""The temperature's coefficient: found where the logs tell it, held where they do not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cangauge.identify.fit import fit
from cangauge.identify.rows import FitOptions
from cangauge.identify.voltage_fit import fit_voltage_model, prepare
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.effects.first_order import low_passed
from cangauge.model.published import CAPACITY_AH, leaf_2012_model
from cangauge.model.voltage_model import VoltageModel
from cangauge.validation.recordings import LG_CAPACITY_AH, LG_PARALLEL, LG_SERIES
from cangauge.validation.twin.injection import scaled_to_pack, with_initial_soc
from synthetic import synthetic_log

OPTIONS = FitOptions(capacity_ah=CAPACITY_AH)
PUBLISHED = leaf_2012_model()
WITHOUT_KT = replace(PUBLISHED, kt_v_per_k=0.0)


def warming(log: Log, by_k: float) -> NDArray[np.float64]:
    """A temperature that rises over a log as heat comes in and goes [°C]."""
    heat = low_passed(log.time_s, log.current_a**2, 2500.0, 0.0)
    return np.asarray(20.0 + by_k * heat / heat.max())


def at_temperature(log: Log, temperature_c: NDArray[np.float64], model: VoltageModel) -> Log:
    """The log as it would have been at another temperature."""
    change = model.kt_v_per_k * (temperature_c - log.temperature_c)
    return replace(log, temperature_c=temperature_c, voltage_v=log.voltage_v + change)


def diffusing(log: Log) -> Log:
    """A log with overvoltages of minutes to an hour, which the model lacks."""
    over = sum(
        0.04 * low_passed(log.time_s, log.current_a, tau_s, 0.0) for tau_s in (200.0, 800.0, 3200.0)
    )
    return replace(log, voltage_v=log.voltage_v - over)


def test_a_log_that_tells_it_is_believed() -> None:
    found = fit([synthetic_log(noise_v=0.5)], OPTIONS)
    held = found.solution.held
    assert held is not None
    assert held.part > 0.98
    assert found.voltage_model.kt_v_per_k == pytest.approx(PUBLISHED.kt_v_per_k, rel=0.03)
    assert not any("kt" in remark for remark in found.remarks)


def test_what_the_model_lacks_is_not_taken_for_the_temperature() -> None:
    """A pack without kt, and an error as slow as its warming: elsewhere that would be volts."""
    log = synthetic_log(noise_v=0.2, model=WITHOUT_KT)
    log = diffusing(at_temperature(log, warming(log, 4.0), WITHOUT_KT))
    rows = prepare([log], OPTIONS)
    plain, _ = fit_voltage_model(rows, OPTIONS, is_held=False)
    found = fit([log], OPTIONS)
    assert abs(plain.kt_v_per_k) > 0.2
    assert abs(found.voltage_model.kt_v_per_k) < 0.5 * abs(plain.kt_v_per_k)
    assert any("kt from the open-circuit voltage" in remark for remark in found.remarks)
    # Its standard error says what the logs leave open, not what one drive happened to agree on.
    assert found.model.coefficients["kt"].std_error > 0.03


@pytest.mark.parametrize("constant_c", [20.0, 27.0])
def test_a_temperature_that_never_moves_tells_nothing(constant_c: float) -> None:
    """Any coefficient would do for the fit, and tens of millions of volts per kelvin did."""
    log = synthetic_log(noise_v=0.3)
    log = at_temperature(log, np.full(len(log), constant_c), PUBLISHED)
    found = fit([log], OPTIONS)
    assert abs(found.voltage_model.kt_v_per_k) < 1e-3
    assert found.voltage_rmse_v == pytest.approx(0.3, rel=0.05)
    assert any("kt from the open-circuit voltage" in remark for remark in found.remarks)
    assert 0.05 < found.model.coefficients["kt"].std_error < 0.2


@pytest.mark.parametrize("step_k", [0.25, 0.5, 1.0])
def test_a_temperature_in_steps_is_read_between_them(step_k: float) -> None:
    """By the reports alone, kt would be found too small: no voltage jumps when a report does."""
    log = synthetic_log(noise_v=0.1)
    log = at_temperature(log, warming(log, 8.0), PUBLISHED)
    coarse = replace(log, temperature_c=np.round(log.temperature_c / step_k) * step_k)
    rows = prepare([coarse], OPTIONS)
    reported = [replace(item, between_c=item.temperature_c) for item in rows]
    as_reported, _ = fit_voltage_model(reported, OPTIONS)
    between, _ = fit_voltage_model(rows, OPTIONS)
    off = [abs(each.kt_v_per_k - PUBLISHED.kt_v_per_k) for each in (as_reported, between)]
    assert off[1] < 0.6 * off[0]


def test_one_drive_of_real_cells_is_no_lesson_on_the_cold(shared_data: Path) -> None:
    """By plain least squares one drive at 25 °C would be tens of volts out at 10 °C."""
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
    rows = prepare([there], options)
    row = prepare([cold], options)[0]

    def missed_v(model: VoltageModel) -> float:
        everywhere = replace(model, temperature_range_c=(-40.0, 60.0))
        volts = everywhere.voltage(row.soc_pct, row.temperature_c, row.delayed_current_a)
        return float(np.sqrt(np.mean((row.voltage_v - volts) ** 2)))

    plain, held = (fit_voltage_model(rows, options, is_held=held)[0] for held in (False, True))
    assert missed_v(held) < 0.5 * missed_v(plain)
