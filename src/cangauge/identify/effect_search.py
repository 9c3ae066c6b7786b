"""Selection of effects by forward selection and backward elimination, and their joint fit.

Forward: every effect with every trial value of its shapes is screened by a linear step on the
folds. The most promising are fitted jointly with the present model, through its own equations, and
the better one is added if it is significantly better (`cross_validation`). Backward: the effect
whose removal costs least is removed if the cost is not significant; otherwise each effect is
compared with the best replacement.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import CangaugeError, InputError
from cangauge.identify.cross_validation import Comparison, CrossValidation, HeldOutErrors, compare
from cangauge.inference.least_squares import CLUSTER_S, Solution
from cangauge.inference.linearized import (
    ROUGHLY_CONVERGED,
    Linearization,
    effect_columns,
    fit_extended,
    linearize,
    residual,
    solution_at,
    with_modelled_voltage,
)
from cangauge.inference.rows import LOGS_AT_LEAST, SampledLog, block_numbers
from cangauge.model.effects.base import Effect, Values
from cangauge.model.effects.library import (
    LIBRARY,
    Candidate,
    candidates,
    effect_entries,
    effect_of,
    parse_effects,
    shape_key,
)
from cangauge.model.extended import ExtendedModel

_LOG = logging.getLogger(__name__)

AUTO = "auto"

SEARCHED = (
    "resistance_temperature", "resistance_soc", "resistance_asymmetry", "charge_transfer",
    "fast_polarization", "slow_diffusion", "hysteresis", "entropic_coefficient",
    "temperature_lag", "core_temperature",
)  # fmt: skip
"""Effects that `auto` tries: structure of a healthy pack that the coefficients lack."""

NOT_IDENTIFIABLE = {
    "initial_soc": "it belongs to one log: give --initial-soc",
    "resistance_step": "it belongs to one log, not to a healthy pack",
    "capacity": "give --capacity-ah; the curve over SoC follows it",
    "current_gain": "resistances and capacity absorb it: give --capacity-ah",
    "voltage_offset": "k0 absorbs it",
    "voltage_gain": "the coefficients absorb it",
}
"""Effects that a fit cannot separate from its own coefficients, and why."""

COPIES_AT_MOST = 2
"""Copies of one effect with different shapes in a model: a chain of RC elements."""

EFFECTS_AT_MOST = 8

TAU_RATIO_AT_LEAST = 2.0
"""Ratio of the time constants of two copies of one effect."""

FITTED_PER_ROUND = 2
"""Number of the most promising effects of a round that are fitted in full."""

FEW_LOGS = 5
"""With fewer whole logs the standard error of the mean gain is unreliable: a remark is added."""

AT_BOUND = 1e-6
"""Distance of a parameter from its bound, relative to their width, at which the bound is active."""


def parse_effect_ids(given: Sequence[str]) -> tuple[str, ...]:
    """Return effect ids from texts that may hold several, separated by commas.

    Raises
    ------
    InputError
        If an id is unknown, not identifiable by a fit, repeated too often, or combined with
        `auto`.
    """
    ids = [part.strip() for text in given for part in text.split(",")]
    if ids == [AUTO]:
        return (AUTO,)
    if AUTO in ids:
        raise InputError(
            "auto selects effects itself", field="--effects", value=", ".join(ids),
            cure="give auto alone, or ids alone",
        )  # fmt: skip
    for effect_id in ids:
        effect = effect_of(effect_id, "--effects")
        if effect_id in NOT_IDENTIFIABLE:
            raise InputError(
                "not identifiable by a fit",
                field="--effects",
                value=effect_id,
                cure=NOT_IDENTIFIABLE[effect_id],
            )
        copies = COPIES_AT_MOST if effect.shapes and effect.amplitudes else 1
        if ids.count(effect_id) > copies:
            raise InputError(
                f"may be given {'twice' if copies == COPIES_AT_MOST else 'once'} at most",
                field="--effects",
                value=", ".join(ids),
            )
    return tuple(ids)


@dataclass(frozen=True)
class SearchStep:
    """One effect added or removed, or a decision against it."""

    what: str
    """`added`, `not added`, `removed`, or `in place of` another."""
    effect_id: str
    comparison: Comparison
    """With the model without it (or with the other effect, where it replaces one)."""

    def to_dict(self) -> dict[str, object]:
        """Return the step for `fit --json`."""
        return {
            "step": self.what,
            "effect": self.effect_id,
            "held_out_rmse_without_v": self.comparison.before_rmse_v,
            "held_out_rmse_with_v": self.comparison.after_rmse_v,
            "t_value": self.comparison.t_value,
            "t_needed": self.comparison.t_critical,
        }


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter of an effect."""

    name: str
    value: float
    std_error: float | None
    """None for a discrete choice and for a constant."""
    unit: str

    def to_dict(self) -> dict[str, object]:
        """Return value, standard error and unit."""
        return {"value": self.value, "std_error": self.std_error, "unit": self.unit}


