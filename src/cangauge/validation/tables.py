"""What the check must show, beside what it shows.

The figures of the check for people, on the terminal.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cangauge._formatting import NONE_KNOWN, number
from cangauge.validation.score import LEAST_GAP

# --- What the check must show, beside what it shows


@dataclass(frozen=True)
class Target:
    """A figure with the limits that it must keep.

    Parameters
    ----------
    name, unit : str
    path : tuple of str
        Where the figure stands in the result.
    low, high : float, optional
        In the unit of the figure as it stands there; shares from 0 to 1.
    """

    name: str
    path: tuple[str, ...]
    low: float | None = None
    high: float | None = None
    unit: str = ""

    def judge(self, result: Mapping[str, Any]) -> dict[str, Any] | None:
        """Return value, interval, limits and whether they are kept; None if it was not run."""
        found: Any = result
        for key in self.path:
            if not isinstance(found, Mapping) or key not in found:
                return None
            found = found[key]
        value, interval = (
            (found["value"], found["ci"]) if isinstance(found, Mapping) else (found, None)
        )
        if value is None:
            return None
        met = (self.low is None or value >= self.low) and (self.high is None or value <= self.high)
        return {
            "name": self.name,
            "unit": self.unit,
            "value": value,
            "ci": interval,
            "low": self.low,
            "high": self.high,
            "met": met,
        }


def _of(protocol: str, *path: str) -> tuple[str, ...]:
    return ("protocols", protocol, *path)


TARGETS: Final = (
    Target("simulated: first, pairs counted", _of("simulated", "effects", "top1_pair"), low=0.95),
    Target("simulated: first, strictly", _of("simulated", "effects", "top1"), low=0.85),
    Target(
        "simulated: closed, median of found (truth's floor)",
        _of("simulated", "effects", "closed", "sensor", "detected"),
        low=0.90,
    ),
    Target("simulated: false alarms", _of("simulated", "healthy", "false_alarms"), high=0.02),
    Target(
        "simulated: right ones with probability ≥ 0.5",
        _of("simulated", "effects", "correct_and_confident"),
        low=0.70,
    ),
    Target(
        "simulated: intervals hold the parameter",
        _of("simulated", "coverage", "all"),
        low=0.85,
        high=0.98,
    ),
    # The easier plant: healthy it obeys the published equation, so only the cause is asked for.
    Target("equation: first, pairs counted", _of("equation", "effects", "top1_pair"), low=0.95),
    Target("equation: first, strictly", _of("equation", "effects", "top1"), low=0.85),
    Target("equation: false alarms", _of("equation", "healthy", "false_alarms"), high=0.02),
    # The easiest: little but noise beside the cause.
    Target("published: first, pairs counted", _of("published", "effects", "top1_pair"), low=0.95),
    Target("published: first, strictly", _of("published", "effects", "top1"), low=0.85),
    Target("published: false alarms", _of("published", "healthy", "false_alarms"), high=0.02),
    Target("PyBaMM: first, strictly", _of("pybamm", "effects", "top1"), low=0.70),
    Target("PyBaMM: family", _of("pybamm", "effects", "family"), low=0.90),
    Target("real logs: first, strictly", _of("real", "effects", "top1"), low=0.70),
    Target("real logs: among the first two", _of("real", "effects", "top2"), low=0.90),
    Target("real logs: family", _of("real", "effects", "family"), low=0.90),
    Target("real logs: false alarms", _of("real", "healthy", "false_alarms"), high=0.05),
    Target(
        "open set: confidently wrong", _of("open-set", "open_set", "confidently_wrong"), high=0.10
    ),
    Target(
        "effects outside the library: confidently wrong",
        _of("outside", "open_set", "confidently_wrong"),
        high=0.10,
    ),
    Target("cold car: resistance_temperature", _of("cold-bmw_i3", "effects", "top1"), low=1.0),
    Target(
        "cold car, trip left out: RMSE",
        ("later", "left_out", "extended", "rmse_v"),
        high=1.4,
        unit="V",
    ),
    Target(
        "cold car, trip left out: EKF SoC MAE",
        ("later", "left_out", "extended", "soc_mae_pct"),
        high=2.0,
        unit="%",
    ),
    Target(
        "held-out summer trips, that model: EKF SoC MAE",
        ("later", "clean", "extended", "soc_mae_pct"),
        high=1.2,
        unit="%",
    ),
    Target("cold cell: resistance_temperature", _of("cold-lg_hg2", "effects", "top1"), low=1.0),
    Target(
        "cold cell: closed",
        _of("cold-lg_hg2", "effects", "closed", "reported", "all"),
        low=0.70,
    ),
    Target("one log: longest", _of("simulated", "cost", "seconds", "max"), high=15.0, unit="s"),
    Target("four logs: longest", _of("real", "cost", "seconds", "max"), high=40.0, unit="s"),
    Target("memory: most", ("cost", "peak_mib", "max"), high=1024.0, unit="MiB"),
)


def judge_targets(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return every target that this run says something of, with its value."""
    return [found for target in TARGETS if (found := target.judge(result)) is not None]


