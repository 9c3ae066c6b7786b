"""Effects of a fit: those of the truth are found with their parameters, and no others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.estimation.offline import estimate_log
from cangauge.estimation.settings import EstimatorSettings
from cangauge.identify.cross_validation import CrossValidation, HeldOutErrors, compare
from cangauge.identify.effect_search import NOT_IDENTIFIABLE, SEARCHED, parse_effect_ids
from cangauge.identify.fit import Identification, fit
from cangauge.identify.log_errors import held_out_error
from cangauge.identify.passes import fit_voltage_model, held_out_models
from cangauge.inference.linearized import (
    changed_model,
    free_parameters,
    linearize,
    stacked_residual,
)
from cangauge.inference.rows import FitOptions, SampledLog, sample_log
from cangauge.logs.log import Log
from cangauge.model.effects.base import Signals
from cangauge.model.effects.library import LIBRARY, effect_entries, parse_effects
from cangauge.model.extended import ExtendedModel
from cangauge.model.published import CAPACITY_AH, leaf_2012_model
from synthetic import synthetic_log

TRUTH = replace(leaf_2012_model(), temperature_range_c=(0.0, 40.0))
NOISE_V = 0.4
OPTIONS = FitOptions(capacity_ah=CAPACITY_AH)

TRUE_EFFECTS: dict[str, tuple[tuple[str, dict[str, float]], ...]] = {
    "nothing": (),
    "cold": (
        (
            "resistance_temperature",
            {
                "share": 0.8,
                "activation_k": 3500.0,
                "delayed": 1.0,
                "reference_c": 20.0,
                "lag_s": 0.0,
            },
        ),
    ),
    "dynamics": (
        ("fast_polarization", {"ohm": 0.03, "tau_s": 3.0, "activation_k": 0.0}),
        (
            "slow_diffusion",
            {"ohm": 0.05, "tau_s": 300.0, "spread": 0.0, "activation_k": 0.0, "by_slope": 0.0},
        ),
    ),
    "hysteresis": (("hysteresis", {"half_width_v": 2.0, "travel_pct": 3.0}),),
}
"""Name → effects of the truth; time constants lie between the trial values."""


def truth(name: str) -> ExtendedModel:
    effects = tuple((LIBRARY[effect_id], values) for effect_id, values in TRUE_EFFECTS[name])
    return ExtendedModel(TRUTH, CAPACITY_AH, effects)


@cache
def trips(name: str, number: int = 5) -> tuple[Log, ...]:
    """Trips of 25 minutes on days of 4 to 28 °C, simulated by the model's own equation and noise.

    Six minutes of rest in each separate effects that decay from those that persist.
    """
    made = []
    for k in range(number):
        start = 92.0 - 14.0 * k
        log = synthetic_log(hours=0.42, start_pct=start, end_pct=start - 22.0, seed=40 + k)
        warmth = np.linspace(4.0, 28.0, number)[(2 * k) % number]
        rests = (log.time_s > 800.0) & (log.time_s < 1160.0)
        current_a = np.where(rests, 0.0, log.current_a)
        log = replace(log, temperature_c=log.temperature_c - 23.0 + warmth, current_a=current_a)
        signals = Signals(log.time_s, log.current_a, np.zeros(len(log)), log.temperature_c)
        found = truth(name).predict(signals, start, np.arange(len(log)))
        noise = np.random.default_rng(k).normal(0.0, NOISE_V, len(log))
        volts = found.voltage_v + noise
        made.append(replace(log, voltage_v=volts, soc_pct=found.soc_pct, name=f"trip{k}"))
    return tuple(made)


@cache
def fitted(name: str, effects: tuple[str, ...] = ("auto",)) -> Identification:
    return fit(trips(name), capacity_ah=CAPACITY_AH, effects=effects)


def parameters(result: Identification, effect_id: str) -> dict[str, tuple[float, float | None]]:
    assert result.effects is not None
    ((_, estimates),) = [item for item in result.effects.estimates if item[0] == effect_id]
    return {item.name: (item.value, item.std_error) for item in estimates}


def share_at(reference_c: float, of: dict[str, float]) -> float:
    """The equivalent share, with the resistance, at another reference temperature."""
    grown = math.exp(
        of["activation_k"] * (1.0 / (reference_c + 273.15) - 1.0 / (of["reference_c"] + 273.15))
    )
    return of["share"] * grown / (1.0 - of["share"] + of["share"] * grown)


@pytest.mark.parametrize("name", ["cold", "dynamics", "hysteresis"])
def test_auto_finds_true_effects_with_their_parameters(name: str) -> None:
    result = fitted(name)
    assert result.effects is not None
    assert [effect.id for effect, _ in result.effects.model.effects] == [
        i for i, _ in TRUE_EFFECTS[name]
    ]
    for effect_id, values in TRUE_EFFECTS[name]:
        true = dict(values)
        found = parameters(result, effect_id)
        if effect_id == "resistance_temperature":
            true["share"] = share_at(found["reference_c"][0], values)
        for parameter, (value, std_error) in found.items():
            if std_error is None:
                continue
            assert abs(value - true[parameter]) < 3.5 * std_error
            assert 0.0 < std_error < 0.1 * abs(true[parameter])
    before, after = result.effects.held_out_rmse_v
    # The remaining error is that of the same trips without effects.
    assert after == pytest.approx(fitted("nothing").model.noise.voltage_rmse_v, rel=0.03)
    assert before > 1.2 * after
    assert result.model.noise.voltage_rmse_v == pytest.approx(after)


def test_auto_takes_nothing_on_logs_without_effects() -> None:
    result = fitted("nothing")
    assert result.effects is not None
    assert result.effects.model.effects == ()
    assert result.model.effects == []
    assert {step.what for step in result.effects.steps} <= {"not added"}
    assert any("none taken" in remark for remark in result.remarks)
    plain = fit(trips("nothing"), capacity_ah=CAPACITY_AH)
    for key, item in plain.model.coefficients.items():
        assert result.model.coefficients[key].value == pytest.approx(item.value, rel=1e-6)
        assert result.model.coefficients[key].std_error == pytest.approx(item.std_error, rel=1e-6)
    assert result.model.noise.voltage_rmse_v == pytest.approx(plain.model.noise.voltage_rmse_v)
    assert result.soc_newton_mae_pct == pytest.approx(plain.soc_newton_mae_pct, abs=1e-6)


def test_one_log_is_cross_validated_by_blocks() -> None:
    log = synthetic_log(hours=1.2, start_pct=95.0, end_pct=30.0)
    signals = Signals(log.time_s, log.current_a, np.zeros(len(log)), log.temperature_c)
    volts = truth("dynamics").predict(signals, 95.0, np.arange(len(log))).voltage_v
    noise = np.random.default_rng(0).normal(0.0, NOISE_V, len(log))
    result = fit(
        [replace(log, voltage_v=volts + noise)], capacity_ah=CAPACITY_AH, effects=("auto",)
    )
    ids = [effect.id for effect, _ in result.effects.model.effects]
    assert ids == ["fast_polarization", "slow_diffusion"]
    value, std_error = parameters(result, "fast_polarization")["tau_s"]
    assert abs(value - 3.0) < 3.5 * std_error
    assert "blocks" in result.model.noise.judged_on


def test_named_effects_are_all_taken_and_reported() -> None:
    result = fitted("cold", ("resistance_asymmetry", "resistance_temperature"))
    ids = [effect.id for effect, _ in result.effects.model.effects]
    assert ids == ["resistance_temperature", "resistance_asymmetry"]
    assert [step.effect_id for step in result.effects.steps] == ids  # the more helpful one first
    value, std_error = parameters(result, "resistance_asymmetry")["charging_ohm"]
    assert abs(value) < 3.5 * std_error + 1e-9  # there is none
    assert not any("bound" in remark for remark in result.remarks)
    described = result.to_dict()
    assert [item["id"] for item in described["effects"]] == ids
    assert described["effects"][0]["parameters"]["share"]["unit"] == "1"
    assert described["effect_search"]["held_out_rmse_with_v"] == result.effects.held_out_rmse_v[1]


@pytest.mark.parametrize("name", ["cold", "hysteresis"])
def test_the_estimator_reproduces_the_newton_inverse_of_the_fit(name: str) -> None:
    result = fitted(name)
    entries = effect_entries(result.effects.model.effects)
    assert parse_effects(entries, result.effects.model.pack) == list(result.effects.model.effects)
    for number, log in enumerate(trips(name)[:2]):
        table, _ = estimate_log(log, result.model, EstimatorSettings(initial_soc_pct=None))
        rows = result.fits[number].rows
        at = np.searchsorted(log.time_s, rows.time_s)
        expected = result.fits[number].soc_newton_pct
        np.testing.assert_allclose(table.soc_newton_pct[at], expected, atol=1e-6)


def test_a_remark_names_a_parameter_at_its_bound() -> None:
    """A pack whose resistance falls in the cold would need a negative share."""
    inverted = []
    for log, plain in zip(trips("cold"), trips("nothing"), strict=True):
        inverted.append(replace(log, voltage_v=2.0 * plain.voltage_v - log.voltage_v))
    result = fit(inverted, capacity_ah=CAPACITY_AH, effects=("resistance_temperature",))
    assert parameters(result, "resistance_temperature")["share"][0] == pytest.approx(0.0, abs=1e-3)
    assert any("share lies at its bound of 0" in remark for remark in result.remarks)
    assert all(resistance < 0.0 for resistance in result.voltage_model.resistance_ohm)


def test_information_marginalises_the_effects() -> None:
    result = fitted("cold")
    information = result.model.information
    assert information is not None
    root, scale = np.array(information.root), np.array(information.scale)
    # Resistances only: k0 … k7 are nearly collinear.
    at = np.linalg.solve(root, np.array(information.projected)) / scale
    assert at[-4:] == pytest.approx(result.voltage_model.resistance_ohm, rel=0.02)
    spread = np.linalg.inv(root.T @ root) / scale / scale[:, None]
    plain = fit(trips("cold"), capacity_ah=CAPACITY_AH).model.information
    plain_root, plain_scale = np.array(plain.root), np.array(plain.scale)
    held = np.linalg.inv(plain_root.T @ plain_root) / plain_scale / plain_scale[:, None]
    # The effect may take over resistance, so its coefficient is less certain.
    assert spread[-4, -4] > 1.05 * held[-4, -4]


def sampled_trips(name: str) -> list[SampledLog]:
    return [sample_log(log, OPTIONS) for log in trips(name)]


def test_columns_are_the_derivative_of_the_residual() -> None:
    logs, model = sampled_trips("dynamics"), truth("dynamics")
    linear = linearize(model, logs)
    rng = np.random.default_rng(4)
    spans = np.array([item.step for item in linear.free])
    change = np.concatenate((1e-4 * np.abs(model.model.coefficients), 0.05 * spans))
    change *= rng.uniform(-1.0, 1.0, change.size)
    moved = stacked_residual(changed_model(linear, change), logs)
    expected = linear.residual_v - linear.columns @ change
    scale = np.abs(linear.columns @ change).max()
    assert np.abs(moved - expected).max() < 0.02 * scale


def test_kt_stays_physical_at_constant_temperature() -> None:
    noise = np.random.default_rng(8)
    still = [
        replace(log, temperature_c=20.0 + noise.normal(0.0, 0.002, len(log)))
        for log in trips("dynamics")
    ]
    result = fit(still, capacity_ah=CAPACITY_AH, effects=("fast_polarization",))
    kt = result.model.coefficients["kt"]
    assert abs(kt.value) < 3.0  # 8 mV/K per cell; 2 mK of noise alone would allow any
    assert kt.std_error is not None
    assert kt.std_error < 3.0


def test_held_out_errors_come_from_fits_without_the_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without effects the model is linear, so the one-step folds equal full fits."""
    monkeypatch.setattr("cangauge.inference.linearized.WIDE_KT_PRIOR_PER_K", math.inf)
    logs = sampled_trips("dynamics")
    validation = CrossValidation(logs)
    seen = np.zeros(validation.unit.size, dtype=int)
    for fold in validation.folds:
        assert not np.any(fold.training & fold.held_out)
        seen += fold.held_out
    assert seen.max() == 1
    assert seen.mean() > 0.5
    rows = [item.rows for item in logs]
    plain, _ = fit_voltage_model(rows, OPTIONS, with_kt_prior=False)
    models = held_out_models(rows, OPTIONS, with_kt_prior=False)
    expected = np.concatenate(list(map(held_out_error, rows, models)))
    found = validation.errors(ExtendedModel(plain, CAPACITY_AH)).error_v
    np.testing.assert_allclose(found, expected, atol=1e-6)


