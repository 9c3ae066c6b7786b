"""Figures of a log, an estimate, a fit and a diagnosis for notebooks: thin faces of `charts`.

Each returns a bokeh object for `bokeh.plotting.show`. The methods `Log.plot`, `EstimateTable.plot`,
`Identification.plot` and `Diagnosis.plot` call them.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from bokeh.layouts import column

from cangauge.diagnosis import Diagnosis
from cangauge.estimation.offline import EstimateTable
from cangauge.extras.report.charts import (
    BLUE,
    GREY,
    ORANGE,
    Pen,
    Plot,
    TimeFigures,
    add_line,
    add_zero,
    bars,
    histogram,
    new_figure,
)
from cangauge.extras.report.estimate import soc_plot
from cangauge.extras.report.inspection import channel_figures
from cangauge.identify.identification import Identification
from cangauge.logs.log import Log
from cangauge.service.offline import Recorded

_SHOWN_CAUSES = 8


def log_figure(log: Log) -> Plot:
    """Return current, voltage, temperature and, where known, SoC over time."""
    return _stacked(*(figure.plot for figure in channel_figures(log)))


def estimate_figure(table: EstimateTable, log: Log | None = None) -> Plot:
    """Return the SoC with ±2σ, by voltage and by counting alone, and the residual, over time.

    Parameters
    ----------
    table : EstimateTable
    log : Log, optional
        Its reference SoC is drawn too.
    """
    span_s = float(table.time_s[-1] - table.time_s[0]) if len(table) else 0.0
    rows = SimpleNamespace(name="estimate", time_s=table.time_s, duration_s=span_s)
    time = TimeFigures([cast("Recorded", rows)])
    has_soc = log is not None and log.soc_pct is not None
    soc = soc_plot(table, (log.time_s, log.soc_pct) if has_soc else None, time)  # type: ignore[union-attr,arg-type]
    return _stacked(soc, _residual(time, [(table.time_s, table.residual_v)]))


def fit_figure(found: Identification) -> Plot:
    """Return the pseudo-OCV over SoC, the residual over time and its histogram."""
    model = found.voltage_model
    soc_pct = np.linspace(*model.soc_range_pct, 400)
    curve = new_figure(
        ("state of charge", "pseudo-OCV"), "@y{0.[00]} V at @x{0.[0]} %", units=("%", "V")
    )
    volts = model.pseudo_ocv(soc_pct)
    add_line(curve, "pseudo-OCV", soc_pct, volts, Pen(BLUE, 1.8, in_legend=False))
    pieces = [(item.rows.time_s, item.residual_v) for item in found.fits]
    errors = np.concatenate([values for _, values in pieces])
    held_out = np.concatenate([*found.held_out_error_v, np.empty(0)])
    parts = [("fitted", errors, BLUE), ("held out", held_out, ORANGE)]
    shares = histogram("measured − model", "V", parts)
    return _stacked(curve, _residual(TimeFigures(found.logs), pieces), shares)


def diagnosis_figure(found: Diagnosis) -> Plot:
    """Return the probabilities of the causes as bars, the likeliest first."""
    answer = found.posterior
    ordered = sorted(answer.probabilities.items(), key=lambda item: -item[1])
    entries = [
        (name, float(probability), BLUE if name == answer.verdict else GREY)
        for name, probability in ordered[:_SHOWN_CAUSES]
    ]
    return bars("probability", "", entries, decimals=2)


def _residual(time: TimeFigures, pieces: Any) -> Plot:
    plot = time.plot("measured − model", "V", names=True)
    add_zero(plot)
    time.line(plot, "measured − model", pieces, Pen(BLUE, in_legend=False))
    return plot


def _stacked(*plots: Any) -> Plot:
    return column(list(plots), sizing_mode="stretch_width")
