"""The energy balance of a log.

How well a voltage model explains rows of logs.

What the model's error is like in time: fast, slow, and lasting.

The filter must know the difference. An error that is new every second averages out; one that
lasts as long as a trip does not, however many samples are taken. All are read off the
autocovariance of errors on logs that the fit did not see.

Fitted coefficients → model file: noise, information, where it came from.

Identification: recorded logs → voltage model, with its figures.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import t as student_t

from cangauge import __version__
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.identify.effect_search import FittedEffects, fit_effects
from cangauge.identify.linearized import Prepared, prepare_log
from cangauge.identify.rows import LOGS_AT_LEAST, FitOptions, FitRows
from cangauge.identify.voltage_fit import KT, fit_voltage_model, held_out_errors, prepare, stack
from cangauge.inference.least_squares import Solution
from cangauge.logs.log import Log
from cangauge.model.charge import BRIDGE_S, capacity_from_full_discharge
from cangauge.model.delay_line import delayed_currents
from cangauge.model.effects.library import effect_entries
from cangauge.model.extended import ExtendedModel, Prediction
from cangauge.model.model_file import (
    Coefficient,
    Information,
    Made,
    Model,
    ModelNoise,
    Ranges,
    SourceLog,
    resistance_names,
)
from cangauge.model.voltage_model import BASIS_NAMES, VoltageModel, soc_from_ocv

# --- The energy balance of a log

JOULE_PER_KWH = 3.6e6


@dataclass(frozen=True)
class Energy:
    """Energy at the pack's terminals [kWh]."""

    driven_kwh: float
    """Taken out, ∫U·I over I > 0."""
    regenerated_kwh: float
    """Put back, −∫U·I over I < 0."""
    net_kwh: float
    heat_kwh: float
    """Joule heat, R·∫I² with the slope resistance R."""
    efficiency_pct: float
    """Net energy over net energy plus heat [%]."""


def energy_balance(logs: Sequence[Log], slope_ohm: float) -> Energy:
    """Return the energy balance summed over the logs, by the trapezoidal rule.

    Parameters
    ----------
    logs : sequence of Log
    slope_ohm : float
        Slope resistance [Ω], positive.
    """
    driven = regenerated = square = 0.0
    for log in logs:
        step_s = np.diff(log.time_s)
        step_s[step_s > BRIDGE_S] = 0.0
        power_w = log.voltage_v * log.current_a
        driven += _integral(np.maximum(power_w, 0.0), step_s)
        regenerated += _integral(np.maximum(-power_w, 0.0), step_s)
        square += _integral(log.current_a**2, step_s)
    net = driven - regenerated
    heat = slope_ohm * square
    return Energy(
        driven_kwh=driven / JOULE_PER_KWH,
        regenerated_kwh=regenerated / JOULE_PER_KWH,
        net_kwh=net / JOULE_PER_KWH,
        heat_kwh=heat / JOULE_PER_KWH,
        efficiency_pct=100.0 * net / (net + heat) if net + heat > 0.0 else float("nan"),
    )


def _integral(values: np.ndarray, step_s: np.ndarray) -> float:
    return float(np.sum((values[1:] + values[:-1]) * step_s) / 2.0)


# --- How well a voltage model explains rows of logs


@dataclass(frozen=True, eq=False)
class LogFit:
    """How the model fits one log; shape (m,) each, on the rows of the fit."""

    rows: FitRows
    pseudo_ocv_v: FloatArray
    voltage_model_v: FloatArray
    soc_newton_pct: FloatArray

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


def evaluate(model: VoltageModel, rows: Sequence[FitRows]) -> tuple[LogFit, ...]:
    """Return how the model explains each log's rows."""
    return tuple(_log_fit(model, item) for item in rows)


def _log_fit(model: VoltageModel, rows: FitRows) -> LogFit:
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
    )


