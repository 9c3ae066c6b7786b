"""Measurement files with named channels on several rasters: MF4 signals, MCAP messages.

Channels are chosen by name and unit as the columns of a table. The log's rows are those of the
current; other channels are brought to its times as for captures.
"""

from __future__ import annotations

import json
from array import array
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from cangauge._bounded_child import BoundedChild, Send, serve
from cangauge._io import MAX_LOG_BYTES, MAX_LOG_COLUMNS, MAX_LOG_ROWS, MIB, open_unpacked
from cangauge._mcap import FRAME, SAMPLE, McapMessage, read_messages
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.arrow import build_table
from cangauge.logs.column_map import ColumnMap, choose_columns
from cangauge.logs.draft import DraftLog
from cangauge.logs.file_content import FileContent
from cangauge.logs.headings import FIELDS
from cangauge.logs.table_columns import draft_of_arrow, unknown_columns

VOLTAGE_FILL_S: Final = 1.0
"""Longest time between two values of a channel for interpolation [s], as in captures."""
_TIME: Final = "time [s]"
"""Heading of the rasters' own time."""
_HELD: Final = frozenset({"temperature", "soc"})
"""Quantities that change slowly: the latest value is taken, before the first the first."""


class Channel(NamedTuple):
    """Times [s] and values of a channel, shape (n,) each."""

    time_s: FloatArray
    values: FloatArray


_Read = Callable[[Sequence[str]], Mapping[str, Channel]]


def _draft_of_channels(
    content: FileContent, headings: Sequence[str], given: ColumnMap | None, read: _Read
) -> DraftLog:
    """Return the draft of the chosen channels on the raster of the current.

    Parameters
    ----------
    content : FileContent
    headings : sequence of str
        `name [unit]` of the channels.
    given : ColumnMap, optional
        The user's choice.
    read : callable
        Returns channels by heading.
    """
    source = str(content.path)
    names = [_TIME, *(name for name in headings if name != _TIME)]
    choice = choose_columns(names, (), given)
    if not choice.is_complete:
        raise unknown_columns(source, names, choice)
    quantity_of = {
        names[place]: quantity
        for quantity, column in choice.chosen.items()
        for place in column.places
    }
    current = names[choice.chosen["current"].places[0]]
    notes: list[str] = []

    def table(wanted: Sequence[str]) -> Any:
        found = read([name for name in wanted if name != _TIME])
        time_s = found[current].time_s
        if not time_s.size:
            raise InputError("the channel holds no values", source=source, field=current)
        columns = {}
        for name in wanted:
            if name == _TIME:
                columns[name] = time_s
                continue
            quantity = quantity_of.get(name, "")
            columns[name], note = _on_raster(time_s, found[name], name, quantity)
            notes.extend(filter(None, [note]))
        return build_table(columns)

    draft = draft_of_arrow(names, given, name=content.name, source=source, read=table)
    draft.remarks.extend(notes)
    return draft


def _on_raster(
    time_s: FloatArray, channel: Channel, name: str, quantity: str
) -> tuple[FloatArray, str]:
    """Return a channel at the times of the current, and what was done [str]."""
    if channel.time_s.size == time_s.size and np.array_equal(channel.time_s, time_s):
        return channel.values, ""
    known = np.isfinite(channel.values) & np.isfinite(channel.time_s)
    own_s, values = channel.time_s[known], channel.values[known]
    if not own_s.size:
        return np.full(time_s.size, np.nan), f"{name}: the channel holds no values"
    order = np.argsort(own_s, kind="stable")
    own_s, values = own_s[order], values[order]
    right = np.searchsorted(own_s, time_s, side="right")
    if quantity in _HELD:
        held = values[np.maximum(right - 1, 0)]
        return held, f"{name}: latest of its {own_s.size} values"
    filled = np.interp(time_s, own_s, values, left=np.nan, right=np.nan)
    before = own_s[np.clip(right - 1, 0, own_s.size - 1)]
    after = own_s[np.clip(right, 0, own_s.size - 1)]
    filled[(after - before > VOLTAGE_FILL_S) & (before != time_s)] = np.nan
    return filled, f"{name}: interpolated between its {own_s.size} values"


