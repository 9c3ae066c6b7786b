"""The readers of captures, those of other packages included."""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points
from typing import Final

from cangauge.bus.captures import library, text
from cangauge.bus.captures.mcap import McapReader
from cangauge.bus.captures.mf4 import Mf4Reader
from cangauge.bus.captures.pcap import PcapReader
from cangauge.bus.captures.reader import CaptureReader
from cangauge.errors import InputError

GROUP: Final = "cangauge.capture_readers"
"""Entry points of other packages: classes derived from `CaptureReader`."""

# Marked by their first bytes: the first that matches is taken.
_MARKED: Final[tuple[type[CaptureReader], ...]] = (
    library.AscReader,
    library.BlfReader,
    library.TrcReader,
    Mf4Reader,
    library.CsvReader,
    PcapReader,
    McapReader,
)
# The one with most frames in the beginning of a file is taken, the first of equals.
_TEXTS: Final[tuple[type[CaptureReader], ...]] = (
    text.CrtdReader,
    text.CandumpLogReader,
    text.GvretReader,
    text.CarbusReader,
    text.CanHackerReader,
    text.IdDataReader,
    text.TableReader,
    text.SpacedReader,
    text.CandumpReader,
    text.UnstampedCandumpReader,
)


def readers() -> tuple[type[CaptureReader], ...]:
    """Return all readers of captures, in the order of their trial."""
    return (*_plugins(), *_MARKED, *_TEXTS)


def reader_of(head: bytes) -> type[CaptureReader] | None:
    """Return the reader of a file by its unpacked beginning; None if it is no known capture."""
    for reader in (*_plugins(), *_MARKED):
        if reader.matches(head):
            return reader
    scores = {reader: reader.matches(head) for reader in _TEXTS}
    best = max(_TEXTS, key=lambda reader: scores[reader])
    return best if scores[best] > 0 else None


@cache
def _plugins() -> tuple[type[CaptureReader], ...]:
    found = []
    for entry in entry_points(group=GROUP):
        reader = entry.load()
        if not (isinstance(reader, type) and issubclass(reader, CaptureReader)):
            raise InputError(
                "the entry point is not a CaptureReader",
                source=f"{GROUP}: {entry.name}",
                value=entry.value,
                cure="correct or remove the package that declares it",
            )
        found.append(reader)
    return tuple(found)
