"""Capacity, resistance and offset, learned over charges and drives of a simulated pack."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.delay_line import delayed_currents
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH, leaf_2012_model, leaf_2012_model_file
from cangauge.settings import PackLimits
from cangauge.types import Health, Sample
from synthetic import drive_current

PACK = leaf_2012_model()
HIGH_PCT, LOW_PCT = 96.0, 10.0
CHARGE_A = 40.0
STEP_S = 5
"""Step of the samples [s]: health needs hours, and not every second of them."""


def model_with_noise(std_v: float) -> Model:
    """Return the published model with an error of one size in each of its parts [V]."""
    model = leaf_2012_model_file()
    parts = {"level_std_v": std_v, "slow_std_v": std_v, "fast_std_v": 0.3 * std_v}
    return model.model_copy(update={"noise": model.noise.model_copy(update=parts)})


MODEL = model_with_noise(0.3)


def current_of(charges: int, seed: int) -> np.ndarray:
    """Drives of an hour from 96 to 10 %, each with a charge and rests [A]."""
    swing_ah = (HIGH_PCT - LOW_PCT) / 100.0 * CAPACITY_AH
    parts = []
    for number in range(charges):
        drive_a = drive_current(np.arange(3600.0), swing_ah, 100 * seed + number)
        drive_a += swing_ah - drive_a.mean()
        parts += [drive_a, np.zeros(120), np.full(int(swing_ah / CHARGE_A * 3600.0), -CHARGE_A)]
        parts.append(np.zeros(120))
    return np.concatenate(parts)


def wander(size: int, per_step: float, rng: np.random.Generator) -> np.ndarray:
    """A first-order Gauss–Markov process of unit variance."""
    kept, values = math.exp(-per_step), np.empty(size)
    noise = rng.normal(size=size) * math.sqrt(1.0 - kept**2)
    values[0] = rng.normal()
    for at in range(1, size):
        values[at] = kept * values[at - 1] + noise[at]
    return values


@cache
def samples_of_pack(
    seed: int, *, offset_a: float = 0.0, resistance: float = 1.0, charges: int = 3
) -> list[Sample]:
    """A pack of the model's capacity with errors of the model's own size, and more."""
    rng = np.random.default_rng(seed)
    current_a = current_of(charges, seed)[::STEP_S]
    time_s = STEP_S * np.arange(current_a.size, dtype=float)
    steps_ah = 0.5 * (current_a[1:] + current_a[:-1]) * STEP_S / 3600.0
    soc_pct = HIGH_PCT - 100.0 / CAPACITY_AH * np.concatenate(([0.0], np.cumsum(steps_ah)))
    drop_v = (
        delayed_currents(time_s, current_a, PACK.loads.delays_s, time_s) @ PACK.loads.resistance_ohm
    )
    error_v = 0.3 * wander(time_s.size, STEP_S / 300.0, rng) + 0.2 * rng.normal(size=time_s.size)
    voltage_v = PACK.pseudo_ocv(soc_pct, 23.0) + resistance * drop_v + error_v
    rows = zip(time_s.tolist(), (current_a + offset_a).tolist(), voltage_v.tolist(), strict=True)
    return [Sample(*row, 23.0) for row in rows]


def settings(wrong: float, **more: object) -> EstimatorSettings:
    return EstimatorSettings(capacity_ah=wrong * CAPACITY_AH, gap_s=3.0 * STEP_S, **more)  # type: ignore[arg-type] # of tests


@cache
def learned(seed: int, wrong: float, *, offset_a: float = 0.0, resistance: float = 1.0) -> Health:
    """Return the health at the end, of an estimator whose capacity is wrong by a factor."""
    estimator = make_estimator(MODEL, settings(wrong))
    for sample in samples_of_pack(seed, offset_a=offset_a, resistance=resistance):
        estimator.update(sample)
    return estimator.health


def apart(health: Health) -> tuple[float, float]:
    """Return the capacity's relative error [%], and in its standard deviations."""
    error_ah = health.capacity_ah - CAPACITY_AH
    return 100.0 * error_ah / CAPACITY_AH, error_ah / health.capacity_std_ah


