"""A pack's model and its references, shared by most diagnoses; only to read."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Iterator, Sequence

import pytest
from days import day, short_day

from cangauge.diagnosis import references as references_module
from cangauge.diagnosis.error_model import error_from_references
from cangauge.diagnosis.hypotheses import Hypotheses
from cangauge.diagnosis.linear_gaussian import ErrorModel, NormalEquations
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


@pytest.fixture(scope="session")
def short_references() -> list[Log]:
    return [short_day(seed) for seed in (11, 12, 13)]


@pytest.fixture(scope="session", autouse=True)
def error_models() -> Iterator[None]:
    """Estimate the error model of equal references once: a pure function, half of a diagnosis."""
    known: dict[str, ErrorModel] = {}

    def estimate(
        hypotheses: Hypotheses,
        references: Sequence[NormalEquations],
        stated: ErrorModel,
        least_weight: float = 0.0,
    ) -> ErrorModel:
        candidates = [
            (each.effect.id, each.shape, each.bounds.tolist()) for each in hypotheses.candidates
        ]
        others = (
            hypotheses.prior_root,
            hypotheses.column_scale,
            hypotheses.structure,
            hypotheses.per_log,
            hypotheses.per_log_prior_std,
            hypotheses.prior_mean,
        )
        logs = [(each.products.tobytes(), each.counts.tobytes()) for each in references]
        given = pickle.dumps((candidates, others, logs, vars(stated), least_weight))
        key = hashlib.sha256(given).hexdigest()
        if key not in known:
            known[key] = error_from_references(hypotheses, references, stated, least_weight)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(references_module, "error_from_references", estimate)
        yield
