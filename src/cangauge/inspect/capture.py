"""Inspect a capture: its frames by id, their periods and protection, and the matching presets."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from os import PathLike
from pathlib import Path
from statistics import median
from typing import Any, Final

import can
from can.typechecking import Channel

from cangauge.bus.captures import CaptureInfo, open_capture
from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.protection import RULES, FrameChecker, Verdict
from cangauge.bus.recording import capture_to_log, open_vehicle_capture
from cangauge.bus.vehicle import LOG_COLUMNS, PRESETS, Vehicle
from cangauge.inspect.log import Gap, LogInspection, inspect_log

GAP_S: Final = 1.0
"""Longest silence of a bus that does not count as a gap [s]."""
LISTED_GAPS: Final = 20
MAX_IDS: Final = 4096
"""Most ids to describe, more than any car has; frames of others are only counted."""
LEARN_FRAMES: Final = 50
INTERVALS: Final = 2000
"""First frames of an id from which the period of its alive counter is learned, and first intervals
whose median is its period."""
DAMAGED: Final = 0.1
PAYLOADS: Final = 4
"""Largest share of frames with a wrong CRC for an id to be protected by a rule, and least number of
different payloads: a constant one can agree by chance."""
REPEATED_SHARE: Final = 0.02
MIXED_SHARE: Final = 0.55
"""Largest share of repeated counters; above it the counter is elsewhere, or there is none. Of two
senders: of two frames with one counter value, one is repeated."""
PERIOD_TOLERANCE: Final = 0.3
"""Largest difference of a period from a preset's [-]."""
LONG_ENOUGH_S: Final = 2.0
"""Length of a capture from which slow signals are expected [s]."""

Span = tuple[float, float] | None
"""Lowest and highest value; None without any."""


@dataclass(frozen=True, slots=True)
class IdSummary:
    """Frames of one id on one bus.

    `protection` is the rule whose CRCs agree, or "". Counts by it are None without one, those of
    the counter also where the counter is elsewhere in the frame.
    """

    id: str
    bus: str
    frames: int
    bytes: str
    period_s: float | None
    longest_s: float | None
    protection: str = ""
    crc_errors: int | None = None
    counter_jumps: int | None = None
    frames_lost: int | None = None
    counter_repeats: int | None = None
    two_senders: bool = False


@dataclass(frozen=True, slots=True)
class PresetMatch:
    """Whether a preset decodes the capture, why, and the range of each value that it decodes."""

    preset: str
    about: str
    matches: bool
    because: str
    samples: int = 0
    current_a: Span = None
    voltage_v: Span = None
    temperature_c: Span = None
    soc_pct: Span = None


