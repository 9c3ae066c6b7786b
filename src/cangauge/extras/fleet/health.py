"""`fleet health`: capacity and resistance of each vehicle over time, and outliers of the fleet."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np

from cangauge.errors import InputError
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import gap_of, initial_soc_of, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.estimation.state import EstimatorState
from cangauge.extras.fleet.jobs import COUNT, REAL, TEXT, Job, known, required
from cangauge.extras.fleet.outliers import VALUES_AT_LEAST, robust_z
from cangauge.extras.fleet.sources import FleetLog
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.service.offline import require_same_pack

PARKED_S: Final = 8.0 * 3600.0
"""Time between two logs of a vehicle without a known start [s]: a car parked overnight."""

QUANTITIES: Final = {
    "capacity_ah": "capacity_std_ah",
    "resistance_ratio": "resistance_std",
    "offset_a": "offset_std_a",
}
"""Quantities compared over the fleet, with their standard deviations."""


@dataclass(frozen=True, eq=False)
class HealthJob(Job):
    """Capacity and resistance of each vehicle after each of its logs.

    The estimator's state passes from a log to the vehicle's next one, as over the restarts of a
    service, so that the capacity is learned over the whole life that was recorded.

    Parameters
    ----------
    model : Model
    settings : EstimatorSettings
    """

    model: Model
    settings: EstimatorSettings

    kind: ClassVar[str] = "health"
    is_chained: ClassVar[bool] = True
    columns: ClassVar[Mapping[str, Any]] = {
        "start": TEXT, "end_s": REAL, "rows": COUNT, "temperature_c": REAL,
        "capacity_ah": REAL, "capacity_std_ah": REAL, "resistance_ratio": REAL,
        "resistance_std": REAL, "offset_a": REAL, "offset_std_a": REAL, "soc_pct": REAL,
        "state": TEXT,
    }  # fmt: skip

    def identity(self) -> dict[str, Any]:
        """Return model and settings."""
        return {"model": self.model.to_json(), "settings": repr(self.settings)}

    def row(self, log: FleetLog, path: Path | None, state: str | None) -> dict[str, Any]:
        """Return capacity, resistance and offset with their deviations at the log's end."""
        recorded = self.options.read_log(log, required(path, log))
        require_same_pack(recorded, self.model)
        before = None if state is None else EstimatorState.model_validate_json(state)
        shift_s = self._shift_s(log, recorded, before)
        estimator = self._estimator(recorded, before)
        for sample in samples_of(replace(recorded, time_s=recorded.time_s + shift_s)):
            estimator.update(sample)
        estimate = estimator.estimate
        return {
            "start": log.start,
            "end_s": float(recorded.time_s[-1]) + shift_s,
            "rows": len(recorded),
            "temperature_c": float(recorded.temperature_c.mean()),
            **{name: known(value) for name, value in estimator.health._asdict().items()},
            "soc_pct": known(estimate.soc_pct),
            "state": estimator.snapshot().model_dump_json(),
        }

    def _estimator(self, recorded: Log, before: EstimatorState | None) -> Estimator:
        settings = replace(
            self.settings, gap_s=gap_of(recorded), temperature_source=recorded.temperature_source
        )
        if before is None and recorded.first_soc() is not None:
            start = initial_soc_of(recorded, settings.capacity_ah or self.model.capacity_ah)
            settings = replace(settings, initial_soc_pct=start)
        estimator = make_estimator(self.model, settings)
        if before is not None:
            estimator.restore(before)
        return estimator

    @staticmethod
    def _shift_s(log: FleetLog, recorded: Log, before: EstimatorState | None) -> float:
        """Return what is added to the log's time, so that it follows the log before [s]."""
        ended_s = -math.inf if before is None else before.clock.last_s
        if log.start_s is not None:
            shift_s = log.start_s - float(recorded.time_s[0])
            if log.start_s <= ended_s:
                raise InputError(
                    "starts before the previous log of this vehicle ends", field="start",
                    value=log.start, cure="correct the dates of the manifest",
                )  # fmt: skip
            return shift_s
        if before is None:
            return 0.0
        return ended_s + PARKED_S - float(recorded.time_s[0])


def latest_health(rows: Iterable[Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """Return the last row of each vehicle, by vehicle."""
    found: dict[str, Mapping[str, Any]] = {}
    for row in rows:
        before = found.get(row["vehicle"])
        if before is None or before["end_s"] <= row["end_s"]:
            found[row["vehicle"]] = row
    return dict(sorted(found.items()))


def outliers(latest: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Return the robust z of each vehicle's capacity, resistance and offset over the fleet.

    Parameters
    ----------
    latest : mapping
        Of `latest_health`.

    Returns
    -------
    dict
        Quantity → z by vehicle; empty below `VALUES_AT_LEAST` vehicles.
    """
    found: dict[str, dict[str, float]] = {}
    for quantity, deviation in QUANTITIES.items():
        values = {
            vehicle: (row[quantity], row[deviation] or 0.0)
            for vehicle, row in latest.items()
            if row[quantity] is not None
        }
        if len(values) < VALUES_AT_LEAST:
            continue
        z = robust_z(*np.array([*values.values()]).T)
        found[quantity] = dict(zip(values, z.tolist(), strict=True))
    return found