@dataclass(frozen=True, eq=False)
class FittedEffects:
    """A model with effects, fitted to logs, and the search that selected them."""

    model: ExtendedModel
    linear: Linearization
    """At the model."""
    solution: Solution
    """Of the voltage model's coefficients; the effects' parameters are free too."""
    estimates: tuple[tuple[str, tuple[ParameterEstimate, ...]], ...]
    """Id and parameters of each effect, in the model's order."""
    held_out_error_v: tuple[FloatArray, ...]
    """Held-out errors of each log's rows [V]; NaN where no fold holds the row out."""
    held_out_rmse_v: tuple[float, float]
    """Without any effect, and with all of them [V]."""
    steps: tuple[SearchStep, ...]

    def remarks(self) -> list[str]:
        """Return remarks for the user on the selection and on active bounds."""
        before, after = self.held_out_rmse_v
        if not self.model.effects:
            return ["no effect reduces the held-out error significantly: none taken"]
        found = ["the slope resistance expected from the coefficients excludes the effects' part"]
        if LOGS_AT_LEAST <= len(self.held_out_error_v) < FEW_LOGS:
            found.append(
                f"the effects were selected on only {len(self.held_out_error_v)} logs held out in"
                " turn: give five or more for a reliable selection"
            )
        if after > before:
            found.append("the effects increase the held-out error: omit them")
        for item in self.linear.free:
            reach = AT_BOUND * (item.high - item.low)
            edge = {item.low: item.value - item.low, item.high: item.high - item.value}
            for bound, distance in edge.items():
                if distance <= reach:
                    effect = self.model.effects[item.effect][0]
                    found.append(f"{effect.id}: {item.name} lies at its bound of {bound:.4g}")
        return found

    def to_dict(self) -> dict[str, object]:
        """Return the part of `cangauge fit --json` on effects."""
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
    plain: ExtendedModel, logs: Sequence[SampledLog], ids: Sequence[str]
) -> FittedEffects:
    """Select effects and fit them jointly with the coefficients.

    Parameters
    ----------
    plain : ExtendedModel
        The fitted voltage model, without effects.
    logs : sequence of SampledLog
    ids : sequence of str
        From `parse_effect_ids`: `auto` alone, or effects that are all taken.

    Raises
    ------
    InputError
        If the logs are too short to hold rows out.
    """
    search = _Search(CrossValidation(logs))
    plain_errors = search.validation.errors(plain)
    if tuple(ids) == (AUTO,):
        model, errors = search.backward(*search.forward(plain, plain_errors))
    else:
        model, errors = search.named(plain, plain_errors, ids)
    if model.effects:
        _LOG.debug("effects: final joint fit")
        model = fit_extended(model, logs)
        errors = search.validation.errors(model)
    linear = linearize(model, logs)
    rows = [item.rows for item in logs]
    whole = solution_at(linear, block_numbers(rows, CLUSTER_S))
    n = model.model.coefficients.size
    ends = np.cumsum([len(item) for item in rows])[:-1]
    return FittedEffects(
        model=model,
        linear=linear,
        solution=whole.first(n),
        estimates=tuple(_estimates(linear, whole.std_error[n:])),
        held_out_error_v=tuple(np.split(errors.error_v, ends)),
        held_out_rmse_v=(plain_errors.rmse_v, errors.rmse_v),
        steps=tuple(search.steps),
    )


