"""A fitted model with its figures: fit of each log, slope resistance, energy balance, tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from typing import Any, Final

import numpy as np

from cangauge._extras import extra
from cangauge._text import NONE_KNOWN, counted, duration, number, significant, span
from cangauge._typing import FloatArray
from cangauge.identify.effect_search import Selected
from cangauge.identify.published import PublishedFit
from cangauge.identify.rows import (
    CHUNK,
    SOC_SPAN_AT_LEAST_PCT,
    TEMPERATURE_SPAN_K,
    FitRows,
    usable_delays,
)
from cangauge.identify.starts import Start
from cangauge.logs.gaps import (
    BRIDGE_S,
    bridge_s,
    split_where_moved,
    uncounted_gaps,
    usual_step_s,
)
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import difference_from_reference, start_of
from cangauge.model.effects.base import Signals
from cangauge.model.extended import ExtendedModel, newton_soc
from cangauge.model.inverse import socs_from_ocv
from cangauge.model.model_file import Model
from cangauge.model.voltage_model import VoltageModel

NEAR_AN_END_PCT: Final = 10.0
"""Rest of the SoC beyond the logs that is not worth another drive [%]."""

AT_REST: Final = 0.1
"""Change of the current, over the capacity, below which the logs show no resistance [1/h]."""


@dataclass(frozen=True)
class Energy:
    """Energy at the pack's terminals [kWh]."""

    driven_kwh: float
    """Discharged, ∫U·I over I > 0."""
    regenerated_kwh: float
    """Charged, −∫U·I over I < 0."""
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
    sums = np.zeros(3)
    for log in logs:
        for first in range(0, len(log) - 1, CHUNK):
            part = slice(first, first + CHUNK + 1)  # with the first row of the next one
            step_s = np.diff(log.time_s[part])
            step_s[step_s > BRIDGE_S] = 0.0
            current_a = log.current_a[part]
            power_w = log.voltage_v[part] * current_a
            rates = np.stack([np.maximum(power_w, 0.0), np.maximum(-power_w, 0.0), current_a**2])
            sums += np.sum((rates[:, 1:] + rates[:, :-1]) * step_s, axis=1) / 2.0
    driven, regenerated, square = sums.tolist()
    net, heat = driven - regenerated, slope_ohm * square
    joule_per_kwh = 3.6e6
    return Energy(
        driven_kwh=driven / joule_per_kwh,
        regenerated_kwh=regenerated / joule_per_kwh,
        net_kwh=net / joule_per_kwh,
        heat_kwh=heat / joule_per_kwh,
        efficiency_pct=100.0 * net / (net + heat) if net > 0.0 else float("nan"),
    )


@dataclass(frozen=True, eq=False)
class LogFit:
    """Model and measurement of one log, shape (m,) each, on the rows of the fit."""

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
        """Mean absolute error of the Newton inverse against the counted SoC [% SoC]."""
        return float(np.mean(np.abs(self.soc_newton_pct - self.rows.soc_pct)))


def evaluate(model: ExtendedModel, rows: FitRows) -> LogFit:
    """Return the voltages and Newton inverse of a model on the rows of a log."""
    if not model.effects:
        columns = np.empty((3, len(rows)))
        for place, chunk in rows.chunks():
            columns[:, place] = _predicted(model.model, chunk)
        return LogFit(rows, *columns)
    log = rows.log
    row, soc_pct = start_of(log)
    prediction = model.predict(Signals.of(log), soc_pct, rows.at, initial_row=row)
    temperature_c = prediction.signals.temperature_c[rows.at]
    return LogFit(
        rows=rows,
        pseudo_ocv_v=model.model.pseudo_ocv(prediction.soc_pct[rows.at], temperature_c),
        voltage_model_v=prediction.voltage_v,
        soc_newton_pct=newton_soc(model, prediction),
    )


