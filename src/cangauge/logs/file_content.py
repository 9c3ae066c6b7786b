"""Content of a log file: unpacked (gzip, bzip2, zip), text decoded; its beginning to know it."""

from __future__ import annotations

import csv
import io
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

from cangauge._io import (
    MAX_LOG_BYTES,
    UNPACK_FREE_BYTES,
    UNPACK_RATIO,
    bounded,
    open_unpacked,
    read_all,
    read_beginning,
)
from cangauge._mcap import MAGIC
from cangauge.errors import InputError
from cangauge.logs.foreign import NDAX_CURE

_WORKBOOK: Final = "xl/workbook.xml"
_ZIP: Final = b"PK\x03\x04"
_PARQUET: Final = b"PAR1"
_MDF: Final = (b"MDF     ", b"UnFinMF ")
_DELIMITERS: Final = ("\t", ";", ",")
_HEAD_BYTES: Final = 64 * 1024
_HEAD_LINES: Final = 160
_PIECE_BYTES: Final = 4 << 20
_UTF16: Final = (b"\xff\xfe", b"\xfe\xff")
_MAGIC_BYTES: Final = 64
MAX_WORKBOOK_TEXTS: Final = 64 << 20
"""Distinct texts of a workbook [bytes]: all are held in memory, and a log holds numbers."""
_D3_MEMBER: Final = "test data.txt"
# An LZMA member sets the memory of its reader; no exporter writes one.
_ZIP_METHODS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_DAMAGE: Final = (EOFError, OSError, zlib.error, zipfile.BadZipFile, struct.error, ValueError)


class FileContent:
    """The unpacked content of one file: its beginning at once, the rest on demand.

    Parameters
    ----------
    path : path-like

    Attributes
    ----------
    path : Path
        As given.
    name : str
        File name without folder and suffixes (of the member, for a zip).
    head : tuple of str
        The first lines, without line ends; empty for binary content.
    magic : bytes
        The first bytes.
    is_parquet, is_mf4, is_mcap : bool

    Raises
    ------
    InputError
        If the file is absent, unreadable, empty or damaged from its start, or if a zip holds
        several files.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)
        self.name = _stem(self.path.name)
        with self._open() as file:
            beginning = read_beginning(file, _HEAD_BYTES)
        if not beginning:
            with self._open() as file:
                file.read(1)  # raises if the file is damaged, not empty
        if not beginning.strip():
            raise InputError("the file is empty", source=self.path, cure="check the export")
        self._sheet: bytes | None = None
        if beginning.startswith(_ZIP):  # not unpacked: a workbook
            self._sheet = sheet_text(self.path)
            beginning = self._sheet[:_HEAD_BYTES]
        self.magic = beginning[:_MAGIC_BYTES]
        self.is_parquet = beginning.startswith(_PARQUET)
        self.is_mf4 = beginning.startswith(_MDF)
        self.is_mcap = beginning.startswith(MAGIC)
        is_binary = self.is_parquet or self.is_mf4 or self.is_mcap
        self.head = () if is_binary else _first_lines(beginning)

    @property
    def first_line(self) -> str:
        """The first line that is not blank; "" for binary content."""
        return next((line for line in self.head if line.strip()), "")

    def read(self) -> bytes:
        r"""Return the whole content; text as UTF-8 with `\n` or `\r\n` line ends.

        Raises
        ------
        InputError
            If the file is damaged, or larger than a log may be.
        """
        if self._sheet is not None:
            return self._sheet
        with self._open() as file:
            data = read_all(file, self.path, MAX_LOG_BYTES, "a log")
        return data if self.is_parquet else as_utf8(data)

    @contextmanager
    def open_seekable(self) -> Iterator[BinaryIO]:
        """Open the unpacked content: a plain file itself, which is then not held in memory."""
        with self._open() as file:
            if file.seekable() and os.fstat(file.fileno()).st_size <= MAX_LOG_BYTES:
                yield file
            else:
                yield io.BytesIO(read_all(file, self.path, MAX_LOG_BYTES, "a log"))

    def read_pieces(self) -> Iterator[bytes]:
        """Yield a text in pieces of whole lines; the whole of a workbook's or a UTF-16 text."""
        if self._sheet is not None or b"\0" in self.magic or self.magic[:2] in _UTF16:
            yield self.read()
            return
        rest = b""
        with self._open() as file:
            while piece := file.read(_PIECE_BYTES):
                end = piece.rfind(b"\n") + 1
                if end:
                    yield rest + piece[:end]
                    rest = piece[end:]
                else:
                    rest += piece
        if rest:
            yield rest

    @contextmanager
    def _open(self) -> Iterator[io.BufferedReader]:
        kind = ""
        try:
            with open_unpacked(self.path, MAX_LOG_BYTES) as file:
                kind = "" if file.seekable() else "packed "
                if not file.peek(len(_ZIP)).startswith(_ZIP):
                    yield file
                    return
                kind = "zip "
                packed = io.BytesIO(read_all(file, self.path, MAX_LOG_BYTES, "a log"))
            with zipfile.ZipFile(packed) as archive:
                if _WORKBOOK in archive.namelist():
                    packed.seek(0)
                    yield io.BufferedReader(packed)
                    return
                member = _only_member(archive, self.path)
                self.name = _stem(Path(member.filename).name)
                size = packed.getbuffer().nbytes
                with archive.open(member) as content:
                    unpacked = cast("io.BufferedIOBase", content)
                    yield bounded(unpacked, self.path, MAX_LOG_BYTES, size)
        except _DAMAGE as error:
            raise InputError(
                f"the {kind}file is cut off or damaged ({error})",
                source=self.path,
                cure="fetch it again",
            ) from error
        except (RuntimeError, NotImplementedError) as error:  # encrypted; unknown compression
            raise InputError(f"the zip cannot be unpacked: {error}", source=self.path) from error


