"""Targets of the withheld check, and its figures as tables on the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cangauge._formatting import NONE_KNOWN, number, span
from cangauge.extras.validation.score import LEAST_GAP


@dataclass(frozen=True)
class Target:
    """A figure with its limits.

    Parameters
    ----------
    name : str
    path : tuple of str
        Keys of the figure in the result.
    low, high : float, optional
        Limits in the unit of the figure; shares from 0 to 1.
    unit : str
        Empty for shares.
    """

    name: str
    path: tuple[str, ...]
    low: float | None = None
    high: float | None = None
    unit: str = ""

    def judge(self, result: Mapping[str, Any]) -> dict[str, Any] | None:
        """Return value, interval, limits and whether they are met; None if it is missing."""
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
    Target("simulated: top 1, pairs counted", _of("simulated", "effects", "top1_pair"), low=0.95),
    Target("simulated: top 1", _of("simulated", "effects", "top1"), low=0.85),
    Target(
        "simulated: closed fraction, median of detected (true floor)",
        _of("simulated", "effects", "closed", "sensor", "detected"),
        low=0.90,
    ),
    Target("simulated: false alarms", _of("simulated", "healthy", "false_alarms"), high=0.02),
    Target(
        "simulated: correct ones with probability ≥ 0.5",
        _of("simulated", "effects", "correct_and_confident"),
        low=0.70,
    ),
    Target(
        "simulated: coverage of the 95 % intervals",
        _of("simulated", "coverage", "all"),
        low=0.85,
        high=0.98,
    ),
    # A healthy plant of this kind obeys the published equation.
    Target("equation: top 1, pairs counted", _of("equation", "effects", "top1_pair"), low=0.95),
    Target("equation: top 1", _of("equation", "effects", "top1"), low=0.85),
    Target("equation: false alarms", _of("equation", "healthy", "false_alarms"), high=0.02),
    # Here the reported temperature is that of the core: little error besides noise.
    Target("published: top 1, pairs counted", _of("published", "effects", "top1_pair"), low=0.95),
    Target("published: top 1", _of("published", "effects", "top1"), low=0.85),
    Target("published: false alarms", _of("published", "healthy", "false_alarms"), high=0.02),
    Target("PyBaMM: top 1", _of("pybamm", "effects", "top1"), low=0.70),
    Target("PyBaMM: family", _of("pybamm", "effects", "family"), low=0.90),
    Target("recorded logs: top 1", _of("real", "effects", "top1"), low=0.70),
    Target("recorded logs: top 2", _of("real", "effects", "top2"), low=0.90),
    Target("recorded logs: family", _of("real", "effects", "family"), low=0.90),
    Target("recorded logs: false alarms", _of("real", "healthy", "false_alarms"), high=0.05),
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
        "cold car, held-out trip: RMSE",
        ("later", "left_out", "extended", "rmse_v"),
        high=1.4,
        unit="V",
    ),
    Target(
        "cold car, held-out trip: EKF SoC MAE",
        ("later", "left_out", "extended", "soc_mae_pct"),
        high=2.0,
        unit="%",
    ),
    Target(
        "held-out summer trips, same model: EKF SoC MAE",
        ("later", "clean", "extended", "soc_mae_pct"),
        high=1.2,
        unit="%",
    ),
    Target("cold cell: resistance_temperature", _of("cold-lg_hg2", "effects", "top1"), low=1.0),
    Target(
        "cold cell: closed fraction",
        _of("cold-lg_hg2", "effects", "closed", "reported", "all"),
        low=0.70,
    ),
    Target(
        "one log: maximum time", _of("simulated", "cost", "seconds", "max"), high=15.0, unit="s"
    ),
    Target("four logs: maximum time", _of("real", "cost", "seconds", "max"), high=40.0, unit="s"),
    Target("maximum memory", ("cost", "peak_mib", "max"), high=1024.0, unit="MiB"),
)


def judge_targets(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return every target whose figure is in the result, with its value."""
    return [found for target in TARGETS if (found := target.judge(result)) is not None]


Entry = tuple[str, Mapping[str, Any]]

ACCURACY: Final = (
    ("detected", "alarm"),
    ("top1", "top 1"),
    ("top1_pair", "top 1, ambiguous pairs counted"),
    ("top2", "top 2"),
    ("family", "family"),
    ("unknown", "verdict unknown"),
    ("ranked_first", "ranked first, any verdict"),
    ("ranked_in_two", "ranked in the first two, any verdict"),
    ("correct_and_confident", "of the correct ones: probability ≥ 0.5"),
)
FLOORS: Final = (
    ("clean", "floor: model on the same drives without the fault"),
    ("sensor", "floor: perfect model"),
    ("reported", "as reported"),
)


def percent(item: Mapping[str, Any] | None) -> str:
    """Return a share with its interval, such as "87 % (83–90)"."""
    if item is None or item["value"] is None:
        return NONE_KNOWN
    low, high = item["ci"]
    return f"{100.0 * item['value']:.0f} % ({100.0 * low:.0f}–{100.0 * high:.0f})"


POSTERIOR: Final = (
    ("probability_of_truth", "mean probability of the truth", 2),
    ("log_score", "log score [nats]", 2),
    ("set_size", "answers in the 90 % set", 1),
    ("ceiling", "ceiling of named effects: ideal observer right", 2),
)


