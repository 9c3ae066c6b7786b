"""The tables of an identification's report.

The figures of an identification: the published ones, for one log or several in turn.

The report of an identification: the published figures, for one log or several in turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cangauge._formatting import duration, number, significant, span
from cangauge._typing import FloatArray
from cangauge.identify.evaluate import LogFit
from cangauge.identify.fit import Identification
from cangauge.inference.rows import running_rows
from cangauge.model.charge import discharged_ah
from cangauge.model.effects.library import LIBRARY
from cangauge.report.charts import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    Pen,
    Plot,
    TimeFigures,
    Timeline,
    add_cloud,
    add_line,
    add_zero,
    bars,
    frame,
    histogram,
    plane,
    shade_outside,
)
from cangauge.report.page import (
    Beside,
    Block,
    Bullets,
    Figure,
    Page,
    Paragraph,
    Section,
    Table,
    Tile,
    reconstruction_banners,
    render,
)
from cangauge.report.tables import effect_rows, step_rows

# --- The tables of an identification's report

UNITS = {"V": "V", "V/K": "V/K", "ohm": "Ω"}

RULES = {
    "decimation": "not on the model's rate (decimation)",
    "start_up_or_shut_down": "low voltage at start-up or shut-down, and 2 s around it",
    "delay_line_filling": "delay line not yet full, at the start or after a gap",
}


def coefficient_table(result: Identification) -> Table:
    """Return the coefficients with standard errors and units."""
    rows = []
    for name, item in result.model.coefficients.items():
        error = item.std_error
        ratio = abs(item.value) / error if error else math.nan
        rows.append(
            [
                name,
                significant(item.value, 5),
                significant(error, 2),
                number(ratio, 1),
                UNITS[item.unit],
                _meaning(name, result),
            ]
        )
    held = (
        " The bounds that keep the pseudo-OCV rising were active; standard errors are those of the"
        " plain fit's directions."
        if result.solution.constrained
        else ""
    )
    return Table(
        ["coefficient", "value", "std. error", "|value| / error", "unit", "what it multiplies"],
        rows,
        "U = k0 + k1/s + k2/s² + k3/s³ + k4/s⁴ + k5·s + k6·ln s + k7·ln(1 − s) + kt·(T − Tr)"
        " + Σ Rj·I(t − dj),  s = S/100·(1 − 2ε) + ε. Standard errors allow for residuals that are"
        " correlated within 300 s. k0 … k7 lean on each other (condition number"
        f" {significant(result.solution.condition_number, 2)}): trust their sum, the curve, not"
        f" each of them.{held}",
    )


def _meaning(name: str, result: Identification) -> str:
    basis = {
        "k0": "1", "k1": "1/s", "k2": "1/s²", "k3": "1/s³", "k4": "1/s⁴", "k5": "s",
        "k6": "ln s", "k7": "ln(1 − s)", "kt": f"T − {result.model.t_ref_c:g} °C",
    }  # fmt: skip
    if name in basis:
        return basis[name]
    delay = result.model.delays_s[int(name.removeprefix("R")) - 1]
    return "current" if delay == 0.0 else f"current {delay:g} s ago"


def effect_tables(result: Identification) -> list[Block]:
    """Return the effects with their parameters, and how they were found."""
    found = result.effects
    if found is None:
        return []
    ids = dict.fromkeys(effect_id for effect_id, _ in found.estimates)
    equations = "; ".join(f"{effect_id}: {LIBRARY[effect_id].equation}" for effect_id in ids)
    before, after = found.held_out_rmse_v
    headings, rows = effect_rows(found)
    tried, steps = step_rows(found)
    return [
        Table(
            _plain(headings),
            rows,
            f"{equations}. Names are signatures at the terminals, not proof of a mechanism."
            if ids
            else "The logs show none by more than chance.",
        ),
        Table(
            _plain(tried),
            steps,
            f"Root mean square error on data left out: {significant(before, 4)} V without effects,"
            f" {significant(after, 4)} V with those above. One is taken if the mean logarithm of"
            " the ratio of errors, log by log, lies so many standard errors (t) above zero as"
            " chance seldom reaches (within the logs half as many), and if the error falls by 1 %."
            " Which effects to take was chosen on the same data that judge them, so the last figure"
            " is a little too good.",
        ),
    ]


def _plain(headings: list[str]) -> list[str]:
    return [heading.removeprefix("<") for heading in headings]


def error_table(result: Identification) -> Table:
    """Return the voltage error, in the fit and held out, and how it splits in time."""
    noise = result.model.noise
    residual = np.concatenate([item.residual_v for item in result.fits])
    return Table(
        ["voltage error", "value", "unit", "what it is"],
        [
            ["MAE of the fit", number(result.voltage_mae_pct), "%", "relative to the voltage"],
            ["RMSE of the fit", significant(result.voltage_rmse_v, 3), "V", ""],
            ["largest of the fit", significant(float(np.abs(residual).max()), 3), "V", ""],
            ["MAE held out", number(noise.voltage_mae_pct), "%", noise.judged_on],
            ["RMSE held out", significant(noise.voltage_rmse_v, 3), "V", noise.judged_on],
            ["fast part (σ)", significant(noise.fast_std_v, 3), "V",
             f"lasts {number(noise.fast_time_s, 1, 's')}: averages out"],
            ["slow part (σ)", significant(noise.slow_std_v, 3), "V",
             f"lasts {number(noise.slow_time_s, 0, 's')}: averages out over far longer times"],
            ["lasting part (σ)", significant(noise.lasting_std_v, 3), "V",
             "stays for a whole log: does not average out"],
        ],
        "The split is fitted to the error's autocovariance; its parts need not add up to the RMSE,"
        " and the filter takes its σ from them.",
    )  # fmt: skip


def energy_table(result: Identification) -> Table:
    """Return the energy balance."""
    energy = result.energy
    share = _share(energy.regenerated_kwh, energy.driven_kwh)
    lost = _share(energy.heat_kwh, energy.net_kwh)
    return Table(
        ["energy", "kWh", "", ""],
        [
            ["driven", significant(energy.driven_kwh, 4), "", "∫U·I over I > 0"],
            [
                "regenerated",
                significant(energy.regenerated_kwh, 4),
                share,
                "of driven; over I < 0",
            ],
            ["net", significant(energy.net_kwh, 4), "", "driven − regenerated"],
            ["Joule heat", significant(energy.heat_kwh, 4), lost, "of net; slope resistance × ∫I²"],
            ["efficiency", "", number(energy.efficiency_pct, 1, "%"), "net / (net + heat)"],
        ],
    )


def log_table(result: Identification) -> Table:
    """Return one row for each log."""
    rows = []
    for log, item, held_out in zip(result.logs, result.fits, result.held_out_error_v, strict=True):
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
                number(item.voltage_mae_pct),
                number(100.0 * float(relative.mean()) if judged.any() else None),
                number(item.soc_newton_mae_pct, 2),
            ]
        )
    return Table(
        [
            "log", "duration", "rows", "rows used", "SoC [%]", "temperature [°C]", "current [A]",
            "U MAE [%]", "U MAE held out [%]", "SoC by inverse MAE [%]",
        ],
        rows,
    )  # fmt: skip


def removed_table(result: Identification) -> Table:
    """Return how many rows each rule removed."""
    totals: dict[str, int] = {}
    for item in result.fits:
        for rule, count in item.rows.removed.items():
            totals[rule] = totals.get(rule, 0) + count
    rows = [[RULES.get(rule, rule), str(count)] for rule, count in totals.items()]
    rows.append(["used", str(sum(len(item.rows) for item in result.fits))])
    return Table(["rows", "count"], rows)


def settings_table(result: Identification) -> Table:
    """Return the options and ranges of the model."""
    model = result.model
    return Table(
        ["model", ""],
        [
            ["capacity", number(model.capacity_ah, 3, "Ah")],
            ["delays", ", ".join(f"{delay:g}" for delay in model.delays_s) + " s"],
            ["rate", f"{model.rate_hz:g} Hz"],
            ["ε", f"{model.epsilon:g}"],
            ["Tr", f"{model.t_ref_c:g} °C"],
            ["temperature measured on", model.temperature_source],
            ["identified over SoC", span(*model.range.soc_pct, 1, "%")],
            ["identified over temperature", span(*model.range.temperature_c, 1, "°C")],
            ["identified over current", span(*model.range.current_a, 1, "A")],
            ["condition number", significant(result.solution.condition_number, 2)],
            ["pseudo-OCV held to rise", "yes" if result.solution.constrained else "not needed"],
            ["made by", model.made.by],
            ["fingerprint of the logs", model.made.fingerprint[:16]],
        ],
    )


def _share(part: float, whole: float) -> str:
    return number(100.0 * part / whole if whole else None, 1, "%")


# --- The figures of an identification: the published ones, for one log or several in turn


def recorded_figures(result: Identification, time: TimeFigures) -> list[Block]:
    """Return current, voltage, temperature, power and charge of the whole logs."""
    logs = result.logs

    def one(axis: tuple[str, str], color: str, see: str, values: list[FloatArray]) -> Figure:
        quantity, unit = axis
        plot = time.plot(quantity, unit, height=235, names=quantity == "current")
        pieces = [(log.time_s, item) for log, item in zip(logs, values, strict=True)]
        time.line(plot, quantity, pieces, Pen(color, width=1.0, in_legend=False))
        return Figure(quantity.capitalize(), plot, see)

    voltage = one(
        ("voltage", "V"), BLACK, "The voltage falls with the charge and dips under load.",
        [log.voltage_v for log in logs],
    )  # fmt: skip
    running = [log.voltage_v[running_rows(log.time_s, log.voltage_v)] for log in logs]
    if sum(values.size for values in running) < sum(map(len, logs)):
        shown = np.concatenate(running)
        frame(voltage.plot, float(shown.min()), float(shown.max()))
        voltage = replace(
            voltage, see=voltage.see + " Start-up and shut-down rows lie below the frame."
        )
    power = [log.voltage_v * log.current_a / 1000.0 for log in logs]
    charge = [discharged_ah(log.time_s, log.current_a) for log in logs]
    each = " of each log" if len(logs) > 1 else ""
    return [
        one(("current", "A"), BLUE,
            "Above zero the pack is discharged, below it is charged (regeneration).",
            [log.current_a for log in logs]),
        voltage,
        one(("temperature", "°C"), ORANGE,
            f"Measured on: {result.model.temperature_source}. What moves little here hardly"
            " identifies kt.",
            [log.temperature_c for log in logs]),
        one(("power", "kW"), PURPLE,
            "Voltage times current at the terminals; its area is the energy below.", power),
        one(("charge taken out", "Ah"), GREEN,
            f"Current integrated by the trapezoidal rule from the start{each};"
            f" {number(result.model.capacity_ah, 2, 'Ah')} are 100 %.", charge),
    ]  # fmt: skip


def fit_figures(result: Identification, time: TimeFigures) -> list[Block]:
    """Return the fit over time and the pseudo-OCV over SoC."""
    over_time = time.plot("voltage", "V", height=320, names=True)
    for name, pen, values in (
        ("measured", Pen(BLACK, width=1.2), lambda item: item.rows.voltage_v),
        ("model", Pen(ORANGE, width=1.0, alpha=0.85), lambda item: item.voltage_model_v),
        ("pseudo-OCV", Pen(BLUE, width=1.8), lambda item: item.pseudo_ocv_v),
    ):
        time.line(over_time, name, _of_fits(result, values), pen, gap_s=_break_s(result))
    lo, hi = result.voltage_model.soc_range_pct
    return [
        Figure(
            "Measured voltage, model and pseudo-OCV",
            over_time,
            "The model should lie on the measurement; the pseudo-OCV is its part without current."
            " Rows that the fit did not use leave gaps.",
        ),
        Beside(
            [
                Figure(
                    "Pseudo-OCV against SoC",
                    _ocv_plane(result),
                    "Dots: the measured voltage less the model's resistances"
                    f"{_and_effects(result)} and temperature term."
                    f" The logs cover {number(lo, 1)} … {number(hi, 1)} %; in the shaded part the"
                    " curve goes on as a straight line.",
                ),
                Figure(
                    "Slope of the pseudo-OCV",
                    _slope_plane(result),
                    "Where it is low, SoC is hard to tell from voltage: an error of the voltage"
                    " divided by this slope is the error of the SoC.",
                ),
            ]
        ),
    ]


def _and_effects(result: Identification) -> str:
    return ", effects" if result.effects is not None and result.effects.model.effects else ""


def _ocv_plane(result: Identification) -> Plot:
    model = result.voltage_model
    plot = plane(
        ("state of charge", "voltage"),
        "$name: @y{0.00} V<br>at @x{0.0} %",
        units=("%", "V"),
        height=340,
    )
    soc = np.concatenate([item.rows.soc_pct for item in result.fits])
    at_reference = np.concatenate([item.residual_v for item in result.fits]) + model.pseudo_ocv(soc)
    add_cloud(plot, "measured, less drop", soc, at_reference, GREY)
    grid = np.linspace(min(0.0, soc.min()), max(100.0, soc.max()), 401)
    add_line(plot, "pseudo-OCV", grid, model.pseudo_ocv(grid), Pen(BLUE, width=2.2))
    shade_outside(plot, *model.soc_range_pct)
    return plot


def _slope_plane(result: Identification) -> Plot:
    model = result.voltage_model
    plot = plane(
        ("state of charge", "dU/dS"),
        "@y{0.000} V per %<br>at @x{0.0} %",
        units=("%", "V per %"),
        height=340,
    )
    grid = np.linspace(0.0, 100.0, 401)
    add_line(
        plot, "slope", grid, model.pseudo_ocv_slope(grid), Pen(BLUE, width=2.0, in_legend=False)
    )
    shade_outside(plot, *model.soc_range_pct)
    lo, hi = model.soc_range_pct
    inside = model.pseudo_ocv_slope(np.linspace(lo, hi, 201))
    # At the ends the slope rises tenfold; the middle is what matters.
    plot.y_range.end = float(min(inside.max(), 4.0 * np.median(inside))) * 1.1
    plot.y_range.start = 0.0
    return plot


def voltage_error_figures(result: Identification, time: TimeFigures) -> list[Block]:
    """Return the voltage error over time, its histogram and its table."""
    plot = time.plot("voltage error", "V", height=260, names=True)
    gap_s = _break_s(result)
    time.line(
        plot, "fit", _of_fits(result, lambda item: item.residual_v), Pen(BLUE, width=1.0),
        gap_s=gap_s,
    )  # fmt: skip
    held_out = [
        (item.rows.time_s, values)
        for item, values in zip(result.fits, result.held_out_error_v, strict=True)
    ]
    judged = any(np.isfinite(values).any() for _, values in held_out)
    if judged:
        time.line(
            plot, "held out", held_out, Pen(ORANGE, width=1.0, alpha=0.75, visible=False),
            gap_s=gap_s,
        )  # fmt: skip
    add_zero(plot)
    parts = [("fit", np.concatenate([item.residual_v for item in result.fits]), BLUE)]
    if judged:
        parts.append(("held out", np.concatenate([values for _, values in held_out]), ORANGE))
    spread = histogram("measured − model", "V", parts)
    return [
        Figure(
            "Measured minus modelled voltage",
            plot,
            "A good fit scatters about zero without lasting bias. “Held out” (click the legend) is"
            f" the error under fits that did not see the row: {result.model.noise.judged_on}.",
        ),
        Figure(
            "How large the error is",
            spread,
            "“Held out” is what to expect of a new log; the wider it is than “fit”, the more the"
            " model learned its own logs by heart. The outermost bars hold all that lies beyond.",
        ),
        error_table(result),
    ]


def inverse_figures(result: Identification, time: TimeFigures) -> list[Block]:
    """Return the SoC by Newton's method and its error over time."""
    gap_s = _break_s(result)
    soc = time.plot("state of charge", "%", height=280, names=True)
    time.line(
        soc, "by inverse (Newton)", _of_fits(result, lambda item: item.soc_newton_pct),
        Pen(ORANGE, width=0.9, alpha=0.8), gap_s=gap_s,
    )  # fmt: skip
    time.line(
        soc, "counted", _of_fits(result, lambda item: item.rows.soc_pct), Pen(BLACK, width=2.0),
        gap_s=gap_s,
    )  # fmt: skip
    error = time.plot("SoC error", "%", height=235)
    time.line(
        error, "by inverse − counted",
        _of_fits(result, lambda item: item.soc_newton_pct - item.rows.soc_pct),
        Pen(ORANGE, width=0.9, in_legend=False), gap_s=gap_s,
    )  # fmt: skip
    add_zero(error)
    return [
        Figure(
            "SoC from voltage alone",
            soc,
            "At each row the voltage equation is solved for SoC by Newton's method; no charge is"
            " counted in it. It should scatter about the counted SoC.",
        ),
        Figure(
            "Its error",
            error,
            f"Mean absolute error {number(result.soc_newton_mae_pct, 2, '%')}: the voltage error"
            " divided by the slope of the pseudo-OCV, hence large where that is flat.",
        ),
    ]


