"""Inspect a capture: its frames by id, their periods and protection, and the matching presets."""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, get_args

import can
import numpy as np
from can.typechecking import StringPathLike

from cangauge._typing import FloatArray
from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.protection import RULES, Anomaly, FrameChecker, Protection
from cangauge.bus.recording import capture_to_log, open_vehicle_capture
from cangauge.bus.vehicle import PRESETS, Vehicle
from cangauge.inspect.log import Gap, LogInspection, inspect_log

GAP_S: Final = 1.0
"""Longest silence of a bus that does not count as a gap [s]."""
LISTED_GAPS: Final = 20
LEARN_FRAMES: Final = 50
"""First frames of an id that decide whether a protection rule is worth trying on all of them."""
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

_COLUMNS: Final = ("current_a", "voltage_v", "temperature_c", "soc_pct")
Span = tuple[float, float] | None
"""Lowest and highest value; None without any."""


@dataclass(frozen=True, slots=True)
class IdSummary:
    """Frames of one id on one bus.

    `protection` is the vehicle's rule, or the one whose CRCs agree, or "". Counts by it are None
    without one, those of the counter also where the counter is elsewhere in the frame.
    """

    id: str
    bus: str
    frames: int
    bytes: str
    period_s: float | None = None
    longest_s: float | None = None
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

    `info` is that of `Capture`.
    `time_reversals` are frames stamped earlier than the one before.
    """

    name: str
    source: str
    info: dict[str, Any]
    start_s: float
    duration_s: float
    error_frames: int
    remote_frames: int
    time_reversals: int
    ids: tuple[IdSummary, ...]
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
    path: StringPathLike, vehicle: Vehicle | None = None, frames: int | None = None
) -> CaptureInspection:
    """Inspect a capture, or its first `frames`; with a vehicle, also the decoded log.

    Raises
    ------
    InputError
        If it cannot be read, or holds no usable frame; with a vehicle, also as `capture_to_log`.
    """
    path = Path(path)
    capture = open_vehicle_capture(path, vehicle)
    stamps_s, error_frames, remote_frames = array("d"), 0, 0
    ids: defaultdict[tuple[str, int, bool], _Frames] = defaultdict(_Frames)
    cars = {name: preset.vehicle() for name, preset in PRESETS.items()}
    wanted = {key for car in cars.values() for key in car.wanted_ids}
    buses = defaultdict[str, list[_Trial]](partial(_trials, cars))
    for message in islice(capture, frames):
        stamps_s.append(message.timestamp)
        error_frames += message.is_error_frame
        remote_frames += message.is_remote_frame and not message.is_error_frame
        if not (message.is_error_frame or message.is_remote_frame):
            bus = "" if message.channel is None else str(message.channel)
            ids[bus, message.arbitration_id, message.is_extended_id].add(message)
            if message.arbitration_id in wanted:
                for trial in buses[bus]:
                    trial.add(message)
    start_s, steps_s = min(stamps_s), np.diff(stamps_s)
    duration_s = max(stamps_s) - start_s
    gaps = np.flatnonzero(steps_s > GAP_S)[:LISTED_GAPS].tolist()
    rules = {} if vehicle is None else _rules_of(vehicle)
    summaries = tuple(
        frames.summary(*key, rules.get(key[1:])) for key, frames in sorted(ids.items())
    )
    # Of every preset the trial on the bus with most of its samples; without a frame of any preset,
    # that of an empty bus.
    of_buses = buses.values() or [buses[""]]
    best = [max(trials, key=len) for trials in zip(*of_buses, strict=True)]
    return CaptureInspection(
        path.name,
        str(path),
        capture.info,
        start_s,
        duration_s,
        error_frames,
        remote_frames,
        time_reversals=int((steps_s < 0.0).sum()),
        ids=summaries,
        gaps=tuple({"start_s": stamps_s[at], "length_s": float(steps_s[at])} for at in gaps),
        presets=_without_cold_relatives(trial.match(summaries, duration_s) for trial in best),
        log=None if vehicle is None else inspect_log(capture_to_log(path, vehicle)),
    )


# --- Frames by id

_Rule = tuple[Protection, str, int]
"""A protection that a vehicle states, its name, and the length of its message."""


def _rules_of(vehicle: Vehicle) -> dict[tuple[int, bool], _Rule]:
    """Return the stated protections by id, and whether it is extended."""
    return {
        (each.arbitration_id, each.is_extended): (stated.rule, stated.name or "", each.length)
        for each in (*vehicle.signals, *vehicle.cells)
        if (stated := vehicle.messages[each.key]).rule is not None
    }


def _no_stamps() -> array[float]:
    return array("d")


@dataclass(slots=True)
class _Frames:
    """Frames of one id on one bus; `payloads` are joined, for as long as all have one length."""

    stamps_s: array[float] = field(default_factory=_no_stamps)
    lengths: set[int] = field(default_factory=set)
    payloads: bytearray = field(default_factory=bytearray)

    def add(self, message: can.Message) -> None:
        self.stamps_s.append(message.timestamp)
        self.lengths.add(len(message.data))
        if len(self.lengths) == 1:
            self.payloads += message.data

    def summary(self, bus: str, number: int, is_extended: bool, stated: _Rule | None) -> IdSummary:
        name = f"{number:08X}" if is_extended else f"{number:03X}"
        lengths, intervals_s = ", ".join(map(str, sorted(self.lengths))), np.diff(self.stamps_s)
        known: dict[str, Any] = {}
        if intervals_s.size:
            known = {
                "period_s": float(np.median(intervals_s)),
                "longest_s": float(intervals_s.max()),
                **self._protection(intervals_s, stated),
            }
        return IdSummary(name, bus, len(self.stamps_s), lengths, **known)

    def _protection(self, intervals_s: FloatArray, stated: _Rule | None) -> dict[str, Any]:
        """Return the fields of `IdSummary` by the stated rule, or the first whose CRCs agree.

        {} without one.
        """
        length = max(self.lengths)
        if len(self.lengths) > 1 or length < (3 if stated is None else stated[2]):
            return {}
        payloads = [self.payloads[at : at + length] for at in range(0, len(self.payloads), length)]
        # Lost frames lengthen intervals: the lower quartile is the period; 0 for equal stamps.
        period_s = float(np.quantile(intervals_s, 0.25)) or None
        if stated is not None:
            rule, name, length = stated
            payloads = [data[:length] for data in payloads]
            return _counts_by(rule, name, payloads, self.stamps_s, period_s)
        varies = len(set(map(bytes, payloads))) >= PAYLOADS
        for name in ("leaf", "generic") if varies else ():
            rule, first = RULES[name], payloads[:LEARN_FRAMES]
            if 2 * sum(map(rule.is_whole, first)) < len(first):
                continue
            found = _counts_by(rule, name, payloads, self.stamps_s, period_s)
            if found["crc_errors"] > DAMAGED * len(payloads):
                continue
            most = MIXED_SHARE if found["two_senders"] else REPEATED_SHARE
            if found["counter_repeats"] > most * len(payloads):
                return {"protection": name, "crc_errors": found["crc_errors"]}
            return found
        return {}


def _counts_by(
    rule: Protection,
    name: str,
    payloads: list[bytearray],
    stamps_s: array[float],
    period_s: float | None,
) -> dict[str, Any]:
    checker, lost, two_senders = FrameChecker(rule, period_s), 0, False
    anomalies: dict[str, int] = dict.fromkeys(get_args(Anomaly), 0)
    for data, time_s in zip(payloads, stamps_s, strict=True):
        anomaly = checker.check(data, time_s)
        if anomaly is not None:
            anomalies[anomaly] += 1
        lost += checker.lost if anomaly == "counter_jumps" else 0
        two_senders |= checker.suspects_second_sender
    return {"protection": name, "frames_lost": lost, "two_senders": two_senders, **anomalies}


# --- Match of the presets


class _Trial:
    """A preset tried on one bus of the capture; its length is the number of samples."""

    def __init__(self, name: str, vehicle: Vehicle) -> None:
        self._name, self._decoder, self._values = name, SampleDecoder(vehicle), array("d")

    def __len__(self) -> int:
        return self._decoder.statistics.samples

    def add(self, message: can.Message) -> None:
        if (sample := self._decoder.handle(message)) is not None:
            self._values.extend((*sample[1:], self._decoder.reference_soc_pct))

    def match(self, ids: Sequence[IdSummary], duration_s: float) -> PresetMatch:
        spans: dict[str, Span] = {}
        for column, values in zip(_COLUMNS, np.reshape(self._values, (-1, 4)).T, strict=True):
            if (finite := values[np.isfinite(values)]).size:
                spans[column] = float(finite.min()), float(finite.max())
        problem = self._problem(spans, duration_s) or _wrong_period(self._name, ids, duration_s)
        because, about = problem or "all its signals decode", PRESETS[self._name].about
        return PresetMatch(self._name, about, not problem, because, len(self), **spans)

    def _problem(self, spans: dict[str, Span], duration_s: float) -> str:
        """Return why the frames are not those of the preset, or ""."""
        statistics = self._decoder.statistics
        if not len(self):
            return "no current in its frames" if statistics.wanted else "none of its frames"
        if statistics.crc_errors > DAMAGED * statistics.wanted:
            return f"{statistics.crc_errors} of {statistics.wanted} CRCs are wrong"
        if "voltage_v" not in spans:
            return "no voltage"
        has_temperature = self._decoder.vehicle.temperature is None or "temperature_c" in spans
        return "" if has_temperature or duration_s < LONG_ENOUGH_S else "no temperature"


def _trials(cars: Mapping[str, Vehicle]) -> list[_Trial]:
    return [_Trial(*each) for each in cars.items()]


def _wrong_period(preset: str, ids: Sequence[IdSummary], duration_s: float) -> str:
    """Return which id is absent or has another period, on the bus that has most of it, or ""."""
    for number, expected_s in PRESETS[preset].periods_s.items():
        same = [each for each in ids if each.id == f"{number:03X}"]
        period_s = max(same, key=attrgetter("frames")).period_s if same else None
        if period_s is None and duration_s >= LONG_ENOUGH_S:
            return f"no frames of 0x{number:X}"
        if period_s is not None and abs(period_s - expected_s) > PERIOD_TOLERANCE * expected_s:
            return f"0x{number:X} has a period of {period_s:.3g} s, not {expected_s:g} s"
    return ""


def _without_cold_relatives(matches: Iterable[PresetMatch]) -> tuple[PresetMatch, ...]:
    """Say of a match that it is none where a related preset finds the temperature as well."""
    found = list(matches)
    warm = {PRESETS[match.preset].dbc for match in found if match.temperature_c is not None}
    for place, match in enumerate(found):
        car = PRESETS[match.preset]
        if match.matches and car.lacks_temperature and car.dbc in warm:
            why = "the pack temperature is on this bus"
            found[place] = replace(match, matches=False, because=why)
    return tuple(found)
