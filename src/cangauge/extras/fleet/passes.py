"""Both passes of `fleet fit`: rows of a data set ↔ summaries of `identify`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import pyarrow as pa

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.extras.fleet.jobs import COUNT, REAL, TEXT, Job, required
from cangauge.extras.fleet.sources import FleetLog, ReadOptions
from cangauge.identify.assemble import log_sha256, signals_sha256
from cangauge.identify.log_errors import LogErrors, LogFigures, errors_of
from cangauge.identify.starts import unknown_start
from cangauge.identify.voltage_fit import LogInformation, information_of
from cangauge.inference.error_model import SCALES as ERROR_SCALES
from cangauge.inference.error_model import ErrorEquations
from cangauge.inference.least_squares import Solution
from cangauge.inference.rows import FitOptions, FitRows, fit_rows, usable_delays
from cangauge.inference.time_scales import SCALES
from cangauge.logs.gaps import split_where_moved
from cangauge.logs.log import Log
from cangauge.model.voltage_model import VoltageModel

_NUMBERS: Final = pa.list_(pa.float64())
_SUMS: Final = (
    "rows", "voltage_pct", "square_v2", "fit_v2", "newton_pct", "clusters", "held_out",
    "held_out_pct", "held_out_v2",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class InformationJob(Job):
    """First pass: square-root information of each log.

    Parameters
    ----------
    fit : FitOptions
    """

    fit: FitOptions

    kind: ClassVar[str] = "information"
    columns: ClassVar[Mapping[str, Any]] = {
        "name": TEXT, "data_sha256": TEXT, "signals_sha256": TEXT, "temperature_source": TEXT,
        "rows": COUNT, "temperature_sum": REAL,
        "root": _NUMBERS, "scale_roots": _NUMBERS, "counts": _NUMBERS, "low": _NUMBERS,
        "high": _NUMBERS, "levels_v": _NUMBERS, "level_rows": _NUMBERS, "spans": _NUMBERS,
    }  # fmt: skip

    def identity(self) -> dict[str, Any]:
        """Return the options of the fit."""
        return {"fit": repr(self.fit)}

    def row(self, log: FleetLog, path: Path | None, state: str | None) -> dict[str, Any]:
        """Return the log's information, flattened."""
        del state
        recorded, rows = rows_of(self.options, self.fit, log, required(path, log))
        found = information_of(rows, self.fit, with_levels=True)
        arrays = {
            name: np.ravel(getattr(found, name)).tolist()
            for name, kind in self.columns.items()
            if kind is _NUMBERS
        }
        return {
            "name": recorded.name,
            "data_sha256": log_sha256(recorded),
            "signals_sha256": signals_sha256(recorded),
            "temperature_source": recorded.temperature_source,
            "rows": found.rows,
            "temperature_sum": found.temperature_sum,
            **arrays,
        }


@dataclass(frozen=True, eq=False)
class ErrorsJob(Job):
    """Second pass: errors of each log under the model of all, and without its fold.

    Parameters
    ----------
    fit : FitOptions
    model : VoltageModel
    solution : Solution
    without : tuple of VoltageModel or None
        By fold; None where the other logs identify no model.
    mean_c : float
        Mean temperature of all logs [°C].
    """

    fit: FitOptions
    model: VoltageModel
    solution: Solution
    without: tuple[VoltageModel | None, ...]
    mean_c: float

    kind: ClassVar[str] = "errors"
    columns: ClassVar[Mapping[str, Any]] = {
        "voltage_mae_pct": REAL, "soc_newton_mae_pct": REAL,
        **dict.fromkeys(_SUMS, REAL),
        "scores": _NUMBERS, "currents": _NUMBERS, "means": _NUMBERS, "counts": _NUMBERS,
        "products": _NUMBERS,
    }  # fmt: skip

    def identity(self) -> dict[str, Any]:
        """Return the models, and the options of the fit."""
        models = repr((self.model, self.without, self.mean_c))
        return {"fit": repr(self.fit), "models": models}

    def row(self, log: FleetLog, path: Path | None, state: str | None) -> dict[str, Any]:
        """Return the log's errors, flattened."""
        del state
        _, rows = rows_of(self.options, self.fit, log, required(path, log))
        without = self.without[log.fold]
        found = errors_of(
            rows,
            self.fit,
            self.model,
            self.solution,
            held_out=[] if without is None else [(None, without)],
            mean_c=self.mean_c,
        )
        figures = LogFigures(rows.name, rows.removed, found.sums)
        return {
            "voltage_mae_pct": figures.voltage_mae_pct,
            "soc_newton_mae_pct": figures.soc_newton_mae_pct,
            **found.sums,
            "scores": np.ravel(found.scores).tolist(),
            "currents": np.ravel(found.currents).tolist(),
            "means": np.ravel(found.equations.means).tolist(),
            "counts": found.equations.counts.tolist(),
            "products": np.ravel(found.equations.products).tolist(),
        }


def rows_of(
    options: ReadOptions, fit: FitOptions, log: FleetLog, path: Path
) -> tuple[Log, FitRows]:
    """Read a log and return it with its rows of the fit.

    Raises
    ------
    InputError
        If the SoC at its start is unknown, it was charged or driven in a gap, or its rows do not
        resolve the delays.
    """
    recorded = options.read_log(log, path)
    if recorded.first_soc() is None:
        unknown = unknown_start(recorded, others=False)
        cure = "state initial_soc_pct in a manifest, or name the SoC (--columns soc=…)"
        raise InputError(unknown.problem, field=unknown.field, cure=cure)
    if len(split_where_moved(recorded)) > 1:
        raise InputError(
            "the pack was charged or driven in a gap of this log",
            field="time_s",
            cure="split it there: each part begins with its own SoC",
        )
    if len(usable_delays([recorded], fit.delay_s)) < len(fit.delay_s):
        raise InputError(
            "the rows are too far apart for these delays of the current",
            field="--delays",
            value=list(fit.delay_s),
            cure="give fewer delays, or logs with rows every 10 s or less",
        )
    return recorded, fit_rows(recorded, fit)


def information_of_row(row: Mapping[str, Any]) -> LogInformation:
    """Return the information of a row of `InformationJob`."""
    n = int(np.sqrt(len(row["root"])))
    shapes: dict[str, tuple[int, ...]] = {"root": (n, n), "scale_roots": (SCALES, n, n)}
    arrays: dict[str, Any] = {
        name: np.array(row[name]).reshape(shapes.get(name, (-1,)))
        for name, kind in InformationJob.columns.items()
        if kind is _NUMBERS
    }
    return LogInformation(
        rows=row["rows"], logs=1, temperature_sum=row["temperature_sum"], **arrays
    )


def errors_of_row(row: Mapping[str, Any], kept: int) -> LogErrors:
    """Return the errors of a row of `ErrorsJob`.

    Parameters
    ----------
    row : mapping
    kept : int
        Orthonormal coordinates of the solution.
    """

    def array(name: str, *shape: int) -> FloatArray:
        return np.array(row[name]).reshape(shape)

    width = len(row["means"])
    side = int(np.sqrt(len(row["currents"])))
    return LogErrors(
        {name: row[name] for name in _SUMS},
        array("scores", kept, kept),
        array("currents", side, side),
        ErrorEquations(
            np.array([row["rows"]]),
            array("means", 1, width),
            array("counts", ERROR_SCALES),
            array("products", ERROR_SCALES, width, width),
        ),
    )
