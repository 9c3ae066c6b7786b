"""`cangauge inspect`: one JSON object, or a table and sentences; clear errors."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import can
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from cangauge.bus.vehicle import Vehicle
from cangauge.cli.inspect import inspect_command
from cangauge.errors import InputError
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.replay.encoder import FrameEncoder
from cangauge.types import Sample

app = typer.Typer()
app.command()(inspect_command)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    rng = np.random.default_rng(2)
    time = np.arange(6000) / 10
    current = np.repeat(rng.normal(10.0, 40.0, 150), 40)
    voltage = 380.0 - 0.1 * current
    log = Log(time, current, voltage, np.full(6000, 20.0), temperature_source="pack")
    write_log(log, tmp_path / "drive [1].parquet")
    return tmp_path / "drive [1].parquet"


def test_json_is_one_object_on_stdout(path: Path) -> None:
    result = CliRunner().invoke(app, [str(path), "--json"])
    assert result.exit_code == 0
    found = json.loads(result.stdout)
    assert found["kind"] == "log"
    assert found["rows"] == 6000
    assert found["sign_of_current"]["sign"] == 1
    assert found["timing"]["rate_hz"] == pytest.approx(10.0)
    assert found["resistance"]["median_ohm"] == pytest.approx(0.1, rel=1e-3)


def test_the_table_shows_the_main_findings(path: Path) -> None:
    result = CliRunner().invoke(app, [str(path)])
    assert result.exit_code == 0
    for words in (
        "drive [1]: good for an estimate; a fit needs --capacity-ah and",
        "6000 rows, 10.0 min, 10 Hz (regular), temperature of: pack",
        "Sign: positive current discharges",
        "voltage moved against current in",
        "ohmic resistance",
        "rest voltage",
    ):
        assert words in result.stdout


def test_a_jittering_rate_is_a_round_figure(tmp_path: Path) -> None:
    time = 1.0022 * np.arange(300) + 0.2 * (np.arange(300) % 3 == 1)
    write_log(Log(time, time % 7, 380.0 - time % 7, time * 0 + 20.0), tmp_path / "x.parquet")
    assert "about 1 Hz (irregular)" in CliRunner().invoke(app, [str(tmp_path / "x.parquet")]).stdout


def test_a_temperature_is_taken_where_the_file_has_none(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text("time_s,current_a,voltage_v\n0,1,380\n1,2,379\n")
    result = CliRunner().invoke(app, [str(path)])
    assert isinstance(result.exception, InputError)
    assert "--temperature" in str(result.exception)
    result = CliRunner().invoke(app, [str(path), "--temperature", "24", "--json"])
    assert json.loads(result.stdout)["channels"]["temperature_c"]["median"] == 24.0


@pytest.mark.parametrize("option", ["--vehicle", "--map"])
def test_a_log_needs_no_vehicle(path: Path, option: str) -> None:
    given = path.with_name("given.toml")
    given.write_text('[current]\nsignal = "x"\n')
    result = CliRunner().invoke(app, [str(path), option, str(given), "--json"])
    assert json.loads(result.stdout)["rows"] == 6000
    assert "--vehicle, --dbc and --map do not apply to it" in result.stderr


@pytest.mark.real
@pytest.mark.parametrize("options", [[], ["--vehicle", "leaf_ze0"]])
def test_a_capture_is_inspected_with_and_without_a_vehicle(
    shared_data: Path, options: list[str]
) -> None:
    pytest.importorskip("cangauge.inspect.capture")
    capture = str(shared_data / "leaf_can" / "ZE0_Shift_P_D_ECO_N.log.gz")
    result = CliRunner().invoke(app, [capture, *options, "--json"])
    assert result.exit_code == 0, result.exception
    assert isinstance(json.loads(result.stdout), dict)
    table = CliRunner().invoke(app, [capture, *options])
    assert table.exit_code == 0
    assert len(table.stdout.splitlines()) > 5


def test_a_capture_is_shown_in_eighty_columns_with_the_next_step(tmp_path: Path) -> None:
    path = tmp_path / "drive.log"
    lines = [f"({1.7e9 + k / 10:.6f}) can0 1F0#{k % 256:02X}00" for k in range(200)]
    path.write_text("\n".join([*lines, "(1700000030.000000) can0 2A0#01", ""]))
    shown = CliRunner().invoke(app, [str(path)]).stdout
    assert "drive.log: candump log, 201 frames of 2 ids, 30.0 s, from 2023-11-14 22:13:20" in shown
    assert f"No known vehicle. Find its signals: cangauge init {path} -o mycar" in shown
    assert re.search(r"1F0 . +can0 . +200 . +2 . +0.1 . ", shown)
    assert "period [s]" in shown
    assert "Silence of 10.1 s after 19.9 s" in shown
    assert all(len(line) <= 80 for line in shown.splitlines() if ": " not in line)


def capture_of(path: Path, start_s: float = 1.7e9) -> Path:
    """A drive of the generic pack, with a silent bus for 5 s and one damaged frame."""
    encoder = FrameEncoder(Vehicle.load("generic"))
    with can.CanutilsLogWriter(path) as writer:
        for k in [k for k in range(300) if not 100 < k < 150]:
            current_a = 40.0 * (k // 20 % 2)
            sample = Sample(start_s + k / 10.0, current_a, 380.0 - 0.1 * current_a, 20.0)
            for frame in encoder.encode(sample, 80.0):
                frame.data[0] ^= k == 200
                writer.on_message_received(frame)
    return path


def test_the_vehicle_of_a_capture_is_named_with_its_ranges(tmp_path: Path) -> None:
    shown = CliRunner().invoke(app, [str(capture_of(tmp_path / "drive.log"))]).stdout
    assert "(--vehicle generic), 250 samples: 0 … 40 A, 376 … 380 V, 20 … 20 °C, 80 … 80 %" in shown
    assert "1 wrong CRC" in shown
    assert not any(words in shown for words in ("leaf", "Nissan", "False", "(0.0", "0 error"))


LOGGER = "Stempel;Wert a;Wert b\n" + "".join(
    f"{k};{1000 * (10 - 50 * (k % 2))};{384 - 5 * (k % 2)}\n" for k in range(60)
)
"""Discharge negative, in mA."""


@pytest.mark.parametrize("way", ["option", "map"])
def test_columns_by_option_or_map_file_read_a_table(tmp_path: Path, way: str) -> None:
    path = tmp_path / "logger.csv"
    path.write_text(LOGGER)
    options = ["--columns", "time=Stempel,current=Wert a[mA],voltage=Wert b"]
    if way == "map":
        (tmp_path / "car.toml").write_text(
            '[columns]\ntime = "Stempel"\ncurrent = "Wert a[mA]"\nvoltage = "Wert b"\n'
        )
        options = ["--map", str(tmp_path / "car.toml")]
    result = CliRunner().invoke(app, [str(path), *options, "--temperature", "20", "--json"])
    found = json.loads(result.stdout)
    assert found["channels"]["current_a"]["maximum"] == 40.0
    (assumed,) = found["assumed"].values()
    assert 'current = "Wert a" [mA]' in assumed
    assert "positive current charges, found from the data" in assumed


def test_unknown_columns_are_refused_with_a_command(tmp_path: Path) -> None:
    path = tmp_path / "logger.csv"
    path.write_text(LOGGER)
    result = CliRunner().invoke(app, [str(path)])
    assert isinstance(result.exception, InputError)
    assert "(found: Stempel, Wert a, Wert b)" in str(result.exception)
    assert "--columns 'time=Stempel,current=?,voltage=?'" in str(result.exception)
    assert "docs/logs.md" in str(result.exception)


def test_one_map_reads_captures_by_signals_and_tables_by_columns(
    tmp_path: Path, project: Path
) -> None:
    dbc = next((project / "dbc").glob("generic*.dbc"))
    (tmp_path / "car.toml").write_text(
        f'dbc = "{dbc}"\n'
        'current = "current_a"\nvoltage = "voltage_v"\ntemperature = "temperature_c"\n'
        'soc = "soc_pct"\n[columns]\ntime = "Stempel"\ncurrent = "Wert a[mA]"\n'
        'voltage = "Wert b"\n'
    )
    (tmp_path / "logger.csv").write_text(LOGGER)
    capture_of(tmp_path / "drive.log")
    options = ["--map", str(tmp_path / "car.toml"), "--temperature", "20", "--json"]
    table = CliRunner().invoke(app, [str(tmp_path / "logger.csv"), *options])
    assert json.loads(table.stdout)["channels"]["current_a"]["maximum"] == 40.0
    capture = CliRunner().invoke(app, [str(tmp_path / "drive.log"), *options])
    found = json.loads(capture.stdout)
    assert found["log"]["channels"]["current_a"]["maximum"] == 40.0
    assert found["log"]["soc"]["first_pct"] == pytest.approx(80.0)


def test_the_answer_is_the_first_line_and_remarks_follow(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = [f"{k},{40 - 50 * (k % 2)},{376 + 5 * (k % 2)},21,x" for k in range(400)]
    path.write_text("\n".join(["Time [s],Current [A],Voltage [V],Temp [C],Odo", *rows, ""]))
    command = [sys.executable, "-m", "cangauge", "inspect", str(path)]
    lines = subprocess.run(
        command, check=True, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ).stdout.splitlines()
    assert lines[0].startswith("log: good for an estimate")
    assert lines[-1].startswith(f"{path}: read as time = ")
