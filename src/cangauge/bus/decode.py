"""Frames → samples: only the wanted signals are looked at, and only when they are to be trusted."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import can

from cangauge.bus.counters import Counters, MessageCounters
from cangauge.bus.input_health import InputHealth, SignalGate
from cangauge.bus.pairing import Pairing
from cangauge.bus.protection import FrameChecker, Verdict
from cangauge.bus.signal_health import Fault
from cangauge.bus.stuck import Pack
from cangauge.bus.vehicle import EXTENDED, BoundSignal, Vehicle
from cangauge.estimate.types import Sample

_GOOD: Final = Verdict.GOOD  # of every frame; members of an enum are slow to look up


@dataclass(slots=True)
class _Route:
    """What happens to the frames of one message."""

    length: int
    checker: FrameChecker | None
    counters: MessageCounters
    take_fast: Callable[[bytearray, float], Sample | None] | None = None
    """Takes a payload and its bus time [s], if there is current or voltage in it."""
    slow: tuple[SignalGate, ...] = ()
    last_s: float = -math.inf


class SampleAssembler:
    """Makes samples from a vehicle's frames; pure, driven by the frames' time stamps alone.

    Refused are frames with a wrong CRC, with a counter that stands still, or that are too short,
    and values whose code means "not available", that are out of range, change too fast or are
    stuck; what follows from several of them in a row, `signal_health` says. A counter that jumps
    is counted as a loss, and the frame is used. Error frames and remote frames are ignored, and
    so are extended ids where the DBC means standard ones. Current and voltage pair as `pairing`
    says. Temperature is the last value while it is trusted and not older than its time-out, else
    NaN.

    Parameters
    ----------
    vehicle : Vehicle
    pack : Pack, optional
        What the model knows of the pack; see `InputHealth`.

    Attributes
    ----------
    health : InputHealth
        What is known of the signals; to be read only.
    wanted_ids : tuple of int
        Arbitration ids worth receiving, for filters in the kernel (see `Vehicle.filters`).
    counters : Counters
        What happened to the frames so far.
    """

    def __init__(self, vehicle: Vehicle, pack: Pack | None = None) -> None:
        self.vehicle = vehicle
        self.wanted_ids = vehicle.wanted_ids
        self._pairing = Pairing(vehicle.pair_within_s)
        self.health = InputHealth(vehicle, pack)
        self._temperature = None if vehicle.temperature is None else self.health["temperature"]
        self._routes: dict[int, _Route] = {}
        for signal in vehicle.signals:
            self._add(signal)
        self._counters = Counters({key: route.counters for key, route in self._routes.items()})
        self._now_s = -math.inf

    def _add(self, signal: BoundSignal) -> None:
        route = self._routes.get(signal.key)
        if route is None:
            message = self.vehicle.messages[signal.key]
            checker = None if message.rule is None else FrameChecker(message.rule, message.period_s)
            route = _Route(signal.length, checker, MessageCounters())
            self._routes[signal.key] = route
        gate = self.health.gate(signal, route.counters)
        if signal.role == "current":
            self._current = gate
            route.take_fast = self._take_current
        elif signal.role == "voltage":
            self._voltage = gate
            both = signal.key == self.vehicle.current.key
            route.take_fast = self._take_both if both else self._take_voltage
        else:
            route.slow = (*route.slow, gate)

    @property
    def last_update_s(self) -> dict[str, float]:
        """Bus time of the last good value by role [s]; NaN before the first.

        Roles are "current", "voltage", "temperature" and "soc_reference".
        """
        return self.health.latest_s

    @property
    def now_s(self) -> float:
        """Bus time of the latest wanted frame [s]; −inf before the first."""
        return self._now_s

    @property
    def counters(self) -> Counters:
        """What happened to the frames so far; kept up to date."""
        self._counters.current_unpaired = self._pairing.current_unpaired
        self._counters.voltage_unpaired = self._pairing.voltage_unpaired
        return self._counters

    @property
    def reference_soc_pct(self) -> float:
        """The car's own state of charge [%]; NaN when there is none within its time-out."""
        return self.health.latest("soc_reference", self._now_s)

    def handle(self, message: can.Message) -> Sample | None:
        """Take one frame; return the sample that it completes, if any.

        `voltage_v` and `temperature_c` of a sample may be NaN. Samples come in the order of their
        currents.
        """
        counters = self._counters
        counters.frames += 1
        key = message.arbitration_id
        if message.is_extended_id:
            key |= EXTENDED
        route = self._routes.get(key)
        if route is None:
            if message.is_error_frame or message.is_remote_frame:
                counters.ignored += 1
            return None
        if message.is_error_frame or message.is_remote_frame:
            counters.ignored += 1
            return None
        payload = self._accept(key, route, message)
        if payload is None:
            return None
        for gate in route.slow:
            gate.read(payload, message.timestamp)
        if route.take_fast is None:
            return None
        sample = route.take_fast(payload, message.timestamp)
        if sample is not None:
            counters.samples += 1
        return sample

    def flush(self) -> Sample | None:
        """Return the current that still waits for a voltage, as a sample without one (the end)."""
        sample = self._pairing.flush()
        if sample is not None:
            self._counters.samples += 1
        return sample

    def _accept(self, key: int, route: _Route, message: can.Message) -> bytearray | None:
        """Return the payload, cut to the message's length, if the frame is to be used."""
        fate, time_s = route.counters, message.timestamp
        fate.wanted += 1
        if time_s < route.last_s:
            self._restart(route.last_s, time_s)
        self._now_s = time_s
        payload = message.data
        length = route.length
        if len(payload) != length:
            if len(payload) < length:
                fate.short += 1
                self.health.refused(key, Fault.PROTECTION)
                return None
            payload = payload[:length]
        checker = route.checker
        if checker is not None:
            verdict = checker.check(payload, time_s)
            if verdict is not _GOOD:
                if verdict is Verdict.CRC_WRONG:
                    fate.crc_errors += 1
                    self.health.refused(key, Fault.PROTECTION)
                    return None
                if verdict is Verdict.REPEATED:
                    fate.counter_repeats += 1
                    self.health.refused(key, Fault.REPEATED)
                    return None
                fate.counter_jumps += 1
                fate.frames_lost += checker.lost
        route.last_s = time_s
        return payload

    def _restart(self, last_s: float, time_s: float) -> None:
        """Time runs backwards: a log that starts again, or a clock that was set."""
        self._counters.time_reversals += 1
        if last_s - time_s > self.vehicle.pair_within_s:
            self.health.rewind(time_s)

    def _take_current(self, payload: bytearray, time_s: float) -> Sample | None:
        current_a = self._current.read(payload, time_s)
        if math.isnan(current_a):
            return None
        return self._pairing.current(time_s, current_a, self._temperature_at(time_s))

    def _take_voltage(self, payload: bytearray, time_s: float) -> Sample | None:
        voltage_v = self._voltage.read(payload, time_s)
        return None if math.isnan(voltage_v) else self._pairing.voltage(time_s, voltage_v)

    def _take_both(self, payload: bytearray, time_s: float) -> Sample | None:
        """Take a frame with current and voltage: a sample at once."""
        current_a = self._current.read(payload, time_s)
        voltage_v = self._voltage.read(payload, time_s)
        if math.isnan(current_a):
            return None
        if math.isnan(voltage_v):
            self._pairing.current_unpaired += 1
        return Sample(time_s, current_a, voltage_v, self._temperature_at(time_s))

    def _temperature_at(self, time_s: float) -> float:
        if self._temperature is None:
            return self.vehicle.fixed_temperature_c
        return self._temperature.value_at(time_s)
