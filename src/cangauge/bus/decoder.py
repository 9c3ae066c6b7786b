"""What happened to the frames: counted in total and for every wanted message.

Current and voltage → samples, on bus time.

Rules
-----
- A current and a voltage at most `within_s` apart make a sample, stamped with the current's
  time, when the later of the two arrives. Each is used once.
- A current that can no longer be paired (a newer frame of either kind lies more than `within_s`
  after it, or the next current arrives) becomes a sample without voltage (NaN), so that its
  charge is still counted.
- A voltage that finds no current is dropped: the next one replaces it.
- When time runs backwards by more than `within_s`, what waits is given up: a current as a sample
  without voltage, a voltage dropped.

At most one sample results from one frame, and samples come in the order of their currents.

All signals of a vehicle together: which values go on, and what the status must say of the rest.

What cannot be is decided by the pack's model where there is one: its resistance couples current
and voltage (`stuck`), its voltage bounds what a pack can show. Without a model only what the
mapping states is checked, so that a wrong scale in a mapping is seen as such by whoever reads a
capture, and not as a signal that never comes.

Frames → samples: only the wanted signals are looked at, and only when they are to be trusted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Final

import can

from cangauge.bus.plausibility import Fault, Pack, SignalChecks, SignalHealth, Still, StuckPair
from cangauge.bus.protection import FrameChecker, Verdict
from cangauge.bus.vehicle import EXTENDED, Vehicle, VehicleSignal
from cangauge.estimate.validity import (
    CURRENT_AT_MOST_A,
    TEMPERATURE_WITHIN_C,
    VOLTAGE_WITHIN,
    Reason,
    Sample,
)

# --- What happened to the frames: counted in total and for every wanted message


@dataclass(slots=True)
class MessageStatistics:
    """Fate of the frames of one wanted message."""

    wanted: int = 0
    """Frames with its id."""
    crc_errors: int = 0
    """Refused: the CRC is wrong."""
    counter_repeats: int = 0
    """Refused: the counter stands still."""
    counter_jumps: int = 0
    """Good frames that came after a loss."""
    frames_lost: int = 0
    """Frames that the counter says are missing."""
    short: int = 0
    """Refused: fewer bytes than the DBC says."""
    not_available: int = 0
    """Values refused because the code means "not available"."""
    implausible: int = 0
    """Values refused because they are out of range or changed too fast."""
    stuck: int = 0
    """Values refused because the signal stands still while it should move."""
    held_back: int = 0
    """Good values not used yet, because too many before them failed."""


@dataclass(slots=True)
class FrameStatistics:
    """Fate of all frames.

    Parameters
    ----------
    messages : dict of int to MessageStatistics
        By key: arbitration id, plus `vehicle.EXTENDED` for an extended one.
    """

    messages: dict[int, MessageStatistics] = field(default_factory=dict)
    frames: int = 0
    """Frames handed over, wanted or not."""
    ignored: int = 0
    """Error frames and remote frames."""
    samples: int = 0
    """Samples made."""
    current_unpaired: int = 0
    """Samples without a voltage (voltage NaN)."""
    voltage_unpaired: int = 0
    """Voltages that found no current, and were dropped."""
    time_reversals: int = 0
    """Frames of a wanted message stamped earlier than the one before."""

    def _sum(self, name: str) -> int:
        return sum(getattr(each, name) for each in self.messages.values())

    @property
    def wanted(self) -> int:
        """Frames with a wanted id."""
        return self._sum("wanted")

    @property
    def crc_errors(self) -> int:
        """Frames refused for a wrong CRC."""
        return self._sum("crc_errors")

    @property
    def counter_repeats(self) -> int:
        """Frames refused because their counter stands still."""
        return self._sum("counter_repeats")

    @property
    def counter_jumps(self) -> int:
        """Good frames that came after a loss."""
        return self._sum("counter_jumps")

    @property
    def frames_lost(self) -> int:
        """Frames that the counters say are missing."""
        return self._sum("frames_lost")

    @property
    def short(self) -> int:
        """Frames refused because they have fewer bytes than the DBC says."""
        return self._sum("short")

    @property
    def not_available(self) -> int:
        """Values refused because their code means "not available"."""
        return self._sum("not_available")

    @property
    def implausible(self) -> int:
        """Values refused because they are out of range or changed too fast."""
        return self._sum("implausible")

    @property
    def stuck(self) -> int:
        """Values refused because their signal stands still while it should move."""
        return self._sum("stuck")

    @property
    def held_back(self) -> int:
        """Good values not used yet, because too many before them failed."""
        return self._sum("held_back")

    def to_dict(self) -> dict[str, object]:
        """Return totals, and the counters of every message by its id ("0x1DB")."""
        totals = {
            name: getattr(self, name)
            for name in (
                "frames",
                "wanted",
                "ignored",
                "samples",
                "current_unpaired",
                "voltage_unpaired",
                "time_reversals",
                "crc_errors",
                "counter_repeats",
                "counter_jumps",
                "frames_lost",
                "short",
                "not_available",
                "implausible",
                "stuck",
                "held_back",
            )
        }
        per_message = {
            f"0x{key & 0x1FFFFFFF:X}": asdict(each) for key, each in self.messages.items()
        }
        return {**totals, "messages": per_message}


# --- Current and voltage → samples, on bus time


class Pairing:
    """Pairs currents and voltages; see the rules in the module's docstring.

    Parameters
    ----------
    within_s : float
        Largest distance in bus time [s].

    Attributes
    ----------
    current_unpaired, voltage_unpaired : int
        Samples without voltage, voltages dropped.
    """

    __slots__ = (
        "_current_a",
        "_current_s",
        "_temperature_c",
        "_voltage_s",
        "_voltage_v",
        "_within_s",
        "current_unpaired",
        "voltage_unpaired",
    )

    def __init__(self, within_s: float) -> None:
        # A hair more than stated, so that stamps 20 ms apart pair whatever their rounding.
        self._within_s = within_s + 1e-6
        self.current_unpaired = 0
        self.voltage_unpaired = 0
        self._current_s = math.nan  # NaN: nothing waits
        self._current_a = math.nan
        self._temperature_c = math.nan
        self._voltage_s = math.nan
        self._voltage_v = math.nan

    def current(self, time_s: float, current_a: float, temperature_c: float) -> Sample | None:
        """Take a current [A] and the temperature [°C] that holds at it."""
        if abs(time_s - self._voltage_s) <= self._within_s:
            # No current can wait beside a waiting voltage that near.
            voltage_v = self._voltage_v
            self._voltage_s = math.nan
            return Sample(time_s, current_a, voltage_v, temperature_c)
        if not math.isnan(self._voltage_s):
            self.voltage_unpaired += 1
            self._voltage_s = math.nan
        given_up = self.flush()
        self._current_s, self._current_a = time_s, current_a
        self._temperature_c = temperature_c
        return given_up

    def voltage(self, time_s: float, voltage_v: float) -> Sample | None:
        """Take a voltage [V]."""
        if abs(time_s - self._current_s) <= self._within_s:
            sample = Sample(self._current_s, self._current_a, voltage_v, self._temperature_c)
            self._current_s = math.nan
            return sample
        if not math.isnan(self._voltage_s):
            self.voltage_unpaired += 1
        self._voltage_s, self._voltage_v = time_s, voltage_v
        return self.flush()

    def flush(self) -> Sample | None:
        """Give up the waiting current, if any: a sample without voltage."""
        if math.isnan(self._current_s):
            return None
        sample = Sample(self._current_s, self._current_a, math.nan, self._temperature_c)
        self._current_s = math.nan
        self.current_unpaired += 1
        return sample


# --- All signals of a vehicle together: which values go on, and what the status must say of …

_FAST: Final = {"current", "voltage"}
_MISSING: Final = {
    "current": Reason.CURRENT_MISSING,
    "voltage": Reason.VOLTAGE_MISSING,
    "temperature": Reason.TEMPERATURE_MISSING,
}
_WHY: Final = {
    Fault.NONE: Reason.NONE,
    Fault.PROTECTION: Reason.PROTECTION_FAILED,
    Fault.REPEATED: Reason.PROTECTION_FAILED,
    Fault.NOT_AVAILABLE: Reason.NONE,
    Fault.RANGE: Reason.IMPLAUSIBLE_INPUT,
    Fault.RATE: Reason.IMPLAUSIBLE_INPUT,
    Fault.STUCK: Reason.SIGNAL_STUCK,
}


TEMPERATURE_JUMP_K: Final = 5.0
TEMPERATURE_RATE_K_PER_S: Final = 1.0
"""A battery is heavy: coarse steps, and two sensors taking turns, stay below this. Current and
voltage may change as fast as they like: contactors, fuses, short circuits."""


_NO_FAULT: Final = Fault.NONE

Watch = Callable[[float, float], bool]
"""Takes a value and its bus time [s]; returns whether the signal is stuck."""


class SignalGate:
    """Reads one signal, and lets through what may be used.

    Parameters
    ----------
    signal : VehicleSignal
    health : SignalHealth
    is_stuck : Watch, optional
    fate : MessageStatistics
        Where it is counted what became of a value.
    """

    __slots__ = ("_decode", "_fate", "_gain", "_health", "_is_in", "_is_stuck", "_offset")

    def __init__(
        self,
        signal: VehicleSignal,
        health: SignalHealth,
        is_stuck: Watch | None,
        fate: MessageStatistics,
    ) -> None:
        codec = signal.codec
        self._decode = codec.decode
        self._is_in = codec.is_in if codec.conditions else None
        self._gain, self._offset = signal.gain, signal.offset
        self._health = health
        self._is_stuck = is_stuck
        self._fate = fate

    def read(self, payload: bytes | bytearray, time_s: float) -> float:
        """Return the value [A, V, °C, %]; NaN if the frame has none or it is not to be used.

        Parameters
        ----------
        payload : bytes
            Of the message's own length.
        time_s : float
            Bus time [s].
        """
        if self._is_in is not None and not self._is_in(payload):
            return math.nan
        value = self._gain * self._decode(payload) + self._offset  # as `VehicleSignal.decode`
        health, is_stuck = self._health, self._is_stuck
        fault = health.judge(value, time_s)
        if fault is _NO_FAULT:
            if is_stuck is None or not is_stuck(value, time_s):
                if health.take(value, time_s):
                    return value
                self._fate.held_back += 1
                return math.nan
            fault = Fault.STUCK
        self._refuse(fault)
        return math.nan

    def _refuse(self, fault: Fault) -> None:
        self._health.fail(fault)
        if fault is Fault.NOT_AVAILABLE:
            self._fate.not_available += 1
        elif fault is Fault.STUCK:
            self._fate.stuck += 1
        else:
            self._fate.implausible += 1


class InputHealth:
    """Judges every value of a vehicle's signals; pure, driven by the frames' time stamps alone.

    Parameters
    ----------
    vehicle : Vehicle
    pack : Pack, optional
        What the model knows of the pack; without it no signal of it is ever called stuck, and
        only stated ranges are checked.
    """

    def __init__(self, vehicle: Vehicle, pack: Pack | None = None) -> None:
        self._signals = vehicle.signals
        self._of: dict[str, SignalHealth] = {
            signal.role: SignalHealth(
                signal.checks if pack is None else _bounded(signal.role, signal.checks, pack),
                # Not every frame of a multiplexed message has the signal: its period is learned.
                None if signal.codec.conditions else vehicle.messages[signal.key].period_s,
                is_cyclic=signal.role in _FAST,
            )
            for signal in vehicle.signals
        }
        self._pair = None if pack is None else _pair(vehicle, pack)

    def __getitem__(self, role: str) -> SignalHealth:
        """Return what is known of one signal."""
        return self._of[role]

    def gate(self, signal: VehicleSignal, fate: MessageStatistics) -> SignalGate:
        """Return what reads a signal's values; what becomes of them is counted in `fate`."""
        return SignalGate(signal, self._of[signal.role], self._watch(signal), fate)

    def refused(self, key: int, fault: Fault) -> None:
        """Take note that a frame of the message with that key was refused."""
        for signal in self._signals:
            if signal.key == key:
                self._of[signal.role].fail(fault)

    def rewind(self, time_s: float) -> None:
        """Time runs backwards to `time_s` [s]."""
        for health in self._of.values():
            health.rewind(time_s)

    def latest(self, role: str, now_s: float) -> float:
        """Return a signal's latest value if it still holds at bus time `now_s` [s], else NaN."""
        health = self._of.get(role)
        return math.nan if health is None else health.value_at(now_s)

    @property
    def latest_s(self) -> dict[str, float]:
        """Bus time of the latest good value by role [s]; NaN before the first."""
        return {role: health.latest_s for role, health in self._of.items()}

    def reasons(self, now_s: float) -> Reason:
        """Return which signals are not to be had at bus time `now_s` [s], and why.

        One that is missing without a reason is too old, never came, or its sender says "not
        available".
        """
        reasons = Reason.NONE
        for role, missing in _MISSING.items():
            health = self._of.get(role)
            if health is not None and not health.is_usable(now_s):
                reasons |= missing
                if health.is_failing:
                    reasons |= _WHY[health.fault]
        return reasons

    def _watch(self, signal: VehicleSignal) -> Watch | None:
        """Return what notices that a signal is stuck; None where nothing can."""
        if signal.role == "temperature" and signal.checks.stuck_after_s < math.inf:
            return _StillFor(signal.checks.stuck_after_s)
        if self._pair is not None and signal.role in _FAST:
            return self._pair.current if signal.role == "current" else self._pair.voltage
        return None