def evaluate_extended(model: ExtendedModel, logs: Sequence[Prepared]) -> tuple[LogFit, ...]:
    """Return how a model with effects explains each log's rows.

    The rows are what perfect sensors would have shown, where an effect corrects them.
    """
    return tuple(_extended_fit(model, item) for item in logs)


def _extended_fit(model: ExtendedModel, log: Prepared) -> LogFit:
    found = model.predict(log.signals, log.initial_soc_pct, log.at)
    signals = found.signals
    delayed = delayed_currents(
        signals.time_s, signals.current_a, model.model.delay_s, signals.time_s
    )
    rows = replace(
        log.rows,
        voltage_v=signals.voltage_v[log.at],
        temperature_c=signals.temperature_c[log.at],
        soc_pct=found.soc_pct[log.at],
        delayed_current_a=delayed[log.at],
    )
    return LogFit(
        rows=rows,
        pseudo_ocv_v=model.model.pseudo_ocv(rows.soc_pct, rows.temperature_c),
        voltage_model_v=found.voltage_v,
        soc_newton_pct=_newton(model, found, delayed),
    )


def _newton(model: ExtendedModel, found: Prediction, delayed_a: FloatArray) -> FloatArray:
    """Return the inverse on the rows, the effects carried through every sample [%], shape (m,)."""
    online, signals = model.online(), found.signals
    wanted = dict(zip(found.rows.tolist(), range(found.rows.size), strict=True))
    newton = np.empty(found.rows.size)
    guess = 50.0
    samples = zip(
        signals.time_s.tolist(), signals.current_a.tolist(), signals.temperature_c.tolist(),
        signals.voltage_v.tolist(), delayed_a.tolist(), strict=True,
    )  # fmt: skip
    for k, (time_s, current_a, temperature_c, voltage_v, delayed) in enumerate(samples):
        online.advance(time_s, current_a, temperature_c, delayed)
        if k in wanted:
            beside = model.model.offset_at(temperature_c, delayed)
            guess = soc_from_ocv(online, voltage_v - beside, guess).soc_pct
            newton[wanted[k]] = guess
    return newton


def slope_resistance(model: VoltageModel, rows: Sequence[FitRows]) -> tuple[float, float]:
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


# --- What the model's error is like in time: fast, slow, and lasting

LAGS_S = (1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0)
TIME_CONSTANTS_S = (3.0, 10.0, 30.0, 100.0, 300.0, 1e6)
"""Durations that the error is made up of [s]; the last stands for the whole log. Those in between
cannot be told from it in trips of half an hour."""

SLOW_UNSEEN_S = 300.0
"""Duration of a slow part that the logs do not show [s]."""

SLOW_S, LASTING_S = 60.0, 1e5
"""Parts that last longer count as slow, and as lasting [s]."""

PARTS_AT_LEAST = 0.5
"""Fewer than three logs do not show how the error differs from log to log; the slow and the
lasting part are then taken to be at least this large, relative to the root mean square error."""


@dataclass(frozen=True)
class Noise:
    """The model's voltage error."""

    fast_std_v: float
    """Standard deviation of the fast part [V]."""
    fast_time_s: float
    """How long the fast part lasts [s]; 0 if it is new at each sample."""
    slow_std_v: float
    """Standard deviation of the slow part [V]."""
    slow_time_s: float
    """How long the slow part lasts [s]."""
    lasting_std_v: float
    """Standard deviation from log to log of what lasts as long as a log [V]."""