def sheet_text(path: Path) -> bytes:
    """Return the longest sheet of an Excel workbook as tab-separated text.

    Raises
    ------
    InputError
        If the extra is not installed, or the workbook is damaged or larger than a log may be.
    """
    try:
        import openpyxl  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise InputError(
            "reading a workbook needs openpyxl",
            source=path,
            cure="install the extra: pip install 'cangauge[excel]', or export the sheet as CSV",
        ) from error
    try:
        _refuse_large(path)
        book = openpyxl.load_workbook(path, read_only=True, data_only=True)
        texts = [_sheet_rows(sheet) for sheet in book.worksheets]
    except InputError:
        raise
    except Exception as error:  # openpyxl raises whatever a damaged part provokes
        raise InputError(
            f"the workbook is damaged ({type(error).__name__})",
            source=path,
            cure="save it again, or export the sheet as CSV",
        ) from error
    return max(texts, key=lambda text: text.count(b"\n"), default=b"")


def _refuse_large(path: Path) -> None:
    """Refuse a workbook that unpacks to more than a log may hold, before it is parsed."""
    with zipfile.ZipFile(path) as archive:
        parts = archive.infolist()
    unpacked = sum(part.file_size for part in parts)
    texts = sum(part.file_size for part in parts if part.filename.endswith("sharedStrings.xml"))
    is_dense = unpacked > max(UNPACK_FREE_BYTES, UNPACK_RATIO * path.stat().st_size)
    if unpacked > MAX_LOG_BYTES or texts > MAX_WORKBOOK_TEXTS or is_dense:
        raise InputError(
            f"the workbook unpacks to {unpacked >> 20} MiB ({texts >> 20} MiB of texts), more than"
            " a log's",
            source=path,
            cure="export the sheet as CSV",
        )


def _sheet_rows(sheet: Any) -> bytes:
    lines = io.StringIO()
    writer = csv.writer(lines, delimiter="\t", lineterminator="\n")
    for row in sheet.iter_rows(values_only=True):
        cells = ["" if cell is None else str(cell) for cell in row]
        if any(cells):
            writer.writerow(cells)
    return lines.getvalue().encode()


def delimiter_of(line: str) -> str | None:
    """Return the delimiter of a line (tab before `;` before `,`), or None."""
    return next((mark for mark in _DELIMITERS if mark in line), None)


def split_cells(line: str, delimiter: str) -> list[str]:
    """Split a line into cells, without enclosing blanks and quotes."""
    reader = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    return [cell.strip() for cell in next(reader, [])]


def _only_member(archive: zipfile.ZipFile, path: Path) -> zipfile.ZipInfo:
    files = [
        info
        for info in archive.infolist()
        if info.filename and not info.filename.endswith("/")
        if not info.filename.startswith("__MACOSX")
    ]
    # A vehicle's zip of the ANL D3 data base holds documents beside the test data.
    tests = [info for info in files if info.filename.lower().endswith(_D3_MEMBER)]
    chosen = tests or files
    if len(chosen) != 1:
        names = ", ".join(info.filename for info in chosen[:4])
        more = ", …" if len(chosen) > 4 else ""
        is_ndax = any(info.filename == "data.ndc" for info in chosen)
        raise InputError(
            f"the zip holds {len(chosen)} files ({names}{more})" if chosen else "the zip is empty",
            source=path,
            cure=NDAX_CURE if is_ndax else "unpack it and name one of them",
        )
    if chosen[0].compress_type not in _ZIP_METHODS:
        raise InputError(
            "the zip uses another compression than deflate",
            source=path,
            value=chosen[0].compress_type,
            cure="unpack it first",
        )
    return chosen[0]


def as_utf8(data: bytes) -> bytes:
    """Return text of UTF-8, UTF-16 or latin-1 as UTF-8 without a byte order mark."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    if data[:2] in _UTF16:  # "Unicode text" of spreadsheets
        return data.decode("utf-16", errors="replace").encode()
    nul = data[:_HEAD_BYTES].count(0)
    for first, codec in ((1, "utf-16-le"), (0, "utf-16-be")):  # without a BOM: every second byte
        halves = data[first:_HEAD_BYTES:2]
        if nul and 2 * nul > len(halves) and halves.count(0) == nul:
            return data.decode(codec, errors="replace").encode()
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1").encode()
    return data


def _first_lines(beginning: bytes) -> tuple[str, ...]:
    if len(beginning) >= _HEAD_BYTES:
        # The last line may be cut within a character, which would make it look like latin-1.
        beginning = beginning[: beginning.rfind(b"\n") + 1] or beginning
    text = as_utf8(beginning).decode("utf-8", errors="ignore")
    if "\x00" in text:
        return ()
    return tuple(text.replace("\r\n", "\n").replace("\r", "\n").split("\n")[:_HEAD_LINES])


def _stem(name: str) -> str:
    for suffix in (
        ".gz",
        ".bz2",
        ".zip",
        ".csv",
        ".txt",
        ".tsv",
        ".parquet",
        ".pq",
        ".dat",
        ".xlsx",
        ".mpt",
        ".bdf",
        ".mf4",
        ".mcap",
    ):
        if name.lower().endswith(suffix):
            name = name[: -len(suffix)]
    return name.removesuffix(" Test Data")
