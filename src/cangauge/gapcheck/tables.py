"""The figures of the check for people, on the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table


def percent(item: Mapping[str, Any] | None, *, digits: int = 0) -> str:
    """Return a share with its interval, such as "87 % (83–90)"."""
    if item is None or item["value"] is None:
        return "–"
    low, high = item["ci"]
    text = f"{100.0 * item['value']:.{digits}f} %"
    return f"{text} ({100.0 * low:.{digits}f}–{100.0 * high:.{digits}f})"


def print_figures(figures: Mapping[str, Any], console: Console) -> None:
    """Print every table.

    Parameters
    ----------
    figures : mapping
        From `score.score`.
    console : Console
    """
    for name, items in figures["protocols"].items():
        _print_protocol(name, items, console)
    brier = figures["reliability"]["brier"]
    if brier["value"] is not None:
        low, high = brier["ci"]
        console.print(
            f"Brier score of the probabilities: {brier['value']:.3f} ({low:.3f}–{high:.3f})"
        )
    cost = figures["cost"]
    for key, unit in (("seconds", "s"), ("peak_mib", "MiB")):
        if cost[key] is not None:
            console.print(
                f"{key} a case: median {cost[key]['median']:.1f} {unit},"
                f" most {cost[key]['max']:.1f} {unit}"
            )
    for item in figures["crashed"]:
        console.print(f"crashed: {item['case']} {item['truth']}: {item['error']}", markup=False)


def _print_protocol(name: str, items: Mapping[str, Any], console: Console) -> None:
    table = Table(title=name, title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("figure")
    table.add_column("value (95 % interval)", justify="right")
    table.add_column("cases", justify="right")

    def row(label: str, item: Mapping[str, Any]) -> None:
        table.add_row(label, percent(item), str(item["of"]))

    if "effects" in items:
        effects = items["effects"]
        for key, label in (
            ("detected", "a gap is found"),
            ("top1", "first, strictly"),
            ("top1_pair", "first, pairs not told apart counted"),
            ("top2", "among the first two"),
            ("family", "family"),
            ("unknown", "called unknown"),
            ("ranked_first", "ranked first, whatever the verdict"),
            ("correct_and_confident", "of the right ones: probability ≥ 0.5"),
        ):
            row(label, effects[key])
        for floor in ("clean", "sensor", "reported"):
            row(f"closed, median, found ({floor} floor)", effects["closed"][floor]["detected"])
        row("intervals that hold the true parameter", items["coverage"]["all"])
    if "healthy" in items:
        row("false alarms on healthy packs", items["healthy"]["false_alarms"])
    if "open_set" in items:
        row("cause out of the library: unknown", items["open_set"]["unknown"])
        row("… none", items["open_set"]["none"])
        row("… confidently wrong", items["open_set"]["confidently_wrong"])
    if "pairs" in items:
        row("two causes: first is one of them", items["pairs"]["first_is_one_of_both"])
        row("… both", items["pairs"]["both"])
    console.print(table)
    if "by_gap" in items:
        _print_by_gap(items, console)
    table = Table(title=f"{name}: verdicts", title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("truth")
    table.add_column("cases", justify="right")
    table.add_column("verdicts")
    for truth, said in items["confusion"].items():
        table.add_row(
            truth, str(sum(said.values())), ", ".join(f"{k} {v}" for k, v in said.items())
        )
    console.print(table)


def _print_by_gap(items: Mapping[str, Any], console: Console) -> None:
    table = Table(title="by size of the gap", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("gap [floors]", "cases", "found", "first, strictly", "with pairs"):
        table.add_column(heading, justify="right")
    for entry in items["by_gap"]:
        low, high = entry["gap_in_floors"]
        table.add_row(
            f"{low:g} … {high:g}",
            str(entry["top1"]["of"]),
            *(percent(entry[key]) for key in ("detected", "top1", "top1_pair")),
        )
    console.print(table)
