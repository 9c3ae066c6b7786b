"""Error model: what references show of healthy logs, and the weight of the model file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from days import late, more_amperes, more_resistance, more_volts, short_day

from cangauge.diagnosis import Verdict, diagnose
from cangauge.diagnosis.problem import DiagnosisProblem, build_problem
from cangauge.diagnosis.verdict import decide
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from synthetic import synthetic_log


def with_fast_polarization(log: Log, ohm: float) -> Log:
    follows = np.empty_like(log.current_a)
    follows[0] = log.current_a[0]
    decay = np.exp(-np.diff(log.time_s) / 3.0)
    for row, part in enumerate(decay, start=1):
        follows[row] = part * follows[row - 1] + (1.0 - part) * log.current_a[row]
    return replace(log, voltage_v=log.voltage_v - ohm * follows)


@pytest.fixture(scope="module")
def learn(model: Model) -> Callable[[Sequence[Log]], DiagnosisProblem]:
    def learned(references: Sequence[Log]) -> DiagnosisProblem:
        return build_problem([short_day(21)], model, references)

    return learned


@pytest.fixture(scope="module")
def references(short_references: list[Log]) -> list[Log]:
    return short_references


@pytest.fixture(scope="module")
def alike(
    learn: Callable[[Sequence[Log]], DiagnosisProblem], references: list[Log]
) -> DiagnosisProblem:
    """From references that differ by their noise alone."""
    return learn(references)


def effect_std(problem: DiagnosisProblem, effect_id: str) -> float:
    """Standard deviation of a per-log effect over its prior; that of its largest shape."""
    hypotheses = problem.hypotheses
    candidates = [hypotheses.candidates[k] for k in hypotheses.per_log]
    names = [each.effect.id for each in candidates for _ in each.amplitudes]
    parts = np.array(problem.error.per_log_std) / hypotheses.per_log_prior_std
    parts = parts[: len(names)]
    return max(part for name, part in zip(names, parts.tolist(), strict=True) if name == effect_id)


def resistance_std(problem: DiagnosisProblem) -> float:
    """The same of the resistance level."""
    return problem.error.per_log_std[-1] / float(problem.hypotheses.per_log_prior_std[-1])


def varied(
    change: Callable[[Log, float], Log], references: Sequence[Log], size: float
) -> list[Log]:
    return [
        change(log, part * size) for log, part in zip(references, (-1.0, 0.0, 1.0), strict=True)
    ]


@pytest.mark.parametrize(
    ("change", "size", "effect_id"),
    [
        (more_volts, 1.5, "voltage_offset"),
        (more_amperes, 3.0, "current_offset"),
    ],
    ids=["volts", "amperes"],
)
def test_an_effect_that_references_vary_in_counts_less(
    change: Callable[[Log, float], Log],
    size: float,
    effect_id: str,
    model: Model,
    references: list[Log],
) -> None:
    """A fault of the references' own size has little evidence left; others lose less."""
    different = varied(change, references, size)

    def verdicts_on(logs: Sequence[Log]) -> list[Verdict]:
        """With references that are alike, and with those that differ."""
        return [decide(build_problem(logs, model, known)) for known in (references, different)]

    def kept(of: str, verdicts: Sequence[Verdict]) -> float:
        """Part of an effect's evidence that is left."""
        before, after = (
            next(score.log_bayes_factor for score in found.candidates if score.effect_id == of)
            for found in verdicts
        )
        return after / before

    of_the_same = kept(effect_id, verdicts_on([change(short_day(seed), size) for seed in (21, 22)]))
    assert of_the_same < 0.1
    of_late = verdicts_on([late(short_day(seed)) for seed in (21, 22)])
    assert kept("time_skew", of_late) > 2.0 * max(of_the_same, 0.0)
    assert of_late[1].cause == "time_skew"


def test_references_that_vary_in_resistance_widen_its_prior(
    learn: Callable[[Sequence[Log]], DiagnosisProblem],
    references: list[Log],
    alike: DiagnosisProblem,
) -> None:
    ohms = learn(varied(more_resistance, references, 0.03))
    assert resistance_std(ohms) > 3.0 * resistance_std(alike)
    assert effect_std(ohms, "time_skew") < resistance_std(ohms)


def test_the_error_is_that_of_the_references(
    learn: Callable[[Sequence[Log]], DiagnosisProblem], alike: DiagnosisProblem, model: Model
) -> None:
    """White noise of 0.5 V on every scale; then twice as much."""
    assert alike.error.rmse_v == pytest.approx(0.5, rel=0.05)
    np.testing.assert_allclose(np.sqrt(alike.error.scale_v2[:5]), 0.5, rtol=0.1)
    noisy = learn([short_day(seed, 1.0) for seed in (11, 12, 13)])
    assert model.noise.voltage_rmse_v == pytest.approx(0.5, rel=0.05)
    assert noisy.error.rmse_v == pytest.approx(1.0, rel=0.12)


