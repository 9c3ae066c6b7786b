"""`fleet gap`: the gap of each vehicle, with references of all healthy vehicles of its type.

What healthy vehicles of a type have in common, and how much their errors differ, is learned from
references of many vehicles. A vehicle's own healthy logs come first, since they show its own pack;
the others follow, one of each vehicle in turn. Vehicles without healthy logs of their own have the
same references: what these show is learned once, and a diagnosis then takes no longer with more.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice, zip_longest
from pathlib import Path
from typing import Any, ClassVar, Final, Self, cast

import pyarrow as pa

from cangauge._files import text_sha256
from cangauge.diagnosis import (
    ALARM,
    NONE,
    UNKNOWN,
    Diagnosis,
    References,
    diagnose,
    learn_references,
)
from cangauge.errors import InputError
from cangauge.extras.fleet.jobs import COUNT, REAL, TEXT, Job
from cangauge.extras.fleet.sources import FleetLog, local_file
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

REFERENCES: Final = 30
"""References of a diagnosis by default; more gain little, and learning from a thousand takes 1.9 GB
(see docs/fleet.md)."""

WITH_OWN: Final = 30
"""References at most of a vehicle that has healthy logs of its own, or whose logs lie beyond the
common references: they are learned from for this vehicle alone, in half a second each."""

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
        Logs without a fault, its own first; empty: those of the job.
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
    alarm : float
        Probability of `none` up to which a fault is reported.
    common : tuple of FleetLog
        References of every vehicle without healthy logs of its own.
    learned : References, optional
        From these.
    unread : tuple of str
        Those that could not be used, with the reason.
    """

    model: Model
    references: int = REFERENCES
    alarm: float = ALARM
    common: tuple[FleetLog, ...] = ()
    learned: References | None = None
    unread: tuple[str, ...] = ()

    kind: ClassVar[str] = "gap"
    of: ClassVar[str] = "vehicles"
    reads_log: ClassVar[bool] = False
    columns: ClassVar[Mapping[str, Any]] = {
        "logs": _NAMES, "references": COUNT, "reference_vehicles": COUNT, "unread": _NAMES,
        "detected": pa.bool_(), "verdict": TEXT, "probability": REAL, "probability_none": REAL,
        "probability_unknown": REAL, "group": TEXT, "group_probability": REAL,
        "check_first": TEXT, "credible_set": _NAMES, "baseline_rmse_v": REAL,
        "extended_rmse_v": REAL, "healthy_rmse_v": REAL, "closed_fraction": REAL,
        "parameters": TEXT, "visible_from": TEXT, "summary": TEXT, "limits": _NAMES,
    }  # fmt: skip

    def identity(self) -> dict[str, Any]:
        """Return model, references and alarm."""
        model = self.model.to_json()
        return {"model": model, "references": self.references, "alarm": self.alarm}

    def with_common(
        self,
        suspect: Mapping[str, tuple[FleetLog, ...]],
        healthy: Mapping[str, tuple[FleetLog, ...]],
    ) -> Self:
        """Return the job with the references of vehicles without own ones, if there are any."""
        if all(vehicle in healthy for vehicle in suspect):
            return self
        return replace(self, common=tuple(islice(_in_turn(healthy), self.references)))

    def prepared(self) -> Self:
        """Return the job with what the common references show."""
        if not self.common:
            return self
        unread: list[str] = []
        logs = list(self._read(self.common, unread))
        while logs:
            try:
                learned = learn_references(logs, self.model)
            except InputError as error:
                left = [log for log in logs if error.source not in {log.source, log.name}]
                if len(left) == len(logs):
                    raise
                unread.append(str(error))
                logs = left
            else:
                return replace(self, learned=learned, unread=tuple(unread))
        raise InputError(f"no reference can be used: {unread[0]}", field="--reference")

    def vehicles(
        self,
        suspect: Mapping[str, tuple[FleetLog, ...]],
        healthy: Mapping[str, tuple[FleetLog, ...]],
    ) -> list[VehicleLogs]:
        """Return each vehicle with its logs and references; its stamp is that of all of these.

        References are the vehicle's own healthy logs, at most half, then one of each other vehicle
        in turn; or the common ones.

        Parameters
        ----------
        suspect, healthy : mapping of str to tuple of FleetLog
            Logs to diagnose, and logs without a fault, by vehicle.
        """
        most = min(self.references, WITH_OWN)
        in_turn = list(_in_turn(healthy))
        found = []
        for vehicle, logs in sorted(suspect.items()):
            chosen: tuple[FleetLog, ...] = ()
            if vehicle in healthy:
                tested = {log.url for log in logs}
                own = sorted(healthy[vehicle], key=_order)[: max(most // 2, 1)]
                others = (log for log in in_turn if log.vehicle != vehicle)
                usable = (log for log in chain(own, others) if log.url not in tested)
                chosen = tuple(islice(usable, most))
            read = (*logs, *(chosen or self.common))
            text = "".join(f"{each.url}{each.stamp}{each.stated}" for each in read)
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
            raise InputError("none of its logs can be read", cure=f"the first: {unread[0]}")
        of = vehicle.references or self.common
        references: list[Log] | References
        if not vehicle.references and self.learned is not None:
            references = self.learned
            unread += self.unread
            unusable = {text.partition(": ")[0] for text in self.unread}
        else:
            of = of[:WITH_OWN]
            before = len(unread)
            references = list(self._read(of, unread))
            unusable = {text.partition(": ")[0] for text in unread[before:]}
        found = diagnose(logs, self.model, references, alarm=self.alarm)
        return {
            "logs": [each.url for each in vehicle.logs],
            "references": len(found.known.logs),
            "reference_vehicles": len({each.vehicle for each in of if each.url not in unusable}),
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
    answer = found.posterior
    group, probability = next(iter(answer.groups.items()))
    return {
        "detected": answer.detected,
        "verdict": answer.verdict,
        "probability": answer.probability,
        "probability_none": answer.probabilities[NONE],
        "probability_unknown": answer.probabilities[UNKNOWN],
        "group": group,
        "group_probability": probability,
        "check_first": answer.check_first,
        "credible_set": list(answer.credible_set),
        "baseline_rmse_v": found.baseline_rmse_v,
        "extended_rmse_v": found.extended_rmse_v,
        "healthy_rmse_v": found.healthy_rmse_v,
        "closed_fraction": found.closed_fraction,
        "parameters": json.dumps(
            {
                answer.verdict: {
                    name: item.to_dict()
                    for name, item in found.parameters.get(answer.verdict, {}).items()
                }
            }
        ),
        "visible_from": json.dumps(found.visible_from),
        "summary": found.summary,
        "limits": found.caveats,
    }


def _in_turn(healthy: Mapping[str, tuple[FleetLog, ...]]) -> Iterator[FleetLog]:
    """Yield one healthy log of each vehicle in turn; logs and vehicles are shuffled."""
    shuffled = [sorted(logs, key=_order) for logs in healthy.values()]
    by_order = sorted(shuffled, key=lambda logs: _order(logs[0]))
    return (log for log in chain(*zip_longest(*by_order)) if log is not None)


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
