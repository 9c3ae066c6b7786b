"""The page of `cangauge fleet`: which vehicles have which gap, health over time, outliers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np

from cangauge._text import counted, number
from cangauge.extras.fleet.dataset import by_kind, reason_of
from cangauge.extras.fleet.health import QUANTITIES
from cangauge.extras.fleet.outliers import OUTLIER_Z
from cangauge.extras.fleet.overview import FleetOverview
from cangauge.extras.report.charts import BLUE, GREY, ORANGE, Pen, Plot, add_line, bars, new_figure
from cangauge.extras.report.page import (
    Block,
    Figure,
    Page,
    Paragraph,
    Section,
    Table,
    Tile,
    joined,
    render,
)

SHOWN: Final = 200
"""Vehicles that a table or a figure shows; the data set has all."""

BARS: Final = 20
"""Vehicles in a figure of bars."""

DAY_S: Final = 86400.0
YEAR_2000_S: Final = 946684800.0
"""Later times are dates, earlier ones count from the first log without a known start."""

_LABELS: Final = {
    "capacity_ah": ("capacity", "Ah", 1),
    "resistance_ratio": ("resistance relative to the model", "", 2),
    "offset_a": ("offset of the current sensor", "A", 2),
}


def fleet_report(found: FleetOverview) -> str:
    """Return the results of a fleet as one self-contained HTML page."""
    return render(fleet_page(found))


def fleet_page(found: FleetOverview) -> Page:
    """Return the report's content (see `fleet_report`)."""
    sections = [
        Section(title, blocks)
        for title, blocks in (
            ("Gaps", _gaps(found)),
            ("Health over time", _health(found)),
            ("Outliers of the fleet", _outliers(found)),
            ("State of charge", _estimates(found)),
            ("Logs set aside", _bad(found)),
        )
        if blocks
    ]
    return Page(
        title=f"Fleet of {counted(len(found.vehicles), 'vehicle')}",
        subtitle=found.name,
        lead=_lead(found),
        tiles=_tiles(found),
        sections=sections,
    )


def _lead(found: FleetOverview) -> str:
    sentences = []
    if found.gaps:
        causes = [f"{name} ({found.gaps[name]['verdict']})" for name in found.alarms]
        sentences.append(
            f"{len(causes)} of {len(found.gaps)} vehicles have a gap: {joined(causes, 5)}."
            if causes
            else f"No significant gap in {counted(len(found.gaps), 'vehicle')};"
            f" {found.nearest_text}."
        )
    if found.health:
        names = list(dict.fromkeys(vehicle for vehicle, _, _ in found.outlying))
        sentences.append(
            f"{len(names)} differ in their health from the fleet: {joined(names, 5)}."
            if names
            else "No vehicle differs in its health from the fleet."
        )
    return " ".join(sentences)


def _tiles(found: FleetOverview) -> list[Tile]:
    tiles = [Tile("Vehicles", str(len(found.vehicles)))]
    if found.estimates:
        logs = sum(each.logs for each in found.estimates.values())
        hours = sum(each.hours for each in found.estimates.values())
        tiles.append(Tile("Logs estimated", str(logs), f"{hours:.0f} h"))
        errors = [e.soc_mae_pct for e in found.estimates.values() if e.soc_mae_pct is not None]
        if errors:
            middle = number(float(np.median(errors)), 2, "%")
            tiles.append(Tile("SoC error, MAE", middle, "median of the vehicles"))
    if found.gaps:
        tiles.append(Tile("With a gap", str(len(found.alarms)), f"of {len(found.gaps)} diagnosed"))
    if found.health:
        names = {vehicle for vehicle, _, _ in found.outlying}
        tiles.append(Tile("Outliers in health", str(len(names)), f"|z| ≥ {OUTLIER_Z}"))
    aside = {row["log"] for row in found.bad}
    tiles.append(Tile("Logs set aside", str(len(aside)), "not counted"))
    return tiles


def _gaps(found: FleetOverview) -> list[Block]:
    if not found.gaps:
        return []
    ordered = [*found.alarms, *(name for name in sorted(found.gaps) if name not in found.alarms)]
    rows = []
    for name in ordered[:SHOWN]:
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
    ratio = sorted(
        (
            (name, row["baseline_rmse_v"] / row["healthy_rmse_v"])
            for name, row in found.gaps.items()
        ),
        key=lambda item: -item[1],
    )[:BARS]
    colors = [ORANGE if found.gaps[name]["detected"] else GREY for name, _ in ratio]
    plot = bars(
        "error of the model over that of the references", "",
        [(name, value, color) for (name, value), color in zip(ratio, colors, strict=True)],
        decimals=2,
    )  # fmt: skip
    return [
        Table(head, rows, note=_shown(len(ordered))),
        Figure(
            "Size of the gaps", plot,
            f"The {len(ratio)} largest. Orange: P(no fault) is below the alarm's limit.",
        ),
    ]  # fmt: skip


