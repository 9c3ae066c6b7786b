"""`fleet fit`: one model from all logs, by one pass that reduces each log to its sums.

The rows of the pass are kept, so that a further log costs the reading of itself. The sums give the
model, the models without some of the logs, and the error of each log, as in `cangauge fit`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cangauge._files import text_sha256
from cangauge._text import counted
from cangauge._version import __version__
from cangauge.errors import InputError
from cangauge.extras.fleet.dataset import Dataset, by_kind
from cangauge.extras.fleet.outliers import ErrorsByLog
from cangauge.extras.fleet.passes import (
    FleetFitOptions,
    SumsJob,
    factor_of_row,
    ranges_of_rows,
    sums_of_row,
)
from cangauge.extras.fleet.run import Summary, run_id, run_job
from cangauge.extras.fleet.sources import FleetLog, ReadOptions
from cangauge.identify.fit import EPSILON, LISTED_LOGS, common_name, knots_file, model_rmse
from cangauge.identify.least_squares import LOGS_AT_LEAST, LogSums, Solution, solve_scaled
from cangauge.identify.published import PublishedFit, pooled, solve_published
from cangauge.model.model_file import Made, Model, SourceLog
from cangauge.model.prior import CHEMISTRIES, DELAYS_S, REFERENCE_C


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
    slope_ohm : float
        As of `cangauge.Identification` [Ω], weighted as in the fit.
    rows : int
    logs_used : int
    summary : Summary
        Of the pass.
    by_log : ErrorsByLog
    left_out : list of dict
        Logs that could be read but are not of the fit, each with `log`, `reason` and its `kind`.
    bad : list of dict
        Logs set aside, each with `table`, `log`, `reason` and its `kind`.
    """

    model: Model
    solution: Solution
    published: PublishedFit
    voltage_rmse_v: float
    slope_ohm: float
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
            "slope_ohm": self.slope_ohm,
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
            "pass": self.summary.to_dict(),
            "logs": self.logs_used,
            "left_out": self.left_out,
            "bad": self.bad,
        }


def fit_fleet(
    logs: Sequence[FleetLog],
    options: ReadOptions,
    fit: FleetFitOptions,
    out: str,
    client: Any,
) -> FleetFit:
    """Identify the model of a type of pack from all logs of a fleet.

    Parameters
    ----------
    logs : sequence of FleetLog
    options : ReadOptions
    fit : FleetFitOptions
    out : str
        Folder or URL of the data set.
    client : distributed.Client

    Raises
    ------
    InputError
        If fewer than three logs can be used.
    """
    job = SumsJob(options, fit)
    dataset = Dataset(out, job.kind, job.columns)
    summary = run_job(job, logs, dataset, client)
    used, left_out = _usable(logs, dataset, run_id(job))
    found = {row["log"]: row for row in dataset.rows(run_id(job)) if _is_of(row, used)}
    rows = [found[url] for url in used]
    sums = [sums_of_row(row) for row in rows]
    chemistry = CHEMISTRIES[fit.chemistry]
    solution, without = solve_scaled(sums, fit.capacity_ah, chemistry)
    published = solve_published(pooled([factor_of_row(row) for row in rows]), EPSILON)
    fields: dict[str, Any] = {
        "name": common_name([row["name"] for row in rows]),
        "chemistry": fit.chemistry,
        "cells": fit.cells,
        "capacity_ah": fit.capacity_ah,
        "rate_hz": fit.rate_hz,
        "temperature_source": rows[0]["temperature_source"],
        "range": ranges_of_rows(rows),
        "made": _made(rows, fit),
    }
    if published.identified:
        fields["published"] = published.fields(EPSILON, REFERENCE_C, DELAYS_S)
    model = knots_file(solution, chemistry, fields)
    held_out_v = model_rmse(without, sums)
    noise = model.noise.model_copy(
        update={
            "voltage_rmse_v": held_out_v,
            "voltage_mae_pct": 100.0 * (2.0 / np.pi) ** 0.5 * held_out_v / solution.mean_v,
            "judged_on": "logs left out in turn",
        }
    )
    errors = [(item, solution.mean_error(item)[0], solution.square_error(item)) for item in sums]
    return FleetFit(
        model=model.model_copy(update={"noise": noise}),
        solution=solution,
        published=published,
        voltage_rmse_v=model_rmse([solution] * len(sums), sums),
        slope_ohm=_slope_ohm(sums, solution),
        rows=sum(row["rows"] for row in rows),
        logs_used=len(rows),
        summary=summary,
        by_log=ErrorsByLog.of_logs(
            [
                (row["log"], row["vehicle"], mean_v, square_v2**0.5, item.weight)
                for row, (item, mean_v, square_v2) in zip(rows, errors, strict=True)
            ],
            noise,
        ),
        left_out=left_out,
        bad=_bad(logs, dataset, run_id(job)),
    )


