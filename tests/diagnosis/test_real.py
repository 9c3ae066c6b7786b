"""Faults injected into recorded trips, as a user would meet them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cangauge.bus.recording import read_log
from cangauge.diagnosis import Diagnosis, References, diagnose, learn_references
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
def known(references: list[Log], model: Model) -> References:
    return learn_references(references, model)


def found_in(change: Callable[[Log], Log], model: Model, known: References) -> Diagnosis:
    return diagnose([change(trip(number)) for number in (15, 17)], model, known)


@pytest.mark.parametrize(
    ("change", "group"),
    [
        (lambda log: replace(log, voltage_v=1.02 * log.voltage_v), "sensors_and_count"),
        (lambda log: replace(log, current_a=np.interp(
            log.time_s - 0.5, log.time_s, log.current_a)), "clock"),
        (lambda log: replace(log, voltage_v=log.voltage_v - 0.05 * log.current_a),
         "overpotential"),
    ],
)  # fmt: skip
def test_a_fault_of_two_floors_is_in_the_first_group(
    change: Callable[[Log], Log], group: str, model: Model, known: References
) -> None:
    found = found_in(change, model, known)
    assert found.posterior.detected
    assert found.posterior.stated_groups[0] == group


def test_a_late_current_is_named_and_sized(model: Model, known: References) -> None:
    found = found_in(
        lambda log: replace(log, current_a=np.interp(log.time_s - 0.5, log.time_s, log.current_a)),
        model,
        known,
    )
    assert found.posterior.name == "time_skew"
    ci = found.parameters["time_skew"]["skew_s"].ci
    assert ci is not None
    assert ci[0] <= 0.5 <= ci[1]
    assert found.accepted == "time_skew"
    assert found.extended_rmse_v < found.baseline_rmse_v


def test_healthy_trips_give_no_alarm(model: Model, known: References) -> None:
    assert not found_in(lambda log: log, model, known).posterior.detected
