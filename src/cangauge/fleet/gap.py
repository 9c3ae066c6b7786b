"""`fleet gap`: the gap of each vehicle, with references of all healthy vehicles of its type.

What healthy vehicles of a type have in common, and how much their errors differ, is learned from
references of many vehicles. A vehicle's own healthy logs come first, since they show its own pack;
the others follow, one of each vehicle in turn.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice, zip_longest
from pathlib import Path
from typing import Any, ClassVar, Final, cast

import pyarrow as pa

from cangauge._io import text_sha256
from cangauge.diagnosis import ALARM_BELOW, NONE, UNKNOWN, Diagnosis, diagnose
from cangauge.errors import InputError
from cangauge.fleet.jobs import COUNT, REAL, TEXT, Job
from cangauge.fleet.sources import FleetLog, local_file
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

REFERENCES: Final = 30
"""References of a diagnosis by default: each takes a second and 40 MB; more gain little (see
docs/fleet.md)."""

LOGS: Final = 3
"""Latest logs of a vehicle that are diagnosed together by default."""

_NAMES: Final = pa.list_(pa.string())


@dataclass(frozen=True, slots=True)
class VehicleLogs(FleetLog):
    """A vehicle with what its task reads.

    Parameters
    ----------
    logs : tuple of FleetLog
        Logs to diagnose.
    references : tuple of FleetLog
        Logs without a fault, its own first.
    """

    logs: tuple[FleetLog, ...] = ()
    references: tuple[FleetLog, ...] = ()


@dataclass(frozen=True, eq=False)
class GapJob(Job):
    """Verdict on each vehicle; its logs are `VehicleLogs`.

    Parameters
    ----------
    model : Model
        Of the vehicles' type, such as from `fleet fit`.
    references : int
        Largest number of references of a diagnosis.
    alarm_below : float
        Probability of `none` up to which a fault is reported.
    """

    model: Model
    references: int = REFERENCES
    alarm_below: float = ALARM_BELOW

    kind: ClassVar[str] = "gap"
    of: ClassVar[str] = "vehicles"
    reads_log: ClassVar[bool] = False
    columns: ClassVar[Mapping[str, Any]] = {
        "logs": _NAMES, "references": COUNT, "reference_vehicles": COUNT, "unread": _NAMES,
        "detected": pa.bool_(), "verdict": TEXT, "probability": REAL, "probability_none": REAL,
        "probability_unknown": REAL, "family": TEXT, "family_probability": REAL,
        "credible_set": _NAMES, "baseline_rmse_v": REAL, "extended_rmse_v": REAL, "floor_v": REAL,
        "closed_fraction": REAL, "parameters": TEXT, "smallest": TEXT, "summary": TEXT,
        "limits": _NAMES,
    }  # fmt: skip

    def identity(self) -> dict[str, Any]:
        """Return model, references and alarm."""
        model = self.model.to_json()
        return {"model": model, "references": self.references, "alarm": self.alarm_below}

    def vehicles(
        self,
        suspect: Mapping[str, tuple[FleetLog, ...]],
        healthy: Mapping[str, tuple[FleetLog, ...]],
    ) -> list[VehicleLogs]:
        """Return each vehicle with its logs and references; its stamp is that of all of these.

        References are the vehicle's own healthy logs, at most half, then one of each other vehicle
        in turn.

        Parameters
        ----------
        suspect, healthy : mapping of str to tuple of FleetLog
            Logs to diagnose, and logs without a fault, by vehicle.
        """
        shuffled = {name: sorted(logs, key=_order) for name, logs in healthy.items()}
        by_order = sorted(shuffled.values(), key=lambda logs: _order(logs[0]))
        in_turn = [log for log in chain(*zip_longest(*by_order)) if log is not None]
        found = []
        for vehicle, logs in sorted(suspect.items()):
            tested = {log.url for log in logs}
            own = shuffled.get(vehicle, [])[: max(self.references // 2, 1)]
            others = (log for log in in_turn if log.vehicle != vehicle)
            usable = (log for log in chain(own, others) if log.url not in tested)
            chosen = tuple(islice(usable, self.references))
            text = "".join(f"{each.url}{each.stamp}{each.stated}" for each in (*logs, *chosen))
            stamp = text_sha256(text)[:16]
            found.append(VehicleLogs(vehicle, vehicle, stamp, logs=logs, references=chosen))
        return found

    def row(self, log: FleetLog, path: Path | None, state: str | None) -> dict[str, Any]:
        """Return the verdict on a vehicle."""
        del path, state
        vehicle = cast("VehicleLogs", log)
        unread: list[str] = []
        logs = list(self._read(vehicle.logs, unread))
        if not logs:
            raise InputError(f"none of its logs can be read: {unread[0]}")
        references = list(self._read(vehicle.references, unread))
        found = diagnose(logs, self.model, references, alarm_below=self.alarm_below)
        return {
            "logs": [each.url for each in vehicle.logs],
            "references": len(references),
            "reference_vehicles": len({each.vehicle for each in vehicle.references}),
            "unread": unread,
            **_columns_of(found),
        }

    def _read(self, logs: Sequence[FleetLog], unread: list[str]) -> Iterator[Log]:
        """Read logs; those that cannot be read are named in `unread`."""
        for log in logs:
            try:
                with local_file(log.url) as path:
                    recorded = self.options.read_log(log, path)
            except InputError as error:
                unread.append(f"{log.url}: {error.problem}")
            else:
                yield recorded


def _columns_of(found: Diagnosis) -> dict[str, Any]:
    verdict = found.verdict
    return {
        "detected": verdict.detected,
        "verdict": verdict.cause,
        "probability": verdict.probability,
        "probability_none": verdict.probabilities[NONE],
        "probability_unknown": verdict.probabilities[UNKNOWN],
        "family": verdict.family,
        "family_probability": verdict.family_probability,
        "credible_set": list(verdict.credible_set),
        "baseline_rmse_v": found.baseline_rmse_v,
        "extended_rmse_v": found.extended_rmse_v,
        "floor_v": found.floor_v,
        "closed_fraction": found.closed_fraction,
        "parameters": json.dumps(
            {
                item["effect"]: item["parameters"]
                for item in found.candidates
                if item["effect"] == verdict.cause
            }
        ),
        "smallest": json.dumps(
            {str(item["effect"]): 1.0 - float(str(item["visible"])) for item in found.observability}
        ),
        "summary": found.summary,
        "limits": found.caveats,
    }


def _order(log: FleetLog) -> str:
    """Return a key that shuffles logs, by their names only."""
    return text_sha256(log.url)


def suspect_and_healthy(
    logs: Sequence[FleetLog], per_vehicle: int
) -> tuple[dict[str, tuple[FleetLog, ...]], dict[str, tuple[FleetLog, ...]]]:
    """Return the latest logs to diagnose, and the healthy ones, by vehicle.

    Parameters
    ----------
    logs : sequence of FleetLog
        In order of time for each vehicle.
    per_vehicle : int
        Largest number of logs to diagnose of each.

    Raises
    ------
    InputError
        If no log is healthy, or all are.
    """
    suspect: dict[str, list[FleetLog]] = {}
    healthy: dict[str, list[FleetLog]] = {}
    for log in logs:
        (healthy if log.healthy else suspect).setdefault(log.vehicle, []).append(log)
    if not healthy:
        raise InputError(
            "no log is known to be healthy", field="--reference",
            cure="give --reference, or a manifest with the column `healthy`",
        )  # fmt: skip
    if not suspect:
        raise InputError("every log is a reference", cure="give logs to diagnose")
    return (
        {name: tuple(found[-per_vehicle:]) for name, found in suspect.items()},
        {name: tuple(found) for name, found in healthy.items()},
    )