def resistance_figure(result: Identification) -> Figure:
    """Return the voltage drop against current with the slope resistance."""
    current = np.concatenate([item.rows.delayed_current_a[:, 0] for item in result.fits])
    drop = np.concatenate([item.rows.voltage_v - item.pseudo_ocv_v for item in result.fits])
    if result.model.delays_s[0] != 0.0:
        axis = f"current {result.model.delays_s[0]:g} s ago"
    else:
        axis = "current"
    plot = plane(
        (axis, "voltage − pseudo-OCV"),
        "$name<br>@x{0.0} A, @y{0.00} V",
        units=("A", "V"),
        height=360,
    )
    add_cloud(plot, "rows of the fit", current, drop, GREY)
    ends = np.array([current.min(), current.max()])
    mean_a, mean_v = float(current.mean()), float(drop.mean())
    add_line(
        plot, f"slope {significant(result.slope_ohm, 4, 'Ω')}", ends,
        mean_v - result.slope_ohm * (ends - mean_a), Pen(ORANGE, width=2.2),
    )  # fmt: skip
    return Figure(
        "Voltage drop against current",
        plot,
        "The line's slope is the resistance at the terminals,"
        f" {significant(result.slope_ohm, 4, 'Ω')}."
        f" R1 + Σ Rj·ρj, with ρj the current's autocorrelation at the delays, expects"
        f" {significant(result.slope_expected_ohm, 4, 'Ω')}.",
    )


