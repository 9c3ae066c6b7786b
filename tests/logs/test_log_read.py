"""`read_log` on every format: whole, cut off anywhere, damaged, unknown."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.logs.read import read_log

NAMES = (
    "log.parquet",
    "log.csv",
    "log.csv.gz",
    "log;.csv",
    "2012 Test Data.txt",
    "2013 Test Data.txt",
    "later Test Data.txt",
    "leaf.zip",
    "TripA01.csv.gz",
    "A123_OCV_P25_S1.csv",
    "A123_DYN_50_P25_s1.csv",
    "Cell-HPPC-10C.csv",
    "module.csv",
    "logger.csv",
    "history.csv",
)


def test_the_list_is_complete(every_format: dict[str, bytes]) -> None:
    assert set(NAMES) == set(every_format)


@pytest.mark.parametrize("name", NAMES)
def test_whole_files_read_gzipped_too(
    tmp_path: Path, every_format: dict[str, bytes], name: str
) -> None:
    (tmp_path / name).write_bytes(every_format[name])
    log = read_log(tmp_path / name)
    (tmp_path / f"{name}.gz").write_bytes(gzip.compress(every_format[name]))
    again = read_log(tmp_path / f"{name}.gz") if not name.endswith(".gz") else log
    np.testing.assert_array_equal(again.voltage_v, log.voltage_v)
    assert again.remarks == log.remarks


def outcome(path: Path, data: bytes) -> Log | InputError:
    """Return the log or the InputError; anything else fails the test."""
    path.write_bytes(data)
    try:
        return read_log(path)
    except InputError as error:
        return error


@pytest.mark.parametrize("name", NAMES)
def test_cut_off_at_every_byte_it_reads_or_is_refused(
    tmp_path: Path, every_format: dict[str, bytes], name: str
) -> None:
    path = tmp_path / name
    data = every_format[name]
    found = [outcome(path, data[:length]) for length in range(len(data))]
    read = [log for log in found if isinstance(log, Log)]
    refused = [error for error in found if isinstance(error, InputError)]
    assert all(np.isfinite(log.voltage_v).all() for log in read)
    assert all(str(path) in str(error) for error in refused)
    assert refused
    assert (not read) == name.endswith((".parquet", ".gz", ".zip"))


@pytest.mark.parametrize("name", NAMES)
def test_damaged_bytes_raise_nothing_but_input_errors(
    tmp_path: Path, every_format: dict[str, bytes], name: str
) -> None:
    rng = np.random.default_rng(7)
    path = tmp_path / name
    for _ in range(200):
        data = bytearray(every_format[name])
        for place in rng.integers(len(data), size=rng.integers(1, 4)):
            data[place] = rng.integers(256)
        found = outcome(path, bytes(data))
        assert len(found) > 0 if isinstance(found, Log) else str(path) in str(found)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "the file is empty"),
        (b"\r\n \n", "the file is empty"),
        (gzip.compress(b"", mtime=0), "the file is empty"),
        (
            b"\x00\x01\x02" * 100,
            "not a known kind of log; known are: canonical Parquet",
        ),
        (b"%PDF-1.4\n", r"first line: .*not a known kind of log.* \(got '%PDF-1.4'\)"),
        (b"a,b,c\n1,2,3\n", r"found: a, b, c\); name the columns"),
        (b"\x1f\x8bnot gzip", "gzip file is cut off or damaged"),
        (b"PK\x03\x04not zip", "zip file is cut off or damaged"),
        (b"PAR1not parquet", "Parquet file is cut off or damaged"),
    ],
)
def test_unknown_content_is_refused_in_one_line(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "x"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        read_log(path)
    assert "\n" not in str(caught.value)


def test_absent_files_and_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_log(tmp_path / "absent.csv")
    with pytest.raises(InputError, match="this is a folder"):
        read_log(tmp_path)


def test_an_encrypted_zip_is_refused(tmp_path: Path, every_format: dict[str, bytes]) -> None:
    data = bytearray(every_format["leaf.zip"])
    for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        data[data.index(signature) + offset] |= 1  # the flag that says so
    (tmp_path / "x.zip").write_bytes(data)
    with pytest.raises(InputError, match=r"zip cannot be unpacked: .*encrypted"):
        read_log(tmp_path / "x.zip")
