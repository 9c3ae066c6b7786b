"""How much the structure that all logs share, and what is each log's own, may take.

A level for every effect, under which the references are most probable (an automatic relevance
determination: MacKay, Neural Computation 4 (1992) 415). A pack that obeys the model shows no
structure, and one that shows a piece of it need not show the others: what is looked for in vain
costs certainty elsewhere, and goes astray where no reference has been.

What reference logs say: how far the model strays without a cause.

Everything is judged on whole logs left out: each reference is seen with the coefficients that the
others (and the model's own information) leave open, and what then remains is the error, scale by
scale, and what is each log's own. Without at least two references the model file's own noise
stands in.

Which pieces of the structure that clean logs share a model needs.

The verdict integrates over all of them; a model that somebody reads and a service runs has few.

The model as references know it, and their columns about it.

Structure acts on what coefficients multiply: a core that is warmer than its sensor shows as kt
times its rise, so both cannot be solved for at once from columns of a model with another kt. They
are solved for again about what was found (Gauss-Newton), until the references are no less probable
than they seemed from where it began.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.diagnosis.bayes_factors import kept_v2
from cangauge.diagnosis.design_matrix import LEVELS, DesignMatrix, design_matrix, own_choices
from cangauge.diagnosis.hypotheses import Frame
from cangauge.diagnosis.linear_gaussian import (
    ErrorModel,
    Gram,
    gather,
    gram_of,
    information_of,
    log_integral,
    log_likelihood,
    moved,
    prior_precision,
    structure_precision,
    within_bounds,
)
from cangauge.inference.rows import SampledLog
from cangauge.inference.time_scales import SCALES, scale_variances
from cangauge.model.effects.library import Candidate
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import ModelNoise

# --- How much the structure that all logs share, and what is each log's own, may take

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


# --- What reference logs say: how far the model strays without a cause

ROUNDS = 4

KNOWN_LOGS = 0.05
"""What the model file says of the error counts like so much of a reference log. That error was
judged on logs left out of a fit to a few, so it may be many times too large."""

KNOWN_COEFFICIENTS = 2.0
"""So many coefficients are taken to agree with the model file, beside those that are looked at."""

TRUSTS: tuple[float, ...] = tuple(np.logspace(-7.0, 0.0, 29).tolist())
"""Weights of the model file's information to choose from."""

LEAST_TRUST_BEYOND = 0.1
"""At temperatures that no reference has, the model file is all that there is: it keeps this."""

FEW = 2.0
"""Chance on few references: a mean of n squares is taken to be low by this over n."""

LEAST = 1e-4
"""No scale's variance is below this part of the largest."""


def error_from_noise(noise: ModelNoise, rate_hz: float, frame: Frame) -> ErrorModel:
    """Return the error that a model file states, for want of references."""
    slow_v2, fast_v2 = noise.slow_std_v**2, noise.fast_std_v**2
    total_v2 = max(slow_v2 + fast_v2, 1e-12)
    variance = scale_variances(
        fast_v2, noise.fast_time_s * rate_hz, slow_v2, noise.slow_time_s * rate_hz
    )
    return ErrorModel(
        scale_v2=_positive(variance),
        own_std=tuple(frame.own_prior.tolist()),
        rmse_v=float(np.sqrt(total_v2)),
    )


