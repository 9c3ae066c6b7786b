"""How much the structure that all logs share, and what is each log's own, may take.

A level for every effect, under which the references are most probable (an automatic relevance
determination: MacKay, Neural Computation 4 (1992) 415). A pack that obeys the model shows no
structure, and one that shows a piece of it need not show the others: what is looked for in vain
costs certainty elsewhere, and goes astray where no reference has been.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cangauge.gap.columns import LEVELS
from cangauge.gap.evidence import (
    ErrorModel,
    Gram,
    gather,
    log_integral,
    log_likelihood,
    structure_precision,
)
from cangauge.gap.frame import Frame

FloatArray = NDArray[np.float64]

STRUCTURE_ROUNDS = 2
"""So often each piece is looked at beside the others."""

STRUCTURE_LEVELS: tuple[float, ...] = (0.001, 0.03, 0.1, 0.3, 1.0)
"""How much of its physical range a piece of structure may take."""

OWN_LEVELS: tuple[float, ...] = (0.001, *np.logspace(-1.75, -0.5, 6).tolist())
"""By how much less than is usual logs of one pack may differ, in all ways at once. Not by more: all
effects together can mimic nearly any error of the model, and what differs from log to log in all
ways would hide every cause; how far references stray (`with_strays`) guards against those."""

OWN_LEVEL_SPREAD = 1.0
"""Standard deviation, before references were seen, of that level's logarithm."""

OWN_EACH: tuple[float, ...] = (0.3, 2.0, 4.0)
OWN_EACH_SPREAD = 1.0
"""By how much one effect's own may differ more, or less, than that of all, and the standard
deviation of that level's logarithm before references were seen."""


def structure_levels(frame: Frame, grams: Sequence[Gram], error: ErrorModel) -> dict[str, float]:
    """Return the levels of shared structure under which the references are most probable.

    That of all at once, then that of each effect beside the others: what one piece needs would
    leave all others free to go astray where no reference has been.
    """
    whole = gather(frame, grams, [], error)
    p = frame.scale.size
    at = p + np.arange(whole.mean.size - p)
    right = whole.precision @ whole.mean
    held = structure_precision(frame, error)

    def log_probability(levels: dict[str, float]) -> float:
        prior = structure_precision(frame, replace(error, structure=levels))
        precision = whole.precision.copy()
        precision[at, at] += prior - held
        return log_integral(precision, right) + 0.5 * float(np.sum(np.log(prior)))

    pieces = list(error.structure)
    if not pieces:
        return {}
    together = [dict.fromkeys(pieces, level) for level in STRUCTURE_LEVELS]
    best, levels = _most_probable(together, log_probability)
    for _ in range(STRUCTURE_ROUNDS):
        before = levels
        for piece in pieces:
            others = [level for level in STRUCTURE_LEVELS if level != levels[piece]]
            trials = [{**levels, piece: level} for level in others]
            chance, trial = _most_probable(trials, log_probability)
            if chance > best:
                best, levels = chance, trial
        if levels == before:
            break
    return levels


def _most_probable(
    trials: Sequence[dict[str, float]], log_probability: Callable[[dict[str, float]], float]
) -> tuple[float, dict[str, float]]:
    """Return the largest log probability, and what has it."""
    chances = [log_probability(trial) for trial in trials]
    at = int(np.argmax(chances))
    return chances[at], trials[at]


def own_level(
    frame: Frame, grams: Sequence[Gram], error: ErrorModel, usual: FloatArray
) -> tuple[float, ...]:
    """Return what is usual of a log's own times the level under which the logs are most probable.

    Few logs say little of one way to differ, but much of all ways together.
    """

    def log_probability(level: float) -> float:
        found = replace(error, own_std=tuple((level * usual).tolist()))
        known = -0.5 * (np.log(level) / OWN_LEVEL_SPREAD) ** 2
        return log_likelihood(frame, grams, found) + float(known)

    return tuple((max(OWN_LEVELS, key=log_probability) * usual).tolist())


def own_levels(frame: Frame, grams: Sequence[Gram], error: ErrorModel) -> tuple[float, ...]:
    """Return a log's own with a level for every effect, each with the others at theirs."""
    own_std = np.array(error.own_std)
    best = log_likelihood(frame, grams, error)
    for at in _own_by_effect(frame):
        here = own_std.copy()
        for level in OWN_EACH:
            trial = own_std.copy()
            trial[at] *= level
            found = replace(error, own_std=tuple(trial.tolist()))
            known = -0.5 * float(np.log(level) / OWN_EACH_SPREAD) ** 2
            chance = log_likelihood(frame, grams, found) + known
            if chance > best:
                best, here = chance, trial
        own_std = here
    return tuple(own_std.tolist())


def _own_by_effect(frame: Frame) -> list[NDArray[np.intp]]:
    """Return where each effect's own amplitudes are, and each of `columns.LEVELS`."""
    places: dict[str, list[int]] = {}
    at = 0
    for k in frame.own:
        choice = frame.choices[k]
        of_one = places.setdefault(choice.effect.id, [])
        of_one += range(at, at + len(choice.amplitudes))
        at += len(choice.amplitudes)
    groups = [*places.values(), *([at + k] for k in range(len(LEVELS)))]
    return [np.array(group, dtype=np.intp) for group in groups]
