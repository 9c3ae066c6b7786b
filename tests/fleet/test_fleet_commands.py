"""What the fleet commands print and write, with tasks in this process."""

from __future__ import annotations

import json
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from cangauge.fleet import run as fleet_run
from cangauge.fleet.gap import GapJob
from cangauge.fleet.sources import FleetLog
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
        "family": "voltage_sensing", "family_probability": 0.82, "credible_set": [],
        "baseline_rmse_v": 3.4, "floor_v": 1.04,
    }  # fmt: skip
    monkeypatch.setattr(GapJob, "row", lambda *_: row)
    arguments = (
        "fleet", "gap", logs[3].url, "--reference", logs[5].url, "-m", type_json,
        "-o", tmp_path / "out", "--report", tmp_path / "fleet.html",
    )  # fmt: skip
    ended = in_process(*arguments)
    assert "Vehicles with a gap" not in ended.out
    shown = "nearest: car1 (P(no fault) 9 %, voltage_sensing 82 %)"
    assert shown in ended.out
    assert shown in Html((tmp_path / "fleet.html").read_text(encoding="utf-8")).text
    found = json.loads(in_process(*arguments, "--json").out)
    assert (found["alarms"], found["nearest"]["vehicle"]) == ([], "car1")
