"""The pages of `cangauge fleet`: gaps, health and errors of the vehicles; the fit of all logs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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
from cangauge.extras.report.fit import coefficient_tables, settings_table, slope_figure
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
    table = _table(
        [(name, found.gaps[name]) for name in found.by_gap],
        {
            "vehicle": lambda of: of[0],
            "alarm": lambda of: "gap" if of[1]["detected"] else "–",
            "verdict": lambda of: of[1]["verdict"],
            "its probability": lambda of: number(of[1]["probability"], 2),
            "P(no fault)": lambda of: number(of[1]["probability_none"], 3),
            "error [V]": lambda of: number(of[1]["baseline_rmse_v"], 2),
            "of references [V]": lambda of: number(of[1]["healthy_rmse_v"], 2),
            "closed [%]": lambda of: _percent(of[1]["closed_fraction"]),
            "90 % set": lambda of: ", ".join(of[1]["credible_set"]),
        },
    )
    ratios = {
        name: row["baseline_rmse_v"] / row["healthy_rmse_v"] for name, row in found.gaps.items()
    }
    largest = [
        (name, ratios[name], ORANGE if found.gaps[name]["detected"] else GREY)
        for name in sorted(ratios, key=lambda name: -ratios[name])[:_BARS]
    ]
    caption = f"The {len(largest)} largest. Orange: P(no fault) is below the alarm's limit."
    label = "error of the model over that of the references"
    return [table, bars("Size of the gaps", label, largest, caption)]


def _percent(share: float | None) -> str:
    return number(None if share is None else 100.0 * share, 0)


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
    outliers = Table(head, rows, _note(len(found.outlying))) if rows else found.no_outlier_text
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

    def mean(rows: Sequence[Mapping[str, Any]], column: str) -> float | None:
        return mean_of([row[column] for row in rows])

    def worst(rows: Sequence[Mapping[str, Any]]) -> float | None:
        errors = [row["soc_mae_pct"] for row in rows if row["soc_mae_pct"] is not None]
        return max(errors, default=None)

    return _table(
        sorted(found.estimates.items(), key=lambda of: -(mean(of[1], "soc_mae_pct") or 0.0)),
        {
            "vehicle": lambda of: of[0],
            "logs": lambda of: str(len(of[1])),
            "hours": lambda of: number(sum(row["duration_s"] for row in of[1]) / 3600.0, 1),
            "SoC MAE [%]": lambda of: number(mean(of[1], "soc_mae_pct"), 2),
            "worst log [%]": lambda of: number(worst(of[1]), 2),
            "mean σ [%]": lambda of: number(mean(of[1], "mean_soc_std_pct"), 2),
            "within 2σ [%]": lambda of: _percent(mean(of[1], "cover_2sigma")),
            "valid [%]": lambda of: _percent(mean(of[1], "valid_share")),
        },
    )


def _set_aside(bad: Sequence[Mapping[str, Any]], heading: str = "command") -> list[Block]:
    """Return a table of the reasons for which logs were set aside, if any were."""
    rows = [[row["table"], str(count), reason_of(row), row["log"]] for row, count in by_kind(bad)]
    head = [heading, "logs", "reason", "for example"]
    return [Table(head, rows[:_SHOWN], _note(len(rows)))] if rows else []


def _table(items: Sequence[Any], columns: Mapping[str, Callable[[Any], str]]) -> Table:
    return Table.of(items[:_SHOWN], columns, _note(len(items)))


def _note(total: int) -> str:
    return f"{_SHOWN} of {total}; the results have all." if total > _SHOWN else ""


def fleet_fit_page(result: FleetFit) -> Page:
    """Return the page of a fleet's fit."""
    model, by_log = result.model, result.by_log
    unused = [
        *(row | {"table": "set aside"} for row in result.bad),
        *(row | {"table": "left out"} for row in result.left_out),
    ]
    grid, equation = np.linspace(0.0, 100.0, 401), model.voltage_model()
    curve = Figure(
        "Pseudo-OCV against SoC",
        "state of charge [%]",
        "voltage [V]",
        "The curve of all logs.",
        hover="@y{0.00} V<br>at @x{0.0} %",
        height=340,
    )
    curve.line("pseudo-OCV", grid, equation.pseudo_ocv(grid), BLUE, line_width=2.2)
    slope = slope_figure(equation, "A voltage error divided by this slope is the SoC error.")
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
    table = _table(
        by_log.misfits,
        {
            "vehicle": lambda k: by_log.vehicles[k],
            "log": lambda k: by_log.logs[k],
            "mean error [V]": lambda k: significant(float(by_log.mean_v[k]), 3),
            "RMSE [V]": lambda k: significant(float(by_log.rmse_v[k]), 3),
            "robust z": lambda k: number(float(by_log.z[k]), 1),
        },
    )
    largest = by_log.order[:_BARS]
    names = short_names([by_log.logs[k] for k in largest])
    entries = [
        (name, float(by_log.mean_v[k]), ORANGE if k in by_log.misfits else GREY)
        for name, k in zip(names, largest, strict=True)
    ]
    caption = f"The {len(largest)} farthest of {len(by_log.logs)}."
    title, label = "Mean error of each log under the model of all", "mean of measured − modelled"
    figure = bars(title, label, entries, caption, unit="V", decimals=None)
    return [*([table] if table.rows else []), by_log.rule_text, figure]
