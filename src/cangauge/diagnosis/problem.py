"""Where references have been: the temperatures and the charge at which the model is known.

What all verdicts of one diagnosis rest on: candidates, logs as products, the error to expect.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.diagnosis.design_matrix import DesignMatrix, design_matrix, own_choices
from cangauge.diagnosis.hypotheses import Frame
from cangauge.diagnosis.input_checks import check_inputs
from cangauge.diagnosis.linear_gaussian import ErrorModel, Gram, gram_of
from cangauge.diagnosis.references import (
    LEAST_TRUST_BEYOND,
    error_from_noise,
    error_from_references,
    learn,
    reference_grams,
    reference_terms,
    with_strays,
)
from cangauge.errors import InputError
from cangauge.inference.linearized import residual
from cangauge.inference.rows import FitOptions, SampledLog, sample_log
from cangauge.logs.log import Log, TemperatureSource
from cangauge.logs.resample import dequantize, resample, usual_step_k
from cangauge.model.effects.base import Effect
from cangauge.model.effects.library import Candidate, candidates
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model

# --- Where references have been: the temperatures and the charge at which the model is known

COVERED_K, COVERED_PCT = 3.0, 3.0
"""References cover temperatures and SoC up to this far outside their own [K, %]."""

COLDER_PART, WARMER_PART = 0.2, 0.5
"""Nor are temperatures foreign that lie below or above by less than these parts of the range that
references have: how the pack follows the temperature, they have shown. In the cold resistance
grows ever faster. (On trips that the check is made of, winter is 0.3 below summer.)"""

BEYOND_WEIGHT = 0.3
"""Weight of a row at a charge that no reference has been at: its error is expected to be larger by
the inverse. What the pseudo-OCV is there, nobody has looked at since the model's own logs. Chosen
on development cases, where no such row had counted before; 0.3 is the only value that was run."""

LEAST_COUNT = 0.1
"""A reference that went where no other has been still counts so much."""


def temperatures_covered(references: Sequence[SampledLog], diagnosed: Sequence[SampledLog]) -> bool:
    """Return whether most rows of the diagnosed logs are at temperatures that references teach."""
    seen = np.concatenate([item.rows.temperature_c for item in references])
    asked = np.concatenate([item.rows.temperature_c for item in diagnosed])
    spread = float(np.ptp(seen))
    low = seen.min() - max(COVERED_K, COLDER_PART * spread)
    high = seen.max() + max(COVERED_K, WARMER_PART * spread)
    return bool(np.mean((asked >= low) & (asked <= high)) > 0.5)


def charge_weight(
    item: SampledLog, references: Sequence[SampledLog], taught_pct: tuple[float, float]
) -> FloatArray:
    """Return how much each row of a log tells by where it is charged, shape (m,).

    Parameters
    ----------
    item : SampledLog
    references : sequence of SampledLog
    taught_pct : tuple of float
        SoC that the model was fitted on, low and high [%].

    Returns
    -------
    array of shape (m,)
        1 where references have been; `BEYOND_WEIGHT` where only the model's own logs have; 0 where
        the pseudo-OCV's formula goes on by itself. All 1 without references.
    """
    soc_pct = item.rows.soc_pct
    if not references:
        return np.ones(soc_pct.size)
    taught = (soc_pct >= taught_pct[0]) & (soc_pct <= taught_pct[1])
    beyond = np.where(taught, BEYOND_WEIGHT, 0.0)
    return np.where(_inside(item, references, "soc_pct", COVERED_PCT), 1.0, beyond)


def counting(references: Sequence[SampledLog], diagnosed: Sequence[SampledLog]) -> list[float]:
    """Return how much each reference says of how far the diagnosed logs may stray.

    One that went where no other has been shows how the model extrapolates. If the diagnosed logs
    stay where references have been, that is another question, and it counts little.
    """
    asked = min(_part_inside(item, references) for item in diagnosed)
    return [
        max(
            LEAST_COUNT,
            1.0 - asked,
            _part_inside(item, [other for other in references if other is not item]),
        )
        for item in references
    ]


def _part_inside(item: SampledLog, others: Sequence[SampledLog]) -> float:
    """Return the part of a log's rows within the temperatures and SoC of others [-]."""
    warm = _inside(item, others, "temperature_c", COVERED_K)
    charged = _inside(item, others, "soc_pct", COVERED_PCT)
    return float(np.mean(warm & charged))


def _inside(
    item: SampledLog, others: Sequence[SampledLog], name: str, margin: float
) -> NDArray[np.bool_]:
    """Return which rows lie within the range of others; all of them, if there are no others."""
    values = getattr(item.rows, name)
    if not others:
        return np.ones(values.size, dtype=bool)
    seen = np.concatenate([getattr(other.rows, name) for other in others])
    return np.asarray((values >= seen.min() - margin) & (values <= seen.max() + margin))


# --- What all verdicts of one diagnosis rest on: candidates, logs as products, the error to …

