"""The page of `cangauge inspect`: the channels of a log and what it can identify."""

from __future__ import annotations

from cangauge._text import duration, significant
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
from cangauge.inspect.log import LogInspection, ability_rows, channel_rows
from cangauge.logs.log import Log


def inspect_report(found: LogInspection, log: Log) -> str:
    """Return the inspection of a log as one self-contained HTML page."""
    rate = significant(found.timing.rate_hz, 4, "Hz") if found.timing.rate_hz else "one row"
    regular = "regular" if found.timing.regular else "irregular"
    charge, soc = found.charge, found.soc
    tiles = [
        Tile(
            "Discharged",
            significant(charge.discharged_ah, 4, "Ah"),
            f"charged {significant(charge.charged_ah, 4, 'Ah')}",
        )
    ]
    if found.resistance is not None:
        median = significant(found.resistance.median_ohm, 3, "Ω")
        tiles.append(Tile("Resistance", median, "median of steps of current"))
    if soc is not None:
        ends = f"{soc.first_pct:.1f} → {soc.last_pct:.1f} %"
        tiles.append(Tile("The log's own SoC", ends, f"in {100.0 * soc.coverage:.1f} % of rows"))
    parts: tuple[tuple[str, list[Block]], ...] = (
        ("Recorded data", [*channel_figures(log)]),
        ("What this log can identify", [Table(*ability_rows(found))]),
        ("Channels", [Table(*channel_rows(found), "Step: the quantization.")]),
        ("Warnings", [Bullets(found.warnings)] if found.warnings else []),
        ("Remarks", [Bullets(found.remarks)] if found.remarks else []),
    )
    return render(
        Page(
            title=f"Inspection of {found.name}",
            lead=inspect_verdict(found),
            subtitle=f"{duration(found.timing.duration_s)}, {found.rows:,} rows, {rate}"
            f" ({regular}).",
            tiles=tiles,
            sections=[Section(title, blocks) for title, blocks in parts if blocks],
            inputs=[InputFile.of_path("log", found.name, found.source)],
            banners=reconstruction_banners(found.name, found.source, *found.remarks),
        )
    )


def channel_figures(log: Log) -> list[Figure]:
    """Return current, voltage, temperature and, where known, SoC over time."""
    time = TimeFigures([log])
    channels = [
        ("Current", "A", log.current_a, BLUE, "Positive current discharges."),
        ("Voltage", "V", log.voltage_v, ORANGE, "At the terminals."),
        ("Temperature", "°C", log.temperature_c, PURPLE, f"Measured on: {log.temperature_source}."),
    ]
    if log.first_soc() is not None and log.soc_pct is not None:
        channels.append(("State of charge", "%", log.soc_pct, GREEN, "The log's own."))
    figures = []
    for name, unit, values, color, caption in channels:
        plot = time.plot(name.lower(), unit, height=235)
        time.line(plot, name.lower(), [(log.time_s, values)], Pen(color, 1.0, in_legend=False))
        figures.append(Figure(name, plot, caption))
    return figures


def inspect_verdict(found: LogInspection) -> str:
    """Return what the log can identify and what it cannot, with the first reason."""
    names: dict[str, list[str]] = {"yes": [], "partly": [], "no": []}
    for ability in found.abilities:
        names[ability.verdict].append(ability.topic)
    parts = [
        words + ", ".join(names[verdict])
        for verdict, words in (("yes", ""), ("partly", "in part "), ("no", "not "))
        if names[verdict]
    ]
    text = "This log can identify " + "; ".join(parts)
    if names["no"] and not names["yes"] and not names["partly"]:
        text = f"This log cannot identify {', '.join(names['no'])}"
    lacking = next((ability for ability in found.abilities if ability.verdict == "no"), None)
    if lacking is None:
        return f"{text}."
    return f"{text}. {lacking.topic.capitalize()}: {lacking.text.rstrip('.')}."
