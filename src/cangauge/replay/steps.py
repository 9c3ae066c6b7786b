"""How far the SoC of a replayed log can be from that of the log itself: frames are rounded.

The numbers that a frame holds differ from the log's by half a step at most (δI, δU, δT; and half
a microsecond in time). Through the model:

    counting   ≤ 100/(3600·C) · (δI·t + δt·Σ|ΔI|)
    Newton     ≤ (δU + |kt|·δT + Σ|Rj|·(δI + δt·max|dI/dt|)) / min dU/dS
    fusion     ≤ counting + Newton

The last because a filter moves the counted SoC towards that of the voltage by less than the whole
difference: the error stays below the larger of the two, plus what is counted in between. It holds
as long as no threshold (outlier, lasting contradiction) falls the other way.

What to send and when: logs and captures as steps of log time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import can
import numpy as np

from cangauge.bus.capture_log import open_vehicle_capture
from cangauge.bus.captures.capture import open_capture
from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.publish import FrameIds
from cangauge.bus.time_source import ReceiveTime, ReplayClock, is_clock, whole_us
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimate.validity import Sample
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

# --- How far the SoC of a replayed log can be from that of the log itself: frames are rounded


@dataclass(frozen=True)
class QuantisationBound:
    """Largest difference that rounding can make in SoC [%], by method."""

    coulomb_pct: float
    newton_pct: float

    @property
    def ekf_pct(self) -> float:
        """For fusion."""
        return self.coulomb_pct + self.newton_pct


def quantisation_bound(
    vehicle: Vehicle, model: Model, log: Log, capacity_ah: float | None = None
) -> QuantisationBound:
    """Return the bound for a log that is replayed as a vehicle's frames with REPLAY_CLOCK.

    Parameters
    ----------
    vehicle : Vehicle
    model : Model
    log : Log
    capacity_ah : float, optional
        Instead of the model's [Ah].
    """
    step = FrameEncoder(vehicle).quantisation()
    voltage_model = model.voltage_model()
    current_a = step["current_a"]
    time_s = float(np.max(np.abs(np.rint(log.time_s * 1e6) / 1e6 - log.time_s)))
    steps_a = np.abs(np.diff(log.current_a))
    slew = float(np.max(steps_a / np.diff(log.time_s))) if len(log) > 1 else 0.0
    pct_per_as = 100.0 / (3600.0 * (capacity_ah or model.capacity_ah))
    coulomb = pct_per_as * (current_a * log.duration_s + time_s * float(steps_a.sum()))
    # A vehicle without a temperature signal is not bounded here: its temperature is another one.
    temperature_k = step.get("temperature_c", 0.0)
    resistance = sum(abs(each) for each in voltage_model.resistance_ohm)
    volts = step["voltage_v"] + abs(voltage_model.kt_v_per_k) * temperature_k
    volts += resistance * (current_a + time_s * slew)
    slope = min(voltage_model.pseudo_ocv_at(soc)[1] for soc in np.linspace(0.0, 100.0, 1001))
    return QuantisationBound(coulomb, volts / slope)


# --- What to send and when: logs and captures as steps of log time


class Step(NamedTuple):
    """Frames that belong to one moment."""

    time_us: int
    """Log time [µs]; goes on increasing when the log is played again."""
    frames: list[can.Message]
    samples: int
    """Samples that a receiver has made when it has these frames, since the first step."""
    is_wanted: bool
    """Whether a receiver looks at them, so that they need the clock."""


class Source(Protocol):
    """Something to replay."""

    name: str

    @property
    def duration_s(self) -> float | None:
        """Length [s]; None if it is known only at the end."""

    @property
    def counts_samples(self) -> bool:
        """Whether `Step.samples` is known."""

    def steps(self, *, loop: bool) -> Iterator[Step]:
        """Yield the steps, again and again if `loop`."""


class LogSource:
    """A log as the frames of a vehicle.

    Parameters
    ----------
    log : Log
    vehicle : Vehicle

    Raises
    ------
    InputError
        If a value does not fit into its signal.
    """

    def __init__(self, log: Log, vehicle: Vehicle) -> None:
        self.name = log.name
        self._log = log
        self.vehicle = vehicle
        FrameEncoder(vehicle).check_range(log)

    @property
    def duration_s(self) -> float:
        """Length [s]."""
        return self._log.duration_s

    @property
    def counts_samples(self) -> bool:
        """Whether `Step.samples` is known: always."""
        return True

    def steps(self, *, loop: bool) -> Iterator[Step]:
        """Yield a step per row; played again, the rows follow one typical step later."""
        log = self._log
        times = log.time_s.tolist()
        soc = [math.nan] * len(log) if log.soc_pct is None else log.soc_pct.tolist()
        rows = list(
            zip(
                times,
                log.current_a.tolist(),
                log.voltage_v.tolist(),
                log.temperature_c.tolist(),
                soc,
                strict=True,
            )
        )
        again_s = log.duration_s + (float(np.median(np.diff(log.time_s))) if len(log) > 1 else 1.0)
        encoder = FrameEncoder(self.vehicle)
        counter = _SampleCounter(self.vehicle)
        shift_us = 0
        while True:
            for time_s, current_a, voltage_v, temperature_c, soc_pct in rows:
                time_us = whole_us(time_s) + shift_us
                sample = Sample(time_us / 1e6, current_a, voltage_v, temperature_c)
                frames = encoder.encode(sample, soc_pct)
                yield Step(time_us, frames, counter.after(frames), is_wanted=True)
            if not loop:
                return
            shift_us += whole_us(again_s)


class CaptureSource:
    """A capture's own frames, as recorded.

    What cangauge itself had put on the bus is left out. Where that holds REPLAY_CLOCK, the time
    is the log's that was replayed, else the recorded stamps'.

    Parameters
    ----------
    path : path-like
    vehicle : Vehicle, optional
        Whose frames a receiver looks at; without it all frames count as wanted, and samples
        cannot be counted.
    ids : FrameIds, optional
    """

    def __init__(
        self, path: str | Path, vehicle: Vehicle | None = None, ids: FrameIds | None = None
    ) -> None:
        self._path = Path(path)
        self._vehicle = vehicle
        self._ids = ids or FrameIds()
        self.name = self._path.name
        self.dropped = 0
        """Frames left out in the latest pass: those of cangauge itself, and error frames."""

    @property
    def duration_s(self) -> float | None:
        """Length [s]: known only at the end."""
        return None

    @property
    def counts_samples(self) -> bool:
        """Whether `Step.samples` is known: with a vehicle."""
        return self._vehicle is not None

    def steps(self, *, loop: bool) -> Iterator[Step]:
        """Yield a step per frame; played again, they follow 10 ms later."""
        counter = None if self._vehicle is None else _SampleCounter(self._vehicle)
        wanted = None if self._vehicle is None else set(self._vehicle.messages)
        shift_us = 0
        while True:
            first_us: int | None = None
            last_us = 0
            for message in self._timed():
                time_us = whole_us(message.timestamp)
                first_us = time_us if first_us is None else first_us
                last_us = max(last_us, time_us)
                message.timestamp = (time_us + shift_us) / 1e6
                samples = 0 if counter is None else counter.after([message])
                yield Step(
                    time_us + shift_us,
                    [message],
                    samples,
                    is_wanted=wanted is None or _key(message) in wanted,
                )
            if not loop or first_us is None:
                return
            shift_us += last_us - first_us + 10_000

    def _timed(self) -> Iterator[can.Message]:
        """Yield the frames to send, with log time as stamp."""
        self.dropped = 0
        clock: ReceiveTime | ReplayClock = ReceiveTime()
        if self._has_clock():
            clock = ReplayClock(self._ids.replay_clock)
        own = {self._ids.soc_estimate, self._ids.soc_detail, self._ids.replay_clock}
        for message in self._messages():
            time_s = clock.time_of(message)
            is_own = message.arbitration_id in own and not message.is_extended_id
            if time_s is None or is_own or message.is_error_frame:
                self.dropped += 1
                continue
            if clock.beginnings:
                raise InputError(
                    "holds several replays one after the other",
                    source=self._path,
                    cure="cut it into one capture each",
                )
            message.timestamp = time_s
            message.channel = None  # the recorded one's name means nothing on this bus
            yield message

    def _has_clock(self) -> bool:
        return any(is_clock(message, self._ids.replay_clock) for message in self._messages())

    def _messages(self) -> Iterable[can.Message]:
        if self._vehicle is None:
            return open_capture(self._path)
        return open_vehicle_capture(self._path, self._vehicle)


@dataclass
class _SampleCounter:
    """Counts the samples that a receiver makes of the frames, by making them."""

    vehicle: Vehicle
    samples: int = 0

    def __post_init__(self) -> None:
        self._decoder = SampleDecoder(self.vehicle)

    def after(self, frames: Iterable[can.Message]) -> int:
        """Return how many samples there are after these frames."""
        for frame in frames:
            if self._decoder.handle(frame) is not None:
                self.samples += 1
        return self.samples


def _key(message: can.Message) -> int:
    return message.arbitration_id | (1 << 31 if message.is_extended_id else 0)
