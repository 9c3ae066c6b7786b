"""What a pass over a capture shows, without knowing the car: ids, periods, protection, silence."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from statistics import median
from typing import Final

import can
from can.typechecking import Channel

from cangauge.bus.protection import GENERIC_RULE, LEAF_RULE, FrameChecker, Verdict

GAP_S: Final = 1.0
"""A bus that is silent for longer has a gap [s]."""
LISTED_GAPS: Final = 20
MAX_IDS: Final = 4096
"""More ids than any car has: what comes after them is only counted."""
INTERVALS: Final = 2000
"""The period of an id is the median of its first so many intervals."""
LEARN_FRAMES: Final = 50
"""The period by which a standing counter is judged is learnt from so many frames."""
AGREEING: Final = 0.9
"""A rule's CRC protects an id when so much of its frames agree, …"""
PAYLOADS: Final = 4
"""… if they have at least so many different payloads: a constant one can agree by chance."""
STANDING: Final = 0.02
"""… but where more of its counters stand still, its counter is elsewhere, or it has none."""


@dataclass(frozen=True, slots=True)
class IdSummary:
    """Frames of one id on one bus.

    Parameters
    ----------
    id : str
        Hexadecimal; 8 digits for an extended id.
    bus : str
        As in the capture; "" where it does not say.
    frames : int
    bytes : str
        Lengths that were seen ("8", "5, 8").
    period_s : float or None
        Median interval [s].
    longest_s : float or None
        Longest interval [s].
    protection : str
        "leaf" or "generic" where CRCs by that rule agree, else "".
    crc_errors, counter_jumps, frames_lost, counter_repeats : int or None
        By that rule; None without it, the last three also where its counter is elsewhere.
    """

    id: str
    bus: str
    frames: int
    bytes: str
    period_s: float | None
    longest_s: float | None
    protection: str
    crc_errors: int | None
    counter_jumps: int | None
    frames_lost: int | None
    counter_repeats: int | None


@dataclass(frozen=True, slots=True)
class Silence:
    """Time without any frame: when the last frame before it came, and its length [s]."""

    start_s: float
    length_s: float


class Survey:
    """Takes the frames of a capture, one after the other.

    Attributes
    ----------
    first_s, last_s : float
        Earliest and latest stamp [s]; NaN before the first frame.
    error_frames, remote_frames, time_reversals, other_ids : int
        Frames of these kinds; stamped earlier than the one before; of ids beyond `MAX_IDS`.
    gaps : list of Silence
    """

    def __init__(self) -> None:
        self.first_s = math.nan
        self.last_s = math.nan
        self.error_frames = 0
        self.remote_frames = 0
        self.time_reversals = 0
        self.other_ids = 0
        self.gaps: list[Silence] = []
        self._records: dict[tuple[Channel | None, int, bool], _IdRecord] = {}

    def take(self, message: can.Message) -> None:
        """Take one frame."""
        self._take_time(message.timestamp)
        if message.is_error_frame:
            self.error_frames += 1
            return
        if message.is_remote_frame:
            self.remote_frames += 1
            return
        key = (message.channel, message.arbitration_id, message.is_extended_id)
        record = self._records.get(key)
        if record is None:
            if len(self._records) >= MAX_IDS:
                self.other_ids += 1
                return
            record = self._records[key] = _IdRecord()
        record.take(message.data, message.timestamp)

    def _take_time(self, time_s: float) -> None:
        if math.isnan(self.first_s):
            self.first_s = self.last_s = time_s
            return
        if time_s < self.last_s:
            self.time_reversals += 1
            self.first_s = min(self.first_s, time_s)
            return
        if time_s - self.last_s > GAP_S and len(self.gaps) < LISTED_GAPS:
            self.gaps.append(Silence(self.last_s, time_s - self.last_s))
        self.last_s = time_s

    def period_s(self, number: int) -> float | None:
        """Return the median interval of a standard id [s], on the bus that has most of it."""
        found = [
            record
            for (_, each, extended), record in self._records.items()
            if each == number and not extended
        ]
        return max(found, key=lambda record: record.frames).period_s if found else None

    def summaries(self) -> tuple[IdSummary, ...]:
        """Return what was seen of every id, by bus and id."""
        ordered = sorted(self._records.items(), key=lambda item: (str(item[0][0]), *item[0][1:]))
        return tuple(
            record.summary(f"{number:08X}" if extended else f"{number:03X}", channel)
            for (channel, number, extended), record in ordered
        )


