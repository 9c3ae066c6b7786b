"""Frames → samples: acceptance of frames, decoding, plausibility, pairing in bus time."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final, cast, get_args

import can
import numpy as np
from can.interfaces.socketcan.constants import CAN_EFF_FLAG

from cangauge._typing import FloatArray
from cangauge.bus.database import BitField, SignalCodec
from cangauge.bus.isotp import READ_BY_IDENTIFIER, Reassembler, reply_id
from cangauge.bus.mapping import CellsMap
from cangauge.bus.plausibility import (
    Count,
    PackProperties,
    SignalHealth,
    StuckDetector,
    stuck_detectors,
)
from cangauge.bus.protection import FrameChecker
from cangauge.bus.vehicle import Vehicle, VehicleSignal, pgn_mask
from cangauge.types import Reason, Sample

_MISSING: Final = {
    "current": Reason.CURRENT_MISSING,
    "voltage": Reason.VOLTAGE_MISSING,
    "temperature": Reason.TEMPERATURE_MISSING,
}
# Looked up for every frame or sample; enum members are slow to look up.
_DUPLICATE, _NO_REASON = Reason.DUPLICATE_SENDER, Reason.NONE

SUSPECTED_FOR_S: Final = 10.0
"""Time after the last sign of a second sender for which a message is refused [s]: longer than an
attacker's pause between two tries, well below the longest gap over which charge is counted."""


@dataclass(slots=True)
class FrameStatistics:
    """Counts of all frames; those of its messages have their total under the same names."""

    messages: dict[int, Counter[Count]] = field(default_factory=dict)  # by key, see `vehicle`
    frames: int = 0  # received, wanted or not
    samples: int = 0

    def __getattr__(self, name: str) -> int:
        """Return the total of a count of the messages."""
        if name not in get_args(Count):
            raise AttributeError(name)
        return sum(each[cast("Count", name)] for each in self.messages.values())


class Pairing:
    """Pair currents and voltages into samples.

    - A current and a voltage at most `within_s` apart make a sample, stamped with the current's
      time, when the later of the two arrives. Each value is used once.
    - A current left without a voltage (a newer value lies more than `within_s` after it, or the
      next current arrives) becomes a sample with voltage NaN, so that its charge is counted.
    - A voltage left without a current is dropped when the next voltage arrives, or a current more
      than `within_s` away.
    - When time runs backwards by more than `within_s`, waiting values are released likewise.

    A value completes at most one sample. Samples keep the order of their currents. All times are
    bus time [s].
    """

    def __init__(self, within_s: float) -> None:
        # Slightly more than stated: stamps 20 ms apart must pair in spite of rounding.
        self._within_s = within_s + 1e-6
        self._waiting: Sample | None = None
        self._voltage_s = self._voltage_v = math.nan  # NaN: no voltage waits

    def current(self, sample: Sample) -> Sample | None:
        """Add a current, as a sample without voltage; return a sample, if any."""
        time_s, current_a, _, temperature_c = sample
        is_paired = abs(time_s - self._voltage_s) <= self._within_s
        self._voltage_s = math.nan
        if is_paired:
            # No current can be waiting next to this voltage: they would have been paired.
            return Sample(time_s, current_a, self._voltage_v, temperature_c)
        unpaired, self._waiting = self.flush(), sample
        return unpaired

    def voltage(self, time_s: float, voltage_v: float) -> Sample | None:
        """Add a voltage [V]; return a sample, if any."""
        waiting = self._waiting
        if waiting is not None and abs(time_s - waiting.time_s) <= self._within_s:
            self._waiting = None
            return Sample(waiting.time_s, waiting.current_a, voltage_v, waiting.temperature_c)
        self._voltage_s, self._voltage_v = time_s, voltage_v
        return self.flush()

    def flush(self) -> Sample | None:
        """Release the waiting current, if any, as a sample without voltage."""
        waiting, self._waiting = self._waiting, None
        return waiting


