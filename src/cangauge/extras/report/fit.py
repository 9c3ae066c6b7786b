"""The page of `cangauge fit`: the model's error, curves and coefficients, and how it was made."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import Final

import numpy as np

from cangauge._text import duration, number, significant, span
from cangauge._typing import FloatArray
from cangauge.extras.report.charts import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    Pen,
    Plot,
    TimeFigures,
    add_cloud,
    add_line,
    add_zero,
    histogram,
    new_figure,
    set_y_limits,
    shade_outside,
)
from cangauge.extras.report.page import (
    Beside,
    Block,
    Bullets,
    Figure,
    InputFile,
    Page,
    Paragraph,
    Section,
    Table,
    Tile,
    joined,
    reconstruction_banners,
    render,
)
from cangauge.identify.identification import (
    Identification,
    LogFit,
    effect_rows,
    rounded,
    search_rows,
)
from cangauge.identify.rows import running_rows
from cangauge.model.effects.library import LIBRARY
from cangauge.model.model_file import Model, Published
from cangauge.model.voltage_model import VoltageModel

_UNITS: Final = {"V": "V", "V/K": "V/K", "ohm": "Ω"}
_REMOVED_BY: Final = {
    "decimation": "not on the model's rate",
    "start_up_or_shut_down": "at start-up or shut-down",
    "delay_line_filling": "delay line not yet full",
}
_NEAR_AN_END_PCT: Final = 10.0
"""Range of SoC at an end that a model may lack without a word [%]: cars keep as much unused."""


def fit_report(result: Identification) -> str:
    """Return the report of an identification as one self-contained HTML page."""
    return render(fit_page(result))


def fit_page(result: Identification) -> Page:
    """Return the report's content; `figures` holds the bokeh figures."""
    logs, model = result.logs, result.model
    time = TimeFigures(logs)
    rows = sum(len(item.rows) for item in result.fits)
    condition = result.published.condition_number
    sections = [
        Section("Fit and pseudo-OCV", _fit_figures(result, time)),
        Section("Voltage error", _voltage_error(result, time)),
        Section("State of charge from voltage", [_newton_figure(result, time)]),
        Section("Resistance and energy", [_resistance_figure(result), _energy(result)]),
        Section("Coefficients", coefficient_tables(model, condition)),
        *([Section("Effects", _effects(result))] if result.effects is not None else []),
        Section("Recorded data", _recorded_figures(result, time)),
        Section("How the model was made", _method(result)),
    ]
    return Page(
        title=f"Voltage model {model.name}",
        lead=result.verdict,
        subtitle=f"Identified from {joined([log.name for log in logs])}:"
        f" {duration(sum(log.duration_s for log in logs))}, {rows:,} rows used.",
        tiles=_tiles(result),
        sections=sections,
        inputs=[
            InputFile.of_model(model),
            *(InputFile.of_path("log", log.name, log.source) for log in logs),
        ],
        banners=reconstruction_banners(
            *(text for log in logs for text in (log.name, log.source, *log.remarks))
        ),
    )


def _tiles(result: Identification) -> list[Tile]:
    noise, energy = result.model.noise, result.energy
    net = significant(energy.net_kwh, 3, "kWh")
    return [
        Tile(
            "Voltage error (MAE)",
            number(result.voltage_mae_pct, 3, "%"),
            f"RMSE {significant(result.voltage_rmse_v, 3, 'V')}",
        ),
        Tile(
            "Held out (MAE)",
            number(noise.voltage_mae_pct, 3, "%") if result.is_held_out else "not measured",
            f"RMSE {significant(noise.voltage_rmse_v, 3, 'V')}"
            if result.is_held_out
            else "too few logs to leave one out",
        ),
        Tile("SoC by Newton (MAE)", number(result.soc_newton_mae_pct, 2, "%"), "against counting"),
        Tile(
            "Slope resistance",
            significant(result.slope_ohm, 3, "Ω"),
            f"expected {significant(result.slope_expected_ohm, 3, 'Ω')}",
        ),
        Tile("Capacity", number(result.model.capacity_ah, 2, "Ah"), "100 → 0 %"),
        Tile("Efficiency", number(energy.efficiency_pct, 1, "%"), f"net {net}"),
    ]


