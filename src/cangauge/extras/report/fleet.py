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
from cangauge.extras.report.charts import BLUE, GREY, ORANGE, Figure, bars
from cangauge.extras.report.fit import (
    coefficient_tables,
    curve_figure,
    settings_table,
    slope_figure,
)
from cangauge.extras.report.page import Block, Page, Table, Tile, joined

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


def fleet_page(found: FleetOverview) -> Page:
    """Return the page of the results of a fleet."""
    return Page(
        title=f"Fleet of {counted(len(found.vehicles), 'vehicle')}",
        lead=_lead(found),
        subtitle=found.name,
        tiles=_tiles(found),
        sections={
            "Gaps": _gaps(found) if found.gaps else [],
            "Health over time": _health(found) if found.health else [],
            "State of charge": [_estimates(found)] if found.estimates else [],
            "Logs set aside": _set_aside(found.bad),
        },
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
    rows = [(name, found.gaps[name]) for name in found.by_gap]
    entries = [
        {
            "vehicle": name,
            "alarm": "gap" if row["detected"] else "–",
            "verdict": row["verdict"],
            "its probability": number(row["probability"], 2),
            "P(no fault)": number(row["probability_none"], 3),
            "error [V]": number(row["baseline_rmse_v"], 2),
            "of references [V]": number(row["healthy_rmse_v"], 2),
            "closed [%]": _percent(row["closed_fraction"]),
            "90 % set": ", ".join(row["credible_set"]),
        }
        for name, row in rows
    ]
    ratios = {
        name: row["baseline_rmse_v"] / row["healthy_rmse_v"] for name, row in found.gaps.items()
    }
    largest = [
        (name, ratios[name], ORANGE if found.gaps[name]["detected"] else GREY)
        for name in sorted(ratios, key=lambda name: -ratios[name])[:_BARS]
    ]
    caption = f"The {len(largest)} largest. Orange: P(no fault) is below the alarm's limit."
    label = "error of the model over that of the references"
    return [_table(entries), bars("Size of the gaps", label, largest, caption)]


def _percent(share: float | None) -> str:
    return number(None if share is None else 100.0 * share, 0)


def _health(found: FleetOverview) -> list[Block]:
    entries = []
    for vehicle, quantity, z in found.outlying:
        label, unit, digits = _LABELS[quantity]
        last = found.health[vehicle][-1]
        values = [of_vehicle[-1][quantity] for of_vehicle in found.health.values()]
        middle = float(np.median([value for value in values if value is not None]))
        entry = {
            "vehicle": vehicle,
            "outlier in": label,
            "value": number(last[quantity], digits, unit),
            "σ": number(last[QUANTITIES[quantity]], digits, unit),
            "median of the fleet": number(middle, digits, unit),
            "robust z": number(z, 1),
        }
        entries.append(entry)
    outliers = _table(entries) if entries else found.no_outlier_text
    return [outliers, *(_over_time(found, quantity) for quantity in QUANTITIES)]


def _over_time(found: FleetOverview, quantity: str) -> Figure:
    label, unit, _ = _LABELS[quantity]
    marked = sorted(vehicle for vehicle, of, _ in found.outlying if of == quantity)
    first_s = min(rows[0]["end_s"] for rows in found.health.values())
    dated = first_s > _YEAR_2000_S
    since = datetime.fromtimestamp(first_s, UTC).strftime("since %Y-%m-%d") if dated else "time"
    figure = Figure(
        label.capitalize(),
        f"{since} [days]",
        f"{label} [{unit}]" if unit else label,
        "One line a vehicle, a point at the end of each log; outliers of the fleet in orange.",
        hover="$name: @y",
        height=320,
    )
    others = [name for name in found.health if name not in marked][:_SHOWN]
    for name in (*others, *marked):
        rows = [row for row in found.health[name] if row[quantity] is not None]
        x = np.array([(row["end_s"] - first_s) / 86400.0 for row in rows])
        y = np.array([row[quantity] for row in rows], np.float64)
        is_marked = name in marked
        color, width, alpha = (ORANGE, 2.0, 1.0) if is_marked else (BLUE, 1.0, 0.5)
        figure.line(name, x, y, color, in_legend=is_marked, line_width=width, line_alpha=alpha)
        figure.plot.scatter(x=x, y=y, size=4, color=color, alpha=alpha, name=name)
    return figure


def _estimates(found: FleetOverview) -> Table:
    """Return the errors of each vehicle, the worst first."""
    entries = []
    for vehicle, rows in found.estimates.items():
        errors = [row["soc_mae_pct"] for row in rows if row["soc_mae_pct"] is not None]
        mean_error_pct = mean_of(errors)
        entry = {
            "vehicle": vehicle,
            "logs": str(len(rows)),
            "hours": number(sum(row["duration_s"] for row in rows) / 3600.0, 1),
            "SoC MAE [%]": number(mean_error_pct, 2),
            "worst log [%]": number(max(errors, default=None), 2),
            "mean σ [%]": number(mean_of([row["mean_soc_std_pct"] for row in rows]), 2),
            "within 2σ [%]": _percent(mean_of([row["cover_2sigma"] for row in rows])),
            "valid [%]": _percent(mean_of([row["valid_share"] for row in rows])),
        }
        entries.append((mean_error_pct or 0.0, entry))
    return _table([entry for _, entry in sorted(entries, key=lambda item: -item[0])])


def _set_aside(bad: Sequence[Mapping[str, Any]], heading: str = "command") -> list[Block]:
    """Return a table of the reasons for which logs were set aside, if any were."""
    entries = [
        {heading: row["table"], "logs": str(n), "reason": reason_of(row), "for example": row["log"]}
        for row, n in by_kind(bad)
    ]
    return [_table(entries)] if entries else []


def _table(entries: Sequence[Mapping[str, str]]) -> Table:
    return Table.of(entries[:_SHOWN], _note(len(entries)))


def _note(total: int) -> str:
    return f"{_SHOWN} of {total}; the results have all." if total > _SHOWN else ""


def fleet_fit_page(result: FleetFit) -> Page:
    """Return the page of a fleet's fit."""
    model, by_log = result.model, result.by_log
    unused = [
        *(row | {"table": "set aside"} for row in result.bad),
        *(row | {"table": "left out"} for row in result.left_out),
    ]
    curve = curve_figure(
        model.voltage_model(), "The curve of all logs, which cover the part that is not shaded."
    )
    caption = "A voltage error divided by this slope is the SoC error."
    slope = slope_figure(model.voltage_model(), caption)
    figures = result.to_dict()
    names = [by_log.logs[k] for k in by_log.misfits]
    verb = "does" if len(names) == 1 else "do"
    lead = f"{by_log.count_text} logs {verb} not fit the others: {joined(names)}."
    if not names:
        lead = "Every log fits the others." if by_log.is_known else by_log.rule_text
    rmse = significant(figures["voltage_rmse_v"], 3, "V")
    share = f"{number(figures['voltage_rmse_pct'], 3, '%')} of the voltage"
    left_out = significant(model.noise.voltage_rmse_v, 3, "V")
    return Page(
        title=f"Voltage model {model.name}",
        lead=lead,
        subtitle=f"Identified from {result.logs_used} logs of a fleet.",
        tiles=[
            Tile("Voltage error (RMSE)", rmse, share),
            Tile("Logs left out (RMSE)", left_out, "each by the model of the others"),
            Tile("Logs used", str(result.logs_used), f"{result.rows:,} rows"),
            Tile("Do not fit the others", by_log.count_text, "used all the same"),
            Tile("Logs set aside", str(len(unused)), "not used"),
        ],
        sections={
            "Logs that do not fit the others": _misfits(result),
            "Pseudo-OCV": [curve, slope],
            "Coefficients": coefficient_tables(model, result.published.condition_number),
            "Logs set aside and left out": _set_aside(unused, "status"),
            "How the model was made": [settings_table(model)],
        },
        model=model,
    )


def _misfits(result: FleetFit) -> list[Block]:
    by_log = result.by_log
    head, rows = by_log.misfit_rows()
    table = Table(head, rows[:_SHOWN], _note(len(rows)))
    largest = by_log.order[:_BARS]
    names = short_names([by_log.logs[k] for k in largest])
    largest_errors = [
        (name, float(by_log.mean_v[k]), ORANGE if k in by_log.misfits else GREY)
        for name, k in zip(names, largest, strict=True)
    ]
    caption = f"The {len(largest)} farthest of {len(by_log.logs)}."
    title, label = "Mean error of each log under the model of all", "mean of measured − modelled"
    figure = bars(title, label, largest_errors, caption, unit="V", decimals=None)
    return [*([table] if rows else []), by_log.rule_text, figure]
