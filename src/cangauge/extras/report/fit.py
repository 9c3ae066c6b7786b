"""The page of `cangauge fit`: the model's error, curves and coefficients, and how it was made."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from operator import attrgetter

import numpy as np

from cangauge._text import NONE_KNOWN, number, significant, span
from cangauge._typing import FloatArray
from cangauge.extras.report.charts import (
    BLUE,
    COLORS,
    ORANGE,
    Figure,
    Plot,
    TimeFigures,
    stacked,
)
from cangauge.extras.report.page import Page
from cangauge.identify.identification import Identification
from cangauge.identify.rows import running_rows
from cangauge.model.voltage_model import VoltageModel


def fit_page(result: Identification) -> Page:
    """Return the page of an identification."""
    time = _time(result)
    values = {
        "result": result,
        "voltage": _voltage_figure(result, time),
        "ocv": _ocv_figure(result),
        "slope": _slope_figure(result.voltage_model),
        "errors": _error_figures(result, time),
        "newton": _newton_figure(result, time),
        "resistance": _resistance_figure(result),
        "recorded": _recorded_figures(result, time),
        "held_out_mae_pct": _held_out_mae_pct(result),
        "removed": sum((Counter(item.rows.removed) for item in result.fits), Counter()),
        "remarks": _remarks(result),
        "with_error": _with_error,
    }
    return Page.of("fit.j2", values)


def fit_figure(result: Identification) -> Plot:
    """Return the pseudo-OCV over SoC, the residual over time and its histogram, for a notebook."""
    return stacked(_ocv_figure(result), *_error_figures(result, _time(result)))


def _time(result: Identification) -> TimeFigures:
    return TimeFigures([log.time_s for log in result.logs], [log.name for log in result.logs])


def _over_time(result: Identification, name: str) -> list[tuple[FloatArray, FloatArray]]:
    """Return time and an attribute of each log's fit."""
    values = attrgetter(name)
    return [(item.rows.time_s, values(item)) for item in result.fits]


def _voltage_figure(result: Identification, time: TimeFigures) -> Figure:
    return time.figure(
        "Measured voltage, model and pseudo-OCV",
        "voltage [V]",
        "The model should lie on the measurement. The pseudo-OCV is its part without current."
        " Rows that the fit did not use leave gaps.",
        {
            "measured": _over_time(result, "rows.voltage_v"),
            "model": _over_time(result, "voltage_model_v"),
            "pseudo-OCV": _over_time(result, "pseudo_ocv_v"),
        },
        height=320,
    )


def _ocv_figure(result: Identification) -> Figure:
    """Return the pseudo-OCV over SoC, with dots where the logs have it."""
    model = result.voltage_model
    effects = ", effects" if result.model.effects else ""
    figure = Figure(
        "Pseudo-OCV against SoC",
        "state of charge [%]",
        "voltage [V]",
        f"Dots: the measured voltage minus the model's resistances{effects} and temperature term."
        f" The logs cover {span(*model.range.soc_pct, 1, '%')}; in the shaded part the curve"
        f" {result.beyond}.",
        hover="$name: @y{0.00} V<br>at @x{0.0} %",
        height=340,
    )
    soc = np.concatenate([item.rows.soc_pct for item in result.fits])
    residual = np.concatenate([item.residual_v for item in result.fits])
    figure.cloud("measured, less drop", soc, residual + model.pseudo_ocv(soc))
    grid = np.linspace(min(0.0, soc.min()), max(100.0, soc.max()), 401)
    figure.line("pseudo-OCV", grid, model.pseudo_ocv(grid), BLUE, line_width=2.2)
    figure.shade_outside(*model.range.soc_pct)
    return figure


def _slope_figure(model: VoltageModel) -> Figure:
    figure = Figure(
        "Slope of the pseudo-OCV",
        "state of charge [%]",
        "dU/dS [V per %]",
        "A voltage error divided by this slope is the SoC error: where the slope is small, the"
        " voltage hardly determines the SoC.",
        hover="@y{0.000} V per %<br>at @x{0.0} %",
        height=340,
    )
    grid = np.linspace(0.0, 100.0, 401)
    figure.line("slope", grid, model.pseudo_ocv_slope(grid), BLUE, line_width=2.0)
    figure.shade_outside(*model.range.soc_pct)
    inside = model.pseudo_ocv_slope(np.linspace(*model.range.soc_pct, 201))
    # The slope rises tenfold at the ends; the middle matters.
    figure.plot.y_range.end = float(min(inside.max(), 4.0 * np.median(inside))) * 1.1
    figure.plot.y_range.start = 0.0
    return figure


def _error_figures(result: Identification, time: TimeFigures) -> list[Figure]:
    """Return the error over time and its histogram, of the fit and on rows held out of it."""
    lines = {"fit": _over_time(result, "residual_v")}
    held_out = [
        (item.rows.time_s, values)
        for item, values in zip(result.fits, result.held_out_error_v, strict=False)
    ]
    hidden = expected = ""
    if any(np.isfinite(values).any() for _, values in held_out):
        lines["held out"] = held_out
        hidden = " “Held out” (click the legend) is the error on rows that the fit did not see:"
        hidden += f" {result.model.noise.judged_on}."
        expected = "Expect “held out” on a new log. Where it is much wider than “fit”, the model"
        expected += " overfits its logs. "
    error = time.figure(
        "Measured minus modelled voltage",
        "voltage error [V]",
        f"A good fit scatters about zero without lasting bias.{hidden}",
        lines,
        height=260,
    )
    error.mark("width", 0.0)
    errors = [np.concatenate([values for _, values in pieces]) for pieces in lines.values()]
    return [error, _histogram(dict(zip(lines, errors, strict=True)), expected)]