def energy_figures(result: Identification) -> list[Block]:
    """Return the energy balance."""
    energy = result.energy
    return [
        Figure(
            "Energy at the terminals",
            bars(
                "energy",
                "kWh",
                [
                    ("driven", energy.driven_kwh, BLUE),
                    ("regenerated", energy.regenerated_kwh, GREEN),
                    ("net", energy.net_kwh, BLACK),
                    ("Joule heat", energy.heat_kwh, ORANGE),
                ],
            ),
            "Driven less regenerated is net; heat is the slope resistance times ∫I².",
        ),
        energy_table(result),
    ]


def _of_fits(
    result: Identification, values: Callable[[LogFit], FloatArray]
) -> list[tuple[FloatArray, FloatArray]]:
    return [(item.rows.time_s, values(item)) for item in result.fits]


def _break_s(result: Identification) -> float:
    """Return over which step the lines on the fit's rows break [s]."""
    longest = max(float(np.median(np.diff(item.rows.time_s))) for item in result.fits)
    return 3.0 * max(longest, 1.0 / result.model.rate_hz)


# --- The report of an identification: the published figures, for one log or several in turn


def fit_report(result: Identification) -> str:
    """Return the report of an identification as one self-contained HTML page."""
    return render(fit_page(result))


def fit_page(result: Identification) -> Page:
    """Return the report's content, for those who want to add to it."""
    time = TimeFigures(Timeline.of(result.logs))
    several = len(result.logs) > 1
    seconds = sum(log.duration_s for log in result.logs)
    made_of = f"{len(result.logs)} logs" if several else f"the log {result.logs[0].name}"
    sections = [
        Section("What was recorded", recorded_figures(result, time)),
        Section("Fit and pseudo-OCV", fit_figures(result, time)),
        Section("Voltage error", voltage_error_figures(result, time)),
        Section("State of charge by inverse", inverse_figures(result, time)),
        Section("Resistance", [resistance_figure(result)]),
        Section("Energy", energy_figures(result)),
        Section("Coefficients", [coefficient_table(result)]),
        *([Section("Effects", effect_tables(result))] if result.effects is not None else []),
        Section("How it was made", _made(result)),
    ]
    return Page(
        title=f"Voltage model {result.model.name}",
        subtitle=f"Identified from {made_of}, {duration(seconds)} in all,"
        f" {sum(len(item.rows) for item in result.fits):,} rows used."
        " Positive current discharges.",
        tiles=_tiles(result),
        sections=sections,
        banners=reconstruction_banners(
            *(text for log in result.logs for text in (log.name, log.source, *log.remarks))
        ),
    )