SOC_STD_PCT = 0.5
"""How well a log's assumed initial SoC is known without a cause [%]."""

SLOW_STD, LEVEL_STD = 0.08, 0.03
"""How much slow polarisation and resistance differ from log to log without a cause, in parts of
the pack's resistance."""

OWN_PART = 0.01
"""How much every other effect does, in parts of its physical range."""

ALWAYS_OF_TEMPERATURE = frozenset({"charge_transfer", "inner_temperature"})
"""Structure that follows the temperature whatever its shape."""

LEAST_INSIDE = 0.2
"""Rows where neither references nor the model's own logs have been as charged do not count, if the
others are at least this part of a log."""


@dataclass(frozen=True, eq=False)
class DiagnosisProblem:
    """The common ground of a diagnosis."""

    model: ExtendedModel
    """As given, with the references' coefficients and without their structure: all columns but
    those of temperatures are of it."""
    options: FitOptions
    frame: Frame
    error: ErrorModel
    references: tuple[DesignMatrix, ...]
    diagnosed: tuple[DesignMatrix, ...]
    as_given: ExtendedModel
    """The model before its temperatures were widened; what the gap is measured from."""
    covered: bool = True
    """Whether references have been at the diagnosed logs' temperatures."""
    acting: ExtendedModel | None = None
    """The model with the structure that references call for, about which all columns are linear
    (`columns.log_terms`)."""
    temperature_step_k: float = 0.0
    """The coarsest step in which a diagnosed log's temperature is reported [K]."""
    temperature_source: TemperatureSource = "unknown"
    """What the model's temperature was measured on."""
    left_out: tuple[str, ...] = ()
    """Rows that no pack makes, a sentence each."""

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

    @cached_property
    def judged_grams(self) -> tuple[Gram, ...]:
        """Products of the diagnosed logs, less of them where references have not been as charged.

        How a pseudo-OCV goes on beyond the charge that it was taught, nobody has seen: what shows
        there may be the cause or the model. Without enough of other rows, those of all.
        """
        prepared = [item.prepared for item in self.references]
        grams = []
        for terms, gram in zip(self.diagnosed, self.diagnosed_grams, strict=True):
            weight = charge_weight(terms.prepared, prepared, self.as_given.model.soc_range_pct)
            if np.all(weight == 1.0):
                grams.append(gram)
            elif np.mean(weight > 0.0) >= LEAST_INSIDE:
                judged = gram_of(terms, self.frame.scale, weight)
                grams.append(judged.weakened(self.hardness(terms)))
        return tuple(grams) or self.diagnosed_grams

    def hardness(self, terms: DesignMatrix) -> float:
        """Return how much larger a log's error may be than the references', as variance.

        What a voltage model lacks grows with the current, so a log with twice the mean square
        current gets twice the variance.
        """
        if not self.references:
            return 1.0
        usual = float(np.mean([_mean_square(each) for each in self.references]))
        return max(1.0, _mean_square(terms) / max(usual, 1e-12))


