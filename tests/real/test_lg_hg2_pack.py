"""Capacity, resistance and possible current of a real cell × 96, driven from full to empty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cangauge
from cangauge.bus.recording import read_log
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.health import Health
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.logs.gaps import discharged_ah
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.settings import PackLimits
from chains import chain

pytestmark = pytest.mark.real

CAPACITY_AH = 2.78
"""Charge of the cell at 25 °C from full to 2.5 V [Ah]."""
FITTED = ("551_Mixed1", "551_LA92", "552_Mixed3", "552_Mixed5")
HELD_OUT = ("551_US06", "552_Mixed7", "552_Mixed8", "551_Mixed2")
PULSE_S = 10.0


def pack_log(folder: Path, name: str) -> Log:
    """Return a drive of the cell at 1 Hz as one of 96 in series, from 100 %."""
    log = read_log(folder / "lg_hg2" / f"25degC__{name}.parquet")
    log = log.rows(slice(0, None, 10))
    soc_pct = 100.0 - 100.0 * np.asarray(discharged_ah(log.time_s, log.current_a)) / CAPACITY_AH
    return replace(log, voltage_v=96.0 * log.voltage_v, soc_pct=soc_pct, name=name)


@pytest.fixture(scope="module")
def model(shared_data: Path) -> Model:
    logs = [pack_log(shared_data, name) for name in FITTED]
    return cangauge.fit(logs, capacity_ah=CAPACITY_AH).model


@pytest.fixture(scope="module")
def drives(shared_data: Path) -> list[Log]:
    return [pack_log(shared_data, name) for name in HELD_OUT]


def health_after_three_charges(
    model: Model, drives: Sequence[Log], error: float, offset_a: float
) -> Health:
    """Return the health after four drives with counted charges between, without voltages."""
    samples, _ = chain(drives, CAPACITY_AH, offset_a)
    settings = EstimatorSettings(method="coulomb", capacity_ah=(1.0 + error) * CAPACITY_AH)
    estimator = make_estimator(model, settings)
    for sample in samples:
        estimator.update(sample)
    return estimator.health


@pytest.fixture(scope="module", params=[(0.1, 0.0), (-0.1, 0.0), (0.1, 0.07)])
def learned(
    request: pytest.FixtureRequest, model: Model, drives: list[Log]
) -> tuple[Health, float]:
    """Return the health after a wrong stated capacity and an offset [A], and the offset."""
    error, offset_a = request.param
    return health_after_three_charges(model, drives, error, offset_a), offset_a


def test_three_charges_correct_the_capacity_of_a_real_cell(learned: tuple[Health, float]) -> None:
    health, offset_a = learned
    # Three quarters of the error; 2.3 A at 90 Ah.
    assert abs(health.capacity_ah - CAPACITY_AH) < 0.025 * CAPACITY_AH
    assert health.capacity_std_ah < 0.03 * CAPACITY_AH
    assert health.offset_a == pytest.approx(offset_a, abs=0.02)


def test_deviation_covers_capacity_and_resistance_of_a_real_cell(
    learned: tuple[Health, float],
) -> None:
    health, _ = learned
    assert abs(health.capacity_ah - CAPACITY_AH) < 3.0 * health.capacity_std_ah
    assert abs(health.resistance_ratio - 1.0) < 3.0 * health.resistance_std


def pulses(log: Log) -> list[tuple[int, int, float]]:
    """Return row before, row near the end and mean current [A] of heavy pulses of some 10 s.

    The end is where the current has its mean, so that the voltage there is that of the mean.
    """
    found: list[tuple[int, int, float]] = []
    held = int(PULSE_S)
    for row in range(120, len(log) - held - 2):
        during = log.current_a[row + 1 : row + 1 + held]
        mean_a = float(during.mean())
        is_heavy = abs(mean_a) > 0.7 * CAPACITY_AH
        is_held = bool(np.all(np.abs(during - mean_a) < 0.5 * abs(mean_a)))
        is_step = abs(log.current_a[row]) < 0.6 * abs(mean_a)
        seconds = log.time_s[row + held] - log.time_s[row]
        if not (is_heavy and is_held and is_step and abs(seconds - PULSE_S) < 0.5):
            continue
        last = held - 3 + int(np.argmin(np.abs(during[-3:] - mean_a)))
        if abs(during[last] - mean_a) < 0.05 * abs(mean_a):
            found.append((row, row + 1 + last, mean_a))
    return found


def test_possible_currents_are_those_of_real_pulses(model: Model, drives: list[Log]) -> None:
    apart = []
    for log in drives[1:3]:
        events = {row: (end, mean_a) for row, end, mean_a in pulses(log)}
        estimator = make_estimator(model, EstimatorSettings(initial_soc_pct=100.0))
        for row, sample in enumerate(samples_of(log)):
            estimator.update(sample)
            if row not in events:
                continue
            end, mean_a = events[row]
            # The voltage at the end as limit: the current that led to it was just possible.
            measured_v = float(log.voltage_v[end])
            limit = "min_voltage_v" if mean_a > 0.0 else "max_voltage_v"
            limits = PackLimits(
                **{"min_voltage_v": 0.0, "max_voltage_v": 9e3, limit: measured_v},
                max_discharge_a=1e3,
                max_charge_a=1e3,
            )
            at_limit = make_estimator(model, replace(estimator.settings, limits=limits))
            at_limit.restore(estimator.snapshot())
            power = at_limit.power()
            if mean_a > 0.0:
                apart.append((power.discharge_a - mean_a) / power.discharge_std_a)
            else:
                apart.append((power.charge_a + mean_a) / power.charge_std_a)
    assert len(apart) > 30
    assert np.mean(np.abs(apart) < 2.0) > 0.85
    assert abs(np.median(apart)) < 1.0