def held_out(unit_rmse_v: Sequence[float]) -> HeldOutErrors:
    return HeldOutErrors(np.repeat(unit_rmse_v, 50), np.repeat(np.arange(len(unit_rmse_v)), 50))


def test_significance_needs_most_logs_not_a_single_one() -> None:
    before = held_out([1.0] * 8)
    assert compare(before, held_out([0.8, 0.85, 0.9, 0.8, 0.9, 0.85, 0.8, 0.88])).is_significant
    assert not compare(before, held_out([0.2, *[1.0] * 7])).is_significant
    assert not compare(before, held_out([0.999] * 8)).is_significant  # significant, but too small
    assert not compare(before, held_out([1.2, 0.8] * 4)).is_significant
    assert not compare(held_out([1.0] * 3), held_out([0.9, 0.8, 0.97])).is_significant


def test_significance_needs_a_gain_within_the_logs() -> None:
    """Errors that last as long as a log may be explained by chance."""
    rng = np.random.default_rng(0)
    fast = rng.normal(0.0, 0.3, (8, 200))
    unit = np.repeat(np.arange(8), 200)

    def with_offsets(offset_v: float, scale: float) -> HeldOutErrors:
        return HeldOutErrors((scale * fast + offset_v).ravel(), unit, whole_logs=True)

    assert not compare(with_offsets(0.5, 1.0), with_offsets(0.1, 1.0)).is_significant
    smaller = rng.uniform(0.7, 0.95, (8, 1))
    after = HeldOutErrors((smaller * fast + 0.1).ravel(), unit, whole_logs=True)
    assert compare(with_offsets(0.5, 1.0), after).is_significant


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["gremlin"], "known are"),
        (["hysteresis,"], "unknown effect"),
        (["auto,hysteresis"], "auto alone"),
        (["auto", "auto"], "auto alone"),
        (["resistance_asymmetry", "resistance_asymmetry"], "once"),
        (["slow_diffusion"] * 3, "twice"),
        *(([effect_id], "not identifiable") for effect_id in NOT_IDENTIFIABLE),
    ],
)
def test_bad_ids_are_refused(given: list[str], words: str) -> None:
    with pytest.raises(InputError, match=words) as error:
        parse_effect_ids(given)
    assert error.value.field == "--effects"


def test_ids_may_be_repeated_and_separated_by_commas() -> None:
    given = ["slow_diffusion, fast_polarization", "slow_diffusion"]
    assert parse_effect_ids(given) == ("slow_diffusion", "fast_polarization", "slow_diffusion")
    assert parse_effect_ids(["auto"]) == ("auto",)
    assert parse_effect_ids([",".join(SEARCHED)]) == SEARCHED


def test_one_short_log_cannot_select_effects() -> None:
    short = synthetic_log(hours=0.25, start_pct=80.0, end_pct=70.0, noise_v=0.3)
    assert fit([short], capacity_ah=CAPACITY_AH).model.effects == []
    with pytest.raises(InputError, match="too little to hold rows out") as error:
        fit([short], capacity_ah=CAPACITY_AH, effects=("auto",))
    assert "--effects" in str(error.value)


@pytest.mark.parametrize("skew_s", [-1.5, 1.5])
def test_a_skew_of_either_sign_can_be_refined_both_ways(skew_s: float) -> None:
    model = ExtendedModel(TRUTH, CAPACITY_AH, ((LIBRARY["time_skew"], {"skew_s": skew_s}),))
    (free,) = free_parameters(model)
    low, high = free.step_bounds()
    assert low < 0.0 < high
