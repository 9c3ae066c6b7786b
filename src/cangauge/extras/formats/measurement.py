"""Measurement files with channels on several rasters: MF4 signals.

Channels are chosen by name and unit as the columns of a table. The log's rows are those of the
current: voltage is interpolated to them, temperature and SoC are held, as for captures.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from cangauge._files import MIB, Head
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.extras.formats.channels import Channels
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.draft import DraftLog
from cangauge.logs.table import HOLD_S
from cangauge.logs.text import MAX_COLUMNS, MAX_ROWS


class Mf4Signals(Channels):
    """MF4 with signals, as CANape and INCA write them; one with bus logging is a capture.

    An instance is an open file; `places` are group and index of each signal by its name.
    """

    takes_columns = True
    time = "time [s]"
    _BUS_LOGGING: Final = b"CAN_DataFrame"
    """Channel name of the standard for bus logging, stored uncompressed."""

    def __init__(self, file: Any, places: dict[str, tuple[int, int]], source: Path) -> None:
        self._file, self._places, self._source = file, places, source
        self.remarks = []

    @property
    def headings(self) -> list[str]:
        """Names and units of the signals."""
        return [*self._places]

    def _signal(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Return times [s] and values, none of a signal that holds no numbers."""
        group, index = self._places[name]
        signal = self._file.get(group=group, index=index)
        values = np.asarray(signal.samples)
        numbers = values.astype(np.float64) if values.dtype.kind in "iufb" else np.empty(0)
        return np.asarray(signal.timestamps, dtype=np.float64)[: numbers.size], numbers

    def rows_of(self, current: list[str], voltage: list[str]) -> FloatArray:
        """Return the raster of the current [s]."""
        del voltage
        rows_s, _ = self._signal(current[0])
        if not rows_s.size:
            problem = "the channel holds no values"
            raise InputError(problem, source=self._source, field=current[0])
        return rows_s

    def at(self, name: str, rows_s: FloatArray, quantity: str) -> FloatArray:
        """Return a signal interpolated between near values; temperature and SoC are held."""
        time_s, values = self._signal(name)
        if np.array_equal(time_s, rows_s):
            return values
        known = np.isfinite(values) & np.isfinite(time_s)
        order = np.argsort(time_s[known], kind="stable")
        own_s, values = time_s[known][order], values[known][order]
        if not own_s.size:
            self.remarks.append(f"{name}: the channel holds no values")
            return np.full(rows_s.size, np.nan)
        right = np.searchsorted(own_s, rows_s, side="right")
        if quantity in {"temperature", "soc"}:  # before the first value, the first
            self.remarks.append(f"{name}: latest of its {own_s.size} values")
            return values[np.maximum(right - 1, 0)]
        self.remarks.append(f"{name}: interpolated between its {own_s.size} values")
        filled = np.interp(rows_s, own_s, values, left=np.nan, right=np.nan)
        before = own_s[np.clip(right - 1, 0, own_s.size - 1)]
        after = own_s[np.clip(right, 0, own_s.size - 1)]
        filled[(after - before > HOLD_S) & (before != rows_s)] = np.nan
        return filled

    @classmethod
    def matches(cls, head: Head) -> bool:
        """Return whether the file is an MF4 without bus logging."""
        if not head.data.startswith((b"MDF     ", b"UnFinMF ")):
            return False
        tail = b""
        with head.open() as file:
            while part := file.read(MIB):
                if cls._BUS_LOGGING in tail + part:
                    return False
                tail = part[-len(cls._BUS_LOGGING) :]
        return True

    @classmethod
    def read(cls, head: Head, columns: ColumnMap | None = None) -> DraftLog:
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
                places = cls._places_in(file)
                draft = cls(file, places, head.path).draft(head, columns)
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
    def _places_in(file: Any) -> dict[str, tuple[int, int]]:
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


READERS: Final = (Mf4Signals,)
