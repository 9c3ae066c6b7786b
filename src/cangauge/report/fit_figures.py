"""The figures of an identification: the published ones, for one log or several in turn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cangauge.identify.evaluate import LogFit
from cangauge.identify.fit import Identification
from cangauge.identify.rows import running_rows
from cangauge.model.charge import discharged_ah
from cangauge.report.bars import bars, histogram
from cangauge.report.figures import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    Pen,
    Plot,
    add_cloud,
    add_line,
    add_zero,
    frame,
    plane,
    shade_outside,
)
from cangauge.report.fit_tables import energy_table, error_table
from cangauge.report.page import Beside, Block, Figure
from cangauge.report.time_figures import TimeFigures
from cangauge.report.words import number, significant

FloatArray = NDArray[np.float64]


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
    return ", effects" if result.found is not None and result.found.model.effects else ""


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
