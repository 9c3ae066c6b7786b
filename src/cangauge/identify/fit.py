"""Identification: recorded logs → voltage model, with its figures."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cangauge import __version__
from cangauge.errors import InputError
from cangauge.estimate.inverse import soc_from_ocv
from cangauge.identify.charge import capacity_from_full_discharge
from cangauge.identify.energy import Energy, energy_balance
from cangauge.identify.held_out import folds
from cangauge.identify.least_squares import BLOCK_S, Solution, solve
from cangauge.identify.noise import Noise, describe_noise
from cangauge.identify.rows import FitRows, fit_rows
from cangauge.logs.log import Log
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
from cangauge.model.voltage_model import (
    BASIS_NAMES,
    SLOPE_AT_LEAST,
    VoltageModel,
    ocv_basis,
    ocv_basis_slope,
)

FloatArray = NDArray[np.float64]
Progress = Callable[[str], None]

DELAYS_S = (0.0, 10.0, 30.0, 70.0)
SLOPE_CHECKS = 201
"""Points over the identified SoC at which the pseudo-OCV must rise."""

SOC_SPAN_AT_LEAST_PCT = 2.0
"""A fit over less SoC than this would be all extrapolation."""


@dataclass(frozen=True)
class FitOptions:
    """What a user may choose; the defaults are the published choices."""

    capacity_ah: float | None = None
    """Charge from 100 to 0 % [Ah]; by default from a log that runs from full to empty."""
    initial_soc_pct: float | None = None
    """SoC at each log's first row [%]; by default the logs' own reference, else 100."""
    rate_hz: float = 1.0
    delay_s: tuple[float, ...] = DELAYS_S
    epsilon: float = 0.05
    t_ref_c: float = 20.0
    name: str | None = None


@dataclass(frozen=True, eq=False)
class LogFit:
    """How the model fits one log; shape (m,) each, on the rows of the fit."""

    rows: FitRows
    pseudo_ocv_v: FloatArray
    voltage_model_v: FloatArray
    soc_newton_pct: FloatArray
    held_out_error_v: FloatArray
    """Measured minus predicted by a fit that did not see the row [V]; NaN where none judged it."""

    @property
    def residual_v(self) -> FloatArray:
        """Measured minus modelled voltage [V]."""
        return self.rows.voltage_v - self.voltage_model_v

    @property
    def voltage_mae_pct(self) -> float:
        """Mean absolute voltage error relative to the measured voltage [%]."""
        return 100.0 * float(np.mean(np.abs(self.residual_v) / self.rows.voltage_v))

    @property
    def soc_newton_mae_pct(self) -> float:
        """Mean absolute error of the inverse against the counted SoC [% SoC]."""
        return float(np.mean(np.abs(self.soc_newton_pct - self.rows.soc_pct)))


@dataclass(frozen=True, eq=False)
class Identification:
    """A fitted model with the figures that belong to it."""

    model: ModelFile
    voltage_model: VoltageModel
    logs: tuple[Log, ...]
    fits: tuple[LogFit, ...]
    solution: Solution
    energy: Energy
    slope_ohm: float
    """Regression of U − pseudo-OCV on the current, as a positive resistance [Ω]."""
    slope_expected_ohm: float
    """−(R1 + Σ Rj·ρj), ρj the current's autocorrelation at the delays [Ω]."""
    voltage_mae_pct: float
    voltage_rmse_v: float
    soc_newton_mae_pct: float
    remarks: tuple[str, ...] = field(default=())

    def to_dict(self) -> dict[str, object]:
        """Return the object that `cangauge fit --json` prints."""
        noise = self.model.noise
        return {
            "voltage_mae_pct": self.voltage_mae_pct,
            "voltage_rmse_v": self.voltage_rmse_v,
            "soc_newton_mae_pct": self.soc_newton_mae_pct,
            "capacity_ah": self.model.capacity_ah,
            "slope_ohm": self.slope_ohm,
            "slope_expected_ohm": self.slope_expected_ohm,
            "condition_number": self.solution.condition_number,
            "constrained": self.solution.constrained,
            "coefficients": {
                name: item.model_dump() for name, item in self.model.coefficients.items()
            },
            "energy": vars(self.energy),
            "held_out": {
                "voltage_mae_pct": noise.voltage_mae_pct,
                "voltage_rmse_v": noise.voltage_rmse_v,
                "judged_on": noise.judged_on,
            },
            "delays_s": list(self.model.delays_s),
            "rows": sum(len(item.rows) for item in self.fits),
            "logs": [
                {
                    "name": item.rows.name,
                    "rows": len(item.rows),
                    "voltage_mae_pct": item.voltage_mae_pct,
                    "soc_newton_mae_pct": item.soc_newton_mae_pct,
                    "removed": item.rows.removed,
                }
                for item in self.fits
            ],
            "remarks": list(self.remarks),
        }