def error_from_references(
    frame: Frame, grams: Sequence[Gram], stated: ErrorModel, least_trust: float = 0.0
) -> ErrorModel:
    """Return the error under which each reference is most probable, given the others.

    Expectation maximisation on the variance of every scale, in which what `stated` says counts like
    `KNOWN_LOGS` logs, in turn with the levels of the structure that all share and of all that is a
    log's own (`levels`); then the level of each effect's own. Structure and own begin at next to
    nothing and grow where the references need them.

    Parameters
    ----------
    frame : Frame
    grams : sequence of Gram
        Of the references, two at least.
    stated : ErrorModel
    least_trust : float
        The model file is trusted at least so far.
    """
    usual = np.array(stated.own_std)
    pieces = dict.fromkeys(frame.choices[k].effect.id for k in frame.repairs)
    error = replace(
        stated,
        structure=dict.fromkeys(pieces, STRUCTURE_LEVELS[0]),
        own_std=tuple((OWN_LEVELS[0] * usual).tolist()),
    )
    # What all references share comes first, or it is taken for what differs from log to log: under
    # information that is too sure the differences grow until they explain it, and it stays so.
    error = replace(error, trust=_trust(frame, grams, error, least_trust))
    known_v2 = np.array(stated.scale_v2)
    counts = np.sum([gram.counts for gram in grams], axis=0)
    known = KNOWN_LOGS * counts / len(grams) + 1e-9
    for _ in range(ROUNDS):
        seen = [_left_out(frame, grams, k, error) for k in range(len(grams))]
        variance = (np.sum(seen, axis=0) + known * known_v2) / (counts + known)
        error = replace(
            error,
            scale_v2=_positive(variance),
            rmse_v=float(np.sqrt(np.sum(counts * variance) / np.sum(counts))),
        )
        error = replace(error, trust=_trust(frame, grams, error, least_trust))
        error = replace(error, structure=structure_levels(frame, grams, error))
        error = replace(error, own_std=own_level(frame, grams, error, usual))
    return replace(error, own_std=own_levels(frame, grams, error))


def with_strays(
    frame: Frame,
    grams: Sequence[Gram],
    error: ErrorModel,
    covered: Sequence[float] = (),
    judged: Sequence[Gram] = (),
) -> ErrorModel:
    """Return the error with how far references stray that are diagnosed like the logs.

    A voltage model that lacks something shows it as if it were an effect, more on one day than on
    another. Each reference is diagnosed with the others as references; the mean of its squared
    evidence over what chance would give is what that effect's evidence must be divided by (a
    quasi-likelihood, McCullagh, Nelder, Generalized Linear Models, 2nd ed. 1989, ch. 9).

    Parameters
    ----------
    frame : Frame
    grams : sequence of Gram
        Of the references, two at least.
    error : ErrorModel
        From `error_from_references`.
    covered : sequence of float, optional
        How much each reference counts: the part of it that lies where the others have been.
    judged : sequence of Gram, optional
        What of each reference is diagnosed, if not the whole.
    """
    weights = np.array(covered) if len(covered) else np.ones(len(grams))
    shown = frame.shown
    few = replace(
        frame,
        choices=tuple(frame.choices[k] for k in shown),
        repairs=tuple(range(len(frame.repairs))),
        own=tuple(range(len(frame.repairs), len(shown))),
    )
    squares: dict[str, list[float]] = {}
    kept = []
    for number, gram in enumerate(judged or grams):
        others = [item for k, item in enumerate(grams) if k != number]
        evidence = gather(few, others, [gram], error)
        without = gather(few, others, [], error)
        kept.append(kept_v2(few, gram, without.mean))
        for k, choice in enumerate(few.choices):
            at = evidence.of(k)
            prior = prior_precision(choice.bounds)
            total = evidence.curvature[at, at] + 1e-6 * prior
            chance = float(np.trace(np.linalg.solve(total, evidence.curvature[at, at])))
            square = float(evidence.gradient[at] @ np.linalg.solve(total, evidence.gradient[at]))
            squares.setdefault(choice.effect.id, []).append(square / max(chance, 1e-9))
    few_logs = 1.0 + FEW / float(weights.sum())
    worth = {}
    for key, seen in squares.items():  # all shapes of the first reference, then of the second …
        each = np.reshape(seen, (len(grams), -1)).mean(axis=1)
        worth[key] = max(1.0, few_logs * float(np.average(each, weights=weights)))
    # A model that strays in some ways will stray in others too, on a day that nobody has seen.
    # (The median: one way to stray, however far, says nothing of a quite different one.)
    usual = float(np.median([*worth.values()]))
    worth = {key: max(value, usual) for key, value in worth.items()}
    return replace(error, strays=worth, clean_v2=float(np.average(kept, weights=weights)))