# --- Figures


def _fit_figures(result: Identification, time: TimeFigures) -> list[Block]:
    plot = time.plot("voltage", "V", height=320, names=True)
    for name, pen, values in (
        ("measured", Pen(BLACK, width=1.2), lambda item: item.rows.voltage_v),
        ("model", Pen(ORANGE, width=1.0, alpha=0.85), lambda item: item.voltage_model_v),
        ("pseudo-OCV", Pen(BLUE, width=1.8), lambda item: item.pseudo_ocv_v),
    ):
        time.line(plot, name, _over_time(result, values), pen, gap_s=_gap_s(result))
    low, high = result.voltage_model.soc_range_pct
    effects = ", effects" if result.model.effects else ""
    return [
        Figure(
            "Measured voltage, model and pseudo-OCV",
            plot,
            "The model should lie on the measurement. The pseudo-OCV is its part without current."
            " Rows that the fit did not use leave gaps.",
        ),
        Beside(
            [
                Figure(
                    "Pseudo-OCV against SoC",
                    _ocv_plot(result),
                    "Dots: the measured voltage minus the model's resistances"
                    f"{effects} and temperature term. The logs cover {span(low, high, 1, '%')}; in"
                    f" the shaded part the curve {result.beyond}.",
                ),
                Figure(
                    "Slope of the pseudo-OCV",
                    slope_plot(result.voltage_model),
                    "A voltage error divided by this slope is the SoC error: where the slope is"
                    " small, the voltage hardly determines the SoC.",
                ),
            ]
        ),
    ]


def _over_time(
    result: Identification, values: Callable[[LogFit], FloatArray]
) -> list[tuple[FloatArray, FloatArray]]:
    return [(item.rows.time_s, values(item)) for item in result.fits]


def _gap_s(result: Identification) -> float:
    """Return the step over which lines on the rows of the fit break [s]."""
    step_s = max(float(np.median(np.diff(item.rows.time_s))) for item in result.fits)
    return 3.0 * max(step_s, 1.0 / result.model.rate_hz)


def _ocv_plot(result: Identification) -> Plot:
    model = result.voltage_model
    plot = new_figure(
        ("state of charge", "voltage"),
        "$name: @y{0.00} V<br>at @x{0.0} %",
        units=("%", "V"),
        height=340,
    )
    soc = np.concatenate([item.rows.soc_pct for item in result.fits])
    residual = np.concatenate([item.residual_v for item in result.fits])
    add_cloud(plot, "measured, less drop", soc, residual + model.pseudo_ocv(soc), GREY)
    grid = np.linspace(min(0.0, soc.min()), max(100.0, soc.max()), 401)
    add_line(plot, "pseudo-OCV", grid, model.pseudo_ocv(grid), Pen(BLUE, width=2.2))
    shade_outside(plot, *model.soc_range_pct)
    return plot


def slope_plot(model: VoltageModel) -> Plot:
    """Return the slope of the pseudo-OCV over SoC."""
    plot = new_figure(
        ("state of charge", "dU/dS"),
        "@y{0.000} V per %<br>at @x{0.0} %",
        units=("%", "V per %"),
        height=340,
    )
    grid = np.linspace(0.0, 100.0, 401)
    pen = Pen(BLUE, width=2.0, in_legend=False)
    add_line(plot, "slope", grid, model.pseudo_ocv_slope(grid), pen)
    low, high = model.soc_range_pct
    shade_outside(plot, low, high)
    inside = model.pseudo_ocv_slope(np.linspace(low, high, 201))
    # The slope rises tenfold at the ends; the middle matters.
    plot.y_range.end = float(min(inside.max(), 4.0 * np.median(inside))) * 1.1
    plot.y_range.start = 0.0
    return plot


