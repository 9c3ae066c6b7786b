"""The pass of `fleet fit`: rows of a data set ↔ sums of `identify`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import pyarrow as pa

from cangauge.errors import InputError
from cangauge.extras.fleet.jobs import COUNT, REAL, TEXT, Job, required
from cangauge.extras.fleet.sources import FleetLog
from cangauge.identify.fit import EPSILON, log_sha256, ranges_of, signals_sha256
from cangauge.identify.least_squares import LogSums, log_sums
from cangauge.identify.published import Factor, factor_of
from cangauge.identify.rows import fit_rows
from cangauge.identify.starts import unknown_start
from cangauge.logs.gaps import split_where_moved
from cangauge.model.model_file import Ranges
from cangauge.model.prior import CHEMISTRIES, DELAYS_S, REFERENCE_C, ChemistryName

_NUMBERS: Final = pa.list_(pa.float64())
_RANGES: Final = ("soc_pct", "temperature_c", "current_a")


@dataclass(frozen=True)
class FleetFitOptions:
    """How logs become sums.

    Parameters
    ----------
    capacity_ah : float
        Charge from 100 to 0 % [Ah].
    chemistry : {"oxide", "lfp"}
    cells : int or None
        Cells in series.
    rate_hz : float
        Rate of the rows [Hz].
    """

    capacity_ah: float
    chemistry: ChemistryName = "oxide"
    cells: int | None = None
    rate_hz: float = 1.0


@dataclass(frozen=True, eq=False)
class SumsJob(Job):
    """Sums of each log.

    Parameters
    ----------
    fit : FleetFitOptions
    """

    fit: FleetFitOptions

    kind: ClassVar[str] = "sums"
    columns: ClassVar[Mapping[str, Any]] = {
        "name": TEXT, "data_sha256": TEXT, "signals_sha256": TEXT, "temperature_source": TEXT,
        "rows": COUNT, "row_s": REAL, "weight": REAL, "mean_soc_pct": REAL,
        "moments": _NUMBERS, "root": _NUMBERS, **dict.fromkeys(_RANGES, _NUMBERS),
    }  # fmt: skip

    def identity(self) -> dict[str, Any]:
        """Return the options of the fit."""
        return {"fit": repr(self.fit)}

    def row(self, log: FleetLog, path: Path | None, state: str | None) -> dict[str, Any]:
        """Return the log's sums, flattened.

        Raises
        ------
        InputError
            If the SoC at its start is unknown, or it was charged or driven in a gap.
        """
        del state
        recorded = self.options.read_log(log, required(path, log))
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
        rows = fit_rows(recorded, self.fit.capacity_ah, rate_hz=self.fit.rate_hz)
        sums = log_sums(rows, CHEMISTRIES[self.fit.chemistry])
        factor = factor_of(rows, len(DELAYS_S), EPSILON, REFERENCE_C)
        return {
            "name": recorded.name,
            "data_sha256": log_sha256(recorded),
            "signals_sha256": signals_sha256(recorded),
            "temperature_source": recorded.temperature_source,
            "rows": len(rows),
            "row_s": factor.row_s,
            "weight": sums.weight,
            "mean_soc_pct": sums.mean_soc_pct,
            "moments": sums.moments.ravel().tolist(),
            "root": factor.root.ravel().tolist(),
            **{name: list(getattr(ranges_of([rows]), name)) for name in _RANGES},
        }


def sums_of_row(row: Mapping[str, Any]) -> LogSums:
    """Return the sums of a row of `SumsJob`."""
    n = round(len(row["moments"]) ** 0.5)
    return LogSums(np.array(row["moments"]).reshape(n, n), row["weight"], row["mean_soc_pct"])


def factor_of_row(row: Mapping[str, Any]) -> Factor:
    """Return the published equation's factor of a row of `SumsJob`."""
    n = round(len(row["root"]) ** 0.5)
    low, high = row["soc_pct"]
    return Factor(np.array(row["root"]).reshape(n, n), row["rows"], row["row_s"], (low, high))


def ranges_of_rows(rows: Sequence[Mapping[str, Any]]) -> Ranges:
    """Return the ranges of several rows of `SumsJob`."""
    ends = {name: np.array([row[name] for row in rows]) for name in _RANGES}
    return Ranges(
        **{name: (float(v[:, 0].min()), float(v[:, 1].max())) for name, v in ends.items()}
    )
