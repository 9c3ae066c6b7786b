"""What is computed of each log of a fleet: one row of a data set."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Final, Self

import numpy as np
import pyarrow as pa

from cangauge._files import text_sha256
from cangauge.errors import InputError
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.fleet.sources import FleetLog, ReadOptions
from cangauge.logs.gaps import discharged_ah
from cangauge.logs.read import LogFile
from cangauge.model.model_file import Model
from cangauge.service.offline import (
    PackHistory,
    RecordedEstimate,
    estimate_recorded_capture,
    estimate_recorded_log,
    require_same_pack,
)
from cangauge.types import Status

REAL: Final = pa.float64()
COUNT: Final = pa.int64()
TEXT: Final = pa.string()


@dataclass(frozen=True, eq=False)
class Job(ABC):
    """What is computed of each log.

    Parameters
    ----------
    options : ReadOptions
    """

    options: ReadOptions

    kind: ClassVar[str]
    """Name of the table."""
    columns: ClassVar[Mapping[str, Any]]
    """Columns of a row, with their Arrow types."""
    is_chained: ClassVar[bool] = False
    """Whether the column `state` of a log is the input of the vehicle's next one."""
    of: ClassVar[str] = "logs"
    """What its rows are about."""
    reads_log: ClassVar[bool] = True
    """Whether the log is one file."""

    @property
    def resumes_with(self) -> tuple[str, ...]:
        """Columns of earlier rows that a resumed run needs."""
        return ("state",) if self.is_chained else ()

    def chained_stamp(self, before: str, log: FleetLog) -> str:
        """Return the stamp of a log; of a chained job it also depends on the logs before."""
        given = f"{log.stamp}{log.stated}"
        if self.is_chained:
            given = f"{before}{given}"
        return text_sha256(given)[:16]

    def prepared(self) -> Self:
        """Return the job with what all its rows share, computed once on a worker."""
        return self

    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """Return what the rows depend on beside the log and how it is read, as JSON."""

    @abstractmethod
    def row(self, log: FleetLog, path: Path | None, state: str | None) -> dict[str, Any]:
        """Return the columns of a log.

        Parameters
        ----------
        log : FleetLog
        path : Path or None
            Local copy of the log; None if the job `reads_log` itself.
        state : str, optional
            Column `state` of the vehicle's log before, of a chained job.

        Raises
        ------
        InputError
            If the log cannot be used: it is set aside.
        """


@dataclass(frozen=True, eq=False)
class EstimateJob(Job):
    """State of charge of each log, as `cangauge estimate` computes it.

    Parameters
    ----------
    model : Model
    settings : EstimatorSettings
    """

    model: Model
    settings: EstimatorSettings

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

    def identity(self) -> dict[str, Any]:
        """Return model and settings."""
        return {"model": self.model.to_json(), "settings": repr(self.settings)}

    def row(self, log: FleetLog, path: Path | None, state: str | None) -> dict[str, Any]:
        """Return SoC at both ends, errors where the log has SoC, and the shares of each status."""
        del state
        done = self._estimate(log, required(path, log))
        table, scores, recorded = done.table, done.scores, done.recorded
        std_pct = table.soc_std_pct[np.isfinite(table.soc_std_pct)]
        temperature_c = recorded.temperature_c[np.isfinite(recorded.temperature_c)]
        errors = {
            name: value
            for name, value in vars(scores).items()
            if name in self.columns and name != "rows"
        }
        out_ah = discharged_ah(recorded.time_s, recorded.current_a)
        return {
            "start": log.start,
            "rows": scores.rows,
            "duration_s": recorded.duration_s,
            "temperature_c": _mean(temperature_c),
            "initial_soc_pct": done.settings.initial_soc_pct,
            "initial_soc_from": done.origin,
            "end_soc_pct": known(table.soc_pct[-1]),
            "end_soc_std_pct": known(table.soc_std_pct[-1]),
            "mean_soc_std_pct": _mean(std_pct),
            "discharged_ah": known(out_ah[-1]),
            **errors,
            **{
                f"{status.name.lower()}_share": float(np.mean(table.status == status))
                for status in Status
            },
            "reasons": ", ".join(done.reason_shares),
            "warnings": " ".join(done.warnings),
        }

    def _estimate(self, log: FleetLog, path: Path) -> RecordedEstimate:
        settings = self.settings
        if log.initial_soc_pct is not None:
            settings = replace(settings, initial_soc_pct=log.initial_soc_pct)
        recording = self.options.open(path)
        if not isinstance(recording, LogFile) and self.options.vehicle is not None:
            done = estimate_recorded_capture(path, self.options.vehicle, self.model, settings)
            require_same_pack(done.recorded, self.model)
            return done
        return estimate_recorded_log(
            self.options.read(path, log.url),
            self.model,
            settings,
            soc_from_log=settings.initial_soc_pct is None,
            pack=PackHistory(),
        )


def known(value: float) -> float | None:
    """Return a number, or None if it is NaN."""
    return None if math.isnan(value) else float(value)


def _mean(values: Any) -> float | None:
    return float(values.mean()) if values.size else None


def required(path: Path | None, log: FleetLog) -> Path:
    """Return the local copy of a log.

    Raises
    ------
    InputError
        If there is none.
    """
    if path is None:
        raise InputError("no such file", source=log.url)
    return path
