"""Which structure the extended model takes from clean logs."""

from __future__ import annotations

from dataclasses import replace

import pytest

from cangauge.diagnosis.cross_validation import rms
from cangauge.diagnosis.extended_model import extend, library_without
from cangauge.diagnosis.problem import DiagnosisProblem, build_problem
from cangauge.diagnosis.references import needed
from cangauge.identify.fit import fit
from cangauge.inference.linearized import residual
from cangauge.inference.rows import sample_log
from cangauge.logs.log import Log
from cangauge.model.effects.first_order import low_passed
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH
from synthetic import synthetic_log

NOISE_V = 0.5
POLARISED_OHM = 0.1


def day(seed: int) -> Log:
    return synthetic_log(hours=0.6, start_pct=85.0, end_pct=65.0, noise_v=NOISE_V, seed=seed)


def polarised(log: Log) -> Log:
    """A polarisation of 400 s, which no delay of the model follows."""
    slow = low_passed(log.time_s, log.current_a, 400.0, 0.0)
    return replace(log, voltage_v=log.voltage_v - POLARISED_OHM * slow)


@pytest.fixture(scope="module")
def model() -> Model:
    logs = [synthetic_log(noise_v=NOISE_V, seed=seed) for seed in (1, 2, 3)]
    return fit(logs, capacity_ah=CAPACITY_AH).model


def needed_of(settled: DiagnosisProblem) -> set[str]:
    pieces = needed(settled.frame, settled.reference_grams, settled.error)
    return {settled.frame.choices[k].effect.id for k in pieces}


def test_a_pack_that_obeys_the_model_needs_none(model: Model) -> None:
    settled = build_problem([day(21)], model, [day(11), day(12), day(13)], library_without([]))
    assert needed_of(settled) == set()
    assert extend(settled, []).model.effects == ()


def test_structure_that_references_show_runs_in_the_extended_model(model: Model) -> None:
    references = [polarised(day(seed)) for seed in (11, 12, 13)]
    settled = build_problem([polarised(day(21))], model, references, library_without([]))
    assert "slow_diffusion" in needed_of(settled)
    extended = extend(settled, []).model
    assert "slow_diffusion" in {effect.id for effect, _ in extended.effects}
    another = sample_log(polarised(day(31)), settled.options)
    assert rms(residual(another, extended)) < 1.1 * NOISE_V
    assert rms(residual(another, model.extended_model())) > 1.5 * NOISE_V
