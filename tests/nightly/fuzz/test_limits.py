"""Small files of huge content, or of huge run time, are refused within bounds of both."""

from __future__ import annotations

import gzip
import io
import json
import multiprocessing as mp
import resource
import struct
import subprocess
import sys
import time
import zipfile
import zlib
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cangauge.bus.captures import open_capture
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.logs.read import read_log
from cangauge.model.effects.library import LIBRARY
from cangauge.model.model_file import Model
from cangauge.service.config import load_config
from cangauge.service.setup import load_vehicle
from fuzzing import corpus

MIB = 1 << 20
SECONDS = 10.0
"""Largest CPU time of a case [s]: generous for slow machines, far below a hang."""
MEMORY = 1500 * MIB
HEADER = b"time_s,current_a,voltage_v,temperature_c\n"
FRAME = b"(1436509052.249713) can0 1DB#0004C262000003B6\n"


def blf(*objects: bytes) -> bytes:
    """A BLF file of these objects."""
    header = struct.pack("<4sL8BQQLL8H8H", b"LOGG", 144, *[0] * 8, 0, 0, 1, 1, *[0] * 16)
    return header.ljust(144, b"\0") + b"".join(objects)


def container(content: bytes, method: int = 2) -> bytes:
    packed = zlib.compress(content, 9) if method == 2 else content
    body = struct.pack("<H6xL4x", method, len(content)) + packed
    return struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(body), 10) + body + bytes(len(body) % 4)


def frame_object(length: int = 48) -> bytes:
    head = struct.pack("<4sHHLLLHHQ", b"LOBJ", 32, 1, length, 86, 2, 0, 0, 1000)
    return head + struct.pack("<HBBL8s", 1, 0, 8, 0x1DB, bytes(8))