def _voltage_error(result: Identification, time: TimeFigures) -> list[Block]:
    plot = time.plot("voltage error", "V", height=260, names=True)
    gap_s = _gap_s(result)
    fitted = _over_time(result, lambda item: item.residual_v)
    time.line(plot, "fit", fitted, Pen(BLUE, width=1.0), gap_s=gap_s)
    parts = [("fit", np.concatenate([values for _, values in fitted]), BLUE)]
    held_out = [
        (item.rows.time_s, values)
        for item, values in zip(result.fits, result.held_out_error_v, strict=False)
    ]
    if any(np.isfinite(values).any() for _, values in held_out):
        pen = Pen(ORANGE, width=1.0, alpha=0.75, visible=False)
        time.line(plot, "held out", held_out, pen, gap_s=gap_s)
        parts.append(("held out", np.concatenate([values for _, values in held_out]), ORANGE))
    add_zero(plot)
    noise = result.model.noise
    hidden = expected = ""
    if len(parts) > 1:
        hidden = " “Held out” (click the legend) is the error on rows that the fit did not see:"
        hidden += f" {noise.judged_on}."
        expected = "Expect “held out” on a new log. Where it is much wider than “fit”, the model"
        expected += " overfits its logs. "
    return [
        Figure(
            "Measured minus modelled voltage",
            plot,
            f"A good fit scatters about zero without lasting bias.{hidden}",
        ),
        Figure(
            "Distribution of the error",
            histogram("measured − model", "V", parts),
            f"{expected}The outermost bars include everything beyond.",
        ),
        Table(
            ["voltage error", "value", "unit", "meaning"],
            [
                ["MAE of the fit", number(result.voltage_mae_pct), "%", "of the voltage"],
                ["RMSE of the fit", significant(result.voltage_rmse_v, 3), "V", ""],
                ["MAE of the error model", number(noise.voltage_mae_pct), "%", noise.judged_on],
                ["RMSE of the error model", significant(noise.voltage_rmse_v, 3), "V",
                 noise.judged_on],
                ["of a 30 s mean (σ)", significant(noise.fast_std_v, 3), "V", "new in each block"],
                ["slow part (σ)", significant(noise.slow_std_v, 3), "V",
                 f"correlated over {number(noise.slow_time_s, 0, 's')}"],
                ["level (σ)", significant(noise.level_std_v, 3), "V",
                 "constant over a log: does not average out"],
                ["SoC against voltage (σ)", number(noise.soc_std_pct, 1), "%",
                 "times the slope of the curve, a further error of the voltage"],
            ],
            "The filter takes its measurement noise from the last four. Level and coefficients are"
            f" scaled by the errors of left-out logs (κ² = {number(noise.left_out_scale, 2)}).",
        ),
    ]  # fmt: skip


def _newton_figure(result: Identification, time: TimeFigures) -> Figure:
    gap_s = _gap_s(result)
    plot = time.plot("state of charge", "%", height=280, names=True)
    newton = _over_time(result, lambda item: item.soc_newton_pct)
    counted = _over_time(result, lambda item: item.rows.soc_pct)
    time.line(plot, "Newton", newton, Pen(ORANGE, width=0.9, alpha=0.8), gap_s=gap_s)
    time.line(plot, "counted", counted, Pen(BLACK, width=2.0), gap_s=gap_s)
    return Figure(
        "SoC from voltage alone",
        plot,
        "The voltage equation solved for SoC at each row by Newton's method, without counting. Mean"
        f" absolute error {number(result.soc_newton_mae_pct, 2, '%')}: the voltage error divided by"
        " the slope of the pseudo-OCV, so it is large where that is flat.",
    )