def describe_noise(residuals: Sequence[tuple[FloatArray, FloatArray]], rate_hz: float) -> Noise:
    """Split errors into a fast and a slow part.

    Parameters
    ----------
    residuals : sequence of (time_s, error_v)
        Errors [V] of each log on its rows' times [s], from a fit that did not see the log.
    rate_hz : float
        Rate of the rows.

    Notes
    -----
    The autocovariance at `LAGS_S` is fitted by a non-negative sum of white noise and exponentials
    with `TIME_CONSTANTS_S` (scipy's nnls).
    """
    lags = np.array([0.0, *LAGS_S])
    total, count = np.zeros(lags.size), np.zeros(lags.size)
    for time_s, error_v in residuals:
        on_grid, present = _on_grid(time_s, error_v, rate_hz)
        for k, lag in enumerate(lags):
            shift = round(lag * rate_hz)
            if shift >= on_grid.size or (lag > 0.0 and shift == 0):
                continue  # longer than the log, or shorter than a row lasts
            both = present[shift:] & present[: on_grid.size - shift]
            total[k] += float(on_grid[shift:][both] @ on_grid[: on_grid.size - shift][both])
            count[k] += float(both.sum())
    seen = count > 0
    covariance, weight = total[seen] / count[seen], np.sqrt(count[seen] / count[0])
    columns = np.column_stack(
        [lags[seen] == 0.0, *(np.exp(-lags[seen] / tau) for tau in TIME_CONSTANTS_S)]
    )
    variance, _ = nnls(columns * weight[:, None], covariance * weight)
    times = np.array([0.0, *TIME_CONSTANTS_S])
    slow = (times > SLOW_S) & (times < LASTING_S)
    fast = times <= SLOW_S
    slow_v2, lasting_v2 = float(variance[slow].sum()), float(variance[-1])
    if len(residuals) < LOGS_AT_LEAST:
        floor_v2 = PARTS_AT_LEAST**2 * float(covariance[0])
        slow_v2, lasting_v2 = max(slow_v2, floor_v2), max(lasting_v2, floor_v2)
    few = _few_logs(len(residuals))
    return Noise(
        fast_std_v=float(np.sqrt(variance[fast].sum())),
        fast_time_s=_mean_time(variance[fast], times[fast]),
        slow_std_v=few * math.sqrt(slow_v2),
        slow_time_s=_mean_time(variance[slow], times[slow]) or SLOW_UNSEEN_S,
        lasting_std_v=few * math.sqrt(lasting_v2),
    )


def _few_logs(number: int) -> float:
    """Return by how much a spread seen in a few logs understates that of the next log.

    The 95 % prediction interval of a normal variable from n values, relative to ±1.96 σ.
    """
    if number < LOGS_AT_LEAST:
        return 1.0
    return float(student_t.ppf(0.975, number - 1) / 1.96 * np.sqrt(1.0 + 1.0 / number))


def _mean_time(variance: FloatArray, times_s: FloatArray) -> float:
    total = float(variance.sum())
    return float(variance @ times_s) / total if total > 0.0 else 0.0


def _on_grid(
    time_s: FloatArray, error_v: FloatArray, rate_hz: float
) -> tuple[FloatArray, NDArray[np.bool_]]:
    slot = np.round((time_s - time_s[0]) * rate_hz).astype(np.intp)
    values, present = np.zeros(int(slot[-1]) + 1), np.zeros(int(slot[-1]) + 1, dtype=bool)
    values[slot] = error_v
    present[slot] = True
    return values, present


# --- Fitted coefficients → model file: noise, information, where it came from


