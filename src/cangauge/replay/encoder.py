"""Samples → frames: the inverse of `decoder`, with the quantization that frames cause."""

from __future__ import annotations

import math
from operator import itemgetter
from typing import Final

import can
import numpy as np

from cangauge.bus.database import Condition
from cangauge.bus.time_source import MICROSECONDS
from cangauge.bus.vehicle import LOG_COLUMNS, Vehicle, VehicleSignal
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.types import Sample

SLOW_EVERY_S: Final = 1.0
"""Longest interval at which temperature and SoC are sent without a change, in log time [s]."""

_UNITS: Final = {"current": "A", "voltage": "V", "temperature": "°C", "soc_reference": "%"}


class FrameEncoder:
    """Encode samples as frames; the inverse of `SampleDecoder`.

    Slow signals (temperature, SoC) come first, so that they apply to their own sample; then
    current; then voltage. Slow ones are sent when their quantized value changes, and every
    `SLOW_EVERY_S` of log time. Alive counters run per message. Time stamps are the samples' times.

    Raises InputError for a vehicle whose frames can only be received.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        if any(each.reply for each in vehicle.messages.values()):
            problem = "replies over ISO-TP are received only"
            cure = "use a vehicle without them, and --temperature"
            raise InputError(problem, source=vehicle.name, cure=cure)
        self.vehicle = vehicle
        self._counters = dict.fromkeys(vehicle.messages, 0)
        groups: dict[tuple[int, tuple[Condition, ...]], list[VehicleSignal]] = {}
        for signal in vehicle.signals:
            groups.setdefault((signal.key, signal.codec.conditions), []).append(signal)
        keys = [key for key, _ in groups]
        # Signals of each frame in a payload of its own, and whether they are slow.
        self._frames: list[tuple[list[VehicleSignal], bool]] = []
        self._sent: dict[int, tuple[bytearray, float]] = {}
        for (key, _), signals in groups.items():
            is_slow = all(signal.role in {"temperature", "soc_reference"} for signal in signals)
            if not is_slow and keys.count(key) > 1:
                problem = "has multiplexed frames with current or voltage, which cannot be replayed"
                source, where = vehicle.dbc_files[0], signals[0].message
                cure = "replay as another --vehicle"
                raise InputError(problem, source=source, field=where, cure=cure)
            self._frames.append((signals, is_slow))
        self._frames.sort(key=itemgetter(1), reverse=True)

    def encode(self, sample: Sample, soc_reference_pct: float = math.nan) -> list[can.Message]:
        """Return the frames of one sample, in sending order.

        A frame whose values are all NaN is not sent; a NaN among others becomes the DBC's code for
        "not available". InputError is raised if a value does not fit into its signal, or has no
        such code.
        """
        time_s, current_a, voltage_v, temperature_c = sample
        values = {
            "current": current_a,
            "voltage": voltage_v,
            "temperature": temperature_c,
            "soc_reference": soc_reference_pct,
        }
        messages = []
        for place, (signals, is_slow) in enumerate(self._frames):
            if all(math.isnan(values[signal.role]) for signal in signals):
                continue
            first = signals[0]
            payload = bytearray(first.length)
            for signal in signals:
                signal.codec.encode_into(payload, values[signal.role])
            if is_slow:
                last, last_s = self._sent.get(place, (None, -math.inf))
                if payload == last and 0.0 <= time_s - last_s < SLOW_EVERY_S:
                    continue
                self._sent[place] = payload, time_s
            rule = self.vehicle.messages[first.key].rule
            data = bytes(payload)
            if rule is not None:
                data = rule.protect(payload, self._counters[first.key])
                self._counters[first.key] += 1
            messages.append(
                can.Message(
                    timestamp=time_s,
                    arbitration_id=first.arbitration_id,
                    is_extended_id=first.is_extended,
                    is_fd=first.length > 8,
                    data=data,
                )
            )
        return messages

    def check_range(self, log: Log) -> None:
        """Raise InputError for the first signal that is too narrow for a log, before sending."""
        for signal in self.vehicle.signals:
            column = LOG_COLUMNS[signal.role]
            if (values := getattr(log, column)) is None:
                continue
            bad = np.flatnonzero(~signal.codec.fits(values))
            if bad.size:
                row, (low, high) = int(bad[0]), signal.codec.range
                raise InputError(
                    f"does not fit into signal {signal.codec.name} of {signal.message}, which holds"
                    f" {low:g} to {high:g} {_UNITS[signal.role]}; the first such row is {row + 1}",
                    source=log.source or log.name,
                    field=column,
                    value=float(values[row]),
                    cure="replay it as another --vehicle",
                )

    def quantization(self) -> dict[str, float]:
        """Return the largest quantization errors of frames by column; `time_s` is the clock's."""
        signals = self.vehicle.signals
        steps = {LOG_COLUMNS[signal.role]: signal.codec.half_step for signal in signals}
        return {**steps, "time_s": 0.5 / MICROSECONDS}
