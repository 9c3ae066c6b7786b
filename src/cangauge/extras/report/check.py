"""The pages of `cangauge gap-check`: on drawn cases, and on one's own logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from bokeh.models import ColumnDataSource, FactorRange, LinearColorMapper, Range1d, Whisker

from cangauge._formatting import number
from cangauge.extras.report.charts import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    Pen,
    Plot,
    add_line,
    bars,
    new_figure,
)
from cangauge.extras.report.page import (
    Block,
    Bullets,
    Figure,
    Page,
    Paragraph,
    Section,
    Table,
    Tile,
    joined,
    render,
)
from cangauge.extras.validation.own_logs import summary, table
from cangauge.extras.validation.plan import EFFECTS
from cangauge.extras.validation.score import CRASHED, LEAST_GAP, NONE, UNKNOWN
from cangauge.extras.validation.tables import (
    entries_of,
    limits,
    measured,
    percent,
    posterior_entries,
)

_SHADES: Final = ("#ffffff", "#deebf7", "#c6dbef", "#9ecae1", "#6baed6", "#4292c6", "#2171b5")
_ROW_PX: Final = 22

Result = Mapping[str, Any]


def check_report(result: Result) -> str:
    """Return the result of a check as one self-contained HTML page.

    Parameters
    ----------
    result : mapping
        As `cangauge gap-check --json` prints it.
    """
    return render(check_page(result))


def check_page(result: Result) -> Page:
    """Return the report's content (see `check_report`); `figures` holds the bokeh figures."""
    seeds = "a release's final seeds" if result["final"] else f"development seed {result['seed']}"
    sections = [Section("Targets", [_targets(result["targets"])])]
    sections += [
        Section(name, _protocol(items)) for name, items in sorted(result["protocols"].items())
    ]
    if result["later"]:
        sections.append(Section("Extended models on further logs", _held_out(result["later"])))
    sections.append(Section("Reliability of the probabilities", _reliability(result)))
    sections.append(Section("Method", _method(result)))
    targets = result["targets"]
    return Page(
        title="Withheld check of the diagnosis",
        lead=f"{sum(row['met'] for row in targets)} of {len(targets)} targets met."
        if targets
        else "",
        subtitle=f"Causes drawn from {seeds}, sealed, diagnosed from the logs alone, then scored."
        " Shares with 95 % intervals.",
        tiles=_tiles(result),
        sections=sections,
    )


def own_logs_report(result: Result) -> str:
    """Return the result of `validation.own_logs.summarize` as one self-contained page."""
    head, rows = table(result)
    head[0] = head[0].removeprefix("<")
    largest = [(item["effect"], item["sizes"][-1]) for item in result["effects"]]
    shares = [
        (name, 100.0 * of["probability"], BLUE if 2 * of["named"] > of["of"] else GREY)
        for name, of in largest
    ]
    healthy = [
        [item["log"], item["verdict"], number(item["probability_none"], 2),
         number(item["floor_v"], 2)]
        for item in result["healthy"]
    ]  # fmt: skip
    names = [item["log"] for item in result["healthy"]]
    return render(
        Page(
            title="What this diagnosis would find on this pack",
            lead=summary(result),
            subtitle=f"Every effect injected into {joined(names)}, each diagnosed with the other"
            " logs as references.",
            tiles=[],
            sections=[
                Section(
                    "Effects",
                    [
                        Table(
                            head,
                            rows,
                            note="Size, mean probability of the true effect, and the logs on which"
                            " it is named. Its limit: physically no larger one is possible.",
                        ),
                        Figure(
                            "Probability of the true effect at the largest size",
                            bars("probability", "%", shares, decimals=0),
                            "Blue: named on more than half of the logs.",
                        ),
                    ],
                ),
                Section(
                    "Logs as recorded",
                    [Table(["log", "verdict", "P(none)", "floor [V]"], healthy)],
                ),
            ],
        )
    )