def model_from_fit(
    logs: Sequence[Log],
    options: FitOptions,
    model: VoltageModel,
    solution: Solution,
    errors: tuple[Sequence[LogFit], Sequence[FloatArray]],
    *,
    found: FittedEffects | None = None,
) -> Model:
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
    return Model.model_validate(
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


# --- Identification: recorded logs → voltage model, with its figures

Progress = Callable[[str], None]

MOSTLY_KEPT = 0.8
"""If less of the temperature's coefficient is left, a remark says so."""


@dataclass(frozen=True, eq=False)
class Identification:
    """A fitted model with the figures that belong to it."""

    model: Model
    voltage_model: VoltageModel
    logs: tuple[Log, ...]
    fits: tuple[LogFit, ...]
    held_out_error_v: tuple[FloatArray, ...]
    """Measured minus predicted voltage of each log's rows, by fits that did not see the row [V];
    NaN where none judged it."""
    solution: Solution
    energy: Energy
    slope_ohm: float
    """Regression of U − pseudo-OCV on the current, as a positive resistance [Ω]."""
    slope_expected_ohm: float
    """−(R1 + Σ Rj·ρj), ρj the current's autocorrelation at the delays [Ω]."""
    voltage_mae_pct: float
    voltage_rmse_v: float
    soc_newton_mae_pct: float
    remarks: tuple[str, ...] = ()
    found: FittedEffects | None = None
    """Effects, where the options ask for them."""

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
        } | ({} if self.found is None else self.found.to_dict())


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
    for log in logs:
        if len(log) < 2:
            raise InputError(
                "a single row identifies nothing",
                source=log.source or log.name,
                cure="give a log of minutes or hours",
            )
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
    found = None
    if options.effects:
        # Beside effects the logs that are left out judge kt too, so it is left free, but for what
        # keeps it from being anything where the temperature never moves.
        free, _ = fit_voltage_model(rows, options, is_held=False)
        prepared = [prepare_log(log, options) for log in logs]
        found = fit_effects(ExtendedModel(free, capacity), prepared, options.effects, say)
    if found is not None and found.model.effects:
        voltage_model, solution = found.model.model, found.solution
        fits = evaluate_extended(found.model, prepared)
        held_out = list(found.held_out_error_v)
    else:
        voltage_model, solution = fit_voltage_model(rows, options)
        say("judging on rows that the fit did not see")
        held_out = held_out_errors(rows, options)
        fits = evaluate(voltage_model, rows)
    residual = np.concatenate([item.residual_v for item in fits])
    volts = np.concatenate([item.rows.voltage_v for item in fits])
    rows = [item.rows for item in fits]
    slope, expected = slope_resistance(voltage_model, rows)
    newton_error = np.concatenate([item.soc_newton_pct - item.rows.soc_pct for item in fits])
    return Identification(
        model=model_from_fit(logs, options, voltage_model, solution, (fits, held_out), found=found),
        voltage_model=voltage_model,
        logs=tuple(logs),
        fits=fits,
        held_out_error_v=tuple(held_out),
        solution=solution,
        energy=energy_balance(logs, slope),
        slope_ohm=slope,
        slope_expected_ohm=expected,
        voltage_mae_pct=100.0 * float(np.mean(np.abs(residual) / volts)),
        voltage_rmse_v=float(np.sqrt(np.mean(residual**2))),
        soc_newton_mae_pct=float(np.mean(np.abs(newton_error))),
        remarks=(
            *_remarks(voltage_model, solution, rows),
            *(found.remarks() if found is not None else ()),
        ),
        found=found,
    )


def _check_temperature_sources(logs: Sequence[Log]) -> None:
    sources = {log.temperature_source for log in logs}
    if len(sources) > 1:
        raise InputError(
            "the logs' temperatures were measured on different things",
            field="temperature_source",
            value=sorted(sources),
            cure="fit logs of one kind together",
        )


def _remarks(model: VoltageModel, solution: Solution, rows: Sequence[FitRows]) -> list[str]:
    remarks = []
    lo, hi = model.soc_range_pct
    if hi - lo < 50.0:
        remarks.append(
            f"the logs cover {lo:.0f}–{hi:.0f} % SoC; beyond, the pseudo-OCV goes on as a line"
        )
    t_lo, t_hi = model.temperature_range_c
    held = solution.held
    if held is not None and held.part < MOSTLY_KEPT:
        remarks.append(
            f"the logs ({t_lo:.1f} … {t_hi:.1f} °C) tell kt from the open-circuit voltage to"
            f" ±{held.std_v_per_k:.2g} V/K only: it is {model.kt_v_per_k:.3f} V/K, held by what is"
            f" usual (±{held.usual_v_per_k:.2g}); a log at another temperature would tell it"
        )
    elif t_hi - t_lo < 3.0:
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
