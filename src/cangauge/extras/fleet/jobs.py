"""What is computed of a fleet: tasks of one log or of a vehicle's logs, each with its rows."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Final

import numpy as np
import pyarrow as pa

from cangauge._files import text_sha256
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.offline import gap_of, initial_soc_of, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.estimation.state import EstimatorState
from cangauge.extras.fleet.sources import FleetLog, ReadOptions, local_file
from cangauge.logs.gaps import discharged_ah
from cangauge.logs.log import Log
from cangauge.logs.read import LogFile
from cangauge.model.model_file import Model
from cangauge.service.offline import (
    PackHistory,
    RecordedEstimate,
    estimate_capture,
    estimate_recorded_log,
    require_same_pack,
)
from cangauge.types import Status

REAL: Final = pa.float64()
COUNT: Final = pa.int64()
TEXT: Final = pa.string()

_PARKED_S: Final = 8.0 * 3600.0
"""Time between two logs of a vehicle without a known start [s]: a car parked overnight."""


Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Task:
    """What one worker computes: a log, or the logs of a vehicle with their references."""

    name: str
    vehicle: str
    logs: tuple[FleetLog, ...]
    references: tuple[FleetLog, ...] = ()

    @property
    def stamp(self) -> str:
        """Changes with the content of any of its logs, and with what a manifest states of them."""
        logs = (*self.logs, *self.references)
        told = (f"{log.url}{log.stamp}{log.start}{log.initial_soc_pct}" for log in logs)
        return text_sha256("\n".join((self.vehicle, *told)))[:16]


@dataclass(frozen=True, eq=False)
class Job(ABC):
    """What is computed of each task."""

    options: ReadOptions

    kind: ClassVar[str]
    """Name of the table."""
    columns: ClassVar[Mapping[str, Any]]
    """Columns of a row, with their Arrow types."""
    of: ClassVar[str] = "logs"
    """What its rows are about."""

    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """Return what the rows depend on beside the logs and how they are read, as JSON."""

    def parts(self, task: Task) -> Iterator[tuple[str, Callable[[], Row]]]:
        """Yield the name of each row, and the function that computes its columns.

        A function that raises sets its row aside; the others are computed all the same.
        """
        for log in task.logs:
            yield log.url, partial(self.row, log)

    def row(self, log: FleetLog) -> Row:
        """Return the columns of a log that depends on no other; needed unless `parts` is own."""
        raise NotImplementedError

    def read(self, log: FleetLog) -> Log:
        """Read a log of the fleet (`ReadOptions.read`)."""
        with local_file(log.url) as path:
            return self.options.read(log, path)


@dataclass(frozen=True, eq=False)
class ModelJob(Job):
    """A job by a model of the vehicles' type, such as from `fleet fit`."""

    model: Model

    def identity(self) -> dict[str, Any]:
        """Return the model."""
        return {"model": self.model.to_json()}


def by_log(logs: Iterable[FleetLog]) -> list[Task]:
    """Return a task for each log."""
    return [Task(log.url, log.vehicle, (log,)) for log in logs]


def by_vehicle(logs: Iterable[FleetLog]) -> list[Task]:
    """Return a task for each vehicle, with its logs in order."""
    found: dict[str, tuple[FleetLog, ...]] = {}
    for log in logs:
        found[log.vehicle] = (*found.get(log.vehicle, ()), log)
    return [Task(vehicle, vehicle, of_vehicle) for vehicle, of_vehicle in found.items()]


# --- State of charge


