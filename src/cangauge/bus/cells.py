"""Cell voltages of a vehicle: the signals of each cell, and their latest values.

A map file names them in one of two ways: an array of signals, one a cell, or a group of signals
that a counter in the frame assigns to cells (`mapping.CellsMap`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from cangauge.bus.database import Condition, Decode, Field

CELL_TIMEOUT_S: Final = 10.0
"""Age of a cell's voltage above which it is not known [s]: large packs send a round of cells in
some seconds."""

CELL_WITHIN_V: Final = (0.2, 6.0)
"""Plausible voltages of a cell [V], where none are stated."""


@dataclass(frozen=True, slots=True)
class CellGroup:
    """Cells whose voltages are together in a frame.

    Parameters
    ----------
    key : int
        Message key (`vehicle.EXTENDED`).
    message : str
    length : int
        Bytes of the message.
    conditions : tuple of Condition
        All must hold for the group to be in a frame.
    places : tuple of int
        Index of each cell, from 0.
    decoders : tuple of callable
        Decoder of each cell's voltage [V].
    index : Field, optional
        Raw number of the group; it times `len(decoders)` is added to the places.
    first_index : int
        Number of the first group.
    """

    key: int
    message: str
    length: int
    conditions: tuple[Condition, ...]
    places: tuple[int, ...]
    decoders: tuple[Decode, ...]
    index: Field | None = None
    first_index: int = 0


@dataclass(frozen=True, slots=True)
class CellSignals:
    """All cells of a vehicle.

    Parameters
    ----------
    count, first : int
        Number of cells in series; number of the first.
    groups : tuple of CellGroup
    lowest_v, highest_v : float
        Plausible voltages [V].
    timeout_s : float
        Age above which a voltage is not known [s].
    """

    count: int
    first: int
    groups: tuple[CellGroup, ...]
    lowest_v: float = CELL_WITHIN_V[0]
    highest_v: float = CELL_WITHIN_V[1]
    timeout_s: float = CELL_TIMEOUT_S

    @property
    def keys(self) -> tuple[int, ...]:
        """Keys of the messages, each once."""
        return tuple(dict.fromkeys(group.key for group in self.groups))


class CellVoltages:
    """Latest voltage of each cell, with its bus time.

    Parameters
    ----------
    signals : CellSignals

    Attributes
    ----------
    voltage_v, time_s : list of float
        By cell; NaN before the first plausible value.
    refused : int
        Values out of range.
    """

    def __init__(self, signals: CellSignals) -> None:
        self.signals = signals
        self.voltage_v = [math.nan] * signals.count
        self.time_s = [math.nan] * signals.count
        self.refused = 0
        self._taken_s = [math.nan] * signals.count

    def reader(self, key: int) -> Callable[[bytes | bytearray, float], None] | None:
        """Return what takes the payloads of a message with their time [s]; None: no cells in it."""
        groups = [group for group in self.signals.groups if group.key == key]
        if not groups:
            return None
        selectors = {each.field for group in groups for each in group.conditions}
        if len(selectors) == 1 and all(len(group.conditions) == 1 for group in groups):
            # One multiplexer: its value finds the group; a large pack has dozens.
            (selector,) = selectors
            by_value: dict[int, list[CellGroup]] = {}
            for group in groups:
                for value in group.conditions[0].values:
                    by_value.setdefault(value, []).append(group)

            def read_selected(payload: bytes | bytearray, time_s: float) -> None:
                for group in by_value.get(selector.get(payload), ()):
                    self._read(group, payload, time_s)

            return read_selected

        def read(payload: bytes | bytearray, time_s: float) -> None:
            for group in groups:
                if all(each.field.get(payload) in each.values for each in group.conditions):
                    self._read(group, payload, time_s)

        return read

    def take(self, now_s: float) -> tuple[list[float], list[float]]:
        """Return voltages [V] and bus times [s] that are new since the last call, NaN for others.

        A voltage older than the time-out at `now_s` [s] is not returned.
        """
        oldest_s, taken = now_s - self.signals.timeout_s, self._taken_s
        volts, times = [], []
        for place, time_s in enumerate(self.time_s):
            is_new = time_s >= oldest_s and time_s != taken[place]
            volts.append(self.voltage_v[place] if is_new else math.nan)
            times.append(time_s if is_new else math.nan)
            taken[place] = time_s
        return volts, times

    def _read(self, group: CellGroup, payload: bytes | bytearray, time_s: float) -> None:
        shift = 0
        if group.index is not None:
            shift = (group.index.get(payload) - group.first_index) * len(group.decoders)
        signals = self.signals
        for place, decode in zip(group.places, group.decoders, strict=True):
            at, volts = place + shift, decode(payload)
            if not 0 <= at < signals.count or math.isnan(volts):
                continue  # the last group may be filled up, and a cell be not available
            if not signals.lowest_v <= volts <= signals.highest_v:
                self.refused += 1
                continue
            self.voltage_v[at], self.time_s[at] = volts, time_s
