"""The page of `cangauge gap-check`: what it must show, confusion, reliability, detection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from cangauge.gapcheck.outcome import LEAST_GAP
from cangauge.gapcheck.tables import entries_of, limits, measured, percent
from cangauge.report.check_figures import confusion_figure, gap_figure, reliability_figure
from cangauge.report.page import (
    Block,
    Bullets,
    Page,
    Paragraph,
    Section,
    Table,
    Tile,
    render,
)
from cangauge.report.words import number

Result = Mapping[str, Any]


def check_report(result: Result) -> str:
    """Return the result of a check as one self-contained HTML page.

    Parameters
    ----------
    result : mapping
        What `cangauge gap-check --json` prints.
    """
    return render(check_page(result))


def check_page(result: Result) -> Page:
    """Return the page of a check."""
    seeds = "a release's final seeds" if result["final"] else f"development seed {result['seed']}"
    sections = [Section("What it must show", [_targets(result["targets"])])]
    sections += [
        Section(name, _protocol(items)) for name, items in sorted(result["protocols"].items())
    ]
    if result["later"]:
        sections.append(Section("Extended models on further logs", _later(result["later"])))
    sections.append(Section("How far probabilities can be trusted", _reliability(result)))
    sections.append(Section("How it was done", _done(result)))
    return Page(
        title="Withheld check of the diagnosis",
        subtitle=f"Causes drawn from {seeds}, sealed, diagnosed from the logs alone, then scored."
        " Shares with 95 % intervals.",
        tiles=_tiles(result),
        sections=sections,
    )


def _tiles(result: Result) -> list[Tile]:
    targets = result["targets"]
    brier = result["reliability"]["brier"]
    seconds = result["cost"]["seconds"]
    tiles = [
        Tile("Diagnoses", str(len(result["cases"])), f"{len(result['crashed'])} crashed"),
        Tile("Targets met", f"{sum(row['met'] for row in targets)} of {len(targets)}"),
        Tile("Brier score", number(brier["value"], 3), "0 is perfect, 0.25 a coin"),
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
        return Paragraph("This run was of none of what has a target.")
    return Table(
        ["figure", "measured (95 %)", "wanted", "met"],
        [[row["name"], measured(row), limits(row), "yes" if row["met"] else "NO"] for row in rows],
    )


def _protocol(items: Result) -> list[Block]:
    rows = [[label, percent(item), str(item["of"])] for label, item in entries_of(items)]
    blocks: list[Block] = [Table(["", "share (95 %)", "cases"], rows)]
    if items.get("below_range"):
        blocks.append(
            Paragraph(
                f"{items['below_range']} of {items['cases']} cases have a gap below {LEAST_GAP}"
                " floors, since physics allows no larger one on their days. They are in no share of"
                " effects."
            )
        )
    if items["confusion"]:
        blocks.append(confusion_figure(items["confusion"]))
    if "by_gap" in items:
        blocks.append(gap_figure(items["by_gap"]))
    if items.get("coverage", {}).get("by_parameter"):
        blocks.append(
            Table(
                ["parameter", "interval holds the truth", "cases"],
                [
                    [name, percent(item), str(item["of"])]
                    for name, item in items["coverage"]["by_parameter"].items()
                ],
            )
        )
    return blocks


def _later(later: Result) -> list[Block]:
    blocks: list[Block] = []
    for group, items in later.items():
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
                note="Voltage at the counted SoC; the EKF's initial SoC is withheld, and it is"
                " judged after 5 minutes.",
            )
        )  # fmt: skip
    return blocks


def _reliability(result: Result) -> list[Block]:
    said = [entry for entry in result["reliability"]["bins"] if entry["right"]["of"]]
    if not said:
        return [Paragraph("No verdict was given.")]
    return [reliability_figure(said)]


def _done(result: Result) -> list[Block]:
    cost = result["cost"]
    lines = [
        f"SHA-256 of the sealed causes, shown before the diagnosis: {result['labels_sha256']}.",
        f"{result['jobs']} diagnosing processes, each with the logs, the model and a request.",
        "A gap is counted in what a model of training and references misses on clean days that"
        " it has not seen.",
        "Shares have Wilson's intervals, medians and the Brier score bootstrap ones.",
        "A case that crashes counts as wrong.",
    ]
    if cost["peak_mib"] is not None:
        lines.append(
            f"Memory of a diagnosis: median {cost['peak_mib']['median']:.0f} MiB,"
            f" at most {cost['peak_mib']['max']:.0f} MiB."
        )
    lines += [f"Crashed: {item['case']}: {item['error']}" for item in result["crashed"]]
    return [Bullets(lines)]
