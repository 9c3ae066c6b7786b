"""The page of `cangauge inspect`: the channels of a log and what it can identify."""

from __future__ import annotations

from cangauge.extras.report.charts import Figure, Plot, TimeFigures, stacked
from cangauge.extras.report.page import Page
from cangauge.inspect.log import LogInspection, ability_rows, channel_rows
from cangauge.logs.log import Log


def inspect_page(found: LogInspection, log: Log) -> Page:
    """Return the page of the inspection of a log."""
    values = {
        "found": found,
        "log": log,
        "channels": channel_figures(log),
        "abilities": ability_rows(found),
        "channel_rows": channel_rows(found),
    }
    return Page.of("inspection.j2", values)


def log_figure(log: Log) -> Plot:
    """Return current, voltage, temperature and, where known, SoC over time, for a notebook."""
    return stacked(*channel_figures(log))


def channel_figures(log: Log) -> list[Figure]:
    """Return current, voltage, temperature and, where known, SoC over time."""
    captions = {
        "current": "Positive current discharges.",
        "voltage": "At the terminals.",
        "temperature": f"Measured on: {log.temperature_source}.",
    }
    if log.first_soc() is not None:
        captions["state of charge"] = "The log's own."
    time = TimeFigures([log.time_s])
    return [time.channel([log], name, caption) for name, caption in captions.items()]
