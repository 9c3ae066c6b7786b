"""Read a capture of any known format as messages; recognised by content, not by suffix."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Final

import can
from can.typechecking import Channel

from cangauge._io import MAX_BUSES
from cangauge.bus.captures.files import CaptureInfo, Stamps, parts_of_run, read_head
from cangauge.bus.captures.reader import CaptureReader
from cangauge.bus.captures.registry import reader_of
from cangauge.errors import InputError

CLOCK_ID: Final = 0x1DB
"""Without time stamps, frames of this id (Nissan Leaf) count time, …"""
CLOCK_PERIOD_S: Final = 0.010
"""… one each period [s]."""

KNOWN_CAPTURES: Final = (
    "candump (log, and screen output), CRTD, SavvyCAN's GVRET CSV, CAN Hacker and CARBUS traces,"
    " Vector ASC and BLF, PEAK TRC, PCAP and PCAPNG, ASAM MF4, MCAP, python-can's CSV,"
    " tab-separated tables, and text of seconds, id, length, bytes; each may be gzipped"
)
_CURE: Final = f"known are: {KNOWN_CAPTURES}"


class Capture:
    """A capture file: iterable over its messages, any number of times.

    Time stamps are in seconds, as recorded: from 1970, from the start of the capture or of the
    logger. In a capture without stamps, time is counted from 0 in frames of the clock's id;
    frames between two of them have the earlier one's time.

    Parameters
    ----------
    path : Path
    kind : type of CaptureReader
    clock : tuple of int and float
        Id of the frames that count time where there are no stamps, and their period [s].
    parts : sequence of Path
        The files for which `path` stands; by default itself.
    """

    def __init__(
        self,
        path: Path,
        kind: type[CaptureReader],
        clock: tuple[int, float],
        parts: Sequence[Path] = (),
    ) -> None:
        self.path = path
        self._parts = parts or (path,)
        self._kind = kind
        self._clock = clock
        self._readers: list[CaptureReader] = []

    @property
    def stamps(self) -> Stamps:
        """Resolution of the time stamps."""
        return self._readers[0].stamps if self._readers else self._kind.stamps

    @property
    def info(self) -> CaptureInfo:
        """Findings of the latest iteration; complete after its end."""
        readers = self._readers
        firsts = (each.first_malformed for each in readers)
        return CaptureInfo(
            format=self._kind.name,
            stamps=self.stamps,
            frames=sum(each.frames for each in readers),
            malformed=sum(each.malformed for each in readers),
            first_malformed=next((first for first in firsts if first is not None), None),
            cut_off=any(each.cut_off for each in readers),
            remarks=tuple(self._remarks()),
        )

    def _remarks(self) -> Iterator[str]:
        if self.stamps == "ms":
            yield "time stamps are whole milliseconds"
        elif self.stamps == "none":
            number, period_s = self._clock
            yield (
                "no time stamps: time is counted from 0 by frames of"
                f" 0x{number:X}, one every {1000.0 * period_s:g} ms"
            )
        yield from dict.fromkeys(chain.from_iterable(each.remarks for each in self._readers))
        for reader in self._readers:
            if reader.malformed:
                first = (
                    "" if reader.first_malformed is None else f" (first: {reader.first_malformed})"
                )
                yield f"{reader.malformed} malformed {reader.unit} skipped{first}"
        if any(each.cut_off for each in self._readers):
            frames = sum(each.frames for each in self._readers)
            yield f"the file is cut off after {frames} frames"

    def __iter__(self) -> Iterator[can.Message]:
        """Yield the messages in the file's order.

        Raises
        ------
        InputError
            If the file cannot be read, holds no frames or mostly malformed lines (names the
            first), or has neither stamps nor frames of the clock's id.
        """
        self._readers = []
        messages: Iterator[can.Message] = chain.from_iterable(map(self._read, self._parts))
        if self._kind.stamps == "none":
            messages = self._count_time(messages)
        channels: set[Channel | None] = set()
        for message in messages:
            if message.channel not in channels:
                channels.add(message.channel)
                if len(channels) > MAX_BUSES:
                    raise InputError(
                        f"frames of more than {MAX_BUSES} buses", source=self.path, cure=_CURE
                    )
            yield message
        self._finish()

    def _read(self, path: Path) -> Iterator[can.Message]:
        with self._kind(path) as reader:
            self._readers.append(reader)
            yield from reader.messages()

    def _count_time(self, messages: Iterator[can.Message]) -> Iterator[can.Message]:
        number, period_s = self._clock
        ticks = 0
        for message in messages:
            if message.arbitration_id == number and not message.is_extended_id:
                ticks += 1
            message.timestamp = max(ticks - 1, 0) * period_s
            yield message
        if not ticks and any(each.frames for each in self._readers):
            raise InputError(
                f"no time stamps, and no frames of 0x{number:X} to count time by",
                source=self.path,
                cure="record it with stamps, for instance by candump -l",
            )

    def _finish(self) -> None:
        # An empty last part, begun just before a power cut, does not invalidate the others.
        if not any(each.frames for each in self._readers):
            last = self._readers[-1]
            if last.damage is not None:
                raise last.damaged()
            raise InputError("the capture holds no frames", source=self.path, cure=_CURE)
        for reader in self._readers:
            if reader.malformed > reader.frames:
                raise reader.junk()


def find_capture(
    path: str | PathLike[str], *, clock: tuple[int, float] = (CLOCK_ID, CLOCK_PERIOD_S)
) -> Capture | None:
    """Return the capture of a file or of the parts of a recording; None if it is no capture.

    Parameters
    ----------
    path : path-like
        A file, or the name of a run (see `run_path`).
    clock : tuple of int and float
        Id of the frames that count time where there are no stamps, and their period [s].

    Raises
    ------
    InputError
        If it cannot be read.
    """
    path = Path(path)
    parts = parts_of_run(path)
    kinds = (reader_of(read_head(part)) for part in parts or [path])
    kind = next((each for each in kinds if each is not None), None)
    return None if kind is None else Capture(path, kind, clock, parts)


def open_capture(
    path: str | PathLike[str], *, clock: tuple[int, float] = (CLOCK_ID, CLOCK_PERIOD_S)
) -> Capture:
    """Return the capture of a file or of the parts of a recording.

    Parameters as of `find_capture`.

    Raises
    ------
    InputError
        If it cannot be read, or is no known kind of capture.
    """
    capture = find_capture(path, clock=clock)
    if capture is None:
        raise _unknown(Path(path))
    return capture


def read_capture(path: str | PathLike[str]) -> Iterator[can.Message]:
    """Yield the messages of a capture; see `open_capture` and `Capture`."""
    return iter(open_capture(path))


def is_capture(path: str | PathLike[str]) -> bool:
    """Return whether a file is a readable capture of a known kind."""
    try:
        return find_capture(path) is not None
    except InputError:
        return False


def _unknown(path: Path) -> InputError:
    return InputError("the file is not a known kind of capture", source=path, cure=_CURE)
