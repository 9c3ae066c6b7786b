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
from functools import lru_cache, partial
from itertools import chain, islice, zip_longest
from typing import Any, ClassVar, Final, NamedTuple

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
from cangauge.extras.fleet.jobs import COUNT, REAL, TEXT, ModelJob, Row, Task, by_vehicle
from cangauge.extras.fleet.sources import FleetLog
from cangauge.logs.log import Log

_REFERENCES: Final = 30
"""References of a diagnosis; more gain little, and learning from a thousand takes 1.9 GB (see
docs/fleet.md)."""
_LATEST: Final = 3
"""Latest logs of a vehicle that are diagnosed together."""
_NAMES: Final = pa.list_(pa.string())


@dataclass(frozen=True, eq=False)
class GapJob(ModelJob):
    """Verdict on each vehicle."""

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

    def parts(self, task: Task) -> Iterator[tuple[str, Callable[[], Row]]]:
        """Yield the verdict on the vehicle."""
        yield task.vehicle, partial(self._row, task)

    def _row(self, task: Task) -> Row:
        logs, unread = self.read_all(task.logs)
        if not logs:
            raise InputError("none of its logs can be read", cure=f"the first: {unread[0]}")
        healthy = _learned(self, task.references)
        if isinstance(healthy, InputError):
            raise healthy
        found = diagnose([*logs.values()], self.model, healthy.references)
        return {
            "logs": [log.url for log in task.logs],
            "references": len(found.known.logs),
            "reference_vehicles": healthy.vehicles,
            "unread": [*unread, *healthy.unread],
            **_columns_of(found),
        }

    def read_all(self, logs: Iterable[FleetLog]) -> tuple[dict[FleetLog, Log], list[str]]:
        """Return the logs that can be read, and why the others cannot."""
        read, unread = {}, []
        for log in logs:
            try:
                read[log] = self.read(log)
            except InputError as error:
                unread.append(f"{log.url}: {error.problem}")
        return read, unread


class _Learned(NamedTuple):
    """What references show, of how many vehicles they are, and those that could not be used."""

    references: References
    vehicles: int
    unread: list[str]


@lru_cache(maxsize=1)
def _learned(job: GapJob, references: tuple[FleetLog, ...]) -> _Learned | InputError:
    """Learn from references on this worker, without those that cannot be used.

    An error is returned, so that it is kept too: other vehicles have the same references.
    """
    logs, unread = job.read_all(references)
    while logs:
        try:
            learned = learn_references([*logs.values()], job.model)
        except InputError as error:
            left = {
                of: log for of, log in logs.items() if error.source not in {log.source, log.name}
            }
            if len(left) == len(logs):
                return error
            unread.append(str(error))
            logs = left
        else:
            return _Learned(learned, len({log.vehicle for log in logs}), unread)
    return InputError(f"no reference can be used: {unread[0]}", field="--reference")


def gap_tasks(logs: Sequence[FleetLog]) -> list[Task]:
    """Return a task for each vehicle, with its references.

    References of a vehicle are its own healthy logs, at most half, then one of each other vehicle
    in turn. Vehicles without healthy logs of their own have the same, and come first: a worker then
    learns from these once.

    Parameters
    ----------
    logs : sequence of FleetLog
        Healthy logs and those to diagnose, each in order of time. The latest of a vehicle
        (`_LATEST`) are diagnosed together.

    Raises
    ------
    InputError
        If no log is healthy, or all are.
    """
    healthy = by_vehicle(log for log in logs if log.healthy)
    suspect = by_vehicle(log for log in logs if not log.healthy)
    good = {task.vehicle: sorted(task.logs, key=_order) for task in healthy}
    if not good:
        cure = "give --reference, or a manifest with the column `healthy`"
        raise InputError("no log is known to be healthy", field="--reference", cure=cure)
    if not suspect:
        raise InputError("every log is a reference", cure="give logs to diagnose")
    groups = sorted(good.values(), key=lambda of_vehicle: _order(of_vehicle[0]))
    in_turn = [log for log in chain(*zip_longest(*groups)) if log is not None]
    tasks = []
    for task in sorted(suspect, key=lambda task: task.vehicle in good):
        own = good.get(task.vehicle, [])[: _REFERENCES // 2]
        others = (log for log in in_turn if log.vehicle != task.vehicle)
        references = tuple(islice(chain(own, others), _REFERENCES))
        tasks.append(replace(task, logs=task.logs[-_LATEST:], references=references))
    return tasks


def _columns_of(found: Diagnosis) -> Row:
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