def big_gzip(part: bytes, count: int, head: bytes = b"") -> bytes:
    """Pack `head` and `count` times `part`, without holding the content in memory."""
    packer = zlib.compressobj(9, wbits=31)
    step = part * 1000
    parts = [packer.compress(head), *(packer.compress(step) for _ in range(count // 1000))]
    return b"".join([*parts, packer.flush()])


def lying_zip() -> bytes:
    """A member whose header states 100 bytes and that unpacks to 100 MB."""
    out = io.BytesIO()
    with (
        zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("a.csv", "w", force_zip64=True) as member,
    ):
        for _ in range(100):
            member.write(b"0" * MIB)
    data = bytearray(out.getvalue())
    place = data.rindex(b"PK\x01\x02")
    data[place + 24 : place + 28] = struct.pack("<L", 100)
    return bytes(data)


def parquet(**columns: object) -> bytes:
    out = io.BytesIO()
    pq.write_table(pa.table(columns), out, compression="zstd")
    return out.getvalue()


def rows(count: int) -> dict[str, object]:
    zero = pa.array(np.zeros(count))
    return {"time_s": zero, "current_a": zero, "voltage_v": zero, "temperature_c": zero}


def repeated(count: int, text: str) -> object:
    places = pa.array(np.zeros(count, dtype=np.int32))
    return pa.DictionaryArray.from_arrays(places, pa.array([text]))


LOGS: dict[str, Callable[[], bytes]] = {
    "gzip": lambda: big_gzip(b"0,0,0,0\n", 10 * MIB, HEADER),
    "gzip of nothing": lambda: big_gzip(b"\0", 64 * MIB),
    "zip that lies": lying_zip,
    "rows of one value": lambda: parquet(**rows(25_000_000)),
    "long words": lambda: parquet(
        **rows(2_000_000), temperature_source=repeated(2_000_000, "x" * 100_000)
    ),
    "long numbers": lambda: parquet(
        **{**rows(2_000_000), "current_a": repeated(2_000_000, "1" + "0" * 100_000)}
    ),
    "odd rows": lambda: gzip.compress(HEADER + b"1,2,3,4\n" + b"1,2\n" * (4 * MIB)),
    "columns": lambda: b",".join(b"c%d" % n for n in range(12_000)) + b"\n" + HEADER,
    "wide": lambda: HEADER + b"," * 60_000 + b"\n",
    "D3 heading": lambda: b"Time[s]\thvbatt" + b" " * 50_000 + b"_\tDyno[mph]\n0\t1\t2\n",
    "i3 heading": lambda: b"Time [s];battery voltage [V];" + b" [" * 25_000 + b"\n0;1;2\n",
    "decades": lambda: HEADER + b"0,1,380,20\n1.7e9,1,380,20\n1700000001,1,380,20\n",
}
CAPTURES: dict[str, Callable[[], bytes]] = {
    "gzip of lines": lambda: big_gzip(b"\n", 12 * MIB, FRAME),
    "gzip of frames": lambda: big_gzip(FRAME, MIB),
    "gzip of one line": lambda: big_gzip(b"A", 64 * MIB, FRAME * 3),
    "blanks": lambda: b"  can0  RX" + b" " * 60_000 + b"\n" + b" can0 1DB [1] 00\n" * 3,
    "more blanks": lambda: (b"can0 RX" + b"\t -" * 5000 + b"\n") * 4,
    "lines of ASC": lambda: b"date x\nbase hex timestamps absolute\n" + b"9" * (64 * MIB),
    "lines of TRC": lambda: b";$FILEVERSION=1.1\n" + b"1" * (64 * MIB),
    "object of no length": lambda: blf(container(frame_object(0) * 3)),
    "unknown object of no length": lambda: blf(
        container(struct.pack("<4sHHLL", b"LOBJ", 16, 9, 0, 1) + bytes(64), 0)
    ),
    "file object of no length": lambda: blf(struct.pack("<4sHHLL", b"LOBJ", 16, 1, 0, 1)),
    "container": lambda: blf(container(bytes(100 * MIB))),
    "gigabytes": lambda: blf(struct.pack("<4sHHLL", b"LOBJ", 16, 1, 0xFFFFFFFF, 10) + bytes(99)),
    "object of many containers": lambda: blf(
        container(struct.pack("<4sHHLL", b"LOBJ", 16, 1, 15 * MIB, 1), 0),
        *[container(bytes(8), 0)] * 300_000,
    ),
    "buses": lambda: b"".join(FRAME.replace(b"can0", b"c%d" % n) for n in range(5000)),
    "ids": lambda: b"".join(FRAME.replace(b"1DB", b"%08X" % n) for n in range(200_000)),
}


def refused(run: Callable[[], object]) -> str:
    """Run it within bounds; return the error message, "" if it was read.

    In a process of its own, which may have only so much memory and is ended if it hangs.
    """
    context = mp.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_bounded, args=(run, theirs), daemon=True)
    child.start()
    theirs.close()
    try:
        assert ours.poll(20 * SECONDS), "it hangs"
        message, seconds = ours.recv()
    finally:
        child.kill()
        child.join()
    assert seconds < SECONDS
    assert message.isprintable() or not message
    assert len(message) < 2000
    return message


def _bounded(run: Callable[[], object], answer: Connection) -> None:
    held = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_DATA, (held + MEMORY, held + MEMORY))
    began = time.process_time()
    try:
        run()
        message = ""
    except InputError as error:
        message = str(error)
    # Any other error ends the process without an answer.
    answer.send((message, time.process_time() - began))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(LOGS))
def test_logs(tmp_path: Path, name: str) -> None:
    path = tmp_path / "bomb"
    path.write_bytes(LOGS[name]())
    assert path.stat().st_size < 10 * MIB
    assert refused(lambda: read_log(path))


