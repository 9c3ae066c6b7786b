"""Steps of a replay: frames of a log or a capture with their log time; quantization error bound."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from itertools import count
from pathlib import Path
from typing import NamedTuple

import can
import numpy as np
from can.typechecking import Channel

from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.recording import open_vehicle_capture
from cangauge.bus.time_source import (
    MICROSECONDS,
    ReceiveTime,
    ReplayClock,
    recorded_time_source,
    whole_us,
)
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.logs.gaps import usual_step_s
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.settings import FrameIds, Method
from cangauge.types import Sample

_CAPTURE_LOOP_GAP_US = 10_000
"""Log time between the last frame of a capture and the first of its repetition [µs]."""


class Step(NamedTuple):
    """Frames of one moment.

    `time_us` is the log time [µs], which keeps increasing when the log is repeated. `samples` are
    those that a receiver has completed after these frames. Frames that it uses need the clock.
    """

    time_us: int
    frames: list[can.Message]
    samples: int
    is_wanted: bool


class LogSource:
    """A log as the frames of a vehicle; raises InputError if a value does not fit its signal."""

    counts_samples = True

    def __init__(self, log: Log, vehicle: Vehicle) -> None:
        self.name, self.log, self.vehicle = log.name, log, vehicle
        encoder = FrameEncoder(vehicle)
        encoder.check_range(log)
        self.quantization = encoder.quantization()
        """Largest errors by rounding into frames, by column."""

    def steps(self, *, loop: bool) -> Iterator[Step]:
        """Yield a step per row, each one sample; repetitions follow one typical step later.

        A row that the checks of the map refuse counts as lost.
        """
        log, encoder = self.log, FrameEncoder(self.vehicle)
        soc_pct = np.full(len(log), math.nan) if log.soc_pct is None else log.soc_pct
        columns = (log.time_s, log.current_a, log.voltage_v, log.temperature_c, soc_pct)
        rows = list(zip(*(column.tolist() for column in columns), strict=True))
        again_us = whole_us(log.duration_s + (usual_step_s(log.time_s) or 1.0))
        samples = count(1)
        for repetition in count() if loop else (0,):
            for time_s, current_a, voltage_v, temperature_c, soc in rows:
                time_us = whole_us(time_s) + repetition * again_us
                sample = Sample(time_us / MICROSECONDS, current_a, voltage_v, temperature_c)
                yield Step(time_us, encoder.encode(sample, soc), next(samples), is_wanted=True)


class CaptureSource:
    """The frames of a capture, as recorded.

    Frames of cangauge itself are dropped. If REPLAY_CLOCK is among them, log time is that of the
    replayed log, else the recorded stamps.

    With a vehicle the frames that pass its filters are wanted, and with them each frame of a reply;
    without one all are, and samples cannot be counted.
    """

    def __init__(
        self, path: str | Path, vehicle: Vehicle | None = None, ids: FrameIds | None = None
    ) -> None:
        self._path, self._vehicle, self._ids = Path(path), vehicle, ids or FrameIds()
        self.name, self.counts_samples = self._path.name, vehicle is not None
        self.dropped = 0
        """Frames dropped in the latest pass: those of cangauge itself, and error frames."""

    def steps(self, *, loop: bool) -> Iterator[Step]:
        """Yield a step per frame; repetitions follow 10 ms later."""
        decoder = None if self._vehicle is None else SampleDecoder(self._vehicle)
        filters = [] if self._vehicle is None else self._vehicle.filters
        samples = shift_us = 0

        @cache
        def is_wanted(number: int, is_extended: bool) -> bool:
            return not filters or any(
                each["extended"] is is_extended and not (number ^ each["can_id"]) & each["can_mask"]
                for each in filters
            )

        while True:
            first_us, last_us = None, 0
            for message in self._timed():
                time_us = whole_us(message.timestamp)
                first_us = time_us if first_us is None else first_us
                last_us = max(last_us, time_us)
                message.timestamp = (time_us + shift_us) / MICROSECONDS
                if decoder is not None:
                    decoder.handle(message)
                    samples = decoder.statistics.samples
                needs_clock = is_wanted(message.arbitration_id, message.is_extended_id)
                yield Step(time_us + shift_us, [message], samples, needs_clock)
            if not loop or first_us is None:
                return
            shift_us += last_us - first_us + _CAPTURE_LOOP_GAP_US

    def _timed(self) -> Iterator[can.Message]:
        """Yield the frames to send, stamped with log time."""
        self.dropped = 0
        clock_id = self._ids.replay_clock
        is_replay = recorded_time_source(self._messages(), clock_id) == "replay-clock"
        clock = ReplayClock(clock_id) if is_replay else None
        # The stamps of two buses can be of two adapters.
        stamps: defaultdict[Channel | None, ReceiveTime] = defaultdict(ReceiveTime)
        own = {*self._ids.published, clock_id}
        for message in self._messages():
            time_s = (clock or stamps[message.channel]).time_of(message)
            is_own = message.arbitration_id in own and not message.is_extended_id
            if time_s is None or is_own or message.is_error_frame:
                self.dropped += 1
                continue
            if clock is not None and clock.beginnings:
                cure = "cut it into one capture each"
                raise InputError("holds several consecutive replays", source=self._path, cure=cure)
            message.timestamp, message.channel = time_s, None  # the channel was another bus's
            yield message

    def _messages(self) -> Iterable[can.Message]:
        return open_vehicle_capture(self._path, self._vehicle)


Source = LogSource | CaptureSource
"""A recording to replay."""


def quantization_bound(
    vehicle: Vehicle, model: Model, log: Log, capacity_ah: float | None = None
) -> dict[Method, float]:
    """Return the largest SoC error due to the quantization of frames [%], by method.

    For a log replayed as a vehicle's frames with REPLAY_CLOCK. Values in frames differ from the
    log's by at most half a step (δI, δU, δT; δt = 0.5 µs). Through the model::

        coulomb  ≤ 100/(3600·C) · (δI·t + δt·Σ|ΔI|)
        newton   ≤ (δU + |kt|·δT + Σ|Rj|·(δI + δt·max|dI/dt|)) / min dU/dS
        ekf      ≤ coulomb + newton

    The last because a filter moves the counted SoC towards that of the voltage by less than their
    difference: the error stays below the larger of the two plus the counting error in between. It
    holds as long as no threshold (outlier, persistent contradiction) is decided differently.
    """
    step = FrameEncoder(vehicle).quantization()
    voltage_model = model.voltage_model()
    current_a = step["current_a"]
    rounded_s = np.rint(log.time_s * MICROSECONDS) / MICROSECONDS
    time_s = float(np.max(np.abs(rounded_s - log.time_s)))
    steps_a = np.abs(np.diff(log.current_a))
    slew = float(np.max(steps_a / np.diff(log.time_s))) if len(log) > 1 else 0.0
    pct_per_as = 100.0 / (3600.0 * (capacity_ah or model.capacity_ah))
    coulomb = pct_per_as * (current_a * log.duration_s + time_s * float(steps_a.sum()))
    # Without a temperature signal the temperature is another one: not bounded here.
    temperature_k = step.get("temperature_c", 0.0)
    resistance = sum(abs(each) for each in voltage_model.loads.resistance_ohm)
    volts = step["voltage_v"] + abs(voltage_model.loads.kt_v_per_k) * temperature_k
    volts += resistance * (current_a + time_s * slew)
    slope = min(voltage_model.pseudo_ocv_at(soc)[1] for soc in np.linspace(0.0, 100.0, 1001))
    newton = volts / slope
    return {"coulomb": coulomb, "newton": newton, "ekf": coulomb + newton}
