"""The model as references know it, and their columns about it.

Structure acts on what coefficients multiply: a core that is warmer than its sensor shows as kt
times its rise, so both cannot be solved for at once from columns of a model with another kt. They
are solved for again about what was found (Gauss-Newton), until the references are no less probable
than they seemed from where it began.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cangauge.gap.bounded import moved, within_bounds
from cangauge.gap.columns import LogTerms, Prepared, log_terms, own_choices
from cangauge.gap.evidence import ErrorModel, Gram, gather, gram_of, log_likelihood
from cangauge.gap.frame import Frame
from cangauge.gap.structure import WORTH_IT, repaired
from cangauge.model.extended import ExtendedModel

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
    references: tuple[LogTerms, ...]
    grams: tuple[Gram, ...]


def learn(
    references: Sequence[Prepared],
    model: ExtendedModel,
    frame: Frame,
    grams: Sequence[Gram],
    error: ErrorModel,
) -> Learned:
    """Return what the references teach.

    Parameters
    ----------
    references : sequence of Prepared
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


def _moved(references: Sequence[Prepared], last: Learned, error: ErrorModel) -> Learned:
    """Return the model with the references' coefficients, and their columns of it."""
    model, frame = _with_coefficients(last, error)
    grams = reference_grams(reference_terms(references, model, frame), frame)
    return Learned(model, None, frame, (), grams)


def _step(references: Sequence[Prepared], last: Learned, error: ErrorModel) -> Learned:
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
    references: Sequence[Prepared],
    model: ExtendedModel,
    frame: Frame,
    acting: ExtendedModel | None = None,
) -> tuple[LogTerms, ...]:
    """Return the references' columns, of the candidates in `Frame.shown`."""
    wanted = tuple(dict.fromkeys(frame.shown))  # structure may be a log's own as well
    at = [wanted.index(k) for k in frame.shown]
    found = []
    for item in references:
        choices = own_choices(frame.choices, model.pack, item)
        found.append(log_terms(item, model, [choices[k] for k in wanted], acting))
    return tuple(replace(terms, effects=tuple(terms.effects[k] for k in at)) for terms in found)


def reference_grams(references: Sequence[LogTerms], frame: Frame) -> tuple[Gram, ...]:
    """Return the products of the references' columns."""
    return tuple(gram_of(terms, frame.scale) for terms in references)