def _health(found: FleetOverview) -> list[Block]:
    if not found.health:
        return []
    marked = {quantity: set[str]() for quantity in QUANTITIES}
    for vehicle, quantity, _ in found.outlying:
        marked[quantity].add(vehicle)
    return [
        Figure(
            f"{_LABELS[quantity][0][:1].upper()}{_LABELS[quantity][0][1:]}",
            _over_time(found, quantity, marked[quantity]),
            "One line a vehicle, a point at the end of each log; outliers of the fleet in orange.",
        )
        for quantity in QUANTITIES
    ]


def _over_time(found: FleetOverview, quantity: str, marked: set[str]) -> Plot:
    label, unit, _ = _LABELS[quantity]
    dated = all(rows[0]["end_s"] > YEAR_2000_S for rows in found.health.values())
    first_s = min(rows[0]["end_s"] for rows in found.health.values())
    since = datetime.fromtimestamp(first_s, UTC).strftime("since %Y-%m-%d") if dated else "time"
    plot = new_figure((since, label), "$name: @y", units=("days", unit), height=320)
    others = [name for name in found.health if name not in marked][:SHOWN]
    for name in (*others, *sorted(marked)):
        rows = [row for row in found.health[name] if row[quantity] is not None]
        x = np.array([(row["end_s"] - first_s) / DAY_S for row in rows])
        y = np.array([row[quantity] for row in rows])
        is_marked = name in marked
        color = ORANGE if is_marked else BLUE
        pen = (
            Pen(color, 2.0, in_legend=True) if is_marked else Pen(color, 1.0, 0.5, in_legend=False)
        )
        add_line(plot, name, x, y, pen)
        plot.scatter(x=x, y=y, size=4, color=color, alpha=pen.alpha, name=name)
    return plot


def _outliers(found: FleetOverview) -> list[Block]:
    if not found.health:
        return []
    if not found.outlying:
        return [Paragraph(found.no_outlier_text)]
    rows = []
    for vehicle, quantity, z in found.outlying[:SHOWN]:
        label, unit, digits = _LABELS[quantity]
        last = found.health[vehicle][-1]
        values = [each[-1][quantity] for each in found.health.values()]
        middle = float(np.median([value for value in values if value is not None]))
        rows.append(
            [
                vehicle,
                label,
                number(last[quantity], digits, unit),
                number(last[QUANTITIES[quantity]], digits, unit),
                number(middle, digits, unit),
                number(z, 1),
            ]
        )
    head = ["vehicle", "quantity", "value", "σ", "median of the fleet", "robust z"]
    return [Table(head, rows, note=_shown(len(found.outlying)))]


def _estimates(found: FleetOverview) -> list[Block]:
    if not found.estimates:
        return []
    ordered = sorted(found.estimates.items(), key=lambda item: -(item[1].soc_mae_pct or 0.0))
    rows = [
        [
            name,
            str(each.logs),
            number(each.hours, 1),
            number(each.soc_mae_pct, 2),
            number(each.worst_mae_pct, 2),
            number(each.soc_std_pct, 2),
            number(None if each.cover_2sigma is None else 100.0 * each.cover_2sigma, 0),
            number(100.0 * each.valid_share, 0),
        ]
        for name, each in ordered[:SHOWN]
    ]
    head = [
        "vehicle", "logs", "hours", "SoC MAE [%]", "worst log [%]", "mean σ [%]",
        "within 2σ [%]", "valid [%]",
    ]  # fmt: skip
    return [Table(head, rows, note=_shown(len(ordered)))]


def _bad(found: FleetOverview) -> list[Block]:
    text = found.elsewhere_text
    return [*bad_table(found.bad), *([Paragraph(text)] if text else [])]


def bad_table(bad: Sequence[Mapping[str, Any]], heading: str = "command") -> list[Block]:
    """Return a table of the reasons for which logs were set aside, if any were.

    Parameters
    ----------
    bad : sequence of mapping
        Each with `table`, `log`, `reason` and `kind`.
    heading : str
        Of the column with `table`.
    """
    if not bad:
        return []
    rows = [
        [row["table"], str(count), reason_of(row), row["log"]]
        for row, count in by_kind(bad)[:SHOWN]
    ]
    return [Table([heading, "logs", "reason", "for example"], rows)]


def _shown(total: int) -> str:
    return f"{SHOWN} of {total}; the data set has all." if total > SHOWN else ""
