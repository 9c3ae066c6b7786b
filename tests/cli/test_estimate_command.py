"""`cangauge estimate`: table, JSON contract, initial SoC, refusals; captures as live."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

from cangauge._resources import shared_file
from cangauge.bus.recording import read_log
from cangauge.bus.vehicle import Vehicle
from cangauge.cli.estimate import write_estimates
from cangauge.estimation.offline import estimate_log, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.offline import estimate_capture
from cangauge.types import Sample, reason_names
from cells_bus import ALL_CELLS, CELLS_DBC, CELLS_ON_BUS, all_cell_frames
from live import in_process, refused, succeeds

NUMBERS = [
    "soc_pct",
    "soc_std_pct",
    "soc_newton_pct",
    "soc_coulomb_pct",
    "voltage_model_v",
    "residual_v",
]


@pytest.fixture
def part(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Log:
    """The log part.csv, beside the model model.json in the working folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("part.csv", "model.json"):
        shutil.copy(made / name, tmp_path)
    return read_log("part.csv")


def read_table(path: str) -> pa.Table:
    return (pa.csv.read_csv if path.endswith(".csv") else pa.parquet.read_table)(path)


@pytest.mark.parametrize("out", ["soc.csv", "soc.parquet"])
def test_one_row_per_sample_bit_for_bit_and_its_scores(part: Log, out: str) -> None:
    found = succeeds("estimate", "part.csv", "-m", "model.json", "-o", out, "--json").json
    table = read_table(out)
    assert table.column_names == ["time_s", *NUMBERS, "status", "reasons"]
    assert part.soc_pct is not None
    settings = EstimatorSettings(initial_soc_pct=part.soc_pct[0], temperature_source="room")
    expected, _ = estimate_log(part, Model.load("model.json"), settings)
    assert table["time_s"].to_numpy().tolist() == part.time_s.tolist()
    for name in NUMBERS:
        assert table[name].to_numpy().tolist() == getattr(expected, name).tolist()
    assert set(table["status"].to_pylist()) == {"degraded", "valid"}
    words = [each or "" for each in table["reasons"].to_pylist()]
    assert words[0] == "delay line filling; soc uncertain"
    assert words == [reason_names(each) for each in expected.reasons.tolist()]
    assert (found["rows"], found["initial_soc_from"]) == (len(part), "log")
    assert found["soc_mae_pct"] < 1.0
    assert 0.0 <= found["cover_2sigma"] <= 1.0
    assert found["reasons"]["delay line filling"] == pytest.approx(70.0 / 1440.0, abs=1e-3)


def test_without_reference_the_scores_are_null(part: Log) -> None:
    write_log(replace(part, soc_pct=None), "bare.parquet")
    options = ("-m", "model.json", "-o", "soc.csv", "--report", "soc.html", "--json")
    found = succeeds("estimate", "bare.parquet", *options).json
    assert found["soc_mae_pct"] is None
    assert found["cover_2sigma"] is None
    assert found["initial_soc_from"] == "voltage"
    assert found["voltage_mae_pct"] < 1.0
    assert "no reference SoC" in Path("soc.html").read_text(encoding="utf-8")


def test_the_first_reference_is_counted_back_to_the_first_row(part: Log) -> None:
    assert part.soc_pct is not None
    late_pct = np.where(np.arange(len(part)) < 600, np.nan, part.soc_pct)
    write_log(replace(part, soc_pct=late_pct), "late.parquet")
    options = ("-m", "model.json", "-o", "soc.csv", "--capacity-ah", "51.5", "--json")
    found = succeeds("estimate", "late.parquet", *options).json
    assert found["initial_soc_pct"] == pytest.approx(part.soc_pct[0], abs=1e-6)


@pytest.mark.usefixtures("part")
@pytest.mark.parametrize(
    ("given", "start_pct", "origin", "doubt"),
    [
        ("auto", None, "voltage", ""),
        ("80.4", 80.4, "given", ""),
        ("55", 55.0, "given", "its own SoC is 80.0 %"),
        ("0.8", 0.8, "given", "a fraction is given in percent, as 80"),
    ],
)
def test_initial_soc(given: str, start_pct: float | None, origin: str, doubt: str) -> None:
    options = ("--initial-soc", given, "--initial-soc-std", "20", "--json")
    ran = succeeds("estimate", "part.csv", "-m", "model.json", "-o", "soc.parquet", *options)
    found = ran.json
    assert (found["initial_soc_pct"], found["initial_soc_from"]) == (start_pct, origin)
    counted = read_table("soc.parquet")["soc_coulomb_pct"].drop_null()[0].as_py()
    assert counted == pytest.approx(start_pct or 80.0, abs=1e-9 if start_pct else 10.0)
    assert doubt in ran.err
    assert ("the initial SoC is" in ran.err) is bool(doubt)


