"""`fleet fit`: one model from all logs, by two passes over them (`identify.voltage_fit`).

The rows of both passes are kept. A further log costs the reading of itself in the first pass; the
second pass is computed again for all, since each log changes the model.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from cangauge._formatting import counted
from cangauge.errors import InputError
from cangauge.extras.fleet.dataset import Dataset, by_kind
from cangauge.extras.fleet.outliers import ErrorsByLog
from cangauge.extras.fleet.passes import (
    ErrorsJob,
    InformationJob,
    errors_of_row,
    information_of_row,
)
from cangauge.extras.fleet.run import Summary, run_id, run_job
from cangauge.extras.fleet.sources import FleetLog, ReadOptions
from cangauge.identify.assemble import (
    coefficient_names,
    common_name,
    information_of_rows,
    made_of,
    model_file_of,
    noise_of,
)
from cangauge.identify.log_errors import LogErrors, slope_resistances, summed, with_std_errors
from cangauge.identify.voltage_fit import (
    LogInformation,
    fit_information,
    models_without,
    pooled,
)
from cangauge.inference.least_squares import Solution
from cangauge.inference.rows import (
    FOLDS_AT_MOST,
    LOGS_AT_LEAST,
    FitOptions,
)
from cangauge.model.model_file import Made, Model, SourceLog
from cangauge.model.voltage_model import VoltageModel

LISTED_LOGS: Final = 4096
"""Source logs that a model file names; of more, it states the number."""

POOLED_AT_ONCE: Final = 256
"""Logs of which the factors are stacked for one QR decomposition."""


@dataclass(frozen=True, eq=False)
class FleetFit:
    """Model of all logs, with its figures.

    Parameters
    ----------
    model : Model
    solution : Solution
    errors : LogErrors
        Of all logs.
    slope_ohm, slope_expected_ohm : float
        As of `cangauge.Identification` [Ω].
    summaries : tuple of Summary
        Of both passes.
    by_log : ErrorsByLog
    left_out : list of dict
        Logs that could be read but are not of the fit, each with `log`, `reason` and its `kind`.
    bad : list of dict
        Logs set aside, each with `table`, `log`, `reason` and its `kind`.
    """

    model: Model
    solution: Solution
    errors: LogErrors
    slope_ohm: float
    slope_expected_ohm: float
    summaries: tuple[Summary, ...]
    by_log: ErrorsByLog
    left_out: list[dict[str, Any]]
    bad: list[dict[str, Any]]

    @property
    def logs_used(self) -> int:
        """Number of logs of the fit."""
        return len(self.errors.equations.rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the object that `cangauge fleet fit --json` prints."""
        sums, noise = self.errors.sums, self.model.noise
        return {
            "voltage_mae_pct": sums["voltage_pct"] / sums["rows"],
            "voltage_rmse_v": float(np.sqrt(sums["square_v2"] / sums["rows"])),
            "soc_newton_mae_pct": sums["newton_pct"] / sums["rows"],
            "capacity_ah": self.model.capacity_ah,
            "slope_ohm": self.slope_ohm,
            "slope_expected_ohm": self.slope_expected_ohm,
            "condition_number": self.solution.condition_number,
            "constrained": self.solution.constrained,
            "coefficients": {
                name: item.model_dump() for name, item in self.model.coefficients.items()
            },
            "held_out": {
                "voltage_mae_pct": noise.voltage_mae_pct,
                "voltage_rmse_v": noise.voltage_rmse_v,
                "judged_on": noise.judged_on,
            },
            **self.by_log.to_dict(),
            "rows": int(sums["rows"]),
            "passes": [summary.to_dict() for summary in self.summaries],
            "logs": self.logs_used,
            "left_out": self.left_out,
            "bad": self.bad,
        }


