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
from cangauge.diagnosis.sizes import simulated
from cangauge.model.effects.library import effect_entries
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model

BEYOND: Final = 2.0
"""A model misses the healthy logs whose error is more than this many times what is expected: their
error among themselves, and the uncertainty that the model file states."""
OF_LOGS: Final = ("start", "clock")
"""Faults of logs, not of a model."""
EFFECTS_AT_MOST: Final = 3
"""Effects that a model may lack."""


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
    """Return what a model misses on references, two at least."""
    among_v, references = healthy.rmse_v, healthy.references
    now, extended = model, model.extended_model()
    expected_v = _expected_v(model, healthy)
    found: list[Missed] = []
    models, errors_v = [extended], [_rmse_v(extended, references)]
    while errors_v[-1] > BEYOND * expected_v and len(found) < EFFECTS_AT_MOST:
        alone = replace(
            of_model(now, among_v),
            mean_squares_v2=healthy.mean_squares_v2,
            nats=healthy.nats,
            excess=healthy.excess,
        )
        logs = [log_rows(alone.linear, log, alone.tried, []) for log in references]
        evidence = simulated(alone, logs, analyse(alone, logs))
        answer = posterior(alone, logs, evidence)
        changed, left_v = {}, {}
        for name, of in evidence.items():
            if of.fault not in OF_LOGS:
                changed[name] = added(models[-1], of.shape.effect, of.shape.values(of.size))
                left_v[name] = _rmse_v(changed[name], references)
        # Of those that suffice the most probable, else of all. Two effects may cancel: without one
        # of them the error grows, until the other is found too.
        enough = [name for name, v in left_v.items() if v <= BEYOND * expected_v]
        effect = max(enough or left_v, key=answer.probabilities.__getitem__)
        models.append(changed[effect])
        errors_v.append(left_v[effect])
        now = now.model_copy(update={"effects": effect_entries(models[-1].effects)})
        found.append(Missed(evidence[effect], answer, left_v[effect]))
    best = int(np.argmin(errors_v))
    return ModelCheck(errors_v[0], among_v, expected_v, tuple(found[:best]), models[best])


def _expected_v(model: Model, healthy: Healthy) -> float:
    """Return the error of the references that the model's own uncertainty explains [V]."""
    alone = of_model(model)
    logs = [log_rows(alone.linear, log, (), []) for log in healthy.references]
    plain = replace(alone, tried=(), known=alone.known.with_columns(range(alone.linear.p)))
    open_v2 = float(np.mean([plain.open_v2([log]) for log in logs]))
    return float(np.sqrt(healthy.healthy_v2 + open_v2 + model.noise.level_std_v**2))


def _rmse_v(model: ExtendedModel, references: Sequence[Trace]) -> float:
    """Return the RMS error of references by a model, each log weighing alike [V]."""
    squares = [np.mean(Simulated(model, log).plain.residual_v ** 2) for log in references]
    return float(np.sqrt(np.mean(squares)))