@dataclass(frozen=True, slots=True)
class CaptureInspection:
    """Findings of `inspect_capture`; `log` is the decoded one, with a vehicle.

    `time_reversals` are frames stamped earlier than the one before. `other_ids` are frames of ids
    beyond the first `MAX_IDS`.
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
    gaps: tuple[Gap, ...]
    presets: tuple[PresetMatch, ...]
    log: LogInspection | None = None

    @property
    def matching(self) -> tuple[str, ...]:
        """Names of the presets that match."""
        return tuple(match.preset for match in self.presets if match.matches)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        plain, names = asdict(self), ", ".join(self.matching)
        plain["log"] = None if self.log is None else self.log.to_dict()
        return {"kind": "capture", **plain.pop("info"), **plain, "matching_presets": names}


def inspect_capture(
    path: str | PathLike[str], vehicle: Vehicle | None = None, frames: int | None = None
) -> CaptureInspection:
    """Inspect a capture, or its first `frames`; with a vehicle, also the decoded log.

    Raises
    ------
    InputError
        If it cannot be read, or holds no usable frame; with a vehicle, also as `capture_to_log`.
    """
    path = Path(path)
    capture = open_capture(path) if vehicle is None else open_vehicle_capture(path, vehicle)
    survey, attempts = _Survey(), _Attempts()
    for message in islice(capture, frames):
        survey.add(message)
        attempts.add(message)
    return CaptureInspection(
        path.name, str(path), capture.info, survey.first_s, survey.last_s - survey.first_s,
        survey.error_frames, survey.remote_frames, survey.time_reversals, survey.summaries(),
        survey.other_ids, tuple(survey.gaps), attempts.matches(survey),
        None if vehicle is None else inspect_log(capture_to_log(path, vehicle)),
    )  # fmt: skip


# --- Frames by id, without a vehicle


class _Survey:
    """Statistics of the frames of a capture; attributes as of `CaptureInspection`."""

    def __init__(self) -> None:
        self.first_s, self.last_s = math.inf, -math.inf
        self.error_frames = self.remote_frames = self.time_reversals = self.other_ids = 0
        self.gaps: list[Gap] = []
        self._records: dict[tuple[Channel | None, int, bool], _IdRecord] = {}

    def add(self, message: can.Message) -> None:
        time_s, step_s = message.timestamp, message.timestamp - self.last_s
        self.time_reversals += step_s < 0.0
        if GAP_S < step_s < math.inf and len(self.gaps) < LISTED_GAPS:
            self.gaps.append(Gap(self.last_s, step_s))
        self.first_s, self.last_s = min(self.first_s, time_s), max(self.last_s, time_s)
        self.error_frames += message.is_error_frame
        self.remote_frames += message.is_remote_frame and not message.is_error_frame
        if message.is_error_frame or message.is_remote_frame:
            return
        key = (message.channel, message.arbitration_id, message.is_extended_id)
        if key in self._records or len(self._records) < MAX_IDS:
            self._records.setdefault(key, _IdRecord()).add(bytes(message.data), time_s)
        else:
            self.other_ids += 1

    def period_s(self, number: int) -> float | None:
        """Return the median interval of a standard id [s], on the bus that has most of it."""
        records = self._records.items()
        found = [record for (_, each, wide), record in records if each == number and not wide]
        return max(found, key=lambda record: record.frames).period_s if found else None

    def summaries(self) -> tuple[IdSummary, ...]:
        """Return the summary of every id, ordered by bus and id."""
        ordered = sorted(self._records.items(), key=lambda item: (str(item[0][0]), *item[0][1:]))
        return tuple(
            record.summary(f"{number:08X}" if extended else f"{number:03X}", channel)
            for (channel, number, extended), record in ordered
        )


class _Trial:
    """One of `RULES` tried on the frames of one id."""

    def __init__(self, rule: str, period_s: float | None) -> None:
        self.rule, self._checker = rule, FrameChecker(RULES[rule], period_s)
        self.verdicts = dict.fromkeys(Verdict, 0)
        self.crc_errors = self.frames_lost = 0
        self.two_senders = False

    def add(self, data: bytes, time_s: float) -> None:
        verdict = self._checker.check(data, time_s)
        self.verdicts[verdict] += 1
        self.crc_errors += verdict is Verdict.CRC_WRONG
        self.two_senders |= self._checker.suspects_second_sender
        self.frames_lost += self._checker.lost if verdict is Verdict.AFTER_LOSS else 0


@dataclass(slots=True)
class _IdRecord:
    """Frames of one id on one bus; `waiting` are the first ones, until the period is known."""

    frames: int = 0
    lengths: set[int] = field(default_factory=set)
    intervals: list[float] = field(default_factory=list)
    longest_s: float = -math.inf
    last_s: float = math.nan
    payloads: set[bytes] = field(default_factory=set)
    waiting: list[tuple[bytes, float]] = field(default_factory=list)
    trials: list[_Trial] | None = None

    def add(self, data: bytes, time_s: float) -> None:
        if self.frames:
            self.longest_s = max(self.longest_s, time_s - self.last_s)
            if len(self.intervals) < INTERVALS:
                self.intervals.append(time_s - self.last_s)
        self.frames, self.last_s = self.frames + 1, time_s
        self.lengths.add(len(data))
        if len(self.payloads) < PAYLOADS:
            self.payloads.add(data)
        self.waiting.append((data, time_s))
        if self.frames >= LEARN_FRAMES:
            self._try_rules()

    def _try_rules(self) -> None:
        if self.trials is None:
            # Lost frames lengthen intervals: the lower quartile is the period; 0 for equal stamps.
            period_s = sorted(self.intervals)[len(self.intervals) // 4] if self.intervals else None
            self.trials = [_Trial(rule, period_s or None) for rule in ("leaf", "generic")]
        for data, time_s in self.waiting:
            if len(data) < 3 or len(self.lengths) > 1:
                self.trials = []
            for trial in list(self.trials):
                trial.add(data, time_s)
                if trial.crc_errors > max(20, sum(trial.verdicts.values()) / 2):
                    self.trials.remove(trial)
        self.waiting.clear()

    @property
    def period_s(self) -> float | None:
        return median(self.intervals) if self.intervals else None

    def summary(self, name: str, channel: Channel | None) -> IdSummary:
        self._try_rules()
        bus, sizes = "" if channel is None else str(channel), sorted(self.lengths)
        found = IdSummary(
            name, bus, self.frames, ", ".join(map(str, sizes)), self.period_s,
            self.longest_s if self.intervals else None,
        )  # fmt: skip
        agreeing = (
            trial for trial in self.trials or () if trial.crc_errors <= DAMAGED * self.frames
        )
        trial = next(agreeing, None) if len(self.payloads) >= PAYLOADS else None
        if trial is None:
            return found
        found = replace(found, protection=trial.rule, crc_errors=trial.crc_errors)
        repeats, jumps = (trial.verdicts[each] for each in (Verdict.REPEATED, Verdict.AFTER_LOSS))
        if repeats > (MIXED_SHARE if trial.two_senders else REPEATED_SHARE) * self.frames:
            return found
        return replace(
            found, counter_jumps=jumps, frames_lost=trial.frames_lost, counter_repeats=repeats,
            two_senders=trial.two_senders,
        )  # fmt: skip


# --- Match of the presets


class _Attempt:
    """A preset tried on one bus of the capture: its samples, and the range of each value."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.decoder, self.samples = SampleDecoder(vehicle), 0
        self.spans: dict[str, Span] = {}

    def add(self, message: can.Message) -> None:
        sample = self.decoder.handle(message)
        self.samples += sample is not None
        values = () if sample is None else (*sample[1:], self.decoder.reference_soc_pct)
        for name, value in zip(LOG_COLUMNS.values(), values, strict=False):
            if not math.isnan(value):
                low, high = self.spans.get(name) or (value, value)
                self.spans[name] = (min(low, value), max(high, value))


