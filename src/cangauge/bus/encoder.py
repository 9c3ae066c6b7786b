"""Samples → frames: the inverse of `decoder`, with the quantization that frames cause."""

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
from cangauge.bus.time_source import MICROSECONDS
from cangauge.bus.vehicle import LOG_COLUMNS, Vehicle, VehicleSignal
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.types import Sample

SLOW_EVERY_S: Final = 1.0
"""Longest interval at which temperature and SoC are sent without a change, in log time [s]."""

_UNITS: Final = {"current": "A", "voltage": "V", "temperature": "°C", "soc_reference": "%"}


@dataclass(slots=True)
class _Outgoing:
    """A frame to send: the signals of one message that share a payload."""

    signals: tuple[VehicleSignal, ...]
    rule: Protection | None
    is_slow: bool
    last: bytes = b""
    last_s: float = -math.inf


class FrameEncoder:
    """Encode samples as frames; the inverse of `SampleDecoder`.

    Slow signals (temperature, SoC) come first, so that they apply to their own sample; then
    current; then voltage. Slow ones are sent when their quantized value changes, and every
    `SLOW_EVERY_S` of log time. Alive counters run per message. Time stamps are the samples' times.

    Parameters
    ----------
    vehicle : Vehicle
    """

    def __init__(self, vehicle: Vehicle) -> None:
        if any(each.is_reply for each in vehicle.messages.values()):
            raise InputError(
                "replies over ISO-TP are received only",
                source=vehicle.name,
                cure="use a vehicle without them, and --temperature",
            )
        self.vehicle = vehicle
        self._counters = dict.fromkeys(vehicle.messages, 0)
        self._frames = _plan(vehicle)

    def encode(self, sample: Sample, soc_reference_pct: float | None = None) -> list[can.Message]:
        """Return the frames of one sample, in sending order.

        Parameters
        ----------
        sample : Sample
            A frame whose values are all NaN is not sent; a NaN among others becomes the DBC's
            code for "not available".
        soc_reference_pct : float, optional
            Sent where the vehicle has such a signal; None or NaN: not sent.

        Raises
        ------
        InputError
            If a value does not fit into its signal, or is NaN without such a code.
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
            signal.codec.encode_into(payload, value)
        if frame.is_slow:
            if payload == frame.last and 0.0 <= time_s - frame.last_s < SLOW_EVERY_S:
                return None
            frame.last, frame.last_s = bytes(payload), time_s
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
        """Check that every value of a log fits into its signal, before anything is sent.

        Raises
        ------
        InputError
            Names the first signal that is too narrow, its range, the value and its row.
        """
        for signal, field, values in self._columns(log):
            bad = np.flatnonzero(~signal.codec.fits(values))
            if bad.size:
                row = int(bad[0])
                low, high = signal.codec.range
                unit = _UNITS[signal.role]
                raise InputError(
                    f"does not fit into signal {signal.codec.name} of {signal.message}, which"
                    f" holds {low:g} to {high:g} {unit}; the first such row is {row + 1}",
                    source=log.source or log.name,
                    field=field,
                    value=float(values[row]),
                    cure="replay it as another --vehicle",
                )

    def quantization(self) -> dict[str, float]:
        """Return the largest quantization errors of frames: half a step.

        Returns
        -------
        dict of str to float
            `current_a` [A], `voltage_v` [V], `temperature_c` [°C], `soc_pct` [%], where the
            vehicle sends them, and `time_s` [s] for REPLAY_CLOCK.
        """
        steps = {
            LOG_COLUMNS[signal.role]: signal.codec.half_step for signal in self.vehicle.signals
        }
        return {**steps, "time_s": 0.5 / MICROSECONDS}

    def quantize(self, log: Log) -> Log:
        """Return the log as decoded from its frames with REPLAY_CLOCK, bit for bit.

        A vehicle without a temperature signal gives its fixed temperature, or the log's if it has
        none.
        """
        sent = {
            field: signal.codec.quantize(values) for signal, field, values in self._columns(log)
        }
        if not math.isnan(self.vehicle.fixed_temperature_c):
            sent["temperature_c"] = np.full(len(log), self.vehicle.fixed_temperature_c)
        return replace(
            log,
            time_s=np.rint(log.time_s * MICROSECONDS) / MICROSECONDS,
            current_a=sent["current_a"],
            voltage_v=sent["voltage_v"],
            temperature_c=sent.get("temperature_c", log.temperature_c),
            soc_pct=sent.get("soc_pct", log.soc_pct),
        )

    def _columns(self, log: Log) -> list[tuple[VehicleSignal, str, FloatArray]]:
        found = []
        for signal in self.vehicle.signals:
            values = getattr(log, LOG_COLUMNS[signal.role])
            if values is not None:
                found.append((signal, LOG_COLUMNS[signal.role], values))
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