# --- The figures of the check for people, on the terminal

Entry = tuple[str, Mapping[str, Any]]

ACCURACY: Final = (
    ("detected", "a gap is found"),
    ("top1", "first, strictly"),
    ("top1_pair", "first, pairs not told apart counted"),
    ("top2", "among the first two"),
    ("family", "family"),
    ("unknown", "called unknown"),
    ("ranked_first", "ranked first, whatever the verdict"),
    ("ranked_in_two", "ranked in two, whatever the verdict"),
    ("correct_and_confident", "of the right ones: probability ≥ 0.5"),
)
FLOORS: Final = (
    ("clean", "floor: model on the same days without the fault"),
    ("sensor", "floor: the truth's, a perfect model"),
    ("reported", "as reported"),
)


def percent(item: Mapping[str, Any] | None) -> str:
    """Return a share with its interval, such as "87 % (83–90)"."""
    if item is None or item["value"] is None:
        return NONE_KNOWN
    low, high = item["ci"]
    return f"{100.0 * item['value']:.0f} % ({100.0 * low:.0f}–{100.0 * high:.0f})"


def entries_of(items: Mapping[str, Any]) -> Iterator[Entry]:
    """Yield the lines of a protocol's table: name and share.

    Parameters
    ----------
    items : mapping
        The figures of one protocol.
    """
    if "effects" in items:
        effects = items["effects"]
        for key, label in ACCURACY:
            yield label, effects[key]
        for key, label in FLOORS:
            if effects["closed"][key]["detected"]["of"]:
                yield f"closed where found, median ({label})", effects["closed"][key]["detected"]
        if items["coverage"]["all"]["of"]:
            yield "intervals that hold the true parameter", items["coverage"]["all"]
    if "healthy" in items:
        yield "healthy: false alarms", items["healthy"]["false_alarms"]
        yield "healthy: an effect named", items["healthy"]["named_an_effect"]
    if "open_set" in items:
        yield "cause not in the library: unknown", items["open_set"]["unknown"]
        yield "cause not in the library: none", items["open_set"]["none"]
        yield "cause not in the library: an effect named", items["open_set"]["named_an_effect"]
        yield "… with probability ≥ 0.5", items["open_set"]["confidently_wrong"]
    if "decoys" in items:
        yield "another effect left out: still right", items["decoys"]
    if "pairs" in items:
        yield "two causes: first is one of them", items["pairs"]["first_is_one_of_both"]
        yield "two causes: both accepted", items["pairs"]["both"]
        yield "two causes: both among the first three", items["pairs"]["both_among_three"]


def limits(row: Mapping[str, Any]) -> str:
    """Return the limits of a target in words."""
    parts = [
        f"{sign} {amount(row[key], row['unit'])}"
        for key, sign in (("low", "≥"), ("high", "≤"))
        if row[key] is not None
    ]
    return " and ".join(parts)


def amount(value: float, unit: str) -> str:
    """Return a figure of a target: a share in %, or a quantity in its unit."""
    return f"{100.0 * value:.0f} %" if not unit else number(value, 1 if value > 10 else 2, unit)