def fit_fleet(
    logs: Sequence[FleetLog],
    options: ReadOptions,
    fit: FitOptions,
    out: str,
    client: Any,
    *,
    name: str | None = None,
) -> FleetFit:
    """Identify the model of a type of pack from all logs of a fleet.

    Parameters
    ----------
    logs : sequence of FleetLog
    options : ReadOptions
    fit : FitOptions
    out : str
        Folder or URL of the data sets of both passes.
    client : distributed.Client
    name : str, optional
        Name of the model.

    Raises
    ------
    InputError
        If fewer than three logs can be used, or they do not identify a model.
    """
    first = InformationJob(options, fit)
    dataset = Dataset(out, first.kind, first.columns)
    summary = run_job(first, logs, dataset, client)
    used, left_out = _usable(logs, dataset, run_id(first))
    by_fold = _pooled_by_fold(used, dataset, run_id(first))
    whole = pooled(by_fold)
    model, solution = fit_information(whole, fit, source=out)
    second = ErrorsJob(options, fit, model, solution, models_without(by_fold, fit), whole.mean_c)
    errors_set = Dataset(out, second.kind, second.columns)
    later = run_job(second, [log for log, _ in used.values()], errors_set, client)
    errors = _summed(errors_set.rows(run_id(second)), used, solution)
    if errors is None or errors.sums["rows"] < whole.rows:
        raise InputError(
            f"{counted(later.bad + later.bad_before, 'log')} of the first pass failed in the"
            " second",
            source=out,
            cure=f"see {second.kind}-bad in it, and run the same command again",
        )
    if not errors.sums["held_out"]:
        raise InputError(
            "no log has rows in the SoC range of the others, so that none can be held out",
            source=out,
            cure="give logs that overlap in SoC",
        )
    solution = with_std_errors(solution, errors.sums, errors.scores)
    slope, expected = slope_resistances(errors, model.resistance_ohm)
    rows = errors_set.rows(run_id(second), without=_NOT_BY_LOG)
    found = _model_file(whole, model, solution, errors=errors, fit=fit, used=used, name=name)
    return FleetFit(
        found,
        solution,
        errors,
        slope,
        expected,
        (summary, later),
        by_log=ErrorsByLog.of_rows((row for row in rows if _is_of(row, used)), found),
        left_out=left_out,
        bad=_bad(logs, dataset, run_id(first)),
    )


_Used = dict[str, tuple[FleetLog, Mapping[str, Any]]]


_NOT_BY_LOG: Final = ("scores", "means", "counts", "products")
"""Columns of `ErrorsJob` that the errors by log do not need."""


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
    """Return the logs with information, by URL in their order, each with a fold; and the others.

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
    number = min(len(used), FOLDS_AT_MOST)
    for k, (url, (log, found)) in enumerate(used.items()):
        used[url] = (replace(log, fold=k % number), found)
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


def _pooled_by_fold(used: _Used, dataset: Dataset, run: str) -> list[LogInformation]:
    waiting: dict[int, list[LogInformation]] = {}
    for row in dataset.rows(run):
        if not _is_of(row, used):
            continue
        parts = waiting.setdefault(used[row["log"]][0].fold, [])
        parts.append(information_of_row(row))
        if len(parts) >= POOLED_AT_ONCE:
            parts[:] = [pooled(parts)]
    return [pooled(waiting[fold]) for fold in sorted(waiting)]


def _summed(rows: Iterable[Mapping[str, Any]], used: _Used, solution: Solution) -> LogErrors | None:
    """Return the errors of all used logs together; None if there is no row."""
    kept = solution.back.shape[1]
    waiting: list[LogErrors] = []
    for row in rows:
        if _is_of(row, used):
            waiting.append(errors_of_row(row, kept))
        if len(waiting) >= POOLED_AT_ONCE:
            waiting = [summed(waiting)]
    return summed(waiting) if waiting else None


def _model_file(
    whole: LogInformation,
    model: VoltageModel,
    solution: Solution,
    *,
    errors: LogErrors,
    fit: FitOptions,
    used: _Used,
    name: str | None,
) -> Model:
    prior, root = solution.kt_prior, whole.root
    rows = [row for _, row in used.values()]
    return model_file_of(
        model,
        solution,
        fit,
        name=name or common_name([row["name"] for row in rows]),
        temperature_source=rows[0]["temperature_source"],
        noise=noise_of(
            errors,
            model,
            rate_hz=fit.rate_hz,
            mean_c=whole.mean_c,
            spans=whole.spans / whole.logs,
        ),
        effects=[],
        information=information_of_rows(
            root[:, :-1], np.empty((len(root), 0)), root[:, -1], coefficient_names(fit),
            0.0 if prior is None else prior.row_weight,
        ),
        made=_made(rows, fit),
    )  # fmt: skip


def _made(rows: Sequence[Mapping[str, Any]], fit: FitOptions) -> Made:
    listed = [
        SourceLog(name=row["name"], rows=row["rows"], sha256=row["data_sha256"])
        for row in (rows if len(rows) <= LISTED_LOGS else [])
    ]
    return made_of(fit, listed, [row["data_sha256"] for row in rows], fleet_logs=len(rows))