class CellVoltages:
    """Voltages of the cells, each used once."""

    def __init__(self, cells: CellsMap, group: int, index: BitField | None) -> None:
        self._cells, self._group, self._index = cells, group, index
        self._forget()

    def _forget(self) -> None:
        self._voltage_v = [math.nan] * self._cells.count
        self._time_s = [math.nan] * self._cells.count

    def take(self, now_s: float) -> tuple[list[float], list[float]]:
        """Return voltages [V] and bus times [s] that came since the last call and are not old.

        The others are NaN.
        """
        oldest_s = now_s - self._cells.timeout_s
        voltage_v, time_s = self._voltage_v, self._time_s
        for place, at_s in enumerate(time_s):
            if at_s < oldest_s:
                voltage_v[place] = time_s[place] = math.nan
        self._forget()
        return voltage_v, time_s

    def read(
        self, signals: Sequence[tuple[int, SignalCodec]], payload: bytearray, time_s: float
    ) -> None:
        """Read the cells (place and codec of each) of a payload at bus time `time_s` [s]."""
        shift, cells = 0, self._cells
        if self._index is not None:
            shift = (self._index.get(payload) - cells.first_index) * self._group
        for place, codec in signals:
            at = place + shift
            # The last group may be filled up.
            if 0 <= at < cells.count and codec.is_in(payload):
                volts = codec.decode(payload)
                if cells.lowest <= volts <= cells.highest:
                    self._voltage_v[at], self._time_s[at] = volts, time_s


@dataclass(slots=True)
class _Wanted:
    """A wanted message: its checks, its signals, and place and codec of the cells in it."""

    name: str
    length: int
    checker: FrameChecker | None
    counts: Counter[Count]
    by_pgn: bool
    inputs: list[tuple[SignalCodec, SignalHealth]] = field(default_factory=list)
    cells: list[tuple[int, SignalCodec]] = field(default_factory=list)
    last_s: float = -math.inf
    suspected_s: float = -math.inf  # the last sign of a second sender
    source: int = -1  # latest source address (J1939), and when it was seen
    source_s: float = -math.inf

    def checked(self, payload: bytearray, time_s: float, source: int) -> bytearray | None:
        """Return the payload, cut to the message's length; None for a refused frame.

        A refused frame is a failure of each signal. `source` is the source address of a J1939
        frame: two of them, of two packs for instance, are two senders.
        """
        self.counts["wanted"] += 1
        if self.by_pgn:
            if source != self.source and abs(time_s - self.source_s) < SUSPECTED_FOR_S:
                self.suspected_s = time_s
            self.source, self.source_s = source, time_s
        if len(payload) > self.length:
            payload = payload[: self.length]
        refusal = self._refusal(payload, time_s)
        if refusal is None:
            self.last_s = time_s
            return payload
        self.counts[refusal] += 1
        reason = _DUPLICATE if refusal == "two_senders" else Reason.PROTECTION_FAILED
        for _, health in self.inputs:
            health.fail(reason, is_repeated=refusal == "counter_repeats")
        return None

    def _refusal(self, payload: bytearray, time_s: float) -> Count | None:
        """Return the count of refused frames that a payload enters; None for a good one."""
        if len(payload) < self.length:
            return "short"
        checker = self.checker
        if checker is not None and (anomaly := checker.check(payload, time_s)) is not None:
            if anomaly == "crc_errors":
                return anomaly
            if checker.suspects_second_sender:
                self.suspected_s = time_s
            if anomaly == "counter_repeats":
                return anomaly
            self.counts["counter_jumps"] += 1
            self.counts["frames_lost"] += checker.lost
        return "two_senders" if self.is_suspected(time_s) else None

    def is_suspected(self, now_s: float) -> bool:
        """Return whether it seems to have two senders; not after the clock was set far back."""
        return abs(now_s - self.suspected_s) < SUSPECTED_FOR_S


def unsigned_reading(codec: SignalCodec, current_a: FloatArray) -> tuple[str, str] | None:
    """Return problem and cure if negative currents [A] are read as large ones; else None."""
    bits = codec.wrapped_bits(current_a)
    if bits is None:
        return None
    top_a = (1 << bits) * abs(codec.gain * codec.factor)
    wrapped = int((2.0 * np.abs(current_a) > top_a).sum())
    problem = f"read unsigned: {wrapped} of {current_a.size} values lie just below {top_a:.6g} A,"
    cure = "state signed = true under [current] of the map file"
    if bits < codec.field.width:
        cure = f"make it a signed signal of {bits} bits in the DBC"
    return f"{problem} as negative ones of {bits} bits do", cure


