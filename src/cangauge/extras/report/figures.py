"""Figures of a log, an estimate, a fit and a diagnosis for notebooks: thin faces of `charts`.

Each returns a bokeh object for `bokeh.plotting.show`. The methods `Log.plot`, `EstimateTable.plot`,
`Identification.plot` and `Diagnosis.plot` call them.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from bokeh.layouts import column

from cangauge.diagnosis import Diagnosis
from cangauge.estimation.offline import EstimateTable
from cangauge.extras.report.charts import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    Pen,
    Plot,
    TimeFigures,
    add_line,
    add_zero,
    bars,
    histogram,
    new_figure,
)
from cangauge.identify.fit import Identification
from cangauge.logs.log import Log
from cangauge.service.offline import Recorded

SHOWN_CAUSES = 8
CURVE_POINTS = 400


def log_figure(log: Log, *, height: int = 180) -> Plot:
    """Return current, voltage, temperature and, where known, SoC over time.

    Parameters
    ----------
    log : Log
    height : int
        Of each figure, in pixels.
    """
    time = TimeFigures([log])
    channels = [
        ("current", "A", log.current_a, BLUE),
        ("voltage", "V", log.voltage_v, ORANGE),
        ("temperature", "°C", log.temperature_c, PURPLE),
    ]
    if log.soc_pct is not None and np.isfinite(log.soc_pct).any():
        channels.append(("SoC", "%", log.soc_pct, GREEN))
    plots = []
    for quantity, unit, values, color in channels:
        plot = time.plot(quantity, unit, height=height)
        time.line(plot, quantity, [(log.time_s, values)], Pen(color, in_legend=False))
        plots.append(plot)
    return _stacked(plots)


def estimate_figure(table: EstimateTable, log: Log | None = None, *, height: int = 240) -> Plot:
    """Return the SoC with ±2σ, by voltage and by counting alone, and the residual, over time.

    Parameters
    ----------
    table : EstimateTable
    log : Log, optional
        Its reference SoC is drawn too.
    height : int
        Of each figure, in pixels.
    """
    rows = SimpleNamespace(
        name="estimate",
        time_s=table.time_s,
        duration_s=float(table.time_s[-1] - table.time_s[0]) if len(table) else 0.0,
    )
    time = TimeFigures([cast("Recorded", rows)])
    at = table.time_s
    soc = time.plot("state of charge", "%", height=height)
    low, high = table.soc_pct - 2.0 * table.soc_std_pct, table.soc_pct + 2.0 * table.soc_std_pct
    time.band(soc, "±2σ", [(at, np.maximum(low, 0.0), np.minimum(high, 100.0))], BLUE)
    for name, values, pen in (
        ("by voltage alone", table.soc_newton_pct, Pen(GREY, 0.8, visible=False)),
        ("by counting alone", table.soc_coulomb_pct, Pen(ORANGE, dash="dashed")),
        ("estimate", table.soc_pct, Pen(BLUE, 1.8)),
    ):
        time.line(soc, name, [(at, values)], pen)
    if log is not None and log.soc_pct is not None:
        time.line(soc, "reference", [(log.time_s, log.soc_pct)], Pen(GREEN))
    residual = time.plot("measured − model", "V", height=height)
    add_zero(residual)
    pen = Pen(BLUE, in_legend=False)
    time.line(residual, "measured − model", [(at, table.residual_v)], pen)
    return _stacked([soc, residual])


def fit_figure(found: Identification, *, height: int = 240) -> Plot:
    """Return the pseudo-OCV over SoC, the residual over time and its histogram.

    Parameters
    ----------
    found : Identification
    height : int
        Of each figure, in pixels.
    """
    model = found.voltage_model
    soc_pct = np.linspace(*model.soc_range_pct, CURVE_POINTS)
    curve = new_figure(
        ("state of charge", "pseudo-OCV"),
        "@y{0.[00]} V at @x{0.[0]} %",
        units=("%", "V"),
        height=height,
    )
    volts = model.pseudo_ocv(soc_pct)
    add_line(curve, "pseudo-OCV", soc_pct, volts, Pen(BLUE, 1.8, in_legend=False))
    time = TimeFigures(found.logs)
    residual = time.plot("measured − model", "V", height=height, names=True)
    add_zero(residual)
    pieces = [(item.rows.time_s, item.residual_v) for item in found.fits]
    time.line(residual, "measured − model", pieces, Pen(BLUE, in_legend=False))
    errors = np.concatenate([item.residual_v for item in found.fits])
    held_out = np.concatenate([*found.held_out_error_v, np.empty(0)])
    shares = histogram(
        "measured − model", "V", [("fitted", errors, BLUE), ("held out", held_out, ORANGE)]
    )
    return _stacked([curve, residual, shares])


def diagnosis_figure(found: Diagnosis) -> Plot:
    """Return the probabilities of the causes as bars, the likeliest first.

    Parameters
    ----------
    found : Diagnosis
    """
    answer = found.posterior
    ordered = sorted(answer.probabilities.items(), key=lambda item: -item[1])
    entries = [
        (name, float(probability), BLUE if name == answer.verdict else GREY)
        for name, probability in ordered[:SHOWN_CAUSES]
    ]
    return bars("probability", "", entries, decimals=2)


def _stacked(plots: Sequence[Any]) -> Plot:
    return column(list(plots), sizing_mode="stretch_width")