def _predicted(model: VoltageModel, rows: FitRows) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pseudo-OCV and voltage [V], and the Newton inverse [%], without effects."""
    currents = len(model.loads.resistance_ohm)  # the published equation has delayed ones only
    columns = model.load_columns(rows.temperature_c, rows.current_columns_a[:, :currents])
    load_v = columns @ model.load_coefficients
    voltage_v = model.pseudo_ocv(rows.soc_pct) + load_v
    newton_pct = socs_from_ocv(model, rows.voltage_v - load_v)
    return model.pseudo_ocv(rows.soc_pct, rows.temperature_c), voltage_v, newton_pct


def slope_resistances(
    fits: Sequence[LogFit], resistance_ohm: Sequence[float]
) -> tuple[float, float]:
    """Return the regression of U − pseudo-OCV on the current, and what the model expects of it [Ω].

    Both are positive. The expected one is −Σ Rm·ρm, ρm being the regression of the m-th current on
    the present one.

    Parameters
    ----------
    fits : sequence of LogFit
    resistance_ohm : sequence of float
        Rm of the first currents of the rows [Ω], negative.
    """
    total: Any = 0.0
    product: Any = 0.0
    for item in fits:
        for place, chunk in item.rows.chunks():
            drop_v = chunk.voltage_v - item.pseudo_ocv_v[place]
            table = np.column_stack([chunk.current_columns_a[:, : len(resistance_ohm)], drop_v])
            total = total + table.sum(axis=0)
            product = product + table[:, 0] @ table
    rows = sum(len(item.rows) for item in fits)
    covariance = product / rows - total[0] / rows * (total / rows)
    slopes = covariance / max(float(covariance[0]), 1e-300)
    return -float(slopes[-1]), -float(slopes[:-1] @ np.array(resistance_ohm))


@dataclass(frozen=True, eq=False, repr=False)
class Identification:
    """A fitted model with its figures."""

    model: Model
    starts: tuple[Start, ...]
    """The logs, their SoC at the start, and how it is known."""
    fits: tuple[LogFit, ...] = field(repr=False)
    """Model and measurement of each log, on the rows of the fit."""
    held_out_error_v: tuple[FloatArray, ...] = field(repr=False)
    """Measured minus predicted voltage of each log's rows by fits without the log [V]; () for
    fewer than three logs."""
    published: PublishedFit
    """The published equation on the same rows."""
    remarks: tuple[str, ...] = ()
    effects: Selected | None = None
    """Selected effects; None if none were asked for."""

    @property
    def logs(self) -> tuple[Log, ...]:
        """The logs of the fit; counting starts from their first finite SoC."""
        return tuple(start.log for start in self.starts)

    @cached_property
    def voltage_model(self) -> VoltageModel:
        """The model's equation, without effects."""
        return self.model.voltage_model()

    @cached_property
    def _slopes_ohm(self) -> tuple[float, float]:
        return slope_resistances(self.fits, self.voltage_model.loads.resistance_ohm)

    @property
    def slope_ohm(self) -> float:
        """Regression of U − pseudo-OCV on the current, as a positive resistance [Ω]."""
        return self._slopes_ohm[0]

    @property
    def slope_expected_ohm(self) -> float:
        """What the model's resistances expect of it [Ω]."""
        return self._slopes_ohm[1]

    @property
    def energy(self) -> Energy:
        """Energy at the pack's terminals over all logs."""
        return energy_balance(self.logs, self.slope_ohm)

    @property
    def verdict(self) -> str:
        """Where the model holds, its error there, and which log would widen it."""
        low, high = self.model.range.soc_pct
        least, most = self.model.range.current_a
        if high - low < SOC_SPAN_AT_LEAST_PCT and most - least < AT_REST * self.model.capacity_ah:
            return (
                f"The logs identify nothing: the SoC moves by {number(high - low, 1, '%')}, the"
                f" current by {number(most - least, 1, 'A')}. The curve {self.beyond}, and so do"
                " the resistances: add a drive."
            )
        noise = self.model.noise
        error, on = number(noise.voltage_mae_pct, 2, "%"), noise.judged_on
        text = f"Fitted from {low:.0f} to {high:.0f} % SoC: mean voltage error {error} on {on}."
        ends = [f"below {low:.0f} %"] if low > NEAR_AN_END_PCT else []
        ends += [f"above {high:.0f} %"] if high < 100.0 - NEAR_AN_END_PCT else []
        if ends:
            text += f" Add a drive {' and '.join(ends)}: there the curve {self.beyond}."
        least_c, most_c = self.model.range.temperature_c
        if (change_k := most_c - least_c) < TEMPERATURE_SPAN_K:
            text += (
                " No temperature dependence: the logs have one temperature, within"
                f" {number(change_k, 1, 'K')}."
            )
        return text

    @property
    def beyond(self) -> str:
        """What the curve does beyond the SoC of the logs, in a phrase."""
        knots = "follows the typical cell of the chemistry"
        return knots if self.model.equation == "knots" else "is extrapolated linearly"

    @property
    def is_held_out(self) -> bool:
        """Whether the error that the model states is of logs left out in turn."""
        return any(np.isfinite(error_v).any() for error_v in self.held_out_error_v)

    def _mean(self, of_logs: Iterable[float]) -> float:
        """Return the mean over the rows of all logs, given that of each."""
        rows = [len(item.rows) for item in self.fits]
        return float(np.average(list(of_logs), weights=rows))

    @property
    def voltage_mae_pct(self) -> float:
        """Mean absolute voltage error on the rows of the fit [%]."""
        return self._mean(item.voltage_mae_pct for item in self.fits)

    @property
    def voltage_rmse_v(self) -> float:
        """Root mean square of it [V]."""
        squares = (float(np.mean(item.residual_v**2)) for item in self.fits)
        return float(self._mean(squares) ** 0.5)

    @property
    def soc_newton_mae_pct(self) -> float:
        """Mean absolute error of the SoC from voltage on the rows of the fit [%]."""
        return self._mean(item.soc_newton_mae_pct for item in self.fits)

    def summary(self) -> dict[str, str]:
        """Return what the fit is good for, by name: the table of `cangauge fit`."""
        model, ranges = self.model, self.model.range
        held_out = number(model.noise.voltage_mae_pct, 3, "%") if self.is_held_out else NONE_KNOWN
        return {
            "voltage error, MAE": number(self.voltage_mae_pct, 3, "%"),
            "voltage error, RMSE": significant(self.voltage_rmse_v, 3, "V"),
            "voltage error held out, MAE": held_out,
            "SoC from voltage, MAE": number(self.soc_newton_mae_pct, 2, "%"),
            "capacity": number(model.capacity_ah, 2, "Ah"),
            "effects": ", ".join(effect["id"] for effect in model.effects) or NONE_KNOWN,
            "identified at SoC": span(*ranges.soc_pct, 1, "%"),
            "identified at temperature": span(*ranges.temperature_c, 1, "°C"),
            "rows used": str(sum(len(item.rows) for item in self.fits)),
        }

    def __repr__(self) -> str:
        """Return ten lines on what the fit is good for."""
        lines = [f"  {name:28}{text}" for name, text in self.summary().items()]
        return "\n".join([f"<Identification {self.model.name!r}", *lines]) + ">"

    def _repr_html_(self) -> str:
        """Return the same as a table, for notebooks."""
        rows = "".join(
            f"<tr><th>{name}</th><td>{escape(text)}</td></tr>"
            for name, text in self.summary().items()
        )
        return f"<table><caption>{escape(self.model.name)}</caption>{rows}</table>"

    def plot(self) -> Any:
        """Return pseudo-OCV and residuals, for `bokeh.plotting.show`."""
        return extra("report.fit:fit_figure")(self)

    def to_dict(self) -> dict[str, object]:
        """Return the object that `cangauge fit --json` prints."""
        model, noise = self.model, self.model.noise
        return {
            "verdict": self.verdict,
            "voltage_mae_pct": self.voltage_mae_pct,
            "voltage_rmse_v": self.voltage_rmse_v,
            "soc_newton_mae_pct": self.soc_newton_mae_pct,
            "capacity_ah": model.capacity_ah,
            "slope_ohm": self.slope_ohm,
            "slope_expected_ohm": self.slope_expected_ohm,
            "condition_number": self.published.condition_number,
            "coefficients": {name: item.model_dump() for name, item in model.coefficients.items()},
            "energy": vars(self.energy),
            "equation": model.equation,
            "chemistry": model.chemistry,
            "cells": model.cells,
            "held_out": {
                "voltage_mae_pct": noise.voltage_mae_pct if self.is_held_out else None,
                "voltage_rmse_v": noise.voltage_rmse_v if self.is_held_out else None,
                "judged_on": noise.judged_on,
                "scale": noise.left_out_scale,
            },
            "rows": sum(len(item.rows) for item in self.fits),
            "logs": [
                {
                    "name": item.rows.name,
                    "rows": len(item.rows),
                    "voltage_mae_pct": item.voltage_mae_pct,
                    "soc_newton_mae_pct": item.soc_newton_mae_pct,
                    "removed": item.rows.removed,
                    "initial_soc_pct": start.soc_pct,
                    "initial_soc_std_pct": start.std_pct,
                    "initial_soc_from": start.origin,
                }
                for item, start in zip(self.fits, self.starts, strict=True)
            ],
            "effects": model.effects,
            "effect_search": [vars(step) for step in self.effects.steps] if self.effects else [],
            "remarks": list(self.remarks),
        }