@dataclass(frozen=True, eq=False)
class EstimateJob(ModelJob):
    """State of charge of each log, as `cangauge estimate` computes it."""

    kind: ClassVar[str] = "estimate"
    columns: ClassVar[Mapping[str, Any]] = {
        "start": TEXT, "rows": COUNT, "duration_s": REAL, "temperature_c": REAL,
        "initial_soc_pct": REAL, "initial_soc_from": TEXT, "end_soc_pct": REAL,
        "end_soc_std_pct": REAL, "mean_soc_std_pct": REAL, "discharged_ah": REAL,
        "soc_mae_pct": REAL, "soc_max_pct": REAL, "soc_newton_mae_pct": REAL,
        "soc_coulomb_mae_pct": REAL, "cover_2sigma": REAL, "voltage_mae_pct": REAL,
        **{f"{status.name.lower()}_share": REAL for status in Status},
        "reasons": TEXT, "warnings": TEXT,
    }  # fmt: skip

    def row(self, log: FleetLog) -> Row:
        """Return SoC at both ends, errors where the log has SoC, and the shares of each status."""
        done = self._estimate(log)
        table, recorded = done.table, done.recorded
        scores = {k: value for k, value in vars(done.scores).items() if k in self.columns}
        shares = {f"{s.name.lower()}_share": float(np.mean(table.status == s)) for s in Status}
        return {
            **scores,
            **shares,
            "start": log.start,
            "duration_s": recorded.duration_s,
            "temperature_c": mean_of(recorded.temperature_c),
            "initial_soc_pct": done.settings.initial_soc_pct,
            "initial_soc_from": done.origin,
            "end_soc_pct": _known(table.soc_pct[-1]),
            "end_soc_std_pct": _known(table.soc_std_pct[-1]),
            "mean_soc_std_pct": mean_of(table.soc_std_pct),
            "discharged_ah": _known(discharged_ah(recorded.time_s, recorded.current_a)[-1]),
            "reasons": ", ".join(done.reason_shares),
            "warnings": " ".join(done.warnings),
        }

    def _estimate(self, log: FleetLog) -> RecordedEstimate:
        settings = EstimatorSettings(initial_soc_pct=log.initial_soc_pct)
        with local_file(log.url) as path:
            is_log = isinstance(self.options.open(path), LogFile)
            if not is_log and self.options.vehicle is not None:
                return estimate_capture(path, self.options.vehicle, self.model, settings)
            recorded = self.options.read(replace(log, initial_soc_pct=None), path)
        unstated = settings.initial_soc_pct is None
        return estimate_recorded_log(
            recorded, self.model, settings, soc_from_log=unstated, pack=PackHistory()
        )


def _known(value: float) -> float | None:
    return None if math.isnan(value) else float(value)


def mean_of(values: FloatArray | Sequence[float | None]) -> float | None:
    """Return the mean of the known values; None without any."""
    known = np.array(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    return float(known.mean()) if known.size else None


# --- Health


@dataclass(frozen=True, eq=False)
class HealthJob(ModelJob):
    """Capacity and resistance of each vehicle after each of its logs.

    The estimator's state passes from a log to the vehicle's next one, as over the restarts of a
    service, so that the capacity is learned over the whole life that was recorded.
    """

    kind: ClassVar[str] = "health"
    columns: ClassVar[Mapping[str, Any]] = {
        "start": TEXT, "end_s": REAL, "rows": COUNT, "temperature_c": REAL,
        "capacity_ah": REAL, "capacity_std_ah": REAL, "resistance_ratio": REAL,
        "resistance_std": REAL, "offset_a": REAL, "offset_std_a": REAL, "soc_pct": REAL,
    }  # fmt: skip

    def parts(self, task: Task) -> Iterator[tuple[str, Callable[[], Row]]]:
        """Yield the row of each log, in order of time."""
        states: list[EstimatorState] = []
        for log in task.logs:
            yield log.url, partial(self._row, log, states)

    def _row(self, log: FleetLog, states: list[EstimatorState]) -> Row:
        recorded = self.read(log)
        require_same_pack(recorded.voltage_v, self.model, recorded.source or recorded.name)
        before = states[-1] if states else None
        shift_s = _shift_s(log, recorded, before)
        settings = EstimatorSettings(
            gap_s=gap_of(recorded), temperature_source=recorded.temperature_source
        )
        if before is None and recorded.first_soc() is not None:
            start = initial_soc_of(recorded, self.model.capacity_ah)
            settings = replace(settings, initial_soc_pct=start)
        estimator = make_estimator(self.model, settings)
        if before is not None:
            estimator.restore(before)
        for sample in samples_of(replace(recorded, time_s=recorded.time_s + shift_s)):
            estimator.update(sample)
        states.append(estimator.snapshot())
        return {
            "start": log.start,
            "end_s": float(recorded.time_s[-1]) + shift_s,
            "rows": len(recorded),
            "temperature_c": float(recorded.temperature_c.mean()),
            **{name: _known(value) for name, value in estimator.health._asdict().items()},
            "soc_pct": _known(estimator.estimate.soc_pct),
        }


def _shift_s(log: FleetLog, recorded: Log, before: EstimatorState | None) -> float:
    """Return what is added to the log's time, so that it follows the log before [s]."""
    first_s = float(recorded.time_s[0])
    ended_s = -math.inf if before is None else before.clock.last_s
    if log.start_s is None:
        return 0.0 if before is None else ended_s + _PARKED_S - first_s
    if log.start_s <= ended_s:
        raise InputError(
            "starts before the previous log of this vehicle ends",
            field="start",
            value=log.start,
            cure="correct the dates of the manifest",
        )
    return log.start_s - first_s
