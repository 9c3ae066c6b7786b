"""What is in a file: bytes unpacked from gzip and zip, text decoded, the beginning to judge by."""

from __future__ import annotations

import csv
import gzip
import io
import struct
import zipfile
import zlib
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Final, cast

from cangauge._io import GZIP, MAX_LOG_BYTES, Bounded, read_bounded, unpacks_to
from cangauge.errors import InputError

_ZIP: Final = b"PK\x03\x04"
_PARQUET: Final = b"PAR1"
_DELIMITERS: Final = ("\t", ";", ",")
_HEAD_BYTES: Final = 64 * 1024
_HEAD_LINES: Final = 60
_D3_MEMBER: Final = "test data.txt"
_WHAT: Final = "a log"
# LZMA in a zip says itself how much memory it wants; no exporter uses it.
_ZIP_METHODS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


@dataclass(frozen=True, slots=True)
class FileContent:
    r"""The unpacked content of one file.

    Parameters
    ----------
    path : Path
        The file as the user named it.
    data : bytes
        Its content, unpacked; text is UTF-8 with `\n` or `\r\n` line ends.
    stem : str
        Name without folder and suffixes (of the member, for a zip).
    head : tuple of str
        The first lines, without line ends; empty when the content is not text.
    remarks : tuple of str
        What unpacking noticed.
    """

    path: Path
    data: bytes
    stem: str
    head: tuple[str, ...]
    remarks: tuple[str, ...] = ()

    @property
    def is_parquet(self) -> bool:
        """Whether the content begins like a Parquet file."""
        return self.data.startswith(_PARQUET)

    @property
    def delimiter(self) -> str | None:
        """Delimiter of the first line that has one: tab, `;` or `,` in this order."""
        return delimiter_of(self.head[0]) if self.head else None


def delimiter_of(line: str) -> str | None:
    """Return the delimiter of a line (tab before `;` before `,`), or None."""
    return next((mark for mark in _DELIMITERS if mark in line), None)


def cells(line: str, delimiter: str) -> list[str]:
    """Split a line into cells without blanks and quotes around them."""
    reader = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    return [cell.strip() for cell in next(reader, [])]


def read_file_content(path: str | PathLike[str]) -> FileContent:
    """Read a file whole, unpack gzip and zip, decode text.

    Raises
    ------
    InputError
        If the file is absent, unreadable, empty, cut off or damaged, or if a zip does not say
        which of its files is meant.
    """
    path = Path(path)
    data, stem, remarks = read_bounded(path, MAX_LOG_BYTES, _WHAT), _stem(path.name), ()
    if data.startswith(GZIP):
        data = _gunzip(data, path)
    if data.startswith(_ZIP):
        data, stem = _unzip(data, path)
    if not data.strip():
        raise InputError("the file is empty", source=path, cure="check the export")
    if data.startswith(_PARQUET):
        return FileContent(path, data, stem, (), remarks)
    data = _as_utf8(data)
    return FileContent(path, data, stem, _head(data), remarks)


def _gunzip(data: bytes, path: Path) -> bytes:
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as packed:
            return _read_all(packed, path, len(data))
    except (EOFError, OSError, zlib.error) as error:
        raise InputError(
            f"the gzip file is cut off or damaged ({error})", source=path, cure="fetch it again"
        ) from error


def _read_all(packed: io.BufferedIOBase, path: Path, packed_bytes: int) -> bytes:
    limit = min(MAX_LOG_BYTES, unpacks_to(packed_bytes))
    return io.BufferedReader(Bounded(packed, path, limit)).read()


def _unzip(data: bytes, path: Path) -> tuple[bytes, str]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            member = _member(archive, path)
            with archive.open(member) as packed:
                content = _read_all(cast("io.BufferedIOBase", packed), path, len(data))
            return content, _stem(Path(member.filename).name)
    except (zipfile.BadZipFile, EOFError, OSError, zlib.error, ValueError, struct.error) as error:
        raise InputError(
            f"the zip file is cut off or damaged ({error})", source=path, cure="fetch it again"
        ) from error
    except (RuntimeError, NotImplementedError) as error:  # encrypted; unknown compression
        raise InputError(f"the zip cannot be unpacked: {error}", source=path) from error


def _member(archive: zipfile.ZipFile, path: Path) -> zipfile.ZipInfo:
    files = [
        info
        for info in archive.infolist()
        if info.filename and not info.filename.endswith("/")
        if not info.filename.startswith("__MACOSX")
    ]
    # A vehicle's zip of the ANL D3 data base holds documents beside the test data.
    tests = [info for info in files if info.filename.lower().endswith(_D3_MEMBER)]
    chosen = tests or files
    if len(chosen) == 1 and chosen[0].compress_type in _ZIP_METHODS:
        return chosen[0]
    if len(chosen) == 1:
        raise InputError(
            "the zip packs in another way than deflate",
            source=path,
            value=chosen[0].compress_type,
            cure="unpack it yourself",
        )
    names = ", ".join(info.filename for info in chosen[:4]) + (", …" if len(chosen) > 4 else "")
    raise InputError(
        f"the zip holds {len(chosen)} files ({names})" if chosen else "the zip is empty",
        source=path,
        cure="unpack it and name one of them",
    )


def _as_utf8(data: bytes) -> bytes:
    if data.startswith(b"\xef\xbb\xbf"):
        return data[3:]
    if data[:2] in {b"\xff\xfe", b"\xfe\xff"}:  # "Unicode text" of spreadsheets
        return data.decode("utf-16", errors="replace").encode()
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1").encode()
    return data


def _head(data: bytes) -> tuple[str, ...]:
    text = data[:_HEAD_BYTES].decode("utf-8", errors="ignore")
    if "\x00" in text:
        return ()
    return tuple(text.replace("\r\n", "\n").replace("\r", "\n").split("\n")[:_HEAD_LINES])


def _stem(name: str) -> str:
    for suffix in (".gz", ".zip", ".csv", ".txt", ".tsv", ".parquet", ".pq", ".dat"):
        if name.lower().endswith(suffix):
            name = name[: -len(suffix)]
    return name.removesuffix(" Test Data")
