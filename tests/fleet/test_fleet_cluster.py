"""The commands on a real scheduler with two worker processes, one of which is killed."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.fleet import run as fleet_run
from cangauge.extras.fleet.dataset import Dataset
from cangauge.extras.fleet.jobs import EstimateJob
from cangauge.extras.fleet.run import Summary, connected, perform, run_job
from cangauge.extras.fleet.sources import FleetLog, ReadOptions, find_logs
from cangauge.model.model_file import Model
from fleet_cluster import Cluster, wait_until
from live import in_process

pytest.importorskip("distributed")

VOLATILE = ("made_at", "seconds", "run", "stamp")


@pytest.fixture(scope="module")
def job(model: Model) -> EstimateJob:
    return EstimateJob(ReadOptions(), model, EstimatorSettings())


def results(data: Dataset) -> dict[str, dict[str, Any]]:
    return {
        row["log"]: {name: value for name, value in row.items() if name not in VOLATILE}
        for row in data.rows()
    }


def test_fleet_fit_is_the_fit_of_all_logs(
    cluster: Cluster, folder: Path, logs: list[FleetLog], model: Model, tmp_path: Path
) -> None:
    plain = model  # of `cangauge.fit` on the same logs
    (folder / "car3" / "broken.parquet").write_bytes(b"PAR1")
    try:
        ended = in_process(
            "fleet", "fit", f"{folder}/*/*.parquet", "-m", tmp_path / "type.json",
            "-o", tmp_path / "out", "--capacity-ah", plain.capacity_ah,
            "--scheduler", cluster.address, "--json",
        )  # fmt: skip
    finally:
        (folder / "car3" / "broken.parquet").unlink()
    assert ended.code == 0, ended.err
    one_pass = json.loads(ended.out)["pass"]
    assert (one_pass["done"], one_pass["bad"]) == (len(logs), 1)
    found = Model.load(tmp_path / "type.json")
    assert found.curve is not None
    assert plain.curve is not None
    assert found.curve.voltage_v == pytest.approx(plain.curve.voltage_v, rel=1e-9)
    for name, wanted in plain.coefficients.items():
        item = found.coefficients[name]
        assert item.value == pytest.approx(wanted.value, rel=1e-6)
        assert item.std_error == pytest.approx(wanted.std_error, rel=1e-6)
    assert found.range == plain.range
    assert found.noise.level_std_v == pytest.approx(plain.noise.level_std_v)
    assert found.noise.fast_std_v == pytest.approx(plain.noise.fast_std_v)
    root, wanted_root = (np.array(each.information.root) for each in (found, plain))
    assert np.allclose(np.abs(root), np.abs(wanted_root), atol=1e-9 * np.abs(wanted_root).max())
    assert found.made.fingerprint == plain.made.fingerprint


def test_a_killed_run_and_a_killed_worker_leave_a_complete_result(
    cluster: Cluster,
    logs: list[FleetLog],
    job: EstimateJob,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fleet_run, "FLUSH_S", 0.0)
    logs = logs[1:7]
    data = Dataset(str(tmp_path), job.kind, job.columns)
    finished: list[Summary] = []
    with connected(cluster.address) as client:
        thread = threading.Thread(target=lambda: finished.append(run_job(job, logs, data, client)))
        thread.start()
        wait_until(lambda: len(results(data)) >= 1)
        cluster.processes[1].kill()
        at_kill = len(results(data))
        thread.join(60.0)
    assert at_kill < len(logs)
    assert (finished[0].done, finished[0].bad) == (len(logs), 0)
    cluster.add_worker()
    found = results(data)
    for log in logs:
        wanted = perform(job, log, "", None).row
        assert wanted is not None
        assert {name: found[log.url][name] for name in wanted} == wanted
        assert found[log.url]["vehicle"] == log.vehicle


def test_an_interrupted_run_continues_and_a_changed_log_is_done_again(
    cluster: Cluster, logs: list[FleetLog], job: EstimateJob, tmp_path: Path
) -> None:
    few = logs[1:4]
    copies = []
    for number, log in enumerate(few):
        copy = tmp_path / "logs" / log.vehicle / f"{number}.parquet"
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(Path(log.url).read_bytes())
        copies.append(copy)
    data = Dataset(str(tmp_path / "out"), job.kind, job.columns)
    pattern = [f"{tmp_path}/logs/*/*.parquet"]
    with connected(cluster.address) as client:
        assert run_job(job, find_logs(pattern)[:2], data, client).done == 2
        rest = run_job(job, find_logs(pattern), data, client)
        assert (rest.skipped, rest.done) == (2, 1)
        before = results(data)
        copies[0].write_bytes(b"PAR1 cut off")
        copies[1].write_bytes(copies[1].read_bytes())  # touched, not changed
        again = run_job(job, find_logs(pattern), data, client)
        assert (again.skipped, again.done, again.bad) == (2, 0, 1)
        assert set(results(data)) == set(before) - {str(copies[0])}
        assert [row["log"] for row in data.rows(bad=True)] == [str(copies[0])]
        known = run_job(job, find_logs(pattern), data, client)
        assert (known.bad, known.bad_before) == (0, 1)


def test_no_result_at_all_is_a_failure(cluster: Cluster, model: Model, tmp_path: Path) -> None:
    model.save(tmp_path / "type.json")
    (tmp_path / "x.csv").write_text("nothing\n")
    ended = in_process(
        "fleet", "estimate", tmp_path / "x.csv", "-m", tmp_path / "type.json",
        "-o", tmp_path / "out", "--scheduler", cluster.address,
    )  # fmt: skip
    assert ended.code == 1
    assert "set aside: 1 ×" in ended.err
    assert "no result" in ended.err


def test_a_scheduler_that_does_not_answer_is_bad_input(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fleet_run, "CONNECT_S", 0.2)
    with (
        pytest.raises(InputError, match="no Dask scheduler answers"),
        connected("tcp://127.0.0.1:1"),
    ):
        pass


@pytest.fixture
def bucket(storage_port: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A bucket `drives` of a server with the interface of S3."""
    server = pytest.importorskip("moto.server")
    s3fs = pytest.importorskip("s3fs")
    endpoint = f"http://127.0.0.1:{storage_port}"
    monkeypatch.setitem(
        fsspec.config.conf, "s3", {"endpoint_url": endpoint, "key": "test", "secret": "test"}
    )
    running = server.ThreadedMotoServer(port=storage_port, verbose=False)
    running.start()
    fs = s3fs.S3FileSystem(skip_instance_cache=True)
    fs.mkdir("drives")
    yield fs
    running.stop()