class _Attempts:
    """Every preset tried on every bus of the capture."""

    def __init__(self) -> None:
        self._vehicles = {name: preset.vehicle() for name, preset in PRESETS.items()}
        self._wanted = {key for car in self._vehicles.values() for key in car.wanted_ids}
        self._buses: dict[Channel | None, dict[str, _Attempt]] = {}

    def add(self, message: can.Message) -> None:
        if message.arbitration_id in self._wanted:
            if message.channel not in self._buses:
                cars = self._vehicles.items()
                self._buses[message.channel] = {name: _Attempt(car) for name, car in cars}
            for attempt in self._buses[message.channel].values():
                attempt.add(message)

    def matches(self, survey: _Survey) -> tuple[PresetMatch, ...]:
        """Return the match of every preset, on the bus with most of its samples."""
        found = [self._match(name, survey) for name in PRESETS]
        # A related preset that also finds its temperature explains more of the capture.
        warm = {PRESETS[match.preset].dbc for match in found if match.temperature_c is not None}
        cold = {name for name, car in PRESETS.items() if car.lacks_temperature and car.dbc in warm}
        no = {"matches": False, "because": "the pack temperature is on this bus"}
        return tuple(replace(m, **no) if m.matches and m.preset in cold else m for m in found)  # type: ignore[arg-type] # of its fields

    def _match(self, name: str, survey: _Survey) -> PresetMatch:
        car = self._vehicles[name]
        tries = [attempts[name] for attempts in self._buses.values()] or [_Attempt(car)]
        best = max(tries, key=lambda attempt: attempt.samples)
        problem = _problem(name, best, car, survey)
        because, about = problem or "all its signals decode", PRESETS[name].about
        return PresetMatch(name, about, not problem, because, best.samples, **best.spans)


def _problem(name: str, attempt: _Attempt, vehicle: Vehicle, survey: _Survey) -> str:
    """Return why a preset does not match, or ""."""
    statistics, spans = attempt.decoder.statistics, attempt.spans
    if not attempt.samples:
        return "no current in its frames" if statistics.wanted else "none of its frames"
    if statistics.crc_errors > 0.1 * statistics.wanted:
        return f"{statistics.crc_errors} of {statistics.wanted} CRCs are wrong"
    long_enough = survey.last_s - survey.first_s >= LONG_ENOUGH_S
    has_temperature = vehicle.temperature is None or "temperature_c" in spans
    if "voltage_v" not in spans or (long_enough and not has_temperature):
        return "no temperature" if "voltage_v" in spans else "no voltage"
    for number, expected_s in PRESETS[name].periods_s.items():
        period_s = survey.period_s(number)
        if period_s is None and long_enough:
            return f"no frames of 0x{number:X}"
        if period_s is not None and abs(period_s - expected_s) > PERIOD_TOLERANCE * expected_s:
            return f"0x{number:X} has a period of {period_s:.3g} s, not {expected_s:g} s"
    return ""
