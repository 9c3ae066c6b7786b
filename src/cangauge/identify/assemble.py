"""Parts of a model file, of one fit or of a fleet's."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from typing import Any, Final, Literal

import numpy as np

from cangauge._io import text_sha256
from cangauge._typing import FloatArray
from cangauge._version import __version__
from cangauge.errors import InputError
from cangauge.identify.log_errors import LogErrors
from cangauge.identify.voltage_fit import KT
from cangauge.inference.error_model import KNOTS_PCT, describe_error_of
from cangauge.inference.least_squares import Solution
from cangauge.inference.rows import LOGS_AT_LEAST, FitOptions
from cangauge.logs.log import Log, TemperatureSource
from cangauge.model.model_file import (
    Coefficient,
    CurveNoise,
    Information,
    Made,
    Model,
    ModelNoise,
    Ranges,
    SourceLog,
    resistance_names,
)
from cangauge.model.voltage_model import BASIS_NAMES, VoltageModel

FITTED_ROWS: Final = "the rows of the fit itself (too short a log to hold any out)"
BLOCKS: Final = "interleaved blocks of 240 s left out in turn"
WHOLE_LOGS: Final = "whole logs left out in turn"
"""How the held-out error was made: of no rows, of one or two logs, of three or more."""


def coefficients_of(names: Sequence[str], solution: Solution) -> dict[str, Coefficient]:
    """Return the coefficients with their standard errors and units."""
    return {
        key: Coefficient(value=float(value), std_error=float(error), unit=_unit(key))
        for key, value, error in zip(names, solution.coefficients, solution.std_error, strict=True)
    }


def _unit(name: str) -> Literal["V", "V/K", "ohm"]:
    if name == "kt":
        return "V/K"
    return "ohm" if name.startswith("R") else "V"


def model_file_of(
    voltage_model: VoltageModel, solution: Solution, options: FitOptions, **parts: Any
) -> Model:
    """Return the model file of a fit; the keywords are the other fields of `Model`."""
    return Model(
        coefficients=coefficients_of(coefficient_names(options), solution),
        epsilon=voltage_model.epsilon,
        t_ref_c=voltage_model.t_ref_c,
        delays_s=list(voltage_model.delay_s),
        rate_hz=options.rate_hz,
        capacity_ah=options.capacity_ah,
        range=Ranges(
            soc_pct=voltage_model.soc_range_pct,
            temperature_c=voltage_model.temperature_range_c,
            current_a=voltage_model.current_range_a,
        ),
        **parts,
    )


def coefficient_names(options: FitOptions) -> list[str]:
    """Return the names of the coefficients, in the order of the design matrix."""
    return [*BASIS_NAMES, "kt", *resistance_names(len(options.delay_s))]


def made_of(
    options: FitOptions, logs: list[SourceLog], sha256: Sequence[str], **further: Any
) -> Made:
    """Return how a model file was made: further options, logs listed, `log_sha256` of all."""
    return Made(
        by=f"cangauge {__version__}",
        options={
            "capacity_ah": options.capacity_ah,
            "initial_soc_pct": None,
            "rate_hz": options.rate_hz,
            "delay_s": list(options.delay_s),
            "epsilon": options.epsilon,
            "t_ref_c": options.t_ref_c,
            **further,
        },
        logs=logs,
        fingerprint=text_sha256("".join(sha256)),
    )


def common_temperature_source(sources: Iterable[TemperatureSource]) -> TemperatureSource:
    """Return the source of all logs' temperatures; raise InputError if they differ."""
    found = sorted(set(sources))
    if len(found) > 1:
        raise InputError(
            "the temperatures of the logs have different sources",
            field="temperature_source",
            value=found,
            cure="state it for the logs that do not (--temperature-source), or fit logs of one"
            " source together",
        )
    return found[0]


