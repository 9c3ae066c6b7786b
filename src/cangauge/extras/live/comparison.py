"""Whether the gap between the pack and the model grows: the residual against the stated error."""

from __future__ import annotations

import math
import shlex
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import CangaugeError
from cangauge.extras.live.history import History, column
from cangauge.model.model_file import Model, Noise
from cangauge.types import Status

SIGNIFICANT: Final = 3.0
"""Standard deviations of the logarithm of a ratio of variances that count as a difference."""
LEAST_ROWS: Final = 600
"""Rows below which no comparison is shown: 10 min at one a second, as for `cangauge gap`."""
LOG_NAME: Final = "cangauge-last-hour.csv"
REFERENCE: Final = "GOOD.csv"
"""Stands for a log without a fault, which the reader puts in its place."""
LOG_COLUMNS: Final = ("time_s", "current_a", "voltage_v", "temperature_c")


def comparison(history: History) -> dict[str, Any]:
    """Return the RMS of the residual by time scale beside the model's stated error.

    The rows are those of the last hour, one a second; the last third is held against the rest.

    Returns
    -------
    dict
        "verdict" and "command" are text; "scales" has one object each, with RMS and floor [mV].
    """
    model = "" if history.status is None else str(history.status["model"])
    command = f"cangauge gap {LOG_NAME} -m {shlex.quote(str(Path(model).absolute()))}"
    try:
        file = _model(model, Path(model).stat().st_mtime_ns)
    except (CangaugeError, OSError) as error:
        file, problem = None, str(error)
    if file is not None and file.information is None:
        command += f" --reference {REFERENCE}"  # else an error of the model is no sign of a cause
    result: dict[str, Any] = {"command": command, "log": LOG_NAME, "scales": []}
    rows = history.spans["1h"].rows()
    status = column(rows, "status")
    usable = (status == Status.VALID) | (status == Status.DEGRADED)
    residual_mv = column(rows, "residual_mv")[usable]
    residual_mv = residual_mv[np.isfinite(residual_mv)]
    if residual_mv.size < LEAST_ROWS:
        minutes = math.ceil((LEAST_ROWS - residual_mv.size) / 60.0)
        return result | {"verdict": f"Too few samples yet: wait {minutes} min more."}
    if file is None:
        return result | {"verdict": f"The model cannot be read: {problem}"}
    scales = _scales(residual_mv, file.noise)
    return result | {"scales": scales, "verdict": _verdict(scales)}


def last_hour(history: History) -> str:
    """Return the last hour as a log that `cangauge gap` reads: CSV on bus time.

    A row is kept where bus time has moved on; times begin at the first row after the latest jump
    back, as after a restart.
    """
    rows = history.hour.rows()
    values = np.stack([column(rows, name) for name in LOG_COLUMNS], axis=1)
    values = values[np.isfinite(values[:, :2]).all(axis=1)]
    back = np.flatnonzero(np.diff(values[:, 0]) < 0.0)
    values = values[back[-1] + 1 :] if back.size else values
    values = values[np.diff(values[:, 0], prepend=-math.inf) > 0.0]
    lines = [",".join("" if math.isnan(v) else f"{v:.6g}" for v in row[1:]) for row in values]
    stamps = [f"{time_s:.6f}" for time_s in values[:, 0]]
    return "\n".join([",".join(LOG_COLUMNS), *map(",".join, zip(stamps, lines, strict=True)), ""])


@lru_cache(maxsize=1)
def _model(path: str, changed_ns: int) -> Model:  # noqa: ARG001 - read again once changed
    return Model.load(path)


def _scales(residual_mv: FloatArray, noise: Noise) -> list[dict[str, Any]]:
    """Return RMS and stated error of the residual's means over a block and over the slow error."""
    stated_v = {
        int(noise.block_s): (noise.fast_std_v, noise.slow_std_v, noise.level_std_v),
        int(noise.slow_time_s): (noise.slow_std_v, noise.level_std_v),
    }
    found = []
    for seconds, parts_v in stated_v.items():
        number = residual_mv.size // seconds
        means = residual_mv[: number * seconds].reshape(number, seconds).mean(axis=1)
        split = 2 * number // 3
        early, late = means[:split], means[split:]
        if min(early.size, late.size) < 2:
            break
        rms_mv, floor_mv = math.sqrt(float(np.mean(means**2))), 1000.0 * math.hypot(*parts_v)
        growth = float(np.mean(late**2)) / max(float(np.mean(early**2)), 1e-12)
        found.append(
            {
                "seconds": seconds,
                "rms_mv": rms_mv,
                "floor_mv": floor_mv,
                "growth": math.sqrt(growth),
                "above": _is_larger((rms_mv / max(floor_mv, 1e-9)) ** 2, 2.0 / number),
                "growing": _is_larger(growth, 2.0 / early.size + 2.0 / late.size),
            }
        )
    return found


def _is_larger(ratio: float, variance: float) -> bool:
    """Return whether a ratio of variances is above 1, given the variance of its logarithm."""
    return math.log(max(ratio, 1e-12)) > SIGNIFICANT * math.sqrt(variance)


def _verdict(scales: list[dict[str, Any]]) -> str:
    growing = [each["seconds"] for each in scales if each["growing"]]
    above = [each["seconds"] for each in scales if each["above"]]
    if above and growing:
        return f"The gap is growing, over {_range(growing)}: diagnose the last hour."
    if above:
        return f"The gap is larger than the model states, over {_range(above)}, and not growing."
    if growing:
        return f"The residual is growing over {_range(growing)}, within what the model states."
    return "No gap beyond what the model states."


def _range(seconds: list[int]) -> str:
    low, high = min(seconds), max(seconds)
    return f"{low} s" if low == high else f"{low}–{high} s"
