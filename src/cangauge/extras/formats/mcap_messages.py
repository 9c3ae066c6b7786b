"""MCAP files: messages read within bounds, and written with JSON schemas.

A recording has CAN frames on `/can/BUS` (schema `cangauge.CanFrame`), samples on `/sample`
(`cangauge.Sample`) and estimates on `/soc_estimate` (`cangauge.SocEstimate`), all as JSON, so that
Foxglove and PlotJuggler show them without a plug-in. Specification: mcap.dev/spec.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from os import PathLike
from typing import Any, Final, NamedTuple

from cangauge._files import MIB
from cangauge.errors import InputError

MAGIC: Final = b"\x89MCAP0\r\n"
FRAME, SAMPLE, ESTIMATE = "cangauge.CanFrame", "cangauge.Sample", "cangauge.SocEstimate"

MAX_RECORD_BYTES: Final = 64 * MIB
"""One record, packed: writers fill chunks of 1–4 MiB."""

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
        Where the file is damaged or cut off.
    """
    mcap = _need_mcap(path)
    schemas: dict[int, str] = {0: ""}
    channels: dict[int, Any] = {}
    reader = mcap.stream_reader.StreamReader(
        file, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES
    )
    try:
        for record in reader.records:
            if isinstance(record, mcap.records.Schema):
                schemas[record.id] = record.name
            elif isinstance(record, mcap.records.Channel):
                channels[record.id] = record
            elif isinstance(record, mcap.records.Message):
                channel = channels[record.channel_id]
                yield McapMessage(
                    channel.topic,
                    schemas.get(channel.schema_id, ""),
                    channel.message_encoding,
                    record.log_time,
                    record.data,
                )
            elif isinstance(record, mcap.records.DataEnd):
                return
    except mcap.exceptions.EndOfFile as error:
        raise EOFError("it ends in a record") from error
    except Exception as error:  # the packages of its compressions raise errors of their own
        raise ValueError(str(error) or type(error).__name__) from error


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
        import mcap.exceptions  # noqa: PLC0415 - an extra
        import mcap.records  # noqa: PLC0415
        import mcap.stream_reader  # noqa: PLC0415
        import mcap.writer  # noqa: PLC0415
    except ImportError as error:
        raise InputError(
            "MCAP needs the package mcap, which is not installed",
            source=path,
            cure="pip install 'cangauge[mcap]'",
        ) from error
    return mcap
