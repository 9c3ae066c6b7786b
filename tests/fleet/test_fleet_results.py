"""Rows by vehicle: layout, what is known, settling, and what is set aside."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.dataset as pds
import pytest

from cangauge.errors import InputError
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.fleet.dataset import Dataset, keys_of
from cangauge.extras.fleet.gap import GapJob, suspect_and_healthy
from cangauge.extras.fleet.health import HealthJob, outliers
from cangauge.extras.fleet.jobs import REAL, EstimateJob
from cangauge.extras.fleet.outliers import ErrorsByLog
from cangauge.extras.fleet.overview import FleetOverview
from cangauge.extras.fleet.run import perform, run_id
from cangauge.extras.fleet.sources import FleetLog, ReadOptions
from cangauge.extras.report.fleet import fleet_page, fleet_report
from cangauge.logs.canonical import write_log
from cangauge.logs.read import read_log
from cangauge.model.model_file import Model
from report_html import Html

LOG = FleetLog("a.csv", "A 1/7", "s1")


def keyed(log: FleetLog, run: str = "r", **columns: Any) -> dict[str, Any]:
    return keys_of(log, run, "hash", 0.1) | columns


@pytest.fixture(params=["local", "memory"])
def out(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "local":
        return str(tmp_path / "out")
    return f"memory://{tmp_path.name}"


def test_rows_are_a_hive_data_set(tmp_path: Path) -> None:
    data = Dataset(str(tmp_path), "x", {"value": REAL})
    data.add([keyed(LOG, value=1.0), keyed(replace(LOG, vehicle="B"), value=2.0)])
    table = pds.dataset(tmp_path / "x", partitioning="hive").to_table().to_pydict()
    assert dict(zip(table["vehicle"], table["value"], strict=True)) == {"A 1/7": 1.0, "B": 2.0}


def test_the_latest_row_of_a_log_counts_after_settling(out: str) -> None:
    data = Dataset(out, "x", {"value": REAL})
    data.add([keyed(LOG, value=1.0)])
    data.add([keyed(LOG, value=2.0), keyed(replace(LOG, url="b.csv"), value=3.0)])
    assert data.known("r", "value")["a.csv"]["value"] == 2.0
    data.settle()
    assert sorted(row["value"] for row in data.rows()) == [2.0, 3.0]
    before = [*data.rows()]
    data.settle()
    assert [*data.rows()] == before


def test_a_log_is_either_done_or_set_aside(out: str) -> None:
    data = Dataset(out, "x", {"value": REAL})
    data.add([keyed(LOG, reason="cut off", is_final=True)], bad=True)
    assert "a.csv" in data.known("r")
    data.add([keyed(LOG, value=1.0)])
    data.settle()
    assert not [*data.rows(bad=True)]
    data.add([keyed(LOG, reason="cut off", is_final=True)], bad=True)
    data.settle()
    assert not [*data.rows()]
    assert data.known("another") == {}


def test_a_failure_beside_the_log_keeps_its_row(out: str) -> None:
    data = Dataset(out, "x", {"value": REAL})
    data.add([keyed(LOG, value=1.0)])
    for _ in range(2):
        data.add([keyed(LOG, run="other", reason="lost", is_final=False)], bad=True)
        data.settle()
        assert [row["value"] for row in data.rows()] == [1.0]
        assert [row["reason"] for row in data.rows(bad=True)] == ["lost"]
        assert set(data.known("r")) == {"a.csv"}
        assert data.known("other") == {}
    data.add([keyed(LOG, run="other", value=2.0)])
    data.settle()
    assert [row["value"] for row in data.rows()] == [2.0]
    assert not [*data.rows(bad=True)]


def test_what_a_killed_run_was_writing_is_ignored(tmp_path: Path) -> None:
    data = Dataset(str(tmp_path), "x", {"value": REAL})
    data.add([keyed(LOG, value=1.0)])
    (path,) = tmp_path.rglob("*.parquet")
    path.with_name(".3f2c.a1b2.parquet").write_bytes(b"PAR1")
    assert [row["value"] for row in data.rows()] == [1.0]
    data.settle()
    assert set(data.known("r")) == {"a.csv"}


def test_two_runs_settle_at_the_same_time(out: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data, other = (Dataset(out, "x", {"value": REAL}) for _ in range(2))
    for k in range(3):
        data.add([keyed(replace(LOG, url=f"{k}.csv"), value=float(k))])
    listed = data._files("x")
    other.settle()
    monkeypatch.setattr(data, "_files", lambda table: listed if table == "x" else [])
    assert not [*data.rows()]
    data.settle()
    assert sorted(row["value"] for row in other.rows()) == [0.0, 1.0, 2.0]


def test_what_fails_is_a_reason_not_an_error(
    tmp_path: Path, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = EstimateJob(ReadOptions(), model, EstimatorSettings())
    broken = tmp_path / "broken.parquet"
    broken.write_bytes(b"PAR1")
    found = perform(job, FleetLog(str(broken), "v", "s"), "", None)
    assert (found.row, found.is_final) == (None, True)
    assert found.reason.startswith(str(broken))
    gone = perform(job, FleetLog(str(tmp_path / "gone.csv"), "v", "s"), "", None)
    assert "no such file" in gone.reason

    def fail(*_: object) -> dict[str, Any]:
        raise OSError("connection reset")

    monkeypatch.setattr(EstimateJob, "row", fail)
    lost = perform(job, FleetLog(str(broken), "v", "s"), "", None)
    assert not lost.is_final
    assert "OSError: connection reset" in lost.reason


def test_the_same_content_is_not_computed_again(logs: list[FleetLog], model: Model) -> None:
    job = EstimateJob(ReadOptions(), model, EstimatorSettings())
    first = perform(job, logs[1], "", None)
    again = perform(job, replace(logs[1], stamp="touched"), first.sha256, None)
    assert again.row is None
    assert not again.reason
    other = EstimateJob(ReadOptions(), model, EstimatorSettings(capacity_ah=50.0))
    assert run_id(other) != run_id(job) == run_id(replace(job))


def test_health_passes_from_log_to_log(logs: list[FleetLog], model: Model) -> None:
    job = HealthJob(ReadOptions(), model, EstimatorSettings())
    trips = [log for log in logs if log.vehicle == "car1"]
    rows: list[dict[str, Any]] = []
    state = None
    for log in trips:
        done = perform(job, log, "", state)
        assert done.row, done.reason
        rows.append(done.row)
        state = rows[-1]["state"]
    alone = perform(job, trips[1], "", None).row or {}
    assert rows[1]["capacity_std_ah"] < alone["capacity_std_ah"]
    assert [row["end_s"] for row in rows] == sorted(row["end_s"] for row in rows)
    dated = replace(trips[0], start="2024-05-01T08:00:00Z")
    first = perform(job, dated, "", None).row or {}
    early = perform(job, replace(trips[1], start="2024-05-01T08:10:00Z"), "", first["state"])
    assert "before the previous log of this vehicle ends" in early.reason


def test_one_vehicle_apart_from_the_others_is_an_outlier() -> None:
    rows = {
        f"v{k}": {
            "capacity_ah": 60.0 + 0.1 * k, "capacity_std_ah": 0.2,
            "resistance_ratio": 1.0, "resistance_std": 0.05, "offset_a": None, "offset_std_a": None,
        }
        for k in range(8)
    }  # fmt: skip
    rows["v3"] |= {"capacity_ah": 50.0}
    rows["v5"] |= {"capacity_ah": 50.0, "capacity_std_ah": 9.0}  # badly known
    z = outliers(rows)
    assert set(z) == {"capacity_ah", "resistance_ratio"}
    assert z["capacity_ah"]["v3"] < -3.5 < z["capacity_ah"]["v5"] < 0.0
    assert outliers({name: rows[name] for name in list(rows)[:4]}) == {}


def test_few_logs_do_not_show_which_one_does_not_fit() -> None:
    names, zeros = [f"{k}.csv" for k in range(5)], np.zeros(5)
    mean_v = np.array([0.1, 0.2, 0.0, 0.1, 3.0])
    five = ErrorsByLog(names, names, mean_v, zeros, mean_v)
    assert five.misfits == [4]
    four = ErrorsByLog(names[1:], names[1:], mean_v[1:], zeros[1:], mean_v[1:])
    assert four.misfits == []
    assert four.to_dict() == {"misfits": None}
    assert four.rule_text.startswith("Fewer than 5 logs")


def test_references_come_from_all_vehicles(logs: list[FleetLog], model: Model) -> None:
    marked = [replace(log, healthy="trip1" not in log.url) for log in logs]
    suspect, healthy = suspect_and_healthy(marked, 1)
    job = GapJob(ReadOptions(), model, references=5)
    found = {each.vehicle: each for each in job.vehicles(suspect, healthy)}
    chosen = found["car1"].references
    assert chosen[0].vehicle == "car1"
    assert [log.vehicle for log in chosen].count("car1") == 1
    assert {log.vehicle for log in chosen} == {"car0", "car1", "car2", "car3"}
    assert job.vehicles(dict(reversed(suspect.items())), healthy) == [*found.values()]
    with pytest.raises(InputError, match="known to be healthy"):
        suspect_and_healthy(logs, 1)


def test_a_vehicle_without_own_references_has_the_common_ones(
    logs: list[FleetLog], model: Model, tmp_path: Path
) -> None:
    broken = tmp_path / "broken.csv"
    broken.write_text("x\n")
    suspect = {"car1": (logs[3], FleetLog(str(broken), "car1", "s"))}
    dead = tmp_path / "dead.parquet"
    still = read_log(logs[6].url)
    write_log(replace(still, current_a=np.zeros(len(still))), dead)
    healthy = {"car0": (FleetLog(str(dead), "car0", "s"),), "car2": (logs[5],), "car3": (logs[7],)}
    job = GapJob(ReadOptions(), model, references=3).with_common(suspect, healthy)
    (vehicle,) = job.vehicles(suspect, healthy)
    assert len(job.common) == 3
    assert not vehicle.references
    row = perform(job.prepared(), vehicle, "", None).row
    assert row is not None
    assert (row["references"], row["reference_vehicles"]) == (2, 2)
    assert row["unread"][0].startswith(str(broken))
    assert "constant" in row["unread"][1]


def test_nothing_is_learned_for_vehicles_with_own_references(
    logs: list[FleetLog], model: Model
) -> None:
    suspect, healthy = {"car1": (logs[3],)}, {"car1": (logs[4],), "car2": (logs[5],)}
    job = GapJob(ReadOptions(), model).with_common(suspect, healthy)
    assert job.common == ()
    assert job.prepared() is job


def test_the_page_says_which_vehicle_has_which_gap() -> None:
    gap = {
        "detected": True, "verdict": "voltage_offset", "probability": 0.9, "probability_none": 0.01,
        "baseline_rmse_v": 2.0, "healthy_rmse_v": 0.5, "closed_fraction": 0.8,
        "credible_set": ["voltage_offset"], "group": "sensors_and_count", "group_probability": 0.9,
    }  # fmt: skip
    healthy = {
        "end_s": 3600.0, "capacity_ah": 60.0, "capacity_std_ah": 1.0, "resistance_ratio": 1.0,
        "resistance_std": 0.1, "offset_a": 0.0, "offset_std_a": 0.1,
    }  # fmt: skip
    found = FleetOverview(
        name="results",
        gaps={"car1": gap, "car2": gap | {"detected": False, "verdict": "none"}},
        health={f"car{k}": [healthy, healthy | {"end_s": 9e4}] for k in range(6)},
        z={"capacity_ah": {"car4": -5.0}},
        bad=[{"table": "estimate", "log": "x.csv", "reason": "x.csv: cut off"}],
    )
    page = Html(fleet_report(found))
    assert not page.fetched
    text = page.text
    assert "1 of 2 vehicles have a gap: car1 (voltage_offset)" in text
    assert "1 differ in their health from the fleet: car4" in text
    assert "cut off" in text
    assert len(fleet_page(found).figures) == 4
