"""ASAM MF4 with bus logging, read by python-can and asammdf in a bounded child process."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final

import can

from cangauge._bounded_child import BoundedChild, Send, serve
from cangauge.bus.captures.reader import BinaryReader, is_whole

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
        with BoundedChild("cangauge.bus.captures.mf4", self.raw, self.source) as child:
            for data in child.blocks():
                place = 0
                while place < len(data):
                    message, place = _message(data, place)
                    if is_whole(message):
                        yield message
                    else:
                        self.skip(None)


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


def _child(path: str, send: Send) -> None:
    frames: list[bytes] = []
    try:
        for message in can.MF4Reader(path):
            frames.append(_packed(message))
            if len(frames) == _FRAMES_PER_BLOCK:
                send(b"".join(frames))
                frames.clear()
    finally:
        send(b"".join(frames))


if __name__ == "__main__":
    serve(_child)
