"""What the results of a fleet say of each vehicle: state of charge, health, gap, outliers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from cangauge._text import counted, number
from cangauge.diagnosis import NONE
from cangauge.extras.fleet.dataset import Dataset
from cangauge.extras.fleet.gap import GapJob
from cangauge.extras.fleet.health import HealthJob, latest_health, outliers
from cangauge.extras.fleet.jobs import EstimateJob
from cangauge.extras.fleet.outliers import OUTLIER_Z, VALUES_AT_LEAST
from cangauge.extras.fleet.sources import FleetLog

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
        Logs set aside, each with `reason`, its `kind`, `log` and `table`.
    elsewhere : int
        Rows of logs that are not among those asked for.
    """

    name: str
    estimates: dict[str, VehicleEstimates] = field(default_factory=dict)
    health: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    z: dict[str, dict[str, float]] = field(default_factory=dict)
    gaps: dict[str, dict[str, Any]] = field(default_factory=dict)
    bad: list[dict[str, Any]] = field(default_factory=list)
    elsewhere: int = 0

    @classmethod
    def read(cls, out: str, logs: Iterable[FleetLog]) -> FleetOverview:
        """Read the data sets of a folder or URL: the rows of some logs, and of their vehicles.

        A data set keeps the rows of logs that were given to an earlier run only, such as those of
        another month or those that were renamed since.

        Parameters
        ----------
        out : str
        logs : iterable of FleetLog
        """
        tables = {job.kind: Dataset(out, job.kind, job.columns) for job in _JOBS}
        asked = _Asked(logs)
        health: dict[str, list[dict[str, Any]]] = {}
        for row in asked.only(tables["health"].rows(without=["state"])):
            health.setdefault(row["vehicle"], []).append(row)
        for rows in health.values():
            rows.sort(key=lambda row: float(row["end_s"]))
        last = latest_health(rows[-1] for rows in health.values())
        return cls(
            name=out,
            estimates=_by_vehicle(asked.only(tables["estimate"].rows())),
            health=dict(sorted(health.items())),
            z=outliers(last),
            gaps={row["vehicle"]: row for row in asked.only(tables["gap"].rows())},
            bad=[
                {"table": kind, **{name: row.get(name) for name in ("log", "reason", "kind")}}
                for kind, table in tables.items()
                for row in asked.only(table.rows(bad=True))
            ],
            elsewhere=asked.refused,
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
    def nearest(self) -> str | None:
        """The vehicle without a gap whose probability of no fault is smallest."""
        without = [name for name, row in self.gaps.items() if not row["detected"]]
        return min(without, key=lambda name: self.gaps[name]["probability_none"], default=None)

    @property
    def nearest_text(self) -> str:
        """The nearest vehicle in a phrase; "" if there is none."""
        if self.nearest is None:
            return ""
        row = self.gaps[self.nearest]
        text = (
            f"nearest: {self.nearest} (P(no fault) {number(100.0 * row['probability_none'], 0)} %"
        )
        if row["group"] != NONE:
            text += f", {row['group']} {number(100.0 * row['group_probability'], 0)} %"
        return f"{text})"

    @property
    def elsewhere_text(self) -> str:
        """The rows that are not counted, in a sentence; "" if there are none."""
        if not self.elsewhere:
            return ""
        return (
            f"{self.name} holds {counted(self.elsewhere, 'row')} of logs that are not among LOGS"
            " (earlier runs, or deleted or renamed since); not counted."
        )

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

    @property
    def no_outlier_text(self) -> str:
        """Why no vehicle is an outlier, in a sentence."""
        if self.z:
            return f"No outlier in health: every robust z lies within ±{OUTLIER_Z}."
        return f"Fewer than {VALUES_AT_LEAST} vehicles: the spread of their health is not known."

    def to_dict(self) -> dict[str, Any]:
        """Return what `--json` prints of the vehicles."""
        return {
            "vehicles": len(self.vehicles),
            "alarms": [self._alarm(name) for name in self.alarms],
            "nearest": None if self.nearest is None else self._alarm(self.nearest),
            "rows_elsewhere": self.elsewhere,
            "outliers": [
                {"vehicle": vehicle, "quantity": quantity, "z": z}
                for vehicle, quantity, z in self.outlying
            ],
            "soc_mae_pct": mean(each.soc_mae_pct for each in self.estimates.values()),
            "valid_share": mean(each.valid_share for each in self.estimates.values()),
        }

    def _alarm(self, name: str) -> dict[str, Any]:
        shown = ("verdict", "probability", "probability_none", "group", "group_probability")
        return {"vehicle": name, **{key: self.gaps[name][key] for key in shown}}


class _Asked:
    """Passes the rows of some logs, and counts the others."""

    def __init__(self, logs: Iterable[FleetLog]) -> None:
        self.refused = 0
        self._vehicles = {log.url: log.vehicle for log in logs}
        # A diagnosis is of a vehicle, and so is the row of one set aside.
        self._vehicles |= {vehicle: vehicle for vehicle in self._vehicles.values()}

    def only(self, rows: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
        """Yield the rows of which all logs were asked for, of the same vehicle."""
        for row in rows:
            names = row.get("logs") or [row["log"]]
            if {self._vehicles.get(name) for name in names} == {row["vehicle"]}:
                yield row
            else:
                self.refused += 1


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
