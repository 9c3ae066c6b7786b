"""A simulator in the place of the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from days import day

from cangauge.diagnosis import diagnose
from cangauge.diagnosis.simulator import simulated_v
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.model.effects.base import Signals
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH, leaf_2012_model


class Simulator:
    """The published equation, with an error of its voltage."""

    def __init__(self, volts: float = 0.0, capacity: float = 1.0) -> None:
        self.volts, self.capacity = volts, capacity

    def __call__(
        self, time_s: np.ndarray, current_a: np.ndarray, temperature_c: np.ndarray, start: float
    ) -> np.ndarray:
        model = ExtendedModel(leaf_2012_model(), CAPACITY_AH * self.capacity)
        signals = Signals(time_s, current_a, current_a, temperature_c)
        return model.predict(signals, start, np.arange(time_s.size)).voltage_v + self.volts


@pytest.fixture(scope="module")
def logs() -> list[Log]:
    return [day(seed) for seed in (31, 32)]


@pytest.mark.parametrize(("off_v", "fault_v"), [(6.0, 6.0), (0.0, 8.0)])
def test_the_level_of_a_simulator_is_that_on_healthy_logs(
    logs: list[Log], model: Model, off_v: float, fault_v: float
) -> None:
    """The voltage of a faulty log may hide it, or look like one."""
    faulty = [replace(log, voltage_v=log.voltage_v + fault_v) for log in logs]
    references = [day(seed) for seed in (33, 34, 35)]
    found = diagnose(faulty, model, references, simulation=Simulator(volts=off_v))
    assert ("6.0 V too high everywhere" in found.summary) == (off_v > 0.0)
    assert ("Correct its level first" in found.summary) == (off_v > 0.0)


def test_a_simulator_that_is_off_everywhere_is_told_first(logs: list[Log], model: Model) -> None:
    found = diagnose(logs, model, simulation=Simulator(volts=6.0))
    first = found.summary.splitlines()[0]
    assert "6.0 V too high everywhere" in first
    assert "Correct its level first" in first
    assert "Nothing to do" not in found.summary


def test_a_corrected_simulator_is_better(logs: list[Log], model: Model) -> None:
    references = [day(seed) for seed in (33, 34, 35)]
    faulty = [replace(log, voltage_v=log.voltage_v + 8.0) for log in logs]
    found = diagnose(faulty, model, references, simulation=Simulator())
    assert found.posterior.stated[0] == "voltage_reading"
    assert "To correct the simulator" in found.summary
    assert found.simulator is not None
    for log, carried in zip(faulty, found.logs, strict=True):
        before = log.voltage_v - simulated_v(Simulator(), log)
        after = found.extended_model.predict(carried).residual_v
        assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))


def test_a_simulator_that_misses_references_is_not_fitted_again(
    logs: list[Log], model: Model
) -> None:
    references = [day(seed) for seed in (33, 34, 35)]
    found = diagnose(logs, model, references, simulation=Simulator(volts=6.0))
    check = found.model_check
    assert check is not None
    assert not check.describes
    assert "The simulator misses the healthy logs by" in found.summary
    assert "Fit the model again" not in found.summary


def test_the_gap_is_the_difference_to_the_simulator(logs: list[Log], model: Model) -> None:
    found = diagnose(logs, model, simulation=Simulator(volts=0.8))
    difference = np.concatenate([log.voltage_v - Simulator(0.8)(
        log.time_s, log.current_a, log.temperature_c, 85.0) for log in logs])  # fmt: skip
    assert found.baseline_rmse_v == pytest.approx(np.sqrt(np.mean(difference**2)), rel=1e-3)


def test_voltages_of_a_table_are_a_simulator(logs: list[Log]) -> None:
    volts = {log.name: log.voltage_v + 1.0 for log in logs}
    assert simulated_v(volts, logs[0]) == pytest.approx(logs[0].voltage_v + 1.0)


@pytest.mark.parametrize(
    ("simulation", "word"),
    [
        (lambda *_: [1.0], "shape"),
        (lambda time_s, *_: np.nan * time_s, "not finite"),
        (lambda *_: 1 / 0, "ZeroDivisionError"),
    ],
)
def test_a_failing_simulation_is_one_line(logs: list[Log], simulation: object, word: str) -> None:
    with pytest.raises(InputError, match=word):
        simulated_v(simulation, logs[0])