@pytest.mark.usefixtures("part")
@pytest.mark.parametrize("method", ["newton", "coulomb"])
def test_each_method_gives_its_own_soc(method: str) -> None:
    options = ("-m", "model.json", "-o", "soc.parquet", "--method", method)
    succeeds("estimate", "part.csv", *options)
    table = read_table("soc.parquet")
    assert table["soc_pct"].to_pylist() == table[f"soc_{method}_pct"].to_pylist()


@pytest.mark.parametrize("out", ["soc.csv", "soc.parquet"])
def test_unknown_values_are_empty(part: Log, out: str) -> None:
    voltage_v = np.where(np.arange(len(part)) < 5, 0.0, part.voltage_v)
    write_log(replace(part, voltage_v=voltage_v, soc_pct=None), "start.parquet")
    succeeds("estimate", "start.parquet", "-m", "model.json", "-o", out)
    table = read_table(out)
    assert table["soc_pct"].null_count == 60  # an implausible voltage drops the first block
    assert table["time_s"].to_numpy().tolist() == part.time_s.tolist()
    assert table["status"].to_pylist()[:61] == ["initialising"] * 60 + ["degraded"]
    assert b"nan" not in Path(out).read_bytes().lower() or out.endswith(".parquet")


def test_a_refused_sample_keeps_its_own_time(part: Log) -> None:
    log = part.rows(slice(0, 50))
    wild = replace(log, current_a=np.where(np.arange(50) == 20, 1e5, log.current_a))
    table, _ = estimate_log(wild, Model.load("model.json"), EstimatorSettings())
    assert table.time_s[20] == log.time_s[19]
    write_estimates(Path("soc.parquet"), wild.time_s, table, is_parquet=True)
    written = read_table("soc.parquet")
    assert written["time_s"].to_numpy().tolist() == log.time_s.tolist()
    assert "implausible input" in written["reasons"][20].as_py()
    assert written.equals(replace(table, time_s=wild.time_s).to_arrow())


@pytest.mark.usefixtures("part")
@pytest.mark.parametrize(("every", "gap_s"), [(1, 3.0), (5, 15.0)])
def test_only_a_slow_log_notes_its_gaps(made: Path, every: int, gap_s: float) -> None:
    write_log(read_log(made / "full.parquet").rows(slice(None, None, every)), "slow.parquet")
    options = ("-m", "model.json", "-o", "a.csv", "--json")
    ran = succeeds("estimate", "slow.parquet", *options)
    assert ran.json["max_gap_s"] == gap_s
    assert ("15 s count as gaps" in ran.err) is (every == 5)
    assert "current gap" not in ran.json["reasons"]


@pytest.mark.usefixtures("part")
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--method ukf", ["'--method': 'ukf' is not one of 'ekf', 'newton', 'coulomb'"]),
        ("--sign plus", ["'--sign': 'plus' is not one of 'charge', 'discharge'"]),
        ("--temperature warm", ["'--temperature': must be a valid number; see"]),
        ("--initial-soc half", ["--initial-soc", "half"]),
        ("--initial-soc 101", ["--initial-soc", "101"]),
        ("--initial-soc-std -1", ["--initial-soc-std", "-1"]),
        ("--capacity-ah 0", ["--capacity-ah"]),
        ("-o soc.txt", ["soc.txt", ".csv or .parquet"]),
        ("-o no/such/soc.csv", ["no/such/soc.csv"]),
        ("-o part.csv", ["part.csv", "also an input"]),
        ("-m none.json", ["none.json", "no such file"]),
        ("--pack pack.txt", ["--pack", ".csv or .parquet"]),
        ("--pack soc.csv", ["two outputs"]),
        ("--report soc.csv", ["--report", ".html"]),
    ],
)
def test_bad_options_get_one_line_and_write_nothing(
    tmp_path: Path, options: str, words: list[str]
) -> None:
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    usual = ("-m", "model.json", "-o", "soc.csv")
    refused(in_process("estimate", "part.csv", *usual, *options.split()), *words)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_log_of_another_pack_or_of_inverted_current_is_refused(part: Log) -> None:
    write_log(replace(part, voltage_v=part.voltage_v / 2.0), "half.parquet")
    write_log(replace(part, current_a=-part.current_a), "turned.parquet")
    given = ("-m", "model.json", "-o", "soc.csv")
    ran = in_process("estimate", "half.parquet", *given)
    refused(ran, "half.parquet", "voltage_v", "median", "-m")
    refused(in_process("estimate", "turned.parquet", *given), "turned.parquet", "current_a")
    assert not Path("soc.csv").exists()
    ran = in_process("fit", "turned.parquet", "-o", "new.json", "--capacity-ah", "51")
    refused(ran, "turned.parquet", "current_a", "multiply the column by -1")
    assert not Path("new.json").exists()


