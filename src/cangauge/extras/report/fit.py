"""The page of `cangauge fit`: the model's error, curves and coefficients, and how it was made."""

from __future__ import annotations

import math
from collections import Counter
from operator import attrgetter
from typing import Final

import numpy as np

from cangauge._text import NONE_KNOWN, duration, number, significant, span
from cangauge._typing import FloatArray
from cangauge.extras.report.charts import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    Figure,
    Plot,
    TimeFigures,
    histogram,
    stacked,
)
from cangauge.extras.report.page import Block, Page, Table, Tile, joined, range_rows
from cangauge.identify.identification import Identification
from cangauge.identify.rows import running_rows
from cangauge.model.effects.library import LIBRARY
from cangauge.model.model_file import Model, Published
from cangauge.model.voltage_model import VoltageModel

OWN_NOISE: Final = 2.0
"""Standard errors within which a coefficient may as well be zero [-]: 95 %."""
_UNITS: Final = {"V": "V", "V/K": "V/K", "ohm": "Ω"}
_REMOVED_BY: Final = {
    "decimation": "not on the model's rate",
    "start_up_or_shut_down": "at start-up or shut-down",
    "delay_line_filling": "delay line not yet full",
}


def fit_page(result: Identification) -> Page:
    """Return the page of an identification."""
    logs, model, fits = result.logs, result.model, result.fits
    time = _time(result)
    slope = _slope_figure(result.voltage_model)
    rows = sum(len(item.rows) for item in fits)
    return Page(
        title=f"Voltage model {model.name}",
        lead=result.verdict,
        subtitle=f"Identified from {joined([log.name for log in logs])}:"
        f" {duration(sum(log.duration_s for log in logs))}, {rows:,} rows used.",
        tiles=_tiles(result),
        sections={
            "Fit and pseudo-OCV": [_voltage_figure(result, time), [_ocv_figure(result), slope]],
            "Voltage error": [*_error_figures(result, time), _error_table(result)],
            "State of charge from voltage": [_newton_figure(result, time)],
            "Resistance and energy": [_resistance_figure(result), _energy(result)],
            "Coefficients": _coefficients(model, result.published.condition_number),
            "Effects": _effects(result),
            "Recorded data": _recorded_figures(result, time),
            "How the model was made": _method(result),
        },
        model=model,
        logs=logs,
    )


def fit_figure(result: Identification) -> Plot:
    """Return the pseudo-OCV over SoC, the residual over time and its histogram, for a notebook."""
    return stacked(_ocv_figure(result), *_error_figures(result, _time(result)))


def _time(result: Identification) -> TimeFigures:
    return TimeFigures([log.time_s for log in result.logs], [log.name for log in result.logs])


def _tiles(result: Identification) -> list[Tile]:
    noise, energy = result.model.noise, result.energy
    mae, rmse = "not measured", "too few logs to leave one out"
    if result.is_held_out:
        mae = number(noise.voltage_mae_pct, 3, "%")
        rmse = f"RMSE {significant(noise.voltage_rmse_v, 3, 'V')}"
    expected = f"expected {significant(result.slope_expected_ohm, 3, 'Ω')}"
    net = f"net {significant(energy.net_kwh, 3, 'kWh')}"
    of_fit = f"RMSE {significant(result.voltage_rmse_v, 3, 'V')}"
    return [
        Tile("Voltage error (MAE)", number(result.voltage_mae_pct, 3, "%"), of_fit),
        Tile("Held out (MAE)", mae, rmse),
        Tile("SoC by Newton (MAE)", number(result.soc_newton_mae_pct, 2, "%"), "against counting"),
        Tile("Slope resistance", significant(result.slope_ohm, 3, "Ω"), expected),
        Tile("Capacity", number(result.model.capacity_ah, 2, "Ah"), "100 → 0 %"),
        Tile("Efficiency", number(energy.efficiency_pct, 1, "%"), net),
    ]


# --- Figures


def _over_time(result: Identification, name: str) -> list[tuple[FloatArray, FloatArray]]:
    """Return time and an attribute of each log's fit."""
    values = attrgetter(name)
    return [(item.rows.time_s, values(item)) for item in result.fits]