def _slope_ohm(sums: Sequence[LogSums], solution: Solution) -> float:
    """Return the regression of U − pseudo-OCV on the current, as a positive resistance [Ω]."""
    total = np.sum([item.moments for item in sums], axis=0)
    weight = sum(item.weight for item in sums)
    coefficients = solution.select.T @ solution.coefficients
    first = len(solution.arrhenius_ohm)
    curve = np.zeros(len(total))
    kt = len(coefficients) - 2 * first  # knots and kt come before the currents
    curve[:kt] = -coefficients[:kt]
    curve[-1] = 1.0
    current = np.zeros(len(total))
    current[kt] = 1.0
    one = np.zeros(len(total))
    one[-2] = 1.0
    spread = current @ total @ current - (one @ total @ current) ** 2 / weight
    shared = current @ total @ curve - (one @ total @ current) * (one @ total @ curve) / weight
    return -float(shared / spread)


_Used = dict[str, tuple[FleetLog, Mapping[str, Any]]]


def _is_of(row: Mapping[str, Any], used: _Used) -> bool:
    """Return whether a row is of a used log, and of the vehicle that it has now."""
    found = used.get(row["log"])
    return found is not None and found[0].vehicle == row["vehicle"]


def _bad(logs: Sequence[FleetLog], dataset: Dataset, run: str) -> list[dict[str, Any]]:
    among = {(log.url, log.vehicle) for log in logs}
    return [
        {"table": dataset.kind, **{name: row.get(name) for name in ("log", "reason", "kind")}}
        for row in dataset.rows(run, bad=True)
        if (row["log"], row["vehicle"]) in among
    ]


def _usable(
    logs: Sequence[FleetLog], dataset: Dataset, run: str
) -> tuple[_Used, list[dict[str, Any]]]:
    """Return the logs with sums, by URL in their order; and the others.

    The others have temperatures measured elsewhere, or the same rows as one before.
    """
    wanted = ("name", "rows", "data_sha256", "signals_sha256", "temperature_source")
    known = {url: row for url, row in dataset.known(run, *wanted).items() if "data_sha256" in row}
    used: _Used = {log.url: (log, known[log.url]) for log in logs if log.url in known}
    left_out = [*_measured_elsewhere(used), *_twins(used)]
    if len(used) < LOGS_AT_LEAST:
        most = [f"{n} left out: {row['reason']}" for row, n in by_kind(left_out)[:1]]
        raise InputError(
            f"only {counted(len(used), 'log')} can be used, {LOGS_AT_LEAST} are needed",
            source=dataset.out,
            cure="; ".join(
                [
                    f"see the reasons in {dataset.tables[1]}; one or two logs: `cangauge fit`",
                    *most,
                ]
            ),
        )
    return used, left_out


def _measured_elsewhere(used: _Used) -> list[dict[str, Any]]:
    """Take the logs out whose temperature source is not that of the most, and return them."""
    # The same rows count once.
    distinct = dict.fromkeys(
        (row["signals_sha256"], row["temperature_source"]) for _, row in used.values()
    )
    counts = Counter(source for _, source in distinct)
    # A known place before "unknown" where both are as frequent.
    most = max(counts, key=lambda name: (counts[name], name != "unknown"), default="")
    others = {url: row["temperature_source"] for url, (_, row) in used.items()}
    others = {url: source for url, source in others.items() if source != most}
    for url in others:
        del used[url]
    most_of_all = counted(counts[most], "other")
    return [
        {
            "log": url,
            "reason": f"its temperature source is {source}, that of {most_of_all} {most};"
            " --temperature-source states it where a log does not",
            "kind": f"its temperature source is {source}",
        }
        for url, source in others.items()
    ]


def _twins(used: _Used) -> list[dict[str, Any]]:
    """Take the logs out that have the same rows as one before, and return them."""
    firsts: dict[str, str] = {}
    others = {
        url: first
        for url, (_, row) in used.items()
        if (first := firsts.setdefault(row["signals_sha256"], url)) != url
    }
    for url in others:
        del used[url]
    return [
        {"log": url, "reason": f"same rows as {first}", "kind": "same rows as another"}
        for url, first in others.items()
    ]


def _made(rows: Sequence[Mapping[str, Any]], fit: FleetFitOptions) -> Made:
    listed = rows if len(rows) <= LISTED_LOGS else []
    return Made(
        by=f"cangauge {__version__}",
        options={
            "capacity_ah": fit.capacity_ah,
            "rate_hz": fit.rate_hz,
            "chemistry": fit.chemistry,
            "equation": "knots",
            "fleet_logs": len(rows),
        },
        logs=[
            SourceLog(name=row["name"], rows=row["rows"], sha256=row["data_sha256"])
            for row in listed
        ],
        fingerprint=text_sha256("".join(row["data_sha256"] for row in rows)),
    )
