"""Any simulator in the model's place: the cause of its gap, and its voltage with a correction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from days import day, more_amperes

from cangauge.diagnosis.simulator import Run, SimulatorDiagnosis, diagnose_simulator
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.model.published import CAPACITY_AH


def one_rc(log: Log, initial_soc_pct: float) -> np.ndarray:
    """A simulator of another form than the voltage model: a curve and one RC element."""
    step_s = np.diff(log.time_s, prepend=log.time_s[0])
    out_ah = np.cumsum(log.current_a * step_s) / 3600.0
    soc = initial_soc_pct - 100.0 * out_ah / CAPACITY_AH
    polarization_v = np.zeros(len(log))
    for k in range(1, len(log)):
        kept = np.exp(-step_s[k] / 25.0)
        polarization_v[k] = kept * polarization_v[k - 1] + 0.03 * (1.0 - kept) * log.current_a[k]
    curve_v = 330.0 + 0.55 * soc + 12.0 * np.tanh((soc - 8.0) / 10.0)
    return curve_v - 0.09 * log.current_a - polarization_v


def measured(seed: int) -> Run:
    """A drive on which the simulator is right but for the noise of the sensor."""
    log = day(seed)
    assert log.soc_pct is not None
    volts = one_rc(log, float(log.soc_pct[0]))
    noise_v = np.random.default_rng(seed).normal(0.0, 0.3, len(log))
    return Run(replace(log, voltage_v=volts + noise_v), volts)


def with_offset(seed: int, amperes: float) -> Run:
    """The simulator is given a current that reads too high."""
    right = measured(seed)
    log = more_amperes(right.log, amperes)
    assert log.soc_pct is not None
    return Run(log, one_rc(log, float(log.soc_pct[0])))


@pytest.fixture(scope="module")
def offset() -> SimulatorDiagnosis:
    references = [measured(seed) for seed in (11, 12, 13)]
    runs = [with_offset(21, 4.0), with_offset(22, 4.0)]
    return diagnose_simulator(runs, references, capacity_ah=CAPACITY_AH)


def test_the_cause_is_named_in_the_simulators_terms(offset: SimulatorDiagnosis) -> None:
    verdict = offset.diagnosis.verdict
    assert "current_offset" in {verdict.cause, *verdict.ambiguous_with}
    assert offset.correction.startswith("To correct the simulator: ")
    if verdict.cause == "current_offset":
        amperes = offset.diagnosis.extension.cause["current_offset"]["offset_a"]
        assert amperes == pytest.approx(4.0, abs=0.5)
        assert f"subtract {amperes:.3g} A from the current" in offset.correction


def test_the_error_diagnosed_is_measured_less_simulated(offset: SimulatorDiagnosis) -> None:
    model = offset.diagnosis.model
    for run in offset.runs:
        gap_v = run.log.voltage_v - run.simulated_v
        assert model.predict(run.on(model)).residual_v == pytest.approx(gap_v, abs=1e-9)


def test_the_correction_closes_the_gap_of_each_run(offset: SimulatorDiagnosis) -> None:
    for each in offset.errors():
        assert each["corrected_rmse_v"] < 0.5
        assert each["simulated_rmse_v"] > 1.5 * each["corrected_rmse_v"]


def test_a_good_simulator_has_no_gap() -> None:
    references = [measured(seed) for seed in (11, 12, 13)]
    found = diagnose_simulator([measured(21)], references, capacity_ah=CAPACITY_AH)
    assert found.diagnosis.verdict.cause == "none"
    assert found.correction == ""


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda run: Run(run.log, run.simulated_v[:-1]), "shape"),
        (lambda run: Run(run.log, np.full(len(run.log), np.nan)), "not finite"),
        (lambda run: Run(replace(run.log, soc_pct=None), run.simulated_v), "unknown SoC"),
    ],
)
def test_unusable_simulations_are_refused(change, problem: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match=problem):
        change(measured(21))