def _voltage_figure(result: Identification, time: TimeFigures) -> Figure:
    figure = time.figure(
        "Measured voltage, model and pseudo-OCV",
        "voltage [V]",
        "The model should lie on the measurement. The pseudo-OCV is its part without current."
        " Rows that the fit did not use leave gaps.",
        height=320,
        names=True,
    )
    measured = _over_time(result, "rows.voltage_v")
    model = _over_time(result, "voltage_model_v")
    curve = _over_time(result, "pseudo_ocv_v")
    time.line(figure, "measured", measured, BLACK, line_width=1.2)
    time.line(figure, "model", model, ORANGE, line_width=1.0, line_alpha=0.85)
    return time.line(figure, "pseudo-OCV", curve, BLUE, line_width=1.8)


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
    figure.cloud("measured, less drop", soc, residual + model.pseudo_ocv(soc), GREY)
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
    fitted = _over_time(result, "residual_v")
    parts = [("fit", np.concatenate([values for _, values in fitted]), BLUE)]
    held_out = [
        (item.rows.time_s, values)
        for item, values in zip(result.fits, result.held_out_error_v, strict=False)
    ]
    hidden = expected = ""
    if any(np.isfinite(values).any() for _, values in held_out):
        parts.append(("held out", np.concatenate([values for _, values in held_out]), ORANGE))
        hidden = " “Held out” (click the legend) is the error on rows that the fit did not see:"
        hidden += f" {result.model.noise.judged_on}."
        expected = "Expect “held out” on a new log. Where it is much wider than “fit”, the model"
        expected += " overfits its logs. "
    title = "Measured minus modelled voltage"
    caption = f"A good fit scatters about zero without lasting bias.{hidden}"
    error = time.figure(title, "voltage error [V]", caption, height=260, names=True)
    time.line(error, "fit", fitted, BLUE, line_width=1.0)
    if hidden:
        style = {"line_width": 1.0, "line_alpha": 0.75, "visible": False}
        time.line(error, "held out", held_out, ORANGE, **style)
    error.mark("width", 0.0)
    caption = f"{expected}The outermost bars include everything beyond."
    return [error, histogram("Distribution of the error", "measured − model", "V", parts, caption)]


def _error_table(result: Identification) -> Table:
    noise = result.model.noise
    rows = [
        ["MAE of the fit", number(result.voltage_mae_pct), "%", "of the voltage"],
        ["RMSE of the fit", significant(result.voltage_rmse_v, 3), "V", ""],
        ["MAE of the error model", number(noise.voltage_mae_pct), "%", noise.judged_on],
        ["RMSE of the error model", significant(noise.voltage_rmse_v, 3), "V", noise.judged_on],
        ["of a 30 s mean (σ)", significant(noise.fast_std_v, 3), "V", "new in each block"],
        [
            "slow part (σ)",
            significant(noise.slow_std_v, 3),
            "V",
            f"correlated over {number(noise.slow_time_s, 0, 's')}",
        ],
        [
            "level (σ)",
            significant(noise.level_std_v, 3),
            "V",
            "constant over a log: does not average out",
        ],
        [
            "SoC against voltage (σ)",
            number(noise.soc_std_pct, 1),
            "%",
            "times the slope of the curve, a further error of the voltage",
        ],
    ]
    return Table(
        ["voltage error", "value", "unit", "meaning"],
        rows,
        "The filter takes its measurement noise from the last four. Level and coefficients are"
        f" scaled by the errors of left-out logs (κ² = {number(noise.left_out_scale, 2)}).",
    )


def _newton_figure(result: Identification, time: TimeFigures) -> Figure:
    figure = time.figure(
        "SoC from voltage alone",
        "state of charge [%]",
        "The voltage equation solved for SoC at each row by Newton's method, without counting. Mean"
        f" absolute error {number(result.soc_newton_mae_pct, 2, '%')}: the voltage error divided by"
        " the slope of the pseudo-OCV, so it is large where that is flat.",
        height=280,
        names=True,
    )
    newton = _over_time(result, "soc_newton_pct")
    counted = _over_time(result, "rows.soc_pct")
    time.line(figure, "Newton", newton, ORANGE, line_width=0.9, line_alpha=0.8)
    return time.line(figure, "counted", counted, BLACK, line_width=2.0)


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
    current = np.concatenate([item.rows.currents_a[:, 0] for item in result.fits])
    drop = np.concatenate([item.rows.voltage_v - item.pseudo_ocv_v for item in result.fits])
    figure.cloud("rows of the fit", current, drop, GREY)
    ends = np.array([current.min(), current.max()])
    line = float(drop.mean()) - result.slope_ohm * (ends - float(current.mean()))
    figure.line(f"slope {slope}", ends, line, ORANGE, line_width=2.2)
    return figure