class _StillFor:
    """Says that a signal is stuck once it has stood still for a stated time [s]."""

    def __init__(self, after_s: float) -> None:
        self._after_s = after_s
        self._still = Still(0.0)

    def __call__(self, value: float, time_s: float) -> bool:
        moved = self._still.take(value, time_s)
        return not moved and time_s - self._still.since_s >= self._after_s


def _bounded(role: str, checks: SignalChecks, pack: Pack) -> SignalChecks:
    """Return the checks with what no pack can be in place of limits that are not stated."""
    limits = {
        "current": (-CURRENT_AT_MOST_A, CURRENT_AT_MOST_A),
        "voltage": (VOLTAGE_WITHIN[0] * pack.usual_v, VOLTAGE_WITHIN[1] * pack.usual_v),
        "temperature": TEMPERATURE_WITHIN_C,
    }
    low, high = limits.get(role, (-math.inf, math.inf))
    if role == "temperature" and checks.max_jump == math.inf:
        checks = replace(
            checks, max_jump=TEMPERATURE_JUMP_K, max_rate_per_s=TEMPERATURE_RATE_K_PER_S
        )
    return replace(
        checks,
        lowest=low if checks.lowest == -math.inf else checks.lowest,
        highest=high if checks.highest == math.inf else checks.highest,
    )