# --- Captures

CAPTURED_ROWS, EVERY_CELL = 300, 6
CAR = f'like = "generic"\ndbc = ["{shared_file("dbc", "generic_pack.dbc")}", "cells.dbc"]\n'


@pytest.fixture(scope="module")
def drive(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Minutes of a discharge as frames of the generic pack, with cells, the 12th of them lower."""
    log = read_log(made / "part.csv").rows(slice(CAPTURED_ROWS))
    assert log.soc_pct is not None
    path = tmp_path_factory.mktemp("capture") / "drive.log"
    encoder = FrameEncoder(Vehicle.load("generic"))
    with can.CanutilsLogWriter(path) as writer:
        for row, sample in enumerate(samples_of(log)):
            stamped = sample._replace(time_s=1e6 + sample.time_s)
            cells_v = [sample.voltage_v / CELLS_ON_BUS] * CELLS_ON_BUS
            cells_v[11] -= 0.030
            frames = encoder.encode(stamped, log.soc_pct[row])
            if row % EVERY_CELL == 0:
                frames += all_cell_frames(cells_v, stamped.time_s)
            for frame in frames:
                writer.on_message_received(frame)
    return path


@pytest.mark.usefixtures("part")
def test_a_capture_is_estimated_as_the_service_does(drive: Path) -> None:
    Path("cells.dbc").write_text(CELLS_DBC)
    Path("car.toml").write_text(CAR + ALL_CELLS)
    outputs = ("-o", "soc.parquet", "--pack", "pack.parquet", "--report", "soc.html")
    given = ("--map", "car.toml", "-m", "model.json", *outputs, "--json")
    found = succeeds("estimate", drive, *given).json
    assert found["initial_soc_from"] == "voltage"
    assert found["frames"]["lost"] == 0
    assert found["soc_mae_pct"] is not None
    table = read_table("soc.parquet")
    live = estimate_capture(drive, Vehicle.load(map="car.toml"), Model.load("model.json"))
    assert len(table) == found["rows"] == CAPTURED_ROWS
    for name in NUMBERS:
        assert np.array_equal(table[name].to_numpy(), getattr(live.table, name), equal_nan=True)
    assert live.report is not None
    report = json.loads(json.dumps(live.report.to_dict()))
    assert {name: found[name] for name in report} == report
    assert report["cells"]["weakest"] == 12
    assert read_table("pack.parquet")["cell_soc_pct"].to_pylist()[-1] == report["cells"]["soc_pct"]


@pytest.mark.usefixtures("part")
def test_a_capture_that_does_not_fit_is_refused(drive: Path) -> None:
    model = ("-m", "model.json", "-o", "soc.csv")
    for command, more in (("estimate", model), ("fit", ("-o", "x.json"))):
        words = ("CAN capture", "--vehicle generic matches it")
        refused(in_process(command, drive, *more), *words)
    for command, more in (("estimate", model), ("inspect", ())):
        ran = in_process(command, drive, "--vehicle", "generic", "--sign", "discharge", *more)
        refused(ran, "drive.log", "--sign", "under [current]")
    Path("turned.toml").write_text(
        'like = "generic"\ncurrent = {signal = "current_a", sign = -1}\ntemperature.fixed_c = 23\n'
    )
    ran = in_process("estimate", drive, "--map", "turned.toml", *model)
    refused(ran, "drive.log", "current_a", "sign = -1 under [current]")
    encoder = FrameEncoder(Vehicle.load("generic"))
    with can.CanutilsLogWriter("low.log") as writer:
        for k in range(100):
            for frame in encoder.encode(Sample(1e6 + k / 10.0, 10.0, 38.0 + k / 100.0, 23.0), 80.0):
                writer.on_message_received(frame)
    ran = in_process("estimate", "low.log", "--vehicle", "generic", *model)
    refused(ran, "low.log", "38 … 38.99 V", "but the model", "is of a pack of")
    assert not Path("soc.csv").exists()


@pytest.mark.real
@pytest.mark.nightly
def test_a_real_capture(shared_data: Path, project: Path, tmp_path: Path) -> None:
    capture = shared_data / "leaf_can" / "ZE0w24kWhstock.log.gz"
    model = project / "replay" / "leaf2012_published_model.json"
    outputs = ("-o", tmp_path / "soc.csv", "--report", tmp_path / "soc.html")
    given = ("--vehicle", "leaf_ze0", "-m", model, *outputs, "--json")
    found = succeeds("estimate", capture, *given).json
    assert found["frames"]["crc_errors"] == 0
    assert found["reasons"]["temperature source mismatch"] == 1.0
    assert found["rows"] == len(read_table(str(tmp_path / "soc.csv")))
