"""Evidence that model and pack disagree: a reason, an invalid estimate, and recovery."""

from __future__ import annotations

import numpy as np
import pytest

from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import EstimateTable, run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.model_file import Model
from cangauge.model.published import leaf_2012_model_file
from cangauge.types import Reason, Sample, Status
from synthetic import synthetic_log

MODEL = leaf_2012_model_file()
LOG = synthetic_log(start_pct=90.0, end_pct=50.0, noise_v=0.5, seed=6, hours=0.8)


def flagged(table: EstimateTable) -> np.ndarray:
    return (table.reasons & Reason.MODEL_MISMATCH) != 0


def other_pack(**changes: float) -> Model:
    """Return the published model with some coefficients multiplied by a factor."""
    data = MODEL.model_dump()
    for name, factor in changes.items():
        data["published"]["coefficients"][name]["value"] *= factor
    return Model.model_validate(data)


@pytest.mark.parametrize("start_pct", [None, 90.0, 70.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_good_model_is_never_flagged(seed: int, start_pct: float | None) -> None:
    log = synthetic_log(start_pct=90.0, end_pct=50.0, noise_v=0.8, seed=seed, hours=0.8)
    table = run_estimator(log, MODEL, EstimatorSettings(initial_soc_pct=start_pct))
    assert not flagged(table).any()


@pytest.mark.parametrize("changes", [{"R1": 2.5, "R2": 2.5}, {"R1": 0.0, "R2": 0.0}])
def test_another_packs_model_is_invalid_within_ten_minutes(changes: dict[str, float]) -> None:
    table = run_estimator(LOG, other_pack(**changes), EstimatorSettings(initial_soc_pct=90.0))
    late = LOG.time_s >= 630.0
    assert flagged(table)[late].mean() > 0.8
    assert np.all(table.status[flagged(table)] == Status.INVALID)


def test_unseen_charge_is_a_contradiction_that_passes() -> None:
    """The current read zero for half an hour of driving: the SoC was wrong, not the model."""
    blind = [
        each._replace(current_a=0.0) if 600.0 <= each.time_s < 1500.0 else each
        for each in samples_of(synthetic_log(start_pct=90.0, end_pct=40.0, noise_v=0.5, hours=1.2))
    ]
    table = run_estimator(blind, MODEL, EstimatorSettings(initial_soc_pct=90.0))
    truth = synthetic_log(start_pct=90.0, end_pct=40.0, noise_v=0.5, hours=1.2).soc_pct
    assert truth is not None
    assert abs(table.soc_coulomb_pct[-1] - truth[-1]) > 8.0
    assert abs(table.soc_pct[-1] - truth[-1]) < 2.5 * table.soc_std_pct[-1]


def test_another_model_forgets_the_mismatch() -> None:
    before = Estimator(other_pack(R1=2.5, R2=2.5), EstimatorSettings(initial_soc_pct=90.0))
    samples: list[Sample] = list(samples_of(LOG))
    for sample in samples[:-1]:
        before.step(sample)
    assert before.estimate.reasons & Reason.MODEL_MISMATCH
    after = Estimator(MODEL, EstimatorSettings(initial_soc_pct=90.0))
    after.take_over(before)
    assert not after.step(samples[-1]).reasons & Reason.MODEL_MISMATCH