def _pair(vehicle: Vehicle, pack: Pack) -> StuckPair:
    current, voltage = vehicle.current, vehicle.voltage
    return StuckPair(
        pack,
        current_step_a=2.0 * current.half_step,
        voltage_step_v=2.0 * voltage.half_step,
        current_after_s=current.checks.stuck_after_s,
        voltage_after_s=voltage.checks.stuck_after_s,
    )


# --- Frames → samples: only the wanted signals are looked at, and only when they are to be t…

_GOOD: Final = Verdict.GOOD  # of every frame; members of an enum are slow to look up


@dataclass(slots=True)
class _Route:
    """What happens to the frames of one message."""

    length: int
    checker: FrameChecker | None
    counters: MessageStatistics
    take_fast: Callable[[bytearray, float], Sample | None] | None = None
    """Takes a payload and its bus time [s], if there is current or voltage in it."""
    slow: tuple[SignalGate, ...] = ()
    last_s: float = -math.inf


class SampleDecoder:
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
    counters : FrameStatistics
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
        self._counters = FrameStatistics(
            {key: route.counters for key, route in self._routes.items()}
        )
        self._now_s = -math.inf

    def _add(self, signal: VehicleSignal) -> None:
        route = self._routes.get(signal.key)
        if route is None:
            message = self.vehicle.messages[signal.key]
            checker = None if message.rule is None else FrameChecker(message.rule, message.period_s)
            route = _Route(signal.length, checker, MessageStatistics())
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
    def counters(self) -> FrameStatistics:
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