def _tiles(result: Result) -> list[Tile]:
    targets = result["targets"]
    brier = result["reliability"]["brier"]
    seconds = result["cost"]["seconds"]
    tiles = [
        Tile("Diagnoses", str(len(result["cases"])), f"{len(result['crashed'])} crashed"),
        Tile("Targets met", f"{sum(row['met'] for row in targets)} of {len(targets)}"),
        Tile("Brier score", number(brier["value"], 3), "0 is perfect, 0.25 is chance"),
    ]
    if seconds is not None:
        tiles.append(
            Tile(
                "A diagnosis", number(seconds["median"], 1, "s"), f"at most {seconds['max']:.1f} s"
            )
        )
    return tiles


def _targets(rows: Sequence[Result]) -> Block:
    if not rows:
        return Paragraph("This run covers no target.")
    return Table(
        ["figure", "measured (95 %)", "target", "met"],
        [[row["name"], measured(row), limits(row), "yes" if row["met"] else "NO"] for row in rows],
    )


def _protocol(items: Result) -> list[Block]:
    rows = [[label, percent(item), str(item["of"])] for label, item in entries_of(items)]
    rows += [[label, text, str(cases)] for label, text, cases in posterior_entries(items)]
    blocks: list[Block] = [Table(["", "value (95 %)", "cases"], rows)]
    if items.get("below_range"):
        blocks.append(
            Paragraph(
                f"{items['below_range']} of {items['cases']} cases have a gap below {LEAST_GAP}"
                " floors, the largest that is physical on their days. The shares by effect exclude"
                " them."
            )
        )
    if items["confusion"]:
        blocks.append(_confusion_figure(items["confusion"]))
    if "by_gap" in items:
        blocks.append(_gap_size_figure(items["by_gap"]))
    if items.get("coverage", {}).get("by_parameter"):
        blocks.append(
            Table(
                ["parameter", "interval covers the truth", "cases"],
                [
                    [name, percent(item), str(item["of"])]
                    for name, item in items["coverage"]["by_parameter"].items()
                ],
            )
        )
    return blocks


def _held_out(groups: Result) -> list[Block]:
    blocks: list[Block] = []
    for group, items in groups.items():
        rows = [
            [
                row["log"],
                *(
                    number(row[model][key], 2)
                    for key in ("rmse_v", "soc_mae_pct")
                    for model in ("plain", "extended")
                ),
            ]
            for row in [*items["logs"], {"log": "all", **items}]
        ]
        blocks.append(
            Table(
                [
                    f"{group.replace('_', ' ')} trip",
                    "RMSE, plain [V]", "RMSE, extended [V]",
                    "EKF SoC MAE, plain [%]", "EKF SoC MAE, extended [%]",
                ],
                rows,
                note="Voltage at the counted SoC; EKF after 5 minutes, initial SoC withheld.",
            )
        )  # fmt: skip
    return blocks


def _reliability(result: Result) -> list[Block]:
    bins = [entry for entry in result["reliability"]["bins"] if entry["right"]["of"]]
    return [_reliability_figure(bins) if bins else Paragraph("No case gave a verdict.")]


def _method(result: Result) -> list[Block]:
    cost = result["cost"]
    lines = [
        f"SHA-256 of the sealed causes, published before the diagnosis: {result['labels_sha256']}.",
        f"{result['jobs']} diagnosing processes, whose only inputs are logs, model and request.",
        "A floor, the unit of a gap, is the error of a model of training and reference logs on"
        " unseen days without a fault.",
        "Intervals: Wilson's for shares, bootstrap for medians and the Brier score.",
        "A case that crashes counts as wrong.",
    ]
    if cost["peak_mib"] is not None:
        lines.append(
            f"Peak memory of a diagnosis: median {cost['peak_mib']['median']:.0f} MiB,"
            f" at most {cost['peak_mib']['max']:.0f} MiB."
        )
    lines += [f"Crashed: {item['case']}: {item['error']}" for item in result["crashed"]]
    return [Bullets(lines)]


