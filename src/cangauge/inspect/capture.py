"""Inspect a capture: its frames by id, their periods and protection, and the matching presets."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from os import PathLike
from pathlib import Path
from statistics import median
from typing import Any, Final

import can
from can.typechecking import Channel

from cangauge.bus.captures import CaptureInfo, open_capture
from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.protection import GENERIC_RULE, LEAF_RULE, FrameChecker, Verdict
from cangauge.bus.recording import capture_to_log, open_vehicle_capture
from cangauge.bus.vehicle import PRESETS, Vehicle
from cangauge.inspect.log import LogInspection, inspect_log

GAP_S: Final = 1.0
"""Longest silence of a bus that does not count as a gap [s]."""
LISTED_GAPS: Final = 20
MAX_IDS: Final = 4096
"""Most ids to describe, more than any car has; frames of others are only counted."""
INTERVALS: Final = 2000
"""First intervals of an id whose median is its period."""
LEARN_FRAMES: Final = 50
"""First frames of an id, from which the period of its alive counter is learned."""
AGREEING: Final = 0.9
"""Least share of frames with a correct CRC for an id to be protected by a rule, …"""
PAYLOADS: Final = 4
"""… which have at least this many different payloads: a constant one can agree by chance."""
REPEATED_SHARE: Final = 0.02
"""Largest share of repeated counters; above it the counter is elsewhere, or there is none."""
MIXED_SHARE: Final = 0.55
"""The same of two senders: of two frames with one counter value, one is repeated."""
PERIOD_TOLERANCE: Final = 0.3
"""Largest difference of a period from a preset's [-]."""
LONG_ENOUGH_S: Final = 2.0
"""Length of a capture from which slow signals are expected [s]."""


@dataclass(frozen=True, slots=True)
class IdSummary:
    """Frames of one id on one bus.

    Parameters
    ----------
    id : str
        Hexadecimal; 8 digits for an extended id.
    bus : str
        As in the capture; "" where it names none.
    frames : int
    bytes : str
        Data lengths ("8", "5, 8").
    period_s : float or None
        Median interval [s].
    longest_s : float or None
        Longest interval [s].
    protection : str
        "leaf" or "generic" where CRCs of that rule agree, else "".
    crc_errors, counter_jumps, frames_lost, counter_repeats : int or None
        By that rule; None without one, the last three also where its counter is elsewhere.
    two_senders : bool
        Whether the counters are those of two senders at times.
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
    two_senders: bool


@dataclass(frozen=True, slots=True)
class Silence:
    """An interval without any frame: stamp of the last frame before it, and its length [s]."""

    start_s: float
    length_s: float


@dataclass(frozen=True, slots=True)
class PresetMatch:
    """Whether a preset decodes the capture.

    Parameters
    ----------
    preset, about : str
    matches : bool
    because : str
        Why, or why not.
    samples : int
    current_a, voltage_v, temperature_c, soc_pct : tuple of float, or None
        Lowest and highest value decoded, [A] (positive = discharge), [V], [°C], [%].
    """

    preset: str
    about: str
    matches: bool
    because: str
    samples: int
    current_a: tuple[float, float] | None
    voltage_v: tuple[float, float] | None
    temperature_c: tuple[float, float] | None
    soc_pct: tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class CaptureInspection:
    """Findings of `inspect_capture`.

    Parameters
    ----------
    name, source : str
    info : CaptureInfo
    start_s, duration_s : float
        Stamp of the first frame, time to the last [s].
    error_frames, remote_frames : int
    time_reversals : int
        Frames stamped earlier than the one before.
    ids : tuple of IdSummary
    other_ids : int
        Frames of ids beyond the first `MAX_IDS`.
    gaps : tuple of Silence
        The first `LISTED_GAPS` silences longer than `GAP_S`.
    presets : tuple of PresetMatch
    log : LogInspection or None
        With a vehicle: of the decoded log.
    """

    name: str
    source: str
    info: CaptureInfo
    start_s: float
    duration_s: float
    error_frames: int
    remote_frames: int
    time_reversals: int
    ids: tuple[IdSummary, ...]
    other_ids: int
    gaps: tuple[Silence, ...]
    presets: tuple[PresetMatch, ...]
    log: LogInspection | None = None

    @property
    def matching(self) -> tuple[str, ...]:
        """Names of the presets that match."""
        return tuple(match.preset for match in self.presets if match.matches)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        plain = asdict(self)
        info = plain.pop("info")
        return {
            "kind": "capture",
            **info,
            **plain,
            "matching_presets": ", ".join(self.matching),
            "log": None if self.log is None else self.log.to_dict(),
        }


def inspect_capture(path: str | PathLike[str], vehicle: Vehicle | None = None) -> CaptureInspection:
    """Inspect a capture; with a vehicle, also the decoded log.

    Raises
    ------
    InputError
        If it cannot be read, or holds no usable frame; with a vehicle, also as `capture_to_log`.
    """
    path = Path(path)
    capture = open_capture(path) if vehicle is None else open_vehicle_capture(path, vehicle)
    survey, attempts = _Survey(), _Attempts()
    for message in capture:
        survey.take(message)
        attempts.take(message)
    log = None if vehicle is None else inspect_log(capture_to_log(path, vehicle))
    return CaptureInspection(
        name=path.name,
        source=str(path),
        info=capture.info,
        start_s=survey.first_s,
        duration_s=survey.last_s - survey.first_s,
        error_frames=survey.error_frames,
        remote_frames=survey.remote_frames,
        time_reversals=survey.time_reversals,
        ids=survey.summaries(),
        other_ids=survey.other_ids,
        gaps=tuple(survey.gaps),
        presets=attempts.matches(survey),
        log=log,
    )


# --- Frames by id, without a vehicle


class _Survey:
    """Statistics of the frames of a capture; attributes as of `CaptureInspection`."""

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
        """Return the summary of every id, ordered by bus and id."""
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
    two_senders: bool = False

    def take(self, data: bytes | bytearray, time_s: float) -> None:
        verdict = self.checker.check(data, time_s)
        self.two_senders |= self.checker.suspects_second_sender
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
    """Frames of one id on one bus."""

    frames: int = 0
    lengths: set[int] = field(default_factory=set)
    intervals: list[float] = field(default_factory=list)
    longest_s: float = -math.inf
    last_s: float = math.nan
    payloads: set[bytes] = field(default_factory=set)
    waiting: list[tuple[bytes, float]] = field(default_factory=list)
    """First frames, until the period is known."""
    trials: dict[str, _Trial] = field(default_factory=dict)
    """Rules that may still apply, by name."""

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
        # Lost frames lengthen intervals, so the lower quartile is the period; 0 for equal stamps.
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
        if trial is not None and trial.counter_repeats > REPEATED_SHARE * self.frames:
            # The CRC is correct; the counter is not where the rule expects it, or there are two.
            is_mixed = trial.two_senders and trial.counter_repeats <= MIXED_SHARE * self.frames
            counter = trial if is_mixed else None
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
            two_senders=counter is not None and counter.two_senders,
        )


# --- Match of the presets


@dataclass(slots=True)
class _Range:
    low: float = math.inf
    high: float = -math.inf

    def take(self, value: float) -> None:
        if not math.isnan(value):
            self.low = min(self.low, value)
            self.high = max(self.high, value)

    @property
    def ends(self) -> tuple[float, float] | None:
        return (self.low, self.high) if self.low <= self.high else None


class _Attempt:
    """A preset tried on one bus of the capture."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.decoder = SampleDecoder(vehicle)
        self.samples = 0
        self.current = _Range()
        self.voltage = _Range()
        self.temperature = _Range()
        self.soc = _Range()

    def take(self, message: can.Message) -> None:
        sample = self.decoder.handle(message)
        if sample is not None:
            self.samples += 1
            self.current.take(sample.current_a)
            self.voltage.take(sample.voltage_v)
            self.temperature.take(sample.temperature_c)
            self.soc.take(self.decoder.reference_soc_pct)


