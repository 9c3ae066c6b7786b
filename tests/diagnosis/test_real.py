"""Faults injected into recorded trips, as a user would meet them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cangauge.bus.recording import read_log
from cangauge.diagnosis import Diagnosis, Healthy, diagnose, learn_references
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

TRIPS = Path(__file__).parents[3] / "shared" / "data" / "bmw_i3"
CAPACITY_AH = 61.75

pytestmark = [
    pytest.mark.real,
    pytest.mark.skipif(not TRIPS.exists(), reason="the recorded trips are not beside the project"),
]


def trip(number: int) -> Log:
    log = read_log(TRIPS / f"TripA{number:02d}.csv.gz")
    start = log.first_soc()
    assert start is not None
    soc = np.full(len(log), np.nan)
    soc[start[0]] = start[1]
    return replace(log, soc_pct=soc)


@pytest.fixture(scope="module")
def references() -> list[Log]:
    return [trip(number) for number in (1, 3, 5, 7, 9, 11, 13)]


@pytest.fixture(scope="module")
def model(references: list[Log]) -> Model:
    return fit(references, capacity_ah=CAPACITY_AH).model


@pytest.fixture(scope="module")
def known(references: list[Log], model: Model) -> Healthy:
    return learn_references(references, model)


def found_in(change: Callable[[Log], Log], model: Model, known: Healthy) -> Diagnosis:
    return diagnose([change(trip(number)) for number in (15, 17)], model, known)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda log: replace(log, voltage_v=1.02 * log.voltage_v), "voltage_reading"),
        (lambda log: replace(log, current_a=np.interp(
            log.time_s - 0.5, log.time_s, log.current_a)), "clock"),
        (lambda log: replace(log, voltage_v=log.voltage_v - 0.05 * log.current_a),
         "resistance"),
    ],
)  # fmt: skip
def test_a_fault_of_two_floors_is_stated(
    change: Callable[[Log], Log], fault: str, model: Model, known: Healthy
) -> None:
    found = found_in(change, model, known)
    assert found.posterior.level != "none"
    assert found.posterior.stated[0] == fault


def test_a_late_current_is_named_and_sized(model: Model, known: Healthy) -> None:
    found = found_in(
        lambda log: replace(log, current_a=np.interp(log.time_s - 0.5, log.time_s, log.current_a)),
        model,
        known,
    )
    assert found.posterior.stated[0] == "clock"
    ci = found.best_of("clock").parameters["skew_s"].ci
    assert ci is not None
    assert ci[0] <= 0.5 <= ci[1]
    assert found.is_written
    assert found.extended_rmse_v < found.baseline_rmse_v


def test_healthy_trips_give_no_alarm(model: Model, known: Healthy) -> None:
    assert found_in(lambda log: log, model, known).posterior.level != "gap"
