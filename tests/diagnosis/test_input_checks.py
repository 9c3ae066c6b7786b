"""Inputs that a diagnosis refuses or leaves out, and temperatures that no reference covers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from days import asymmetric, day, late, more_resistance, resistance_step

from cangauge.diagnosis import LIKELY, Diagnosis, diagnose
from cangauge.diagnosis.input_checks import MAX_OUTLIERS, check_inputs, without_outliers
from cangauge.diagnosis.problem import build_problem
from cangauge.diagnosis.verdict import decide
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from synthetic import synthetic_log


def with_row(log: Log, channel: str, row: int, value: float) -> Log:
    values = getattr(log, channel).copy()
    values[row] = value
    return replace(log, **{channel: values})


@pytest.fixture(scope="module")
def healthy(model: Model, references: list[Log]) -> Diagnosis:
    return diagnose([day(21)], model, references)


@pytest.mark.parametrize(("channel", "value"), [("current_a", -1023.0), ("voltage_v", 250.0)])
def test_one_outlier_is_left_out_and_reported(
    model: Model, references: list[Log], healthy: Diagnosis, channel: str, value: float
) -> None:
    """A row of −1023 A made a healthy log `charge_transfer`, with a probability of 0.82."""
    found = diagnose([with_row(day(21), channel, 1500, value)], model, references)
    assert found.verdict.cause == healthy.verdict.cause == "none"
    assert found.verdict.probability == pytest.approx(healthy.verdict.probability, abs=0.02)
    (sentence,) = [caveat for caveat in found.caveats if "left out" in caveat]
    assert "day 21, row 1501" in sentence
    assert f"{value:.0f}" in sentence


def test_possible_rows_are_kept(model: Model) -> None:
    extended = model.extended_model()
    log = day(21)
    ohm = -extended.model.resistance_ohm[0]
    pulse_a = 300.0
    answered = with_row(
        with_row(log, "current_a", 1500, pulse_a),
        "voltage_v", 1500, log.voltage_v[1500] - ohm * (pulse_a - log.current_a[1500]),
    )  # fmt: skip
    answered_late = with_row(
        with_row(log, "current_a", 1500, pulse_a),
        "voltage_v", 1502, log.voltage_v[1502] - ohm * (pulse_a - log.current_a[1500]),
    )  # fmt: skip
    for each in (log, answered, answered_late):
        kept, rows = without_outliers(each, extended)
        assert kept is each
        assert rows.size == 0


def test_many_outliers_are_a_fault_to_diagnose(model: Model) -> None:
    log = day(21)
    for k in range(MAX_OUTLIERS + 1):
        log = with_row(log, "current_a", 300 + 200 * k, 1023.0)
    kept, rows = without_outliers(log, model.extended_model())
    assert kept is log
    assert rows.size == 0


def test_a_start_that_counts_beyond_full_is_a_cause(model: Model, references: list[Log]) -> None:
    log = synthetic_log(hours=0.8, start_pct=95.0, end_pct=65.0, noise_v=0.5, seed=21)
    assert log.soc_pct is not None
    found = diagnose([replace(log, soc_pct=log.soc_pct + 10.0)], model, references)
    assert found.verdict.cause == "initial_soc"
    assert found.extension.cause["initial_soc"]["offset_pct"] == pytest.approx(-10.0, abs=1.0)


def test_a_count_that_no_start_explains_is_refused(model: Model, references: list[Log]) -> None:
    log = day(21)
    with pytest.raises(InputError, match="no start explains it"):
        diagnose([replace(log, current_a=8.0 * log.current_a)], model, references)


@pytest.mark.parametrize("channel", ["current_a", "voltage_v"])
def test_a_dead_channel_is_refused(model: Model, references: list[Log], channel: str) -> None:
    log = day(21)
    dead = replace(log, **{channel: np.full(len(log), getattr(log, channel)[0])})
    with pytest.raises(InputError, match=r"constant for 48 min") as caught:
        diagnose([dead], model, references)
    assert caught.value.field == channel


def test_a_log_given_twice_is_refused(model: Model, references: list[Log]) -> None:
    extended = model.extended_model()
    renamed = replace(references[0], name="a copy")
    for logs, given in (
        ([renamed], references),
        ([day(21), day(21)], references),
        ([day(21)], [*references, renamed]),
    ):
        with pytest.raises(InputError, match="would count twice"):
            check_inputs(logs, given, extended)


def test_a_gap_in_the_recording_is_a_caveat(model: Model, references: list[Log]) -> None:
    log = day(21)
    keep = (log.time_s < 900.0) | (log.time_s > 2100.0)
    found = diagnose([log.rows(keep)], model, references)
    (sentence,) = [caveat for caveat in found.caveats if caveat.startswith("Gap in the recording")]
    assert "day 21 (20 min after 0.2 h)" in sentence


def test_a_log_of_another_pack_has_no_likely_cause(model: Model, references: list[Log]) -> None:
    """13 % more voltage is beyond the bounds of `voltage_gain`, which explains most of it."""
    log = day(21)
    other = replace(log, voltage_v=1.13 * log.voltage_v, temperature_c=log.temperature_c - 15.0)
    verdict = diagnose([other], model, references).verdict
    assert verdict.detected
    assert verdict.probability < LIKELY


def colder(log: Log, model: Model) -> Log:
    """The same log 20 K colder, with the model's own change of voltage."""
    colder_v = model.extended_model().model.kt_v_per_k * -20.0
    return replace(log, voltage_v=log.voltage_v + colder_v, temperature_c=log.temperature_c - 20.0)


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        (late, "time_skew"),
        (lambda log: resistance_step(log, 0.08), "resistance_step"),
        (lambda log: asymmetric(log, 0.1), "resistance_asymmetry"),
    ],
)
def test_beyond_the_references_a_clear_cause_is_named(
    model: Model, references: list[Log], fault: Callable[[Log], Log], cause: str
) -> None:
    verdict = decide(build_problem([colder(fault(day(21)), model)], model, references))
    assert verdict.cause == cause
    assert verdict.detected
    assert sum(verdict.probabilities.values()) == pytest.approx(1.0)


def test_resistance_in_the_cold_does_not_indicate_a_fault(
    model: Model, references: list[Log]
) -> None:
    found = diagnose([colder(more_resistance(day(21), 0.08), model)], model, references)
    assert found.verdict.cause == "resistance_temperature"
    assert "does not indicate a fault" in found.summary