def _trust(frame: Frame, grams: Sequence[Gram], error: ErrorModel, least: float) -> float:
    """Return how far the references bear out the model file's information (`ErrorModel.trust`).

    It says where the coefficients are, and how surely. If the references put them ten times further
    away than it says they may lie, it counts for about a hundredth: the weight under which the
    references are most probable, everything else integrated out.
    """
    p = frame.scale.size
    if frame.prior_root is None:
        return 1.0
    found = gather(frame, grams, [], error)
    right = found.precision @ found.mean
    whole = information_of(frame, replace(error, trust=1.0))
    centre = np.zeros(p) if frame.centre is None else frame.centre

    def log_probability(trust: float) -> float:
        precision, toward = found.precision.copy(), right.copy()
        precision[:p, :p] += (trust - error.trust) * whole
        toward[:p] += (trust - error.trust) * whole @ centre
        agreed = KNOWN_COEFFICIENTS * (np.log(trust) - trust)
        held = p * np.log(trust) - trust * centre @ whole @ centre
        return log_integral(precision, toward) + 0.5 * float(held + agreed)

    return max((trust for trust in TRUSTS if trust >= least), key=log_probability)


def _left_out(frame: Frame, grams: Sequence[Gram], number: int, error: ErrorModel) -> FloatArray:
    """Return the expected squares of one reference's error, summed over each scale [V²]."""
    others = gather(frame, [gram for k, gram in enumerate(grams) if k != number], [], error)
    shared, own = others.mean.size, frame.reference.own
    prior = np.zeros((shared + own.size, shared + own.size))
    prior[:shared, :shared] = others.precision
    prior[own, own] = np.array(error.own_std) ** -2.0
    log = grams[number]
    data = log.weighed(error)[:-1, :-1]
    toward = log.weighed(error)[:-1, -1]
    centre = np.concatenate((others.mean, np.zeros(own.size)))
    spread = _inverse(prior + data)
    mean = spread @ (prior @ centre + toward)
    squares = np.empty(SCALES)
    for j, products in enumerate(log.products):
        block = products[:-1, :-1]
        squares[j] = (
            products[-1, -1]
            - 2.0 * mean @ products[:-1, -1]
            + mean @ block @ mean
            + np.sum(block * spread)
        )
    return np.maximum(squares, 0.0)


