"""`cangauge estimate`: table, JSON contract, initial SoC, refusals; captures as live."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

from cangauge.bus.vehicle import Vehicle
from cangauge.cli.estimate import write_estimates
from cangauge.estimation.offline import estimate_log, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.logs.canonical import write_log
from cangauge.logs.read import read_log
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.offline import estimate_capture
from cangauge.types import Sample, reason_names

Run = Callable[..., object]

COLUMNS = [
    "time_s",
    "soc_pct",
    "soc_std_pct",
    "soc_newton_pct",
    "soc_coulomb_pct",
    "voltage_model_v",
    "residual_v",
    "status",
    "reasons",
]
CONTRACT = {
    "rows",
    "seconds",
    "voltage_mae_pct",
    "soc_mae_pct",
    "soc_max_pct",
    "soc_newton_mae_pct",
    "soc_coulomb_mae_pct",
    "cover_2sigma",
}


def refused(ran: object, *words: str) -> None:
    assert ran.code == 2
    assert ran.out == ""
    errors = [line for line in ran.err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    for word in words:
        assert word in errors[0]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_one_row_per_sample_bit_for_bit(run: Run, made: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"soc{suffix}"
    ran = run("estimate", made / "part.csv", "-m", made / "model.json", "-o", out)
    assert ran.code == 0, ran.err
    read = pa.csv.read_csv if suffix == ".csv" else pa.parquet.read_table
    table = read(out)
    assert table.column_names == COLUMNS
    log = read_log(made / "part.csv")
    settings = EstimatorSettings(initial_soc_pct=log.soc_pct[0], temperature_source="room")
    expected, _ = estimate_log(log, Model.load(made / "model.json"), settings)
    assert table["time_s"].to_numpy().tolist() == log.time_s.tolist()
    for name in COLUMNS[1:7]:
        assert table[name].to_numpy().tolist() == getattr(expected, name).tolist()
    assert set(table["status"].to_pylist()) == {"degraded", "valid"}
    words = [each or "" for each in table["reasons"].to_pylist()]
    assert words[0] == "delay line filling; soc uncertain"
    assert words == [reason_names(each) for each in expected.reasons.tolist()]


def test_json_is_one_object_that_keeps_the_contract(run: Run, made: Path, tmp_path: Path) -> None:
    out = tmp_path / "soc.csv"
    ran = run("estimate", made / "part.csv", "-m", made / "model.json", "-o", out, "--json")
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    assert set(found) >= CONTRACT
    assert found["rows"] == len(read_log(made / "part.csv"))
    assert found["initial_soc_from"] == "log"
    assert found["soc_mae_pct"] < 1.0
    assert 0.0 <= found["cover_2sigma"] <= 1.0
    assert found["reasons"]["delay line filling"] == pytest.approx(70.0 / 1440.0, abs=1e-3)


def test_without_reference_the_scores_are_null(run: Run, made: Path, tmp_path: Path) -> None:
    log = replace(read_log(made / "part.csv"), soc_pct=None)
    write_log(log, tmp_path / "bare.parquet")
    ran = run(
        "estimate", tmp_path / "bare.parquet", "-m", made / "model.json", "-o",
        tmp_path / "soc.csv", "--report", tmp_path / "soc.html", "--json",
    )  # fmt: skip
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    assert found["soc_mae_pct"] is None
    assert found["cover_2sigma"] is None
    assert found["initial_soc_from"] == "voltage"
    assert found["voltage_mae_pct"] < 1.0
    assert "no reference SoC" in (tmp_path / "soc.html").read_text(encoding="utf-8")


def test_the_first_reference_is_counted_back_to_the_first_row(
    run: Run, made: Path, tmp_path: Path
) -> None:
    log = read_log(made / "part.csv")
    soc = log.soc_pct.copy()
    soc[:600] = np.nan
    write_log(replace(log, soc_pct=soc), tmp_path / "late.parquet")
    ran = run(
        "estimate", tmp_path / "late.parquet", "-m", made / "model.json", "-o",
        tmp_path / "soc.csv", "--capacity-ah", "51.5", "--json",
    )  # fmt: skip
    assert json.loads(ran.out)["initial_soc_pct"] == pytest.approx(log.soc_pct[0], abs=1e-6)


@pytest.mark.parametrize(
    "case",
    [
        ("auto", None, "voltage", ""),
        ("80.4", 80.4, "given", ""),
        ("55", 55.0, "given", "its own SoC is 80.0 %"),
        ("0.8", 0.8, "given", "a fraction is given in percent, as 80"),
    ],
)
def test_initial_soc(
    run: Run, made: Path, tmp_path: Path, case: tuple[str, float | None, str, str]
) -> None:
    given, start, origin, doubt = case
    ran = run(
        "estimate", made / "part.csv", "-m", made / "model.json", "-o", tmp_path / "soc.parquet",
        "--initial-soc", given, "--initial-soc-std", "20", "--json",
    )  # fmt: skip
    found = json.loads(ran.out)
    assert (found["initial_soc_pct"], found["initial_soc_from"]) == (start, origin)
    counted = (
        pa.parquet.read_table(tmp_path / "soc.parquet")["soc_coulomb_pct"].drop_null()[0].as_py()
    )
    assert counted == pytest.approx(start or 80.0, abs=1e-9 if start else 10.0)
    assert doubt in ran.err
    assert ("the initial SoC is" in ran.err) is bool(doubt)


def test_each_method_gives_its_own_soc(run: Run, made: Path, tmp_path: Path) -> None:
    for method in ("newton", "coulomb"):
        out = tmp_path / f"{method}.parquet"
        ran = run(
            "estimate", made / "part.csv", "-m", made / "model.json", "-o", out, "--method", method
        )
        assert ran.code == 0, ran.err
        table = pa.parquet.read_table(out)
        assert table["soc_pct"].to_pylist() == table[f"soc_{method}_pct"].to_pylist()


def test_unknown_values_are_empty(run: Run, made: Path, tmp_path: Path) -> None:
    log = read_log(made / "part.csv")
    volts = log.voltage_v.copy()
    volts[:5] = 0.0
    write_log(replace(log, voltage_v=volts, soc_pct=None), tmp_path / "start.parquet")
    for suffix, read in ((".csv", pa.csv.read_csv), (".parquet", pa.parquet.read_table)):
        out = tmp_path / f"soc{suffix}"
        ran = run("estimate", tmp_path / "start.parquet", "-m", made / "model.json", "-o", out)
        assert ran.code == 0, ran.err
        table = read(out)
        assert table["soc_pct"].null_count == 60  # an implausible voltage drops the first block
        assert table["time_s"].to_numpy().tolist() == log.time_s.tolist()
        assert table["status"].to_pylist()[:61] == ["initialising"] * 60 + ["degraded"]
    assert "nan" not in (tmp_path / "soc.csv").read_text(encoding="utf-8").lower()


def test_a_refused_sample_keeps_its_own_time(made: Path, tmp_path: Path) -> None:
    log = read_log(made / "part.csv").rows(slice(0, 50))
    amperes = log.current_a.copy()
    amperes[20] = 1e5
    wild = replace(log, current_a=amperes)
    table, _ = estimate_log(wild, Model.load(made / "model.json"), EstimatorSettings())
    assert table.time_s[20] == log.time_s[19]
    write_estimates(tmp_path / "soc.parquet", wild.time_s, table)
    written = pa.parquet.read_table(tmp_path / "soc.parquet")
    assert written["time_s"].to_numpy().tolist() == log.time_s.tolist()
    assert "implausible input" in written["reasons"][20].as_py()
    assert written.equals(replace(table, time_s=wild.time_s).to_arrow())


def test_a_slow_log_has_no_gaps_by_default(run: Run, made: Path, tmp_path: Path) -> None:
    log = read_log(made / "full.parquet")
    write_log(log.rows(slice(None, None, 5)), tmp_path / "slow.parquet")
    args = ("estimate", tmp_path / "slow.parquet", "-m", made / "model.json", "--json")
    usual = run(*args, "-o", tmp_path / "a.csv")
    assert json.loads(usual.out)["max_gap_s"] == 15.0
    assert "its usual step is 5 s; steps over 15 s count as gaps" in usual.err
    assert "current gap" not in json.loads(usual.out)["reasons"]


def test_a_log_of_one_second_needs_no_note_of_gaps(run: Run, made: Path, tmp_path: Path) -> None:
    args = ("estimate", made / "full.parquet", "-m", made / "model.json", "--json")
    ran = run(*args, "-o", tmp_path / "a.csv")
    assert json.loads(ran.out)["max_gap_s"] == 3.0
    assert "count as gaps" not in ran.err


@pytest.mark.parametrize(
    "case",
    [
        (["--method", "ukf"], ["'--method'", "'ukf' is not one of 'ekf', 'newton', 'coulomb'"]),
        (["--initial-soc", "half"], ["--initial-soc", "half"]),
        (["--initial-soc", "101"], ["--initial-soc", "101"]),
        (["--initial-soc-std", "-1"], ["--initial-soc-std", "-1"]),
        (["--capacity-ah", "0"], ["--capacity-ah"]),
        (["-o", "soc.txt"], ["soc.txt", ".csv, .parquet or .mcap"]),
        (["--pack", "pack.mcap"], ["--pack", ".csv or .parquet"]),
        (["--report", "soc.csv"], ["--report", ".html"]),
        (["-o", "no/such/soc.csv"], ["no/such/soc.csv"]),
        (["-m", "none.json"], ["none.json", "no such file"]),
        (["--pack", "soc.csv"], ["two outputs"]),
    ],
)
def test_bad_options_get_one_line_and_write_nothing(
    run: Run,
    made: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    case: tuple[list[str], list[str]],
) -> None:
    options, words = case
    monkeypatch.chdir(tmp_path)
    usual = ["-m", made / "model.json", "-o", "soc.csv"]
    ran = run("estimate", made / "part.csv", *usual, *options)
    refused(ran, *words)
    assert list(tmp_path.iterdir()) == []


def test_the_model_of_another_pack_is_refused(run: Run, made: Path, tmp_path: Path) -> None:
    log = read_log(made / "part.csv")
    write_log(replace(log, voltage_v=log.voltage_v / 2.0), tmp_path / "half.parquet")
    out = tmp_path / "soc.csv"
    ran = run("estimate", tmp_path / "half.parquet", "-m", made / "model.json", "-o", out)
    refused(ran, "half.parquet", "voltage_v", "median", "-m")
    assert not out.exists()


def test_turned_current_is_refused(run: Run, made: Path, tmp_path: Path) -> None:
    log = read_log(made / "part.csv")
    write_log(replace(log, current_a=-log.current_a), tmp_path / "turned.parquet")
    out = tmp_path / "soc.csv"
    ran = run("estimate", tmp_path / "turned.parquet", "-m", made / "model.json", "-o", out)
    refused(ran, "turned.parquet", "current_a")
    assert not out.exists()


def test_outputs_must_not_overwrite_input(run: Run, made: Path) -> None:
    before = (made / "part.csv").read_bytes()
    ran = run("estimate", made / "part.csv", "-m", made / "model.json", "-o", made / "part.csv")
    refused(ran, "also an input")
    assert (made / "part.csv").read_bytes() == before


@pytest.fixture(scope="module")
def capture(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Part of a discharge, as frames of the generic pack."""
    log = read_log(made / "part.csv")
    path = tmp_path_factory.mktemp("capture") / "drive.log"
    encoder = FrameEncoder(Vehicle.load("generic"))
    with can.Logger(path) as writer:
        for sample, soc in zip(samples_of(log), log.soc_pct.tolist(), strict=True):
            for frame in encoder.encode(sample, soc):
                frame.timestamp = 1e6 + sample.time_s
                writer.on_message_received(frame)
    return path


