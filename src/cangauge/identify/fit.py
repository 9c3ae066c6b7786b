"""Identification: recorded logs → voltage model, with its figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge.errors import InputError
from cangauge.identify.charge import capacity_from_full_discharge
from cangauge.identify.effects.fitted import FittedEffects, fit_effects
from cangauge.identify.effects.prepared import prepare_log
from cangauge.identify.energy import Energy, energy_balance
from cangauge.identify.evaluate import LogFit, evaluate, evaluate_extended, slope_resistance
from cangauge.identify.least_squares import Solution
from cangauge.identify.model_from_fit import model_from_fit
from cangauge.identify.options import FitOptions
from cangauge.identify.rows import FitRows
from cangauge.identify.voltage_fit import fit_voltage_model, held_out_errors, prepare
from cangauge.logs.log import Log
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import ModelFile
from cangauge.model.voltage_model import VoltageModel

__all__ = ["FitOptions", "Identification", "fit"]

FloatArray = NDArray[np.float64]
Progress = Callable[[str], None]

MOSTLY_KEPT = 0.8
"""If less of the temperature's coefficient is left, a remark says so."""


@dataclass(frozen=True, eq=False)
class Identification:
    """A fitted model with the figures that belong to it."""

    model: ModelFile
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
