"""The given model with the effect that explains the logs, judged on rows that did not size it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cangauge._typing import BoolArray
from cangauge._version import __version__
from cangauge.diagnosis.evidence import Evidence
from cangauge.diagnosis.pack import LogRows
from cangauge.diagnosis.rows import Simulated, added
from cangauge.diagnosis.sizes import SizeProfile
from cangauge.diagnosis.where import Errors, rms
from cangauge.model.effects.library import effect_entries
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model


def errors_of(given: Sequence[Simulated], logs: Sequence[LogRows]) -> Errors:
    """Return the errors of simulated logs on the rows that count."""
    parts = []
    for k, (log, of) in enumerate(zip(logs, given, strict=True)):
        at, signals = log.trace.rows[log.kept], of.signals
        parts.append(
            (
                np.full(at.size, k),
                signals.time_s[at] - signals.time_s[0],
                signals.current_a[at],
                signals.temperature_c[at],
                of.plain.soc_pct[at],
                of.plain.residual_v[log.kept],
                of.plain.residual_v[log.kept],
            )
        )
    return Errors(*map(np.concatenate, zip(*parts, strict=True)))


@dataclass(frozen=True, eq=False)
class Correction:
    """The given model with one effect.

    Parameters
    ----------
    evidence : Evidence
    errors : Errors
        Before and after, on the rows that count, sized without them.
    """

    evidence: Evidence
    errors: Errors = field(repr=False)

    @classmethod
    def of(
        cls,
        evidence: Evidence,
        folds: Sequence[tuple[SizeProfile, list[BoolArray]]],
        logs: Sequence[LogRows],
        given: Sequence[Simulated],
        without: Errors,
    ) -> Correction:
        """Return the correction by an effect, judged on parts of logs that did not size it."""
        after_v = [errors.before_v for errors in without.by_log]
        for profile, judged in folds:
            size = profile.sized(evidence)
            for k, (shape, rows) in enumerate(zip(evidence.shapes, judged, strict=True)):
                if shape is not None and rows.any():
                    found = given[k].with_effect(shape.effect, shape.values(size))
                    after_v[k] = np.where(rows, found.residual_v[logs[k].kept], after_v[k])
        return cls(evidence, replace(without, after_v=np.concatenate(after_v)))

    @property
    def rmse_v(self) -> float:
        """Error of the corrected model [V]."""
        return rms(self.errors.after_v)

    @property
    def is_better(self) -> bool:
        """Whether the error of rows that did not size it is smaller with it."""
        return self.rmse_v < rms(self.errors.before_v)

    @property
    def is_of_log(self) -> bool:
        """Whether it belongs to these logs and not to the pack."""
        return self.evidence.fault == "start"

    def applied(self, given: ExtendedModel) -> ExtendedModel:
        """Return the model for later logs: a step that has happened persists."""
        shape = self.evidence.shape
        if shape.place is not None:
            shape = replace(shape, place=0.0).in_log(0.0)
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
