"""Estimates of a recorded capture, by the same pipeline as the live service."""

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
from cangauge.bus.publish import FrameIds
from cangauge.bus.recording import open_vehicle_capture
from cangauge.bus.time_source import REPLAY_CLOCK_ID, TimeSourceName, is_clock
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimate.offline import EstimateTable
from cangauge.estimate.settings import EstimatorSettings
from cangauge.estimate.validity import Estimate
from cangauge.model.model_file import Model
from cangauge.service.pipeline import FrameCounts, Pipeline, PipelineSettings

PROGRESS_EVERY: Final = 50_000
"""Frames between two calls of the progress callback."""


@dataclass(frozen=True, eq=False)
class CaptureEstimate:
    """Estimates of all n samples of a capture.

    Parameters
    ----------
    table : EstimateTable
    time_s, current_a : array of shape (n,)
        Bus time [s] and current [A], positive = discharge, of the samples.
    voltage_v, temperature_c : array of shape (n,)
        Measured voltage [V] and temperature [°C]; NaN where the sample has none.
    soc_reference_pct : array of shape (n,)
        The vehicle's own state of charge [%]; NaN where there is none.
    counts : FrameCounts
        What became of the frames.
    time_source : {"receive", "replay-clock"}
        Source of bus time.
    seconds : float
        Computing time [s].
    remarks : tuple of str
        Notes for the user.
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
    """Estimate a capture, bit for bit as the service does with the same frames.

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
    is_undecided = time_source == "auto"
    source: TimeSourceName = "receive" if time_source == "auto" else time_source
    ids = FrameIds(replay_clock=clock_id)
    buses: dict[Channel | None, _Bus] = {}
    capture = open_vehicle_capture(path, vehicle)
    for number, message in enumerate(capture, start=1):
        if is_undecided and is_clock(message, clock_id):
            # Earlier frames have no log time; a live run starts here as well.
            is_undecided, source = False, "replay-clock"
            buses.clear()
        bus = buses.get(message.channel)
        if bus is None:
            chosen = PipelineSettings(settings or EstimatorSettings(), source, ids)
            bus = buses[message.channel] = _Bus(Pipeline(vehicle, model, chosen, publishes=False))
        bus.handle(message)
        if progress is not None and number % PROGRESS_EVERY == 0:
            progress(number)
    for each in buses.values():
        each.finish()
    found = [bus for bus in buses.values() if bus.estimates]
    if not found:
        raise InputError(
            "the capture gives no sample of current",
            source=path,
            field=vehicle.current.message,
            cure=f"check that this is the bus of {vehicle.name} (see `cangauge inspect`)",
        )
    best = max(found, key=lambda bus: len(bus.estimates))
    counts = best.pipeline.counts
    time_s, current_a, voltage_v, temperature_c, soc_pct = np.array(best.values).reshape(-1, 5).T
    return CaptureEstimate(
        table=EstimateTable.of(best.estimates),
        time_s=time_s,
        current_a=current_a,
        voltage_v=voltage_v,
        temperature_c=temperature_c,
        soc_reference_pct=soc_pct,
        counts=counts,
        time_source=source,
        seconds=time.perf_counter() - began,
        remarks=(*capture.info.remarks, *_remarks(source, counts, len(found))),
    )


@dataclass
class _Bus:
    """One of the buses in a capture; each has its own pipeline."""

    pipeline: Pipeline
    estimates: list[Estimate] = field(default_factory=list)
    # Time, current, voltage, temperature and the vehicle's own SoC of every sample.
    values: array[float] = field(default_factory=lambda: array("d"))

    def handle(self, message: can.Message) -> None:
        if self.pipeline.handle(message):
            self._collect()

    def finish(self) -> None:
        before = self.pipeline.samples
        self.pipeline.finish()
        if self.pipeline.samples != before:
            self._collect()

    def _collect(self) -> None:
        if self.pipeline.latest_sample is not None:
            self.estimates.append(self.pipeline.latest)
            self.values.extend(self.pipeline.latest_sample)
            self.values.append(self.pipeline.decoder.reference_soc_pct)


def _remarks(time_source: TimeSourceName, counts: FrameCounts, buses: int) -> list[str]:
    remarks = []
    if time_source == "replay-clock":
        remarks.append("a recorded replay: time is its log's (REPLAY_CLOCK)")
    if counts.beginnings:
        remarks.append(f"{counts.beginnings + 1} logs were replayed; each is estimated separately")
    if counts.crc_errors:
        remarks.append(f"{counts.crc_errors} frames refused: wrong CRC")
    if counts.lost:
        remarks.append(f"{counts.lost} frames lost, by their alive counters")
    if buses > 1:
        remarks.append("several buses carry the frames; the one with most samples is used")
    return remarks
