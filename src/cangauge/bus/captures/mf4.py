"""ASAM MF4, read in a child process with bounded memory and time.

The blocks of an MF4 file point at one another, and asammdf follows the pointers of a damaged file
in endless loops, into gigabytes of memory, or into errors of any kind. The child sends frames
through a pipe and is killed if it is silent for too long.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final, cast

import can

from cangauge._io import MAX_MF4_MEMORY, MF4_SILENCE_S, MF4_SILENCE_S_PER_MIB, MIB
from cangauge.bus.captures.reader import BinaryReader, is_whole
from cangauge.errors import InputError

_FRAME: Final = struct.Struct("<dIBBiB")
"""Stamp [s], id, flags by `_FLAGS`, DLC, channel (or `_NO_CHANNEL`), bytes of data that follow."""
_FLAGS: Final = (
    "is_extended_id",
    "is_remote_frame",
    "is_error_frame",
    "is_fd",
    "bitrate_switch",
    "error_state_indicator",
    "is_rx",
)
_NO_CHANNEL: Final = -(1 << 31)
_BLOCK: Final = struct.Struct("<cI")
"""Kind of block, and the number of bytes that follow."""
_FRAMES, _END, _DAMAGED, _MISSING = b"F", b"E", b"D", b"M"
_FRAMES_PER_BLOCK: Final = 500


class Mf4Reader(BinaryReader):
    """ASAM MF4 with bus logging."""

    name = "ASAM MF4"

    @classmethod
    def matches(cls, head: bytes) -> int:
        """Return 1 for an MDF file, else 0."""
        return int(head.startswith((b"MDF     ", b"UnFinMF ")))

    def read(self) -> Iterator[can.Message]:
        """Yield the frames.

        Raises
        ------
        InputError
            If asammdf is not installed.
        ValueError
            Where the file is damaged, or cannot be read within bounds of time and memory.
        """
        with tempfile.TemporaryDirectory() as folder:
            plain = Path(folder) / "x.mf4"
            with plain.open("wb") as copy:
                shutil.copyfileobj(self.raw, copy, MIB)
            patience_s = MF4_SILENCE_S + MF4_SILENCE_S_PER_MIB * plain.stat().st_size / MIB
            # The same interpreter and our own module: nothing in the file becomes a command.
            with subprocess.Popen(  # noqa: S603
                [sys.executable, "-m", "cangauge.bus.captures.mf4", str(plain)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            ) as child:
                try:
                    for message in _received(child, self.source, patience_s):
                        if is_whole(message):
                            yield message
                        else:
                            self.skip(None)
                finally:
                    child.kill()


def _received(
    child: subprocess.Popen[bytes], path: Path | None, patience_s: float
) -> Iterator[can.Message]:
    while True:
        what, data = _next_block(child, patience_s)
        if what != _FRAMES:
            break
        place = 0
        while place < len(data):
            message, place = _message(data, place)
            yield message
    if what == _END:
        return
    reason = data.decode("utf-8", errors="replace")
    if what == _MISSING:
        raise InputError(
            f"reading ASAM MF4 needs another package: {reason}",
            source=path,
            cure="pip install 'cangauge[mf4]'",
        )
    raise ValueError(reason)


def _next_block(child: subprocess.Popen[bytes], patience_s: float) -> tuple[bytes, bytes]:
    pipe = cast("BinaryIO", child.stdout)
    timer = threading.Timer(patience_s, child.kill)
    timer.start()
    try:
        head = pipe.read(_BLOCK.size)
        if len(head) < _BLOCK.size:
            return _DAMAGED, b"it cannot be read within bounds of time and memory"
        what, length = _BLOCK.unpack(head)
        return what, pipe.read(length)
    finally:
        timer.cancel()


def _message(data: bytes, place: int) -> tuple[can.Message, int]:
    stamp_s, number, flags, dlc, channel, length = _FRAME.unpack_from(data, place)
    place += _FRAME.size
    message = can.Message(
        timestamp=stamp_s,
        arbitration_id=number,
        dlc=dlc,
        channel=None if channel == _NO_CHANNEL else channel,
        data=data[place : place + length],
        **{name: bool(flags >> bit & 1) for bit, name in enumerate(_FLAGS)},
    )
    return message, place + length


def _packed(message: can.Message) -> bytes:
    flags = sum(bool(getattr(message, name)) << bit for bit, name in enumerate(_FLAGS))
    channel = message.channel if isinstance(message.channel, int) else _NO_CHANNEL
    data = bytes(message.data)
    head = _FRAME.pack(
        message.timestamp, message.arbitration_id, flags, message.dlc, channel, len(data)
    )
    return head + data


def _child(path: str, out: BinaryIO) -> None:
    """Send the frames of a file; the last block reports the end or the error."""

    def send(what: bytes, data: bytes) -> None:
        out.write(_BLOCK.pack(what, len(data)) + data)
        out.flush()

    frames: list[bytes] = []
    last = (_END, b"")
    try:
        for message in can.MF4Reader(path):
            frames.append(_packed(message))
            if len(frames) == _FRAMES_PER_BLOCK:
                send(_FRAMES, b"".join(frames))
                frames.clear()
    except NotImplementedError as error:
        last = (_MISSING, str(error).encode())
    except Exception as error:  # noqa: BLE001 - asammdf raises any kind of error on damage
        reason = f"{type(error).__name__}: {error}".splitlines()[0][:200]
        last = (_DAMAGED, reason.encode("utf-8", errors="replace"))
    send(_FRAMES, b"".join(frames))
    send(*last)


def _limit_memory() -> None:
    if sys.platform == "win32":
        return
    import resource  # noqa: PLC0415 - not on Windows

    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_DATA, (MAX_MF4_MEMORY, MAX_MF4_MEMORY))


if __name__ == "__main__":
    _limit_memory()
    _child(sys.argv[1], sys.stdout.buffer)
    # Skip the destructors of half-read files, which may take long or fail.
    os._exit(0)