@dataclass(slots=True)
class _Trial:
    """A protection rule tried on the frames of one id."""

    checker: FrameChecker
    good: int = 0
    crc_errors: int = 0
    counter_jumps: int = 0
    frames_lost: int = 0
    counter_repeats: int = 0

    def take(self, data: bytes | bytearray, time_s: float) -> None:
        verdict = self.checker.check(data, time_s)
        if verdict is Verdict.CRC_WRONG:
            self.crc_errors += 1
            return
        self.good += 1
        if verdict is Verdict.REPEATED:
            self.counter_repeats += 1
        elif verdict is Verdict.AFTER_LOSS:
            self.counter_jumps += 1
            self.frames_lost += self.checker.lost


@dataclass(slots=True)
class _IdRecord:
    """What was seen of one id on one bus."""

    frames: int = 0
    lengths: set[int] = field(default_factory=set)
    intervals: list[float] = field(default_factory=list)
    longest_s: float = -math.inf
    last_s: float = math.nan
    payloads: set[bytes] = field(default_factory=set)
    waiting: list[tuple[bytes, float]] = field(default_factory=list)
    """First frames, kept until the period is known."""
    trials: dict[str, _Trial] = field(default_factory=dict)
    """Rules that still make sense, by name."""

    def take(self, data: bytearray, time_s: float) -> None:
        if self.frames:
            interval = time_s - self.last_s
            self.longest_s = max(self.longest_s, interval)
            if len(self.intervals) < INTERVALS:
                self.intervals.append(interval)
        self.frames += 1
        self.last_s = time_s
        self.lengths.add(len(data))
        if len(self.payloads) < PAYLOADS:
            self.payloads.add(bytes(data))
        if self.frames < LEARN_FRAMES:
            self.waiting.append((bytes(data), time_s))
            return
        if self.waiting:
            self._start_trials()
        self._try_rules(data, time_s)

    def _start_trials(self) -> None:
        # Losses only lengthen intervals: a quarter of them at least is the period. Frames with
        # equal stamps tell none.
        period_s = sorted(self.intervals)[len(self.intervals) // 4] if self.intervals else None
        for rule in (LEAF_RULE, GENERIC_RULE):
            self.trials[rule.name] = _Trial(FrameChecker(rule, period_s or None))
        for data, time_s in self.waiting:
            self._try_rules(data, time_s)
        self.waiting = []

    def _try_rules(self, data: bytes | bytearray, time_s: float) -> None:
        if len(data) < 3 or len(self.lengths) > 1:
            self.trials.clear()
        hopeless = []
        for name, trial in self.trials.items():
            trial.take(data, time_s)
            if trial.crc_errors > 20 and trial.good < trial.crc_errors:
                hopeless.append(name)
        for name in hopeless:
            del self.trials[name]

    @property
    def period_s(self) -> float | None:
        return median(self.intervals) if self.intervals else None

    def _protection(self) -> tuple[str, _Trial | None]:
        if self.waiting:
            self._start_trials()
        if len(self.payloads) >= PAYLOADS:
            for name, trial in self.trials.items():
                if trial.good >= AGREEING * self.frames:
                    return name, trial
        return "", None

    def summary(self, name: str, channel: Channel | None) -> IdSummary:
        rule, trial = self._protection()
        counter = trial
        if trial is not None and trial.counter_repeats > STANDING * self.frames:
            counter = None  # the CRC is right, but the counter is not where the rule has it
        return IdSummary(
            id=name,
            bus="" if channel is None else str(channel),
            frames=self.frames,
            bytes=", ".join(str(length) for length in sorted(self.lengths)),
            period_s=self.period_s,
            longest_s=self.longest_s if self.intervals else None,
            protection=rule,
            crc_errors=None if trial is None else trial.crc_errors,
            counter_jumps=None if counter is None else counter.counter_jumps,
            frames_lost=None if counter is None else counter.frames_lost,
            counter_repeats=None if counter is None else counter.counter_repeats,
        )
