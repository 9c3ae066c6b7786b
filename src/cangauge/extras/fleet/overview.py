"""What the results of a fleet say of each vehicle: state of charge, health, gap, outliers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from cangauge.extras.fleet.gap import GapJob
from cangauge.extras.fleet.jobs import EstimateJob, HealthJob, mean_of
from cangauge.extras.fleet.outliers import OUTLIER_Z, VALUES_AT_LEAST, robust_z
from cangauge.extras.fleet.results import Results
from cangauge.extras.fleet.sources import FleetLog

_JOBS: Final = (EstimateJob, HealthJob, GapJob)
QUANTITIES: Final = {
    "capacity_ah": "capacity_std_ah",
    "resistance_ratio": "resistance_std",
    "offset_a": "offset_std_a",
}
"""Quantities of health compared over the fleet, with their standard deviations."""

Rows = list[dict[str, Any]]


@dataclass(frozen=True, eq=False)
class FleetOverview:
    """Results of a fleet by vehicle; empty where a command has not run.

    Parameters
    ----------
    name : str
        Folder or URL of the results.
    estimates, health : dict of str to list of dict
        Rows of `fleet estimate` and, in order of time, of `fleet health`.
    gaps : dict of str to dict
        Rows of `fleet gap`.
    bad : list of dict
        Logs set aside, each with `reason`, its `kind`, `log` and `table`.
    """

    name: str
    estimates: dict[str, Rows] = field(default_factory=dict)
    health: dict[str, Rows] = field(default_factory=dict)
    gaps: dict[str, dict[str, Any]] = field(default_factory=dict)
    bad: Rows = field(default_factory=list)

    @classmethod
    def read(cls, out: str, logs: Iterable[FleetLog]) -> FleetOverview:
        """Read the results in a folder or URL: the rows of some logs, and of their vehicles.

        Rows of logs that were given to an earlier run only, such as those of another month or those
        that were renamed since, are left out.
        """
        vehicles = {log.url: log.vehicle for log in logs}
        # A diagnosis is of a vehicle, and so is the row of one set aside.
        vehicles |= {vehicle: vehicle for vehicle in vehicles.values()}

        def asked(rows: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
            for row in rows:
                names = row.get("logs") or [row["log"]]
                if {vehicles.get(name) for name in names} == {row["vehicle"]}:
                    yield row

        tables = {job.kind: Results(out, job.kind, job.columns) for job in _JOBS}
        good = {kind: list(asked(table.rows())) for kind, table in tables.items()}
        bad = [
            {"table": kind, **{name: row.get(name) for name in ("log", "reason", "kind")}}
            for kind, table in tables.items()
            for row in asked(table.rows(bad=True))
        ]
        return cls(
            name=out,
            estimates=_by_vehicle(good["estimate"]),
            health=_by_vehicle(sorted(good["health"], key=lambda row: float(row["end_s"]))),
            gaps={row["vehicle"]: row for row in good["gap"]},
            bad=bad,
        )

    @property
    def vehicles(self) -> list[str]:
        """All vehicles with results, by name."""
        return sorted({*self.estimates, *self.health, *self.gaps})

    @property
    def by_gap(self) -> list[str]:
        """The diagnosed vehicles, that with the likeliest fault first."""
        return sorted(self.gaps, key=lambda name: (self.gaps[name]["probability_none"], name))

    @property
    def alarms(self) -> list[str]:
        """Vehicles with a gap, the surest first."""
        return [name for name in self.by_gap if self.gaps[name]["detected"]]

    @property
    def outlying(self) -> list[tuple[str, str, float]]:
        """Outliers in health: vehicle, quantity and robust z of its last value, farthest first."""
        found = []
        for quantity, deviation in QUANTITIES.items():
            last = {name: rows[-1] for name, rows in self.health.items()}
            values = {
                name: (row[quantity], row[deviation] or 0.0)
                for name, row in last.items()
                if row[quantity] is not None
            }
            if len(values) >= VALUES_AT_LEAST:
                z = robust_z(*np.array([*values.values()]).T)
                pairs = zip(values, z.tolist(), strict=True)
                found += [(name, quantity, far) for name, far in pairs if abs(far) >= OUTLIER_Z]
        return sorted(found, key=lambda item: -abs(item[2]))

    @property
    def no_outlier_text(self) -> str:
        """Why no vehicle is an outlier, in a sentence."""
        if len(self.health) >= VALUES_AT_LEAST:
            return f"No outlier in health: every robust z lies within ±{OUTLIER_Z}."
        return f"Fewer than {VALUES_AT_LEAST} vehicles: the spread of their health is not known."

    def to_dict(self) -> dict[str, Any]:
        """Return what `--json` prints of the vehicles."""
        shown = ("verdict", "probability", "probability_none", "group", "group_probability")

        def mean(column: str) -> float | None:
            """Return the mean over the vehicles of their means."""
            return mean_of(
                [mean_of([row[column] for row in rows]) for rows in self.estimates.values()]
            )

        return {
            "vehicles": len(self.vehicles),
            "alarms": [
                {"vehicle": name, **{key: self.gaps[name][key] for key in shown}}
                for name in self.alarms
            ],
            "outliers": [
                {"vehicle": vehicle, "quantity": quantity, "z": z}
                for vehicle, quantity, z in self.outlying
            ],
            "soc_mae_pct": mean("soc_mae_pct"),
            "valid_share": mean("valid_share"),
        }


def _by_vehicle(rows: Iterable[Mapping[str, Any]]) -> dict[str, Rows]:
    found: dict[str, Rows] = {}
    for row in rows:
        found.setdefault(row["vehicle"], []).append(dict(row))
    return dict(sorted(found.items()))
