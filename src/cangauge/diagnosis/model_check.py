"""Whether the given model describes the healthy pack, and what it misses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cangauge.diagnosis.evidence import Evidence, analyse
from cangauge.diagnosis.pack import Healthy, log_rows, of_model
from cangauge.diagnosis.posterior import Posterior, posterior
from cangauge.diagnosis.rows import Simulated, Trace, added
from cangauge.diagnosis.sizes import sized_by_simulation
from cangauge.diagnosis.where import rms
from cangauge.model.effects.library import effect_entries
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model

BEYOND: Final = 2.0
"""A model misses the healthy logs whose error is more than this many times what is expected: their
error among themselves, and the uncertainty that the model file states."""
OF_LOGS: Final = ("start", "clock")
"""Faults of logs, not of a model."""


@dataclass(frozen=True, eq=False)
class Missed:
    """One effect that the model lacks on the healthy logs."""

    evidence: Evidence
    posterior: Posterior
    rmse_v: float
    """Error of the references with it [V]."""


@dataclass(frozen=True, eq=False)
class ModelCheck:
    """The model beside the healthy logs.

    Parameters
    ----------
    references_rmse_v, among_themselves_rmse_v, expected_rmse_v : float
        Error of the references by the model, by each other, and with the uncertainty that the model
        states [V].
    missed : tuple of Missed
        What it lacks; none where it describes them.
    corrected : ExtendedModel
        The model with these.
    """

    references_rmse_v: float
    among_themselves_rmse_v: float
    expected_rmse_v: float
    missed: tuple[Missed, ...]
    corrected: ExtendedModel

    @property
    def describes(self) -> bool:
        """Whether the model describes the healthy logs."""
        return self.references_rmse_v <= BEYOND * self.expected_rmse_v

    @property
    def is_uncertain(self) -> bool:
        """Whether only the uncertainty that the model states explains what it misses."""
        return self.references_rmse_v > BEYOND * self.among_themselves_rmse_v


def check_model(model: Model, healthy: Healthy) -> ModelCheck:
    """Return what a model misses on references, two at least: three effects at most."""
    references, expected_v = healthy.references, _expected_v(model, healthy)
    models = [model.extended_model()]
    errors_v = [_rmse_v(models[0], references)]
    found: list[Missed] = []
    while errors_v[-1] > BEYOND * expected_v and len(found) < 3:
        now = model.model_copy(update={"effects": effect_entries(models[-1].effects)})
        alone = replace(
            of_model(now, healthy.rmse_v),
            mean_squares_v2=healthy.mean_squares_v2,
            nats=healthy.nats,
            excess=healthy.excess,
        )
        logs = [log_rows(alone.model, log, alone.tried, ()) for log in references]
        evidence = sized_by_simulation(alone, logs, analyse(alone, logs))
        answer = posterior(alone, logs, evidence)
        changed = {
            name: added(models[-1], of.shape.effect, of.shape.values(of.size))
            for name, of in evidence.items()
            if of.fault not in OF_LOGS
        }
        left_v = {name: _rmse_v(each, references) for name, each in changed.items()}
        # Of those that suffice the most probable, else of all. Two effects may cancel: without one
        # of them the error grows, until the other is found too.
        enough = [name for name, v in left_v.items() if v <= BEYOND * expected_v]
        effect = max(enough or left_v, key=answer.probabilities.__getitem__)
        models.append(changed[effect])
        errors_v.append(left_v[effect])
        found.append(Missed(evidence[effect], answer, left_v[effect]))
    best = int(np.argmin(errors_v))
    return ModelCheck(errors_v[0], healthy.rmse_v, expected_v, tuple(found[:best]), models[best])


def _expected_v(model: Model, healthy: Healthy) -> float:
    """Return the error of the references that the model's own uncertainty explains [V]."""
    alone = of_model(model, model.noise.voltage_rmse_v)
    logs = [log_rows(alone.model, log, (), ()) for log in healthy.references]
    coefficients = range(logs[0].columns.shape[1] - logs[0].m - 1)
    plain = replace(alone, delta=alone.delta.with_columns(coefficients))
    open_v2 = float(np.mean([plain.open_v2([log]) for log in logs]))
    return float(np.sqrt(healthy.healthy_v2 + open_v2 + model.noise.level_std_v**2))


def _rmse_v(model: ExtendedModel, references: Sequence[Trace]) -> float:
    """Return the RMS error of references by a model, each log weighing alike [V]."""
    return rms(np.array([rms(Simulated(model, log).plain.residual_v) for log in references]))
