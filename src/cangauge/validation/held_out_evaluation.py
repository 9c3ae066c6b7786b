"""Extended models on logs that the diagnosis never saw, through the estimator that runs live."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cangauge.estimate.offline import run_estimator, samples_of
from cangauge.estimate.settings import EstimatorSettings
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.model_file import Model

SETTLED_S: Final = 300.0
"""The SoC of the EKF is judged from here on, its initial SoC withheld [s]."""


def judge_later(
    label: Mapping[str, Any], plain: Path, extended: Path, sealed: Path
) -> dict[str, Any]:
    """Return errors of the plain and the extended model on the logs kept back for it.

    Parameters
    ----------
    label : mapping
        Its `judged_on` names the sealed logs by group.
    plain, extended : Path
        Model files.
    sealed : Path
        Folder of the sealed logs.

    Returns
    -------
    dict
        Group → list of `{"log", "plain": {…}, "extended": {…}}`, the errors as sums and counts,
        so that those of several logs can be pooled.
    """
    models = {"plain": Model.load(plain), "extended": Model.load(extended)}
    return {
        group: [
            {"log": item["log"]}
            | {
                name: errors_of(read_log(sealed / item["file"]), model)
                for name, model in models.items()
            }
            for item in items
        ]
        for group, items in label["judged_on"].items()
    }


def errors_of(log: Log, model: Model) -> dict[str, float]:
    """Return sums of squares and of absolute errors of one log.

    Voltage: at the SoC counted from the log's own start, on rows where the delay line is full.
    SoC: by the EKF with the start withheld, after `SETTLED_S`.
    """
    start = log.first_soc()
    # Rows before the first SoC tell nothing of where to count from.
    rows = log.rows(slice(0 if start is None else start[0], None))
    known = EstimatorSettings(method="coulomb", initial_soc_pct=None if start is None else start[1])
    voltage = run_estimator(samples_of(rows), model, known).residual_v
    full = rows.time_s - rows.time_s[0] >= max(model.delays_s)
    voltage = voltage[full & np.isfinite(voltage)]
    found = run_estimator(samples_of(log), model, EstimatorSettings())
    reference = np.full(len(log), np.nan) if log.soc_pct is None else log.soc_pct
    error = found.soc_pct - reference
    error = error[np.isfinite(error) & (log.time_s - log.time_s[0] >= SETTLED_S)]
    return {
        "voltage_squares": float(np.sum(voltage**2)),
        "voltage_rows": float(voltage.size),
        "soc_absolute": float(np.sum(np.abs(error))),
        "soc_rows": float(error.size),
    }


def pooled(items: Sequence[Mapping[str, Any]], name: str) -> dict[str, float | None]:
    """Return RMSE of the voltage [V] and MAE of the SoC [%] over all logs, for one model."""

    def total(key: str) -> float:
        return float(sum(item[name][key] for item in items))

    rows, soc_rows = total("voltage_rows"), total("soc_rows")
    return {
        "rmse_v": float(np.sqrt(total("voltage_squares") / rows)) if rows else None,
        "soc_mae_pct": total("soc_absolute") / soc_rows if soc_rows else None,
    }


def later_figures(judged: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return pooled and single figures of every group of kept-back logs."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for item in judged:
        for group, logs in item.items():
            groups.setdefault(group, []).extend(logs)
    return {
        group: {
            "plain": pooled(logs, "plain"),
            "extended": pooled(logs, "extended"),
            "logs": [
                {
                    "log": log["log"],
                    "plain": pooled([log], "plain"),
                    "extended": pooled([log], "extended"),
                }
                for log in logs
            ],
        }
        for group, logs in groups.items()
    }


def write_model(model: Mapping[str, Any], path: Path) -> Path:
    """Write a model that came in an answer, and return its path."""
    path.write_text(json.dumps(model), encoding="utf-8")
    return path
