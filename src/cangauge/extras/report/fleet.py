"""The pages of `cangauge fleet`: gaps, health and errors of the vehicles; the fit of all logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np

from cangauge._text import counted, number, significant
from cangauge.extras.fleet.fit import FleetFit
from cangauge.extras.fleet.jobs import mean_of
from cangauge.extras.fleet.outliers import OUTLIER_Z
from cangauge.extras.fleet.overview import QUANTITIES, FleetOverview
from cangauge.extras.fleet.results import by_kind, reason_of
from cangauge.extras.fleet.sources import short_names
from cangauge.extras.report.charts import BLUE, GREY, ORANGE, Pen, Plot, add_line, bars, new_figure
from cangauge.extras.report.fit import coefficient_tables, settings_table, slope_plot
from cangauge.extras.report.page import (
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

_SHOWN: Final = 200
"""Vehicles that a table or a figure shows; the results have all."""
_BARS: Final = 20
"""Vehicles, or logs, in a figure of bars."""
_YEAR_2000_S: Final = 946684800.0
"""Later times are dates, earlier ones count from the first log without a known start."""
_LABELS: Final = {
    "capacity_ah": ("capacity", "Ah", 1),
    "resistance_ratio": ("resistance relative to the model", "", 2),
    "offset_a": ("offset of the current sensor", "A", 2),
}


def fleet_report(found: FleetOverview) -> str:
    """Return the results of a fleet as one self-contained HTML page."""
    parts = (
        ("Gaps", _gaps(found) if found.gaps else []),
        ("Health over time", _health(found) if found.health else []),
        ("State of charge", [_estimates(found)] if found.estimates else []),
        ("Logs set aside", _set_aside(found.bad)),
    )
    return render(
        Page(
            title=f"Fleet of {counted(len(found.vehicles), 'vehicle')}",
            subtitle=found.name,
            lead=_lead(found),
            tiles=_tiles(found),
            sections=[Section(title, blocks) for title, blocks in parts if blocks],
        )
    )


def _lead(found: FleetOverview) -> str:
    sentences = []
    if found.gaps:
        causes = [f"{name} ({found.gaps[name]['verdict']})" for name in found.alarms]
        sentences.append(
            f"{len(causes)} of {len(found.gaps)} vehicles have a gap: {joined(causes, 5)}."
            if causes
            else f"No significant gap in {counted(len(found.gaps), 'vehicle')}."
        )
    if found.health:
        names = list(dict.fromkeys(vehicle for vehicle, _, _ in found.outlying))
        differ = "vehicle differs" if len(names) == 1 else "vehicles differ"
        sentences.append(
            f"{len(names)} {differ} in health from the fleet: {joined(names, 5)}."
            if names
            else "No vehicle differs in health from the fleet."
        )
    return " ".join(sentences)


def _tiles(found: FleetOverview) -> list[Tile]:
    tiles = [Tile("Vehicles", str(len(found.vehicles)))]
    if found.estimates:
        rows = [row for of_vehicle in found.estimates.values() for row in of_vehicle]
        hours = sum(row["duration_s"] for row in rows) / 3600.0
        error = number(found.to_dict()["soc_mae_pct"], 2, "%")
        tiles.append(Tile("Logs estimated", str(len(rows)), f"{hours:.0f} h"))
        tiles.append(Tile("SoC error, MAE", error, "mean of the vehicles"))
    if found.gaps:
        tiles.append(Tile("With a gap", str(len(found.alarms)), f"of {len(found.gaps)} diagnosed"))
    if found.health:
        names = {vehicle for vehicle, _, _ in found.outlying}
        tiles.append(Tile("Outliers in health", str(len(names)), f"|z| ≥ {OUTLIER_Z}"))
    aside = {row["log"] for row in found.bad}
    return [*tiles, Tile("Logs set aside", str(len(aside)), "not counted")]


def _gaps(found: FleetOverview) -> list[Block]:
    rows = []
    for name in found.by_gap[:_SHOWN]:
        row = found.gaps[name]
        closed = row["closed_fraction"]
        rows.append(
            [
                name,
                "gap" if row["detected"] else "–",
                row["verdict"],
                number(row["probability"], 2),
                number(row["probability_none"], 3),
                number(row["baseline_rmse_v"], 2),
                number(row["healthy_rmse_v"], 2),
                number(None if closed is None else 100.0 * closed, 0),
                ", ".join(row["credible_set"]),
            ]
        )
    head = [
        "vehicle", "alarm", "verdict", "its probability", "P(no fault)", "error [V]",
        "of references [V]", "closed [%]", "90 % set",
    ]  # fmt: skip
    entries = [
        (
            name,
            row["baseline_rmse_v"] / row["healthy_rmse_v"],
            ORANGE if row["detected"] else GREY,
        )
        for name, row in found.gaps.items()
    ]
    largest = sorted(entries, key=lambda entry: -entry[1])[:_BARS]
    plot = bars("error of the model over that of the references", "", largest, decimals=2)
    caption = f"The {len(largest)} largest. Orange: P(no fault) is below the alarm's limit."
    return [_table(head, rows, len(found.gaps)), Figure("Size of the gaps", plot, caption)]


def _health(found: FleetOverview) -> list[Block]:
    rows = []
    for vehicle, quantity, z in found.outlying[:_SHOWN]:
        label, unit, digits = _LABELS[quantity]
        last = found.health[vehicle][-1]
        values = [of_vehicle[-1][quantity] for of_vehicle in found.health.values()]
        middle = float(np.median([value for value in values if value is not None]))
        numbers = (last[quantity], last[QUANTITIES[quantity]], middle)
        shown = [number(value, digits, unit) for value in numbers]
        rows.append([vehicle, label, *shown, number(z, 1)])
    head = ["vehicle", "outlier in", "value", "σ", "median of the fleet", "robust z"]
    outliers = _table(head, rows, len(found.outlying)) if rows else Paragraph(found.no_outlier_text)
    caption = "One line a vehicle, a point at the end of each log; outliers of the fleet in orange."
    figures = [
        Figure(_LABELS[quantity][0].capitalize(), _over_time(found, quantity), caption)
        for quantity in QUANTITIES
    ]
    return [outliers, *figures]


def _over_time(found: FleetOverview, quantity: str) -> Plot:
    label, unit, _ = _LABELS[quantity]
    marked = sorted(vehicle for vehicle, of, _ in found.outlying if of == quantity)
    starts_s = [rows[0]["end_s"] for rows in found.health.values()]
    first_s = min(starts_s)
    dated = first_s > _YEAR_2000_S
    since = datetime.fromtimestamp(first_s, UTC).strftime("since %Y-%m-%d") if dated else "time"
    plot = new_figure((since, label), "$name: @y", units=("days", unit), height=320)
    others = [name for name in found.health if name not in marked][:_SHOWN]
    for name in (*others, *marked):
        rows = [row for row in found.health[name] if row[quantity] is not None]
        x = np.array([(row["end_s"] - first_s) / 86400.0 for row in rows])
        y = np.array([row[quantity] for row in rows])
        is_marked = name in marked
        color = ORANGE if is_marked else BLUE
        pen = Pen(color, 2.0 if is_marked else 1.0, 1.0 if is_marked else 0.5, in_legend=is_marked)
        add_line(plot, name, x, y, pen)
        plot.scatter(x=x, y=y, size=4, color=color, alpha=pen.alpha, name=name)
    return plot


def _estimates(found: FleetOverview) -> Table:
    rows = []
    worst_first = sorted(
        found.estimates.items(),
        key=lambda item: -(mean_of([row["soc_mae_pct"] for row in item[1]]) or 0.0),
    )
    for name, of_vehicle in worst_first:
        columns = ("soc_mae_pct", "mean_soc_std_pct", "cover_2sigma", "valid_share")
        error, std, cover, valid = (
            mean_of([row[column] for row in of_vehicle]) for column in columns
        )
        known = [row["soc_mae_pct"] for row in of_vehicle if row["soc_mae_pct"] is not None]
        percents = [None if share is None else 100.0 * share for share in (cover, valid)]
        rows.append(
            [
                name,
                str(len(of_vehicle)),
                number(sum(row["duration_s"] for row in of_vehicle) / 3600.0, 1),
                number(error, 2),
                number(max(known, default=None), 2),
                number(std, 2),
                *(number(share, 0) for share in percents),
            ]
        )
    head = [
        "vehicle", "logs", "hours", "SoC MAE [%]", "worst log [%]", "mean σ [%]",
        "within 2σ [%]", "valid [%]",
    ]  # fmt: skip
    return _table(head, rows, len(rows))


def _set_aside(bad: Sequence[Mapping[str, Any]], heading: str = "command") -> list[Block]:
    """Return a table of the reasons for which logs were set aside, if any were."""
    rows = [[row["table"], str(count), reason_of(row), row["log"]] for row, count in by_kind(bad)]
    return [_table([heading, "logs", "reason", "for example"], rows, len(rows))] if rows else []


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], total: int) -> Table:
    note = f"{_SHOWN} of {total}; the results have all." if total > _SHOWN else ""
    return Table(head, rows[:_SHOWN], note=note)


def fleet_fit_report(result: FleetFit) -> str:
    """Return the report of a fleet's fit as one self-contained HTML page."""
    model, by_log = result.model, result.by_log
    unused = [
        *(row | {"table": "set aside"} for row in result.bad),
        *(row | {"table": "left out"} for row in result.left_out),
    ]
    curve = new_figure(
        ("state of charge", "voltage"), "@y{0.00} V<br>at @x{0.0} %", units=("%", "V"), height=340
    )
    grid = np.linspace(0.0, 100.0, 401)
    equation = model.voltage_model()
    add_line(curve, "pseudo-OCV", grid, equation.pseudo_ocv(grid), Pen(BLUE, 2.2, in_legend=False))
    parts = (
        ("Logs that do not fit the others", _misfits(result)),
        (
            "Pseudo-OCV",
            [
                Figure("Pseudo-OCV against SoC", curve, "The curve of all logs."),
                Figure(
                    "Slope of the pseudo-OCV",
                    slope_plot(equation),
                    "A voltage error divided by this slope is the SoC error.",
                ),
            ],
        ),
        ("Coefficients", coefficient_tables(model, result.published.condition_number)),
        ("Logs set aside and left out", _set_aside(unused, "status")),
        ("How the model was made", [settings_table(model)]),
    )
    figures, noise = result.to_dict(), model.noise
    names = [by_log.logs[k] for k in by_log.misfits]
    verb = "does" if len(names) == 1 else "do"
    lead = f"{by_log.count_text} logs {verb} not fit the others: {joined(names)}."
    if not names:
        lead = "Every log fits the others." if by_log.is_known else by_log.rule_text
    return render(
        Page(
            title=f"Voltage model {model.name}",
            lead=lead,
            subtitle=f"Identified from {result.logs_used} logs of a fleet.",
            tiles=[
                Tile(
                    "Voltage error (RMSE)",
                    significant(figures["voltage_rmse_v"], 3, "V"),
                    f"{number(figures['voltage_rmse_pct'], 3, '%')} of the voltage",
                ),
                Tile(
                    "Logs left out (RMSE)",
                    significant(noise.voltage_rmse_v, 3, "V"),
                    "each by the model of the others",
                ),
                Tile("Logs used", str(result.logs_used), f"{result.rows:,} rows"),
                Tile("Do not fit the others", by_log.count_text, "used all the same"),
                Tile("Logs set aside", str(len(unused)), "not used"),
            ],
            sections=[Section(title, blocks) for title, blocks in parts if blocks],
            inputs=[InputFile.of_model(model)],
        )
    )


def _misfits(result: FleetFit) -> list[Block]:
    by_log, z = result.by_log, result.by_log.z
    rows = [
        [
            by_log.vehicles[k],
            by_log.logs[k],
            significant(float(by_log.mean_v[k]), 3),
            significant(float(by_log.rmse_v[k]), 3),
            number(float(z[k]), 1),
        ]
        for k in by_log.misfits
    ]
    largest = by_log.order[:_BARS]
    names = short_names([by_log.logs[k] for k in largest])
    entries = [
        (name, float(by_log.mean_v[k]), ORANGE if k in by_log.misfits else GREY)
        for name, k in zip(names, largest, strict=True)
    ]
    plot = bars("mean of measured − modelled", "V", entries, decimals=None)
    head = ["vehicle", "log", "mean error [V]", "RMSE [V]", "robust z"]
    caption = f"The {len(largest)} farthest of {len(by_log.logs)}."
    return [
        *([_table(head, rows, len(rows))] if rows else []),
        Paragraph(by_log.rule_text),
        Figure("Mean error of each log under the model of all", plot, caption),
    ]