class _Attempts:
    """Every preset tried on every bus of the capture."""

    def __init__(self) -> None:
        self._vehicles = {name: preset.vehicle() for name, preset in PRESETS.items()}
        self._wanted = {key for car in self._vehicles.values() for key in car.wanted_ids}
        self._buses: dict[Channel | None, dict[str, _Attempt]] = {}

    def take(self, message: can.Message) -> None:
        if message.arbitration_id not in self._wanted:
            return
        attempts = self._buses.get(message.channel)
        if attempts is None:
            attempts = {name: _Attempt(vehicle) for name, vehicle in self._vehicles.items()}
            self._buses[message.channel] = attempts
        for attempt in attempts.values():
            attempt.take(message)

    def matches(self, survey: _Survey) -> tuple[PresetMatch, ...]:
        """Return the match of every preset, on the bus with most of its samples."""
        found: dict[str, PresetMatch] = {}
        for name in PRESETS:
            tries = [attempts[name] for attempts in self._buses.values()]
            best = max(tries, key=lambda attempt: attempt.samples, default=None)
            found[name] = self._match(name, best, survey)
        # A related preset that also finds its temperature explains more of the capture.
        with_temperature = {
            PRESETS[name].dbc for name, match in found.items() if match.temperature_c is not None
        }
        return tuple(
            replace(match, matches=False, because="the pack temperature is on this bus")
            if match.matches
            and PRESETS[name].lacks_temperature
            and PRESETS[name].dbc in with_temperature
            else match
            for name, match in found.items()
        )

    def _match(self, name: str, attempt: _Attempt | None, survey: _Survey) -> PresetMatch:
        problem = (
            "none of its frames"
            if attempt is None
            else _problem(name, attempt, self._vehicles[name], survey)
        )
        return PresetMatch(
            preset=name,
            about=PRESETS[name].about,
            matches=not problem,
            because=problem or "all its signals decode",
            samples=0 if attempt is None else attempt.samples,
            current_a=None if attempt is None else attempt.current.ends,
            voltage_v=None if attempt is None else attempt.voltage.ends,
            temperature_c=None if attempt is None else attempt.temperature.ends,
            soc_pct=None if attempt is None else attempt.soc.ends,
        )


def _problem(name: str, attempt: _Attempt, vehicle: Vehicle, survey: _Survey) -> str:
    """Return why a preset does not match, or ""."""
    statistics = attempt.decoder.statistics
    if not attempt.samples:
        return "no current in its frames" if statistics.wanted else "none of its frames"
    if statistics.crc_errors > 0.1 * statistics.wanted:
        return f"{statistics.crc_errors} of {statistics.wanted} CRCs are wrong"
    if attempt.voltage.ends is None:
        return "no voltage"
    long_enough = survey.last_s - survey.first_s >= LONG_ENOUGH_S
    if long_enough and vehicle.temperature is not None and attempt.temperature.ends is None:
        return "no temperature"
    return _period_problem(name, survey, long_enough=long_enough)


def _period_problem(name: str, survey: _Survey, *, long_enough: bool) -> str:
    for number, expected_s in PRESETS[name].periods_s.items():
        period_s = survey.period_s(number)
        if period_s is None:
            if long_enough:
                return f"no frames of 0x{number:X}"
        elif abs(period_s - expected_s) > PERIOD_TOLERANCE * expected_s:
            return f"0x{number:X} has a period of {period_s:.3g} s, not {expected_s:g} s"
    return ""