# --- MF4 with signals, as CANape and INCA write them, through asammdf in a bounded child process

_BUS_LOGGING: Final = b"CAN_DataFrame"
"""Channel name of the standard for bus logging."""


def has_mf4_frames(path: Path) -> bool:
    """Return whether an MF4 file holds bus logging; names are stored uncompressed."""
    tail = b""
    with open_unpacked(path, MAX_LOG_BYTES) as file:
        while part := file.read(MIB):
            if _BUS_LOGGING in tail + part:
                return True
            tail = part[-len(_BUS_LOGGING) :]
    return False


def read_mf4(content: FileContent, given: ColumnMap | None = None) -> DraftLog:
    """Read the signals of an MF4 file.

    Raises
    ------
    InputError
        If a channel is not found, the file is damaged, or asammdf is not installed.
    """
    try:
        with (
            open_unpacked(content.path, MAX_LOG_BYTES) as file,
            BoundedChild("cangauge.logs.measurement", file, content.path) as child,
        ):
            blocks = child.blocks()
            headings = json.loads(next(blocks, b"[]"))
            if not headings:
                raise InputError(
                    "the MF4 file holds no channels", source=content.path, cure="export it again"
                )

            def read(names: Sequence[str]) -> dict[str, Channel]:
                child.ask(json.dumps(list(names)).encode())
                found = {}
                for name in names:
                    times, values = next(blocks, b""), next(blocks, b"")
                    found[name] = Channel(np.frombuffer(times), np.frombuffer(values))
                return found

            draft = _draft_of_channels(content, headings, given, read)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(
            f"the MF4 file is damaged ({error})", source=content.path, cure="export it again"
        ) from error
    draft.remarks.insert(0, f"MF4 with {len(headings)} channels")
    return draft


def _serve_channels(path: str, send: Send) -> None:
    """Send the headings of all channels, take the chosen ones, send their times and values."""
    import sys  # noqa: PLC0415 - only in the child

    from asammdf import MDF  # noqa: PLC0415 - an extra

    with MDF(path) as file:
        places = _channel_places(file)
        send(json.dumps(list(places)).encode())
        for name in json.loads(sys.stdin.buffer.readline()):
            group, index = places[name]
            signal = file.get(group=group, index=index)
            values = np.asarray(signal.samples)
            numbers = values.astype(np.float64) if values.dtype.kind in "iufb" else values[:0]
            times = np.asarray(signal.timestamps, dtype=np.float64)[: numbers.size]
            send(times.tobytes())
            send(numbers.tobytes())


def _channel_places(file: Any) -> dict[str, tuple[int, int]]:
    """Return group and index by heading; of several with one name, the one with most values."""
    places: dict[str, tuple[int, int]] = {}
    counts: dict[str, int] = {}
    for group_number, group in enumerate(file.groups):
        count = int(group.channel_group.cycles_nr)
        master = file.masters_db.get(group_number)
        for index, channel in enumerate(group.channels):
            if index == master or len(places) >= MAX_LOG_COLUMNS or not 0 < count <= MAX_LOG_ROWS:
                continue
            conversion = channel.conversion
            unit = channel.unit or (conversion.unit if conversion is not None else "") or ""
            heading = f"{channel.name} [{unit}]" if unit else channel.name
            if count > counts.get(heading, 0):
                places[heading], counts[heading] = (group_number, index), count
    return places


# --- MCAP

_DAMAGE: Final = (ValueError, LookupError, ArithmeticError, EOFError, OSError, RecursionError)
_FIRST_MESSAGES: Final = 1000
"""Messages among which a file with CAN frames shows one."""


