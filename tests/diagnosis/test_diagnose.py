"""Diagnosis: the cause of a known fault, `none` or `unknown`, and an extended model that runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from days import asymmetric, day, late, more_amperes, more_volts, resistance_step

from cangauge.diagnosis import LIKELY, Diagnosis, diagnose
from cangauge.diagnosis.cross_validation import soc_error_pct
from cangauge.diagnosis.extended_model import extended_model_file
from cangauge.diagnosis.problem import build_problem
from cangauge.diagnosis.verdict import decide
from cangauge.errors import InputError
from cangauge.estimation.offline import estimate_log
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.report.diagnosis import gap_report
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from synthetic import synthetic_log

FAULTS = {
    "current_offset": lambda log: more_amperes(log, 4.0),
    "voltage_offset": lambda log: more_volts(log, 2.5),
    "resistance_asymmetry": asymmetric,
    "resistance_step": resistance_step,
    "initial_soc": lambda log: replace(log, soc_pct=log.soc_pct + 5.0),
    "time_skew": late,
}


@pytest.fixture(scope="module")
def offset(model: Model, references: list[Log]) -> Diagnosis:
    return diagnose([more_amperes(day(21), 4.0)], model, references)


@pytest.fixture(scope="module")
def without_references(model: Model) -> Diagnosis:
    return diagnose([day(21)], model)


@pytest.mark.parametrize("effect", FAULTS)
def test_a_clear_fault_is_named_or_ambiguous(
    effect: str, model: Model, references: list[Log]
) -> None:
    found = diagnose([FAULTS[effect](day(21)), FAULTS[effect](day(22))], model, references)
    assert effect in {found.verdict.cause, *found.verdict.ambiguous_with}
    assert len(found.verdict.ambiguous_with) <= 2
    assert found.extended_rmse_v < found.baseline_rmse_v


def test_healthy_logs_have_no_cause(model: Model, references: list[Log]) -> None:
    for seed in range(30, 35):
        assert decide(build_problem([day(seed)], model, references)).cause == "none"
    found = diagnose([day(35)], model, references)
    assert found.verdict.cause == "none"
    assert found.closed_fraction is None


@pytest.mark.parametrize("fitted_from_pct", [55.0, None])
def test_a_gap_outside_the_references_soc_has_no_clear_cause(
    fitted_from_pct: float | None, model: Model, references: list[Log]
) -> None:
    if fitted_from_pct is not None:
        soc_pct = (fitted_from_pct, model.range.soc_pct[1])
        narrow = model.range.model_copy(update={"soc_pct": soc_pct})
        model = model.model_copy(update={"range": narrow})
    log = synthetic_log(hours=1.2, start_pct=85.0, end_pct=40.0, noise_v=0.5, seed=21)
    assert log.soc_pct is not None
    beyond = np.maximum(55.0 - log.soc_pct, 0.0)
    found = diagnose([replace(log, voltage_v=log.voltage_v + 0.5 * beyond)], model, references)
    assert found.baseline_rmse_v > 2.0 * found.floor_v
    if fitted_from_pct is None:
        # The model's own logs cover this SoC: there is a gap, but hardly of a known effect.
        assert found.verdict.cause == "unknown"
        assert found.verdict.detected
        probabilities = found.verdict.probabilities
        assert max(probabilities[item["effect"]] for item in found.candidates) < LIKELY
    else:
        # No log covers it: the pseudo-OCV extrapolates.
        assert found.verdict.cause == "none"


def test_a_gap_unlike_any_effect_is_unknown(model: Model, references: list[Log]) -> None:
    log = day(21)
    wave = 6.0 * np.sin(2.0 * np.pi * log.time_s / 240.0)
    found = diagnose([replace(log, voltage_v=log.voltage_v + wave)], model, references)
    assert found.verdict.cause == "unknown"


def test_two_causes_are_both_accepted(model: Model, references: list[Log]) -> None:
    logs = [asymmetric(more_amperes(day(seed), 4.0)) for seed in (21, 22)]
    found = diagnose(logs, model, references)
    assert set(found.extension.cause) == {score.effect_id for score in found.verdict.accepted}
    assert set(found.extension.cause) == {
        "current_offset",
        "resistance_asymmetry",
    }


def test_the_misfit_of_a_large_cause_is_no_second_cause(
    model: Model, references: list[Log]
) -> None:
    def rising(log: Log) -> Log:  # within a quarter of an hour instead of at once
        part = np.clip((log.time_s - 900.0) / 900.0, 0.0, 1.0)
        return replace(log, voltage_v=log.voltage_v - 0.08 * log.current_a * part)

    verdict = decide(build_problem([rising(day(21)), rising(day(22))], model, references))
    assert [score.effect_id for score in verdict.accepted] == ["resistance_step"]


def test_the_onset_of_a_step_is_found(model: Model, references: list[Log]) -> None:
    short = synthetic_log(
        hours=0.55, start_pct=80.0, end_pct=62.0, noise_v=0.5, seed=22, name="short"
    )
    logs = [resistance_step(log) for log in (day(21), short)]
    found = diagnose(logs, model, references)
    assert found.verdict.cause == "resistance_step"
    assert found.extension.cause["resistance_step"]["start_s"] == pytest.approx(1400.0, abs=20.0)
    parameter = found.candidates[0]["parameters"]["step_ohm"]
    assert parameter["value"] == pytest.approx(0.05, rel=0.1)
    assert parameter["ci"][0] < 0.05 < parameter["ci"][1]


def test_parameter_and_closed_fraction_match_the_fault(offset: Diagnosis) -> None:
    parameters = offset.candidates[0]["parameters"]["offset_a"]
    low, high = parameters["ci"]
    assert low < 4.0 < high
    assert offset.closed_fraction is not None
    assert offset.closed_fraction > 0.9
    assert offset.extension.cause["current_offset"]["offset_a"] == pytest.approx(4.0, abs=0.6)


def test_the_extended_model_runs_in_the_estimator(
    offset: Diagnosis, model: Model, tmp_path: Path
) -> None:
    path = tmp_path / "better.json"
    offset.extended_model.save(path)
    log = more_amperes(day(40), 4.0)
    settings = EstimatorSettings(initial_soc_pct=85.0, method="coulomb")
    _, plain = estimate_log(log, model, settings)
    _, better = estimate_log(log, Model.load(path), settings)
    assert plain.soc_mae_pct is not None
    assert better.soc_mae_pct is not None
    assert better.soc_mae_pct < 0.25 * plain.soc_mae_pct


def test_json_has_the_keys_of_the_contract(offset: Diagnosis) -> None:
    found = json.loads(json.dumps(offset.to_dict("better.json")))
    assert found["schema"] == 2
    assert {
        "baseline_rmse_v", "extended_rmse_v", "floor_sensor_v", "floor_explainable_v",
        "closed_fraction", "closed_fraction_ci", "baseline_soc_mae_pct", "extended_soc_mae_pct",
    } == set(found["gap"])  # fmt: skip
    cause = found["cause"]
    assert {
        "detected", "verdict", "probability", "probability_none", "probability_unknown", "family",
        "family_probability", "credible_set", "ambiguous_with", "accepted", "candidates",
    } <= set(cause)  # fmt: skip
    assert cause["detected"] is (cause["probability_none"] <= 0.02)
    assert cause["credible_set"][0] == cause["verdict"]
    assert cause["family_probability"] >= cause["probability"]
    assert set(found["ceiling"]) == {"isolable_from", "probability_of_best"}
    assert set(found["ceiling"]["isolable_from"]) == {
        item["effect"] for item in cause["candidates"]
    } - {cause["verdict"]}
    assert len(found["inputs"]["references"]) == 3
    assert len(found["inputs"]["model"]["sha256"]) == 64
    probabilities = [item["probability"] for item in cause["candidates"]]
    answers = [*probabilities, cause["probability_unknown"], cause["probability_none"]]
    assert sum(answers) == pytest.approx(1.0)
    assert {item["axis"] for item in found["where"]} == {
        "soc", "temperature", "current", "rest", "time", "timescale",
    }  # fmt: skip
    for axis in ("soc", "current", "time", "timescale"):
        shares = [item["share"] for item in found["where"] if item["axis"] == axis]
        assert sum(shares) == pytest.approx(1.0, abs=1e-6)
    assert len(found["observability"]) == 20
    assert found["extended_model"] == "better.json"


def test_the_page_has_the_verdict_and_loads_nothing(offset: Diagnosis) -> None:
    page = gap_report(offset)
    assert "current_offset" in page
    assert offset.summary.split(":")[0] in page
    assert "default-src 'none'" in page


def test_without_references_the_models_noise_is_the_floor(
    without_references: Diagnosis, model: Model
) -> None:
    assert without_references.floor_v == model.noise.voltage_rmse_v
    assert without_references.verdict.cause == "none"


def test_without_references_the_summary_names_the_model_file(
    without_references: Diagnosis,
) -> None:
    expected = "No significant gap beyond the error stated in the model file ("
    assert without_references.summary.startswith(expected)


def test_the_soc_error_is_computed_on_request(
    without_references: Diagnosis, offset: Diagnosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        pytest.fail("the estimator ran")

    with monkeypatch.context() as patch:
        patch.setattr("cangauge.diagnosis.cross_validation.run_estimator", fail)
        gap = without_references.to_dict(soc_error=False)["gap"]
        assert gap["baseline_soc_mae_pct"] is gap["extended_soc_mae_pct"] is None
    gap = offset.to_dict()["gap"]
    assert gap["extended_soc_mae_pct"] < gap["baseline_soc_mae_pct"] < 5.0


def test_refuses_without_references_and_information(model: Model) -> None:
    with pytest.raises(InputError, match="--reference"):
        diagnose([day(21)], model.model_copy(update={"information": None}), [])


def test_coefficients_are_assigned_by_name(offset: Diagnosis, model: Model) -> None:
    shuffled = model.model_copy(update={"coefficients": dict(sorted(model.coefficients.items()))})
    assert list(shuffled.coefficients) != list(model.coefficients)
    one, other = (extended_model_file(offset.extension, given, 0.5) for given in (model, shuffled))
    assert one.coefficients == other.coefficients


def test_the_extended_models_noise_is_scaled_as_a_whole(offset: Diagnosis, model: Model) -> None:
    for times in (0.5, 8.0):
        rmse_v = times * model.noise.voltage_rmse_v
        noise = extended_model_file(offset.extension, model, rmse_v).noise
        assert noise.fast_std_v == pytest.approx(times * model.noise.fast_std_v)
        assert noise.voltage_mae_pct == pytest.approx(times * model.noise.voltage_mae_pct)


def test_the_soc_error_needs_a_reference_soc_throughout(model: Model) -> None:
    log = day(40)
    assert log.soc_pct is not None
    rows = np.arange(len(log))
    slow, first = (np.where(keep, log.soc_pct, np.nan) for keep in (rows % 30 == 7, rows < 900))
    sparse, whole = (soc_error_pct([each], model) for each in (replace(log, soc_pct=slow), log))
    assert sparse == pytest.approx(whole, rel=0.1)
    assert soc_error_pct([replace(log, soc_pct=first)], model) is None


def test_temperature_steps_of_a_fast_log_are_interpolated(model: Model) -> None:
    """Before resampling, whose means would blur the steps."""
    fast = synthetic_log(hours=1.0, rate_hz=100.0, start_pct=80.0, end_pct=70.0)
    warming_c = 20.0 + 3.0 * (1.0 - np.exp(-fast.time_s / 1500.0)) + 0.2 * np.sin(fast.time_s / 400)
    coarse = replace(fast, temperature_c=np.floor(warming_c + 0.5))
    problem = build_problem([coarse], model, [])
    seen = problem.diagnosed[0].sampled.log
    error_k = seen.temperature_c - np.interp(seen.time_s, fast.time_s, warming_c)
    assert np.sqrt(np.mean(error_k**2)) < 0.13
    assert problem.temperature_step_k == 1.0


def test_refuses_a_log_of_another_pack(model: Model, references: list[Log]) -> None:
    log = day(21)
    with pytest.raises(InputError, match="another pack"):
        diagnose([replace(log, voltage_v=log.voltage_v / 4.0)], model, references)


def test_refuses_a_current_of_the_wrong_sign(model: Model, references: list[Log]) -> None:
    log = day(21)
    with pytest.raises(InputError, match="sign of current"):
        diagnose([replace(log, current_a=-log.current_a)], model, references)
