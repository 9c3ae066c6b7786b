"""Fitted coefficients → model file: noise, information, where it came from."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cangauge import __version__
from cangauge.identify.effects.fitted import FittedEffects
from cangauge.identify.evaluate import LogFit
from cangauge.identify.held_out import LOGS_AT_LEAST
from cangauge.identify.least_squares import Solution
from cangauge.identify.noise import describe_noise
from cangauge.identify.options import FitOptions
from cangauge.identify.rows import FitRows
from cangauge.identify.voltage_fit import KT, stack
from cangauge.logs.log import Log
from cangauge.model.effects.library import effect_entries
from cangauge.model.model_file import (
    Coefficient,
    Information,
    Made,
    ModelFile,
    ModelNoise,
    Ranges,
    SourceLog,
    resistance_names,
)
from cangauge.model.voltage_model import BASIS_NAMES, VoltageModel

FloatArray = NDArray[np.float64]


def model_from_fit(
    logs: Sequence[Log],
    options: FitOptions,
    model: VoltageModel,
    solution: Solution,
    errors: tuple[Sequence[LogFit], Sequence[FloatArray]],
    *,
    found: FittedEffects | None = None,
) -> ModelFile:
    """Return the model file of a fit.

    Parameters
    ----------
    logs : sequence of Log
    options : FitOptions
        With the capacity that was used.
    model : VoltageModel
    solution : Solution
    errors : pair
        How the model fits each log, and each log's held-out errors [V].
    found : FittedEffects, optional
        Effects of the model.
    """
    fits, held_out_error_v = errors
    names = [*BASIS_NAMES, "kt", *resistance_names(len(options.delay_s))]
    rows = [item.rows for item in fits]
    return ModelFile.model_validate(
        {
            "name": options.name or ", ".join(log.name for log in logs[:3]),
            "coefficients": {
                name: Coefficient(value=float(value), std_error=float(error), unit=_unit(name))
                for name, value, error in zip(
                    names, solution.coefficients, solution.std_error, strict=True
                )
            },
            "epsilon": model.epsilon,
            "t_ref_c": model.t_ref_c,
            "delays_s": list(model.delay_s),
            "rate_hz": options.rate_hz,
            "capacity_ah": options.capacity_ah,
            "temperature_source": logs[0].temperature_source,
            "range": Ranges(
                soc_pct=model.soc_range_pct,
                temperature_c=model.temperature_range_c,
                current_a=model.current_range_a,
            ),
            "noise": _noise(fits, held_out_error_v, options),
            "effects": [] if found is None else effect_entries(found.model.effects),
            "information": _information(rows, options, names, solution, found),
            "made": _made(logs, options, rows),
        }
    )


def _unit(name: str) -> Literal["V", "V/K", "ohm"]:
    if name == "kt":
        return "V/K"
    return "ohm" if name.startswith("R") else "V"


def _noise(
    fits: Sequence[LogFit], held_out_error_v: Sequence[FloatArray], options: FitOptions
) -> ModelNoise:
    errors = np.concatenate(held_out_error_v)
    volts = np.concatenate([item.rows.voltage_v for item in fits])
    judged = np.isfinite(errors)
    whole_logs = len(fits) >= LOGS_AT_LEAST
    if not judged.any():
        errors = np.concatenate([item.residual_v for item in fits])
        judged = np.isfinite(errors)
        judged_on = "the rows of the fit itself (too short a log to hold any out)"
    elif whole_logs:
        judged_on = "whole logs left out in turn"
    else:
        judged_on = "interleaved blocks of 240 s left out in turn"
    # Blocks that were held out are short and far apart, which hides how long an error lasts; then
    # the residual of the whole log shows it.
    shown = held_out_error_v if whole_logs else [item.residual_v for item in fits]
    noise = describe_noise(
        [
            (item.rows.time_s[known], values[known])
            for item, values in zip(fits, shown, strict=True)
            if (known := np.isfinite(values)).any()
        ],
        options.rate_hz,
    )
    return ModelNoise(
        **vars(noise),
        voltage_mae_pct=100.0 * float(np.mean(np.abs(errors[judged]) / volts[judged])),
        voltage_rmse_v=float(np.sqrt(np.mean(errors[judged] ** 2))),
        judged_on=judged_on,
    )


def _information(
    rows: Sequence[FitRows],
    options: FitOptions,
    names: Sequence[str],
    solution: Solution,
    found: FittedEffects | None,
) -> Information:
    """Return the square root of the information that the rows hold on the coefficients.

    With effects, what the rows tell of both is shared: the effects' columns come first in the
    triangular factor, so that what is left to the coefficients is their own. The row that holds kt
    is one of them.
    """
    if found is None or not found.model.effects:
        columns, volts, _ = stack(rows, options)
        beside = np.empty((volts.size, 0))
    else:
        n = len(names)
        columns, beside = found.linear.columns[:, :n], found.linear.columns[:, n:]
        volts = found.linear.residual_v + columns @ found.linear.model.model.coefficients
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    first = beside.shape[1]
    table = np.column_stack([beside, columns / scale, volts])
    held = solution.held
    weight = 0.0
    if held is not None:
        weight = held.weight
    elif found is not None:
        weight = found.linear.kt_weight
    holding = np.zeros(table.shape[1])
    holding[first + KT] = weight / scale[KT]
    table = np.vstack([table, holding])
    root = np.linalg.qr(table).R[first:, first:]
    n = columns.shape[1]
    return Information(
        columns=list(names),
        scale=scale.tolist(),
        root=root[:n, :n].tolist(),
        projected=root[:n, n].tolist(),
        rows=columns.shape[0],
        residual_sum_v2=float(root[n, n] ** 2),
    )


def _made(logs: Sequence[Log], options: FitOptions, rows: Sequence[FitRows]) -> Made:
    hashes = [_sha256(log) for log in logs]
    return Made(
        by=f"cangauge {__version__}",
        options={
            "capacity_ah": options.capacity_ah,
            "initial_soc_pct": options.initial_soc_pct,
            "rate_hz": options.rate_hz,
            "delay_s": list(options.delay_s),
            "epsilon": options.epsilon,
            "t_ref_c": options.t_ref_c,
        }
        | ({"effects": ", ".join(options.effects)} if options.effects else {}),
        logs=[
            SourceLog(name=log.name, rows=len(item), sha256=digest)
            for log, item, digest in zip(logs, rows, hashes, strict=True)
        ],
        fingerprint=hashlib.sha256("".join(hashes).encode()).hexdigest(),
    )


def _sha256(log: Log) -> str:
    digest = hashlib.sha256()
    for channel in (log.time_s, log.current_a, log.voltage_v, log.temperature_c):
        digest.update(channel.tobytes())
    return digest.hexdigest()
