"""What the fleet commands print and write, with tasks in this process."""

from __future__ import annotations

import json
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from cangauge.extras.fleet import run as fleet_run
from cangauge.extras.fleet.gap import GapJob
from cangauge.extras.fleet.sources import FleetLog
from cangauge.extras.validation.cases import Scenario
from cangauge.logs.canonical import write_log
from cangauge.logs.read import read_log
from cangauge.model.model_file import Model
from fleet_here import Here
from live import Ended, in_process
from report_html import Html


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take this process for the cluster."""
    client = Here(monkeypatch, lambda: None)

    @contextmanager
    def connected(*_: object) -> Any:
        yield client

    monkeypatch.setattr(fleet_run, "connected", connected)


@pytest.fixture
def type_json(model: Model, tmp_path: Path) -> Path:
    model.save(tmp_path / "type.json")
    return tmp_path / "type.json"


def copied(log: FleetLog, to: Path) -> Path:
    to.parent.mkdir(parents=True, exist_ok=True)
    to.write_bytes(Path(log.url).read_bytes())
    return to


class Fit(NamedTuple):
    """`fleet fit` of the logs in a folder."""

    folder: Path
    capacity_ah: float

    def __call__(self, *more: object) -> Ended:
        return in_process(
            "fleet", "fit", f"{self.folder}/*/*", "-m", self.folder.parent / "new.json",
            "-o", self.folder.parent / "out", "--capacity-ah", self.capacity_ah, *more,
        )  # fmt: skip


@pytest.fixture
def fit(logs: list[FleetLog], scenario: Scenario, tmp_path: Path) -> Fit:
    folder = tmp_path / "logs"
    for number, log in enumerate(logs):
        copied(log, folder / log.vehicle / f"{number}.parquet")
    return Fit(folder, scenario.pack.capacity_ah)


def estimate(folder: Path, type_json: Path, *more: object) -> Ended:
    return in_process(
        "fleet", "estimate", f"{folder}/*/*", "-m", type_json, "-o", folder.parent / "out", *more
    )


def test_a_reason_is_printed_as_on_the_page(
    logs: list[FleetLog], type_json: Path, tmp_path: Path
) -> None:
    copied(logs[1], tmp_path / "logs" / "A" / "good.parquet")
    (tmp_path / "logs" / "A" / "head.csv").write_text("t,I,U,T\n")
    ended = estimate(tmp_path / "logs", type_json, "--report", tmp_path / "fleet.html")
    (printed,) = (line for line in ended.err.splitlines() if line.startswith("set aside: 1 × "))
    reason = printed.removeprefix("set aside: 1 × ")
    assert reason.count("; ") == 1  # problem and cure
    assert "head.csv" not in reason
    page = Html((tmp_path / "fleet.html").read_text(encoding="utf-8"))
    assert reason in page.text.replace("&#39;", "'").replace("&#34;", '"')


def test_results_of_deleted_and_renamed_logs_do_not_count(
    logs: list[FleetLog], type_json: Path, tmp_path: Path
) -> None:
    folder, page = tmp_path / "logs", tmp_path / "fleet.html"
    trip = copied(logs[1], folder / "A" / "trip.parquet")
    (folder / "A" / "junk.csv").write_text("nothing\n")
    first = estimate(folder, type_json, "--report", page, "--json")
    assert json.loads(first.out)["rows_elsewhere"] == 0
    trip.rename(folder / "A" / "renamed.parquet")
    (folder / "A" / "junk.csv").unlink()
    again = estimate(folder, type_json, "--report", page)
    assert "2 rows" in again.err
    text = Html(page.read_text(encoding="utf-8")).text
    assert "junk.csv" not in text
    assert "2 rows" in text
    tile = text[text.index("Logs estimated") - 200 : text.index("Logs estimated") + 200]
    assert ">1<" in tile


def test_the_vehicle_nearest_to_an_alarm_is_named(
    logs: list[FleetLog],
    type_json: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    row = {
        "logs": [log.url for log in logs[3:4]], "references": 1, "detected": False,
        "verdict": "voltage_gain", "probability": 0.41, "probability_none": 0.088,
        "group": "sensors_and_count", "group_probability": 0.82, "credible_set": [],
        "baseline_rmse_v": 3.4, "healthy_rmse_v": 1.04,
    }  # fmt: skip
    monkeypatch.setattr(GapJob, "row", lambda *_: row)
    arguments = (
        "fleet", "gap", logs[3].url, "--reference", logs[5].url, "-m", type_json,
        "-o", tmp_path / "out", "--report", tmp_path / "fleet.html",
    )  # fmt: skip
    ended = in_process(*arguments)
    assert "Vehicles with a gap" not in ended.out
    shown = "nearest: car1 (P(no fault) 9 %, sensors_and_count 82 %)"
    assert shown in ended.out
    assert shown in Html((tmp_path / "fleet.html").read_text(encoding="utf-8")).text
    found = json.loads(in_process(*arguments, "--json").out)
    assert (found["alarms"], found["nearest"]["vehicle"]) == ([], "car1")


def test_a_log_that_does_not_fit_the_others_is_named(
    logs: list[FleetLog], fit: Fit, tmp_path: Path
) -> None:
    recorded = read_log(logs[4].url)
    wrong = fit.folder / "car1" / "wrong.parquet"
    write_log(replace(recorded, voltage_v=1.02 * recorded.voltage_v), wrong)
    page = tmp_path / "fit.html"
    ended = fit("--report", page)
    assert ended.code == 0, ended.err
    assert f"--leave-out '{wrong}'" in ended.err
    assert "wrong.parquet" in ended.out
    text = Html(page.read_text(encoding="utf-8")).text
    assert f"1 of {len(logs) + 1} logs does not fit the others: {wrong}" in text
    found = json.loads(fit("--json").out)
    misfit = found["misfits"][0]
    assert (misfit["log"], misfit["vehicle"]) == (str(wrong), "car1")
    assert misfit["mean_v"] > 0.0
    without = json.loads(fit("--leave-out", wrong, "--json").out)
    assert (without["logs"], without["misfits"]) == (len(logs), [])
    assert without["voltage_rmse_v"] < found["voltage_rmse_v"]
    assert fit("--leave-out", logs[0].url).code == 2


def test_logs_of_another_temperature_source_do_not_stop_the_fit(
    logs: list[FleetLog], fit: Fit
) -> None:
    for log in (logs[2], logs[3]):
        other = fit.folder / log.vehicle / f"{logs.index(log)}.parquet"
        write_log(replace(read_log(other), temperature_source="coolant"), other)
    ended = fit()
    assert ended.code == 0, ended.err
    assert "left out: 2 × its temperature source is coolant" in ended.err
    assert "--temperature-source" in ended.err
    found = json.loads(fit("--json").out)
    assert found["logs"] == len(logs) - 2
    assert [each["log"][-9:] for each in found["left_out"]] == ["2.parquet", "3.parquet"]


def test_a_log_of_another_source_leaves_its_twin_in_the_fit(logs: list[FleetLog], fit: Fit) -> None:
    twin = copied(logs[3], fit.folder / "car0" / "a-twin.parquet")
    write_log(replace(read_log(twin), temperature_source="coolant"), twin)
    found = json.loads(fit("--json").out)
    assert found["logs"] == len(logs)
    assert [each["log"] for each in found["left_out"]] == [str(twin)]


def test_a_log_set_aside_as_another_vehicle_is_no_longer_listed(
    logs: list[FleetLog], fit: Fit
) -> None:
    recorded, changed = read_log(logs[4].url), fit.folder / "car1" / "changed.parquet"
    write_log(replace(recorded, soc_pct=None), changed)
    first = json.loads(fit("--json").out)
    assert [(each["log"], each["table"]) for each in first["bad"]] == [(str(changed), "sums")]
    assert json.loads(fit("--json").out)["bad"] == first["bad"]
    write_log(replace(recorded, voltage_v=recorded.voltage_v + 0.01), changed)
    again = json.loads(fit("--vehicle-pattern", "/(logs)/", "--json").out)
    assert (again["logs"], again["bad"]) == (len(logs) + 1, [])


def test_an_output_never_replaces_a_log(
    logs: list[FleetLog], fit: Fit, type_json: Path, tmp_path: Path
) -> None:
    log = copied(logs[1], fit.folder / "A" / "trip.html")
    before = log.read_bytes()
    for ended in (
        in_process("fleet", "fit", log, "-m", log, "-o", tmp_path / "out", "--capacity-ah", 60),
        fit("--report", log),
        estimate(fit.folder, type_json, "--report", log),
    ):
        assert ended.code == 2
        assert log.name in ended.err
    assert log.read_bytes() == before