def test_a_capture_is_estimated_as_the_service_does(
    run: Run, made: Path, tmp_path: Path, capture: Path
) -> None:
    out = tmp_path / "soc.parquet"
    ran = run(
        "estimate", capture, "--vehicle", "generic", "-m", made / "model.json", "-o", out,
        "--report", tmp_path / "soc.html", "--json",
    )  # fmt: skip
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    assert found["initial_soc_from"] == "voltage"
    assert found["frames"]["lost"] == 0
    assert found["soc_mae_pct"] is not None
    table = pa.parquet.read_table(out)
    live = estimate_capture(capture, Vehicle.load("generic"), Model.load(made / "model.json")).table
    assert len(table) == found["rows"] == len(read_log(made / "part.csv"))
    for name in COLUMNS[1:7]:
        assert np.array_equal(table[name].to_numpy(), getattr(live, name), equal_nan=True)


@pytest.mark.parametrize("command", ["estimate", "inspect"])
def test_sign_of_a_capture_is_refused(
    run: Run, made: Path, tmp_path: Path, capture: Path, command: str
) -> None:
    more = ("-m", made / "model.json", "-o", tmp_path / "soc.csv") if command == "estimate" else ()
    ran = run(command, capture, "--vehicle", "generic", "--sign", "discharge", *more)
    refused(ran, "drive.log", "--sign", "under [current]")