def _resistance_figure(result: Identification) -> Figure:
    current = np.concatenate([item.rows.currents_a[:, 0] for item in result.fits])
    drop = np.concatenate([item.rows.voltage_v - item.pseudo_ocv_v for item in result.fits])
    delay_s = result.voltage_model.delay_s[0]
    plot = new_figure(
        (f"current {delay_s:g} s ago" if delay_s else "current", "voltage − pseudo-OCV"),
        "$name<br>@x{0.0} A, @y{0.00} V",
        units=("A", "V"),
        height=360,
    )
    add_cloud(plot, "rows of the fit", current, drop, GREY)
    ends = np.array([current.min(), current.max()])
    line = float(drop.mean()) - result.slope_ohm * (ends - float(current.mean()))
    slope = significant(result.slope_ohm, 3, "Ω")
    add_line(plot, f"slope {slope}", ends, line, Pen(ORANGE, width=2.2))
    return Figure(
        "Voltage drop against current",
        plot,
        f"The slope is the resistance at the terminals, {slope}. The coefficients expect"
        f" {significant(result.slope_expected_ohm, 3, 'Ω')}: Σ Rm·ρm with ρm the regression of the"
        " m-th delayed or low-passed current on the present one.",
    )


def _energy(result: Identification) -> Table:
    energy = result.energy

    def share(part: float, whole: float) -> str:
        return number(100.0 * part / whole if whole > 0.0 else None, 1, "%")

    regenerated = share(energy.regenerated_kwh, energy.driven_kwh)
    rows = [
        ["driven", significant(energy.driven_kwh, 3), "", "∫U·I over I > 0"],
        ["regenerated", significant(energy.regenerated_kwh, 3), regenerated, "∫U·I over I < 0"],
        ["net", significant(energy.net_kwh, 3), "", "driven − regenerated"],
        ["Joule heat", significant(energy.heat_kwh, 3), share(energy.heat_kwh, energy.net_kwh),
         "slope resistance × ∫I²"],
        ["efficiency", "", number(energy.efficiency_pct, 1, "%"), "net / (net + heat)"],
    ]  # fmt: skip
    return Table(["energy at the terminals", "kWh", "share", "definition"], rows)


def _recorded_figures(result: Identification, time: TimeFigures) -> list[Block]:
    """Return current, voltage and temperature of the whole logs."""
    logs = result.logs
    running = [log.voltage_v[running_rows(log.time_s, log.voltage_v)] for log in logs]
    is_limited = sum(values.size for values in running) < sum(map(len, logs))
    source = result.model.temperature_source
    figures = []
    for name, unit, color, caption in (
        ("current", "A", BLUE, "Positive current discharges the pack, negative charges it."),
        ("voltage", "V", BLACK, "The voltage falls with the charge and dips under load."
         + (" Start-up and shut-down rows lie below the figure." if is_limited else "")),
        ("temperature", "°C", ORANGE, f"Measured on: {source}. A temperature that hardly changes"
         " does not identify kt."),
    ):  # fmt: skip
        plot = time.plot(name, unit, height=235, names=name == "current")
        field = {"A": "current_a", "V": "voltage_v", "°C": "temperature_c"}[unit]
        pieces = [(log.time_s, getattr(log, field)) for log in logs]
        time.line(plot, name, pieces, Pen(color, width=1.0, in_legend=False))
        if is_limited and unit == "V":
            shown = np.concatenate(running)
            set_y_limits(plot, float(shown.min()), float(shown.max()))
        figures.append(Figure(name.capitalize(), plot, caption))
    return list(figures)


# --- Tables


def coefficient_tables(model: Model, condition_number: float) -> list[Block]:
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
        arrhenius = number(loads.arrhenius.factor, 2)
        rows.append(["part of the resistance that follows Arrhenius", arrhenius, ""])
        note = (
            "U = g(S) + kt·(T − Tr) + Σ Rm·Im + b·(a(T)/a(mean T) − 1)·Σ Rm·Im, with g the curve"
            " through knots."
        )
        blocks.append(Table(["coefficient", "value", "unit"], rows, note))
    if model.published is not None:
        blocks.append(_published_table(model.published, condition_number))
    return blocks


