"""Held-out evaluation: errors of plain and extended models on logs the diagnosis did not get."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cangauge.estimate.offline import run_estimator, samples_of
from cangauge.estimate.settings import EstimatorSettings
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.model_file import Model

_SETTLING_S: Final = 300.0
"""Time after which the SoC of the EKF is evaluated; it does not get the initial SoC [s]."""


def model_errors(
    label: Mapping[str, Any], plain: Path, extended: Path, withheld: Path
) -> dict[str, Any]:
    """Return the errors of plain and extended model on the held-out logs of a case.

    Parameters
    ----------
    label : mapping
        Its `judged_on` names the held-out logs by group.
    plain, extended : Path
        Model files.
    withheld : Path
        Folder of the held-out logs.

    Returns
    -------
    dict
        Group → list of `{"log", "plain": {…}, "extended": {…}}`, with errors as sums and counts to
        be pooled.
    """
    models = {"plain": Model.load(plain), "extended": Model.load(extended)}
    return {
        group: [
            {"log": item["log"]}
            | {
                name: _log_errors(read_log(withheld / item["file"]), model)
                for name, model in models.items()
            }
            for item in items
        ]
        for group, items in label["judged_on"].items()
    }


def _log_errors(log: Log, model: Model) -> dict[str, float]:
    """Return sums of squared voltage errors and of absolute SoC errors of one log.

    The voltage is predicted at the counted SoC, where the delay line is full. The SoC is that of
    the EKF without an initial SoC, after `_SETTLING_S`.
    """
    start = log.first_soc()
    # Counting starts at the first SoC.
    rows = log.rows(slice(0 if start is None else start[0], None))
    known = EstimatorSettings(method="coulomb", initial_soc_pct=None if start is None else start[1])
    voltage = run_estimator(samples_of(rows), model, known).residual_v
    full = rows.time_s - rows.time_s[0] >= max(model.delays_s)
    voltage = voltage[full & np.isfinite(voltage)]
    found = run_estimator(samples_of(log), model, EstimatorSettings())
    reference = np.full(len(log), np.nan) if log.soc_pct is None else log.soc_pct
    error = found.soc_pct - reference
    error = error[np.isfinite(error) & (log.time_s - log.time_s[0] >= _SETTLING_S)]
    return {
        "voltage_squares": float(np.sum(voltage**2)),
        "voltage_rows": float(voltage.size),
        "soc_absolute": float(np.sum(np.abs(error))),
        "soc_rows": float(error.size),
    }


def _pooled(items: Sequence[Mapping[str, Any]], name: str) -> dict[str, float | None]:
    """Return voltage RMSE [V] and SoC MAE [%] of one model over all logs."""

    def total(key: str) -> float:
        return float(sum(item[name][key] for item in items))

    rows, soc_rows = total("voltage_rows"), total("soc_rows")
    return {
        "rmse_v": float(np.sqrt(total("voltage_squares") / rows)) if rows else None,
        "soc_mae_pct": total("soc_absolute") / soc_rows if soc_rows else None,
    }


def pool_errors(errors: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the errors of each group of held-out logs, pooled and by log."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for item in errors:
        for group, logs in item.items():
            groups.setdefault(group, []).extend(logs)
    return {
        group: {
            "plain": _pooled(logs, "plain"),
            "extended": _pooled(logs, "extended"),
            "logs": [
                {
                    "log": log["log"],
                    "plain": _pooled([log], "plain"),
                    "extended": _pooled([log], "extended"),
                }
                for log in logs
            ],
        }
        for group, logs in groups.items()
    }
