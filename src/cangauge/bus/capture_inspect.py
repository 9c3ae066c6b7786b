"""`inspect_capture`: what frames a capture holds, whose they are, and whether they are whole."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Final

import can
from can.typechecking import Channel

from cangauge.bus.capture_log import capture_to_log, open_vehicle_capture
from cangauge.bus.capture_survey import IdSummary, Silence, Survey
from cangauge.bus.captures import CaptureInfo, open_capture
from cangauge.bus.decode import SampleAssembler
from cangauge.bus.presets import PRESETS
from cangauge.bus.vehicle import Vehicle, preset_vehicle
from cangauge.inspect.analysis import LogInspection, inspect_log

PERIOD_TOLERANCE: Final = 0.3
"""A period may differ so much from a preset's."""
LONG_ENOUGH_S: Final = 2.0
"""Slow signals can be expected in captures from this length on [s]."""


@dataclass(frozen=True, slots=True)
class PresetMatch:
    """Whether a preset makes sense of the capture.

    Parameters
    ----------
    preset, about : str
    matches : bool
    because : str
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
    """What `inspect_capture` finds.

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
        With a vehicle: of the samples that it makes of the capture.
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
        info = self.info.to_dict()
        return {
            "kind": "capture",
            "name": self.name,
            "source": self.source,
            **{key: value for key, value in info.items() if key != "remarks"},
            "start_s": self.start_s,
            "duration_s": self.duration_s,
            "error_frames": self.error_frames,
            "remote_frames": self.remote_frames,
            "time_reversals": self.time_reversals,
            "matching_presets": ", ".join(self.matching),
            "other_ids": self.other_ids,
            "ids": [asdict(each) for each in self.ids],
            "gaps": [asdict(each) for each in self.gaps],
            "presets": [asdict(each) for each in self.presets],
            "remarks": info["remarks"],
            "log": None if self.log is None else self.log.to_dict(),
        }


def inspect_capture(path: str | PathLike[str], vehicle: Vehicle | None = None) -> CaptureInspection:
    """Inspect a capture; with a vehicle, also the log that its frames make.

    Raises
    ------
    InputError
        If it cannot be read, or holds no frame that can be used; with a vehicle, also as
        `capture_to_log`.
    """
    path = Path(path)
    capture = open_capture(path) if vehicle is None else open_vehicle_capture(path, vehicle)
    survey, attempts = Survey(), _Attempts()
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
        self.assembler = SampleAssembler(vehicle)
        self.samples = 0
        self.current = _Range()
        self.voltage = _Range()
        self.temperature = _Range()
        self.soc = _Range()

    def take(self, message: can.Message) -> None:
        sample = self.assembler.handle(message)
        if sample is not None:
            self.samples += 1
            self.current.take(sample.current_a)
            self.voltage.take(sample.voltage_v)
            self.temperature.take(sample.temperature_c)
            self.soc.take(self.assembler.reference_soc_pct)


class _Attempts:
    """Every preset tried on every bus of the capture."""

    def __init__(self) -> None:
        self._vehicles = {name: preset_vehicle(preset) for name, preset in PRESETS.items()}
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

    def matches(self, survey: Survey) -> tuple[PresetMatch, ...]:
        """Return how every preset did on the bus that suits it best."""
        found: dict[str, PresetMatch] = {}
        for name in PRESETS:
            tries = [attempts[name] for attempts in self._buses.values()]
            best = max(tries, key=lambda attempt: attempt.samples, default=None)
            found[name] = self._match(name, best, survey)
        # A relative that also finds its temperature explains more of the capture.
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

    def _match(self, name: str, attempt: _Attempt | None, survey: Survey) -> PresetMatch:
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


def _problem(name: str, attempt: _Attempt, vehicle: Vehicle, survey: Survey) -> str:
    """Return why a preset does not match, or ""."""
    counters = attempt.assembler.counters
    if not attempt.samples:
        return "no current in its frames" if counters.wanted else "none of its frames"
    if counters.crc_errors > 0.1 * counters.wanted:
        return f"{counters.crc_errors} of {counters.wanted} CRCs are wrong"
    if attempt.voltage.ends is None:
        return "no voltage"
    long_enough = survey.last_s - survey.first_s >= LONG_ENOUGH_S
    if long_enough and vehicle.temperature is not None and attempt.temperature.ends is None:
        return "no temperature"
    return _period_problem(name, survey, long_enough=long_enough)


def _period_problem(name: str, survey: Survey, *, long_enough: bool) -> str:
    for number, expected_s in PRESETS[name].periods_s.items():
        period_s = survey.period_s(number)
        if period_s is None:
            if long_enough:
                return f"no frames of 0x{number:X}"
        elif abs(period_s - expected_s) > PERIOD_TOLERANCE * expected_s:
            return f"0x{number:X} comes every {period_s:.3g} s, not {expected_s:g} s"
    return ""
