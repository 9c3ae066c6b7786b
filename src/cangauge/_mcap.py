"""MCAP files: messages read within bounds, and written with JSON schemas.

A recording has CAN frames on `/can/BUS` (schema `cangauge.CanFrame`), samples on `/sample`
(`cangauge.Sample`) and estimates on `/soc_estimate` (`cangauge.SocEstimate`), all as JSON, so that
Foxglove and PlotJuggler show them without a plug-in. Specification: mcap.dev/spec.
"""

from __future__ import annotations

import io
import json
import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from os import PathLike
from typing import Any, Final, NamedTuple

from cangauge._io import MAX_MCAP_RECORD, MIB
from cangauge.errors import InputError

MAGIC: Final = b"\x89MCAP0\r\n"
FRAME, SAMPLE, ESTIMATE = "cangauge.CanFrame", "cangauge.Sample", "cangauge.SocEstimate"

_FLAG: Final = {"type": "boolean"}


def _fields(**units: str) -> dict[str, dict[str, str]]:
    return {name: {"type": "number", "description": unit} for name, unit in units.items()}


SCHEMAS: Final[dict[str, dict[str, Any]]] = {
    FRAME: {
        "id": {"type": "integer", "description": "arbitration id"},
        "extended": _FLAG | {"description": "29-bit id"},
        "remote": _FLAG,
        "error": _FLAG | {"description": "error frame"},
        "fd": _FLAG | {"description": "CAN FD"},
        "brs": _FLAG | {"description": "bit rate switch"},
        "esi": _FLAG | {"description": "error state indicator"},
        "tx": _FLAG | {"description": "sent by the recording node"},
        "length": {"type": "integer", "description": "bytes of data, or asked for"},
        "data": {"type": "string", "contentEncoding": "base64"},
    },
    SAMPLE: _fields(
        time_s="bus time [s]",
        current_a="current [A], positive discharges",
        voltage_v="voltage [V]",
        temperature_c="temperature [°C]",
        soc_pct="the vehicle's own state of charge [%]",
    ),
    ESTIMATE: _fields(
        time_s="bus time [s]",
        soc_pct="state of charge of the chosen method [%]",
        soc_std_pct="its standard deviation [%]",
        soc_newton_pct="by inverse of the voltage model [%]",
        soc_coulomb_pct="by counting alone [%]",
        voltage_model_v="predicted voltage [V]",
        residual_v="measured minus predicted voltage [V]",
    )
    | {
        "status": {"type": "string", "description": "initialising, valid, degraded or invalid"},
        "reasons": {"type": "string", "description": 'separated by "; "'},
    },
}
"""Fields of the messages by schema; an unknown number is left out."""


class McapMessage(NamedTuple):
    """A message: topic, name of its schema, its encoding, log time [ns] and content."""

    topic: str
    schema: str
    encoding: str
    time_ns: int
    data: bytes

    def fields(self) -> dict[str, Any]:
        """Return the fields of a JSON message; raise ValueError if it is none."""
        if self.encoding != "json":
            raise ValueError(f"a message of encoding {self.encoding!r}")
        found = json.loads(self.data)
        if not isinstance(found, dict):
            raise ValueError("a message that is no JSON object")  # noqa: TRY004 - damaged content
        return found


def read_messages(file: Any, path: str | PathLike[str] | None) -> Iterator[McapMessage]:
    """Yield the messages of an MCAP file in its order.

    Parameters
    ----------
    file : binary file object
    path : path-like, optional
        For messages.

    Raises
    ------
    InputError
        If the package mcap is not installed.
    ValueError, EOFError
        Where the file is damaged or cut off, or an element exceeds its bound.
    """
    mcap = _need_mcap(path)
    schemas: dict[int, str] = {0: ""}
    channels: dict[int, Any] = {}
    if file.read(len(MAGIC)) != MAGIC:
        raise ValueError("it does not begin as an MCAP file")
    try:
        for record in _records(mcap, file):
            if isinstance(record, mcap.records.Schema):
                schemas[record.id] = record.name
            elif isinstance(record, mcap.records.Channel):
                channels[record.id] = record
            else:
                channel = channels[record.channel_id]
                yield McapMessage(
                    channel.topic,
                    schemas.get(channel.schema_id, ""),
                    channel.message_encoding,
                    record.log_time,
                    record.data,
                )
    except mcap.exceptions.McapError as error:
        raise EOFError("it ends in a record") from error
    except (RuntimeError, MemoryError, struct.error) as error:
        raise ValueError(str(error) or type(error).__name__) from error