def _confusion_figure(confusion: Mapping[str, Mapping[str, int]]) -> Figure:
    """Draw a row for each truth and a column for each verdict, from their counts."""
    order = {name: at for at, name in enumerate([*EFFECTS, NONE, UNKNOWN, CRASHED])}
    given = {verdict for row in confusion.values() for verdict in row}
    truths = sorted(confusion, key=lambda name: (order.get(name, len(order)), name))
    verdicts = [name for name in order if name in given or name in confusion]
    cells = [
        (truth, verdict, count, count / sum(row.values()))
        for truth, row in confusion.items()
        for verdict, count in row.items()
    ]
    plot = new_figure(
        ("verdict", "truth"),
        "@truth: @verdict, @count of @of",
        units=("", ""),
        height=170 + _ROW_PX * len(truths),
        x_range=FactorRange(factors=verdicts),
        y_categories=truths[::-1],
    )
    source = ColumnDataSource(
        {
            "truth": [cell[0] for cell in cells],
            "verdict": [cell[1] for cell in cells],
            "count": [cell[2] for cell in cells],
            "of": [sum(confusion[cell[0]].values()) for cell in cells],
            "share": [cell[3] for cell in cells],
            "ink": ["#ffffff" if cell[3] > 0.6 else "#1c2430" for cell in cells],
            "edge": [GREEN if cell[0] == cell[1] else GREY for cell in cells],
        }
    )
    shades = LinearColorMapper(palette=list(_SHADES), low=0.0, high=1.0)
    plot.rect(
        x="verdict", y="truth", width=0.94, height=0.9, source=source, line_color="edge",
        fill_color={"field": "share", "transform": shades},
    )  # fmt: skip
    plot.text(
        x="verdict", y="truth", text="count", source=source, text_align="center",
        text_baseline="middle", text_font_size="11px", text_color="ink",
    )  # fmt: skip
    plot.xaxis.major_label_orientation = 0.9
    plot.xgrid.grid_line_color = plot.ygrid.grid_line_color = None
    return Figure(
        "Verdict against truth",
        plot,
        "Numbers of cases, shaded by their share of the row. Correct verdicts have a green edge.",
    )


def _reliability_figure(bins: Sequence[Result]) -> Figure:
    """Draw the share of correct verdicts against the stated probability, over bins with cases."""
    plot = new_figure(
        ("stated probability", "share that is correct"),
        "stated @x{0.00}: correct @y{0.00} of @of",
        units=("", ""),
        height=340,
        x_range=Range1d(0.0, 1.0),
    )
    add_line(plot, "perfect", np.array([0.0, 1.0]), np.array([0.0, 1.0]), Pen(GREY, dash="dashed"))
    _points(
        plot,
        "verdicts",
        [entry["stated"] for entry in bins],
        [entry["right"] for entry in bins],
        BLUE,
    )
    plot.y_range = Range1d(-0.03, 1.03)
    return Figure(
        "Reliability",
        plot,
        "Above the dashed line verdicts are correct more often than stated, below it less often."
        " Bars are 95 % intervals.",
    )


def _gap_size_figure(by_gap: Sequence[Result]) -> Figure:
    """Draw how often a gap is detected and its cause named, over ranges of its size."""
    by_gap = [entry for entry in by_gap if entry["top1"]["of"]]
    plot = new_figure(
        ("gap in floors (middle of its range)", "share of cases"),
        "$name: @y{0.00} of @of",
        units=("", ""),
    )
    for shift, key, name, color in (
        (0.98, "detected", "gap detected", GREY),
        (1.0, "top1_pair", "cause named, pairs count", BLUE),
        (1.02, "top1", "cause named, alone", ORANGE),
    ):
        middle = [shift * 0.5 * sum(entry["gap_in_floors"]) for entry in by_gap]
        _points(plot, name, middle, [entry[key] for entry in by_gap], color)
    plot.y_range = Range1d(-0.03, 1.03)
    return Figure("Detection by size of the gap", plot, "Bars are 95 % intervals.")


def _points(
    plot: Plot, name: str, x: Sequence[float], shares: Sequence[Mapping[str, Any]], color: str
) -> None:
    """Draw shares with their 95 % intervals."""
    y = [item["value"] for item in shares]
    add_line(plot, name, np.array(x), np.array(y), Pen(color))
    source = ColumnDataSource(
        {
            "x": list(x),
            "y": y,
            "low": [item["ci"][0] for item in shares],
            "high": [item["ci"][1] for item in shares],
            "of": [item["of"] for item in shares],
        }
    )
    plot.scatter(x="x", y="y", source=source, size=7, color=color, name=name)
    whisker = Whisker(base="x", upper="high", lower="low", source=source, line_color=color)
    whisker.upper_head.line_color = whisker.lower_head.line_color = color
    plot.add_layout(whisker)
