"""Commands that take a log or capture take every format: two of each in the suite."""

from __future__ import annotations

from pathlib import Path

import pytest

import small_files
from cangauge.bus.recording import read_log
from cangauge.bus.vehicle import Vehicle
from cangauge.replay.steps import CaptureSource
from live import in_process, leaf_model_path
from selection import nightly_except

CAPTURES = [name for name in small_files.capture_files() if name != "x.mf4"]
LOGS = ["bds.csv", "x.bdf.csv", "signals.mf4"]


@pytest.mark.parametrize("name", nightly_except(("candump.log", "plain.blf"), CAPTURES))
def test_captures(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(small_files.capture_files()[name])
    car = ("--vehicle", "leaf_aze0")
    inspected = in_process("inspect", path, *car, "--json")
    assert (inspected.code, inspected.json["frames"]) == (0, len(small_files.leaf_frames()))
    output = tmp_path / "soc.csv"
    estimated = in_process("estimate", path, *car, "-m", leaf_model_path(), "-o", output, "--json")
    assert (estimated.code, estimated.json["rows"]) == (0, small_files.ROWS), estimated.err
    source = CaptureSource(path, Vehicle.load("leaf_aze0"))
    assert sum(len(step.frames) for step in source.steps(loop=False)) == len(
        small_files.leaf_frames()
    )


@pytest.mark.parametrize("name", nightly_except(LOGS[:2], LOGS))
def test_logs(tmp_path: Path, name: str) -> None:
    files = small_files.log_files() | {"signals.mf4": small_files.mf4_signals()}
    content = files[name]
    if content is None:
        pytest.skip("asammdf is not installed")
    path = tmp_path / name
    path.write_bytes(content)
    assert len(read_log(path)) == small_files.ROWS
    inspected = in_process("inspect", path, "--json")
    assert (inspected.code, inspected.json["rows"]) == (0, small_files.ROWS), inspected.err
    output = tmp_path / "soc.parquet"
    estimated = in_process("estimate", path, "-m", leaf_model_path(), "-o", output, "--json")
    assert (estimated.code, estimated.json["rows"]) == (0, small_files.ROWS), estimated.err
