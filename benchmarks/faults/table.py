"""The table of faults, for people and as JSON."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from rich.console import Console
from rich.table import Table

from faults.fault import Fault
from faults.judge import Verdict


@dataclass(frozen=True)
class Row:
    """One fault and what came of it.

    Parameters
    ----------
    name, done, profile : str
        Of the fault.
    bus : str
        "udp" or "vcan".
    verdict : Verdict, optional
        None: left out.
    why_not : str
        Why it was left out.
    """

    name: str
    done: str
    profile: str
    bus: str
    verdict: Verdict | None
    why_not: str = ""

    @classmethod
    def of(cls, fault: Fault, bus: str, verdict: Verdict | None, why_not: str = "") -> Row:
        """Return the row of a fault."""
        return cls(fault.name, fault.done, fault.profile.name, bus, verdict, why_not)

    def as_json(self) -> dict[str, Any]:
        """Return the row with NaN as null."""
        row: dict[str, Any] = asdict(self)
        if self.verdict is not None:
            found = {
                key: None if isinstance(value, float) and math.isnan(value) else value
                for key, value in row["verdict"].items()
            }
            row["verdict"] = {"passed": self.verdict.passed, **found}
        return row

    @classmethod
    def from_json(cls, row: dict[str, Any]) -> Row:
        """Return the row that `as_json` gave."""
        found = row["verdict"]
        if found is None:
            return cls(**row)
        numbers = {key: math.nan if value is None else value for key, value in found.items()}
        del numbers["passed"]
        numbers["failures"] = tuple(numbers["failures"])
        return cls(**{**row, "verdict": Verdict(**numbers)})


def show(rows: list[Row], console: Console) -> None:
    """Print the table."""
    table = Table(title="faults on a live bus", caption=CAPTION)
    for name in ("fault", "what was done", "bus, time"):
        table.add_column(name, overflow="fold")
    numbers = (
        "SoC error %",
        "σ %",
        "worst %",
        "status: worst, last",
        "not valid s",
        "stale s",
        "silent s",
    )
    for name in numbers:
        table.add_column(name, justify="right")
    table.add_column("", overflow="fold")
    for row in rows:
        found = row.verdict
        head = (row.name, row.done, f"{row.bus}, {row.profile}")
        if found is None:
            table.add_row(*head, *[""] * 7, f"[yellow]left out: {row.why_not}")
            continue
        told = "[green]pass" if found.passed else f"[red]FAIL: {'; '.join(found.failures)}"
        table.add_row(
            *head,
            _number(found.soc_error_pct, 2),
            _number(found.std_pct, 2),
            _number(found.worst_error_pct, 2),
            f"{found.worst_status}, {found.last_status}",
            _number(found.not_valid_s, 1),
            _number(found.stale_valid_s, 1),
            _number(found.silent_s, 1),
            told,
        )
    console.print(table)


CAPTION = (
    "SoC error: largest against the undisturbed run, called valid after recovery (–: nothing was),"
    " and σ published with it; worst: in the whole run. Not valid: for so long from the fault on."
    " Stale: called valid for so much longer than its time-out. Times by the clock on the wall; a"
    " second of it is 24 of the log's with the replay clock."
)


def _number(value: float, digits: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f}"
