"""Rows by vehicle: what a repeated run computes again, what is set aside, what a job gives."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar
from urllib.error import HTTPError
from urllib.request import urlopen

import numpy as np
import pyarrow as pa
import pyarrow.dataset as pds
import pyarrow.parquet as pq
import pytest

from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.extras.fleet import run as fleet_run
from cangauge.extras.fleet.gap import GapJob, gap_tasks
from cangauge.extras.fleet.jobs import TEXT, EstimateJob, HealthJob, Job, Task, by_log, by_vehicle
from cangauge.extras.fleet.results import Results
from cangauge.extras.fleet.run import Summary, connected, perform, run_id, run_job
from cangauge.extras.fleet.sources import FleetLog, ReadOptions, find_logs
from cangauge.logs.canonical import write_log
from cangauge.model.model_file import Model

FAILS: dict[str, Exception] = {}
COMPUTED: list[str] = []


@dataclass(frozen=True, eq=False)
class NotingJob(Job):
    """Notes the names and starts of its logs; some fail."""

    options: ReadOptions = field(default_factory=ReadOptions)
    kind: ClassVar[str] = "noting"
    columns: ClassVar[dict[str, Any]] = {"text": TEXT}

    def identity(self) -> dict[str, Any]:
        return {}

    def row(self, log: FleetLog) -> dict[str, Any]:
        name = Path(log.url).stem
        COMPUTED.append(name)
        if name in FAILS:
            raise FAILS[name]
        return {"text": f"{name}{log.initial_soc_pct or ''}"}


class Fleet:
    """Logs a, b, c of a vehicle `A 1/7`, and the results of a job."""

    def __init__(self, root: Path, out: str, client: Any) -> None:
        self.root, self.out, self.client = root, out, client
        for name in "abc":
            (root / f"{name}.txt").write_text(name)

    def results(self, job: Job) -> Results:
        return Results(self.out, job.kind, job.columns)

    def logs(self) -> list[FleetLog]:
        return [replace(log, vehicle="A 1/7") for log in find_logs([f"{self.root}/*.txt"])]

    def run(self, *logs: FleetLog, job: Job | None = None, of: Any = by_log) -> Summary:
        COMPUTED.clear()
        job = job or NotingJob()
        return run_job(job, of(logs or self.logs()), self.results(job), self.client)

    def texts(self) -> list[str]:
        return sorted(row["text"] for row in self.results(NotingJob()).rows())


@pytest.fixture(params=["local", "memory"])
def fleet(request: pytest.FixtureRequest, tmp_path: Path, client: Any) -> Fleet:
    FAILS.clear()
    is_local = request.param == "local"
    return Fleet(tmp_path, str(tmp_path / "out") if is_local else f"memory://{tmp_path}", client)


def test_what_is_known_is_not_computed_again(fleet: Fleet) -> None:
    first = fleet.run()
    assert (first.done, first.skipped, fleet.texts()) == (3, 0, ["a", "b", "c"])
    assert (fleet.run().skipped, COMPUTED) == (3, [])
    (fleet.root / "b.txt").write_text("another")
    assert (fleet.run().done, COMPUTED) == (1, ["b"])
    logs = fleet.logs()
    assert fleet.run(replace(logs[0], initial_soc_pct=9.0), *logs[1:]).done == 1
    assert fleet.texts() == ["a9.0", "b", "c"]
    other = replace(NotingJob(), options=ReadOptions(described="other"))
    assert (fleet.run(job=other).done, fleet.texts()) == (3, ["a", "b", "c"])


@pytest.mark.parametrize("content", [b"PAR1 cut", None])
def test_a_file_in_the_results_that_is_not_theirs_is_named(
    tmp_path: Path, client: Any, content: bytes | None
) -> None:
    fleet = Fleet(tmp_path, str(tmp_path / "out"), client)
    fleet.run()
    (path,) = (tmp_path / "out" / "noting").rglob("*.parquet")
    if content is None:
        pq.write_table(pa.table({"other": [1]}), path)
    else:
        path.write_bytes(content)
    with pytest.raises(InputError, match=f"{path.name}.*delete it"):
        fleet.run()
    path.unlink()
    assert fleet.run().done == 3


def test_rows_are_a_hive_data_set(tmp_path: Path, client: Any) -> None:
    Fleet(tmp_path, str(tmp_path / "out"), client).run()
    table = pds.dataset(tmp_path / "out" / "noting", partitioning="hive").to_table().to_pydict()
    assert set(table["vehicle"]) == {"A 1/7"}
    assert sorted(table["text"]) == ["a", "b", "c"]


def test_a_log_is_either_done_or_set_aside(fleet: Fleet) -> None:
    results = fleet.results(NotingJob())
    FAILS.update(a=InputError("cut off", value="1"), b=InputError("cut off", value="2"))
    found = fleet.run()
    assert (found.done, found.bad, fleet.texts()) == (1, 2, ["c"])
    assert [*found.reasons.values()] == [2]  # one kind of reason
    assert [row["log"][-5:] for row in results.rows(bad=True)] == ["a.txt", "b.txt"]
    FAILS.clear()
    assert (fleet.run().bad_before, COMPUTED) == (2, [])  # another run would find it again
    for name in "ab":
        os.utime(fleet.root / f"{name}.txt", (1.0, 1.0))
    assert (fleet.run().done, fleet.texts()) == (2, ["a", "b", "c"])
    assert not [*results.rows(bad=True)]
    FAILS["c"] = InputError("cut off")
    os.utime(fleet.root / "c.txt", (1.0, 1.0))
    fleet.run()
    assert fleet.texts() == ["a", "b"]


def test_a_failure_beside_the_log_keeps_its_row_and_is_tried_again(fleet: Fleet) -> None:
    fleet.run()
    os.utime(fleet.root / "a.txt", (1.0, 1.0))
    FAILS["a"] = OSError("connection reset")
    found = fleet.run()
    assert found.reasons == {"OSError: connection reset": 1}
    assert fleet.texts() == ["a", "b", "c"]
    assert (fleet.run().bad, COMPUTED) == (1, ["a"])
    FAILS.clear()
    assert (fleet.run().done, COMPUTED) == (1, ["a"])


def test_rows_of_a_vehicles_task_come_and_go_together(fleet: Fleet) -> None:
    assert fleet.run(of=by_vehicle).done == 3
    assert fleet.run(of=by_vehicle).skipped == 3
    (fleet.root / "c.txt").unlink()
    assert fleet.run(of=by_vehicle).done == 2
    assert fleet.texts() == ["a", "b"]


def test_an_interrupted_run_keeps_what_it_has_written(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_run, "FLUSH_S", 0.0)
    put = Results.put

    def put_twice(results: Results, vehicle: str, finished: Any) -> None:
        put(results, vehicle, finished)
        if len(fleet.texts()) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(Results, "put", put_twice)
    with pytest.raises(KeyboardInterrupt):
        fleet.run()
    monkeypatch.undo()
    assert (fleet.run().skipped, len(fleet.texts())) == (2, 3)


@pytest.mark.nightly
def test_a_killed_worker_leaves_a_complete_result(
    logs: list[FleetLog], model: Model, tmp_path: Path
) -> None:
    pytest.importorskip("distributed")
    job = EstimateJob(ReadOptions(), model)
    results = Results(str(tmp_path), job.kind, job.columns)
    with connected("2") as client:
        killed: list[int] = []

        def kill(*_: object) -> Any:
            if not killed:
                killed.append(next(iter(client.run(os.getpid).values())))
                os.kill(killed[0], 9)
            return Results.put(results, *_)

        results.put = kill  # type: ignore[method-assign] # after the first result
        fleet_run.FLUSH_S, before = 0.0, fleet_run.FLUSH_S
        try:
            found = run_job(job, by_log(logs), results, client)
        finally:
            fleet_run.FLUSH_S = before
    assert (len(killed), found.done, found.bad) == (1, len(logs), 0)
    wanted = perform(job, by_log(logs)[1]).rows[0]
    row = next(row for row in results.rows() if row["log"] == logs[1].url)
    assert {name: row[name] for name in wanted} == wanted


def test_nobody_without_its_certificate_reaches_a_local_cluster() -> None:
    distributed = pytest.importorskip("distributed")
    with connected("1") as client:
        place = client.scheduler.address
        plain = place.replace("tls://", "tcp://")
        for address, security in (
            (plain, None),
            (place, distributed.Security.temporary()),  # a certificate, but not this one
        ):
            with pytest.raises(OSError, match=r"(?i)timed out|closed|certificate|unknown ca"):
                distributed.Client(address, security=security, timeout=1.0, set_as_default=False)
        for name in ("/status", "/info/main/workers.html"):
            page = client.cluster.dashboard_link.replace("/status", name)
            with pytest.raises(HTTPError, match="404"):
                urlopen(page, timeout=5.0)  # noqa: S310 - http


@pytest.mark.skipif(os.name != "posix", reason="no rights of other users")
def test_no_other_user_gives_a_local_cluster_modules_or_pickles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (tmp_path / "dask-scratch-space").mkdir()
    (tmp_path / "dask-scratch-space").chmod(0o777)  # as made by another user, before
    with connected("1") as client:
        (found,) = client.run(imports_from).values()
        folders = {Path(each) for each in (*found, *imports_from())}
        ours = {each for each in folders if each.is_relative_to(tmp_path)}
        (root,) = {tmp_path / each.relative_to(tmp_path).parts[0] for each in ours}
        assert stat.S_IMODE(root.stat().st_mode) == 0o700
    assert not root.exists()


def imports_from() -> list[str]:
    return sys.path


def test_a_scheduler_that_does_not_answer_is_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(fleet_run, "CONNECT_S", 0.2)
    with (
        pytest.raises(InputError, match="no Dask scheduler answers"),
        connected("tcp://127.0.0.1:1"),
    ):
        pass


# ---- jobs


def test_a_broken_log_is_set_aside_with_its_reason(tmp_path: Path, model: Model) -> None:
    job = EstimateJob(ReadOptions(), model)
    assert run_id(job) != run_id(replace(job, model=model.model_copy(update={"capacity_ah": 50.0})))
    broken = tmp_path / "broken.parquet"
    broken.write_bytes(b"PAR1")
    for path, words in ((broken, "cut off or damaged"), (tmp_path / "gone.csv", "no such file")):
        (row,) = perform(job, by_log([FleetLog(str(path), "v", "s")])[0]).bad
        assert row["reason"].startswith(f"{path}: ")
        assert words in row["reason"]
        assert row["is_final"]


def test_health_passes_from_log_to_log(logs: list[FleetLog], model: Model) -> None:
    job = HealthJob(ReadOptions(), model)
    trips = tuple(log for log in logs if log.vehicle == "car1")
    rows = perform(job, Task("car1", "car1", trips)).rows
    alone = perform(job, Task("car1", "car1", trips[1:])).rows[0]
    assert rows[1]["capacity_std_ah"] < alone["capacity_std_ah"]
    hours = (rows[1]["end_s"] - rows[0]["end_s"]) / 3600.0
    assert 8.0 < hours < 9.0  # parked over night
    dated = [
        replace(log, start=f"2024-05-01T08:{minute}:00Z")
        for log, minute in zip(trips, ("00", "10"), strict=True)
    ]
    (early,) = perform(job, Task("car1", "car1", tuple(dated))).bad
    assert "before the previous log of this vehicle ends" in early["reason"]


def test_references_come_from_all_vehicles(logs: list[FleetLog]) -> None:
    suspect = [log for log in logs if "trip1" in log.url]
    healthy = [replace(log, healthy=True) for log in logs if "trip1" not in log.url]
    tasks = {task.vehicle: task for task in gap_tasks([*suspect, *healthy])}
    chosen = [log.vehicle for log in tasks["car1"].references]
    assert (chosen[0], chosen.count("car1"), set(chosen)) == (
        "car1", 1, {"car0", "car1", "car2", "car3"},
    )  # fmt: skip
    assert replace(tasks["car1"], references=()).stamp != tasks["car1"].stamp
    many = [replace(suspect[0], url=f"{k}.csv") for k in range(5)]
    (latest,) = gap_tasks([*many, *healthy])
    assert latest.logs == tuple(many[-3:])
    again = gap_tasks([*suspect[::-1], *healthy])
    assert {task.vehicle: task for task in again} == tasks
    of_two = [log for log in healthy if log.vehicle in {"car0", "car1"}]
    without = gap_tasks([*suspect, *of_two])
    assert [task.vehicle for task in without] == ["car2", "car3", "car0", "car1"]
    assert without[0].references == without[1].references
    assert {log.vehicle for log in without[2].references} == {"car0", "car1"}
    for few, words in ((healthy, "every log is"), (suspect, "known to be healthy")):
        with pytest.raises(InputError, match=words):
            gap_tasks(few)


def test_logs_and_references_that_cannot_be_used_are_named(
    logs: list[FleetLog], model: Model, tmp_path: Path
) -> None:
    broken, dead = tmp_path / "broken.csv", tmp_path / "dead.parquet"
    broken.write_text("x\n")
    still = read_log(logs[6].url)
    write_log(replace(still, current_a=np.zeros(len(still))), dead)
    broken_log = FleetLog(str(broken), "car1", "s")
    dead_log = FleetLog(str(dead), "car0", "s", healthy=True)
    job = GapJob(ReadOptions(), model)
    good = [replace(log, healthy=True) for log in (dead_log, logs[5], logs[7])]
    (task,) = gap_tasks([logs[3], broken_log, *good])
    (row,) = perform(job, task).rows
    assert (row["log"], row["references"], row["reference_vehicles"]) == ("car1", 2, 2)
    assert row["unread"][0].startswith(str(broken))
    assert "constant" in row["unread"][1]
    (task,) = gap_tasks([logs[3], replace(broken_log, healthy=True), dead_log])
    (aside,) = perform(job, task).bad
    assert "no reference can be used" in aside["reason"]
    (task,) = gap_tasks([broken_log, good[1]])
    (aside,) = perform(job, task).bad
    assert "none of its logs can be read" in aside["reason"]
