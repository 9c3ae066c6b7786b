"""Files of `cases.toml` read to one drive, however packed; those of `errors.toml` are refused."""

from __future__ import annotations

import bz2
import gzip
import io
import re
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_cases import (
    CASES,
    CURRENT_A,
    HERE,
    ROWS,
    SOC_PCT,
    TIME_S,
    VOLTAGE_V,
    content_of,
    options_of,
)

from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.logs.log import Log
from selection import nightly_except

ERRORS: list[dict[str, Any]] = tomllib.loads((HERE / "errors.toml").read_text("utf-8"))["case"]


def write(folder: Path, name: str) -> Path:
    path = folder / CASES[name].get("name", "drive.csv")
    path.write_bytes(content_of(CASES[name]))
    return path


def read(folder: Path, name: str) -> Log:
    return read_log(write(folder, name), **options_of(CASES[name]))


@pytest.mark.parametrize("name", CASES)
def test_file_reads_to_the_drive(tmp_path: Path, name: str) -> None:
    case, log = CASES[name], read(tmp_path, name)
    np.testing.assert_allclose(log.time_s - log.time_s[0], TIME_S, atol=1e-5)
    np.testing.assert_allclose(log.current_a, CURRENT_A, atol=1e-6)
    np.testing.assert_allclose(log.voltage_v, VOLTAGE_V, atol=1e-3)
    np.testing.assert_allclose(log.temperature_c, case.get("temperature_c", 21.5), atol=0.01)
    assert (log.soc_pct is not None) == case.get("soc", False)
    if log.soc_pct is not None:
        np.testing.assert_allclose(log.soc_pct, SOC_PCT, atol=1e-3)
    assert log.temperature_source == case.get("source", "unknown")
    assert any(re.search(case.get("remark", ""), text) for text in (*log.remarks, *log.assumed, ""))
    assert not any("ignored: Cell 1" in text for text in log.remarks)
    is_any_table = any(text.startswith("time = ") for text in log.assumed)
    assert is_any_table == (name in OF_HEADINGS)


OF_HEADINGS = set(CASES) - {
    name for name in CASES
    if name.startswith(("canonical", "quotes", "d3", "battery-data", "bmw", "esc", "bitrode",
                        "visualcn"))
    or (name.startswith("arbin") and name != "arbin-link")
}  # fmt: skip
"""Files whose format does not define the columns: what was assumed is stated."""


def zipped(name: str, data: bytes) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, data)
        archive.writestr("__MACOSX/._x", b"")
        archive.writestr("trips/.DS_Store", b"")
    return packed.getvalue()


@pytest.mark.parametrize("name", ["german", "utf-16-without-a-mark", "canonical", "d3-2012"])
@pytest.mark.parametrize("how", ["gzip", "bzip2", "zip"])
def test_packing_changes_nothing(tmp_path: Path, name: str, how: str) -> None:
    path = write(tmp_path, name)
    plain, data = read_log(path), path.read_bytes()
    packed = {"gzip": gzip.compress, "bzip2": bz2.compress,
              "zip": lambda data: zipped(path.name, data)}[how](data)  # fmt: skip
    path.write_bytes(packed)
    log = read_log(path)
    np.testing.assert_array_equal(log.voltage_v, plain.voltage_v)
    assert (log.name, log.remarks) == (plain.name, plain.remarks)
    path.write_bytes(packed[: len(packed) * 2 // 3])
    with pytest.raises(InputError, match=r"(zip|packed) file is cut off or damaged"):
        read_log(path)


@pytest.mark.parametrize("case", ERRORS, ids=lambda case: case["words"][:40])
def test_what_cannot_be_read_is_refused_with_the_cure(tmp_path: Path, case: dict[str, Any]) -> None:
    path = tmp_path / "x.csv"
    before, repeated, after = case["text"].partition("…")
    if repeated:
        head, rows = before.split("\n", 1)
        body = [text.replace("{k}", str(k)) for k in range(ROWS) for text in rows.splitlines()]
        after = "\n".join([head, *body[:ROWS], after])
    path.write_text((after if repeated else before).replace("{k}", "1"), encoding="utf-8")
    with pytest.raises(InputError, match=case["words"]) as caught:
        read_log(path, **options_of(case))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("magic", "words"),
    [
        (b"ARROW1\0\0", r"Feather.*read_feather"),
        (b"\x89HDF\r\n\x1a\n", r"HDF5.*read_hdf"),
        (b"MATLAB 5.0 MAT-file, Platform", "loadmat"),
        (b"SQLite format 3\0", r"SQLite.*sqlite3 -csv"),
        (b"BIO-LOGIC MODULAR FILE\x1a", r"mpr.*galvani"),
        (b"NEWARE\0", r"\.nda.*NewareNDA"),
        (b"\0\1\0\0Standard Jet DB\0", r"Arbin.*mdb-export"),
        (b"\xfd7zXZ\0", "unxz"),
        (b"\x28\xb5\x2f\xfd", "unzstd"),
        (b"\x00\x01\x02", "not a known kind of log, nor of capture; known logs: canonical Par"),
        (b"\x1f\x8bnot gzip", "packed file is cut off or damaged"),
        (b"PK\x03\x04not zip", "zip file is cut off or damaged"),
        (b"PAR1not parquet", "Parquet file is cut off or damaged"),
    ],
)
def test_binary_file_is_named_with_its_cure(tmp_path: Path, magic: bytes, words: str) -> None:
    (tmp_path / "x.csv").write_bytes(magic + b"\0\1\2" * 100)
    with pytest.raises(InputError, match=words):
        read_log(tmp_path / "x.csv")


def test_zip_of_several_files_asks_for_one(tmp_path: Path) -> None:
    path = tmp_path / "x.zip"
    for names, words in (
        (["a.csv", "b.csv"], r"zip holds 2 files \(a.csv, b.csv\); unpack it and name one"),
        (["VersionInfo.xml", "data.ndc"], "NewareNDA"),
    ):
        with zipfile.ZipFile(path, "w") as archive:
            for name in names:
                archive.writestr(name, "x")
        with pytest.raises(InputError, match=words):
            read_log(path)


def test_absent_files_and_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_log(tmp_path / "absent.csv")
    with pytest.raises(InputError, match="this is a folder"):
        read_log(tmp_path)


@pytest.mark.parametrize("name", ["canonical", "d3-2013"])
def test_text_cut_anywhere_reads_or_is_refused(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, name)
    data = path.read_bytes()
    for length in range(1, len(data), 23):
        path.write_bytes(data[:length])
        try:
            log = read_log(path, **options_of(CASES[name]))
        except InputError as error:
            assert str(path) in str(error)  # noqa: PT017 - either outcome is right
        else:
            whole = len(log) - 1  # the last number may be short
            np.testing.assert_allclose(abs(log.current_a)[:whole], abs(CURRENT_A)[:whole])


@pytest.mark.parametrize("name", nightly_except([*CASES][:3], CASES))
def test_damaged_text_raises_nothing_but_input_errors(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(11)
    path = write(tmp_path, name)
    intact = path.read_bytes()
    for _ in range(4):
        data = bytearray(intact)
        for place in rng.integers(len(data), size=4):
            data[place] = int(rng.choice([*b",;.-\t\n", int(rng.integers(256))]))
        path.write_bytes(bytes(data))
        try:
            log = read_log(path, **options_of(CASES[name]))
        except InputError:
            continue
        assert np.isfinite(log.voltage_v).all()
