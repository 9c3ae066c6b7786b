"""Whether the given model describes the healthy pack, and what it misses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cangauge.diagnosis.correction import parameters_of
from cangauge.diagnosis.evidence import Evidence, analyse
from cangauge.diagnosis.faults import Quantity
from cangauge.diagnosis.pack import Healthy, log_rows, of_model
from cangauge.diagnosis.posterior import Posterior, posterior
from cangauge.diagnosis.rows import Simulated, Trace, added
from cangauge.diagnosis.sizes import simulated
from cangauge.model.effects.library import effect_entries
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model

BEYOND: Final = 2.0
"""A model misses the healthy logs whose error is more than this many times that among themselves:
their own fit is never that much worse on logs that it did not see."""
EFFECTS_AT_MOST: Final = 3
"""Effects that a model may lack."""


@dataclass(frozen=True, eq=False)
class Missed:
    """One effect that the model lacks on the healthy logs."""

    evidence: Evidence
    posterior: Posterior
    fault: str
    effect: str
    parameters: dict[str, Quantity]
    rmse_v: float
    """Error of the references with it [V]."""


@dataclass(frozen=True, eq=False)
class ModelCheck:
    """The model beside the healthy logs.

    Parameters
    ----------
    references_rmse_v, among_themselves_rmse_v : float
        Error of the references by the model, and by each other [V].
    missed : tuple of Missed
        What it lacks; none where it describes them.
    corrected : ExtendedModel
        The model with these.
    """

    references_rmse_v: float
    among_themselves_rmse_v: float
    missed: tuple[Missed, ...]
    corrected: ExtendedModel

    @property
    def describes(self) -> bool:
        """Whether the model describes the healthy logs."""
        return self.references_rmse_v <= BEYOND * self.among_themselves_rmse_v


def check_model(model: Model, healthy: Healthy) -> ModelCheck:
    """Return what a model misses on references, two at least."""
    among_v, references, found = healthy.rmse_v, healthy.references, []
    now, extended = model, model.extended_model()
    before_v = _rmse_v(extended, references)
    rmse_v = before_v
    while rmse_v > BEYOND * among_v and len(found) < EFFECTS_AT_MOST:
        alone = of_model(now, among_v)
        alone = replace(
            alone,
            mean_squares_v2=healthy.mean_squares_v2,
            nats=healthy.nats,
            excess=healthy.excess,
        )
        logs = [log_rows(alone.linear, log, alone.tried, []) for log in references]
        evidence = simulated(alone, logs, analyse(alone, logs))
        answer = posterior(alone, evidence)
        fault = next(iter(answer.faults))
        effect = next(iter(answer.effects(fault)))
        of = evidence.effects[effect]
        changed = added(extended, of.shape.effect, of.shape.values(of.size))
        now = now.model_copy(update={"effects": effect_entries(changed.effects)})
        with_it_v = _rmse_v(changed, references)
        if with_it_v >= rmse_v:
            break
        parameters = parameters_of(of, references[0].log.duration_s)
        found.append(Missed(evidence, answer, fault, effect, parameters, with_it_v))
        extended, rmse_v = changed, with_it_v
    return ModelCheck(before_v, among_v, tuple(found), extended)


def _rmse_v(model: ExtendedModel, references: Sequence[Trace]) -> float:
    """Return the RMS error of references by a model, each log weighing alike [V]."""
    squares = [np.mean(Simulated(model, log).plain.residual_v ** 2) for log in references]
    return float(np.sqrt(np.mean(squares)))
