"""Diagnosis: names what was done to a log, says none or unknown, and its model runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from days import day, late

from cangauge.diagnosis.cross_validation import soc_mae_pct
from cangauge.diagnosis.diagnose import Diagnosis, diagnose, in_words
from cangauge.diagnosis.extended_model import library_without, model_file_of
from cangauge.diagnosis.problem import build_problem
from cangauge.errors import InputError
from cangauge.estimate.offline import estimate_log
from cangauge.estimate.settings import EstimatorSettings
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.report.diagnosis import gap_report
from synthetic import synthetic_log

FAULTS = {
    "current_offset": lambda log: replace(log, current_a=log.current_a + 4.0),
    "voltage_offset": lambda log: replace(log, voltage_v=log.voltage_v + 2.5),
    "resistance_asymmetry": lambda log: replace(
        log, voltage_v=log.voltage_v - 0.06 * np.minimum(log.current_a, 0.0)
    ),
    "resistance_step": lambda log: replace(
        log, voltage_v=log.voltage_v - 0.05 * log.current_a * (log.time_s > 1400.0)
    ),
    "initial_soc": lambda log: replace(log, soc_pct=log.soc_pct + 5.0),
    "time_skew": late,
}


@pytest.fixture(scope="module")
def offset(model: Model, references: list[Log]) -> Diagnosis:
    return diagnose([FAULTS["current_offset"](day(21))], model, references)


@pytest.mark.parametrize("effect", FAULTS)
def test_names_a_clear_fault_or_says_what_it_cannot_tell_it_from(
    effect: str, model: Model, references: list[Log]
) -> None:
    found = diagnose([FAULTS[effect](day(21)), FAULTS[effect](day(22))], model, references)
    assert effect in {found.verdict.cause, *found.verdict.ambiguous_with}
    assert len(found.verdict.ambiguous_with) <= 2
    assert found.extended_rmse_v < found.baseline_rmse_v


def test_says_none_on_clean_logs(model: Model, references: list[Log]) -> None:
    for seed in range(30, 36):
        found = diagnose([day(seed)], model, references)
        assert found.verdict.cause == "none"
        assert found.closed is None


@pytest.mark.parametrize("taught_from_pct", [55.0, None])
def test_what_shows_only_at_a_charge_that_no_reference_has_been_at_is_no_clear_cause(
    taught_from_pct: float | None, model: Model, references: list[Log]
) -> None:
    if taught_from_pct is not None:
        taught_pct = (taught_from_pct, model.range.soc_pct[1])
        narrow = model.range.model_copy(update={"soc_pct": taught_pct})
        model = model.model_copy(update={"range": narrow})
    log = synthetic_log(hours=1.2, start_pct=85.0, end_pct=40.0, noise_v=0.5, seed=21)
    assert log.soc_pct is not None
    beyond = np.maximum(55.0 - log.soc_pct, 0.0)
    found = diagnose([replace(log, voltage_v=log.voltage_v + 0.5 * beyond)], model, references)
    assert found.baseline_rmse_v > 2.0 * found.floor_v
    if taught_from_pct is None:
        # The model's own logs have been there: something is wrong, but hardly a known effect.
        chances = dict(found.verdict.chances)
        assert chances.pop("unknown") > 0.5
        assert chances.pop("none") < 0.1
        assert max(chances.values()) < 0.3
    else:
        # Nobody has been there: it is how a formula goes on.
        assert found.verdict.cause == "none"


def test_says_unknown_of_what_no_effect_is_like(model: Model, references: list[Log]) -> None:
    log = day(21)
    wave = 6.0 * np.sin(2.0 * np.pi * log.time_s / 240.0)
    found = diagnose([replace(log, voltage_v=log.voltage_v + wave)], model, references)
    assert found.verdict.cause == "unknown"


def test_finds_both_of_two_causes(model: Model, references: list[Log]) -> None:
    logs = [FAULTS["resistance_asymmetry"](FAULTS["current_offset"](day(k))) for k in (21, 22)]
    found = diagnose(logs, model, references)
    assert {score.effect_id for score in found.verdict.accepted} == {
        "current_offset",
        "resistance_asymmetry",
    }


def test_what_the_shape_of_a_large_cause_leaves_is_no_second_cause(
    model: Model, references: list[Log]
) -> None:
    def rising(log: Log) -> Log:  # a step of resistance, but for its quarter of an hour
        part = np.clip((log.time_s - 900.0) / 900.0, 0.0, 1.0)
        return replace(log, voltage_v=log.voltage_v - 0.08 * log.current_a * part)

    found = diagnose([rising(day(21)), rising(day(22))], model, references)
    assert [score.effect_id for score in found.verdict.accepted] == ["resistance_step"]


def test_a_step_is_found_at_its_moment_in_logs_of_any_length(
    model: Model, references: list[Log]
) -> None:
    short = synthetic_log(
        hours=0.55, start_pct=80.0, end_pct=62.0, noise_v=0.5, seed=22, name="short"
    )
    logs = [FAULTS["resistance_step"](log) for log in (day(21), short)]
    found = diagnose(logs, model, references)
    assert found.verdict.cause == "resistance_step"
    assert found.extension.cause["resistance_step"]["start_s"] == pytest.approx(1400.0, abs=20.0)
    parameter = found.candidates[0]["parameters"]["step_ohm"]
    assert parameter["value"] == pytest.approx(0.05, rel=0.1)
    assert parameter["ci"][0] < 0.05 < parameter["ci"][1]


def test_parameter_and_closed_fraction_are_those_put_in(offset: Diagnosis) -> None:
    parameters = offset.candidates[0]["parameters"]["offset_a"]
    low, high = parameters["ci"]
    assert low < 4.0 < high
    assert offset.closed is not None
    assert offset.closed > 0.9
    assert offset.extension.cause["current_offset"]["offset_a"] == pytest.approx(4.0, abs=0.6)


def test_extended_model_runs_in_the_estimator(
    offset: Diagnosis, model: Model, tmp_path: Path
) -> None:
    path = tmp_path / "better.json"
    model_file_of(offset.extension, model, offset.extended_rmse_v).save(path)
    log = FAULTS["current_offset"](day(40))
    settings = EstimatorSettings(initial_soc_pct=85.0, method="coulomb")
    _, plain = estimate_log(log, model, settings)
    _, better = estimate_log(log, Model.load(path), settings)
    assert plain.soc_mae_pct is not None
    assert better.soc_mae_pct is not None
    assert better.soc_mae_pct < 0.25 * plain.soc_mae_pct


def test_json_has_the_contracts_keys(offset: Diagnosis) -> None:
    found = json.loads(json.dumps(offset.to_dict("better.json")))
    assert found["schema"] == 1
    assert {
        "baseline_rmse_v", "extended_rmse_v", "floor_sensor_v", "floor_explainable_v",
        "closed_fraction", "closed_fraction_ci", "baseline_soc_mae_pct", "extended_soc_mae_pct",
    } == set(found["gap"])  # fmt: skip
    assert {"verdict", "probability", "ambiguous_with", "accepted", "candidates"} <= set(
        found["cause"]
    )
    cause = found["cause"]
    chances = [item["probability"] for item in cause["candidates"]]
    answers = [*chances, cause["probability_unknown"], cause["probability_none"]]
    assert sum(answers) == pytest.approx(1.0)
    assert {item["axis"] for item in found["where"]} == {
        "soc", "temperature", "current", "rest", "time", "timescale",
    }  # fmt: skip
    for axis in ("soc", "current", "time", "timescale"):
        shares = [item["share"] for item in found["where"] if item["axis"] == axis]
        assert sum(shares) == pytest.approx(1.0, abs=1e-6)
    assert len(found["observability"]) == 20
    assert found["extended_model"] == "better.json"


def test_page_tells_the_verdict_and_loads_nothing(offset: Diagnosis) -> None:
    page = gap_report(offset)
    assert "current_offset" in page
    assert in_words(offset).split(":")[0] in page
    assert "default-src 'none'" in page


def test_without_references_the_models_noise_is_the_floor(model: Model) -> None:
    found = diagnose([day(21)], model, [])
    assert found.floor_v == model.noise.voltage_rmse_v
    assert found.verdict.cause == "none"


def test_without_references_nothing_is_said_of_them(model: Model) -> None:
    found = diagnose([day(21)], model, [])
    assert in_words(found).startswith("No gap beyond what the model file states (")


def test_refuses_where_nothing_tells_how_well_the_model_is_known(model: Model) -> None:
    with pytest.raises(InputError, match="--reference"):
        diagnose([day(21)], model.model_copy(update={"information": None}), [])


def test_coefficients_are_known_by_their_names(offset: Diagnosis, model: Model) -> None:
    shuffled = model.model_copy(update={"coefficients": dict(sorted(model.coefficients.items()))})
    assert list(shuffled.coefficients) != list(model.coefficients)
    one, other = (model_file_of(offset.extension, given, 0.5) for given in (model, shuffled))
    assert one.coefficients == other.coefficients


def test_the_extended_models_noise_agrees_with_itself(offset: Diagnosis, model: Model) -> None:
    for times in (0.5, 8.0):
        noise = model_file_of(offset.extension, model, times * model.noise.voltage_rmse_v).noise
        assert noise.fast_std_v == pytest.approx(times * model.noise.fast_std_v)
        assert noise.voltage_mae_pct == pytest.approx(times * model.noise.voltage_mae_pct)


def test_a_soc_at_some_rows_is_compared_with_if_it_is_told_all_along(model: Model) -> None:
    log = day(40)
    assert log.soc_pct is not None
    rows = np.arange(len(log))
    slow, first = (np.where(keep, log.soc_pct, np.nan) for keep in (rows % 30 == 7, rows < 900))
    assert soc_mae_pct([replace(log, soc_pct=slow)], model) == pytest.approx(
        soc_mae_pct([log], model), rel=0.1
    )
    assert soc_mae_pct([replace(log, soc_pct=first)], model) is None


def test_steps_of_a_fast_logs_temperature_are_read_between(model: Model) -> None:
    """Found in the reports: means over parts of a second would blur them first."""
    fast = synthetic_log(hours=1.0, rate_hz=100.0, start_pct=80.0, end_pct=70.0)
    warming_c = 20.0 + 3.0 * (1.0 - np.exp(-fast.time_s / 1500.0)) + 0.2 * np.sin(fast.time_s / 400)
    coarse = replace(fast, temperature_c=np.floor(warming_c + 0.5))
    settled = build_problem([coarse], model, [], library_without([]))
    seen = settled.diagnosed[0].prepared.log
    error_k = seen.temperature_c - np.interp(seen.time_s, fast.time_s, warming_c)
    assert np.sqrt(np.mean(error_k**2)) < 0.13
    assert settled.temperature_step_k == 1.0


def test_refuses_a_log_of_another_pack(model: Model, references: list[Log]) -> None:
    log = day(21)
    with pytest.raises(InputError, match="another pack"):
        diagnose([replace(log, voltage_v=log.voltage_v / 4.0)], model, references)


def test_refuses_a_turned_current_by_its_count(model: Model, references: list[Log]) -> None:
    log = day(21)
    with pytest.raises(InputError, match="sign of current"):
        diagnose([replace(log, current_a=-log.current_a)], model, references)
