"""What the check must show, beside what it shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final


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
