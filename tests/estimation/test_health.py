"""Capacity and resistance, learned over charges and drives of a simulated pack."""

from __future__ import annotations

import json
import math
from functools import cache

import numpy as np
import pytest

from cangauge.estimation.estimator import Estimator, EstimatorSettings
from cangauge.estimation.health import Health, ResistanceEstimator
from cangauge.estimation.settings import FullCharge
from cangauge.estimation.state import EstimatorState
from cangauge.model.delay_line import delayed_currents
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH, leaf_2012_model, leaf_2012_model_file
from cangauge.types import Sample
from synthetic import drive_current

PACK = leaf_2012_model()
HIGH_PCT, LOW_PCT = 96.0, 10.0
CHARGE_A = 40.0


def model_with_noise(std_v: float) -> Model:
    """Return the published model with an error of one size in each of its parts [V]."""
    model = leaf_2012_model_file()
    parts = dict.fromkeys(("fast_std_v", "slow_std_v", "lasting_std_v"), std_v)
    return model.model_copy(update={"noise": model.noise.model_copy(update=parts)})


MODEL = model_with_noise(0.3)


def current_of(charges: int, seed: int) -> np.ndarray:
    """Drives of an hour from 96 to 10 %, each with a charge and rests [A]."""
    swing_ah = (HIGH_PCT - LOW_PCT) / 100.0 * CAPACITY_AH
    parts = []
    for number in range(charges):
        time_s = np.arange(3600.0)
        drive_a = drive_current(time_s, swing_ah, 100 * seed + number)
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


def samples_of_pack(
    seed: int, *, offset_a: float = 0.0, curve_v: float = 0.0, resistance: float = 1.0,
    charges: int = 3,
) -> list[Sample]:  # fmt: skip
    """A pack of the model's capacity with errors of the model's own size, and more."""
    rng = np.random.default_rng(seed)
    current_a = current_of(charges, seed)
    time_s = np.arange(current_a.size, dtype=float)
    steps_ah = 0.5 * (current_a[1:] + current_a[:-1]) / 3600.0
    soc_pct = HIGH_PCT - 100.0 / CAPACITY_AH * np.concatenate(([0.0], np.cumsum(steps_ah)))
    drop_v = delayed_currents(time_s, current_a, PACK.delay_s, time_s) @ PACK.resistance_ohm
    curve = curve_v * np.interp(soc_pct, np.arange(101.0), wander(101, 1.0 / 8.0, rng))
    error_v = 0.3 * wander(time_s.size, 1.0 / 300.0, rng) + 0.3 * rng.normal(size=time_s.size)
    voltage_v = PACK.pseudo_ocv(soc_pct, 23.0) + resistance * drop_v + curve + error_v
    rows = zip(time_s.tolist(), (current_a + offset_a).tolist(), voltage_v.tolist(), strict=True)
    return [Sample(*row, 23.0) for row in rows]


@cache
def learned(seed: int, wrong: float, *, offset_a: float = 0.0, curve_v: float = 0.0,
            resistance: float = 1.0, charges: int = 3) -> list[Health]:  # fmt: skip
    """Return the health every minute, of an estimator whose capacity is wrong by a factor.

    Health does not depend on the method; counting is the fastest.
    """
    settings = EstimatorSettings(method="coulomb", capacity_ah=wrong * CAPACITY_AH)
    estimator = Estimator(MODEL, settings)
    found = []
    samples = samples_of_pack(
        seed, offset_a=offset_a, curve_v=curve_v, resistance=resistance, charges=charges
    )
    for number, sample in enumerate(samples):
        estimator.update(sample)
        if number % 60 == 59:
            found.append(estimator.health)
    return found


def apart(health: Health) -> tuple[float, float]:
    """Return the capacity's relative error [%], and in its standard deviations."""
    error_ah = health.capacity_ah - CAPACITY_AH
    return 100.0 * error_ah / CAPACITY_AH, error_ah / health.capacity_std_ah


@pytest.mark.parametrize("wrong", [0.9, 1.1])
def test_three_charges_correct_a_wrong_capacity(wrong: float) -> None:
    first, last = learned(1, wrong)[0], learned(1, wrong)[-1]
    assert abs(apart(first)[0]) == pytest.approx(10.0, abs=0.1)
    assert abs(apart(last)[0]) < 2.0
    assert abs(apart(last)[1]) < 2.0
    assert last.capacity_std_ah < 0.035 * CAPACITY_AH


def test_an_offset_of_2_a_is_not_taken_for_capacity() -> None:
    last = learned(2, 1.1, offset_a=2.0)[-1]
    assert abs(apart(last)[0]) < 2.0
    assert last.offset_a == pytest.approx(2.0, abs=0.3)


def test_a_curve_error_is_covered_by_the_deviation() -> None:
    found = [learned(seed, 0.9, curve_v=0.3)[-1] for seed in (3, 4)]
    assert all(abs(apart(each)[1]) < 2.0 for each in found)
    # Three charges over the same curve: the deviation does not fall as if they were independent.
    assert all(each.capacity_std_ah > 0.01 * CAPACITY_AH for each in found)


def test_capacity_moves_without_jumps() -> None:
    capacities = np.array([each.capacity_ah for each in learned(1, 1.1)])
    assert np.abs(np.diff(capacities)).max() < 0.02 * CAPACITY_AH
    deviations = np.array([each.capacity_std_ah for each in learned(1, 1.1)])
    assert np.diff(deviations).max() < 0.001 * CAPACITY_AH


