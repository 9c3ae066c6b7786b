"""The page of `cangauge inspect`: the channels of a log and what it can identify."""

from __future__ import annotations

from cangauge._text import duration, significant
from cangauge.extras.report.charts import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    Figure,
    Plot,
    TimeFigures,
    stacked,
)
from cangauge.extras.report.page import Page, Table, Tile
from cangauge.inspect.log import LogInspection, ability_rows, channel_rows
from cangauge.logs.log import Log


def inspect_page(found: LogInspection, log: Log) -> Page:
    """Return the page of the inspection of a log."""
    timing, charge, soc = found.timing, found.charge, found.soc
    rate = significant(timing.rate_hz, 4, "Hz") if timing.rate_hz else "one row"
    regular = "regular" if timing.regular else "irregular"
    charged = f"charged {significant(charge.charged_ah, 4, 'Ah')}"
    tiles = [Tile("Discharged", significant(charge.discharged_ah, 4, "Ah"), charged)]
    if found.resistance is not None:
        median = significant(found.resistance["median_ohm"], 3, "Ω")
        tiles.append(Tile("Resistance", median, "median of steps of current"))
    if soc is not None:
        ends = f"{soc.first_pct:.1f} → {soc.last_pct:.1f} %"
        tiles.append(Tile("The log's own SoC", ends, f"in {100.0 * soc.coverage:.1f} % of rows"))
    return Page(
        title=f"Inspection of {found.name}",
        lead=f"{found.answer[0].upper()}{found.answer[1:]}.",
        subtitle=f"{duration(timing.duration_s)}, {found.rows:,} rows, {rate} ({regular}).",
        tiles=tiles,
        sections={
            "Recorded data": channel_figures(log),
            "What this log can identify": [Table(*ability_rows(found))],
            "Channels": [Table(*channel_rows(found), "Step: the quantization.")],
            "Warnings": [found.warnings] if found.warnings else [],
            "Remarks": [found.remarks] if found.remarks else [],
        },
        logs=[log],
    )


def log_figure(log: Log) -> Plot:
    """Return current, voltage, temperature and, where known, SoC over time, for a notebook."""
    return stacked(*channel_figures(log))


def channel_figures(log: Log) -> list[Figure]:
    """Return current, voltage, temperature and, where known, SoC over time."""
    at, time = log.time_s, TimeFigures([log.time_s])
    measured_on = f"Measured on: {log.temperature_source}."
    figures = [
        time.channel("current", "A", [(at, log.current_a)], BLUE, "Positive current discharges."),
        time.channel("voltage", "V", [(at, log.voltage_v)], ORANGE, "At the terminals."),
        time.channel("temperature", "°C", [(at, log.temperature_c)], PURPLE, measured_on),
    ]
    if log.first_soc() is not None and log.soc_pct is not None:
        soc = [(at, log.soc_pct)]
        figures.append(time.channel("state of charge", "%", soc, GREEN, "The log's own."))
    return figures
