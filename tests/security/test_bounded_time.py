"""Every file is read, or refused in one line, within two seconds of a slow processor."""

from __future__ import annotations

import bz2
import gzip
import os
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from cangauge._files import MIB, Head
from cangauge.bus.captures import open_capture
from cangauge.bus.database import load_dbc
from cangauge.bus.readers import capture_readers
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.extras.live.addresses import read_token
from cangauge.logs.read import open_log
from cangauge.model.model_file import Model
from cangauge.service.config import load_config
from cangauge.service.state import read_state
from live import in_process
from processor import at_most

PARTS, HEADINGS, WITHIN_S = 20_000, 40_000, 2.0


def table(*names: str, rows: int = 20) -> bytes:
    row = ",".join("1" for _ in names)
    return "\n".join([",".join(names), *[row] * rows, ""]).encode()


def wide(pattern: str, count: int = HEADINGS) -> bytes:
    return table(*[pattern.format(number) for number in range(count)])


def nested_multiplexers(depth: int = 12) -> bytes:
    """Return a DBC in which each of four values of a multiplexer selects another one."""
    below = range(1, depth)
    signals = [f' SG_ S{k} m0M : {2 * k}|2@1+ (1,0) [0|0] "" E\n' for k in below]
    values = [f"SG_MUL_VAL_ 256 S{k} S{k - 1} 0-3;\n" for k in below]
    first = ' SG_ S0 M : 0|2@1+ (1,0) [0|0] "" E\n'
    head = f'VERSION ""\nNS_ :\nBS_:\nBU_: E\nBO_ 256 M: 64 E\n{first}'
    return "".join([head, *signals, *values]).encode()


def packed_zeros(size: int) -> bytes:
    """Return so many zeros [whole MB], compressed: one block of a MB, repeated."""
    packer = zlib.compressobj(9)
    head = packer.compress(b"") + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(MIB)) + packer.flush(zlib.Z_FULL_FLUSH)
    end = zlib.compressobj(9, wbits=-15).flush()
    checksum = (size % 65521) << 16 | 1  # Adler-32
    return head + size // MIB * block + end + checksum.to_bytes(4, "big")


def packed_container(size: int) -> bytes:
    """Return a BLF with one container of zeros."""
    packed = packed_zeros(size)
    head = struct.pack("<4sHHLL", b"LOBJ", 16, 1, 32 + len(packed), 10)
    container = struct.pack("<H6xL4x", 2, size) + packed
    return b"LOGG" + struct.pack("<L", 144) + bytes(136) + head + container