def _tiles(result: Identification) -> list[Tile]:
    noise = result.model.noise
    return [
        Tile("Voltage error (MAE)", number(result.voltage_mae_pct, 3, "%"),
             f"RMSE {significant(result.voltage_rmse_v, 3, 'V')}"),
        Tile("Held out (MAE)", number(noise.voltage_mae_pct, 3, "%"),
             f"RMSE {significant(noise.voltage_rmse_v, 3, 'V')}"),
        Tile("SoC by inverse (MAE)", number(result.soc_newton_mae_pct, 2, "%"),
             "against counting"),
        Tile("Slope resistance", significant(result.slope_ohm, 4, "Ω"),
             f"expected {significant(result.slope_expected_ohm, 4, 'Ω')}"),
        Tile("Capacity", number(result.model.capacity_ah, 2, "Ah"), "100 → 0 %"),
        Tile("Efficiency", number(result.energy.efficiency_pct, 1, "%"),
             f"net {significant(result.energy.net_kwh, 3, 'kWh')},"
             f" heat {significant(result.energy.heat_kwh, 3, 'kWh')}"),
        Tile("Condition number", significant(result.solution.condition_number, 2),
             "of the scaled columns"),
    ]  # fmt: skip


def _made(result: Identification) -> list[Block]:
    blocks: list[Block] = [settings_table(result), log_table(result), removed_table(result)]
    said: dict[str, list[str]] = {}
    for log in result.logs:
        for remark in log.remarks:
            said.setdefault(remark, []).append(log.name)
    remarks = [*result.remarks, *(f"{', '.join(names)}: {text}" for text, names in said.items())]
    if remarks:
        blocks += [Paragraph("Remarks:"), Bullets(remarks)]
    return blocks
