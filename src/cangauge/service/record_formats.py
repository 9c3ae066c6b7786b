"""The formats that a recording can have: python-can's writers, so that stamps keep their µs."""

from __future__ import annotations

import gzip
import io
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Final, Protocol, cast

import can

from cangauge.errors import InputError
from cangauge.service.record_file import RecordFile

EXACT_FORMATS: Final = (".log", ".csv", ".blf", ".mf4")
PACKED: Final = ".gz"
_EARLIEST_S: Final = 631_152_000.0
"""1990: python-can writes no earlier start into a BLF header [s since 1970]."""
IN_PARTS_ONLY: Final = (".blf", ".mf4")
"""Formats whose stamps count from the file's start, so that a clock set back needs a new file."""


class FrameWriter(Protocol):
    """Puts frames into a `RecordFile`."""

    def write(self, message: can.Message) -> None:
        """Write one frame."""

    def flush(self) -> None:
        """Put all frames written so far into the file, as far as the format can."""

    def stop(self) -> None:
        """Complete the file."""


def record_format(path: Path) -> str:
    """Return the format of a recording by its name, such as ".log", ".log.gz", ".blf".

    Raises
    ------
    InputError
        If it is unknown, does not keep time to the microsecond, or another package is missing.
    """
    suffixes = [suffix.lower() for suffix in path.suffixes]
    packed = suffixes[-1:] == [PACKED]
    kind = "".join(suffixes[-2:-1] if packed else suffixes[-1:])
    if kind not in EXACT_FORMATS or (packed and kind in IN_PARTS_ONLY):
        raise InputError(
            "this format does not keep time stamps to the microsecond, or is not known",
            source=path,
            field="--record",
            value="".join(suffixes),
            cure="name a .log (candump), .csv, .blf or .mf4 file",
        )
    if kind == ".mf4":
        _need_asammdf(path)
    return kind + PACKED if packed else kind


def frame_writer(kind: str, file: RecordFile, start_s: float) -> FrameWriter:
    """Return a writer of a format.

    Parameters
    ----------
    kind : str
        As `record_format` returns it.
    file : RecordFile
    start_s : float
        Stamp of the first frame [s].
    """
    if kind == ".blf":
        return _Blf(file, start_s)
    if kind == ".mf4":
        return _Mf4(file)
    return _Text(kind, file)


class _Text:
    """candump or CSV, perhaps gzipped: whole lines, each readable as soon as it is there."""

    def __init__(self, kind: str, file: RecordFile) -> None:
        self._packed = (
            gzip.GzipFile(fileobj=file, mode="wb", compresslevel=6)
            if kind.endswith(PACKED)
            else None
        )
        below = cast("BinaryIO", self._packed or file)
        text = io.TextIOWrapper(below, "utf-8", newline="\n")
        self._text = text
        self._writer: can.CanutilsLogWriter | can.CSVWriter
        if kind.startswith(".log"):
            self._writer = can.CanutilsLogWriter(text)
            # It would raise stamps below the first one, and so hide a clock that was set back.
            self._writer.last_timestamp = 0.0
        else:
            self._writer = can.CSVWriter(text)
        self.write: Callable[[can.Message], None] = self._writer.on_message_received

    def flush(self) -> None:
        self._text.flush()

    def stop(self) -> None:
        self._writer.stop()


class _Blf(can.BLFWriter):
    """BLF whose header is right from the beginning and after every flush: a kill leaves it whole.

    python-can completes the header, which holds the start that all stamps count from, only when
    the file is closed.
    """

    def __init__(self, file: RecordFile, start_s: float) -> None:
        super().__init__(cast("BinaryIO", file))
        # As the writer itself takes it from the first frame; a start that its header cannot tell
        # (of a clock that was never set) counts from 1970.
        whole_s = int(start_s * 1000.0) / 1000.0
        self.start_timestamp = self.stop_timestamp = 0.0 if whole_s < _EARLIEST_S else whole_s
        self._update_header()

    def write(self, message: can.Message) -> None:
        self.on_message_received(message)

    def flush(self) -> None:
        self._flush()
        self._update_header()

    def _update_header(self) -> None:
        end = self.file.seek(0, io.SEEK_END)
        self.file.seek(0)
        self._write_header(end)
        self.file.seek(end)


class _Mf4:
    """ASAM MF4: python-can holds the whole part in memory until it is complete."""

    def __init__(self, file: RecordFile) -> None:
        self._file = file
        self._content = _KeptBytes()
        self._writer = can.MF4Writer(self._content)
        self.write: Callable[[can.Message], None] = self._writer.on_message_received

    def flush(self) -> None:
        """Do nothing: the format is written as a whole."""

    def stop(self) -> None:
        self._writer.stop()
        self._file.write(self._content.getvalue())


class _KeptBytes(io.BytesIO):
    def close(self) -> None:
        """Keep the content, which is taken after the writer has closed it."""


def _need_asammdf(path: Path) -> None:
    try:
        import asammdf  # noqa: F401, PLC0415 - heavy, and only asked whether it is there
    except ImportError as error:
        raise InputError(
            "writing MF4 needs the package asammdf, which is not installed",
            source=path,
            field="--record",
            cure="pip install 'cangauge[mf4]', or record .blf or .log",
        ) from error