def measured(row: Mapping[str, Any]) -> str:
    """Return the value of a target with its interval."""
    text = amount(row["value"], row["unit"])
    if row["ci"] is None:
        return text
    low, high = row["ci"]
    return f"{text} ({100.0 * low:.0f}–{100.0 * high:.0f})"


def print_result(result: Mapping[str, Any], console: Console) -> None:
    """Print every table.

    Parameters
    ----------
    result : mapping
        What `--json` prints.
    console : Console
    """
    for name, items in result["protocols"].items():
        _print_protocol(name, items, console)
    for group, items in result["later"].items():
        _print_later(group, items, console)
    _print_reliability(result["reliability"], console)
    _print_targets(result["targets"], console)
    cost = result["cost"]
    for key, unit in (("seconds", "s"), ("peak_mib", "MiB")):
        if cost[key] is not None:
            console.print(
                f"{unit} a diagnosis: median {cost[key]['median']:.1f}, most {cost[key]['max']:.1f}"
            )
    for item in result["crashed"]:
        causes = ", ".join(item["truth"]) or "none"
        console.print(
            Text(f"crashed, counted as wrong: {item['case']} ({causes}): {item['error']}")
        )


def _table(title: str, *headings: str) -> Table:
    table = Table(title=Text(title), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    for place, heading in enumerate(headings):
        table.add_column(Text(heading), justify="left" if place == 0 else "right")
    return table


def _print_protocol(name: str, items: Mapping[str, Any], console: Console) -> None:
    table = _table(f"{name}: {items['cases']} diagnoses", "", "share (95 %)", "cases")
    for label, item in entries_of(items):
        table.add_row(label, percent(item), str(item["of"]))
    console.print(table)
    if items.get("below_range"):
        console.print(
            f"{items['below_range']} of them have a gap below {LEAST_GAP} floors, since physics"
            " allows no larger one on their days; they are in no share of effects."
        )
    if "by_gap" in items:
        table = _table("by size of the gap", "floors", "cases", "found", "strictly", "with pairs")
        for entry in items["by_gap"]:
            low, high = entry["gap_in_floors"]
            shares = (percent(entry[key]) for key in ("detected", "top1", "top1_pair"))
            table.add_row(f"{low:g} … {high:g}", str(entry["top1"]["of"]), *shares)
        console.print(table)
    table = _table("what was said", "truth", "cases", "verdicts")
    for truth, said in items["confusion"].items():
        verdicts = ", ".join(f"{verdict} {count}" for verdict, count in said.items())
        table.add_row(truth, str(sum(said.values())), verdicts)
    if items["confusion"]:
        console.print(table)


def _print_later(group: str, items: Mapping[str, Any], console: Console) -> None:
    table = _table(
        f"extended models on {group.replace('_', ' ')} trips",
        "trip",
        "RMSE [V], plain → extended",
        "EKF SoC MAE [%], plain → extended",
    )
    for row in [*items["logs"], {"log": "all", **items}]:
        table.add_row(
            row["log"],
            *(
                f"{number(row['plain'][key], 2)} → {number(row['extended'][key], 2)}"
                for key in ("rmse_v", "soc_mae_pct")
            ),
        )
    console.print(table)


def _print_reliability(items: Mapping[str, Any], console: Console) -> None:
    table = _table("how often verdicts are right", "stated probability", "cases", "right")
    for entry in items["bins"]:
        if entry["right"]["of"]:
            low, high = entry["probability"]
            table.add_row(
                f"{low:.1f} … {high:.1f}", str(entry["right"]["of"]), percent(entry["right"])
            )
    console.print(table)
    brier = items["brier"]
    if brier["value"] is not None:
        low, high = brier["ci"]
        console.print(f"Brier score {brier['value']:.3f} ({low:.3f}–{high:.3f})")


def _print_targets(rows: list[Mapping[str, Any]], console: Console) -> None:
    table = _table("what it must show", "", "measured (95 %)", "wanted", "met")
    for row in rows:
        table.add_row(row["name"], measured(row), limits(row), "yes" if row["met"] else "NO")
    if rows:
        console.print(table)
