"""Measurement files with channels on several rasters: MF4 signals.

Channels are chosen by name and unit as the columns of a table. The log's rows are those of the
current: voltage is interpolated to them, temperature and SoC are held, as for captures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from cangauge._dataframes import arrow_table
from cangauge._files import MIB, Head
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.columns import UnknownColumnsError, choose_columns
from cangauge.logs.draft import DraftLog
from cangauge.logs.table import ArrowTable, draft_of_table
from cangauge.logs.text import MAX_COLUMNS, MAX_ROWS

VOLTAGE_FILL_S: Final = 1.0
"""Longest time between two values of a channel for interpolation [s], as in captures."""
_TIME: Final = "time [s]"
"""Heading of the rasters' own time."""


class MeasuredChannel(NamedTuple):
    """Times [s] and values of a channel, shape (n,) each."""

    time_s: FloatArray
    values: FloatArray


def _draft_of_channels(
    head: Head,
    headings: Sequence[str],
    given: ColumnMap | None,
    read: Callable[[list[str]], Mapping[str, MeasuredChannel]],
) -> DraftLog:
    """Return the draft of the chosen channels on the raster of the current.

    Parameters
    ----------
    head : Head
    headings : sequence of str
        `name [unit]` of the channels.
    given : ColumnMap, optional
        The user's choice.
    read : callable
        Returns channels by heading.
    """
    source = str(head.path)
    names = [_TIME, *(name for name in headings if name != _TIME)]
    choice = choose_columns(names, (), given)
    if not choice.is_complete:
        raise UnknownColumnsError(source, names, choice, given)
    held = {
        names[p]
        for q in ("temperature", "soc")
        if q in choice.chosen
        for p in choice.chosen[q].places
    }
    current = names[choice.chosen["current"].places[0]]
    notes: list[str] = []

    def table(wanted: list[str]) -> Any:
        found = read([name for name in wanted if name != _TIME])
        time_s = found[current].time_s
        if not time_s.size:
            raise InputError("the channel holds no values", source=source, field=current)
        columns = {_TIME: time_s} if _TIME in wanted else {}
        for name in wanted:
            if name != _TIME:
                columns[name], note = _on_raster(time_s, found[name], name, is_held=name in held)
                notes.extend([note] if note else [])
        return arrow_table(columns)

    draft = draft_of_table(ArrowTable(names, table), given, name=head.name, source=source)
    draft.remarks.extend(notes)
    return draft


def _on_raster(
    time_s: FloatArray, channel: MeasuredChannel, name: str, *, is_held: bool
) -> tuple[FloatArray, str]:
    """Return a channel at the times of the current, and a remark on what was done."""
    if np.array_equal(channel.time_s, time_s):
        return channel.values, ""
    known = np.isfinite(channel.values) & np.isfinite(channel.time_s)
    order = np.argsort(channel.time_s[known], kind="stable")
    own_s, values = channel.time_s[known][order], channel.values[known][order]
    if not own_s.size:
        return np.full(time_s.size, np.nan), f"{name}: the channel holds no values"
    right = np.searchsorted(own_s, time_s, side="right")
    if is_held:  # before the first value, the first
        return values[np.maximum(right - 1, 0)], f"{name}: latest of its {own_s.size} values"
    filled = np.interp(time_s, own_s, values, left=np.nan, right=np.nan)
    before = own_s[np.clip(right - 1, 0, own_s.size - 1)]
    after = own_s[np.clip(right, 0, own_s.size - 1)]
    filled[(after - before > VOLTAGE_FILL_S) & (before != time_s)] = np.nan
    return filled, f"{name}: interpolated between its {own_s.size} values"


class Mf4Signals:
    """MF4 with signals, as CANape and INCA write them; one with bus logging is a capture."""

    takes_columns = True
    _BUS_LOGGING: Final = b"CAN_DataFrame"
    """Channel name of the standard for bus logging, stored uncompressed."""

    def matches(self, head: Head) -> bool:
        """Return whether the file is an MF4 without bus logging."""
        if not head.data.startswith((b"MDF     ", b"UnFinMF ")):
            return False
        tail = b""
        with head.open() as file:
            while part := file.read(MIB):
                if self._BUS_LOGGING in tail + part:
                    return False
                tail = part[-len(self._BUS_LOGGING) :]
        return True

    def read(self, head: Head, columns: ColumnMap | None = None) -> DraftLog:
        """Read the chosen signals.

        Raises
        ------
        InputError
            If a channel is not found, the file is damaged, or asammdf is not installed.
        """
        try:
            from asammdf import MDF  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise InputError(
                "reading MF4 needs asammdf", source=head.path, cure="pip install 'cangauge[mf4]'"
            ) from error
        try:
            with head.open() as unpacked, MDF(unpacked) as file:
                places = self._places(file)

                def read(names: list[str]) -> dict[str, MeasuredChannel]:
                    return {name: _signal(file, *places[name]) for name in names}

                draft = _draft_of_channels(head, list(places), columns, read)
        except InputError:
            raise
        except Exception as error:  # asammdf raises whatever a damaged block provokes
            raise InputError(
                f"the MF4 file is damaged ({type(error).__name__}: {error})"[:300],
                source=head.path,
                cure="export it again",
            ) from error
        draft.remarks.insert(0, f"MF4 with {len(places)} channels")
        return draft

    @staticmethod
    def _places(file: Any) -> dict[str, tuple[int, int]]:
        """Return group and index by heading; of channels with one name, that of most values."""
        places: dict[str, tuple[int, int]] = {}
        counts: dict[str, int] = {}
        for number, group in enumerate(file.groups):
            count = int(group.channel_group.cycles_nr)
            master = file.masters_db.get(number)
            for index, channel in enumerate(group.channels):
                if index == master or len(places) >= MAX_COLUMNS or not 0 < count <= MAX_ROWS:
                    continue
                unit = channel.unit or getattr(channel.conversion, "unit", "") or ""
                heading = f"{channel.name} [{unit}]" if unit else channel.name
                if count > counts.get(heading, 0):
                    places[heading], counts[heading] = (number, index), count
        return places


def _signal(file: Any, group: int, index: int) -> MeasuredChannel:
    signal = file.get(group=group, index=index)
    values = np.asarray(signal.samples)
    numbers = values.astype(np.float64) if values.dtype.kind in "iufb" else np.empty(0)
    return MeasuredChannel(np.asarray(signal.timestamps, dtype=np.float64)[: numbers.size], numbers)


READERS: Final = (Mf4Signals(),)