LOG = table("time_s", "current_a", "voltage_v", "temperature_c")
FILES: dict[str, bytes] = {
    "nothing": b"",
    "zeros": bytes(1 << 22),
    "a long line": b"a" * (1 << 22),
    "long numbers": b"9" * (1 << 21),
    "brackets": b"[" * 100_000,
    "tables in tables": b"a = " + b"{a=" * 15_000,
    "objects in objects": b'{"a":' * 100_000,
    "a dotted key": ".".join(["a"] * PARTS).encode() + b" = 1\n",
    "a dotted table": b"[" + ".".join(["a"] * PARTS).encode() + b"]\nx = 1\n",
    "a dotted key of quotes": ".".join(["'a'"] * (PARTS // 2)).encode() + b" = 1\n",
    "plain headings": wide("c{}"),
    "headings of numbers": wide("{}"),
    "headings of times": wide("Time {} [s]"),
    "headings of dates": wide("2024-03-13 {}"),
    "headings of volts": table(
        "time_s", "current_a", "voltage_v", *[f"Voltage {n} [V]" for n in range(HEADINGS)]
    ),
    "headings in 64 kB": wide("c{}", 9_000),
    "many commas": (b"," * 60_000 + b"\n") * 20,
    "frames without ends": b"(1.0) can0 123#" + b"00" * (1 << 21),
    "multiplexers": nested_multiplexers(),
    "a chain of multiplexers": nested_multiplexers(1500),
    "attributes": b'VERSION ""\nBU_: E\n' + b'BA_DEF_ BO_ "A" INT 0 1;\n' * 150_000,
    "a large container": packed_container(1 << 30),
    "blank lines": b"\n" * (1 << 26),
    "packed twice": gzip.compress(gzip.compress(LOG)),
    "a packed table": gzip.compress(wide("c{}")),
}


def a_log(path: Path) -> object:
    return open_log(path).read()


def a_capture(path: Path) -> object:
    return sum(1 for _ in open_capture(path))


READERS: dict[str, Callable[[Path], object]] = {
    "log": a_log,
    "capture": a_capture,
    "DBC": load_dbc,
    "map": lambda path: Vehicle.load(map=path),
    "configuration": load_config,
    "model": Model.load,
    "state": read_state,
    "token": lambda path: read_token(path, {}),
} | {
    kind.name: (lambda path, kind=kind: sum(1 for _ in kind(path))) for kind in capture_readers()
}  # fmt: skip


def refusal(read: Callable[[Path], object], path: Path) -> str:
    """Return why a file is refused; empty if it is read."""
    try:
        read(path)
    except InputError as error:
        return str(error)
    return ""


@pytest.fixture(scope="module", autouse=True)
def imported(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Import what the readers import when they are first used."""
    path = tmp_path_factory.mktemp("log") / "log.csv"
    path.write_bytes(LOG)
    for read in READERS.values():
        refusal(read, path)


@pytest.mark.parametrize("content", FILES)
def test_every_reader_takes_bounded_time(content: str, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(FILES[content])
    for name, read in READERS.items():
        with at_most(WITHIN_S, name):
            why = refusal(read, path)
        assert len(why.splitlines()) <= 1
        assert len(why) < 1000


def test_names_of_a_long_table_take_no_time_for_each_row(tmp_path: Path) -> None:
    rows = "2024-03-13 {:02d}:{:02d}:00,c{},1\n"
    lines = [rows.format(k // 60 % 24, k % 60, k % (PARTS // 2)) for k in range(5 * PARTS)]
    (tmp_path / "file").write_text("".join(["time,name,value\n", *lines]))
    with at_most(WITHIN_S):
        assert "no plain heading of current and voltage" in refusal(a_log, tmp_path / "file")


@pytest.mark.parametrize("reader", READERS)
def test_a_link_to_itself_is_refused(reader: str, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.symlink_to(path)
    with pytest.raises(InputError, match="cannot be read: Too many levels"):
        READERS[reader](path)


@pytest.mark.parametrize("reader", READERS)
def test_a_pipe_is_refused_and_not_waited_for(reader: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "file")
    with pytest.raises(InputError, match=r"this is a pipe \(FIFO\), not a file"):
        READERS[reader](tmp_path / "file")


def test_a_long_name_in_a_zip_costs_no_time(tmp_path: Path) -> None:
    path = tmp_path / "log.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a" + 20_000 * ".gz" + "x", LOG)
    with at_most(WITHIN_S):
        assert Head(path).name.endswith(".gzx")


def stated_by_gzip(path: Path) -> None:
    """Write 40 MB in gzip, whose end states 1.1 GB."""
    packed = gzip.compress(LOG + b"1,1,1,1\n" * (5 * MIB), compresslevel=0)
    path.write_bytes(packed[:-4] + (1100 * MIB).to_bytes(4, "little"))


def stated_by_zip(path: Path) -> None:
    """Write a zip whose directory states 1.1 GB."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("log.csv", LOG)
    size, stated = len(LOG).to_bytes(4, "little"), (1100 * MIB).to_bytes(4, "little")
    path.write_bytes(path.read_bytes().replace(size + size, size + stated))


def stated_by_the_blocks_of_bzip2(path: Path) -> None:
    """Write 1.1 GB of rows in bzip2."""
    path.write_bytes(bz2.compress(LOG) + 275 * bz2.compress(b"1,1,1,1\n" * (MIB // 2)))


def stated_by_the_file_system(path: Path) -> None:
    path.write_bytes(LOG)
    os.truncate(path, 1100 * MIB)


@pytest.mark.parametrize(
    "write",
    [
        stated_by_gzip,
        stated_by_zip,
        stated_by_the_blocks_of_bzip2,
        stated_by_the_file_system,
    ],
    ids=lambda each: each.__name__,
)
def test_a_log_that_states_its_size_is_refused_unread(
    tmp_path: Path, write: Callable[[Path], None]
) -> None:
    write(tmp_path / "file")
    with at_most(0.5):
        why = refusal(a_log, tmp_path / "file")
    is_bzip2 = write is stated_by_the_blocks_of_bzip2
    assert f"larger than the {256 if is_bzip2 else 1024} MB that a log may have" in why


def test_zeros_in_bzip2_are_unpacked_to_the_limit_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They state no size."""
    (tmp_path / "file").write_bytes(bz2.compress(LOG) + 70 * bz2.compress(bytes(16 * MIB)))
    unpacked, read = [0], bz2.BZ2File.read

    def counted(file: bz2.BZ2File, size: int = -1) -> bytes:
        piece = read(file, size)
        unpacked[0] += len(piece)
        return piece

    monkeypatch.setattr(bz2.BZ2File, "read", counted)
    assert "larger than the 256 MB that a log may have" in refusal(a_log, tmp_path / "file")
    assert 256 * MIB < unpacked[0] < 258 * MIB


def test_a_log_that_grows_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = [f"{k},{k % 3},380,20\n" for k in range(30)]
    head = "time_s,current_a,voltage_v,temperature_c\n"
    path.write_text(head + "".join(rows[:20]))
    opened = open_log(path)
    with path.open("a") as logger:
        logger.write("".join(rows[20:]) + "30,1")
    log = opened.read()
    assert len(log) == 30
    assert "the last line is cut off and was omitted: the file may be incomplete" in log.remarks


def test_a_command_refuses_a_link_to_itself(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.symlink_to(path)
    for command in (("inspect", path), ("fit", path, "-o", tmp_path / "m.json"), ("gap", path)):
        ended = in_process(*command)
        assert (ended.code, len(ended.err.splitlines())) == (2, 1), ended.err


def test_no_container_is_unpacked_whole(tmp_path: Path) -> None:
    path = tmp_path / "x.blf"
    path.write_bytes(packed_container(512 * MIB))
    tracemalloc.start()
    assert "a container of more than" in refusal(a_capture, path)
    _, highest = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert highest < 200 * MIB