def test_a_capture_of_another_pack_is_refused(run: Run, made: Path, tmp_path: Path) -> None:
    encoder = FrameEncoder(Vehicle.load("generic"))
    with can.Logger(tmp_path / "low.log") as writer:
        for k in range(100):
            for frame in encoder.encode(Sample(1e6 + k / 10.0, 10.0, 38.0 + k / 100.0, 23.0), 80.0):
                writer.on_message_received(frame)
    model = ("-m", made / "model.json", "-o", tmp_path / "soc.csv")
    ran = run("estimate", tmp_path / "low.log", "--vehicle", "generic", *model)
    refused(ran, "low.log", "38 … 38.99 V", "but the model", "is of a pack of")
    assert not (tmp_path / "soc.csv").exists()


def test_turned_current_in_a_capture_is_refused(
    run: Run, made: Path, tmp_path: Path, capture: Path
) -> None:
    model = ("-m", made / "model.json", "-o", tmp_path / "soc.csv")
    for command in ("estimate", "fit"):
        more = model if command == "estimate" else ("-o", tmp_path / "x.json")
        refused(run(command, capture, *more), "CAN capture", "--vehicle generic matches it")
    vehicle = Vehicle.load("generic")
    current = vehicle.current
    text = f"""
name = "turned"
dbc = ["{vehicle.dbc_files[0]}"]
[current]
message = "{current.message}"
signal = "{current.codec.name}"
sign = -1
[voltage]
message = "{vehicle.voltage.message}"
signal = "{vehicle.voltage.codec.name}"
[temperature]
fixed_c = 23.0
"""
    (tmp_path / "turned.toml").write_text(text, encoding="utf-8")
    ran = run("estimate", capture, "--map", tmp_path / "turned.toml", *model)
    refused(ran, "drive.log", "current_a", "sign = -1 under [current]")
    assert not (tmp_path / "soc.csv").exists()


@pytest.mark.real
@pytest.mark.nightly
def test_a_real_capture(run: Run, shared_data: Path, project: Path, tmp_path: Path) -> None:
    capture = shared_data / "leaf_can" / "ZE0w24kWhstock.log.gz"
    model = project / "replay" / "leaf2012_published_model.json"
    ran = run(
        "estimate", capture, "--vehicle", "leaf_ze0", "-m", model, "-o", tmp_path / "soc.csv",
        "--report", tmp_path / "soc.html", "--json",
    )  # fmt: skip
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    assert found["frames"]["crc_errors"] == 0
    assert found["reasons"]["temperature source mismatch"] == 1.0
    assert found["rows"] == len(pa.csv.read_csv(tmp_path / "soc.csv"))
