"""Which effects clean logs show: forward selection, shapes moved, and a backward pass.

Forward: every effect with every value of its shapes is weighed by a linear step on the folds; the
most promising are fitted together with all that is there, on the model's own equations, and the
better one is taken if it is so by more than chance (`judge`). Backward: an effect whose removal
costs no more than chance goes, the least missed first; and each is weighed against the best other
one in its place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cangauge.errors import CangaugeError, InputError
from cangauge.identify.effects.ids import AUTO, CLEAN, TWICE
from cangauge.identify.effects.judge import Comparison, Judge, Judged, compare
from cangauge.identify.effects.linear import (
    ROUGHLY_CONVERGED,
    FloatArray,
    Linear,
    linearise,
    refine,
    residual_of,
)
from cangauge.identify.effects.prepared import Prepared, as_modelled, effect_columns
from cangauge.model.effects.candidate import Candidate, candidates
from cangauge.model.effects.effect import Effect, Values
from cangauge.model.effects.library import LIBRARY, effect_entries, one_of, parse_effects
from cangauge.model.extended import ExtendedModel

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