def test_logs_and_results_live_in_object_storage(
    cluster: Cluster, bucket: Any, logs: list[FleetLog], model: Model, tmp_path: Path
) -> None:
    for log in logs[1:3]:
        bucket.put_file(log.url, f"drives/{log.vehicle}/{Path(log.url).name}")
    model.save(tmp_path / "type.json")
    arguments = (
        "fleet", "estimate", "s3://drives/*/*.parquet", "-m", tmp_path / "type.json",
        "-o", "s3://drives/results", "--scheduler", cluster.address,
        "--report", tmp_path / "fleet.html", "--json",
    )  # fmt: skip
    ended = in_process(*arguments)
    assert ended.code == 0, ended.err
    assert json.loads(ended.out)["done"] == 2
    assert "Fleet of 1 vehicle<" in (tmp_path / "fleet.html").read_text(encoding="utf-8")
    assert json.loads(in_process(*arguments).out)["skipped"] == 2
    data = Dataset("s3://drives/results", EstimateJob.kind, EstimateJob.columns)
    local = perform(EstimateJob(ReadOptions(), model, EstimatorSettings()), logs[1], "", None).row
    (row,) = (row for row in data.rows() if row["log"].endswith(Path(logs[1].url).name))
    assert local is not None
    assert row["end_soc_pct"] == local["end_soc_pct"]
    assert row["log"].startswith("s3://drives/car0/")


def test_help_imports_no_engine() -> None:
    code = (
        "import sys; import cangauge, cangauge.extras.fleet.command\n"
        "print([m for m in sys.modules if m.split('.')[0] in {'dask', 'distributed', 'fsspec'}])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == "[]"
