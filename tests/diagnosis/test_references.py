"""What references teach: how far clean logs stray, and how far the model file is to be believed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from cangauge.diagnosis.diagnose import diagnose
from cangauge.diagnosis.extended_model import library_without
from cangauge.diagnosis.posterior import Verdict, decide
from cangauge.diagnosis.problem import DiagnosisProblem, build_problem
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from synthetic import synthetic_log


def day(seed: int, noise_v: float = 0.5) -> Log:
    return synthetic_log(
        hours=0.6, start_pct=85.0, end_pct=65.0, noise_v=noise_v, seed=seed, name=f"day {seed}"
    )


def more_resistance(log: Log, ohm: float) -> Log:
    return replace(log, voltage_v=log.voltage_v - ohm * log.current_a)


def more_volts(log: Log, volts: float) -> Log:
    return replace(log, voltage_v=log.voltage_v + volts)


def more_amperes(log: Log, amperes: float) -> Log:
    return replace(log, current_a=log.current_a + amperes)


def with_fast_polarization(log: Log, ohm: float) -> Log:
    follows = np.empty_like(log.current_a)
    follows[0] = log.current_a[0]
    decay = np.exp(-np.diff(log.time_s) / 3.0)
    for row, part in enumerate(decay, start=1):
        follows[row] = part * follows[row - 1] + (1.0 - part) * log.current_a[row]
    return replace(log, voltage_v=log.voltage_v - ohm * follows)


def with_late_current(log: Log, late_s: float) -> Log:
    return replace(log, current_a=np.interp(log.time_s - late_s, log.time_s, log.current_a))


@pytest.fixture(scope="module")
def learn(model: Model) -> Callable[[Sequence[Log]], DiagnosisProblem]:
    def learned(references: Sequence[Log]) -> DiagnosisProblem:
        return build_problem([day(21)], model, references, library_without([]))

    return learned


@pytest.fixture(scope="module")
def references() -> list[Log]:
    return [day(seed) for seed in (11, 12, 13)]


@pytest.fixture(scope="module")
def alike(
    learn: Callable[[Sequence[Log]], DiagnosisProblem], references: list[Log]
) -> DiagnosisProblem:
    """What is learned from references that differ by their noise alone."""
    return learn(references)


def own_std(settled: DiagnosisProblem, effect_id: str) -> float:
    """By how much logs are taken to differ in an effect, over what is usual; its largest shape."""
    frame, error = settled.frame, settled.error
    names = [frame.choices[k].effect.id for k in frame.own for _ in frame.choices[k].amplitudes]
    parts = np.array(error.own_std)[: len(names)] / frame.own_prior[: len(names)]
    return max(part for name, part in zip(names, parts.tolist(), strict=True) if name == effect_id)


def level_std(settled: DiagnosisProblem) -> float:
    """The same of the level of the resistance."""
    return settled.error.own_std[-1] / float(settled.frame.own_prior[-1])


def apart(change: Callable[[Log, float], Log], references: Sequence[Log], size: float) -> list[Log]:
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
def test_where_references_differ_logs_are_taken_to_differ(
    change: Callable[[Log, float], Log],
    size: float,
    effect_id: str,
    model: Model,
    references: list[Log],
) -> None:
    """The same fault is worth little beside references that stray by as much; others lose less."""
    varied = apart(change, references, size)

    def beside_both(logs: Sequence[Log]) -> list[Verdict]:
        """Beside references that are alike, and beside those that differ."""
        return [
            decide(build_problem(logs, model, known, library_without([])))
            for known in (references, varied)
        ]

    def kept(of: str, verdicts: Sequence[Verdict]) -> float:
        """What is left of an effect's evidence."""
        alike, varied = (
            next(score.log_bayes_factor for score in found.candidates if score.effect_id == of)
            for found in verdicts
        )
        return varied / alike

    of_the_same = kept(effect_id, beside_both([change(day(seed), size) for seed in (21, 22)]))
    assert of_the_same < 0.1
    late = [
        replace(log, current_a=np.interp(log.time_s - 1.0, log.time_s, log.current_a))
        for log in (day(21), day(22))
    ]
    of_late = beside_both(late)
    assert kept("time_skew", of_late) > 2.0 * max(of_the_same, 0.0)
    assert of_late[1].cause == "time_skew"


def test_where_references_differ_in_resistance_logs_are_taken_to_differ(
    learn: Callable[[Sequence[Log]], DiagnosisProblem],
    references: list[Log],
    alike: DiagnosisProblem,
) -> None:
    ohms = learn(apart(more_resistance, references, 0.03))
    assert level_std(ohms) > 3.0 * level_std(alike)
    assert own_std(ohms, "time_skew") < level_std(ohms)


def test_the_error_is_that_of_the_references_not_that_of_the_model_file(
    learn: Callable[[Sequence[Log]], DiagnosisProblem], alike: DiagnosisProblem, model: Model
) -> None:
    """0.5 V of white noise on every scale; then twice as much."""
    assert alike.error.rmse_v == pytest.approx(0.5, rel=0.05)
    np.testing.assert_allclose(np.sqrt(alike.error.scale_v2[:5]), 0.5, rtol=0.1)
    noisy = learn([day(seed, 1.0) for seed in (11, 12, 13)])
    assert model.noise.voltage_rmse_v == pytest.approx(0.5, rel=0.05)
    assert noisy.error.rmse_v == pytest.approx(1.0, rel=0.12)