def fit(
    logs: Sequence[Log], options: FitOptions | None = None, progress: Progress | None = None
) -> Identification:
    """Identify the voltage model from one or more logs of the same pack.

    Parameters
    ----------
    logs : sequence of Log
    options : FitOptions, optional
    progress : callable, optional
        Called with a line of text before each long step.

    Raises
    ------
    InputError
        If the logs cannot identify the model: no capacity, too little SoC, a pseudo-OCV that
        does not rise, temperatures of different sources.
    """
    options = options or FitOptions()
    say = progress or _silent
    if not logs:
        raise InputError("no log given", cure="name at least one recorded log")
    _check_temperature_sources(logs)
    capacity = options.capacity_ah
    if capacity is None:
        capacity = capacity_from_full_discharge(logs, options.initial_soc_pct)
    if not capacity > 0.0:
        raise InputError(
            "the capacity must be positive", field="capacity_ah", value=capacity,
            cure="check the sign of current: positive must discharge",
        )  # fmt: skip
    options = replace(options, capacity_ah=capacity)
    rows = prepare(logs, options)
    say(f"fitting {sum(map(len, rows))} rows of {len(rows)} logs")
    voltage_model, solution = fit_voltage_model(rows, options)
    say("judging on rows that the fit did not see")
    held_out = held_out_errors(rows, options)
    fits = tuple(
        _log_fit(voltage_model, item, errors) for item, errors in zip(rows, held_out, strict=True)
    )
    residual = np.concatenate([item.residual_v for item in fits])
    volts = np.concatenate([item.rows.voltage_v for item in fits])
    slope, expected = _slope_resistance(voltage_model, rows)
    newton_error = np.concatenate([item.soc_newton_pct - item.rows.soc_pct for item in fits])
    return Identification(
        model=_model_file(logs, options, voltage_model, solution, fits),
        voltage_model=voltage_model,
        logs=tuple(logs),
        fits=fits,
        solution=solution,
        energy=energy_balance(logs, slope),
        slope_ohm=slope,
        slope_expected_ohm=expected,
        voltage_mae_pct=100.0 * float(np.mean(np.abs(residual) / volts)),
        voltage_rmse_v=float(np.sqrt(np.mean(residual**2))),
        soc_newton_mae_pct=float(np.mean(np.abs(newton_error))),
        remarks=tuple(_remarks(voltage_model, solution, rows)),
    )


def prepare(logs: Sequence[Log], options: FitOptions) -> list[FitRows]:
    """Return the rows of each log that take part in the fit."""
    if options.capacity_ah is None:
        raise InputError("the capacity is not known", field="capacity_ah")
    return [
        fit_rows(
            log,
            capacity_ah=options.capacity_ah,
            delay_s=options.delay_s,
            rate_hz=options.rate_hz,
            initial_soc_pct=options.initial_soc_pct,
        )
        for log in logs
    ]


def fit_voltage_model(
    rows: Sequence[FitRows], options: FitOptions, keep: NDArray[np.bool_] | None = None
) -> tuple[VoltageModel, Solution]:
    """Fit the coefficients on the rows (of all logs in order) that `keep` selects."""
    columns, volts, block = _stack(rows, options)
    soc = np.concatenate([item.soc_pct for item in rows])
    temperature = np.concatenate([item.temperature_c for item in rows])
    current = np.concatenate([item.delayed_current_a[:, 0] for item in rows])
    if keep is not None:
        columns, volts, block = columns[keep], volts[keep], block[keep]
        soc, temperature, current = soc[keep], temperature[keep], current[keep]
    _check_identifiable(rows, soc, current, columns.shape)
    grid = np.linspace(soc.min(), soc.max(), SLOPE_CHECKS)
    bounds = np.zeros((SLOPE_CHECKS, columns.shape[1]))
    bounds[:, : len(BASIS_NAMES)] = ocv_basis_slope(grid, options.epsilon)
    solution = solve(columns, volts, block, bounds, SLOPE_AT_LEAST * float(np.median(volts)))
    x = [float(value) for value in solution.coefficients]
    return VoltageModel(
        ocv_v=tuple(x[: len(BASIS_NAMES)]),
        kt_v_per_k=x[len(BASIS_NAMES)],
        resistance_ohm=tuple(x[len(BASIS_NAMES) + 1 :]),
        delay_s=options.delay_s,
        epsilon=options.epsilon,
        t_ref_c=options.t_ref_c,
        soc_range_pct=(float(soc.min()), float(soc.max())),
        temperature_range_c=(float(temperature.min()), float(temperature.max())),
        current_range_a=(float(current.min()), float(current.max())),
    ), solution


