"""Estimates of a recorded capture, by the very path that the live service takes."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from os import PathLike
from typing import Final, Literal

import can
import numpy as np
from can.typechecking import Channel

from cangauge._typing import FloatArray
from cangauge.bus.recording import open_vehicle_capture
from cangauge.bus.time_source import REPLAY_CLOCK_ID, TimeSourceName, is_clock
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimate.offline import EstimateTable
from cangauge.estimate.settings import EstimatorSettings
from cangauge.estimate.validity import Estimate
from cangauge.model.model_file import Model
from cangauge.service.pipeline import EstimateStream, FrameCounts

PROGRESS_EVERY: Final = 50_000
"""Frames between two calls of the progress callback."""


@dataclass(frozen=True, eq=False)
class CaptureEstimate:
    """Estimates of all samples of a capture, shape (n,) each.

    Parameters
    ----------
    table : EstimateTable
    time_s, current_a : array of shape (n,)
        Bus time [s] and current [A], positive = discharge, of the samples.
    voltage_v, temperature_c : array of shape (n,)
        Measured voltage [V] and temperature [°C]; NaN where the sample has none.
    soc_reference_pct : array of shape (n,)
        The car's own state of charge [%]; NaN where there is none.
    counts : FrameCounts
        What happened to the frames.
    time_source : {"receive", "replay-clock"}
        What bus time was taken from.
    seconds : float
        How long it took [s].
    remarks : tuple of str
        What a user should know, in words.
    """

    table: EstimateTable
    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    soc_reference_pct: FloatArray
    counts: FrameCounts
    time_source: TimeSourceName
    seconds: float
    remarks: tuple[str, ...]


@dataclass
class _Lane:
    """One of the buses in a capture."""

    stream: EstimateStream
    estimates: list[Estimate] = field(default_factory=list)
    # Of each sample in turn: time, current, voltage, temperature, the car's own SoC.
    values: array[float] = field(default_factory=lambda: array("d"))

    def take(self, estimate: Estimate | None) -> None:
        sample = self.stream.latest_sample
        if estimate is None or sample is None:
            return
        self.estimates.append(estimate)
        self.values.extend(sample)
        self.values.append(self.stream.reference_soc_pct)


def estimate_capture(
    path: str | PathLike[str],
    vehicle: Vehicle,
    model: Model,
    settings: EstimatorSettings | None = None,
    *,
    time_source: TimeSourceName | Literal["auto"] = "auto",
    clock_id: int = REPLAY_CLOCK_ID,
    progress: Callable[[int], None] | None = None,
) -> CaptureEstimate:
    """Estimate a capture: bit for bit what the service makes of the same frames.

    Parameters
    ----------
    path : path-like
    vehicle : Vehicle
    model : Model
    settings : EstimatorSettings, optional
    time_source : {"auto", "receive", "replay-clock"}
        "auto": the replay clock if the capture holds one, else the receive stamps.
    clock_id : int
        REPLAY_CLOCK's id.
    progress : callable, optional
        Called with the number of frames read, every `PROGRESS_EVERY`.

    Returns
    -------
    CaptureEstimate

    Raises
    ------
    InputError
        If the capture cannot be read, or gives no sample.
    """
    began = time.perf_counter()
    reader = _Reader(vehicle, model, settings, time_source, clock_id)
    capture = open_vehicle_capture(path, vehicle)
    for number, message in enumerate(capture, start=1):
        reader.take(message)
        if progress is not None and number % PROGRESS_EVERY == 0:
            progress(number)
    lane = reader.finish()
    if lane is None:
        raise InputError(
            "the capture gives no sample of current",
            source=path,
            field=vehicle.current.message,
            cure=f"check that this is the bus of {vehicle.name} (`cangauge inspect` tells)",
        )
    remarks = [*capture.info.remarks, *reader.remarks(lane)]
    time_s, current_a, voltage_v, temperature_c, soc_pct = np.array(lane.values).reshape(-1, 5).T
    return CaptureEstimate(
        table=EstimateTable.of(lane.estimates),
        time_s=time_s,
        current_a=current_a,
        voltage_v=voltage_v,
        temperature_c=temperature_c,
        soc_reference_pct=soc_pct,
        counts=lane.stream.counts,
        time_source=reader.time_source,
        seconds=time.perf_counter() - began,
        remarks=tuple(remarks),
    )


class _Reader:
    """Sorts frames by the bus that they were recorded on; each has its own estimator."""

    def __init__(
        self,
        vehicle: Vehicle,
        model: Model,
        settings: EstimatorSettings | None,
        time_source: TimeSourceName | Literal["auto"],
        clock_id: int,
    ) -> None:
        self._vehicle = vehicle
        self._model = model
        self._settings = settings
        self._clock_id = clock_id
        self._is_open = time_source == "auto"
        self.time_source: TimeSourceName = "receive" if time_source == "auto" else time_source
        self._lanes: dict[Channel | None, _Lane] = {}

    def take(self, message: can.Message) -> None:
        if self._is_open and is_clock(message, self._clock_id):
            # What came before the clock has no time in it: a live run starts here, too.
            self._is_open = False
            self.time_source = "replay-clock"
            self._lanes.clear()
        lane = self._lanes.get(message.channel)
        if lane is None:
            stream = EstimateStream(
                self._vehicle, self._model, self._settings, self.time_source, self._clock_id
            )
            lane = self._lanes[message.channel] = _Lane(stream)
        lane.take(lane.stream.handle(message))

    def finish(self) -> _Lane | None:
        """Return the bus with most samples, if there is any sample."""
        for lane in self._lanes.values():
            lane.take(lane.stream.finish())
        best = max(self._lanes.values(), key=lambda lane: len(lane.estimates), default=None)
        return best if best is not None and best.estimates else None

    def remarks(self, lane: _Lane) -> list[str]:
        counts = lane.stream.counts
        told = []
        if self.time_source == "replay-clock":
            told.append("a recorded replay: time is that of its log (REPLAY_CLOCK)")
        if counts.beginnings:
            told.append(f"{counts.beginnings + 1} logs were replayed: each estimated for itself")
        if counts.crc_errors:
            told.append(f"{counts.crc_errors} frames refused: CRC wrong")
        if counts.lost:
            told.append(f"{counts.lost} frames lost, by their counters")
        if sum(bool(other.estimates) for other in self._lanes.values()) > 1:
            told.append("several buses carry the frames: the one with most samples is used")
        return told