def _inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse, balanced by the diagonal."""
    balance = 1.0 / np.sqrt(np.diag(matrix))
    inverse = np.linalg.inv(matrix * balance * balance[:, None])
    return np.asarray(inverse * balance * balance[:, None])


def _positive(variance: FloatArray) -> tuple[float, ...]:
    least = max(LEAST * float(variance.max()), 1e-12)
    return tuple(np.maximum(variance, least).tolist())


# --- Which pieces of the structure that clean logs share a model needs

WORTH_IT = 3.0
"""A further piece must make the references more probable by this, as a logarithm."""

NEGLIGIBLE = 1e-3
"""A piece smaller than this part of its bounds is left out."""

AT_MOST = 14
"""Pieces: more made no difference that was measured."""


def needed(frame: Frame, references: Sequence[Gram], error: ErrorModel) -> tuple[int, ...]:
    """Return the pieces without which the references are less probable, the most needed first.

    Added one by one, each the one that makes the references most probable beside those before it,
    with all amplitudes and coefficients integrated out.

    Parameters
    ----------
    frame : Frame
    references : sequence of Gram
    error : ErrorModel
    """
    whole = gather(frame, references, [], error)
    right = whole.precision @ whole.mean
    prior = structure_precision(frame, error)
    p = frame.scale.size
    ends = _ends(frame)

    def log_probability(pieces: Sequence[int]) -> float:
        of_pieces = [np.arange(*ends[j]) for j in pieces]
        at = np.concatenate([np.arange(p), *of_pieces])
        held = 0.5 * float(np.sum(np.log(prior[at[p:] - p])))
        return log_integral(whole.precision[np.ix_(at, at)], right[at]) + held

    chosen: list[int] = []
    best = log_probability(chosen)
    while len(chosen) < min(AT_MOST, len(frame.repairs)):
        rest = [j for j in range(len(frame.repairs)) if j not in chosen]
        chances = [log_probability([*chosen, j]) for j in rest]
        if max(chances) < best + WORTH_IT:
            break
        best = max(chances)
        chosen.append(rest[int(np.argmax(chances))])
    return tuple(frame.repairs[j] for j in chosen)


def with_pieces(model: ExtendedModel, frame: Frame, amplitudes: FloatArray) -> ExtendedModel:
    """Return a model with the pieces of structure that are not negligible.

    Parameters
    ----------
    model : ExtendedModel
    frame : Frame
        Whose `repairs` are the pieces.
    amplitudes : array
        Of all pieces, in order, beside the neutral ones.
    """
    at = 0
    totals: dict[tuple[object, ...], tuple[Candidate, FloatArray]] = {}
    for k in frame.repairs:
        choice = frame.choices[k]
        amplitude = amplitudes[at : at + len(choice.amplitudes)]
        at += amplitude.size
        # Columns of one shape differ in how large the effect is that they were taken of.
        key = (choice.effect.id, *choice.shape.items())
        totals[key] = (choice, amplitude + (totals[key][1] if key in totals else 0.0))
    for choice, total in totals.values():
        low, high = choice.bounds[:, 0], choice.bounds[:, 1]
        amplitude = np.clip(total, low, high)
        if np.any(np.abs(amplitude) > NEGLIGIBLE * (high - low)):
            # The pack's sizes move with the coefficients, and a file must agree with them.
            values = choice.effect.clipped(choice.values(amplitude), model.pack)
            model = model.with_effect(choice.effect, values)
    return model


def repaired(
    model: ExtendedModel, frame: Frame, references: Sequence[Gram], error: ErrorModel
) -> ExtendedModel | None:
    """Return the model with the coefficients and the structure that the references call for.

    Parameters
    ----------
    model : ExtendedModel
        That the references' columns were taken of.
    frame : Frame
    references : sequence of Gram
    error : ErrorModel

    Returns
    -------
    ExtendedModel or None
        None if its pseudo-OCV would not rise.
    """
    pieces = needed(frame, references, error)
    whole = gather(frame, references, [], error)
    p = frame.scale.size
    ends = dict(zip(frame.repairs, _ends(frame), strict=True))
    at = np.concatenate([np.arange(p), *(np.arange(*ends[k]) for k in pieces)])
    precision = whole.precision[np.ix_(at, at)]
    balance = 1.0 / np.sqrt(np.diag(precision))
    right = (whole.precision @ whole.mean)[at]
    mean = balance * np.linalg.solve(precision * balance * balance[:, None], balance * right)
    few = replace(
        whole,
        frame=replace(frame, repairs=pieces),
        precision=precision,
        mean=mean,
        per_amplitude=whole.per_amplitude[at],
    )
    solution, _ = within_bounds(few, model.model, [])
    voltage_model = moved(model.model, solution[:p])
    if voltage_model is None:
        return None
    return with_pieces(replace(model, model=voltage_model), few.frame, solution[p:])


def _ends(frame: Frame) -> list[tuple[int, int]]:
    """Return where each piece's amplitudes begin and end in a solution."""
    widths = [len(frame.choices[k].amplitudes) for k in frame.repairs]
    ends = frame.scale.size + np.cumsum([0, *widths])
    return list(itertools.pairwise(ends.tolist()))


# --- The model as references know it, and their columns about it

