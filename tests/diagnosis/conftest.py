"""The model that most diagnoses start from, and its references; only to read."""

from __future__ import annotations

import pytest
from days import day

from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH
from synthetic import synthetic_log


@pytest.fixture(scope="session")
def model() -> Model:
    """The published equation, identified from three full discharges."""
    logs = [synthetic_log(noise_v=0.5, seed=seed) for seed in (1, 2, 3)]
    return fit(logs, capacity_ah=CAPACITY_AH).model


@pytest.fixture(scope="session")
def references() -> list[Log]:
    return [day(seed) for seed in (11, 12, 13)]