def noise_of(
    errors: LogErrors,
    model: VoltageModel,
    *,
    rate_hz: float,
    mean_c: float,
    spans: FloatArray,
) -> ModelNoise:
    """Return the error model and the held-out error of a fit.

    Parameters
    ----------
    errors : LogErrors
        Of all logs.
    model : VoltageModel
    rate_hz : float
        Rate of the rows.
    mean_c : float
        Mean temperature of the rows [°C].
    spans : array of shape (2,)
        Duration [s] and range of SoC [%], the mean of the logs.
    """
    sums = errors.sums
    rmse_v = float(np.sqrt(sums["square_v2"] / sums["rows"]))
    time_error, curve = describe_error_of(
        errors.equations,
        rms_v=rmse_v,
        mean_c=mean_c,
        ocv_v=model.pseudo_ocv(KNOTS_PCT),
        resistance_ohm=model.resistance_ohm,
        rate_hz=rate_hz,
    )
    mae_pct, judged_on = sums["voltage_pct"] / sums["rows"], FITTED_ROWS
    if held_out := sums["held_out"]:
        mae_pct = sums["held_out_pct"] / held_out
        rmse_v = float(np.sqrt(sums["held_out_v2"] / held_out))
        judged_on = WHOLE_LOGS if len(errors.equations.rows) >= LOGS_AT_LEAST else BLOCKS
    return ModelNoise(
        **vars(time_error),
        lasting_time_s=float(spans[0]),
        lasting_soc_pct=float(spans[1]),
        curve=CurveNoise(
            soc_pct=curve.soc_pct.tolist(),
            functions_v=curve.function_v.tolist(),
            temperature_c=curve.temperature_c,
            kt_std_v_per_k=curve.kt_std_v_per_k,
            resistance_std_per_k=curve.resistance_std_per_k,
        ),
        voltage_mae_pct=mae_pct,
        voltage_rmse_v=rmse_v,
        judged_on=judged_on,
    )


def information_of_rows(
    columns: FloatArray,
    effect_columns: FloatArray,
    volts: FloatArray,
    names: Sequence[str],
    kt_weight: float,
) -> Information:
    """Return the square root of the information of rows, or of their triangular factor.

    The columns of the effects come first in the triangular factor, so that they are marginalised.
    The priors of kt and of the pseudo-OCV are included.

    Parameters
    ----------
    columns : array of shape (m, n)
    effect_columns : array of shape (m, e)
    volts : array of shape (m,)
    names : sequence of n str
    kt_weight : float
        Weight of the prior's row kt = 0 V/K [K].
    """
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    first, n = effect_columns.shape[1], columns.shape[1]
    table = np.column_stack([effect_columns, columns / scale, volts])
    prior_row = np.zeros(table.shape[1])
    prior_row[first + KT] = kt_weight / scale[KT]
    root = np.linalg.qr(np.vstack([table, prior_row])).R[first:, first:]
    return Information(
        columns=list(names),
        scale=scale.tolist(),
        root=root[:n, :n].tolist(),
        projected=root[:n, n].tolist(),
    )


def signals_sha256(log: Log) -> str:
    """Return what identifies the rows of a log: the SHA-256 of its current and voltage."""
    return _sha256(log.current_a, log.voltage_v)


def log_sha256(log: Log) -> str:
    """Return the SHA-256 of a log's channels in hexadecimal."""
    return _sha256(log.time_s, log.current_a, log.voltage_v, log.temperature_c)


def _sha256(*channels: FloatArray) -> str:
    digest = hashlib.sha256()
    for channel in channels:
        digest.update(np.ascontiguousarray(channel).data)
    return digest.hexdigest()


def common_name(names: Sequence[str]) -> str:
    """Return a name for several logs: their common prefix and their number.

    Examples
    --------
    >>> common_name(["TripA01", "TripA03", "TripA05"])
    'TripA (3 logs)'
    """
    if len(names) == 1:
        return names[0]
    prefix = os.path.commonprefix(list(names))  # noqa: RUF071 - of strings, not of paths
    if any(name[len(prefix) : len(prefix) + 1].isdigit() for name in names):
        prefix = prefix.rstrip("0123456789")  # of a number that differs
    prefix = prefix.rstrip(" _-.,(")
    if not prefix:
        return f"{names[0]} and {len(names) - 1} more"
    return f"{prefix} ({len(names)} logs)"
