"""Every format, cut off after every byte: the remaining rows, or an `InputError`.

The suite cuts text formats; here are those packed in other ways, and all that configures.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

import small_files
from cangauge.bus.captures import open_capture
from cangauge.bus.database import load_dbc
from cangauge.bus.recording import capture_to_log, read_log
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.model.model_file import Model
from cangauge.service.config import load_config
from cangauge.service.setup import load_vehicle

LOGS = ("log.parquet", "checked.parquet", "leaf.zip", "log.csv.gz", "utf16.csv")
CAPTURES = [
    name
    for name in ("plain.blf", "x.blf", "candump.log.gz", "x.mf4")
    if name in small_files.capture_files()
]


def outcomes(path: Path, data: bytes, read: Callable[[Path], int], step: int = 1) -> list[int]:
    """Return the amount read of every beginning of the file, 0 where it was refused."""
    found = []
    for length in range(0, len(data), step):
        path.write_bytes(data[:length])
        try:
            found.append(read(path))
        except InputError as error:
            assert str(error).isprintable()  # noqa: PT017 - both outcomes are right here
            found.append(0)
    return found


@pytest.mark.parametrize("name", LOGS)
def test_logs(tmp_path: Path, name: str) -> None:
    found = outcomes(
        tmp_path / name, small_files.log_files()[name], lambda path: len(read_log(path))
    )
    # A text has rows before its end; packed files are read whole or not at all.
    assert max(found) == (small_files.ROWS if name == "utf16.csv" else 0)


@pytest.mark.parametrize("name", CAPTURES)
def test_captures(tmp_path: Path, name: str) -> None:
    data = small_files.capture_files()[name]
    # Each MF4 costs a process and a second.
    step = len(data) // 8 if name == "x.mf4" else 1
    found = outcomes(tmp_path / name, data, lambda path: len(list(open_capture(path))), step)
    assert max(found) <= len(small_files.leaf_frames())


@pytest.mark.parametrize("name", ["candump.log", "plain.blf"])
def test_captures_as_logs(tmp_path: Path, name: str) -> None:
    car = Vehicle.load("leaf_aze0")
    found = outcomes(
        tmp_path / name,
        small_files.capture_files()[name],
        lambda path: len(capture_to_log(path, car)),
    )
    assert max(found) <= small_files.ROWS
    assert max(found) >= small_files.ROWS - 1 or name == "plain.blf"  # whose frames are one object


TEXTS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "car.dbc": (small_files.DBC, load_dbc),
    "config.toml": (small_files.CONFIG, lambda path: load_vehicle(load_config(path))),
    "map.toml": (
        small_files.MAP.replace('dbc = "car.dbc"', 'dbc = "whole.dbc"'),
        lambda path: Vehicle.load(map=path),
    ),
    "model.json": (
        json.dumps(small_files.model_tree() | {"effects": [], "information": None}),
        Model.load,
    ),
}


@pytest.mark.parametrize("name", list(TEXTS))
def test_what_configures(tmp_path: Path, name: str) -> None:
    text, read = TEXTS[name]
    (tmp_path / "whole.dbc").write_text(small_files.DBC)
    data = text.encode()
    found = outcomes(tmp_path / name, data, lambda path: read(path) is not None)
    (tmp_path / name).write_bytes(data)
    assert read(tmp_path / name) is not None
    assert found.count(0)
    if name == "model.json":
        assert not any(found)