def remarks_on_rows(rows: Sequence[FitRows]) -> list[str]:
    """Return what is to be said about the rows that a fit leaves out."""
    removed = sum(item.removed["start_up_or_shut_down"] for item in rows)
    return [f"{counted(removed, 'row')} of start-up and shut-down left out"] if removed else []


def remarks_on_logs(
    starts: Sequence[Start], recorded: Sequence[Log], delay_s: Sequence[float], capacity_ah: float
) -> list[str]:
    """Return what is to be said about gaps, starts and counted charge of the logs."""
    found = []
    usable = usable_delays(recorded, delay_s)
    if len(usable) < len(delay_s):
        left_out = ", ".join(f"{delay:g}" for delay in delay_s if delay not in usable)
        step_s = min(usual_step_s(log.time_s) for log in recorded)
        found.append(f"rows every {step_s:.3g} s do not resolve a delay of {left_out} s")
    for log in recorded:
        gaps = uncounted_gaps(log.time_s)
        if gaps.size:
            longest = float(np.max(np.diff(log.time_s)[gaps]))
            found.append(
                f"{log.name}: {counted(gaps.size, 'gap')} of more than"
                f" {bridge_s(log.time_s):.0f} s, the longest {duration(longest)}: no charge is"
                " counted over them (a rest); split the log there if the pack was used"
            )
    estimated = [str(start) for start in starts if start.origin == "estimated"]
    if estimated:
        found.append(f"start estimated together with the curve: {'; '.join(estimated)}")
    pieces = [piece for log in recorded for piece in split_where_moved(log)]
    if len(pieces) > len(recorded):
        parts = ", ".join(piece.name for piece in pieces if " part " in piece.name)
        found.append(f"split where the pack was used in a gap: {parts}")
    differences = (difference_from_reference(piece, capacity_ah) for piece in pieces)
    return [*found, *(text for text in differences if text is not None)]


def remarks_on_effects(selected: Selected | None, model: Model) -> list[str]:
    """Return what is to be said about the selection of effects."""
    if selected is None:
        return []
    if not selected.steps and not selected.chosen:
        return ["effects need three logs, so that each can be left out"]
    error_v = significant(model.noise.voltage_rmse_v, 3)
    names = ", ".join(item.effect.id for item in selected.chosen)
    if not names:
        return [f"no effect lowers the error of left-out logs ({error_v} V) significantly"]
    return [f"effects: {names}; error of left-out logs {error_v} V"]