MOST_STEPS = 3
"""Where they are not after so many, the step after which they are most probable is taken."""


@dataclass(frozen=True, eq=False)
class Learned:
    """A model with what references teach, and the references seen by it."""

    model: ExtendedModel
    """With their coefficients, without structure."""
    acting: ExtendedModel | None
    """With the structure that they call for; None if its pseudo-OCV would not rise."""
    frame: Frame
    references: tuple[DesignMatrix, ...]
    grams: tuple[Gram, ...]


def learn(
    references: Sequence[SampledLog],
    model: ExtendedModel,
    frame: Frame,
    grams: Sequence[Gram],
    error: ErrorModel,
) -> Learned:
    """Return what the references teach.

    Parameters
    ----------
    references : sequence of SampledLog
    model : ExtendedModel
    frame : Frame
    grams : sequence of Gram
        Of the references' columns of the model.
    error : ErrorModel
    """
    wanted, most = log_likelihood(frame, grams, error) - WORTH_IT, -np.inf
    # The coefficients first: a rise is as much too large in the columns as kt is too small.
    last = found = _moved(references, Learned(model, None, frame, (), tuple(grams)), error)
    for left in reversed(range(MOST_STEPS)):
        step = _step(references, last, error)
        here = log_likelihood(step.frame, step.grams, error)
        if here >= wanted or (here > most and left == 0):
            return step
        last = replace(step, references=())
        del step  # columns of long references fill hundreds of megabytes: one set at a time
        if here > most:
            found, most = last, here
    terms = reference_terms(references, found.model, found.frame, found.acting)
    return replace(found, references=terms)


def _moved(references: Sequence[SampledLog], last: Learned, error: ErrorModel) -> Learned:
    """Return the model with the references' coefficients, and their columns of it."""
    model, frame = _with_coefficients(last, error)
    grams = reference_grams(reference_terms(references, model, frame), frame)
    return Learned(model, None, frame, (), grams)


def _step(references: Sequence[SampledLog], last: Learned, error: ErrorModel) -> Learned:
    """Return what the references teach, by their columns about what they taught last."""
    acting = repaired(last.model, last.frame, last.grams, error)
    model, frame = _with_coefficients(last, error)
    terms = reference_terms(references, model, frame, acting)
    return Learned(model, acting, frame, terms, reference_grams(terms, frame))


def _with_coefficients(last: Learned, error: ErrorModel) -> tuple[ExtendedModel, Frame]:
    """Return the model with the references' coefficients, and the frame about them."""
    frame = last.frame
    solution, _ = within_bounds(gather(frame, last.grams, [], error), last.model.model, [])
    change = solution[: frame.scale.size]
    coefficients = moved(last.model.model, change)
    if coefficients is None:
        return last.model, frame
    # Columns follow the model: resistances, slope and kt as the references know them.
    centre = np.zeros(frame.scale.size) if frame.centre is None else frame.centre
    return (
        replace(last.model, model=coefficients),
        replace(frame, centre=centre - change * frame.scale),
    )


def reference_terms(
    references: Sequence[SampledLog],
    model: ExtendedModel,
    frame: Frame,
    acting: ExtendedModel | None = None,
) -> tuple[DesignMatrix, ...]:
    """Return the references' columns, of the candidates in `Frame.shown`."""
    wanted = tuple(dict.fromkeys(frame.shown))  # structure may be a log's own as well
    at = [wanted.index(k) for k in frame.shown]
    found = []
    for item in references:
        choices = own_choices(frame.choices, model.pack, item)
        found.append(design_matrix(item, model, [choices[k] for k in wanted], acting))
    return tuple(replace(terms, effects=tuple(terms.effects[k] for k in at)) for terms in found)


def reference_grams(references: Sequence[DesignMatrix], frame: Frame) -> tuple[Gram, ...]:
    """Return the products of the references' columns."""
    return tuple(gram_of(terms, frame.scale) for terms in references)
