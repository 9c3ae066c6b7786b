"""Effects fitted to logs, with standard errors and what each was worth on logs left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge.identify.effects.linear import Linear, linearise, solution_at
from cangauge.identify.effects.prepared import Prepared
from cangauge.identify.effects.search import Progress, Step, find_effects
from cangauge.identify.held_out import LOGS_AT_LEAST
from cangauge.identify.least_squares import Solution
from cangauge.identify.voltage_fit import blocks_of
from cangauge.model.extended import ExtendedModel

FloatArray = NDArray[np.float64]


FEW_LOGS = 5
"""With fewer whole logs their mean gain has hardly a standard error; it is said."""

AT_BOUND = 1e-6
"""A parameter this near its bound, in parts of the bounds, is held by it."""


@dataclass(frozen=True)
class Estimate:
    """One parameter of an effect."""

    name: str
    value: float
    std_error: float | None
    """None for a choice between two, and for a constant."""
    unit: str

    def to_dict(self) -> dict[str, object]:
        """Return value, standard error and unit."""
        return {"value": self.value, "std_error": self.std_error, "unit": self.unit}


@dataclass(frozen=True, eq=False)
class FittedEffects:
    """A model with effects, as its logs gave it."""

    model: ExtendedModel
    linear: Linear
    """The residual of the logs near the model."""
    solution: Solution
    """Of the voltage model's coefficients, the effects' parameters being open too."""
    estimates: tuple[tuple[str, tuple[Estimate, ...]], ...]
    """Id and parameters of each effect, in the model's order."""
    held_out_error_v: tuple[FloatArray, ...]
    """Of each log, by fits that did not see the row [V]; NaN where none judged it."""
    held_out_rmse_v: tuple[float, float]
    """Without any effect, and with all of them [V]."""
    steps: tuple[Step, ...]

    def remarks(self) -> list[str]:
        """Return what a user should know of the effects beside their numbers."""
        before, after = self.held_out_rmse_v
        if not self.model.effects:
            return ["no effect lowers the error on data left out by more than chance: none taken"]
        found = ["the slope resistance expected from the coefficients leaves out the effects' part"]
        if LOGS_AT_LEAST <= len(self.held_out_error_v) < FEW_LOGS:
            found.append(
                f"the effects were judged on {len(self.held_out_error_v)} logs left out in turn:"
                " so few hardly tell chance from effect; give five or more"
            )
        if after > before:
            found.append("the effects raise the error on data left out: leave them out")
        for item in self.linear.free:
            reach = AT_BOUND * (item.high - item.low)
            edge = {item.low: item.value - item.low, item.high: item.high - item.value}
            for bound, distance in edge.items():
                if distance <= reach:
                    effect = self.model.effects[item.effect][0]
                    found.append(f"{effect.id}: {item.name} lies at its bound of {bound:.4g}")
        return found

    def to_dict(self) -> dict[str, object]:
        """Return the part of `cangauge fit --json` that is about effects."""
        return {
            "effects": [
                {"id": effect_id, "parameters": {item.name: item.to_dict() for item in parameters}}
                for effect_id, parameters in self.estimates
            ],
            "effect_search": {
                "held_out_rmse_without_v": self.held_out_rmse_v[0],
                "held_out_rmse_with_v": self.held_out_rmse_v[1],
                "steps": [step.to_dict() for step in self.steps],
            },
        }


def fit_effects(
    plain: ExtendedModel, logs: Sequence[Prepared], ids: Sequence[str], say: Progress
) -> FittedEffects:
    """Find effects and fit them together with the coefficients.

    Parameters
    ----------
    plain : ExtendedModel
        The fitted voltage model, without effects.
    logs : sequence of Prepared
    ids : sequence of str
        Effects to take, or `auto` alone.
    say : callable
        Called with a line of text before each long step.

    Raises
    ------
    InputError
        If the logs are too short to judge anything.
    """
    found = find_effects(plain, logs, ids, say)
    linear = linearise(found.model, logs)
    whole = solution_at(linear, blocks_of([item.rows for item in logs]))
    n = found.model.model.coefficients.size
    ends = np.cumsum([len(item.rows) for item in logs])[:-1]
    return FittedEffects(
        model=found.model,
        linear=linear,
        solution=whole.part(n),
        estimates=tuple(_estimates(linear, whole.std_error[n:])),
        held_out_error_v=tuple(np.split(found.judged.error_v, ends)),
        held_out_rmse_v=(found.plain.rmse_v, found.judged.rmse_v),
        steps=found.steps,
    )


def _estimates(linear: Linear, std_error: FloatArray) -> list[tuple[str, tuple[Estimate, ...]]]:
    known = {
        (item.effect, item.name): float(error)
        for item, error in zip(linear.free, std_error, strict=True)
    }
    return [
        (
            effect.id,
            tuple(
                Estimate(
                    parameter.name,
                    float(values[parameter.name]),
                    known.get((number, parameter.name)),
                    parameter.unit,
                )
                for parameter in effect.parameters
            ),
        )
        for number, (effect, values) in enumerate(linear.model.effects)
    ]
