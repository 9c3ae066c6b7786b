"""`fleet gap`: the gap of each vehicle, with references of all healthy vehicles of its type.

What healthy vehicles of a type have in common, and how much their errors differ, is learned from
references of many vehicles. A vehicle's own healthy logs come first, since they show its own pack;
the others follow, one of each vehicle in turn. Vehicles without healthy logs of their own have the
same references: what these show is learned once, and a diagnosis then takes no longer with more.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice, zip_longest
from typing import Any, ClassVar, Final, Self

import pyarrow as pa

from cangauge._files import text_sha256
from cangauge.diagnosis import (
    NONE,
    UNKNOWN,
    Diagnosis,
    References,
    diagnose,
    learn_references,
)
from cangauge.errors import InputError
from cangauge.extras.fleet.jobs import COUNT, REAL, TEXT, Job, Task, by_vehicle
from cangauge.extras.fleet.sources import FleetLog
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

_REFERENCES: Final = 30
"""References of a diagnosis; more gain little, and learning from a thousand takes 1.9 GB (see
docs/fleet.md)."""
_LATEST: Final = 3
"""Latest logs of a vehicle that are diagnosed together."""
_NAMES: Final = pa.list_(pa.string())


@dataclass(frozen=True, eq=False)
class GapJob(Job):
    """Verdict on each vehicle.

    Parameters
    ----------
    model : Model
        Of the vehicles' type, such as from `fleet fit`.
    common : tuple of FleetLog
        References of every vehicle without healthy logs of its own.
    learned : References, optional
        From these.
    unread : tuple of str
        Those that could not be used, with the reason.
    """

    model: Model
    common: tuple[FleetLog, ...] = ()
    learned: References | None = None
    unread: tuple[str, ...] = ()

    kind: ClassVar[str] = "gap"
    of: ClassVar[str] = "vehicles"
    columns: ClassVar[Mapping[str, Any]] = {
        "logs": _NAMES, "references": COUNT, "reference_vehicles": COUNT, "unread": _NAMES,
        "detected": pa.bool_(), "verdict": TEXT, "probability": REAL, "probability_none": REAL,
        "probability_unknown": REAL, "group": TEXT, "group_probability": REAL,
        "check_first": TEXT, "credible_set": _NAMES, "baseline_rmse_v": REAL,
        "extended_rmse_v": REAL, "healthy_rmse_v": REAL, "closed_fraction": REAL,
        "parameters": TEXT, "visible_from": TEXT, "summary": TEXT, "limits": _NAMES,
    }  # fmt: skip

    def identity(self) -> dict[str, Any]:
        """Return the model."""
        return {"model": self.model.to_json()}

    def of_fleet(
        self, logs: Iterable[FleetLog], healthy: Iterable[FleetLog]
    ) -> tuple[Self, list[Task]]:
        """Return the job with the common references, and a task for each vehicle.

        References of a vehicle are its own healthy logs, at most half, then one of each other
        vehicle in turn; or the common ones.

        Parameters
        ----------
        logs, healthy : iterable of FleetLog
            Logs to diagnose, and logs without a fault, each in order of time. The latest of a
            vehicle (`_LATEST`) are diagnosed together.

        Raises
        ------
        InputError
            If no log is healthy, or all are.
        """
        good = {task.vehicle: sorted(task.logs, key=_order) for task in by_vehicle(healthy)}
        suspect = by_vehicle(logs)
        if not good:
            cure = "give --reference, or a manifest with the column `healthy`"
            raise InputError("no log is known to be healthy", field="--reference", cure=cure)
        if not suspect:
            raise InputError("every log is a reference", cure="give logs to diagnose")
        groups = sorted(good.values(), key=lambda of_vehicle: _order(of_vehicle[0]))
        in_turn = [log for log in chain(*zip_longest(*groups)) if log is not None]
        needed = any(task.vehicle not in good for task in suspect)
        common = tuple(in_turn[:_REFERENCES]) if needed else ()
        tasks = []
        for task in suspect:
            own = good.get(task.vehicle, [])[: _REFERENCES // 2]
            others = [log for log in in_turn if log.vehicle != task.vehicle] if own else []
            tasks.append(
                replace(
                    task,
                    logs=task.logs[-_LATEST:],
                    references=tuple(islice(chain(own, others), _REFERENCES)),
                    common=() if own else common,
                )
            )
        return replace(self, common=common), tasks

    def prepared(self) -> Self:
        """Return the job with what the common references show."""
        unread: list[str] = []
        logs = self._read_all(self.common, unread)
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
        if self.common:
            raise InputError(f"no reference can be used: {unread[0]}", field="--reference")
        return self

    def parts(self, task: Task) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
        """Yield the verdict on the vehicle."""
        yield task.vehicle, lambda: self._row(task)

    def _row(self, task: Task) -> dict[str, Any]:
        unread: list[str] = []
        logs = self._read_all(task.logs, unread)
        if not logs:
            raise InputError("none of its logs can be read", cure=f"the first: {unread[0]}")
        of, bad = task.references or self.common, list(self.unread)
        references: References | list[Log] | None = self.learned
        if task.references or references is None:
            bad = []
            references = self._read_all(of, bad)
        found = diagnose(logs, self.model, references)
        unusable = {text.partition(": ")[0] for text in bad}
        return {
            "logs": [log.url for log in task.logs],
            "references": len(found.known.logs),
            "reference_vehicles": len({log.vehicle for log in of if log.url not in unusable}),
            "unread": [*unread, *bad],
            **_columns_of(found),
        }

    def _read_all(self, logs: Sequence[FleetLog], unread: list[str]) -> list[Log]:
        """Read logs; those that cannot be read are named in `unread`."""
        found = []
        for log in logs:
            try:
                found.append(self.read(log))
            except InputError as error:
                unread.append(f"{log.url}: {error.problem}")
        return found


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
                    name: vars(item)
                    for name, item in found.parameters.get(answer.verdict, {}).items()
                }
            }
        ),
        "visible_from": json.dumps(found.visible_from),
        "summary": found.summary,
        "limits": found.caveats,
    }


def _order(log: FleetLog) -> str:
    """Return a key that shuffles logs, by their names only."""
    return text_sha256(log.url)
