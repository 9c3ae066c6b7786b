"""`fleet fit`: each log is reduced to its sums on a worker, and these add up to one model.

The sums are those of `identify`: moments of the knots' equation, and the triangular factor of the
published one. Added over all logs, they give the coefficients of `cangauge fit` on the same logs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
import pyarrow as pa

from cangauge._files import text_sha256
from cangauge._text import counted
from cangauge._version import __version__
from cangauge.errors import InputError
from cangauge.extras.fleet.jobs import COUNT, REAL, TEXT, Job, by_log
from cangauge.extras.fleet.outliers import ErrorsByLog
from cangauge.extras.fleet.results import Results, by_kind
from cangauge.extras.fleet.run import Summary, run_id, run_job
from cangauge.extras.fleet.sources import FleetLog
from cangauge.identify.fit import (
    EPSILON,
    ROWS_CHANNELS,
    common_name,
    knots_file,
    log_sha256,
    ranges_of,
)
from cangauge.identify.least_squares import (
    LOGS_AT_LEAST,
    LogSums,
    Solution,
    log_sums,
    solve_scaled,
)
from cangauge.identify.published import Factor, PublishedFit, factor_of, pooled, solve_published
from cangauge.identify.rows import fit_rows
from cangauge.identify.starts import unknown_start
from cangauge.logs.gaps import split_where_moved
from cangauge.model.model_file import Made, Model, Ranges, SourceLog
from cangauge.model.prior import CHEMISTRIES, DELAYS_S, ChemistryName
from cangauge.model.voltage_model import REFERENCE_C

LISTED_LOGS: Final = 4096
"""Source logs that a model file lists; of more, only its options hold the number."""
_RATE_HZ: Final = 1.0
"""Rate of the rows [Hz], as that of `cangauge fit` by default."""
_NUMBERS: Final = pa.list_(pa.float64())
_RANGES: Final = ("soc_pct", "temperature_c", "current_a", "voltage_v")

Row = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class SumsJob(Job):
    """Sums of each log.

    Parameters
    ----------
    capacity_ah : float
        Charge from 100 to 0 % [Ah].
    chemistry : {"oxide", "lfp"}
    cells : int or None
        Cells in series.
    """

    capacity_ah: float
    chemistry: ChemistryName = "oxide"
    cells: int | None = None

    kind: ClassVar[str] = "sums"
    columns: ClassVar[Mapping[str, Any]] = {
        "name": TEXT, "data_sha256": TEXT, "signals_sha256": TEXT, "temperature_source": TEXT,
        "rows": COUNT, "row_s": REAL, "weight": REAL, "mean_soc_pct": REAL,
        "moments": _NUMBERS, "root": _NUMBERS, **dict.fromkeys(_RANGES, _NUMBERS),
    }  # fmt: skip

    def identity(self) -> dict[str, Any]:
        """Return the options of the fit."""
        return {"fit": [self.capacity_ah, self.chemistry, self.cells]}

    def row(self, log: FleetLog) -> dict[str, Any]:
        """Return the log's sums, flattened.

        Raises
        ------
        InputError
            If the SoC at its start is unknown, or it was charged or driven in a gap.
        """
        recorded = self.read(log)
        if recorded.first_soc() is None:
            unknown = unknown_start(recorded, others=False)
            cure = "state initial_soc_pct in a manifest, or name the SoC ([columns] of --map)"
            raise InputError(unknown.problem, field=unknown.field, cure=cure)
        if len(split_where_moved(recorded)) > 1:
            raise InputError(
                "the pack was charged or driven in a gap of this log",
                field="time_s",
                cure="split it there: each part begins with its own SoC",
            )
        rows = fit_rows(recorded, self.capacity_ah, rate_hz=_RATE_HZ)
        sums = log_sums(rows, CHEMISTRIES[self.chemistry])
        factor = factor_of(rows, len(DELAYS_S), EPSILON, REFERENCE_C)
        return {
            "name": recorded.name,
            "data_sha256": log_sha256(recorded),
            "signals_sha256": log_sha256(recorded, ROWS_CHANNELS),
            "temperature_source": recorded.temperature_source,
            "rows": len(rows),
            "row_s": factor.row_s,
            "weight": sums.weight,
            "mean_soc_pct": sums.mean_soc_pct,
            "moments": sums.moments.ravel().tolist(),
            "root": factor.root.ravel().tolist(),
            **{name: list(getattr(ranges_of([rows]), name)) for name in _RANGES},
        }


def _square(values: Sequence[float]) -> Any:
    n = round(len(values) ** 0.5)
    return np.array(values).reshape(n, n)


def _factor(row: Row) -> Factor:
    low, high = row["soc_pct"]
    return Factor(_square(row["root"]), row["rows"], row["row_s"], (low, high))


@dataclass(frozen=True, eq=False)
class FleetFit:
    """Model of all logs, with its figures.

    Parameters
    ----------
    model : Model
    solution : Solution
    published : PublishedFit
        The published equation on the same rows.
    voltage_rmse_v : float
        Rms error of all logs under the model [V], weighted as in the fit.
    rows, logs_used : int
    summary : Summary
        Of the pass.
    by_log : ErrorsByLog
    left_out, bad : list of dict
        Logs that could be read but are not of the fit, and those set aside, each with `log`,
        `reason` and its `kind`.
    """

    model: Model
    solution: Solution
    published: PublishedFit
    voltage_rmse_v: float
    rows: int
    logs_used: int
    summary: Summary
    by_log: ErrorsByLog
    left_out: list[dict[str, Any]]
    bad: list[dict[str, Any]]

    def to_dict(self) -> dict[str, Any]:
        """Return the object that `cangauge fleet fit --json` prints."""
        model, noise = self.model, self.model.noise
        return {
            "voltage_rmse_v": self.voltage_rmse_v,
            "voltage_rmse_pct": 100.0 * self.voltage_rmse_v / self.solution.mean_v,
            "capacity_ah": model.capacity_ah,
            "condition_number": self.published.condition_number,
            "coefficients": {name: item.model_dump() for name, item in model.coefficients.items()},
            "chemistry": model.chemistry,
            "held_out": {
                "voltage_rmse_v": noise.voltage_rmse_v,
                "judged_on": noise.judged_on,
                "scale": noise.left_out_scale,
            },
            **self.by_log.to_dict(),
            "rows": self.rows,
            "pass": vars(self.summary),
            "logs": self.logs_used,
            "left_out": self.left_out,
            "bad": self.bad,
        }


def fit_fleet(job: SumsJob, logs: Sequence[FleetLog], out: str, client: Any) -> FleetFit:
    """Identify the model of a type of pack from all logs of a fleet.

    Parameters
    ----------
    job : SumsJob
    logs : sequence of FleetLog
    out : str
        Folder or URL of the results.
    client : distributed.Client

    Raises
    ------
    InputError
        If fewer than three logs can be used.
    """
    results = Results(out, job.kind, job.columns)
    summary = run_job(job, by_log(logs), results, client)
    among = {(log.url, log.vehicle): k for k, log in enumerate(logs)}
    found = {
        row["log"]: row
        for row in results.rows()
        if row["run"] == run_id(job) and (row["log"], row["vehicle"]) in among
    }
    read = sorted(found.values(), key=lambda row: among[row["log"], row["vehicle"]])
    bad = [
        {"table": job.kind, **{name: row[name] for name in ("log", "reason", "kind")}}
        for row in results.rows(bad=True)
        if (row["log"], row["vehicle"]) in among and row["log"] not in found
    ]
    reasons = _reasons_left_out(read)
    rows = [row for row in read if row["log"] not in reasons]
    left_out = [{"log": url, **reason} for url, reason in reasons.items()]
    if len(rows) < LOGS_AT_LEAST:
        most = [f"{n} left out: {row['reason']}" for row, n in by_kind(left_out)[:1]]
        aside = f"see the reasons in {job.kind}-bad; one or two logs: `cangauge fit`"
        raise InputError(
            f"only {counted(len(rows), 'log')} can be used, {LOGS_AT_LEAST} are needed",
            source=out,
            cure="; ".join([aside, *most]),
        )
    sums = [LogSums(_square(r["moments"]), r["weight"], r["mean_soc_pct"]) for r in rows]
    solution, without = solve_scaled(sums, job.capacity_ah, CHEMISTRIES[job.chemistry])
    published = solve_published(pooled([_factor(row) for row in rows]), EPSILON)
    model = _model(job, rows, solution, published, _rmse(without, sums))
    return FleetFit(
        model=model,
        solution=solution,
        published=published,
        voltage_rmse_v=_rmse([solution] * len(sums), sums),
        rows=sum(row["rows"] for row in rows),
        logs_used=len(rows),
        summary=summary,
        by_log=ErrorsByLog(
            [row["log"] for row in rows],
            [row["vehicle"] for row in rows],
            np.array([solution.mean_error(item)[0] for item in sums]),
            np.sqrt([solution.square_error(item) for item in sums]),
            np.array([item.weight for item in sums]),
            model.noise,
        ),
        left_out=left_out,
        bad=bad,
    )


def _reasons_left_out(rows: Sequence[Row]) -> dict[str, dict[str, str]]:
    """Return why logs are left out, by URL: temperatures measured elsewhere, the same rows."""
    # The same rows count once.
    distinct = {(row["signals_sha256"], row["temperature_source"]) for row in rows}
    counts = Counter(source for _, source in distinct)
    # A known place before "unknown" where both are as frequent.
    most = max(counts, key=lambda name: (counts[name], name != "unknown"), default="")
    found: dict[str, dict[str, str]] = {}
    firsts: dict[str, str] = {}
    for row in rows:
        source, url = row["temperature_source"], row["log"]
        if source != most:
            found[url] = {
                "reason": f"its temperature source is {source}, that of"
                f" {counted(counts[most], 'other')} {most}; a column temperature_source"
                " states it where a log does not",
                "kind": f"its temperature source is {source}",
            }
        elif (first := firsts.setdefault(row["signals_sha256"], url)) != url:
            found[url] = {"reason": f"same rows as {first}", "kind": "same rows as another"}
    return found


def _model(
    job: SumsJob,
    rows: Sequence[Row],
    solution: Solution,
    published: PublishedFit,
    held_out_v: float,
) -> Model:
    ends = {name: np.array([row[name] for row in rows]) for name in _RANGES}
    ranges = {name: (float(v[:, 0].min()), float(v[:, 1].max())) for name, v in ends.items()}
    listed = rows if len(rows) <= LISTED_LOGS else []
    fields: dict[str, Any] = {
        "name": common_name([row["name"] for row in rows]),
        "chemistry": job.chemistry,
        "cells": job.cells,
        "capacity_ah": job.capacity_ah,
        "rate_hz": _RATE_HZ,
        "temperature_source": rows[0]["temperature_source"],
        "range": Ranges(**ranges),
        "made": Made(
            by=f"cangauge {__version__}",
            options={
                "capacity_ah": job.capacity_ah,
                "rate_hz": _RATE_HZ,
                "chemistry": job.chemistry,
                "equation": "knots",
                "fleet_logs": len(rows),
            },
            logs=[
                SourceLog(name=row["name"], rows=row["rows"], sha256=row["data_sha256"])
                for row in listed
            ],
            fingerprint=text_sha256("".join(row["data_sha256"] for row in rows)),
        ),
    }
    if published.identified:
        fields["published"] = published.fields(EPSILON, REFERENCE_C, DELAYS_S)
    judged = {
        "voltage_rmse_v": held_out_v,
        "voltage_mae_pct": 100.0 * (2.0 / np.pi) ** 0.5 * held_out_v / solution.mean_v,
        "judged_on": "logs left out in turn",
    }
    return knots_file(solution, fields, judged)


def _rmse(solutions: Sequence[Solution], sums: Sequence[LogSums]) -> float:
    """Return the rms error of logs [V], each by a solution, weighted by their time."""
    weight = sum(item.weight for item in sums)
    pairs = zip(solutions, sums, strict=True)
    square = sum(a.square_error(item) * item.weight for a, item in pairs)
    return float((square / weight) ** 0.5)
