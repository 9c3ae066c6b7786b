"""Possible currents and energy left, against the pack that they are stated for."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.estimator import EstimatorSettings
from cangauge.estimation.offline import samples_of
from cangauge.estimation.power import PowerModel
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.delay_line import delayed_currents
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH, leaf_2012_model, leaf_2012_model_file
from cangauge.settings import PackLimits
from cangauge.types import Power, Sample
from synthetic import synthetic_log, voltage_of

PACK = leaf_2012_model()
LIMITS = PackLimits(
    min_voltage_v=335.0, max_voltage_v=400.0, max_discharge_a=2000.0, max_charge_a=2000.0
)
LOG = synthetic_log(hours=2.0, start_pct=90.0, end_pct=10.0, noise_v=0.3)
MOMENTS = range(400, 7000, 450)


@cache
def powers() -> dict[int, Power]:
    """Return the power at some rows of the drive."""
    estimator = make_estimator(leaf_2012_model_file(), EstimatorSettings(limits=LIMITS))
    found = {}
    for row, sample in enumerate(samples_of(LOG)):
        estimator.update(sample)
        if row in MOMENTS:
            found[row] = estimator.power()
    return found


def true_voltages(row: int, current_a: float) -> np.ndarray:
    """Return the true voltage while a current flows for 10 s after a row [V]."""
    time_s = np.concatenate((LOG.time_s[: row + 1], LOG.time_s[row] + np.arange(1.0, 12.0)))
    current = np.concatenate((LOG.current_a[: row + 1], np.full(11, current_a)))
    assert LOG.soc_pct is not None
    soc_pct = LOG.soc_pct[row] - 100.0 / 3600.0 / CAPACITY_AH * current_a * np.arange(11.0)
    delayed = delayed_currents(time_s, current, PACK.loads.delays_s, time_s)[-11:]
    return voltage_of(PACK, soc_pct, np.full(11, LOG.temperature_c[row]), delayed)


@pytest.mark.parametrize("direction", ["discharge", "charge"])
def test_the_voltage_touches_the_limit_within_the_deviation(direction: str) -> None:
    ohm = abs(PACK.loads.resistance_ohm[0] + PACK.loads.resistance_ohm[1])
    apart = []
    for row, power in powers().items():
        if direction == "discharge":
            off_v = true_voltages(row, power.discharge_a).min() - 335.0
            apart.append(off_v / (ohm * power.discharge_std_a))
        else:
            off_v = true_voltages(row, -power.charge_a).max() - 400.0
            apart.append(off_v / (ohm * power.charge_std_a))
        assert abs(off_v) < 1.0
    assert np.mean(np.abs(apart) < 2.0) >= 0.9


def test_energy_left_is_the_energy_of_a_discharge() -> None:
    for row, power in powers().items():
        assert LOG.soc_pct is not None
        soc_pct = np.linspace(LOG.soc_pct[row], 0.0, 2000)
        current = np.full((soc_pct.size, 4), CAPACITY_AH / 3.0)
        volts = voltage_of(PACK, soc_pct, np.full(soc_pct.size, LOG.temperature_c[row]), current)
        last = int(np.argmax(volts < 335.0)) or volts.size
        step_ah = (soc_pct[0] - soc_pct[1]) / 100.0 * CAPACITY_AH
        true_wh = volts[:last].sum() * step_ah
        assert abs(power.energy_wh - true_wh) < 2.0 * power.energy_std_wh
        assert power.energy_wh == pytest.approx(true_wh, rel=0.06, abs=120.0)
        assert power.energy_to_soc_pct == pytest.approx(soc_pct[last - 1], abs=1.5)


def test_a_pulse_just_before_lowers_what_is_possible() -> None:
    estimators = []
    for pulse_a in (0.0, 150.0):
        estimator = make_estimator(leaf_2012_model_file(), EstimatorSettings(limits=LIMITS))
        current = np.where((np.arange(200) >= 160) & (np.arange(200) < 190), pulse_a, 0.0)
        rows = np.arange(200.0)
        drops = (
            delayed_currents(rows, current, PACK.loads.delays_s, rows) @ PACK.loads.resistance_ohm
        )
        volts = PACK.pseudo_ocv(np.full(200, 60.0), 23.0) + drops
        for time_s, amperes, voltage in zip(rows, current, volts, strict=True):
            estimator.update(Sample(float(time_s), float(amperes), float(voltage), 23.0))
        estimators.append(estimator)
    rested, pulsed = (each.power() for each in estimators)
    assert pulsed.discharge_a < rested.discharge_a - 5.0
    assert pulsed.charge_a > rested.charge_a + 5.0


def test_current_limits_hold_with_a_smaller_deviation() -> None:
    low = PackLimits(335.0, 400.0, max_discharge_a=100.0, max_charge_a=0.0)
    estimator = make_estimator(leaf_2012_model_file(), EstimatorSettings(limits=low))
    for sample in samples_of(LOG.rows(slice(0, 600))):
        estimator.update(sample)
    power = estimator.power()
    assert (power.discharge_a, power.discharge_std_a) == (100.0, 0.0)
    assert (power.charge_a, power.charge_std_a) == (0.0, 0.0)


def test_limits_default_to_the_identified_range() -> None:
    known = PowerModel(leaf_2012_model_file().online(), PackLimits())
    assert (known.min_v, known.max_v) == (
        PACK.pseudo_ocv_at(0.0)[0],
        PACK.pseudo_ocv_at(100.0)[0],
    )
    assert (known.max_discharge_a, known.max_charge_a) == (200.0, 50.0)
    assert known.cutoff_pct == 0.0


@pytest.mark.parametrize(
    "limits",
    [{"min_voltage_v": -1.0}, {"cutoff_soc_pct": 101.0}, {"max_charge_a": math.nan},
     {"min_voltage_v": 400.0, "max_voltage_v": 300.0}],
)  # fmt: skip
def test_impossible_limits_are_refused(limits: dict[str, float]) -> None:
    with pytest.raises(InputError, match="limits"):
        PackLimits(**limits)


def test_a_limit_beyond_the_models_other_end_is_refused() -> None:
    with pytest.raises(InputError, match="limits"):
        make_estimator(
            leaf_2012_model_file(), EstimatorSettings(limits=PackLimits(max_voltage_v=10.0))
        )


def test_nothing_is_possible_to_say_before_the_soc() -> None:
    estimator = make_estimator(leaf_2012_model_file())
    assert all(math.isnan(each) for each in estimator.power())
    estimator.update(Sample(0.0, 10.0, math.nan, 23.0))
    assert all(math.isnan(each) for each in estimator.power())


@pytest.mark.parametrize("is_constant", [True, False])
def test_a_voltage_that_rises_with_the_current_limits_nothing(is_constant: bool) -> None:
    data = leaf_2012_model_file().model_dump()
    # The sum of the resistances is right, as identified from constant currents.
    for name, more_ohm in (("R1", 0.9), ("R4", -0.9)):
        data["published"]["coefficients"][name]["value"] += more_ohm
    model = Model.model_validate(data)
    estimator = make_estimator(model, EstimatorSettings(limits=LIMITS))
    rows = LOG.rows(slice(0, 600))
    if is_constant:
        drop_v = 20.0 * sum(PACK.loads.resistance_ohm)
        volts = PACK.pseudo_ocv(np.asarray(rows.soc_pct), 23.0) + drop_v
        rows = replace(rows, current_a=np.full(600, 20.0), voltage_v=volts)
    for sample in samples_of(rows):
        estimator.update(sample)
    power = estimator.power()
    assert all(math.isnan(each) for each in power[:4])
    assert power.energy_wh > 0.0


def test_energy_ends_at_the_stated_soc() -> None:
    rest = np.ones(300)
    log = Log(np.arange(300.0), 0.0 * rest, 378.0 * rest, 23.0 * rest)
    found = []
    for cutoff in (0.0, 20.0, 100.0):
        limits = PackLimits(cutoff_soc_pct=cutoff)
        estimator = make_estimator(leaf_2012_model_file(), EstimatorSettings(limits=limits))
        for sample in samples_of(log):
            estimator.update(sample)
        found.append(estimator.power().energy_wh)
    assert found[0] > found[1] + 0.15 * CAPACITY_AH * 330.0
    assert found[2] == 0.0


def test_the_possible_current_does_not_contradict_the_logs() -> None:
    log = synthetic_log(hours=0.6, start_pct=84.0, end_pct=62.0, noise_v=0.3)
    model = fit(log, capacity_ah=CAPACITY_AH, effects="none").model
    mean_a = np.convolve(log.current_a, np.full(10, 0.1), mode="valid")[1:]
    heaviest = 1200 + int(np.argmax(mean_a[1200:]))
    estimator = make_estimator(model, EstimatorSettings(initial_soc_pct=84.0))
    for sample in samples_of(log.rows(slice(0, heaviest + 1))):
        estimator.update(sample)
    power = estimator.power()
    assert power.discharge_a + 2.0 * power.discharge_std_a > mean_a[heaviest]
