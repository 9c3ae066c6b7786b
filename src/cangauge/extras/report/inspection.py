"""The page of `cangauge inspect`: the channels of a log and what it can identify."""

from __future__ import annotations

from cangauge._text import NONE_KNOWN, duration, significant
from cangauge.extras.report.charts import BLUE, GREEN, ORANGE, PURPLE, Pen, TimeFigures
from cangauge.extras.report.page import (
    Block,
    Bullets,
    Figure,
    InputFile,
    Page,
    Section,
    Table,
    Tile,
    reconstruction_banners,
    render,
)
from cangauge.extras.report.verdict import inspect_verdict
from cangauge.inspect.log import LogInspection
from cangauge.logs.log import Log


def inspect_report(found: LogInspection, log: Log) -> str:
    """Return an inspection as one self-contained HTML page.

    Parameters
    ----------
    found : LogInspection
    log : Log
        The inspected log.
    """
    return render(inspect_page(found, log))


def inspect_page(found: LogInspection, log: Log) -> Page:
    """Return the report's content (see `inspect_report`); `figures` holds the bokeh figures."""
    rate = significant(found.timing.rate_hz, 4, "Hz") if found.timing.rate_hz else "one row"
    notes = [
        Section(title, [Bullets(lines)])
        for title, lines in (("Warnings", found.warnings), ("Remarks", found.remarks))
        if lines
    ]
    return Page(
        title=f"Inspection of {found.name}",
        lead=inspect_verdict(found),
        subtitle=f"{duration(found.timing.duration_s)}, {found.rows:,} rows, {rate}"
        f" ({'regular' if found.timing.regular else 'irregular'}).",
        tiles=_tiles(found),
        sections=[
            Section("Recorded data", _channel_figures(log)),
            Section("What this log can identify", [_abilities(found)]),
            Section("Channels", [_channels(found)]),
            *notes,
        ],
        inputs=[InputFile.of_path("log", found.name, found.source)],
        banners=reconstruction_banners(found.name, found.source, *found.remarks),
    )


def _tiles(found: LogInspection) -> list[Tile]:
    charge, soc = found.charge, found.soc
    tiles = [
        Tile("Discharged", significant(charge.discharged_ah, 4, "Ah"),
             f"charged {significant(charge.charged_ah, 4, 'Ah')}"),
    ]  # fmt: skip
    if found.resistance is not None:
        median = significant(found.resistance.median_ohm, 3, "Ω")
        tiles.append(Tile("Resistance", median, "median of steps of current"))
    if soc is not None:
        ends = f"{soc.first_pct:.1f} → {soc.last_pct:.1f} %"
        tiles.append(Tile("The log's own SoC", ends, f"in {100.0 * soc.coverage:.1f} % of rows"))
    return tiles


def _channel_figures(log: Log) -> list[Block]:
    time = TimeFigures([log])
    soc = () if log.soc_pct is None else (("State of charge", "%", log.soc_pct, GREEN, "the log"),)
    figures: list[Block] = []
    for name, unit, values, color, source in (
        ("Current", "A", log.current_a, BLUE, ""),
        ("Voltage", "V", log.voltage_v, ORANGE, ""),
        ("Temperature", "°C", log.temperature_c, PURPLE, log.temperature_source),
        *soc,
    ):
        plot = time.plot(name.lower(), unit, height=235)
        pen = Pen(color, width=1.0, in_legend=False)
        time.line(plot, name.lower(), [(log.time_s, values)], pen)
        caption = f"As given by: {source}." if source else "Positive current discharges."
        figures.append(Figure(name, plot, caption if name != "Voltage" else "At the terminals."))
    return figures


def _abilities(found: LogInspection) -> Table:
    rows = [[item.topic, item.verdict, item.text] for item in found.abilities]
    return Table(["quantity", "identifiable", "reason"], rows)


def _channels(found: LogInspection) -> Table:
    rows = [
        [
            name.rsplit("_", 1)[0],
            *(significant(value, 5) for value in (item.minimum, item.median, item.maximum)),
            item.unit,
            NONE_KNOWN if item.levels == 1 else significant(item.quantum, 3),
            str(item.missing),
        ]
        for name, item in found.channels.items()
    ]
    return Table(
        ["channel", "minimum", "median", "maximum", "unit", "step", "missing rows"], rows,
        "Step: the quantization; – for a constant channel.",
    )  # fmt: skip
