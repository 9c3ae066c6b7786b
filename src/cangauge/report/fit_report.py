"""The report of an identification: the published figures, for one log or several in turn."""

from __future__ import annotations

from cangauge.identify.fit import Identification
from cangauge.report.fit_figures import (
    energy_figures,
    fit_figures,
    inverse_figures,
    recorded_figures,
    resistance_figure,
    voltage_error_figures,
)
from cangauge.report.fit_tables import (
    coefficient_table,
    effect_tables,
    log_table,
    removed_table,
    settings_table,
)
from cangauge.report.page import (
    Block,
    Bullets,
    Page,
    Paragraph,
    Section,
    Tile,
    reconstruction_banners,
    render,
)
from cangauge.report.time_figures import TimeFigures
from cangauge.report.timeline import Timeline
from cangauge.report.words import duration, number, significant


def fit_report(result: Identification) -> str:
    """Return the report of an identification as one self-contained HTML page."""
    return render(fit_page(result))


def fit_page(result: Identification) -> Page:
    """Return the report's content, for those who want to add to it."""
    time = TimeFigures(Timeline.of(result.logs))
    several = len(result.logs) > 1
    seconds = sum(log.duration_s for log in result.logs)
    made_of = f"{len(result.logs)} logs" if several else f"the log {result.logs[0].name}"
    sections = [
        Section("What was recorded", recorded_figures(result, time)),
        Section("Fit and pseudo-OCV", fit_figures(result, time)),
        Section("Voltage error", voltage_error_figures(result, time)),
        Section("State of charge by inverse", inverse_figures(result, time)),
        Section("Resistance", [resistance_figure(result)]),
        Section("Energy", energy_figures(result)),
        Section("Coefficients", [coefficient_table(result)]),
        *([Section("Effects", effect_tables(result))] if result.found is not None else []),
        Section("How it was made", _made(result)),
    ]
    return Page(
        title=f"Voltage model {result.model.name}",
        subtitle=f"Identified from {made_of}, {duration(seconds)} in all,"
        f" {sum(len(item.rows) for item in result.fits):,} rows used."
        " Positive current discharges.",
        tiles=_tiles(result),
        sections=sections,
        banners=reconstruction_banners(
            *(text for log in result.logs for text in (log.name, log.source, *log.remarks))
        ),
    )


def _tiles(result: Identification) -> list[Tile]:
    noise = result.model.noise
    return [
        Tile("Voltage error (MAE)", number(result.voltage_mae_pct, 3, "%"),
             f"RMSE {significant(result.voltage_rmse_v, 3, 'V')}"),
        Tile("Held out (MAE)", number(noise.voltage_mae_pct, 3, "%"),
             f"RMSE {significant(noise.voltage_rmse_v, 3, 'V')}"),
        Tile("SoC by inverse (MAE)", number(result.soc_newton_mae_pct, 2, "%"),
             "against counting"),
        Tile("Slope resistance", significant(result.slope_ohm, 4, "Ω"),
             f"expected {significant(result.slope_expected_ohm, 4, 'Ω')}"),
        Tile("Capacity", number(result.model.capacity_ah, 2, "Ah"), "100 → 0 %"),
        Tile("Efficiency", number(result.energy.efficiency_pct, 1, "%"),
             f"net {significant(result.energy.net_kwh, 3, 'kWh')},"
             f" heat {significant(result.energy.heat_kwh, 3, 'kWh')}"),
        Tile("Condition number", significant(result.solution.condition_number, 2),
             "of the scaled columns"),
    ]  # fmt: skip


def _made(result: Identification) -> list[Block]:
    blocks: list[Block] = [settings_table(result), log_table(result), removed_table(result)]
    said: dict[str, list[str]] = {}
    for log in result.logs:
        for remark in log.remarks:
            said.setdefault(remark, []).append(log.name)
    remarks = [*result.remarks, *(f"{', '.join(names)}: {text}" for text, names in said.items())]
    if remarks:
        blocks += [Paragraph("Remarks:"), Bullets(remarks)]
    return blocks
