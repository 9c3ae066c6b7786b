"""What the results of a fleet say of each vehicle: state of charge, health, gap, outliers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from cangauge.fleet.dataset import Dataset
from cangauge.fleet.gap import GapJob
from cangauge.fleet.health import OUTLIER_Z, HealthJob, latest_health, outliers
from cangauge.fleet.jobs import EstimateJob

_JOBS: Final = (EstimateJob, HealthJob, GapJob)


@dataclass(frozen=True)
class VehicleEstimates:
    """Estimates of one vehicle.

    Parameters
    ----------
    logs : int
    hours : float
        Duration of its logs [h].
    soc_mae_pct, worst_mae_pct : float or None
        Mean over the logs with SoC, and of the worst log [%].
    soc_std_pct : float or None
        Mean standard deviation [%].
    cover_2sigma : float or None
        Mean share of samples with the log's SoC within 2σ (0–1).
    valid_share : float
        Mean share of valid samples (0–1).
    """

    logs: int
    hours: float
    soc_mae_pct: float | None
    worst_mae_pct: float | None
    soc_std_pct: float | None
    cover_2sigma: float | None
    valid_share: float


@dataclass(frozen=True, eq=False)
class FleetOverview:
    """Results of a fleet by vehicle; empty where a command has not run.

    Parameters
    ----------
    name : str
        Folder or URL of the data sets.
    estimates : dict of str to VehicleEstimates
    health : dict of str to list of dict
        Rows of `fleet health` in order of time.
    z : dict
        Robust z by quantity and vehicle (`health.outliers`).
    gaps : dict of str to dict
        Rows of `fleet gap`.
    bad : list of dict
        Logs set aside, each with `reason`, `log` and `table`.
    """

    name: str
    estimates: dict[str, VehicleEstimates] = field(default_factory=dict)
    health: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    z: dict[str, dict[str, float]] = field(default_factory=dict)
    gaps: dict[str, dict[str, Any]] = field(default_factory=dict)
    bad: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def read(cls, out: str) -> FleetOverview:
        """Read the data sets of a folder or URL."""
        tables = {job.kind: Dataset(out, job.kind, job.columns) for job in _JOBS}
        health: dict[str, list[dict[str, Any]]] = {}
        for row in tables["health"].rows(without=["state"]):
            health.setdefault(row["vehicle"], []).append(row)
        for rows in health.values():
            rows.sort(key=lambda row: float(row["end_s"]))
        last = latest_health(rows[-1] for rows in health.values())
        return cls(
            name=out,
            estimates=_by_vehicle(tables["estimate"].rows()),
            health=dict(sorted(health.items())),
            z=outliers(last),
            gaps={row["vehicle"]: row for row in tables["gap"].rows()},
            bad=[
                {"table": kind, "log": row["log"], "reason": row["reason"]}
                for kind, table in tables.items()
                for row in table.rows(bad=True)
            ],
        )

    @property
    def vehicles(self) -> list[str]:
        """All vehicles with results, by name."""
        return sorted({*self.estimates, *self.health, *self.gaps})

    @property
    def alarms(self) -> list[str]:
        """Vehicles with a gap, the surest first."""
        found = [name for name, row in self.gaps.items() if row["detected"]]
        return sorted(found, key=lambda name: (self.gaps[name]["probability_none"], name))

    @property
    def outlying(self) -> list[tuple[str, str, float]]:
        """Outliers of the fleet: vehicle, quantity and robust z, the farthest first."""
        found = [
            (vehicle, quantity, z)
            for quantity, of_vehicle in self.z.items()
            for vehicle, z in of_vehicle.items()
            if abs(z) >= OUTLIER_Z
        ]
        return sorted(found, key=lambda item: -abs(item[2]))

    def to_dict(self) -> dict[str, Any]:
        """Return what `--json` prints of the vehicles."""
        return {
            "vehicles": len(self.vehicles),
            "alarms": [
                {
                    "vehicle": name,
                    **{
                        key: self.gaps[name][key]
                        for key in ("verdict", "probability", "probability_none")
                    },
                }
                for name in self.alarms
            ],
            "outliers": [
                {"vehicle": vehicle, "quantity": quantity, "z": z}
                for vehicle, quantity, z in self.outlying
            ],
            "soc_mae_pct": mean(each.soc_mae_pct for each in self.estimates.values()),
            "valid_share": mean(each.valid_share for each in self.estimates.values()),
        }


def _by_vehicle(rows: Iterable[Mapping[str, Any]]) -> dict[str, VehicleEstimates]:
    columns = ("duration_s", "soc_mae_pct", "mean_soc_std_pct", "cover_2sigma", "valid_share")
    found: dict[str, dict[str, list[float | None]]] = {}
    for row in rows:
        of_vehicle = found.setdefault(row["vehicle"], {name: [] for name in columns})
        for name in columns:
            of_vehicle[name].append(row[name])
    result = {}
    for vehicle, values in sorted(found.items()):
        errors = [value for value in values["soc_mae_pct"] if value is not None]
        result[vehicle] = VehicleEstimates(
            logs=len(values["duration_s"]),
            hours=sum(value or 0.0 for value in values["duration_s"]) / 3600.0,
            soc_mae_pct=mean(errors),
            worst_mae_pct=max(errors, default=None),
            soc_std_pct=mean(values["mean_soc_std_pct"]),
            cover_2sigma=mean(values["cover_2sigma"]),
            valid_share=mean(values["valid_share"]) or 0.0,
        )
    return result


def mean(values: Iterable[float | None]) -> float | None:
    """Return the mean of the known values; None without any."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
