"""Writing a file beside the work: a slow or stuck disk never holds the estimator up.

A file that is written by a thread of its own: a slow, full or broken disk never holds the loop.

What is written stays in memory until `hand_over`, and then goes to the thread in one piece. Pieces
that the disk does not take wait, up to `WAITING_BYTES`; beyond that the newest are dropped whole
and counted, so that the file stays readable and goes on when there is room again.
"""

from __future__ import annotations

import errno
import io
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Generic, TypeVar

from cangauge._logging import emit

# --- Writing a file beside the work: a slow or stuck disk never holds the estimator up

Item = TypeVar("Item")


class BackgroundWriter(Generic[Item]):
    """Writes the latest item in a thread of its own; one that comes meanwhile replaces the last.

    Parameters
    ----------
    write : callable
        Writes an item; whatever it raises is kept for `take_error`.
    """

    def __init__(self, write: Callable[[Item], None]) -> None:
        self._write = write
        self._turn = threading.Condition()
        self._waiting: Item | None = None
        self._is_busy = False
        self._error: Exception | None = None
        self._thread: threading.Thread | None = None
        self.written = 0
        """Items written so far."""

    def submit(self, item: Item) -> None:
        """Take an item to write; returns at once."""
        with self._turn:
            self._waiting = item
            if self._thread is None:
                # A daemon: a disk that hangs does not keep the process from ending.
                self._thread = threading.Thread(target=self._run, name="state", daemon=True)
                self._thread.start()
            self._turn.notify_all()

    def flush(self, seconds: float) -> bool:
        """Wait until all is written; return False if that takes longer [s]."""
        with self._turn:
            return self._turn.wait_for(
                lambda: self._waiting is None and not self._is_busy, timeout=seconds
            )

    def take_error(self) -> Exception | None:
        """Return what went wrong since the last call, if anything."""
        with self._turn:
            error, self._error = self._error, None
            return error

    def _run(self) -> None:
        while True:
            with self._turn:
                self._turn.wait_for(lambda: self._waiting is not None)
                item, self._waiting = self._waiting, None
                self._is_busy = True
            error: Exception | None = None
            try:
                if item is not None:
                    self._write(item)
            except Exception as problem:  # noqa: BLE001 - told by `take_error`; the thread lives on
                error = problem
            with self._turn:
                self._is_busy = False
                self._error = error
                self.written += error is None
                self._turn.notify_all()


# --- A file that is written by a thread of its own: a slow, full or broken disk never holds …

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

WAITING_BYTES: Final = 8 << 20
"""So much may wait for the disk [bytes]: at 2,000 frames/s more than a minute."""
_NOT_SYNCED: Final = frozenset({errno.EINVAL, errno.ENOTSUP, errno.EROFS})
RETRY_S: Final = 1.0
SYNC_EVERY_S: Final = 30.0
"""How often what was written is forced onto the disk, against power cuts [s]."""

_LOG = logging.getLogger(__name__)


@dataclass(slots=True)
class _Piece:
    """Bytes to write; at the end of the file unless a place is given."""

    data: bytes
    frames: int
    place: int | None