@pytest.mark.parametrize("resistance", [0.8, 1.3])
def test_resistance_is_found_within_its_deviation(resistance: float) -> None:
    found = learned(5, 1.0, resistance=resistance, charges=1)
    early, last = found[10], found[-1]
    assert early.resistance_ratio == pytest.approx(resistance, abs=0.05)
    for each in (early, last):
        assert abs(each.resistance_ratio - resistance) < 2.0 * each.resistance_std + 0.01


def test_resistance_ignores_errors_that_drift() -> None:
    rng = np.random.default_rng(1)
    drop_v = -0.1 * drive_current(np.arange(1800.0), 15.0, 3)
    drift_v = np.cumsum(rng.normal(size=1800)) * 0.02 + 0.3 * np.cumsum(drop_v) / 1800.0
    found = ResistanceEstimator()
    for residual, drop in zip((drift_v + 0.2 * drop_v).tolist(), drop_v.tolist(), strict=True):
        found.add(residual, drop, 1.0)
    ratio, std = found.ratio()
    assert ratio == pytest.approx(1.2, abs=0.03)
    assert abs(ratio - 1.2) < 2.0 * std


def test_nothing_is_learned_without_charge_or_voltage() -> None:
    estimator = Estimator(MODEL, EstimatorSettings(method="coulomb"))
    for second in range(1200):
        estimator.update(Sample(float(second), 0.0, 380.0, 23.0))
    assert estimator.health.capacity_std_ah == pytest.approx(0.1 * CAPACITY_AH, rel=0.01)
    blind = Estimator(MODEL, EstimatorSettings(initial_soc_pct=80.0))
    for second in range(1200):
        blind.update(Sample(float(second), 30.0, math.nan, 23.0))
    assert blind.health.capacity_ah == pytest.approx(CAPACITY_AH)
    assert blind.health.resistance_ratio == 1.0


def test_an_unobserved_charge_is_no_evidence() -> None:
    samples = samples_of_pack(6, charges=1)
    estimator = Estimator(MODEL, EstimatorSettings(method="coulomb"))
    # The charge is cut out: the SoC rises by 70 % with nothing counted.
    drive, rest = samples[:3600], samples[-110:]
    for sample in drive:
        estimator.update(sample)
    before = estimator.health
    for sample in rest:
        estimator.update(sample)
    after = estimator.health
    assert after.capacity_ah == pytest.approx(before.capacity_ah, rel=0.01)
    assert after.capacity_std_ah == pytest.approx(before.capacity_std_ah, rel=0.05)


def test_a_full_charge_counts_as_a_known_soc() -> None:
    samples = samples_of_pack(7, charges=1)
    known, unknown = (
        Estimator(MODEL, EstimatorSettings(method="coulomb", full_charge=rule))
        for rule in (FullCharge(voltage_v=380.0, current_a=1.0, hold_s=60.0, soc_pct=96.0), None)
    )
    for sample in samples:
        known.update(sample)
        unknown.update(sample)
    assert known.health.capacity_std_ah < unknown.health.capacity_std_ah
    assert abs(apart(known.health)[1]) < 2.0


def test_health_continues_over_a_restart_bit_for_bit() -> None:
    samples = samples_of_pack(8, charges=1)
    whole = Estimator(MODEL, EstimatorSettings(method="coulomb"))
    for sample in samples[:3500]:
        whole.update(sample)
    text = json.dumps(whole.snapshot().model_dump(mode="json"), allow_nan=False)
    after = Estimator(MODEL, EstimatorSettings(method="coulomb"))
    after.restore(EstimatorState.model_validate(json.loads(text)))
    for sample in samples[3500:3800]:
        whole.update(sample)
        after.update(sample)
        assert after.health == whole.health
        assert after.power() == whole.power()


def test_learned_capacity_survives_another_model_and_setting() -> None:
    before = Estimator(MODEL, EstimatorSettings(method="coulomb", capacity_ah=1.1 * CAPACITY_AH))
    for sample in samples_of_pack(1, charges=1):
        before.update(sample)
    learned_ah = before.health.capacity_ah
    for settings in (EstimatorSettings(), EstimatorSettings(capacity_ah=0.9 * CAPACITY_AH)):
        other = Estimator(model_with_noise(0.4), settings)
        other.take_over(before)
        assert other.health.capacity_ah == pytest.approx(learned_ah)
        assert other.health.capacity_std_ah == pytest.approx(before.health.capacity_std_ah)
        restored = Estimator(MODEL, settings)
        restored.restore(before.snapshot())
        assert restored.health.capacity_ah == pytest.approx(learned_ah)


def test_voltages_of_another_pack_are_survived() -> None:
    rng = np.random.default_rng(0)
    estimator = Estimator(MODEL, EstimatorSettings(method="coulomb"))
    for sample in samples_of_pack(9, charges=1)[:4000]:
        wrong_v = float(rng.choice([300.0, 330.0, 360.0, 400.0])) + rng.normal()
        estimator.update(sample._replace(voltage_v=wrong_v))
        health = estimator.health
        assert 0.2 * CAPACITY_AH < health.capacity_ah < 5.0 * CAPACITY_AH
        assert health.capacity_std_ah > 0.0
        assert all(math.isfinite(each) for each in health)