@pytest.mark.parametrize("wrong", [1.0, 1.05, 1.1])
def test_three_charges_correct_a_wrong_capacity(wrong: float) -> None:
    first = make_estimator(MODEL, settings(wrong)).health
    assert first.capacity_ah == pytest.approx(wrong * CAPACITY_AH)
    assert first.capacity_std_ah == pytest.approx(0.1 * wrong * CAPACITY_AH)
    last = learned(1, wrong)
    assert abs(apart(last)[0]) < 2.0
    assert abs(apart(last)[1]) < 2.5
    assert last.capacity_std_ah < 0.02 * CAPACITY_AH


def test_an_offset_of_2_a_is_not_taken_for_capacity() -> None:
    last = learned(2, 1.05, offset_a=2.0)
    assert abs(apart(last)[0]) < 2.0
    assert last.offset_a == pytest.approx(2.0, abs=0.4)
    assert abs(last.offset_a - 2.0) < 3.0 * last.offset_std_a


@pytest.mark.parametrize("resistance", [0.8, 1.0, 1.3])
def test_resistance_is_found_within_its_deviation(resistance: float) -> None:
    last = learned(3, 1.0, resistance=resistance)
    assert last.resistance_ratio == pytest.approx(resistance, abs=0.05)
    assert abs(last.resistance_ratio - resistance) < 3.0 * last.resistance_std


def test_possible_current_follows_the_learned_resistance() -> None:
    limits = PackLimits(335.0, 420.0, 2000.0, 2000.0)
    found_a = []
    for resistance in (1.0, 1.3):
        estimator = make_estimator(MODEL, settings(1.0, limits=limits))
        for sample in samples_of_pack(3, resistance=resistance):
            estimator.update(sample)
        found_a.append(estimator.power().discharge_a)
    assert found_a[1] == pytest.approx(found_a[0] / 1.3, rel=0.1)


def test_nothing_is_learned_without_charge_or_voltage() -> None:
    resting = make_estimator(MODEL)
    for second in range(1200):
        resting.update(Sample(float(second), 0.0, 380.0, 23.0))
    assert resting.health.capacity_ah == pytest.approx(CAPACITY_AH, rel=1e-3)
    assert resting.health.capacity_std_ah == pytest.approx(0.1 * CAPACITY_AH, rel=1e-3)
    silent = make_estimator(MODEL, EstimatorSettings(initial_soc_pct=80.0))
    for second in range(1200):
        silent.update(Sample(float(second), 60.0, math.nan, 23.0))
    # The prior grows by its random walk alone.
    assert silent.health == pytest.approx(make_estimator(MODEL).health, rel=1e-4)


@pytest.mark.parametrize("wrong", [1.05, 1.1])
def test_deviation_of_the_soc_covers_a_wrong_capacity(wrong: float) -> None:
    """Three charges counted with another capacity: σ says how far that may be off."""
    estimator = make_estimator(MODEL, settings(wrong))
    moved_pct, errors, covered = 0.0, [], []
    samples = samples_of_pack(1)
    for before, sample in zip([samples[0], *samples], samples, strict=False):
        found = estimator.step(sample)
        seconds = sample.time_s - before.time_s
        moved_pct += (before.current_a + sample.current_a) * seconds / 72.0 / CAPACITY_AH
        if sample.time_s > 7200.0:
            errors.append(abs(found.soc_pct - (HIGH_PCT - moved_pct)))
            covered.append(errors[-1] <= 3.0 * found.soc_std_pct)
    assert max(errors) > 3.0
    assert np.mean(covered) > 0.9


def test_learned_capacity_survives_another_model_and_setting() -> None:
    before = make_estimator(MODEL, settings(1.1))
    for sample in samples_of_pack(1):
        before.update(sample)
    after = make_estimator(model_with_noise(0.5), settings(1.0))
    after.take_over(before)
    assert after.health.capacity_ah == pytest.approx(before.health.capacity_ah, rel=1e-9)
    assert after.health.capacity_std_ah == pytest.approx(before.health.capacity_std_ah, rel=0.02)
    assert after.health.offset_a == pytest.approx(before.health.offset_a, abs=0.01)
    assert after.health.resistance_ratio == 1.0
