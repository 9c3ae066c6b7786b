"""What all verdicts of one diagnosis rest on: candidates, logs as products, the error to expect."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cangauge.errors import InputError
from cangauge.gap.columns import (
    Candidate,
    LogTerms,
    candidates,
    log_terms,
    prepare_log,
    residual,
)
from cangauge.gap.evidence import ErrorModel, Frame, Gram, gram_of
from cangauge.gap.references import (
    error_from_noise,
    error_from_references,
    left_out_errors,
    own_from_references,
)
from cangauge.identify.options import FitOptions
from cangauge.logs.log import Log
from cangauge.model.effects.effect import Effect
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import ModelFile

FloatArray = NDArray[np.float64]

CLEAN_STRUCTURE: tuple[tuple[str, dict[str, float]], ...] = (
    ("fast_polarization", {"tau_s": 3.5}),
    ("fast_polarization", {"tau_s": 9.0}),
    ("slow_diffusion", {"tau_s": 200.0}),
    ("slow_diffusion", {"tau_s": 800.0}),
    ("resistance_temperature", {}),
    ("resistance_soc", {"width_pct": 40.0}),
)
"""Structure that a clean pack may well have and the 13 coefficients lack: all logs share it, so it
is learned from the references and is no cause."""

COVERED_K = 3.0
"""References cover temperatures up to this far outside their own [K]."""

INFORMATION_WEIGHT = 0.1
"""How far the model's own information is trusted where the structure above joins it: it was
gathered without that structure."""

STATED_LOGS = 2.0
"""The error that the model file states counts like this many references."""


@dataclass(frozen=True, eq=False)
class Settled:
    """The common ground of a diagnosis."""

    model: ExtendedModel
    options: FitOptions
    frame: Frame
    error: ErrorModel
    references: tuple[LogTerms, ...]
    diagnosed: tuple[LogTerms, ...]
    as_given: ExtendedModel
    """The model before its temperatures were widened; what the gap is measured from."""

    @cached_property
    def given_errors_v(self) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]]:
        """Errors of the model as given on the references and on the diagnosed logs [V]."""
        return (
            tuple(residual(terms.prepared, self.as_given) for terms in self.references),
            tuple(residual(terms.prepared, self.as_given) for terms in self.diagnosed),
        )

    @cached_property
    def reference_grams(self) -> tuple[Gram, ...]:
        """Products of the references."""
        return tuple(gram_of(terms, self.frame.scale) for terms in self.references)

    @cached_property
    def diagnosed_grams(self) -> tuple[Gram, ...]:
        """Products of the diagnosed logs, weakened where they are driven harder."""
        return tuple(
            gram_of(terms, self.frame.scale).weakened(self.hardness(terms))
            for terms in self.diagnosed
        )

    def hardness(self, terms: LogTerms) -> float:
        """Return how much larger a log's error may be than the references', as variance.

        What a voltage model lacks grows with the current, so a log with twice the mean square
        current gets twice the variance.
        """
        if not self.references:
            return 1.0
        usual = float(np.mean([_mean_square(each) for each in self.references]))
        return max(1.0, _mean_square(terms) / max(usual, 1e-12))


def settle(
    logs: Sequence[Log],
    model_file: ModelFile,
    references: Sequence[Log],
    effects: Sequence[Effect],
    *,
    initial_soc_pct: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> Settled:
    """Prepare everything that the verdicts need.

    Parameters
    ----------
    logs, references : sequence of Log
        Diagnosed logs, which share one cause, and logs on which the model is known to be good.
    model_file : ModelFile
    effects : sequence of Effect
        The library to choose from.
    initial_soc_pct : float, optional
        SoC at each log's first row [%].
    progress : callable, optional
        Called with a line of text before each long step.

    Raises
    ------
    InputError
        If a log gives no rows or does not match the model's pack.
    """
    given = model_file.extended_model()
    model = _over_all_temperatures(given, [*logs, *references])
    options = FitOptions(
        capacity_ah=model_file.capacity_ah,
        initial_soc_pct=initial_soc_pct,
        rate_hz=model_file.rate_hz,
        delay_s=model.model.delay_s,
        epsilon=model_file.epsilon,
        t_ref_c=model_file.t_ref_c,
    )
    for log in (*logs, *references):
        _check_pack(log, model)
    choices = candidates(effects, model.pack, logs[0].time_s)
    say = progress or _silent

    def terms_of(group: Sequence[Log], clean: bool) -> tuple[LogTerms, ...]:
        result = []
        for log in group:
            say(f"weighing {'reference ' if clean else ''}{log.name} against every effect")
            own = options if not clean else replace(options, initial_soc_pct=None)
            result.append(_terms(log, model, own, effects, choices))
        return tuple(result)

    reference_terms, diagnosed_terms = terms_of(references, clean=True), terms_of(logs, clean=False)
    frame = _frame(model_file, choices, reference_terms, diagnosed_terms)
    stated = error_from_noise(model_file.noise, model_file.rate_hz)
    error = stated
    if len(reference_terms) >= 2:
        grams = [gram_of(terms, frame.scale) for terms in reference_terms]
        seen = error_from_references(
            left_out_errors(frame, reference_terms, grams, stated), stated, model_file.rate_hz
        )
        stated_part = STATED_LOGS / (STATED_LOGS + len(reference_terms))
        mixed = (1.0 - stated_part) * seen.rmse_v**2 + stated_part * stated.rmse_v**2
        error = own_from_references(frame, grams, replace(seen, rmse_v=math.sqrt(mixed)))
    return Settled(model, options, frame, error, reference_terms, diagnosed_terms, given)


def _terms(
    log: Log,
    model: ExtendedModel,
    options: FitOptions,
    effects: Sequence[Effect],
    choices: Sequence[Candidate],
) -> LogTerms:
    # A shape may depend on the log (a moment as a part of its length), so each has its own list.
    own = candidates(effects, model.pack, log.time_s)
    if len(own) != len(choices):
        raise InputError("the effects' shapes differ between logs", source=log.source or log.name)
    return log_terms(prepare_log(log, options), model, own)


def _frame(
    model_file: ModelFile,
    choices: Sequence[Candidate],
    references: Sequence[LogTerms],
    diagnosed: Sequence[LogTerms],
) -> Frame:
    known = [item for item in CLEAN_STRUCTURE if references]
    if references and not _temperatures_covered(references, diagnosed):
        # References that were never so cold cannot have shown what resistance does there.
        known = [item for item in known if item[0] != "resistance_temperature"]
    repairs = tuple(
        k for k, choice in enumerate(choices) if (choice.effect.id, dict(choice.shape)) in known
    )
    information = model_file.information
    number = 9 + len(model_file.delays_s)
    if information is None:
        return Frame(tuple(choices), None, np.ones(number), repairs)
    weight = INFORMATION_WEIGHT if repairs else 1.0
    root = math.sqrt(weight) * np.array(information.root)
    return Frame(tuple(choices), root, np.array(information.scale), repairs)


def _over_all_temperatures(model: ExtendedModel, logs: Sequence[Log]) -> ExtendedModel:
    """Return the model with its temperature and current ranges widened to those of the logs.

    It is about to learn from them; where it held the temperature at the edge of what it had seen,
    it may now follow. Its SoC stays as it is: beyond, the pseudo-OCV's formula is not to be used.
    """
    low, high = model.model.temperature_range_c
    least, most = model.model.current_range_a
    for log in logs:
        low, high = (
            min(low, float(log.temperature_c.min())),
            max(high, float(log.temperature_c.max())),
        )
        least, most = min(least, float(log.current_a.min())), max(most, float(log.current_a.max()))
    voltage_model = replace(
        model.model, temperature_range_c=(low, high), current_range_a=(least, most)
    )
    return replace(model, model=voltage_model)


def _temperatures_covered(references: Sequence[LogTerms], diagnosed: Sequence[LogTerms]) -> bool:
    seen = np.concatenate([terms.prepared.rows.temperature_c for terms in references])
    asked = np.concatenate([terms.prepared.rows.temperature_c for terms in diagnosed])
    low, high = seen.min() - COVERED_K, seen.max() + COVERED_K
    return bool(np.mean((asked >= low) & (asked <= high)) > 0.5)


def _check_pack(log: Log, model: ExtendedModel) -> None:
    usual = model.pack.voltage_v
    median = float(np.median(log.voltage_v))
    if not 0.7 * usual <= median <= 1.4 * usual:
        raise InputError(
            f"the model's pack has about {usual:.0f} V",
            source=log.source or log.name,
            field="voltage_v",
            value=round(median, 1),
            cure="nothing can be concluded from a log of another pack: give its own model",
        )


def _mean_square(terms: LogTerms) -> float:
    current = terms.prepared.rows.delayed_current_a[:, 0]
    return float(np.mean(current**2))


def _silent(_text: str) -> None:
    """Say nothing."""
