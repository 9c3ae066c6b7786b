"""Evidence that model and pack disagree: a reason, a σ that says so, and no VALID."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cangauge import simulate
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import estimate_log, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.types import Reason, Status

SEED: dict[str, Any] = {"plant": "equation", "seed": 5}


@pytest.fixture(scope="module")
def model() -> Model:
    trips = [simulate(drive=number, hours=0.7, **SEED).log for number in (1, 2, 3)]
    return fit([simulate(discharge=True, **SEED).log, *trips]).model


@pytest.fixture(scope="module")
def day() -> Log:
    return simulate(drive=7, hours=1.0, **SEED).log


@dataclass
class Judged:
    """Rows after five minutes: which are flagged, VALID, and within 2σ of the truth."""

    is_flagged: NDArray[np.bool_]
    is_valid: NDArray[np.bool_]
    is_covered: NDArray[np.bool_]
    std_pct: NDArray[np.float64]


def judge(log: Log, model: Model, **settings: Any) -> Judged:
    table, _ = estimate_log(log, model, EstimatorSettings(**settings))
    assert log.soc_pct is not None
    late = log.time_s > log.time_s[0] + 300.0
    error_pct = np.abs(table.soc_pct - log.soc_pct)[late]
    return Judged(
        is_flagged=(table.reasons[late] & Reason.MODEL_MISMATCH) != 0,
        is_valid=table.status[late] == Status.VALID,
        is_covered=error_pct <= 2.0 * table.soc_std_pct[late],
        std_pct=table.soc_std_pct[late],
    )


@pytest.mark.parametrize("is_given", [False, True])
def test_a_good_model_is_never_flagged(model: Model, day: Log, is_given: bool) -> None:
    assert day.soc_pct is not None
    start = float(day.soc_pct[0]) if is_given else None
    found = judge(day, model, initial_soc_pct=start)
    assert not found.is_flagged.any()
    assert found.is_valid.mean() > 0.8


def test_a_stuck_temperature_widens_the_deviation(model: Model, day: Log) -> None:
    stuck = replace(day, temperature_c=np.full_like(day.temperature_c, -40.0))
    found = judge(stuck, model)
    assert not found.is_valid.any()
    assert found.std_pct.min() > 10.0
    assert found.is_covered.all()


def test_a_large_current_offset_is_a_mismatch(model: Model, day: Log) -> None:
    assert day.soc_pct is not None
    offset = replace(day, current_a=day.current_a + 20.0)
    found = judge(offset, model, initial_soc_pct=float(day.soc_pct[0]))
    assert found.is_flagged.mean() > 0.5
    assert not (found.is_flagged & found.is_valid).any()
    assert found.is_covered[found.is_flagged].all()


@pytest.mark.parametrize("relative", [0.75, 1.25])
def test_another_capacity_is_a_mismatch(model: Model, relative: float) -> None:
    drive = simulate(drive=9, discharge=True, **SEED).log
    assert drive.soc_pct is not None
    found = judge(
        drive, model,
        initial_soc_pct=float(drive.soc_pct[0]), capacity_ah=model.capacity_ah / relative,
    )  # fmt: skip
    assert found.is_flagged[-1]
    assert not (found.is_flagged & found.is_valid).any()


def test_another_model_forgets_the_mismatch(model: Model, day: Log) -> None:
    assert day.soc_pct is not None
    settings = EstimatorSettings(initial_soc_pct=float(day.soc_pct[0]))
    before = Estimator(model, settings)
    samples = list(samples_of(replace(day, current_a=day.current_a + 10.0)))
    for sample in samples[:-1]:
        before.step(sample)
    assert before.estimate.reasons & Reason.MODEL_MISMATCH
    after = Estimator(model, settings)
    after.take_over(before)
    assert not after.step(samples[-1]).reasons & Reason.MODEL_MISMATCH