@pytest.mark.parametrize(
    "text",
    [
        "model = 0x" + "F" * 50_000,
        "bus_options.x = 0x" + "F" * 50_000 + '\nmodel = "m"',
        "initial_soc = " + "9" * 5000,
        "model = " + "[" * 100_000,
        "a." * 50_000 + "b = 1",
        "[" + "a." * 50_000 + "b]",
        "a . " * 15_000 + "b = 1",
        "'a'.\"b\"." * 7_000 + "b = 1",
        "x = {" + "a." * 30_000 + "b = 1}",
        "'" * 60_000,
        "'x\"" * 20_000,
        "x" * 60_000,
        "".join(f"k{n} = {n}\n" for n in range(4_000)),
        "".join(f"[k{n}.x]\n" for n in range(5_000)),
        'model = "' + "x" * 60_000 + '"',
        "x" * 1_000_000,
        "\ufeff" * 3 + "model = 1",
        'model = "a\\u0000b"\nvehicle = "leaf_ze0"\ndbc = "a\\u0000"',
    ],
    ids=range(18),
)
def test_configurations(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.toml"
    path.write_text(text)
    message = refused(lambda: load_vehicle(load_config(path)))
    assert message or text.startswith(('model = "x', "bus_options"))
    assert refused(lambda: Vehicle.load(map=path))


@pytest.mark.parametrize(
    "change",
    [
        {"information": {"projected": [1.0] * 300_000}},
        {"information": {"root": [[1.0] * 1000] * 300}},
        {"effects": [{}] * 300_000},
        {"effects": [{"id": "capacity", "parameters": {"change_pct": 10**300}}]},
        {"coefficients": {f"k{n}": 1 for n in range(100_000)}},
        {"delays_s": list(range(100_000))},
        {"name": {f"k{n}": n for n in range(100_000)}},
        {f"k{n}": n for n in range(100_000)},
        {"name": "x" * 5_000_000},
        {"range": {"soc_pct": [-500, 900]}},
        {"range": {"soc_pct": [0, 108]}},
        {"capacity_ah": 5e-324},
        {"epsilon": 1e-300},
    ],
    ids=range(13),
)
def test_models(tmp_path: Path, change: dict[str, object]) -> None:
    tree = json.loads(json.dumps(corpus.model_tree()))
    for key, value in change.items():
        if isinstance(value, dict) and isinstance(tree.get(key), dict):
            tree[key].update(value)
        else:
            tree[key] = value
    path = tmp_path / "x.json"
    path.write_text(json.dumps(tree))
    assert refused(lambda: Model.load(path))


def test_a_model_as_it_should_be_is_read(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text(json.dumps(corpus.model_tree()))
    assert len(Model.load(path).effects) == len(LIBRARY)


def test_stamps_that_are_no_time_are_malformed(tmp_path: Path) -> None:
    path = tmp_path / "x.log"
    for stamp in (b"9" * 400 + b".0", b"9" * 12 + b".0"):
        path.write_bytes(FRAME * 3 + FRAME.replace(b"1436509052.249713", stamp))
        assert sum(1 for _ in open_capture(path)) == 3
    table = corpus.capture_files()["table.csv"]
    path.write_bytes(table + table.splitlines()[-1].replace(b"1001100", b"9" * 400) + b"\n")
    assert sum(1 for _ in open_capture(path)) == len(corpus.leaf_frames())


def test_python_cans_log_lines_are_not_printed(tmp_path: Path) -> None:
    """python-can logs a line for each unknown object."""
    odd = struct.pack("<4sHHLL", b"LOBJ", 16, 7, 32, 1) + bytes(16)
    (tmp_path / "x.blf").write_bytes(blf(container(odd * 1000 + frame_object())))
    code = (
        "import sys; from cangauge.bus.captures import open_capture;"
        "print(len(list(open_capture(sys.argv[1]))))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "x.blf")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert (done.stdout, done.stderr) == ("1\n", "")


def test_messages_keep_their_length(tmp_path: Path) -> None:
    error = InputError("p" * 9999, source=tmp_path, field="f" * 9999, value="v" * 9999, cure="c")
    assert len(str(error)) < 1500
    assert str(InputError("x", value=1 << 100_000)).startswith("x (got a huge int")
    assert str(InputError("a\nb\x1b[2J", source="c\x00")) == "c\\x00: a\\nb\\x1b[2J"