def _records(mcap: Any, file: Any, *, is_chunk: bool = False) -> Iterator[Any]:
    """Yield schemas, channels and messages; chunks are opened, other records passed over.

    Read here, not by the package's StreamReader, which loads any record whole, such as an index of
    a stated length without bound.
    """
    kinds = mcap.opcode.Opcode
    while head := file.read(_HEAD.size):
        if len(head) < _HEAD.size:
            raise EOFError("it ends in a record")
        kind, size = _HEAD.unpack(head)
        if kind in {kinds.DATA_END, kinds.FOOTER} and not is_chunk:
            return
        if kind == kinds.CHUNK and not is_chunk:
            content = _unpacked(mcap.records.Chunk.read(_body(mcap, file, size)))
            yield from _records(mcap, io.BytesIO(content), is_chunk=True)
        elif kind == kinds.SCHEMA:
            yield mcap.records.Schema.read(_body(mcap, file, size))
        elif kind == kinds.CHANNEL:
            yield mcap.records.Channel.read(_body(mcap, file, size))
        elif kind == kinds.MESSAGE:
            yield mcap.records.Message.read(_body(mcap, file, size, _MESSAGE_HEAD), size)
        else:
            _pass_over(file, size)
    if not is_chunk:
        raise EOFError("it ends before its footer")


_HEAD: Final = struct.Struct("<BQ")
"""Kind of a record, and the number of bytes that follow."""
_MESSAGE_HEAD: Final = 22


def _body(mcap: Any, file: Any, size: int, least: int = 0) -> Any:
    """Return the content of a record as the stream that the package reads."""
    if not least <= size <= MAX_MCAP_RECORD:
        raise ValueError(f"a record of {size} bytes")
    body = file.read(size)
    if len(body) < size:
        raise EOFError("it ends in a record")
    return mcap.data_stream.ReadDataStream(io.BytesIO(body))


def _pass_over(file: Any, size: int) -> None:
    while size > 0:
        part = file.read(min(size, MIB))
        if not part:
            raise EOFError("it ends in a record")
        size -= len(part)


def _unpacked(chunk: Any) -> bytes:
    """Return the content of a chunk, which cannot exceed its bound."""
    limit = MAX_MCAP_RECORD
    if chunk.compression == "zstd":
        import zstandard  # noqa: PLC0415 - comes with mcap

        try:
            with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
                content = bytes(stream.read(limit + 1))
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from error
    elif chunk.compression == "lz4":
        import lz4.frame  # noqa: PLC0415 - comes with mcap

        content = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, limit + 1)
    elif chunk.compression:
        raise ValueError(f"an unknown compression {chunk.compression[:20]!r}")
    else:
        content = chunk.data
    if len(content) > limit:
        raise ValueError(f"a chunk that unpacks to more than {limit} bytes")
    if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
        raise ValueError("a chunk with a wrong checksum")
    return content


class McapTopics:
    """Write messages to an MCAP file, each schema and topic when it is first used.

    Parameters
    ----------
    file : binary file object
        Needs `write` and `tell`.
    path : path-like
        For messages.
    chunk_bytes : int
        Size of a compressed chunk before compression [bytes]: what a kill may lose.

    Raises
    ------
    InputError
        If the package mcap is not installed.
    """

    def __init__(
        self, file: Any, path: str | PathLike[str] | None, chunk_bytes: int = 1024 * 1024
    ) -> None:
        mcap = _need_mcap(path)
        # A plain object: the writer would put another buffer above a raw file.
        self._writer = mcap.writer.Writer(_Sink(file), chunk_size=chunk_bytes)
        self._writer.start(profile="", library="cangauge")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self, topic: str, schema: str, time_s: float, content: bytes) -> None:
        """Write a JSON message of one of `SCHEMAS`; times before 0 become 0."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._channels[topic] = self._writer.register_channel(
                topic, "json", self._schema(schema)
            )
        time_ns = max(round(time_s * 1e6), 0) * 1000
        self._writer.add_message(channel, time_ns, content, time_ns)

    def write_numbers(
        self, topic: str, schema: str, time_s: float, fields: Mapping[str, float | str]
    ) -> None:
        """Write a message of numbers and words; NaN is left out."""
        known = {
            name: value
            for name, value in fields.items()
            if not (isinstance(value, float) and math.isnan(value))
        }
        self.write(topic, schema, time_s, json.dumps(known, separators=(",", ":")).encode())

    def finish(self) -> None:
        """Complete the file with its index."""
        self._writer.finish()

    def _schema(self, name: str) -> int:
        found = self._schemas.get(name)
        if found is None:
            schema = {
                "$schema": "https://json-schema.org/draft/2020-12/schema",
                "title": name,
                "type": "object",
                "properties": SCHEMAS[name],
            }
            content = json.dumps(schema, ensure_ascii=False).encode()
            found = self._writer.register_schema(name, "jsonschema", content)
            self._schemas[name] = found
        return found


class _Sink:
    def __init__(self, file: Any) -> None:
        self.write = file.write
        self.tell = file.tell


def _need_mcap(path: str | PathLike[str] | None) -> Any:
    try:
        import mcap.data_stream  # noqa: PLC0415 - an extra
        import mcap.exceptions  # noqa: PLC0415
        import mcap.opcode  # noqa: PLC0415
        import mcap.records  # noqa: PLC0415
        import mcap.writer  # noqa: PLC0415
    except ImportError as error:
        raise InputError(
            "MCAP needs the package mcap, which is not installed",
            source=path,
            cure="pip install 'cangauge[mcap]'",
        ) from error
    return mcap
