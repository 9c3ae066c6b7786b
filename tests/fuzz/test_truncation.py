"""Every format, cut off after every byte: the rows that are there, or an `InputError`.

`tests/logs/test_log_read.py` and `tests/bus/test_captures.py` do it for more spellings of logs and
captures, and check that what is read of a cut capture was there.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from cangauge.bus.capture_log import capture_to_log
from cangauge.bus.captures import read_capture
from cangauge.bus.database import load_dbc
from cangauge.bus.vehicle import load_vehicle
from cangauge.errors import InputError
from cangauge.logs.read import read_log
from cangauge.model.model_file import load_model
from cangauge.service.config import load_config
from cangauge.twin.schedule import read_speed
from fuzzing import corpus

LOGS = [name for name in corpus.log_files() if name != "utf16.csv"]
CAPTURES = list(corpus.capture_files())


def outcomes(path: Path, data: bytes, read: Callable[[Path], int]) -> list[int]:
    """How much was read of every beginning of the file, 0 where it was refused."""
    found = []
    for length in range(len(data)):
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
        tmp_path / name,
        corpus.log_files()[name],
        lambda path: len(read_log(path, temperature_c=20.0)),
    )
    assert max(found) <= corpus.ROWS + 1
    # A text's rows become more with its bytes; the rest is whole or nothing.
    text = not name.endswith((".parquet", ".zip", ".gz"))
    assert (max(found) >= corpus.ROWS) == text
    assert not found[0]


@pytest.mark.parametrize("name", CAPTURES)
def test_captures(tmp_path: Path, name: str) -> None:
    whole = len(corpus.leaf_frames())
    found = outcomes(
        tmp_path / name, corpus.capture_files()[name], lambda path: len(list(read_capture(path)))
    )
    assert max(found) <= whole
    # BLF and MF4 hold all frames in one block here.
    assert name.endswith((".blf", ".mf4")) or max(found) >= whole - 1


@pytest.mark.parametrize("name", ["candump.log", "x.asc", "plain.blf"])
def test_captures_as_logs(tmp_path: Path, name: str) -> None:
    car = load_vehicle("leaf_aze0")
    data = corpus.capture_files()[name]
    found = outcomes(tmp_path / name, data, lambda path: len(capture_to_log(path, car)))
    assert corpus.ROWS // 2 * name.endswith((".log", ".asc")) <= max(found) <= corpus.ROWS


TEXTS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "car.dbc": (corpus.DBC, load_dbc),
    "config.toml": (corpus.CONFIG, lambda path: load_config(path).load_vehicle()),
    "map.toml": (
        corpus.MAP.replace('dbc = "car.dbc"', 'dbc = "whole.dbc"'),
        lambda path: load_vehicle(map_file=path),
    ),
    "speed.csv": (corpus.SPEED, read_speed),
    "model.json": (json.dumps(corpus.model_tree()), load_model),
}


@pytest.mark.parametrize("name", list(TEXTS))
def test_what_configures(tmp_path: Path, name: str) -> None:
    text, read = TEXTS[name]
    (tmp_path / "whole.dbc").write_text(corpus.DBC)
    data = text.encode()
    found = outcomes(tmp_path / name, data, lambda path: read(path) is not None)
    (tmp_path / name).write_bytes(data)
    assert read(tmp_path / name) is not None
    assert found.count(0)
    if name == "model.json":
        assert not any(found)
