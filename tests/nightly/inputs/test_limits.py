"""Files larger than anybody needs, and numbers beyond any, are refused in one line."""

from __future__ import annotations

import io
import json
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import small_files
from cangauge.bus.captures import open_capture
from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.model.effects.library import LIBRARY
from cangauge.model.model_file import Model
from cangauge.service.config import load_config

HEADER = b"time_s,current_a,voltage_v,temperature_c\n"
FRAME = b"(1436509052.249713) can0 1DB#0004C262000003B6\n"


def big_gzip(part: bytes, count: int, head: bytes = b"") -> bytes:
    """Pack `head` and `count` times `part`, without holding the content in memory."""
    packer = zlib.compressobj(9, wbits=31)
    step = part * 1000
    parts = [packer.compress(head), *(packer.compress(step) for _ in range(count // 1000))]
    return b"".join([*parts, packer.flush()])


def rows_of_one_value() -> bytes:
    out, zero = io.BytesIO(), pa.array(np.zeros(25_000_000))
    names = HEADER.decode().strip().split(",")
    pq.write_table(pa.table(dict.fromkeys(names, zero)), out, compression="zstd")
    return out.getvalue()


LOGS: dict[str, Callable[[], bytes]] = {
    "gzip": lambda: big_gzip(b"0,0,0,0\n", 10 << 20, HEADER),
    "gzip of nothing": lambda: big_gzip(b"\0", 64 << 20),
    "rows of one value": rows_of_one_value,
    "decades": lambda: HEADER + b"0,1,380,20\n1.7e9,1,380,20\n1700000001,1,380,20\n",
}


def refused(read: Callable[[Path], object], path: Path) -> None:
    with pytest.raises(InputError) as caught:
        read(path)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 2000


@pytest.mark.parametrize("name", list(LOGS))
def test_logs(tmp_path: Path, name: str) -> None:
    path = tmp_path / "log"
    path.write_bytes(LOGS[name]())
    refused(read_log, path)


@pytest.mark.parametrize(
    "text",
    ['model = "m"\n' + "#" * 300_000, "initial_soc = " + "9" * 5000, "model = " + "[" * 60_000],
    ids=["size", "number", "depth"],
)
def test_configurations(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.toml"
    path.write_text(text)
    refused(load_config, path)


@pytest.mark.parametrize(
    "change",
    [
        {"effects": [{}] * 300_000},
        {"effects": [{"id": "capacity", "parameters": {"change_pct": 10**300}}]},
        {"name": "x" * 5_000_000},
        {"range": {"soc_pct": [-500, 900]}},
        {"capacity_ah": 5e-324},
    ],
    ids=range(5),
)
def test_models(tmp_path: Path, change: dict[str, object]) -> None:
    path = tmp_path / "x.json"
    tree = json.loads(json.dumps(small_files.model_tree()))
    path.write_text(json.dumps(tree))
    assert len(Model.load(path).effects) == len(LIBRARY)
    for key, value in change.items():
        tree[key] = {**tree[key], **value} if isinstance(value, dict) else value
    path.write_text(json.dumps(tree))
    refused(Model.load, path)


def test_stamps_that_are_no_time_are_malformed(tmp_path: Path) -> None:
    path = tmp_path / "x.log"
    for stamp in (b"9" * 400 + b".0", b"9" * 12 + b".0"):
        path.write_bytes(FRAME * 3 + FRAME.replace(b"1436509052.249713", stamp))
        assert sum(1 for _ in open_capture(path)) == 3
    table = small_files.capture_files()["table.csv"]
    path.write_bytes(table + table.splitlines()[-1].replace(b"1001100", b"9" * 400) + b"\n")
    assert sum(1 for _ in open_capture(path)) == len(small_files.leaf_frames())


def test_python_cans_log_lines_are_not_printed(tmp_path: Path) -> None:
    """python-can logs a line for each unknown object of a BLF file."""
    header = struct.pack("<4sL8BQQLL8H8H", b"LOGG", 144, *[0] * 8, 0, 0, 1, 1, *[0] * 16)
    odd = struct.pack("<4sHHLL", b"LOBJ", 16, 7, 32, 1) + bytes(16)
    frame = struct.pack("<4sHHLLLHHQ", b"LOBJ", 32, 1, 48, 86, 2, 0, 0, 1000)
    content = odd * 1000 + frame + struct.pack("<HBBL8s", 1, 0, 8, 0x1DB, bytes(8))
    body = struct.pack("<H6xL4x", 2, len(content)) + zlib.compress(content, 9)
    packed = struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(body), 10) + body
    path = tmp_path / "x.blf"
    path.write_bytes(header.ljust(144, b"\0") + packed + bytes(len(body) % 4))
    code = (
        "import sys; from cangauge.bus.captures import open_capture;"
        "print(len(list(open_capture(sys.argv[1]))))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, path], capture_output=True, text=True, check=True
    )
    assert (done.stdout, done.stderr) == ("1\n", "")


def test_messages_keep_their_length(tmp_path: Path) -> None:
    error = InputError("p" * 9999, source=tmp_path, field="f" * 9999, value="v" * 9999, cure="c")
    assert len(str(error)) < 1500
    assert str(InputError("x", value=1 << 100_000)).startswith("x (got a huge int")
    assert str(InputError("a\nb\x1b[2J", source="c\x00")) == "c\\x00: a\\nb\\x1b[2J"