class DiskWriter:
    """The thread; it writes one file after the other.

    Attributes
    ----------
    written_bytes, lost_frames : int
    problem : str or None
        Why nothing can be written at present.
    """

    def __init__(self) -> None:
        self._work: deque[_Piece | Callable[[], None]] = deque()
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._done = threading.Event()
        self._handed_bytes = 0
        self._file: io.FileIO | None = None
        self._end = 0
        self._at = 0
        self._synced_s = time.monotonic()
        self.written_bytes = 0
        self.lost_frames = 0
        self.problem: str | None = None
        self._thread = threading.Thread(target=self._run, name="cangauge-record", daemon=True)
        self._thread.start()

    def begin(self, path: Path) -> None:
        """Begin a new file; one that stood there is replaced."""
        self.call(lambda: self._open(path))

    def call(self, action: Callable[[], None]) -> None:
        """Do something in the thread, after what was handed over so far."""
        self._work.append(action)
        self._wake.set()

    def write(self, data: bytes, frames: int, place: int | None = None) -> None:
        """Hand over a piece; it is dropped if too much waits already.

        Parameters
        ----------
        data : bytes
        frames : int
            Frames that are lost with it.
        place : int, optional
            Where to write; by default at the end.
        """
        waiting = self._handed_bytes - self.written_bytes
        # The beginning of a file is never dropped: nothing after it could be read.
        is_beginning = not frames and place is None
        if waiting > WAITING_BYTES and not is_beginning:
            self.lost_frames += frames
            return
        self._handed_bytes += len(data)
        self._work.append(_Piece(data, frames, place))
        self._wake.set()

    def close(self, within_s: float) -> bool:
        """Write what waits and end; return whether all was written in time [s]."""
        self._closing.set()
        self._wake.set()
        is_done = self._done.wait(within_s)
        self.lost_frames += sum(
            item.frames for item in list(self._work) if isinstance(item, _Piece)
        )
        return is_done and not self._work

    def _run(self) -> None:
        while True:
            self._wake.wait(SYNC_EVERY_S)
            self._wake.clear()
            is_last = self._closing.is_set()
            try:
                self._do_all()
                if is_last and not self._work:
                    # Written is enough for the end of the process; the rest is against power cuts.
                    self._done.set()
                    self._close_file()
                    return
                self._sync()
            except OSError as error:
                self._failed(error)
                if is_last:
                    self._done.set()
                    return
                self._closing.wait(RETRY_S)
                self._wake.set()

    def _do_all(self) -> None:
        while self._work:
            item = self._work[0]
            if isinstance(item, _Piece):
                self._write(item)
            else:
                item()
            # Only what is done is taken away: the next turn tries the rest again.
            self._work.popleft()

    def _write(self, piece: _Piece) -> None:
        if self._file is None:  # nothing is handed over before `begin`, which is tried until done
            return
        while piece.data:
            place = self._end if piece.place is None else piece.place
            if place != self._at:  # a pipe cannot seek, and need not
                self._at = self._file.seek(place)
            done = self._file.write(piece.data) or 0
            self._at += done
            self.written_bytes += done
            piece.data = piece.data[done:]
            if piece.place is None:
                self._end += done
            else:
                piece.place += done
        if self.problem is not None:
            self.problem = None
            emit(
                _LOG,
                logging.WARNING,
                "record.resumed",
                f"recording goes on; {self.lost_frames} frames were lost",
                lost_frames=self.lost_frames,
            )

    def _open(self, path: Path) -> None:
        self._close_file()
        self._file = io.FileIO(path, "w")
        self._end = self._at = 0

    def _sync(self) -> None:
        now_s = time.monotonic()
        if self._file is not None and now_s - self._synced_s >= SYNC_EVERY_S:
            self._synced_s = now_s
            _to_disk(self._file)

    def _close_file(self) -> None:
        if self._file is not None:
            file, self._file = self._file, None
            with file:
                if self._done.is_set() or not self._closing.is_set():
                    _to_disk(file)

    def _failed(self, error: OSError) -> None:
        self.problem = error.strerror or str(error)
        emit(
            _LOG,
            logging.ERROR,
            "record.failed",
            f"recording: {self.problem}; the estimate goes on, the disk is tried again",
            lost_frames=self.lost_frames,
        )


class RecordFile(io.RawIOBase):
    """What python-can's writers write into; they see one file of their own.

    Parameters
    ----------
    disk : DiskWriter
    """

    def __init__(self, disk: DiskWriter) -> None:
        self._disk = disk
        self._handed = 0
        """End of what the thread was given: a write before it changes what is there."""
        self._new = bytearray()
        self._changes: list[tuple[int, bytes]] = []
        self._position = 0

    def writable(self) -> bool:
        """Return True."""
        return True

    def readable(self) -> bool:
        """Return False."""
        return False

    def seekable(self) -> bool:
        """Return True: BLF has a header that is kept up to date."""
        return True

    def write(self, data: ReadableBuffer, /) -> int:
        """Keep bytes until they are handed over."""
        content = bytes(data)
        if self._position < self._handed:
            self._changes.append((self._position, content))
        else:
            begin = self._position - self._handed
            self._new[begin : begin + len(content)] = content
        self._position += len(content)
        return len(content)

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Go to a place; return it."""
        end = self._handed + len(self._new)
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: end}[whence]
        self._position = start + offset
        return self._position

    def tell(self) -> int:
        """Return the place."""
        return self._position

    @property
    def waiting(self) -> int:
        """How much is not handed over yet [bytes]."""
        return len(self._new)

    def hand_over(self, frames: int) -> None:
        """Give all that was written to the thread.

        Parameters
        ----------
        frames : int
            Frames in it.
        """
        if self._new:
            self._disk.write(bytes(self._new), frames)
            self._handed += len(self._new)
            self._new.clear()
        for place, content in self._changes:
            self._disk.write(content, 0, place)
        self._changes.clear()


def _to_disk(file: io.FileIO) -> None:
    try:
        os.fsync(file.fileno())
    except OSError as error:
        # A pipe or a device cannot be synced, and need not.
        if error.errno not in _NOT_SYNCED:
            raise