def _energy(result: Identification) -> Table:
    energy = result.energy

    def share(part: float, whole: float) -> str:
        return number(100.0 * part / whole if whole > 0.0 else None, 1, "%")

    regenerated = share(energy.regenerated_kwh, energy.driven_kwh)
    rows = [
        ["driven", significant(energy.driven_kwh, 3), "", "∫U·I over I > 0"],
        ["regenerated", significant(energy.regenerated_kwh, 3), regenerated, "∫U·I over I < 0"],
        ["net", significant(energy.net_kwh, 3), "", "driven − regenerated"],
        [
            "Joule heat",
            significant(energy.heat_kwh, 3),
            share(energy.heat_kwh, energy.net_kwh),
            "slope resistance × ∫I²",
        ],
        ["efficiency", "", number(energy.efficiency_pct, 1, "%"), "net / (net + heat)"],
    ]
    return Table(["energy at the terminals", "kWh", "share", "definition"], rows)


def _recorded_figures(result: Identification, time: TimeFigures) -> list[Block]:
    """Return current, voltage and temperature of the whole logs."""
    logs = result.logs
    running = np.concatenate(
        [log.voltage_v[running_rows(log.time_s, log.voltage_v)] for log in logs]
    )
    is_limited = running.size < sum(map(len, logs))
    below = " Start-up and shut-down rows lie below the figure." if is_limited else ""
    caption = "Positive current discharges the pack, negative charges it."
    pieces = [(log.time_s, log.current_a) for log in logs]
    current = time.channel("current", "A", pieces, BLUE, caption, names=True)
    caption = f"The voltage falls with the charge and dips under load.{below}"
    pieces = [(log.time_s, log.voltage_v) for log in logs]
    voltage = time.channel("voltage", "V", pieces, BLACK, caption)
    if is_limited:
        voltage.set_y_limits(float(running.min()), float(running.max()))
    caption = f"Measured on: {result.model.temperature_source}. A temperature that hardly changes"
    caption += " does not identify kt."
    pieces = [(log.time_s, log.temperature_c) for log in logs]
    return [current, voltage, time.channel("temperature", "°C", pieces, ORANGE, caption)]


# --- Tables


def _coefficients(model: Model, condition_number: float) -> list[Block]:
    """Return the coefficients of a model: loads, and the published equation where identified."""
    blocks: list[Block] = []
    if model.loads is not None:
        loads = model.loads
        names = [f"current {d:g} s ago" if d else "current" for d in loads.delays_s]
        names += [f"current low-passed with {tau:g} s" for tau in loads.low_pass_s]
        rows = [["temperature coefficient", significant(loads.kt_v_per_k, 3), "V/K"]]
        rows += [
            [f"resistance: {name}", significant(ohm, 3), "Ω"]
            for name, ohm in zip(names, loads.resistance_ohm, strict=True)
        ]
        if loads.arrhenius is not None:
            part = number(loads.arrhenius.factor, 2)
            rows.append(["part of the resistance that follows Arrhenius", part, ""])
        note = (
            "U = g(S) + kt·(T − Tr) + Σ Rm·Im + b·(a(T)/a(mean T) − 1)·Σ Rm·Im, with g the curve"
            " through knots."
        )
        blocks.append(Table(["coefficient", "value", "unit"], rows, note))
    if model.published is not None:
        blocks.append(_published_table(model.published, condition_number))
    return blocks


def _with_error(value: float, std_error: float | None) -> tuple[str, str]:
    """Return a value rounded to its standard error, and the error with two digits.

    A value that is its own noise is a dash.
    """
    if not std_error or not math.isfinite(std_error):
        return significant(value, 3), significant(std_error, 2)
    if abs(value) < OWN_NOISE * std_error:
        return NONE_KNOWN, significant(std_error, 2)
    decimals = max(0, 1 - math.floor(math.log10(std_error)))
    return number(value, decimals), significant(std_error, 2)


def _published_table(model: Published, condition_number: float) -> Table:
    factors = {
        "k0": "1",
        "k1": "1/s",
        "k2": "1/s²",
        "k3": "1/s³",
        "k4": "1/s⁴",
        "k5": "s",
        "k6": "ln s",
        "k7": "ln(1 − s)",
        "kt": f"T − {model.t_ref_c:g} °C",
    }
    for place, delay_s in enumerate(model.delays_s, start=1):
        factors[f"R{place}"] = f"current {delay_s:g} s ago" if delay_s else "current"
    rows = []
    for name, item in model.coefficients.items():
        ratio = abs(item.value) / item.std_error if item.std_error else math.nan
        value = _with_error(item.value, item.std_error)
        rows.append([name, *value, number(ratio, 1), _UNITS[item.unit], factors[name]])
    return Table(
        ["published coefficient", "value", "std. error", "|value| / error", "unit", "multiplies"],
        rows,
        "U = k0 + k1/s + k2/s² + k3/s³ + k4/s⁴ + k5·s + k6·ln s + k7·ln(1 − s) + kt·(T − Tr)"
        f" + Σ Rj·I(t − dj),  s = S/100·(1 − 2ε) + ε, ε = {model.epsilon:g}: the published equation"
        " by plain least squares of the same rows. Rows of a minute count as one in the standard"
        " errors; a dash is a coefficient within two of them of zero. k0 … k7 are strongly"
        f" correlated (condition number {significant(condition_number, 2)}): use their sum, the"
        " curve, not single values.",
    )


