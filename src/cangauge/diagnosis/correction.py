"""The given model with the effect that explains the logs, judged on rows that did not size it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from cangauge._typing import BoolArray
from cangauge._version import __version__
from cangauge.diagnosis.evidence import Evidence
from cangauge.diagnosis.pack import LogRows
from cangauge.diagnosis.rows import Simulated, added
from cangauge.diagnosis.sizes import SizeProfile
from cangauge.diagnosis.where import LogErrors, rms
from cangauge.model.effects.library import effect_entries
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model


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
    evidence : Evidence
    errors : list of LogErrors
        Before and after, on the rows that count, sized without them.
    """

    evidence: Evidence
    errors: list[LogErrors] = field(repr=False)

    @classmethod
    def of(
        cls,
        parts: Sequence[tuple[SizeProfile, list[BoolArray]]],
        logs: Sequence[LogRows],
        given: Sequence[Simulated],
        without: Sequence[LogErrors],
        evidence: Evidence,
    ) -> Correction:
        """Return the correction by an effect, judged on parts of logs that did not size it."""
        bound = evidence.shape.bound
        after = [each.before_v.copy() for each in without]
        for profile, judged in parts:
            size = profile.newton(evidence, evidence.size / bound) * bound
            for k, rows in enumerate(judged):
                shape = evidence.shape_in(k, logs[k])
                if shape is not None and rows.any():
                    found = given[k].with_effect(shape.effect, shape.values(size))
                    after[k][rows] = found.residual_v[logs[k].kept][rows]
        errors = [replace(each, after_v=v) for each, v in zip(without, after, strict=True)]
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
        return self.evidence.fault

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