def held_out_errors(rows: Sequence[FitRows], options: FitOptions) -> list[FloatArray]:
    """Return each log's errors [V] under fits that did not see the rows.

    NaN where no fold judged a row, or only with a fit that did not see its SoC: how far the
    model can be trusted beyond its range is another question (the estimate is flagged there).
    """
    volts = np.concatenate([item.voltage_v for item in rows])
    soc = np.concatenate([item.soc_pct for item in rows])
    temperature = np.concatenate([item.temperature_c for item in rows])
    delayed = np.concatenate([item.delayed_current_a for item in rows])
    errors = np.full(volts.size, np.nan)
    for fitted, left_out in folds(rows):
        model, _ = fit_voltage_model(rows, options, fitted)
        lo, hi = model.soc_range_pct
        judged = left_out & (soc > lo - 1.0) & (soc < hi + 1.0)
        errors[judged] = volts[judged] - model.voltage(
            soc[judged], temperature[judged], delayed[judged]
        )
    return np.split(errors, np.cumsum([len(item) for item in rows])[:-1])


def columns_of(rows: FitRows, epsilon: float, t_ref_c: float) -> FloatArray:
    """Return the model's columns k0 … k7, kt, R1 … Rn on the rows, shape (m, 9 + n)."""
    return np.column_stack(
        [ocv_basis(rows.soc_pct, epsilon), rows.temperature_c - t_ref_c, rows.delayed_current_a]
    )