def test_an_effect_that_strays_on_references_is_believed_less(
    learn: Callable[[Sequence[Log]], DiagnosisProblem],
    references: list[Log],
    alike: DiagnosisProblem,
) -> None:
    """One reference with 4 A too much, of three: the others would have called it an offset."""
    assert all(worth >= 1.0 for worth in alike.error.strays.values())
    strange = learn([*references[:2], more_amperes(references[2], 4.0)])
    before, after = alike.error.strays, strange.error.strays
    assert after["current_offset"] > 1.5 * before["current_offset"]
    assert after["current_offset"] > after["time_skew"]
    # A model that strays in one way is believed less in all: none is worth more than the mean.
    assert min(after.values()) > min(before.values())


def test_an_effect_that_references_stray_in_is_no_cause(
    model: Model, references: list[Log]
) -> None:
    """4 A too much are a fault beside references without; not beside references that vary so."""
    logs = [more_amperes(day(seed), 4.0) for seed in (21, 22)]
    assert diagnose(logs, model, references).verdict.cause == "current_offset"
    varied = diagnose(logs, model, apart(more_amperes, references, 6.0))
    assert varied.verdict.cause == "none"


def test_references_that_bear_the_model_file_out_keep_its_word(alike: DiagnosisProblem) -> None:
    """Not exactly 1: chance alone puts thirteen coefficients a little further away, or nearer."""
    assert alike.error.trust > 0.3


@pytest.mark.parametrize(
    "change",
    [
        lambda log: more_resistance(log, 0.05),
        lambda log: replace(log, voltage_v=log.voltage_v + 0.5 * (log.temperature_c - 20.0)),
    ],
    ids=["resistance", "entropy"],
)
def test_references_that_all_contradict_the_model_file_overrule_it(
    change: Callable[[Log], Log],
    learn: Callable[[Sequence[Log]], DiagnosisProblem],
    references: list[Log],
    alike: DiagnosisProblem,
    model: Model,
) -> None:
    """What all of them share is the pack, not a difference from log to log."""
    found = learn([change(log) for log in references])
    assert found.error.trust <= alike.error.trust
    # Far less, unless it is of a kind that structure takes up: a resistance is, and then it may be
    # no less.
    assert found.error.trust < 0.01 or max(found.error.structure.values()) >= 0.1
    # The next level at most.
    assert level_std(found) < 2.0 * level_std(alike)
    logs = [change(day(seed)) for seed in (21, 22)]
    diagnosis = diagnose(logs, model, [change(log) for log in references])
    assert diagnosis.verdict.cause == "none"
    # The given model is 1 V and more out; the extended one has only the noise left.
    assert diagnosis.baseline_rmse_v > 1.0
    assert diagnosis.extended_rmse_v == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("noise_v", [0.52, 0.6, 0.75])
def test_a_noisier_sensor_is_no_gap(noise_v: float, model: Model, references: list[Log]) -> None:
    for seed in (41, 42):
        found = diagnose([day(seed, noise_v)], model, references)
        assert found.verdict.cause == "none"
        assert found.verdict.accepted == ()


def test_a_single_reference_leaves_the_model_files_noise(
    learn: Callable[[Sequence[Log]], DiagnosisProblem], references: list[Log], model: Model
) -> None:
    one = learn(references[:1])
    none = learn([])
    assert one.error == none.error
    assert none.error.rmse_v**2 == pytest.approx(
        model.noise.fast_std_v**2 + model.noise.slow_std_v**2
    )


def test_only_the_structure_that_references_show_may_take_much(
    learn: Callable[[Sequence[Log]], DiagnosisProblem],
    references: list[Log],
    alike: DiagnosisProblem,
) -> None:
    """What one piece needs would leave the others free to go astray."""
    assert max(alike.error.structure.values()) < 0.01
    lagging = [with_fast_polarization(log, 0.03) for log in references]
    found = learn(lagging).error.structure
    assert found["fast_polarization"] >= 0.03
    assert max(found[name] for name in ("hysteresis", "ocv_shape", "resistance_asymmetry")) < 0.01


def test_what_all_references_share_is_not_what_logs_differ_by(model: Model) -> None:
    # All of a pack's currents are late. If references took that as each its own, a log that is
    # not could be as much its own.
    def drive(seed: int, late_s: float) -> Log:
        log = synthetic_log(
            hours=0.5, rate_hz=5.0, start_pct=85.0, end_pct=68.0, noise_v=0.3, seed=seed
        )
        return with_late_current(log, late_s)

    references = [drive(seed, 0.3) for seed in (11, 12, 13)]
    logs = [drive(seed, 0.05) for seed in (21, 22)]
    best = decide(build_problem(logs, model, references, library_without([]))).candidates[0]
    assert best.effect_id == "time_skew"
    assert best.log_bayes_factor > 100.0
