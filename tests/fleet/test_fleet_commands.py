"""What the fleet commands print and write, with tasks in this process."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import fsspec
import numpy as np
import pytest

from cangauge.bus.recording import read_log
from cangauge.extras.fleet.gap import GapJob
from cangauge.extras.fleet.jobs import Task
from cangauge.extras.fleet.outliers import ErrorsByLog
from cangauge.extras.fleet.overview import FleetOverview
from cangauge.extras.fleet.sources import FleetLog
from cangauge.extras.report.fleet import fleet_page
from cangauge.extras.validation.cases import Scenario
from cangauge.logs.canonical import write_log
from cangauge.model.model_file import Model
from live import Ended, in_process
from report_html import Html

pytestmark = pytest.mark.usefixtures("here")


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


def test_fleet_fit_is_the_fit_of_all_logs(fit: Fit, logs: list[FleetLog], model: Model) -> None:
    (fit.folder / "car3" / "broken.parquet").write_bytes(b"PAR1")
    ended = fit("--json")
    assert ended.code == 0, ended.err
    one_pass = json.loads(ended.out)["pass"]
    assert (one_pass["done"], one_pass["bad"]) == (len(logs), 1)
    found = Model.load(fit.folder.parent / "new.json")
    assert found.curve is not None
    assert model.curve is not None
    assert found.curve.voltage_v == pytest.approx(model.curve.voltage_v, rel=1e-9)
    for name, wanted in model.coefficients.items():
        assert found.coefficients[name].value == pytest.approx(wanted.value, rel=1e-6)
        assert found.coefficients[name].std_error == pytest.approx(wanted.std_error, rel=1e-6)
    assert found.range == model.range
    assert found.noise.level_std_v == pytest.approx(model.noise.level_std_v)
    assert found.noise.fast_std_v == pytest.approx(model.noise.fast_std_v)
    root, wanted_root = (np.array(each.information.root) for each in (found, model))
    assert np.allclose(np.abs(root), np.abs(wanted_root), atol=1e-9 * np.abs(wanted_root).max())
    assert found.made.fingerprint == model.made.fingerprint


def test_logs_and_results_live_in_any_storage(
    logs: list[FleetLog], type_json: Path, tmp_path: Path
) -> None:
    remote = fsspec.filesystem("memory")
    for log in logs[1:3]:
        remote.pipe_file(f"/drives/{log.vehicle}/{Path(log.url).name}", Path(log.url).read_bytes())
    arguments = (
        "fleet", "estimate", "memory://drives/*/*.parquet", "-m", type_json,
        "-o", "memory://results", "--report", tmp_path / "fleet.html", "--json",
    )  # fmt: skip
    ended = in_process(*arguments)
    assert ended.code == 0, ended.err
    assert json.loads(ended.out)["done"] == 2
    assert "Fleet of 1 vehicle<" in (tmp_path / "fleet.html").read_text(encoding="utf-8")
    assert json.loads(in_process(*arguments).out)["skipped"] == 2


def test_reason_and_no_result_at_all_are_told(
    logs: list[FleetLog], type_json: Path, tmp_path: Path
) -> None:
    page = tmp_path / "fleet.html"
    head = tmp_path / "logs" / "A" / "head.csv"
    head.parent.mkdir(parents=True)
    head.write_text("t,I,U,T\n")
    ended = estimate(tmp_path / "logs", type_json)
    assert (ended.code, "no result" in ended.err) == (1, True)
    copied(logs[1], tmp_path / "logs" / "A" / "good.parquet")
    assert estimate(tmp_path / "logs", type_json, "--report", page).code == 0
    (printed,) = (line for line in ended.err.splitlines() if line.startswith("set aside: 1 × "))
    reason = printed.removeprefix("set aside: 1 × ")
    assert "head.csv" not in reason
    text = Html(page.read_text(encoding="utf-8")).text
    assert reason in text.replace("&#39;", "'").replace("&#34;", '"')


def test_results_of_renamed_logs_do_not_count(
    logs: list[FleetLog], type_json: Path, tmp_path: Path
) -> None:
    trip = copied(logs[1], tmp_path / "logs" / "A" / "trip.parquet")
    assert estimate(tmp_path / "logs", type_json, "--json").code == 0
    named = [FleetLog(str(trip), "A", ""), FleetLog(str(trip) + "2", "A", "")]
    read = [FleetOverview.read(str(tmp_path / "out"), [log]).vehicles for log in named]
    assert read == [["A"], []]


def test_the_likeliest_gap_comes_first(
    logs: list[FleetLog], type_json: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def row(_: GapJob, task: Task) -> dict[str, Any]:
        return {
            "logs": [log.url for log in task.logs], "references": 1, "detected": False,
            "verdict": "voltage_gain", "probability": 0.41, "group": "sensors_and_count",
            "probability_none": 0.09 if task.vehicle == "car1" else 0.5, "credible_set": [],
            "group_probability": 0.82, "baseline_rmse_v": 3.4, "healthy_rmse_v": 1.04,
        }  # fmt: skip

    monkeypatch.setattr(GapJob, "_row", row)
    page = tmp_path / "fleet.html"
    ended = in_process(
        "fleet", "gap", logs[1].url, logs[3].url, "--reference", logs[5].url, "-m", type_json,
        "-o", tmp_path / "out", "--report", page,
    )  # fmt: skip
    assert "0 of 2 vehicles have a gap" in ended.out
    assert ended.out.index("car1") < ended.out.index("car0")
    assert "No significant gap in 2 vehicles." in Html(page.read_text(encoding="utf-8")).text


def test_a_log_that_does_not_fit_the_others_is_named(
    logs: list[FleetLog], fit: Fit, tmp_path: Path
) -> None:
    recorded = read_log(logs[4].url)
    wrong = fit.folder / "car1" / "wrong.parquet"
    write_log(replace(recorded, voltage_v=1.02 * recorded.voltage_v), wrong)
    page = tmp_path / "fit.html"
    ended = fit("--report", page)
    assert ended.code == 0, ended.err
    assert f"fit again without {wrong}" in ended.err
    assert "wrong.parquet" in ended.out
    text = Html(page.read_text(encoding="utf-8")).text
    assert f"1 of {len(logs) + 1} logs does not fit the others: {wrong}" in text
    found = json.loads(fit("--json").out)
    misfit = found["misfits"][0]
    assert (misfit["log"], misfit["vehicle"]) == (str(wrong), "car1")
    assert misfit["mean_v"] > 0.0
    wrong.unlink()
    without = json.loads(fit("--json").out)
    assert (without["logs"], without["misfits"]) == (len(logs), [])
    assert without["voltage_rmse_v"] < found["voltage_rmse_v"]


def test_few_logs_do_not_show_which_one_does_not_fit(model: Model) -> None:
    mean_v, names = np.array([0.1, 0.2, 0.0, 0.1, 30.0]), list("abcde")
    five = ErrorsByLog(names, names, mean_v, mean_v, np.full(5, 1e4), model.noise)
    assert five.misfits == [4]
    four = ErrorsByLog(names[1:], names[1:], mean_v[1:], mean_v[1:], np.full(4, 1e4), model.noise)
    assert (four.misfits, four.to_dict()) == ([], {"misfits": None})
    assert four.rule_text.startswith("Fewer than 5 logs")


def test_logs_of_another_source_and_twins_are_left_out(logs: list[FleetLog], fit: Fit) -> None:
    twin = copied(logs[3], fit.folder / "car0" / "a-twin.parquet")
    write_log(replace(read_log(twin), temperature_source="coolant"), twin)
    copied(logs[4], fit.folder / "car3" / "z-twin.parquet")
    found = json.loads(fit("--json").out)
    assert found["logs"] == len(logs)
    reasons = {Path(row["log"]).name: row["reason"] for row in found["left_out"]}
    assert reasons["a-twin.parquet"].startswith("its temperature source is coolant")
    assert reasons["z-twin.parquet"].startswith("same rows as")
    assert "left out: 1 × its temperature source is coolant" in fit().err


def test_a_log_without_soc_is_set_aside_until_it_changes(logs: list[FleetLog], fit: Fit) -> None:
    recorded, changed = read_log(logs[4].url), fit.folder / "car1" / "changed.parquet"
    write_log(replace(recorded, soc_pct=None), changed)
    first = json.loads(fit("--json").out)
    assert [(row["log"], row["table"]) for row in first["bad"]] == [(str(changed), "sums")]
    assert json.loads(fit("--json").out)["bad"] == first["bad"]
    write_log(replace(recorded, voltage_v=recorded.voltage_v + 0.01), changed)
    again = json.loads(fit("--json").out)
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


def test_the_page_says_which_vehicle_has_which_gap() -> None:
    gap = {
        "detected": True, "verdict": "voltage_offset", "probability": 0.9, "probability_none": 0.01,
        "baseline_rmse_v": 2.0, "healthy_rmse_v": 0.5, "closed_fraction": 0.8,
        "credible_set": ["voltage_offset"], "group": "sensors_and_count", "group_probability": 0.9,
    }  # fmt: skip
    rows: dict[str, list[dict[str, Any]]] = {
        f"car{k}": [
            {
                "end_s": end_s, "capacity_ah": 60.0 + 0.1 * k, "capacity_std_ah": 0.2,
                "resistance_ratio": 1.0, "resistance_std": 0.1, "offset_a": None,
                "offset_std_a": None,
            }
            for end_s in (3600.0, 9e4)
        ]
        for k in range(8)
    }  # fmt: skip
    rows["car3"][-1] |= {"capacity_ah": 50.0}
    rows["car5"][-1] |= {"capacity_ah": 50.0, "capacity_std_ah": 9.0}  # badly known
    found = FleetOverview(
        name="results",
        gaps={"car1": gap, "car2": gap | {"detected": False, "verdict": "none"}},
        health=rows,
        bad=[{"table": "estimate", "log": "x.csv", "reason": "x.csv: cut off"}],
    )
    ((vehicle, quantity, z),) = found.outlying
    assert (vehicle, quantity, z < -3.5) == ("car3", "capacity_ah", True)
    few = replace(found, health={name: rows[name] for name in list(rows)[:4]})
    assert (few.outlying, few.no_outlier_text[:5]) == ([], "Fewer")
    page = Html(fleet_page(found).html())
    assert not page.fetched
    assert "1 of 2 vehicles have a gap: car1 (voltage_offset)" in page.text
    assert "1 vehicle differs in health from the fleet: car3" in page.text
    assert "cut off" in page.text


def test_help_imports_no_engine() -> None:
    code = (
        "import sys; import cangauge, cangauge.extras.fleet.command\n"
        "print([m for m in sys.modules if m.split('.')[0] in {'dask', 'distributed', 'fsspec'}])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