def _stack(
    rows: Sequence[FitRows], options: FitOptions
) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
    columns = np.vstack([columns_of(item, options.epsilon, options.t_ref_c) for item in rows])
    volts = np.concatenate([item.voltage_v for item in rows])
    blocks, first = [], 0
    for item in rows:
        number = ((item.time_s - item.time_s[0]) // BLOCK_S).astype(np.intp) + first
        first = int(number[-1]) + 1
        blocks.append(number)
    return columns, volts, np.concatenate(blocks)


def _check_identifiable(
    rows: Sequence[FitRows], soc: FloatArray, current: FloatArray, shape: tuple[int, ...]
) -> None:
    where = ", ".join(item.name for item in rows)
    if shape[0] < 4 * shape[1]:
        raise InputError(
            f"{shape[0]} rows cannot identify {shape[1]} coefficients", source=where,
            cure="give a longer log or more logs",
        )  # fmt: skip
    if np.ptp(soc) < SOC_SPAN_AT_LEAST_PCT:
        raise InputError(
            f"the SoC moves by only {np.ptp(soc):.2f} %, too little for a voltage model",
            source=where,
            field="soc_pct",
            cure=f"give logs that together cover at least {SOC_SPAN_AT_LEAST_PCT:.0f} %,"
            " better the whole range",
        )
    if np.ptp(current) == 0.0:
        raise InputError(
            "the current never changes, so no resistance can be told from the open-circuit voltage",
            source=where,
            field="current_a",
            cure="give a log with changing load",
        )


def _log_fit(model: VoltageModel, rows: FitRows, held_out: FloatArray) -> LogFit:
    newton = np.empty(len(rows))
    guess = 50.0
    for k in range(len(rows)):
        beside = model.offset_at(float(rows.temperature_c[k]), rows.delayed_current_a[k].tolist())
        guess = soc_from_ocv(model, float(rows.voltage_v[k]) - beside, guess).soc_pct
        newton[k] = guess
    return LogFit(
        rows=rows,
        pseudo_ocv_v=model.pseudo_ocv(rows.soc_pct, rows.temperature_c),
        voltage_model_v=model.voltage(rows.soc_pct, rows.temperature_c, rows.delayed_current_a),
        soc_newton_pct=newton,
        held_out_error_v=held_out,
    )


def _slope_resistance(model: VoltageModel, rows: Sequence[FitRows]) -> tuple[float, float]:
    """Return the slope of (U − pseudo-OCV) on I, and R1 + Σ Rj·ρj, both turned positive [Ω]."""
    drop = np.concatenate(
        [item.voltage_v - model.pseudo_ocv(item.soc_pct, item.temperature_c) for item in rows]
    )
    delayed = np.concatenate([item.delayed_current_a for item in rows])
    centred = delayed - delayed.mean(axis=0)
    variance = float(centred[:, 0] @ centred[:, 0])
    correlation = centred.T @ centred[:, 0] / variance
    slope = float(centred[:, 0] @ (drop - drop.mean())) / variance
    return -slope, -float(np.array(model.resistance_ohm) @ correlation)


def _check_temperature_sources(logs: Sequence[Log]) -> None:
    sources = {log.temperature_source for log in logs}
    if len(sources) > 1:
        raise InputError(
            "the logs' temperatures were measured on different things",
            field="temperature_source",
            value=sorted(sources),
            cure="fit logs of one kind together",
        )


def _model_file(
    logs: Sequence[Log],
    options: FitOptions,
    model: VoltageModel,
    solution: Solution,
    fits: Sequence[LogFit],
) -> ModelFile:
    names = [*BASIS_NAMES, "kt", *resistance_names(len(options.delay_s))]
    units: list[Literal["V", "V/K", "ohm"]] = ["V" for _ in BASIS_NAMES]
    units += ["V/K", *("ohm" for _ in options.delay_s)]
    rows = [item.rows for item in fits]
    return ModelFile.model_validate(
        {
            "name": options.name or ", ".join(log.name for log in logs[:3]),
            "coefficients": {
                name: Coefficient(value=float(value), std_error=float(error), unit=unit)
                for name, value, error, unit in zip(
                    names, solution.coefficients, solution.std_error, units, strict=True
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
            "noise": _noise(fits, options),
            "information": information_of(rows, options, names),
            "made": _made(logs, options, rows),
        }
    )


def _noise(fits: Sequence[LogFit], options: FitOptions) -> ModelNoise:
    errors = np.concatenate([item.held_out_error_v for item in fits])
    volts = np.concatenate([item.rows.voltage_v for item in fits])
    judged = np.isfinite(errors)
    whole_logs = len(fits) >= 3
    if not judged.any():
        errors = np.concatenate([item.residual_v for item in fits])
        judged = np.isfinite(errors)
        judged_on = "the rows of the fit itself (too short a log to hold any out)"
    elif whole_logs:
        judged_on = "whole logs left out in turn"
    else:
        judged_on = "interleaved blocks of 240 s left out in turn"
    noise = _split_noise(fits, options, use_held_out=whole_logs)
    return ModelNoise(
        **vars(noise),
        voltage_mae_pct=100.0 * float(np.mean(np.abs(errors[judged]) / volts[judged])),
        voltage_rmse_v=float(np.sqrt(np.mean(errors[judged] ** 2))),
        judged_on=judged_on,
    )


def _split_noise(fits: Sequence[LogFit], options: FitOptions, *, use_held_out: bool) -> Noise:
    # Blocks that were held out are short and far apart, which hides how long an error lasts; the
    # residual of the whole log shows it.
    return describe_noise(
        [
            (item.rows.time_s[known], errors[known])
            for item in fits
            for errors in [item.held_out_error_v if use_held_out else item.residual_v]
            for known in [np.isfinite(errors)]
            if known.any()
        ],
        options.rate_hz,
    )


def information_of(
    rows: Sequence[FitRows], options: FitOptions, names: Sequence[str]
) -> Information:
    """Return the square root of the information that the rows hold on the coefficients."""
    columns, volts, _ = _stack(rows, options)
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    root = np.linalg.qr(np.column_stack([columns / scale, volts])).R
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
        },
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


def _remarks(model: VoltageModel, solution: Solution, rows: Sequence[FitRows]) -> list[str]:
    remarks = []
    lo, hi = model.soc_range_pct
    if hi - lo < 50.0:
        remarks.append(
            f"the logs cover {lo:.0f}–{hi:.0f} % SoC; beyond, the pseudo-OCV goes on as a line"
        )
    t_lo, t_hi = model.temperature_range_c
    if t_hi - t_lo < 3.0:
        remarks.append(
            f"the temperature moves by only {t_hi - t_lo:.1f} K: kt = {model.kt_v_per_k:.3f} V/K"
            " is hardly identified"
        )
    if solution.constrained:
        remarks.append("the plain fit's pseudo-OCV would fall somewhere: it was kept rising")
    removed = sum(item.removed["start_up_or_shut_down"] for item in rows)
    if removed:
        remarks.append(f"{removed} start-up or shut-down rows removed")
    if any(resistance > 0.0 for resistance in model.resistance_ohm[:1]):
        remarks.append(
            "R1 is positive: the voltage rises under load, so the sign of current is likely turned"
        )
    return remarks


def _silent(_text: str) -> None:
    """Say nothing."""