def build_problem(
    logs: Sequence[Log],
    model_file: Model,
    references: Sequence[Log],
    effects: Sequence[Effect],
    *,
    initial_soc_pct: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> DiagnosisProblem:
    """Prepare everything that the verdicts need.

    Parameters
    ----------
    logs, references : sequence of Log
        Diagnosed logs, which share one cause, and logs on which the model is known to be good.
    model_file : Model
    effects : sequence of Effect
        The library to choose from.
    initial_soc_pct : float, optional
        SoC at each log's first row [%].
    progress : callable, optional
        Called with a line of text before each long step.

    Raises
    ------
    InputError
        If a log gives no rows, does not match the model's pack, has a dead channel or is given
        twice, or if neither references nor the model file tell how well the model is known.
    """
    given = model_file.extended_model()
    logs, references, left_out = check_inputs(logs, references, given)
    model = _over_all_temperatures(given, [*logs, *references])
    options = FitOptions(
        capacity_ah=model_file.capacity_ah,
        initial_soc_pct=initial_soc_pct,
        rate_hz=model_file.rate_hz,
        delay_s=model.model.delay_s,
        epsilon=model_file.epsilon,
        t_ref_c=model_file.t_ref_c,
    )
    if not references and model_file.information is None:
        raise InputError(
            "tells nothing of how well its coefficients are known, and there are no references:"
            " no error can be told from a cause",
            source=model_file.name,
            field="information",
            cure="give logs on which the model is good with --reference",
        )
    choices = candidates(effects, model.pack, logs[0].time_s, for_diagnosis=True)
    say = progress or _silent
    # Steps are found in the reports, before means blur them.
    of_logs = [sample_log(resample(dequantize(log)), options) for log in logs]
    without_start = replace(options, initial_soc_pct=None)
    of_references = [sample_log(resample(dequantize(log)), without_start) for log in references]
    covered = not of_references or temperatures_covered(of_references, of_logs)
    frame = _frame(model_file, choices, has_references=bool(of_references), covered=covered)
    error = error_from_noise(model_file.noise, model_file.rate_hz, frame)
    acting: ExtendedModel | None = None
    terms_of_references: tuple[DesignMatrix, ...] = ()
    if of_references:
        say("learning from the references")
        grams = reference_grams(reference_terms(of_references, model, frame), frame)
        if len(grams) > 1:
            least_trust = 0.0 if covered else LEAST_TRUST_BEYOND
            error = error_from_references(frame, grams, error, least_trust)
        expected = error if covered or len(grams) == 1 else _beyond_the_references(error)
        say("repairing the structure")
        learned = learn(of_references, model, frame, grams, expected)
        model, acting, frame = learned.model, learned.acting, learned.frame
        terms_of_references = learned.references
        if len(grams) > 1:
            judged = _judged(learned.references, learned.grams, frame, given)
            weights = counting(of_references, of_logs)
            error = with_strays(frame, learned.grams, error, weights, judged)
            error = error if covered else _beyond_the_references(error)
    diagnosed = []
    for item in of_logs:
        say(f"weighing {item.log.name} against every effect")
        diagnosed.append(design_matrix(item, model, own_choices(choices, model.pack, item), acting))
    return DiagnosisProblem(
        model=model,
        options=options,
        frame=frame,
        error=error,
        references=terms_of_references,
        diagnosed=tuple(diagnosed),
        as_given=given,
        covered=covered,
        acting=acting,
        temperature_step_k=max(usual_step_k(log) for log in logs),
        temperature_source=model_file.temperature_source,
        left_out=tuple(left_out),
    )


def _judged(
    references: Sequence[DesignMatrix], grams: Sequence[Gram], frame: Frame, model: ExtendedModel
) -> list[Gram]:
    """Return each reference's products as if it were diagnosed beside the others."""
    found = []
    for terms, gram in zip(references, grams, strict=True):
        others = [other.prepared for other in references if other is not terms]
        weight = charge_weight(terms.prepared, others, model.model.soc_range_pct)
        whole = bool(np.all(weight == 1.0)) or np.mean(weight > 0.0) < LEAST_INSIDE
        found.append(gram if whole else gram_of(terms, frame.scale, weight))
    return found


def _frame(
    model_file: Model,
    choices: Sequence[Candidate],
    *,
    has_references: bool,
    covered: bool,
) -> Frame:
    # References that were never so cold cannot have shown what resistance does there.
    repairs = tuple(
        k
        for k, choice in enumerate(choices)
        if has_references
        and choice.effect.is_structure
        and (covered or not _follows_temperature(choice))
    )
    own, own_prior = _own(choices, model_file)
    information = model_file.information
    root, scale = None, np.ones(9 + len(model_file.delays_s))
    if information is not None:
        root, scale = np.array(information.root), np.array(information.scale)
    return Frame(tuple(choices), root, scale, repairs, own, own_prior)


def _follows_temperature(choice: Candidate) -> bool:
    return choice.effect.id in ALWAYS_OF_TEMPERATURE or bool(choice.shape.get("activation_k"))


def _own(choices: Sequence[Candidate], model_file: Model) -> tuple[tuple[int, ...], FloatArray]:
    """Return by which candidates logs may differ, every effect, and how much at first.

    At their usual shapes: what little logs differ by has no more of a shape than that.
    """
    by_effect: dict[str, dict[tuple[object, ...], int]] = {}
    for k, choice in enumerate(choices):
        if choice.effect.is_cause and choice.is_for_fit:
            # The first of one shape is what an effect does when it is small. What it does when it
            # is large differs from log to log by a cause alone.
            of_one = by_effect.setdefault(choice.effect.id, {})
            of_one.setdefault(tuple(choice.shape.items()), k)
    noise = model_file.noise
    constant_v = max(noise.lasting_std_v, 0.25 * math.hypot(noise.fast_std_v, noise.slow_std_v))
    own: list[int] = []
    stds: list[float] = []
    for effect_id, of_one in by_effect.items():
        for k in of_one.values():
            widths = choices[k].bounds[:, 1] - choices[k].bounds[:, 0]
            usual = {"voltage_offset": [constant_v], "initial_soc": [SOC_STD_PCT]}.get(
                effect_id, (OWN_PART * widths).tolist()
            )
            # All shapes together make up what the effect may differ by.
            stds.extend(std / math.sqrt(len(of_one)) for std in usual)
            own.append(k)
    return tuple(own), np.array([*stds, SLOW_STD, LEVEL_STD])


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


def _beyond_the_references(error: ErrorModel) -> ErrorModel:
    """Return the error to expect at temperatures that no reference has.

    How well the model follows from row to row there, and how far it strays, nobody has seen: all
    scales are given the variance of the slowest.
    """
    return replace(error, scale_v2=(error.lasting_v2,) * len(error.scale_v2), strays={})


def _mean_square(terms: DesignMatrix) -> float:
    current = terms.prepared.rows.delayed_current_a[:, 0]
    return float(np.mean(current**2))


def _silent(_text: str) -> None:
    """Say nothing."""
