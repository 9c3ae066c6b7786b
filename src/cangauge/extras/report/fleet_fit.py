"""The page of `cangauge fleet fit`: logs that do not fit the others, curve and coefficients."""

from __future__ import annotations

from typing import Final

import numpy as np

from cangauge._text import number, significant, span
from cangauge.extras.fleet.fit import FleetFit
from cangauge.extras.fleet.sources import short_names
from cangauge.extras.report.charts import (
    BLUE,
    GREY,
    ORANGE,
    Pen,
    add_line,
    bars,
    new_figure,
    shade_outside,
)
from cangauge.extras.report.fit import coefficient_tables, settings_table, slope_plot
from cangauge.extras.report.fleet import BARS, SHOWN, bad_table
from cangauge.extras.report.page import (
    Beside,
    Block,
    Figure,
    InputFile,
    Page,
    Paragraph,
    Section,
    Table,
    Tile,
    joined,
    render,
)

_HEAD: Final = (
    "vehicle", "log", "mean error [V]", "RMSE [V]", "robust z",
)  # fmt: skip


def fleet_fit_report(result: FleetFit) -> str:
    """Return the report of a fleet's fit as one self-contained HTML page."""
    return render(fleet_fit_page(result))


def fleet_fit_page(result: FleetFit) -> Page:
    """Return the report's content (see `fleet_fit_report`)."""
    model = result.model
    unused = [
        *(each | {"table": "set aside"} for each in result.bad),
        *(each | {"table": "left out"} for each in result.left_out),
    ]
    aside = bad_table(unused, "status")
    sections = [
        Section("Logs that do not fit the others", _misfits(result)),
        Section("Pseudo-OCV", [_curves(result)]),
        Section("Coefficients", coefficient_tables(model, result.published.condition_number)),
        *([Section("Logs set aside and left out", aside)] if aside else []),
        Section("How the model was made", [settings_table(model)]),
    ]
    return Page(
        title=f"Voltage model {model.name}",
        lead=_lead(result),
        subtitle=f"Identified from {result.logs_used} logs of a fleet.",
        tiles=_tiles(result),
        sections=sections,
        inputs=[InputFile.of_model(model)],
    )


def _lead(result: FleetFit) -> str:
    by_log = result.by_log
    names = [by_log.logs[k] for k in by_log.misfits]
    if not names:
        return "Every log fits the others." if by_log.is_known else by_log.rule_text
    verb = "does" if len(names) == 1 else "do"
    return f"{by_log.count_text} logs {verb} not fit the others: {joined(names)}."


def _tiles(result: FleetFit) -> list[Tile]:
    figures, noise = result.to_dict(), result.model.noise
    return [
        Tile("Voltage error (RMSE)", significant(figures["voltage_rmse_v"], 3, "V"),
             f"{number(figures['voltage_rmse_pct'], 3, '%')} of the voltage"),
        Tile("Logs left out (RMSE)", significant(noise.voltage_rmse_v, 3, "V"),
             "each by the model of the others"),
        Tile("Logs used", str(result.logs_used), f"{figures['rows']:,} rows"),
        Tile("Do not fit the others", result.by_log.count_text, "used all the same"),
        Tile("Logs set aside", str(len(result.bad) + len(result.left_out)), "not used"),
    ]  # fmt: skip


def _misfits(result: FleetFit) -> list[Block]:
    by_log = result.by_log
    marked = set(by_log.misfits)
    z = by_log.z
    rows = [
        [
            by_log.vehicles[k],
            by_log.logs[k],
            significant(float(by_log.mean_v[k]), 3),
            significant(float(by_log.rmse_v[k]), 3),
            number(float(z[k]), 1),
        ]
        for k in by_log.misfits[:SHOWN]
    ]
    largest = by_log.order[:BARS]
    names = short_names([by_log.logs[k] for k in largest])
    plot = bars(
        "mean of measured − modelled", "V",
        [
            (name, float(by_log.mean_v[k]), ORANGE if k in marked else GREY)
            for name, k in zip(names, largest, strict=True)
        ],
        decimals=None,
    )  # fmt: skip
    return [
        *([Table(_HEAD, rows)] if rows else []),
        Paragraph(by_log.rule_text),
        Figure(
            "Mean error of each log under the model of all", plot,
            f"The {len(largest)} farthest of {len(by_log.logs)}.",
        ),
    ]  # fmt: skip


def _curves(result: FleetFit) -> Beside:
    model = result.model.voltage_model()
    plot = new_figure(
        ("state of charge", "voltage"), "$name: @y{0.00} V<br>at @x{0.0} %", units=("%", "V"),
        height=340,
    )  # fmt: skip
    grid = np.linspace(0.0, 100.0, 401)
    pen = Pen(BLUE, width=2.2, in_legend=False)
    add_line(plot, "pseudo-OCV", grid, model.pseudo_ocv(grid), pen)
    shade_outside(plot, *model.soc_range_pct)
    return Beside(
        [
            Figure(
                "Pseudo-OCV against SoC", plot,
                f"The logs cover {span(*model.soc_range_pct, 1, '%')}; in the"
                " shaded part it follows the typical cell of the chemistry.",
            ),
            Figure(
                "Slope of the pseudo-OCV", slope_plot(model),
                "A voltage error divided by this slope is the SoC error.",
            ),
        ]
    )  # fmt: skip