def _published_table(model: Published, condition_number: float) -> Table:
    factors = {
        "k0": "1", "k1": "1/s", "k2": "1/s²", "k3": "1/s³", "k4": "1/s⁴", "k5": "s",
        "k6": "ln s", "k7": "ln(1 − s)", "kt": f"T − {model.t_ref_c:g} °C",
    }  # fmt: skip
    for place, delay_s in enumerate(model.delays_s, start=1):
        factors[f"R{place}"] = f"current {delay_s:g} s ago" if delay_s else "current"
    rows = []
    for name, item in model.coefficients.items():
        ratio = abs(item.value) / item.std_error if item.std_error else math.nan
        value = rounded(item.value, item.std_error)
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
    found = result.effects
    if found is None:
        return []
    ids = dict.fromkeys(str(entry["id"]) for entry in result.model.effects)
    equations = "; ".join(f"{effect_id}: {LIBRARY[effect_id].equation}" for effect_id in ids)
    signature = f"{equations}. An effect is a signature at the terminals, not proof of a mechanism."
    blocks: list[Block] = []
    for (head, rows), note in (
        (effect_rows(result), signature if ids else "No effect is significant in these logs."),
        (
            search_rows(found),
            "Errors of left-out logs. An effect is added if the mean logarithm of the error ratio,"
            " log by log, is significantly above zero (t of 2 or more) and worth at least 3 %. The"
            " same data selected the effects, so the last figure is slightly optimistic.",
        ),
    ):
        blocks.append(Table(head, rows, note))
    return blocks


def settings_table(model: Model) -> Table:
    """Return how a model was made, and the range that it is known in."""
    cells = "" if model.cells is None else f", {model.cells} cells in series"
    rows = {
        "equation": model.equation,
        "chemistry": f"{model.chemistry}{cells}",
        "capacity": number(model.capacity_ah, 2, "Ah"),
        "rate": f"{model.rate_hz:g} Hz",
        "temperature measured on": model.temperature_source,
        "identified at SoC": span(*model.range.soc_pct, 1, "%"),
        "identified at temperature": span(*model.range.temperature_c, 1, "°C"),
        "identified at current": span(*model.range.current_a, 0, "A"),
        "made by": model.made.by,
    }
    return Table(["model", ""], [list(row) for row in rows.items()])


def _method(result: Identification) -> list[Block]:
    removed: Counter[str] = Counter()
    for item in result.fits:
        removed.update(item.rows.removed)
    unused = [f"{count:,} {_REMOVED_BY.get(rule, rule)}" for rule, count in removed.items()]
    by_text: dict[str, list[str]] = {}
    for log in result.logs:
        for remark in log.remarks:
            by_text.setdefault(remark, []).append(log.name)
    remarks = [*result.remarks, *(f"{', '.join(names)}: {text}" for text, names in by_text.items())]
    notes: list[Block] = [Paragraph("Remarks:"), Bullets(remarks)] if remarks else []
    return [settings_table(result.model), _logs(result, "; ".join(unused)), *notes]


def _logs(result: Identification, unused: str) -> Table:
    rows = []
    errors = result.held_out_error_v or [np.full(len(item.rows), np.nan) for item in result.fits]
    for log, item, held_out in zip(result.logs, result.fits, errors, strict=True):
        judged = np.isfinite(held_out)
        relative = np.abs(held_out[judged]) / item.rows.voltage_v[judged]
        rows.append(
            [
                log.name,
                duration(log.duration_s),
                str(len(log)),
                str(len(item.rows)),
                span(item.rows.soc_pct.max(), item.rows.soc_pct.min(), 1),
                span(log.temperature_c.min(), log.temperature_c.max(), 1),
                span(log.current_a.min(), log.current_a.max(), 0),
                number(item.voltage_mae_pct, 2),
                number(100.0 * float(relative.mean()) if judged.any() else None, 2),
                number(item.soc_newton_mae_pct, 2),
            ]
        )
    head = [
        "log", "duration", "rows", "rows used", "SoC [%]", "temperature [°C]", "current [A]",
        "U MAE [%]", "U MAE held out [%]", "SoC by Newton MAE [%]",
    ]  # fmt: skip
    return Table(head, rows, f"Rows not used: {unused}." if unused else "")