def posterior_entries(items: Mapping[str, Any]) -> Iterator[tuple[str, str, int]]:
    """Yield label, value with its 95 % interval, and cases of each figure of the posterior."""
    found = items["posterior"]
    yield "truth in the 90 % set", percent(found["set_covers"]), found["set_covers"]["of"]
    for key, label, decimals in POSTERIOR:
        if found[key]["of"]:
            low, high = found[key]["ci"]
            text = f"{number(found[key]['value'], decimals)} ({span(low, high, decimals)})"
            yield label, text, found[key]["of"]


def entries_of(items: Mapping[str, Any]) -> Iterator[Entry]:
    """Yield label and figure of each line of a protocol's table."""
    if "effects" in items:
        effects = items["effects"]
        for key, label in ACCURACY:
            yield label, effects[key]
        for key, label in FLOORS:
            if effects["closed"][key]["detected"]["of"]:
                yield (
                    f"closed fraction of detected, median ({label})",
                    effects["closed"][key]["detected"],
                )
        if items["coverage"]["all"]["of"]:
            yield "coverage of the parameter intervals", items["coverage"]["all"]
    if "healthy" in items:
        yield "healthy: alarms", items["healthy"]["false_alarms"]
        yield "healthy: effect named", items["healthy"]["named_an_effect"]
    if "open_set" in items:
        yield "cause not in the library: unknown", items["open_set"]["unknown"]
        yield "cause not in the library: none", items["open_set"]["none"]
        yield "cause not in the library: effect named", items["open_set"]["named_an_effect"]
        yield "… with probability ≥ 0.5", items["open_set"]["confidently_wrong"]
    if "decoys" in items:
        yield "control, another effect left out: correct", items["decoys"]
    if "pairs" in items:
        yield "two causes: verdict is one of them", items["pairs"]["first_is_one_of_both"]
        yield "two causes: both accepted", items["pairs"]["both"]
        yield "two causes: both in the first three", items["pairs"]["both_among_three"]


def limits(row: Mapping[str, Any]) -> str:
    """Return the limits of a target as text."""
    parts = [
        f"{sign} {_amount(row[key], row['unit'])}"
        for key, sign in (("low", "≥"), ("high", "≤"))
        if row[key] is not None
    ]
    return " and ".join(parts)


def _amount(value: float, unit: str) -> str:
    """Return a share in %, or a quantity in its unit, as text."""
    return f"{100.0 * value:.0f} %" if not unit else number(value, 1 if value > 10 else 2, unit)


def measured(row: Mapping[str, Any]) -> str:
    """Return the value of a target with its interval, as text."""
    text = _amount(row["value"], row["unit"])
    if row["ci"] is None:
        return text
    low, high = row["ci"]
    return f"{text} ({100.0 * low:.0f}–{100.0 * high:.0f})"


def print_result(result: Mapping[str, Any], console: Console) -> None:
    """Print all tables of a result, as returned by `--json`."""
    for name, items in result["protocols"].items():
        _print_protocol(name, items, console)
    for group, items in result["later"].items():
        _print_held_out(group, items, console)
    _print_reliability(result["reliability"], console)
    _print_targets(result["targets"], console)
    cost = result["cost"]
    for key, unit in (("seconds", "s"), ("peak_mib", "MiB")):
        if cost[key] is not None:
            median, largest = cost[key]["median"], cost[key]["max"]
            console.print(f"{unit} per diagnosis: median {median:.1f}, max {largest:.1f}")
    for item in result["crashed"]:
        causes = ", ".join(item["truth"]) or "none"
        console.print(
            Text(f"crashed (counted as wrong): {item['case']} ({causes}): {item['error']}")
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
    for label, text, cases in posterior_entries(items):
        table.add_row(label, text, str(cases))
    console.print(table)
    if items.get("below_range"):
        console.print(
            f"{items['below_range']} have a gap below {LEAST_GAP} floors, the largest that is"
            " physical on their drives. They are excluded from the shares of effects."
        )
    if "by_gap" in items:
        table = _table(
            "by size of the gap", "floors", "cases", "detected", "top 1", "pairs counted"
        )
        for entry in items["by_gap"]:
            low, high = entry["gap_in_floors"]
            shares = (percent(entry[key]) for key in ("detected", "top1", "top1_pair"))
            table.add_row(f"{low:g} … {high:g}", str(entry["top1"]["of"]), *shares)
        console.print(table)
    table = _table("confusion", "truth", "cases", "verdicts")
    for truth, counts in items["confusion"].items():
        verdicts = ", ".join(f"{verdict} {count}" for verdict, count in counts.items())
        table.add_row(truth, str(sum(counts.values())), verdicts)
    if items["confusion"]:
        console.print(table)


def _print_held_out(group: str, items: Mapping[str, Any], console: Console) -> None:
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
    table = _table("reliability", "stated probability", "cases", "correct")
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
    table = _table("targets", "", "measured (95 %)", "target", "met")
    for row in rows:
        table.add_row(row["name"], measured(row), limits(row), "yes" if row["met"] else "NO")
    if rows:
        console.print(table)