def _effects(result: Identification) -> list[Block]:
    if result.effects is None:
        return []
    ids = dict.fromkeys(entry["id"] for entry in result.model.effects)
    note = "No effect is significant in these logs."
    if ids:
        note = "; ".join(f"{effect_id}: {LIBRARY[effect_id].equation}" for effect_id in ids)
        note += ". An effect is a signature at the terminals, not proof of a mechanism."
    parameters = [
        {
            "effect": effect.id,
            "parameter": parameter.name,
            "value": significant(values[parameter.name], 4),
            "unit": "" if parameter.unit == "1" else parameter.unit.replace("ohm", "Ω"),
        }
        for effect, values in result.model.extended_model().effects
        for parameter in effect.parameters
    ]
    steps = [
        {
            "effect": step.effect,
            "step": step.step,
            "left out without [V]": significant(step.held_out_rmse_without_v, 3),
            "with [V]": significant(step.held_out_rmse_with_v, 3),
            "t": number(step.t_value, 1),
        }
        for step in result.effects.steps
    ]
    searched = Table.of(
        steps,
        "Errors of left-out logs. An effect is added if the mean logarithm of the error ratio, log"
        " by log, is significantly above zero (t of 2 or more) and worth at least 3 %. The same"
        " data selected the effects, so the last figure is slightly optimistic.",
    )
    return [Table.of(parameters, note) if parameters else note, *([searched] if steps else [])]


def _settings(model: Model) -> Table:
    """Return how a model was made, and the range that it is known in."""
    cells = "" if model.cells is None else f", {model.cells} cells in series"
    rows = [
        ["equation", model.equation],
        ["chemistry", f"{model.chemistry}{cells}"],
        ["capacity", number(model.capacity_ah, 2, "Ah")],
        ["rate", f"{model.rate_hz:g} Hz"],
        ["temperature measured on", model.temperature_source],
        *range_rows(model),
        ["made by", model.made.by],
    ]
    return Table(["model", ""], rows)


def _method(result: Identification) -> list[Block]:
    by_text: dict[str, list[str]] = {}
    for log in result.logs:
        for remark in log.remarks:
            by_text.setdefault(remark, []).append(log.name)
    remarks = [*result.remarks, *(f"{', '.join(names)}: {text}" for text, names in by_text.items())]
    blocks: list[Block] = [_settings(result.model), _logs(result)]
    return [*blocks, "Remarks:", remarks] if remarks else blocks


def _logs(result: Identification) -> Table:
    removed: Counter[str] = Counter()
    for item in result.fits:
        removed.update(item.rows.removed)
    unused = "; ".join(
        f"{count:,} {_REMOVED_BY.get(rule, rule)}" for rule, count in removed.items()
    )
    errors = result.held_out_error_v or [np.full(len(item.rows), np.nan) for item in result.fits]
    entries = []
    for log, item, error_v in zip(result.logs, result.fits, errors, strict=True):
        soc, judged = item.rows.soc_pct, np.isfinite(error_v)
        relative = np.abs(error_v[judged]) / item.rows.voltage_v[judged]
        held_out_pct = 100.0 * float(relative.mean()) if judged.any() else None
        entry = {
            "log": log.name,
            "duration": duration(log.duration_s),
            "rows": str(len(log)),
            "rows used": str(len(item.rows)),
            "SoC [%]": span(soc.max(), soc.min(), 1),
            "temperature [°C]": span(log.temperature_c.min(), log.temperature_c.max(), 1),
            "current [A]": span(log.current_a.min(), log.current_a.max(), 0),
            "U MAE [%]": number(item.voltage_mae_pct, 2),
            "U MAE held out [%]": number(held_out_pct, 2),
            "SoC by Newton MAE [%]": number(item.soc_newton_mae_pct, 2),
        }
        entries.append(entry)
    return Table.of(entries, f"Rows not used: {unused}." if unused else "")