def _histogram(errors_v: dict[str, FloatArray], expected: str) -> Figure:
    """Return the distribution of errors [V], each in % of its rows; NaN is left out."""
    known = {name: values[np.isfinite(values)] for name, values in errors_v.items()}
    # The outermost bars include outliers, which would otherwise compress the rest into one bar.
    limit = float(np.quantile(np.abs(np.concatenate([*known.values()])), 0.999))
    edges = np.linspace(-limit, limit, 61)
    shown = Figure(
        "Distribution of the error",
        "measured − model [V]",
        "share of rows [%]",
        f"{expected}The outermost bars include everything beyond.",
        hover="$name: @top{0.[00]} %<br>at @x{0.[000]} V",
    )
    for name, values in known.items():
        counts = np.histogram(np.clip(values, -limit, limit), edges)[0]
        bars = {"x": 0.5 * (edges[1:] + edges[:-1]), "top": 100.0 * counts / values.size}
        style = {"fill_color": COLORS[name], "fill_alpha": 0.4, "line_color": None}
        shown.draw("vbar", name, bars, width=float(edges[1] - edges[0]), **style)
    return shown


def _newton_figure(result: Identification, time: TimeFigures) -> Figure:
    return time.figure(
        "SoC from voltage alone",
        "state of charge [%]",
        "The voltage equation solved for SoC at each row by Newton's method, without counting. Mean"
        f" absolute error {number(result.soc_newton_mae_pct, 2, '%')}: the voltage error divided by"
        " the slope of the pseudo-OCV, so it is large where that is flat.",
        {
            "by Newton": _over_time(result, "soc_newton_pct"),
            "counted": _over_time(result, "rows.soc_pct"),
        },
        height=280,
    )


def _resistance_figure(result: Identification) -> Figure:
    slope = significant(result.slope_ohm, 3, "Ω")
    delay_s = result.voltage_model.loads.delays_s[0]
    figure = Figure(
        "Voltage drop against current",
        f"current {delay_s:g} s ago [A]" if delay_s else "current [A]",
        "voltage − pseudo-OCV [V]",
        f"The slope is the resistance at the terminals, {slope}. The coefficients expect"
        f" {significant(result.slope_expected_ohm, 3, 'Ω')}: Σ Rm·ρm with ρm the regression of the"
        " m-th delayed or low-passed current on the present one.",
        hover="$name<br>@x{0.0} A, @y{0.00} V",
        height=360,
    )
    current = np.concatenate([item.rows.current_a for item in result.fits])
    drop = np.concatenate([item.rows.voltage_v - item.pseudo_ocv_v for item in result.fits])
    figure.cloud("rows of the fit", current, drop)
    ends = np.array([current.min(), current.max()])
    line = float(drop.mean()) - result.slope_ohm * (ends - float(current.mean()))
    figure.line(f"slope {slope}", ends, line, ORANGE, line_width=2.2)
    return figure


def _recorded_figures(result: Identification, time: TimeFigures) -> list[Figure]:
    """Return current, voltage and temperature of the whole logs."""
    logs = result.logs
    running = np.concatenate(
        [log.voltage_v[running_rows(log.time_s, log.voltage_v)] for log in logs]
    )
    is_limited = running.size < sum(map(len, logs))
    below = " Start-up and shut-down rows lie below the figure." if is_limited else ""
    figures = [
        time.channel(logs, "current", "Positive current discharges the pack, negative charges it."),
        time.channel(
            logs,
            "voltage",
            f"The voltage falls with the charge and dips under load.{below}",
        ),
        time.channel(
            logs,
            "temperature",
            f"Measured on: {result.model.temperature_source}. A temperature that hardly changes"
            " does not identify kt.",
        ),
    ]
    if is_limited:
        figures[1].set_y_limits(float(running.min()), float(running.max()))
    return figures


def _with_error(value: float, std_error: float | None) -> list[str]:
    """Return a value rounded to its standard error, and the error with two digits.

    A value within two standard errors of zero, 95 %, may as well be zero: it is a dash.
    """
    if not std_error or not math.isfinite(std_error):
        return [significant(value, 3), significant(std_error, 2)]
    decimals = max(0, 1 - math.floor(math.log10(std_error)))
    shown = number(value, decimals) if abs(value) >= 2.0 * std_error else NONE_KNOWN
    return [shown, significant(std_error, 2)]


def _held_out_mae_pct(result: Identification) -> list[float | None]:
    """Return the mean absolute error of each log on rows held out of its fit [%]."""
    found: list[float | None] = [None] * len(result.fits)
    for k, error_v in enumerate(result.held_out_error_v):
        relative = np.abs(error_v) / result.fits[k].rows.voltage_v
        if np.isfinite(relative).any():
            found[k] = 100.0 * float(np.nanmean(relative))
    return found


def _remarks(result: Identification) -> Sequence[str]:
    """Return the remarks of the fit, and each of the logs with the names of those that have it."""
    names: dict[str, list[str]] = {}
    for log in result.logs:
        for remark in log.remarks:
            names.setdefault(remark, []).append(log.name)
    return [*result.remarks, *(f"{', '.join(names[text])}: {text}" for text in names)]