def _estimates(
    linear: Linearization, std_error: FloatArray
) -> list[tuple[str, tuple[ParameterEstimate, ...]]]:
    known = {
        (item.effect, item.name): float(error)
        for item, error in zip(linear.free, std_error, strict=True)
    }
    return [
        (
            effect.id,
            tuple(
                ParameterEstimate(
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


@dataclass(eq=False)
class _Trial:
    model: ExtendedModel
    errors: HeldOutErrors
    comparison: Comparison

    @property
    def rank(self) -> tuple[bool, float]:
        """The better the smaller."""
        return not self.comparison.is_significant, self.errors.rmse_v


class _Search:
    """Selection on one cross-validation; every decision goes into `steps`."""

    def __init__(self, validation: CrossValidation) -> None:
        self.validation = validation
        self.steps: list[SearchStep] = []

    def forward(
        self, model: ExtendedModel, errors: HeldOutErrors
    ) -> tuple[ExtendedModel, HeldOutErrors]:
        """Add effects as long as one is significantly better."""
        pool = [LIBRARY[effect_id] for effect_id in SEARCHED]
        while len(model.effects) < EFFECTS_AT_MOST:
            trials = [
                (trial, choice.effect.id)
                for choice in self._promising(model, pool)[:FITTED_PER_ROUND]
                if (trial := self._with(model, errors, choice)) is not None
            ]
            if not trials:
                break
            best, effect_id = min(trials, key=lambda item: item[0].rank)
            added = best.comparison.is_significant
            self._note("added" if added else "not added", effect_id, best.comparison)
            if not added:
                break
            model, errors = best.model, best.errors
        return model, errors

    def named(
        self, model: ExtendedModel, errors: HeldOutErrors, ids: Sequence[str]
    ) -> tuple[ExtendedModel, HeldOutErrors]:
        """Add all named effects, the most helpful first."""
        left = list(ids)
        while left:
            pool = [LIBRARY[effect_id] for effect_id in dict.fromkeys(left)]
            for choice in self._promising(model, pool):
                trial = self._with(model, errors, choice)
                if trial is not None:
                    break
            else:
                raise InputError(
                    "the model cannot be fitted with it", field="--effects", value=", ".join(left)
                )
            self._note("added", choice.effect.id, trial.comparison)
            model, errors = trial.model, trial.errors
            left.remove(choice.effect.id)
        return model, errors

    def backward(
        self, model: ExtendedModel, errors: HeldOutErrors
    ) -> tuple[ExtendedModel, HeldOutErrors]:
        """Remove effects without a significant contribution; try to replace the others."""
        for _ in range(EFFECTS_AT_MOST):
            if len(model.effects) < 2:
                break
            fewer = [self._without(model, errors, k) for k in range(len(model.effects))]
            least = min(fewer, key=lambda item: item.errors.rmse_v)
            if not least.comparison.is_significant:
                removed = model.effects[fewer.index(least)][0].id
                self._note("removed", removed, least.comparison)
                model, errors = least.model, least.errors
                continue
            exchanged = self._exchanged(model, errors, fewer)
            if exchanged is None:
                break
            model, errors = exchanged.model, exchanged.errors
        return model, errors

    def _without(self, model: ExtendedModel, errors: HeldOutErrors, number: int) -> _Trial:
        effect = model.effects[number][0]
        _LOG.debug("effects: fitting without %s", effect.id)
        kept = tuple(item for k, item in enumerate(model.effects) if k != number)
        without = fit_extended(
            replace(model, effects=kept), self.validation.logs, ROUGHLY_CONVERGED
        )
        without_errors = self.validation.errors(without)
        amplitudes = max(len(effect.amplitudes), 1)
        return _Trial(without, without_errors, compare(without_errors, errors, amplitudes))

    def _exchanged(
        self, model: ExtendedModel, errors: HeldOutErrors, fewer: Sequence[_Trial]
    ) -> _Trial | None:
        """Return the model with one effect replaced by a better one, or None.

        An effect added early may have represented later ones and need not be the best with them.
        """
        for (removed, _), without in zip(model.effects, fewer, strict=True):
            pool = [LIBRARY[effect_id] for effect_id in SEARCHED if effect_id != removed.id]
            for choice in self._promising(without.model, pool)[:1]:
                trial = self._with(without.model, errors, choice)
                if trial is not None and trial.comparison.is_worthwhile:
                    self._note(f"in place of {removed.id}", choice.effect.id, trial.comparison)
                    return trial
        return None

    def _note(self, what: str, effect_id: str, comparison: Comparison) -> None:
        self.steps.append(SearchStep(what, effect_id, comparison))
        _LOG.info(
            "effects: %s %s, held out %.3f V without, %.3f V with it",
            effect_id, what, comparison.before_rmse_v, comparison.after_rmse_v,
        )  # fmt: skip

    def _promising(self, model: ExtendedModel, pool: Sequence[Effect]) -> list[Candidate]:
        """Return each effect with its best shape, the most promising effect first."""
        _LOG.debug("effects: screening %d with %d taken", len(pool), len(model.effects))
        logs = self.validation.logs
        choices = [
            choice
            for choice in candidates(pool, model.pack, logs[0].log.time_s)
            if _is_addable(choice, model)
        ]
        if not choices:
            return []
        linear = linearize(model, logs)
        columns = _columns(linear, logs, choices)
        gains = self.validation.screen(linear, columns, [choice.bounds for choice in choices])
        best: dict[str, tuple[float, Candidate]] = {}
        for gain, choice in zip(gains, choices, strict=True):
            if choice.effect.id not in best or gain > best[choice.effect.id][0]:
                best[choice.effect.id] = gain, choice
        return [choice for _, choice in sorted(best.values(), key=lambda item: -item[0])]

    def _with(
        self, model: ExtendedModel, errors: HeldOutErrors, choice: Candidate
    ) -> _Trial | None:
        """Return the model fitted with one more effect; None if the fit fails."""
        _LOG.debug("effects: fitting with %s", choice.effect.id)
        start = choice.values(choice.steps)  # small amplitudes, so that the shapes matter
        try:
            extended = model.with_effect(choice.effect, start)
            extended = fit_extended(extended, self.validation.logs, ROUGHLY_CONVERGED)
            # Two copies may have merged, or bounds relative to the resistance have been left.
            parse_effects(effect_entries(extended.effects), extended.pack)
        except CangaugeError:
            return None
        with_errors = self.validation.errors(extended)
        return _Trial(extended, with_errors, compare(errors, with_errors, len(choice.amplitudes)))


def _columns(
    linear: Linearization, logs: Sequence[SampledLog], choices: Sequence[Candidate]
) -> list[FloatArray]:
    smooth = [with_modelled_voltage(item, linear.model) for item in logs]
    residuals = [residual(item, linear.model) for item in smooth]
    return [
        np.vstack(
            [
                effect_columns(item, linear.model, choice, residual_v)
                for item, residual_v in zip(smooth, residuals, strict=True)
            ]
        )
        for choice in choices
    ]


def _is_addable(choice: Candidate, model: ExtendedModel) -> bool:
    """Return whether a candidate differs enough from the effects in the model."""
    values = choice.values(choice.steps)
    copies = [taken for effect, taken in model.effects if effect.id == choice.effect.id]
    if len(copies) >= COPIES_AT_MOST or (copies and not choice.shape):
        return False
    key = shape_key(choice.effect, values)
    return all(
        key != shape_key(choice.effect, taken) and _has_other_tau(values, taken) for taken in copies
    )


def _has_other_tau(one: Values, other: Values) -> bool:
    if "tau_s" not in one:
        return True
    ratio = one["tau_s"] / other["tau_s"]
    return max(ratio, 1.0 / ratio) >= TAU_RATIO_AT_LEAST
