"""Which logs a repeated run computes again, and from which state; without a cluster."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, Self

import pytest

from cangauge.errors import CangaugeError, InputError
from cangauge.extras.fleet import run as fleet_run
from cangauge.extras.fleet.dataset import Dataset, by_kind
from cangauge.extras.fleet.jobs import Job
from cangauge.extras.fleet.run import Summary, run_id, run_job
from cangauge.extras.fleet.sources import FleetLog, find_logs
from fleet_here import ChainedJob, Done, Here, NotingJob


class Fleet:
    """Logs a, b, c of a vehicle, and the results of a job."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.root, self._monkeypatch = root, monkeypatch
        self.seen: list[list[str]] = []
        for name in "abc":
            (root / f"{name}.txt").write_text(name)

    def data(self, job: Job) -> Dataset:
        return Dataset(str(self.root / "out"), job.kind, job.columns)

    def logs(self) -> list[FleetLog]:
        return find_logs([f"{self.root}/*.txt"])

    def run(self, job: Job, *logs: FleetLog) -> Summary:
        client = Here(self._monkeypatch, lambda: self.seen.append(self.states(job)))
        return run_job(job, logs or self.logs(), self.data(job), client)

    def states(self, job: Job) -> list[str]:
        return sorted(row["state"] for row in self.data(job).rows())


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fleet:
    monkeypatch.setattr(NotingJob, "needs_soc", set())
    monkeypatch.setattr(NotingJob, "fails", set())
    return Fleet(tmp_path, monkeypatch)


def with_soc(logs: list[FleetLog], soc_pct: float) -> list[FleetLog]:
    return [replace(logs[0], initial_soc_pct=soc_pct), *logs[1:]]


def test_a_log_set_aside_is_tried_again_with_its_soc(fleet: Fleet) -> None:
    job = NotingJob()
    job.needs_soc.add("a")
    assert fleet.run(job).bad == 1
    assert fleet.run(job).bad_before == 1
    again = fleet.run(job, *with_soc(fleet.logs(), 90.0))
    assert (again.done, again.skipped, again.bad) == (1, 2, 0)
    assert fleet.states(job) == ["a90", "b", "c"]


def test_reasons_that_differ_in_a_value_count_together(fleet: Fleet) -> None:
    job = NotingJob()
    job.needs_soc.update("ab")
    job.fails.add("c")
    assert fleet.run(job).reasons == {
        "SoC at start unknown (got 'a')": 2,
        "OSError: connection reset": 1,
    }
    counts = [(row["log"][-5:], number) for row, number in by_kind(fleet.data(job).rows(bad=True))]
    assert counts == [("a.txt", 2), ("c.txt", 1)]


def test_a_corrected_soc_is_computed_again(fleet: Fleet) -> None:
    job = NotingJob()
    fleet.run(job, *with_soc(fleet.logs(), 9.0))
    assert fleet.run(job, *with_soc(fleet.logs(), 90.0)).done == 1
    assert fleet.states(job) == ["a90", "b", "c"]


def test_a_log_of_another_vehicle_is_computed_again(fleet: Fleet) -> None:
    job = NotingJob()
    fleet.run(job)
    moved = [replace(log, vehicle="B") for log in fleet.logs()]
    assert fleet.run(job, *moved).done == 3
    assert fleet.run(job, *moved).skipped == 3


def test_a_touched_log_is_read_once(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    job = NotingJob()
    fleet.run(job)
    os.utime(fleet.root / "a.txt", (1.0, 1.0))
    assert fleet.run(job).skipped == 3
    known = fleet.data(job).known(run_id(job))
    assert {row["stamp"] for row in known.values()} == {
        job.chained_stamp("", log) for log in fleet.logs()
    }
    monkeypatch.setattr(fleet_run, "perform", pytest.fail)
    assert fleet.run(job).skipped == 3
    assert fleet.states(job) == ["a", "b", "c"]


def test_what_follows_a_failed_log_is_computed_again(fleet: Fleet) -> None:
    job = ChainedJob()
    job.fails.add("b")
    assert fleet.run(job).bad == 1
    assert fleet.states(job) == ["a", "ac"]
    job.fails.clear()
    assert fleet.run(job).done == 2
    assert fleet.states(job) == ["a", "ab", "abc"]
    assert fleet.run(job).skipped == 3


class Unprepared(NotingJob):
    """The same table with other options, under which nothing can be computed."""

    error: ClassVar[Exception] = InputError("no reference can be used", field="--reference")

    def identity(self) -> dict[str, Any]:
        return {"references": "other"}

    def prepared(self) -> Self:
        raise self.error


@pytest.mark.parametrize("error", [Unprepared.error, MemoryError("full")])
def test_a_job_that_cannot_be_prepared_writes_nothing(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    fleet.run(NotingJob())
    before = sorted(fleet.root.rglob("*.parquet"))
    monkeypatch.setattr(Unprepared, "error", error)
    with pytest.raises(CangaugeError, match=r"no reference can|MemoryError: full") as caught:
        fleet.run(Unprepared())
    assert caught.value.exit_code == getattr(error, "exit_code", 1)
    assert sorted(fleet.root.rglob("*.parquet")) == before
    assert fleet.run(NotingJob()).skipped == 3


def test_a_result_counts_whose_worker_is_lost_after_it(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    finished = Here.__next__

    def lost(client: Here) -> tuple[Done, Any]:
        done, result = finished(client)
        return replace(done, status="lost"), result

    monkeypatch.setattr(Here, "__next__", lost)
    assert fleet.run(NotingJob()).done == 3


def test_rows_are_written_while_a_task_takes_long(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock_s = [0.0]

    def pass_3_s(_: float) -> None:
        clock_s[0] += 3.0

    clock = SimpleNamespace(monotonic=lambda: clock_s[0], sleep=pass_3_s)
    monkeypatch.setattr(fleet_run, "time", clock)
    fleet.run(NotingJob())
    # a is done after 9 s, and due before b is done after 18 s.
    assert fleet.seen[3:6] == [[], [], ["a"]]
