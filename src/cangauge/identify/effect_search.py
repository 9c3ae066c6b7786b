"""Which effects a fit may look for, and what a user may name.

Which effects clean logs show: forward selection, shapes moved, and a backward pass.

Forward: every effect with every value of its shapes is weighed by a linear step on the folds; the
most promising are fitted together with all that is there, on the model's own equations, and the
better one is taken if it is so by more than chance (`judge`). Backward: an effect whose removal
costs no more than chance goes, the least missed first; and each is weighed against the best other
one in its place.

Effects fitted to logs, with standard errors and what each was worth on logs left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import CangaugeError, InputError
from cangauge.identify.cross_validation import Comparison, Judge, Judged, compare
from cangauge.identify.linearized import (
    ROUGHLY_CONVERGED,
    Linear,
    Prepared,
    as_modelled,
    effect_columns,
    linearise,
    refine,
    residual_of,
    solution_at,
)
from cangauge.identify.rows import LOGS_AT_LEAST
from cangauge.identify.voltage_fit import blocks_of
from cangauge.inference.least_squares import Solution
from cangauge.model.effects.base import Effect, Values
from cangauge.model.effects.library import (
    LIBRARY,
    Candidate,
    candidates,
    effect_entries,
    effect_of,
    one_of,
    parse_effects,
)
from cangauge.model.extended import ExtendedModel

# --- Which effects a fit may look for, and what a user may name

AUTO = "auto"

CLEAN = (
    "resistance_temperature", "resistance_soc", "resistance_asymmetry", "charge_transfer",
    "fast_polarization", "slow_diffusion", "hysteresis", "entropic_coefficient",
    "temperature_lag", "core_temperature",
)  # fmt: skip
"""Structure that a clean pack may well have and the coefficients lack: what `auto` tries."""

REFUSED = {
    "initial_soc": "it belongs to one log: give --initial-soc",
    "resistance_step": "it belongs to one log: a clean pack has none",
    "capacity": "give --capacity-ah; the curve over SoC follows it",
    "current_gain": "resistances and capacity hold it: give --capacity-ah",
    "voltage_offset": "k0 holds it",
    "voltage_gain": "the coefficients hold it",
}
"""Effects that a fit cannot tell from its own numbers, and why."""

TWICE = 2
"""So often one effect may be taken, with different shapes: a chain of RC elements."""


def parse_ids(given: Sequence[str]) -> tuple[str, ...]:
    """Return effect ids from options that may hold several, separated by commas.

    Raises
    ------
    InputError
        If an id is unknown, cannot be told from the coefficients, is there too often, or stands
        beside `auto`.
    """
    ids = [part.strip() for text in given for part in text.split(",")]
    if ids == [AUTO]:
        return (AUTO,)
    if AUTO in ids:
        raise InputError(
            "auto chooses by itself", field="--effects", value=", ".join(ids),
            cure="give auto alone, or ids alone",
        )  # fmt: skip
    for effect_id in ids:
        effect_of(effect_id, "--effects")
        if effect_id in REFUSED:
            raise InputError(
                "a fit on clean logs cannot find it",
                field="--effects",
                value=effect_id,
                cure=REFUSED[effect_id],
            )
        often = TWICE if LIBRARY[effect_id].shapes and LIBRARY[effect_id].amplitudes else 1
        if ids.count(effect_id) > often:
            raise InputError(
                f"may be there {'twice' if often == TWICE else 'once'}",
                field="--effects",
                value=", ".join(ids),
            )
    return tuple(ids)


# --- Which effects clean logs show: forward selection, shapes moved, and a backward pass

Progress = Callable[[str], None]

EFFECTS_AT_MOST = 8
APART = 2.0
"""Two elements of one effect differ in their time constants by this factor at least."""

TRIES = 2
"""So many of the most promising effects of a round are fitted in full; the better one counts."""


@dataclass(frozen=True)
class Step:
    """One effect taken, or left out again."""

    what: str
    """`added`, `not added`, `removed`, or `in place of` another."""
    effect_id: str
    comparison: Comparison
    """Against the model without it (with the other, where it takes its place)."""

    def to_dict(self) -> dict[str, object]:
        """Return the step as `fit --json` prints it."""
        return {
            "step": self.what,
            "effect": self.effect_id,
            "held_out_rmse_without_v": self.comparison.before_rmse_v,
            "held_out_rmse_with_v": self.comparison.after_rmse_v,
            "t_value": self.comparison.t_value,
            "t_needed": self.comparison.needed,
        }


@dataclass(frozen=True, eq=False)
class Found:
    """The model with the effects that were found."""

    model: ExtendedModel
    judged: Judged
    plain: Judged
    """Of the model without effects."""
    steps: tuple[Step, ...]


def find_effects(
    plain: ExtendedModel,
    logs: Sequence[Prepared],
    ids: Sequence[str],
    say: Progress,
) -> Found:
    """Return the model with the effects that the logs show, or that were named.

    Parameters
    ----------
    plain : ExtendedModel
        The fitted voltage model, without effects.
    logs : sequence of Prepared
    ids : sequence of str
        From `ids.parse_ids`: `auto`, or effects that are all taken, whatever they bring.
    say : callable
        Called with a line of text before each long step.

    Raises
    ------
    InputError
        If the logs are too short to judge anything.
    """
    judge = Judge(logs)
    search = _Search(judge, judge(plain), say)
    if tuple(ids) == (AUTO,):
        model, judged = search.forward(plain, search.plain)
        model, judged = search.backward(model, judged)
    else:
        model, judged = search.named(plain, search.plain, ids)
    if model.effects:
        say("effects: fitting all of them once more")
        model = refine(model, logs)
        judged = judge(model)
    return Found(model, judged, search.plain, tuple(search.steps))


@dataclass(eq=False)
class _Tried:
    model: ExtendedModel
    judged: Judged
    comparison: Comparison

    @property
    def order(self) -> tuple[bool, float]:
        """The better the smaller."""
        return not self.comparison.better, self.judged.rmse_v


class _Search:
    def __init__(self, judge: Judge, plain: Judged, say: Progress) -> None:
        self.judge = judge
        self.plain = plain
        self.steps: list[Step] = []
        self._say = say

    def forward(self, model: ExtendedModel, judged: Judged) -> tuple[ExtendedModel, Judged]:
        """Take effects as long as one is better by more than chance."""
        pool = [LIBRARY[effect_id] for effect_id in CLEAN]
        while len(model.effects) < EFFECTS_AT_MOST:
            best: tuple[Candidate, _Tried] | None = None
            for choice in self._promising(model, pool)[:TRIES]:
                tried = self._with(model, judged, choice)
                if tried is None:
                    continue
                if best is None or tried.order < best[1].order:
                    best = choice, tried
            if best is None:
                break
            choice, tried = best
            # The better one of those tried, and only if it is so by more than chance.
            taken = tried.comparison.better
            self._note("added" if taken else "not added", choice.effect.id, tried.comparison)
            if not taken:
                break
            model, judged = tried.model, tried.judged
        return model, judged

    def named(
        self, model: ExtendedModel, judged: Judged, ids: Sequence[str]
    ) -> tuple[ExtendedModel, Judged]:
        """Take all effects that were named, the most helpful first."""
        left = list(ids)
        while left:
            pool = [LIBRARY[effect_id] for effect_id in dict.fromkeys(left)]
            for choice in self._promising(model, pool):
                tried = self._with(model, judged, choice)
                if tried is not None:
                    break
            else:
                raise InputError(
                    "the model cannot be fitted with it", field="--effects", value=", ".join(left)
                )
            self._note("added", choice.effect.id, tried.comparison)
            model, judged = tried.model, tried.judged
            left.remove(choice.effect.id)
        return model, judged

    def backward(self, model: ExtendedModel, judged: Judged) -> tuple[ExtendedModel, Judged]:
        """Leave out effects whose removal costs no more than chance; try others in their place."""
        for _ in range(EFFECTS_AT_MOST):
            if len(model.effects) < 2:
                break
            fewer = [self._without(model, judged, k) for k in range(len(model.effects))]
            least = min(fewer, key=lambda item: item.judged.rmse_v)
            if not least.comparison.better:
                gone = model.effects[fewer.index(least)][0].id
                self._note("removed", gone, least.comparison)
                model, judged = least.model, least.judged
                continue
            exchanged = self._exchanged(model, judged, fewer)
            if exchanged is None:
                break
            model, judged = exchanged.model, exchanged.judged
        return model, judged

    def _without(self, model: ExtendedModel, judged: Judged, number: int) -> _Tried:
        self._say(f"effects: without {model.effects[number][0].id}")
        kept = tuple(item for k, item in enumerate(model.effects) if k != number)
        without = refine(replace(model, effects=kept), self.judge.logs, ROUGHLY_CONVERGED)
        seen = self.judge(without)
        amplitudes = _amplitudes(model.effects[number][0])
        return _Tried(without, seen, compare(seen, judged, amplitudes))

    def _exchanged(
        self, model: ExtendedModel, judged: Judged, fewer: Sequence[_Tried]
    ) -> _Tried | None:
        """Return the model with one effect in the place of another, if that is better.

        What was taken first stood in for what came later; it need not be the best beside it.
        """
        for (gone, _), without in zip(model.effects, fewer, strict=True):
            pool = [LIBRARY[effect_id] for effect_id in CLEAN if effect_id != gone.id]
            for choice in self._promising(without.model, pool)[:1]:
                tried = self._with(without.model, judged, choice)
                if tried is not None and tried.comparison.worth_it:
                    self._note(f"in place of {gone.id}", choice.effect.id, tried.comparison)
                    return tried
        return None

    def _note(self, what: str, effect_id: str, found: Comparison) -> None:
        self.steps.append(Step(what, effect_id, found))
        self._say(
            f"effects: {effect_id} {what}, held out {found.before_rmse_v:.3f} V without,"
            f" {found.after_rmse_v:.3f} V with it"
        )

    def _promising(self, model: ExtendedModel, pool: Sequence[Effect]) -> list[Candidate]:
        """Return each effect with its best shape, the most promising effect first."""
        self._say(f"effects: weighing {len(pool)} beside {len(model.effects)} taken")
        logs = self.judge.logs
        choices = [
            choice
            for choice in candidates(pool, model.pack, logs[0].log.time_s)
            if _beside(choice, model)
        ]
        if not choices:
            return []
        linear = linearise(model, logs)
        columns = _columns(linear, logs, choices)
        gains = self.judge.screen(linear, columns, [choice.bounds for choice in choices])
        best: dict[str, tuple[float, Candidate]] = {}
        for gain, choice in zip(gains, choices, strict=True):
            if choice.effect.id not in best or gain > best[choice.effect.id][0]:
                best[choice.effect.id] = gain, choice
        return [choice for _, choice in sorted(best.values(), key=lambda item: -item[0])]

    def _with(self, model: ExtendedModel, judged: Judged, choice: Candidate) -> _Tried | None:
        """Return the model fitted with one more effect; None if it cannot be."""
        self._say(f"effects: fitting {choice.effect.id} with the others")
        start = choice.values(_inside(choice))
        try:
            with_it = model.with_effect(choice.effect, start)
            more = refine(with_it, self.judge.logs, ROUGHLY_CONVERGED)
            # Two elements may have become one, or bounds that follow the resistance left behind.
            parse_effects(effect_entries(more.effects), more.pack)
        except CangaugeError:
            return None
        seen = self.judge(more)
        return _Tried(more, seen, compare(judged, seen, len(choice.amplitudes)))


def _amplitudes(effect: Effect) -> int:
    return max(len(effect.amplitudes), 1)


def _inside(choice: Candidate) -> FloatArray:
    """Return amplitudes to start from: small ones, so that the shapes already tell."""
    return choice.steps


def _columns(
    linear: Linear, logs: Sequence[Prepared], choices: Sequence[Candidate]
) -> list[FloatArray]:
    smooth = [as_modelled(item, linear.model) for item in logs]
    here = [residual_of(linear.model, [item]) for item in smooth]
    return [
        np.vstack(
            [
                effect_columns(item, linear.model, choice, at)
                for item, at in zip(smooth, here, strict=True)
            ]
        )
        for choice in choices
    ]


def _beside(choice: Candidate, model: ExtendedModel) -> bool:
    """Return whether a candidate is another one than the effects that the model has."""
    values = choice.values(_inside(choice))
    alike = [taken for effect, taken in model.effects if effect.id == choice.effect.id]
    if len(alike) >= TWICE or (alike and not choice.shape):
        return False
    own = one_of(choice.effect, values)
    return all(own != one_of(choice.effect, taken) and _apart(values, taken) for taken in alike)


def _apart(one: Values, other: Values) -> bool:
    if "tau_s" not in one:
        return True
    ratio = one["tau_s"] / other["tau_s"]
    return max(ratio, 1.0 / ratio) >= APART


# --- Effects fitted to logs, with standard errors and what each was worth on logs left out

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
