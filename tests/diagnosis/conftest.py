"""A pack's model and its references, shared by most diagnoses; only to read."""

from __future__ import annotations

import pytest
from days import day

from cangauge.diagnosis import Healthy, learn_references
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH
from synthetic import synthetic_log


@pytest.fixture(scope="session")
def model() -> Model:
    """A model identified from three full discharges of the published equation."""
    logs = [synthetic_log(noise_v=0.5, seed=seed) for seed in (1, 2, 3)]
    return fit(logs, capacity_ah=CAPACITY_AH).model


@pytest.fixture(scope="session")
def references() -> list[Log]:
    return [day(seed) for seed in (11, 12, 13)]


@pytest.fixture(scope="session")
def known(references: list[Log], model: Model) -> Healthy:
    """What the references show, learned once."""
    return learn_references(references, model)