def has_mcap_frames(path: Path) -> bool:
    """Return whether an MCAP file holds CAN frames among its first messages."""
    with open_unpacked(path, MAX_LOG_BYTES) as file:
        try:
            for number, message in enumerate(read_messages(file, path)):
                if message.schema == FRAME:
                    return True
                if number > _FIRST_MESSAGES:
                    break
        except _DAMAGE:
            return False
    return False


def read_mcap(content: FileContent, given: ColumnMap | None = None) -> DraftLog:
    """Read the samples of an MCAP file, or the numbers in JSON messages of any schema.

    Raises
    ------
    InputError
        If it is damaged before its end, a field is not found, or mcap is not installed.
    """
    channels: dict[str, tuple[array[float], array[float]]] = {}
    cut_off = ""
    has_samples = False
    with open_unpacked(content.path, MAX_LOG_BYTES) as file:
        try:
            for message in read_messages(file, content.path):
                if message.encoding != "json" or message.schema == FRAME:
                    continue
                if message.schema == SAMPLE and not has_samples:
                    has_samples = True
                    channels.clear()
                if has_samples and message.schema != SAMPLE:
                    continue
                _collect(channels, message, content.path, with_topic=not has_samples)
        except (
            ValueError,
            LookupError,
            ArithmeticError,
            EOFError,
            OSError,
            RecursionError,
        ) as error:
            cut_off = f"{type(error).__name__}: {error}".splitlines()[0][:200]
    if not channels:
        raise InputError(
            f"the MCAP file is damaged ({cut_off})"
            if cut_off
            else "the MCAP file holds no numbers",
            source=content.path,
            cure="record it again",
        )
    found = {
        name: Channel(np.array(times), np.array(values))
        for name, (times, values) in channels.items()
    }
    if has_samples:
        draft = _draft_of_samples(content, found)
    else:
        draft = _draft_of_channels(content, list(found), given, lambda _: found)
    if cut_off:
        draft.remarks.append(f"the file is cut off or damaged ({cut_off})")
    return draft


def _collect(
    channels: dict[str, tuple[array[float], array[float]]],
    message: McapMessage,
    path: Path,
    *,
    with_topic: bool,
) -> None:
    time_s = message.time_ns / 1_000_000_000
    for field, value in _numbers(message.fields(), ""):
        name = f"{message.topic} {field}" if with_topic else field
        if name not in channels:
            if len(channels) >= MAX_LOG_COLUMNS:
                continue
            channels[name] = (array("d"), array("d"))
        times, values = channels[name]
        if len(times) >= MAX_LOG_ROWS:
            raise InputError(
                f"more than the {MAX_LOG_ROWS} rows that a log may have",
                source=path,
                cure="split it",
            )
        times.append(time_s)
        values.append(value)


def _numbers(fields: Mapping[str, Any], before: str) -> list[tuple[str, float]]:
    """Return the numbers of an object and of objects in it, by their dotted names."""
    found = []
    for name, value in fields.items():
        if isinstance(value, dict):
            found += _numbers(value, f"{before}{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found.append((f"{before}{name}", float(value)))
    return found


def _draft_of_samples(content: FileContent, found: Mapping[str, Channel]) -> DraftLog:
    """Return the samples of a recording; a value that one lacks is filled from its neighbours."""
    draft = DraftLog(content.name, str(content.path), drop_incomplete=True)
    rows = found.get("time_s")
    if rows is None or "current_a" not in found or "voltage_v" not in found:
        raise InputError(
            "the samples lack time, current or voltage", source=content.path, cure="record it again"
        )
    for quantity, field in FIELDS.items():
        channel = found.get(field)
        if channel is None:
            continue
        draft.labels[field] = f"/sample {field}"
        draft.values[field] = (
            rows.values
            if quantity == "time"
            else _on_raster(rows.time_s, channel, field, quantity)[0]
        )
    return draft


if __name__ == "__main__":
    serve(_serve_channels)
