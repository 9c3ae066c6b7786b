"""The given model with the effect that explains the logs, judged on rows that did not size it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from cangauge._version import __version__
from cangauge.diagnosis.evidence import EffectEvidence
from cangauge.diagnosis.faults import Quantity
from cangauge.diagnosis.pack import LogRows
from cangauge.diagnosis.rows import Simulated, added
from cangauge.diagnosis.sizes import HeldOut, shape_in_log
from cangauge.diagnosis.where import LogErrors, rms
from cangauge.model.effects.library import effect_entries
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model

TWO_SIDED: Final = 1.96
"""Standard deviations of a 95 % interval."""

SHAPE_STD: Final = 0.05
"""Relative uncertainty of a size by the shape, which is the library's and not the pack's: on
development cases with much evidence sizes were off by 1 to 15 %."""


def parameters_of(evidence: EffectEvidence, duration_s: float) -> dict[str, Quantity]:
    """Return an effect's parameters with the 95 % interval of its amplitude."""
    shape = evidence.shape
    part = next((part for part in evidence.in_logs if part is not None), 0.0)
    if shape.place is not None:
        shape = shape.at(part, duration_s)
    half = TWO_SIDED * float(np.hypot(evidence.std, SHAPE_STD * evidence.size))
    values = shape.values(evidence.size)
    found = {}
    for item in shape.effect.parameters:
        value, ci = values[item.name], None
        if item.name == shape.name:
            ci = (value - half, value + half)
        found[item.name] = Quantity(value, item.unit, ci)
    return found


def errors_without(
    given: ExtendedModel, logs: Sequence[LogRows]
) -> tuple[list[Simulated], list[LogErrors]]:
    """Return each log as the given model predicts it, and its errors on the rows that count."""
    of_logs = [Simulated(given, log.trace) for log in logs]
    errors = []
    for log, of in zip(logs, of_logs, strict=True):
        at = log.trace.rows[log.kept]
        signals = of.signals
        before_v = of.plain.residual_v[log.kept]
        errors.append(
            LogErrors(
                log.trace.name,
                signals.time_s[at] - signals.time_s[0],
                signals.current_a[at],
                signals.temperature_c[at],
                of.plain.soc_pct[at],
                before_v,
                before_v,
            )
        )
    return of_logs, errors


@dataclass(frozen=True, eq=False)
class Correction:
    """The given model with one effect.

    Parameters
    ----------
    evidence : EffectEvidence
    errors : list of LogErrors
        Before and after, on the rows that count, sized without them.
    """

    evidence: EffectEvidence
    errors: list[LogErrors] = field(repr=False)

    @classmethod
    def of(
        cls,
        held_out: HeldOut,
        logs: Sequence[LogRows],
        given: Sequence[Simulated],
        without: Sequence[LogErrors],
        evidence: EffectEvidence,
    ) -> Correction:
        """Return the correction by an effect, judged on rows that did not size it."""
        sizes, errors = held_out.sizes(evidence), []
        for number, (log, of, before) in enumerate(zip(logs, given, without, strict=True)):
            after_v = before.before_v.copy()
            shape = shape_in_log(evidence, number, log)
            if shape is None:
                errors.append(before)
                continue
            for size in np.unique(sizes[number]):
                mine = sizes[number] == size
                found = of.with_effect(shape.effect, shape.values(float(size)))
                after_v[mine] = found.residual_v[log.kept][mine]
            errors.append(replace(before, after_v=after_v))
        return cls(evidence, errors)

    @property
    def rmse_v(self) -> float:
        """Error of the corrected model [V]."""
        return rms(self.errors, after=True)

    @property
    def is_better(self) -> bool:
        """Whether the error of rows that did not size it is smaller with it."""
        return self.rmse_v < rms(self.errors)

    @property
    def fault(self) -> str:
        """The fault that it corrects."""
        return self.evidence.shape.effect.fault

    @property
    def is_of_log(self) -> bool:
        """Whether it belongs to these logs and not to the pack."""
        return self.fault == "start"

    def applied(self, given: ExtendedModel) -> ExtendedModel:
        """Return the model for later logs: a step that has happened persists."""
        if self.is_of_log:
            return given
        shape = self.evidence.shape
        if shape.place is not None:
            shape = shape.at(0.0, 0.0)
        return added(given, shape.effect, shape.values(self.evidence.size))


def model_file(given: Model, corrected: ExtendedModel, rmse_v: float) -> Model:
    """Return the corrected model, ready to save and run, with its error on held-out rows."""
    made = given.made.model_copy(update={"by": f"cangauge {__version__} gap"})
    judged = {"voltage_rmse_v": rmse_v, "judged_on": "rows left out by `cangauge gap`"}
    return given.model_copy(
        update={
            "name": f"{given.name}, corrected",
            "effects": effect_entries(corrected.effects),
            "noise": given.noise.model_copy(update=judged),
            "information": None,
            "made": made,
        }
    )