def test_one_odd_reference_makes_its_effect_overdispersed(
    learn: Callable[[Sequence[Log]], DiagnosisProblem],
    references: list[Log],
    alike: DiagnosisProblem,
) -> None:
    """One of three references reads 4 A too much: the others would have named an offset."""
    assert all(value >= 1.0 for value in alike.error.overdispersion.values())
    odd = learn([*references[:2], more_amperes(references[2], 4.0)])
    before, after = alike.error.overdispersion, odd.error.overdispersion
    assert after["current_offset"] > 1.5 * before["current_offset"]
    assert after["current_offset"] > after["time_skew"]
    # A model that is wrong in one way counts less in all.
    assert min(after.values()) > min(before.values())


def test_an_offset_that_references_vary_by_is_no_cause(model: Model, references: list[Log]) -> None:
    logs = [more_amperes(short_day(seed), 4.0) for seed in (21, 22)]
    assert decide(build_problem(logs, model, references)).cause == "current_offset"
    different = varied(more_amperes, references, 6.0)
    assert decide(build_problem(logs, model, different)).cause == "none"


def test_agreeing_references_keep_the_information_weight(alike: DiagnosisProblem) -> None:
    """Not exactly 1: noise alone moves thirteen coefficients."""
    assert alike.error.information_weight > 0.3


@pytest.mark.parametrize(
    "change",
    [
        lambda log: more_resistance(log, 0.05),
        lambda log: replace(log, voltage_v=log.voltage_v + 0.5 * (log.temperature_c - 20.0)),
    ],
    ids=["resistance", "entropy"],
)
def test_contradicting_references_overrule_the_model_file(
    change: Callable[[Log], Log],
    learn: Callable[[Sequence[Log]], DiagnosisProblem],
    references: list[Log],
    alike: DiagnosisProblem,
    model: Model,
) -> None:
    """What all references share is the pack, not a per-log effect."""
    found = learn([change(log) for log in references])
    assert found.error.information_weight <= alike.error.information_weight
    # Far less, unless structure can explain it, as it can a resistance.
    assert found.error.information_weight < 0.01 or max(found.error.structure.values()) >= 0.1
    # The next scale at most.
    assert resistance_std(found) < 2.0 * resistance_std(alike)
    logs = [change(short_day(seed)) for seed in (21, 22)]
    diagnosis = diagnose(logs, model, [change(log) for log in references])
    assert diagnosis.verdict.cause == "none"
    # The given model is wrong by more than 1 V; the extended one leaves only noise.
    assert diagnosis.baseline_rmse_v > 1.0
    assert diagnosis.extended_rmse_v == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("noise_v", [0.52, 0.6, 0.75])
def test_a_noisier_sensor_is_no_gap(noise_v: float, model: Model, references: list[Log]) -> None:
    for seed in (41, 42):
        verdict = decide(build_problem([short_day(seed, noise_v)], model, references))
        assert not verdict.detected
        assert verdict.accepted == ()
        # Twice the healthy variance has no cause in the library.
        assert verdict.cause == "none" or (noise_v == 0.75 and verdict.cause == "unknown")


def test_one_reference_leaves_the_model_files_noise(
    learn: Callable[[Sequence[Log]], DiagnosisProblem], references: list[Log], model: Model
) -> None:
    one = learn(references[:1])
    none = learn([])
    assert one.error == none.error
    assert none.error.rmse_v**2 == pytest.approx(
        model.noise.fast_std_v**2 + model.noise.slow_std_v**2
    )


def test_only_structure_in_the_references_gets_a_wide_prior(
    learn: Callable[[Sequence[Log]], DiagnosisProblem],
    references: list[Log],
    alike: DiagnosisProblem,
) -> None:
    """A wide prior for all would leave the others unconstrained."""
    assert max(alike.error.structure.values()) < 0.01
    lagging = [with_fast_polarization(log, 0.03) for log in references]
    found = learn(lagging).error.structure
    assert found["fast_polarization"] >= 0.03
    assert max(found[name] for name in ("hysteresis", "ocv_shape", "resistance_asymmetry")) < 0.01


def test_what_references_share_is_no_per_log_effect(model: Model) -> None:
    """All references have a late current; a log without it deviates."""

    def drive(seed: int, late_s: float) -> Log:
        log = synthetic_log(
            hours=0.5, rate_hz=5.0, start_pct=85.0, end_pct=68.0, noise_v=0.3, seed=seed
        )
        return late(log, late_s)

    references = [drive(seed, 0.3) for seed in (11, 12, 13)]
    logs = [drive(seed, 0.05) for seed in (21, 22)]
    best = decide(build_problem(logs, model, references)).candidates[0]
    assert best.effect_id == "time_skew"
    assert best.log_bayes_factor > 100.0
