"""CAN frames in MCAP files, as messages of the schema `cangauge.CanFrame`."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from typing import IO, Any, Final

import can
from can.io.generic import BinaryIOMessageWriter
from can.typechecking import StringPathLike

from cangauge.bus.readers import MAX_ID, BinaryReader
from cangauge.errors import InputError
from cangauge.extras.formats.mcap_messages import FRAME, MAGIC, McapTopics, read_messages

_TOPIC: Final = "/can/"


class McapReader(BinaryReader):
    """MCAP with CAN frames; other messages are omitted."""

    name = "MCAP"
    unit = "messages"

    @classmethod
    def matches(cls, head: bytes) -> bool:
        """Return whether it is an MCAP file."""
        return head.startswith(MAGIC)

    def read(self) -> Iterator[can.Message]:
        """Yield the frames."""
        other = 0
        for message in read_messages(self.raw, self.source):
            if message.schema != FRAME:
                other += 1
                continue
            try:
                frame = _frame(message.fields())
            except (ValueError, KeyError, TypeError, RecursionError):
                self.skip(None)
                continue
            # Integers divide to the nearest float, which is the stamp that was written.
            frame.timestamp = message.time_ns / 1_000_000_000
            frame.channel = _channel(message.topic)
            yield frame
        if other and not self.frames:
            raise InputError(
                f"none of its {other} messages is a CAN frame (schema {FRAME})",
                source=self.source,
                cure="record frames by cangauge run --record drive.mcap",
            )


def _frame(fields: dict[str, Any]) -> can.Message:
    number, length, data = fields["id"], fields["length"], fields["data"]
    if not (isinstance(number, int) and 0 <= number <= MAX_ID):
        raise ValueError("no such id")
    if not (isinstance(length, int) and 0 <= length <= 64):
        raise ValueError("no such length")
    content = base64.b64decode(data, validate=True)
    if len(content) != (0 if fields.get("remote") else length):
        raise ValueError("length and bytes differ")
    return can.Message(
        arbitration_id=number,
        is_extended_id=bool(fields.get("extended")),
        is_remote_frame=bool(fields.get("remote")),
        is_error_frame=bool(fields.get("error")),
        is_fd=bool(fields.get("fd")),
        bitrate_switch=bool(fields.get("brs")),
        error_state_indicator=bool(fields.get("esi")),
        is_rx=not fields.get("tx"),
        dlc=length,
        data=content,
    )


def _channel(topic: str) -> str | int | None:
    name = topic.removeprefix(_TOPIC)
    if not topic.startswith(_TOPIC) or not name:
        return None
    return int(name) if name.isdecimal() and len(name) < 10 else name


_NAMES: Final = ("false", "true")


def frame_content(message: can.Message) -> bytes:
    """Return a frame as the JSON of the schema `cangauge.CanFrame`."""
    flag = _NAMES
    data = base64.b64encode(message.data).decode()
    return (
        f'{{"id":{message.arbitration_id},"extended":{flag[message.is_extended_id]},'
        f'"remote":{flag[message.is_remote_frame]},"error":{flag[message.is_error_frame]},'
        f'"fd":{flag[message.is_fd]},"brs":{flag[message.bitrate_switch]},'
        f'"esi":{flag[message.error_state_indicator]},"tx":{flag[not message.is_rx]},'
        f'"length":{message.dlc},"data":"{data}"}}'
    ).encode()


def frame_topic(message: can.Message) -> str:
    """Return the topic of a frame: `/can/BUS`."""
    return _TOPIC if message.channel is None else f"{_TOPIC}{message.channel}"


class McapWriter(BinaryIOMessageWriter):
    """Write CAN frames to an MCAP file, in python-can's shape.

    Stamps are kept in whole microseconds from 0 on.

    Parameters
    ----------
    file : path-like or binary file object
    **_options : object
        Ignored; python-can passes options of other writers too.
    """

    def __init__(self, file: StringPathLike | IO[Any], **_options: object) -> None:
        super().__init__(file)  # type: ignore[arg-type]
        self.topics = McapTopics(self.file, getattr(self.file, "name", None))

    def on_message_received(self, msg: can.Message) -> None:
        """Write a frame."""
        self.topics.write(frame_topic(msg), FRAME, msg.timestamp, frame_content(msg))

    def stop(self) -> None:
        """Complete the file and close it."""
        self.topics.finish()
        super().stop()
