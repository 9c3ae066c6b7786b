"""What a diagnosis refuses, leaves out and says of its input."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from days import day, late

from cangauge.diagnosis.caveats import reference_fit, worse_with
from cangauge.diagnosis.diagnose import diagnose, in_words
from cangauge.diagnosis.input_checks import FEW, check_inputs, without_outliers
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.model.model_file import Model


def with_row(log: Log, channel: str, row: int, value: float) -> Log:
    values = getattr(log, channel).copy()
    values[row] = value
    return replace(log, **{channel: values})


@pytest.mark.parametrize(("channel", "value"), [("current_a", -1023.0), ("voltage_v", 250.0)])
def test_one_wrong_row_is_left_out_and_told(
    model: Model, references: list[Log], channel: str, value: float
) -> None:
    """A row of −1023 A made `charge_transfer` of a healthy log, with a probability of 0.82."""
    healthy = day(21)
    found = diagnose([with_row(healthy, channel, 1500, value)], model, references)
    clean = diagnose([healthy], model, references)
    assert found.verdict.cause == clean.verdict.cause == "none"
    assert found.verdict.probability == pytest.approx(clean.verdict.probability, abs=0.02)
    (told,) = [sentence for sentence in found.limits if "left out" in sentence]
    assert "day 21, row 1501" in told
    assert f"{value:.0f}" in told


def test_what_a_pack_does_stays(model: Model) -> None:
    extended = model.extended_model()
    log = day(21)
    ohm = -extended.model.resistance_ohm[0]
    pulse_a = 300.0
    answered = with_row(
        with_row(log, "current_a", 1500, pulse_a),
        "voltage_v", 1500, log.voltage_v[1500] - ohm * (pulse_a - log.current_a[1500]),
    )  # fmt: skip
    late = with_row(
        with_row(log, "current_a", 1500, pulse_a),
        "voltage_v", 1502, log.voltage_v[1502] - ohm * (pulse_a - log.current_a[1500]),
    )  # fmt: skip
    for each in (log, answered, late):
        kept, rows = without_outliers(each, extended)
        assert kept is each
        assert rows.size == 0


def test_many_wrong_rows_are_a_fault_to_be_found(model: Model) -> None:
    log = day(21)
    for k in range(FEW + 1):
        log = with_row(log, "current_a", 300 + 200 * k, 1023.0)
    kept, rows = without_outliers(log, model.extended_model())
    assert kept is log
    assert rows.size == 0


@pytest.mark.parametrize("channel", ["current_a", "voltage_v"])
def test_a_dead_channel_is_refused(model: Model, references: list[Log], channel: str) -> None:
    log = day(21)
    dead = replace(log, **{channel: np.full(len(log), getattr(log, channel)[0])})
    with pytest.raises(InputError, match=r"never changes in 48 min") as caught:
        diagnose([dead], model, references)
    assert caught.value.field == channel


def test_a_log_counts_once(model: Model, references: list[Log]) -> None:
    extended = model.extended_model()
    renamed = replace(references[0], name="a copy")
    for logs, given in (
        ([renamed], references),
        ([day(21), day(21)], references),
        ([day(21)], [*references, renamed]),
    ):
        with pytest.raises(InputError, match="would count twice"):
            check_inputs(logs, given, extended)


def test_a_pause_is_told(model: Model, references: list[Log]) -> None:
    log = day(21)
    keep = (log.time_s < 900.0) | (log.time_s > 2100.0)
    found = diagnose([log.rows(keep)], model, references)
    (told,) = [sentence for sentence in found.limits if sentence.startswith("Nothing was recorded")]
    assert "day 21 (20 min, 0.2 h in)" in told


def test_a_log_of_another_pack_gets_no_name(model: Model, references: list[Log]) -> None:
    """Voltage_gain was named with 0.08 where `unknown` had 0.87."""
    log = day(21)
    other = replace(log, voltage_v=1.13 * log.voltage_v, temperature_c=log.temperature_c - 15.0)
    assert diagnose([other], model, references).verdict.cause == "unknown"


def stepped(log: Log) -> Log:
    return replace(log, voltage_v=log.voltage_v - 0.08 * log.current_a * (log.time_s > 1400.0))


def asymmetric(log: Log) -> Log:
    return replace(log, voltage_v=log.voltage_v - 0.1 * np.minimum(log.current_a, 0.0))


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        (late, "time_skew"),
        (stepped, "resistance_step"),
        (asymmetric, "resistance_asymmetry"),
    ],
)
def test_where_no_reference_has_been_a_clear_cause_is_named_without_being_certain(
    model: Model, references: list[Log], fault: Callable[[Log], Log], cause: str
) -> None:
    log = fault(day(21))
    colder_v = model.extended_model().model.kt_v_per_k * -20.0
    cold = replace(log, voltage_v=log.voltage_v + colder_v, temperature_c=log.temperature_c - 20.0)
    verdict = diagnose([cold], model, references).verdict
    assert verdict.cause == cause
    assert verdict.probability < 0.5
    assert sum(verdict.chances.values()) == pytest.approx(1.0)


def test_where_no_reference_has_been_resistance_in_the_cold_tells_no_fault(
    model: Model, references: list[Log]
) -> None:
    log = day(21)
    colder_v = model.extended_model().model.kt_v_per_k * -20.0
    cold = replace(
        log,
        voltage_v=log.voltage_v + colder_v - 0.08 * log.current_a,
        temperature_c=log.temperature_c - 20.0,
    )
    found = diagnose([cold], model, references)
    assert found.verdict.cause == "resistance_temperature"
    assert "it tells no fault" in in_words(found)


def test_references_that_the_model_misses_are_told() -> None:
    fine = [("a", 0.5), ("b", 0.6), ("c", 0.55)]
    assert reference_fit(fine, 0.4, 360.0) == ""
    assert reference_fit([], 0.4, 360.0) == ""
    odd = reference_fit([("other", 41.8), *fine], 0.4, 360.0)
    assert "the reference other by 41.8 V (12 % of the voltage), the others by 0.55 V" in odd
    all_off = reference_fit([("same", 2.9), ("same", 2.7)], 0.44, 360.0)
    assert "by 2.80 V where its file states 0.44 V" in all_off


def test_an_extension_that_is_worse_says_so() -> None:
    assert worse_with(2.05, 0.5) == ""
    assert "2.90 V, the given one by 2.05 V: do not run it" in worse_with(2.05, 2.90)
