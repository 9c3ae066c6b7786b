"""Samples → frames: what replay sends, and what the decoder will make of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import can
import numpy as np

from cangauge._typing import FloatArray
from cangauge.bus.database import Condition
from cangauge.bus.protection import Protection
from cangauge.bus.vehicle import Vehicle, VehicleSignal
from cangauge.errors import InputError
from cangauge.estimate.validity import Sample
from cangauge.logs.log import Log

SLOW_EVERY_S: Final = 1.0
"""Temperature and SoC are sent when they change, and at least this often in log time [s]."""
MICROSECONDS: Final = 1e6
"""REPLAY_CLOCK tells the log's time in whole microseconds: time_s = log_time_us / 1e6."""

_FIELDS: Final = {
    "current": "current_a",
    "voltage": "voltage_v",
    "temperature": "temperature_c",
    "soc_reference": "soc_pct",
}
_UNITS: Final = {"current": "A", "voltage": "V", "temperature": "°C", "soc_reference": "%"}


@dataclass(slots=True)
class _Outgoing:
    """One frame to send: signals of one message that can stand in one payload."""

    signals: tuple[VehicleSignal, ...]
    rule: Protection | None
    is_slow: bool
    last: bytes = b""
    last_s: float = -math.inf

    def is_due(self, payload: bytes, time_s: float) -> bool:
        """Return whether a slow frame must be sent again, and remember that it was."""
        if payload == self.last and 0.0 <= time_s - self.last_s < SLOW_EVERY_S:
            return False
        self.last, self.last_s = payload, time_s
        return True


class FrameEncoder:
    """Makes frames of samples; the inverse of `SampleDecoder`.

    Slow signals (temperature, SoC) go first, so that a sample finds its own temperature, then
    current, then voltage. Slow ones are sent when their value as a frame carries it changes, and
    every `SLOW_EVERY_S` of log time. Counters run on over all samples, per message. Frames carry
    the sample's time as time stamp.

    Parameters
    ----------
    vehicle : Vehicle
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self._counters = dict.fromkeys(vehicle.messages, 0)
        self._frames = _plan(vehicle)

    def encode(self, sample: Sample, soc_reference_pct: float | None = None) -> list[can.Message]:
        """Return the frames of one sample, in the order in which they are to be sent.

        Parameters
        ----------
        sample : Sample
            Where all values of a frame are NaN it is not sent; one NaN among others becomes the
            DBC's code for "not available".
        soc_reference_pct : float, optional
            Sent where the vehicle has such a signal; None or NaN: not sent.

        Raises
        ------
        InputError
            If a value does not fit into its signal, or is NaN without a code for that (names it).
        """
        values = {
            "current": sample.current_a,
            "voltage": sample.voltage_v,
            "temperature": sample.temperature_c,
            "soc_reference": math.nan if soc_reference_pct is None else soc_reference_pct,
        }
        messages = []
        for frame in self._frames:
            message = self._frame(
                frame, [values[each.role] for each in frame.signals], sample.time_s
            )
            if message is not None:
                messages.append(message)
        return messages

    def _frame(
        self, frame: _Outgoing, values: Sequence[float], time_s: float
    ) -> can.Message | None:
        if all(math.isnan(value) for value in values):
            return None
        first = frame.signals[0]
        payload = bytearray(first.length)
        for signal, value in zip(frame.signals, values, strict=True):
            signal.encode_into(payload, value)
        if frame.is_slow and not frame.is_due(bytes(payload), time_s):
            return None
        if frame.rule is not None:
            counter = self._counters[first.key]
            self._counters[first.key] = counter + 1
            payload = bytearray(frame.rule.protect(payload, counter))
        return can.Message(
            timestamp=time_s,
            arbitration_id=first.arbitration_id,
            is_extended_id=first.is_extended,
            is_fd=first.length > 8,
            data=payload,
        )

    def check_range(self, log: Log) -> None:
        """Check once, before anything is sent, that every value of a log fits into its signal.

        Raises
        ------
        InputError
            For the first signal that is too narrow: names it, its range, the value and its row.
        """
        for signal, field, values in self._columns(log):
            bad = np.flatnonzero(~signal.fits(values))
            if bad.size:
                row = int(bad[0])
                low, high = signal.range
                unit = _UNITS[signal.role]
                raise InputError(
                    f"does not fit into signal {signal.codec.name} of {signal.message}, which"
                    f" holds {low:g} to {high:g} {unit}; the first such row is {row + 1}",
                    source=log.source or log.name,
                    field=field,
                    value=float(values[row]),
                    cure="replay it as another --vehicle",
                )

    def quantisation(self) -> dict[str, float]:
        """Return by how much a frame can differ from the log by rounding: half a step.

        Returns
        -------
        dict of str to float
            `current_a` [A], `voltage_v` [V], `temperature_c` [°C], `soc_pct` [%], where the
            vehicle sends them, and `time_s` [s] for REPLAY_CLOCK.
        """
        steps = {_FIELDS[signal.role]: signal.half_step for signal in self.vehicle.signals}
        return {**steps, "time_s": 0.5 / MICROSECONDS}

    def quantise(self, log: Log) -> Log:
        """Return the log as the decoder gets it, to the last bit, when time is REPLAY_CLOCK's.

        A vehicle without a temperature signal has its fixed temperature in every row, or the
        log's where it has none.
        """
        sent = {field: signal.quantise(values) for signal, field, values in self._columns(log)}
        if not math.isnan(self.vehicle.fixed_temperature_c):
            sent["temperature_c"] = np.full(len(log), self.vehicle.fixed_temperature_c)
        microseconds = np.rint(log.time_s * MICROSECONDS)
        return replace(
            log,
            time_s=microseconds / MICROSECONDS,
            current_a=sent["current_a"],
            voltage_v=sent["voltage_v"],
            temperature_c=sent.get("temperature_c", log.temperature_c),
            soc_pct=sent.get("soc_pct", log.soc_pct),
        )

    def _columns(self, log: Log) -> list[tuple[VehicleSignal, str, FloatArray]]:
        found = []
        for signal in self.vehicle.signals:
            values = getattr(log, _FIELDS[signal.role])
            if values is not None:
                found.append((signal, _FIELDS[signal.role], values))
        return found


def _plan(vehicle: Vehicle) -> list[_Outgoing]:
    """Return the frames of one sample, slow ones first."""
    groups: dict[tuple[int, tuple[Condition, ...]], list[VehicleSignal]] = {}
    for signal in vehicle.signals:
        groups.setdefault((signal.key, signal.codec.conditions), []).append(signal)
    frames = []
    for (key, conditions), signals in groups.items():
        is_slow = all(signal.role in {"temperature", "soc_reference"} for signal in signals)
        if not is_slow and any(other == key and more != conditions for other, more in groups):
            raise InputError(
                "has multiplexed frames with current or voltage, which cannot be replayed",
                source=vehicle.dbc_files[0],
                field=signals[0].message,
                cure="replay as another --vehicle",
            )
        frames.append(_Outgoing(tuple(signals), vehicle.messages[key].rule, is_slow))
    return sorted(frames, key=lambda frame: not frame.is_slow)