class SampleDecoder:
    """Decode a vehicle's frames to samples; a pure function of frames and time stamps.

    Refused are: frames with a wrong CRC, a repeated alive counter or too few bytes; all frames of a
    message that seems to have two senders, or a PGN that two source addresses send, since a mixture
    of both is worse than a gap; values that are not available or implausible (see `plausibility`).
    A jump of the alive counter counts as a loss, and the frame is used. The temperature of a sample
    is the latest value while it is usable, else NaN.

    Parameters
    ----------
    vehicle : Vehicle
    pack : PackProperties, optional
        Pack properties from the model: they limit the signals' values, and detect stuck signals.
        None: only the limits of the map file and those of a SoC apply, and no signal counts as
        stuck. A capture with a wrong scale then shows its wrong values instead of missing ones.
    statistics : FrameStatistics, optional
        Counts to continue.

    Attributes
    ----------
    statistics, health : FrameStatistics, dict of str to SignalHealth
        Counts; health by role, read only.
    now_s : float
        Bus time of the latest wanted frame [s]; −inf before the first.
    cells : CellVoltages or None
        Latest cell voltages, where the vehicle has them.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        pack: PackProperties | None = None,
        statistics: FrameStatistics | None = None,
    ) -> None:
        self.vehicle = vehicle
        self.statistics = FrameStatistics() if statistics is None else statistics
        self.health: dict[str, SignalHealth] = {}
        self.now_s = self._suspected_s = -math.inf
        self._pairing = Pairing(vehicle.pair_within_s)
        current, voltage = vehicle.current, vehicle.voltage
        has_same_conditions = current.codec.conditions == voltage.codec.conditions
        self._is_one_frame = current.key == voltage.key and has_same_conditions
        fixed_c = vehicle.fixed_temperature_c
        self._fixed_c = math.nan if fixed_c is None else fixed_c
        self._wanted: dict[int, _Wanted] = {}
        messages = vehicle.messages.items()
        self._by_pgn = {key & pgn_mask(key): key for key, each in messages if each.by_pgn}
        self._replies = {reply_id(key): Reassembler() for key, each in messages if each.reply}
        self._by_reply = {(reply_id(key), each.reply): key for key, each in messages if each.reply}
        detectors: dict[str, StuckDetector] = {}
        if pack is not None:
            both = (current, voltage)
            steps = [(2.0 * each.codec.half_step, each.checks.stuck_after_s) for each in both]
            detectors["current"], detectors["voltage"] = stuck_detectors(pack, *steps)
        for signal in vehicle.signals:
            self._add(signal, pack, detectors.get(signal.role))
        self.cells: CellVoltages | None = None
        if vehicle.cells_map is not None:
            self.cells = CellVoltages(vehicle.cells_map, len(vehicle.cells), vehicle.cell_index)
        for place, cell in enumerate(vehicle.cells):
            self._message_of(cell).cells.append((place, cell.codec))
        health = self.health
        self._current, self._voltage = health["current"], health["voltage"]
        self._temperature = health.get("temperature")
        self._latest_a: deque[float] = deque(maxlen=1000)  # 10 s of a fast message
        self._needed = [(health[role], why) for role, why in _MISSING.items() if role in health]

    def _add(
        self, signal: VehicleSignal, pack: PackProperties | None, detector: StuckDetector | None
    ) -> None:
        wanted, role = self._message_of(signal), signal.role
        is_multiplexed = bool(signal.codec.conditions)
        health = self.health[role] = SignalHealth(
            signal.checks.within_pack(role, pack),
            # A multiplexed signal is not in every frame of its message: its period is learned.
            None if is_multiplexed else self.vehicle.messages[signal.key].period_s,
            is_cyclic=role in {"current", "voltage"},
            is_stuck=None if detector is None else detector.update,
            counts=wanted.counts,
        )
        if wanted.checker is not None and not is_multiplexed:
            wanted.checker.learned_period_s = partial(getattr, health, "period_s")
        wanted.inputs.append((signal.codec, health))

    def _message_of(self, signal: VehicleSignal) -> _Wanted:
        key = signal.key
        if key not in self._wanted:
            message, counts = self.vehicle.messages[key], self.statistics.messages
            checker = None if message.rule is None else FrameChecker(message.rule, message.period_s)
            self._wanted[key] = _Wanted(
                signal.message,
                signal.length,
                checker,
                counts.setdefault(key, Counter()),
                message.by_pgn,
            )
        return self._wanted[key]

    def handle(self, message: can.Message) -> Sample | None:
        """Decode one frame; return the sample that it completes, if any."""
        self.statistics.frames += 1
        if message.is_error_frame or message.is_remote_frame:
            return None
        key, time_s, data = message.arbitration_id, message.timestamp, message.data
        if message.is_extended_id:
            key |= CAN_EFF_FLAG
        wanted = self._wanted.get(key)
        if wanted is None and (self._by_pgn or key in self._replies):
            wanted, data = self._by_group_or_reply(key, data, time_s)
        if wanted is None:
            return None
        if wanted.last_s - time_s > self.vehicle.pair_within_s:
            # Time runs backwards: a restarted log, or a clock that was set.
            for health in self.health.values():
                health.rewind(time_s)
        self.now_s = time_s
        payload = wanted.checked(data, time_s, key & 0xFF)
        if wanted.suspected_s == time_s:
            self._suspected_s = time_s
        return None if payload is None else self._values(wanted, payload, time_s)

    def _values(self, wanted: _Wanted, payload: bytearray, time_s: float) -> Sample | None:
        """Check the values of an accepted payload; return the sample that they complete."""
        if wanted.cells and self.cells is not None:
            self.cells.read(wanted.cells, payload, time_s)
        current_a = voltage_v = math.nan
        for codec, health in wanted.inputs:
            if codec.conditions and not codec.is_in(payload):
                continue
            decoded = codec.decode(payload)
            value = health.update(decoded, time_s)
            if health is self._current:
                current_a = value
                self._latest_a.append(decoded)
            elif health is self._voltage:
                voltage_v = value
        sample: Sample | None = None
        if not math.isnan(current_a):
            temperature_c = self._fixed_c
            if self._temperature is not None:
                temperature_c = self._temperature.value_at(time_s)
            sample = Sample(time_s, current_a, voltage_v, temperature_c)
            if not self._is_one_frame:
                sample = self._pairing.current(sample)
        elif not (math.isnan(voltage_v) or self._is_one_frame):
            sample = self._pairing.voltage(time_s, voltage_v)
        self.statistics.samples += sample is not None
        return sample

    def flush(self) -> Sample | None:
        """Return the last current, if it is unpaired, as a sample without voltage."""
        sample = self._pairing.flush()
        self.statistics.samples += sample is not None
        return sample

    def _by_group_or_reply(
        self, key: int, data: bytearray, time_s: float
    ) -> tuple[_Wanted | None, bytearray]:
        """Return the wanted message of a J1939 group, or of a whole reply, and its payload."""
        if self._by_pgn and key & CAN_EFF_FLAG:
            return self._wanted.get(self._by_pgn.get(key & pgn_mask(key), -1)), data
        reply = self._replies[key].take(data, time_s) if key in self._replies else None
        if reply is None:
            return None, data
        start = reply[: 3 if reply[0] == READ_BY_IDENTIFIER else 2]
        return self._wanted.get(self._by_reply.get((key, start), -1)), bytearray(reply)

    def reasons(self, now_s: float) -> Reason:
        """Return which signals are missing at bus time `now_s` [s], and why.

        One without a further reason is old, never came, or is sent as "not available".
        """
        is_suspected = abs(now_s - self._suspected_s) < SUSPECTED_FOR_S
        reasons = _DUPLICATE if is_suspected else _NO_REASON
        for health, missing in self._needed:
            if not health.is_usable(now_s):
                reasons |= missing
                if health.is_failing:
                    reasons |= health.reason
        return reasons

    @property
    def is_voltage_implausible(self) -> bool:
        """Whether the newest voltage was refused as implausible."""
        return self._voltage.is_implausible

    @property
    def unsigned_current(self) -> str | None:
        """Problem and cure where the latest currents are signed numbers read unsigned."""
        codec = self.vehicle.current.codec
        found = unsigned_reading(codec, np.array(self._latest_a))
        return None if found is None else f"{codec.name}: {'; '.join(found)}"

    @property
    def two_sender_messages(self) -> tuple[str, ...]:
        """Names of the messages that seem to have two senders at present."""
        wanted = self._wanted.values()
        return tuple(each.name for each in wanted if each.is_suspected(self.now_s))

    @property
    def wrong_periods(self) -> dict[str, str]:
        """Messages that come much more often than the map or the DBC states, and what to do."""
        return {
            wanted.name: f"{wanted.name} comes each {health.period_s:.2g} s: its stated period"
            " is much longer, and is not used; period_s in the map file is in seconds"
            for wanted in self._wanted.values()
            for _, health in wanted.inputs
            if health.is_faster_than_stated
        }

    @property
    def never_decoded(self) -> dict[str, str]:
        """Signals that have had no good value yet, by role, and what came instead."""
        found = {}
        for signal in self.vehicle.signals:
            if not math.isnan(self.health[signal.role].latest_s):
                continue
            role, number = signal.role.removesuffix("_reference"), signal.arbitration_id
            count = self.statistics.messages[signal.key]["wanted"]
            what = f"{signal.codec.name} of {signal.message} was never decoded"
            if not count:
                what = f"{signal.message} was never seen"
                if self.vehicle.messages[signal.key].reply:
                    number = reply_id(signal.key)
                    count = self._replies[number].frames
            found[role] = f"{role}: {what} in {count} frames of 0x{number:X}"
            if not count:
                found[role] = f"{role}: {what}: no frames of 0x{number:X}"
        return found

    @property
    def reference_soc_pct(self) -> float:
        """The car's own state of charge [%]; NaN without a usable one."""
        health = self.health.get("soc_reference")
        return math.nan if health is None else health.value_at(self.now_s)
