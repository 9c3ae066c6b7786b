"""Capture + vehicle → samples as the live service sees them, and → canonical log."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np
from can.typechecking import Channel
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.bus.captures.capture import CLOCK_ID, CLOCK_PERIOD_S, Capture, open_capture
from cangauge.bus.captures.files import CaptureInfo
from cangauge.bus.decoder import FrameStatistics, SampleDecoder
from cangauge.bus.time_source import TimeSource, TimeSourceName, time_source
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimate.validity import Sample
from cangauge.logs.log import Log
from cangauge.logs.sign import resolve_sign
from cangauge.logs.units import refuse_wrong_units

VOLTAGE_FILL_S: Final = 1.0
"""Where voltage is slower than current, or misses, a log has it by linear interpolation between
values at most this far apart [s]; rows further from a voltage are left out."""


@dataclass(frozen=True, slots=True, eq=False)
class CaptureSamples:
    """All samples of a capture, as the live service makes them before it knows a pack's model.

    With one the service also leaves out what no such pack can be; see `input_health`.

    Parameters
    ----------
    time_s, current_a : array of shape (n,)
        Bus time [s], current [A], positive = discharge.
    voltage_v, temperature_c : array of shape (n,)
        [V], [°C]; NaN where the sample has none.
    soc_pct : array of shape (n,)
        The car's own SoC when the sample was made [%]; NaN where there is none.
    counters : FrameStatistics
        Fate of the frames of that bus.
    info : CaptureInfo
        What reading the file showed.
    remarks : tuple of str
        What a user should know, in words.
    """

    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    soc_pct: FloatArray
    counters: FrameStatistics
    info: CaptureInfo
    remarks: tuple[str, ...]

    def __len__(self) -> int:
        """Return the number of samples."""
        return int(self.time_s.size)

    def __iter__(self) -> Iterator[Sample]:
        """Yield the samples."""
        columns = (self.time_s, self.current_a, self.voltage_v, self.temperature_c)
        yield from map(Sample._make, zip(*(column.tolist() for column in columns), strict=True))


class _Bus:
    """One of the buses in a capture: its own assembler, and what came out of it."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.assembler = SampleDecoder(vehicle)
        self._values = array("d")

    def __len__(self) -> int:
        return len(self._values) // 5

    def add(self, sample: Sample) -> None:
        self._values.extend(sample)
        self._values.append(self.assembler.reference_soc_pct)

    def columns(self) -> NDArray[np.float64]:
        return np.array(self._values, dtype=np.float64).reshape(-1, 5).T


def open_vehicle_capture(path: str | PathLike[str], vehicle: Vehicle) -> Capture:
    """Open a capture; without stamps, the vehicle's current message counts time.

    Raises
    ------
    InputError
        As `open_capture`.
    """
    period_s = vehicle.messages[vehicle.current.key].period_s
    if period_s is None:
        return open_capture(path, clock=(CLOCK_ID, CLOCK_PERIOD_S))
    return open_capture(path, clock=(vehicle.current.arbitration_id, period_s))


def capture_samples(
    path: str | PathLike[str], vehicle: Vehicle, *, source: TimeSourceName = "receive"
) -> CaptureSamples:
    """Return the samples of a capture, bit for bit as the live service makes them of the frames.

    What a pack's model would have it leave out is in them; see `CaptureSamples`.

    Where the capture holds several buses, each is decoded for itself and the one with most
    samples is taken.

    Parameters
    ----------
    path : path-like
    vehicle : Vehicle
    source : {"receive", "replay-clock"}
        What bus time is: the recorded stamps, or the log time in REPLAY_CLOCK frames.

    Raises
    ------
    InputError
        If the capture cannot be read, or gives no sample.
    """
    capture = open_vehicle_capture(path, vehicle)
    clock = time_source(source)
    buses = _decode(capture, vehicle, clock)
    channel, bus = max(buses.items(), key=lambda item: len(item[1]), default=(None, None))
    if bus is None or not len(bus):
        raise _no_samples(Path(path), vehicle, bus)
    time_s, current_a, voltage_v, temperature_c, soc_pct = bus.columns()
    info, counters = capture.info, bus.assembler.statistics
    remarks = [*info.remarks, *_fate(counters)]
    if sum(len(other) > 0 for other in buses.values()) > 1:
        remarks.append(f"several buses carry the frames: bus {channel} is used, which has most")
    if clock.beginnings:
        remarks.append(f"the replay clock starts again {clock.beginnings} times")
    return CaptureSamples(
        time_s=time_s,
        current_a=current_a,
        voltage_v=voltage_v,
        temperature_c=temperature_c,
        soc_pct=soc_pct,
        counters=counters,
        info=info,
        remarks=tuple(remarks),
    )


def capture_to_log(
    path: str | PathLike[str], vehicle: Vehicle, *, source: TimeSourceName = "receive"
) -> Log:
    """Return a capture as a log; `soc_pct` is the car's own, where it gives one.

    A log has every value in every row. Time stamps that do not increase are dropped; voltage is
    interpolated as `VOLTAGE_FILL_S` says; temperature is the nearest earlier one, or before the
    first, the first. Remarks tell how often that was done, and what the counters show.

    Parameters
    ----------
    path : path-like
    vehicle : Vehicle
    source : {"receive", "replay-clock"}
        What bus time is: the recorded stamps, or the log time in REPLAY_CLOCK frames.

    Raises
    ------
    InputError
        If the capture cannot be read, gives no sample, no voltage or no temperature, holds
        several replays one after the other, or values that are no battery's.
    """
    samples = capture_samples(path, vehicle, source=source)
    path = Path(path)
    remarks = list(samples.remarks)
    keep = _increasing(samples.time_s)
    if np.count_nonzero(~keep) > 0.5 * keep.size:
        raise InputError(
            "time runs backwards in the capture, or stands still",
            source=path,
            cure="cut it where time starts again; record with absolute stamps (candump -l, not"
            " -td); of a replay at full speed, take the replay clock as time",
        )
    if not keep.all():
        remarks.append(f"{np.count_nonzero(~keep)} samples with time not going on dropped")
    time_s, soc_pct = samples.time_s[keep], samples.soc_pct[keep]
    voltage_v = _filled_voltage(time_s, samples.voltage_v[keep], path, vehicle, remarks)
    temperature_c = _filled_temperature(samples.temperature_c[keep], path, vehicle, remarks)
    near = np.isfinite(voltage_v)
    log = Log(
        time_s=time_s[near],
        current_a=samples.current_a[keep][near],
        voltage_v=voltage_v[near],
        temperature_c=temperature_c[near],
        soc_pct=soc_pct[near] if np.isfinite(soc_pct[near]).any() else None,
        name=path.name.split(".")[0],
        source=str(path),
        temperature_source=vehicle.temperature_source,
        remarks=tuple(remarks),
    )
    _check_values(log, vehicle)
    return resolve_sign(log, stored_sign_unknown=False)


def _decode(capture: Capture, vehicle: Vehicle, clock: TimeSource) -> dict[Channel | None, _Bus]:
    buses: dict[Channel | None, _Bus] = {}
    for message in capture:
        time_s = clock.time_of(message)
        if time_s is None:
            continue
        message.timestamp = time_s
        bus = buses.get(message.channel)
        if bus is None:
            bus = buses[message.channel] = _Bus(vehicle)
        sample = bus.assembler.handle(message)
        if sample is not None:
            bus.add(sample)
    for bus in buses.values():
        last = bus.assembler.flush()
        if last is not None:
            bus.add(last)
    return buses


def _no_samples(path: Path, vehicle: Vehicle, bus: _Bus | None) -> InputError:
    name = f"0x{vehicle.current.arbitration_id:X} ({vehicle.current.message})"
    counters = None if bus is None else bus.assembler.statistics
    if counters is None or not counters.messages[vehicle.current.key].wanted:
        problem = f"the capture holds no frames of {name}, which has the current"
    else:
        problem = f"the frames of {name} give no current ({'; '.join(_fate(counters))})"
    return InputError(
        problem, source=path, cure="see `cangauge inspect` for what it holds; check the vehicle"
    )


def _fate(counters: FrameStatistics) -> list[str]:
    """Return in words what was refused and lost."""
    told = []
    for count, text in (
        (counters.crc_errors, "frames refused: CRC wrong"),
        (counters.counter_repeats, "frames refused: counter stands still"),
        (counters.short, "frames refused: too short"),
        (counters.not_available, "values refused: the code means 'not available'"),
    ):
        if count:
            told.append(f"{count} {text}")
    if counters.counter_jumps:
        told.append(
            f"{counters.counter_jumps} counter jumps: at least {counters.frames_lost} frames lost"
        )
    return told


def _increasing(time_s: FloatArray) -> NDArray[np.bool_]:
    """Return which stamps are larger than all before them."""
    before = np.concatenate([[-np.inf], np.maximum.accumulate(time_s)[:-1]])
    return np.asarray(time_s > before)


def _filled_voltage(
    time_s: FloatArray, voltage_v: FloatArray, path: Path, vehicle: Vehicle, remarks: list[str]
) -> FloatArray:
    known = np.flatnonzero(np.isfinite(voltage_v))
    if not known.size:
        raise InputError(
            "the capture gives no voltage that pairs with a current",
            source=path,
            field=vehicle.voltage.message,
            cure="check the mapping, and pair_within_s",
        )
    gone = np.flatnonzero(~np.isfinite(voltage_v))
    if not gone.size:
        return voltage_v
    filled = voltage_v.copy()
    right = np.searchsorted(known, gone)
    inside = (right > 0) & (right < known.size)
    left_row, right_row = known[right[inside] - 1], known[right[inside]]
    near = time_s[right_row] - time_s[left_row] <= VOLTAGE_FILL_S
    rows = gone[inside][near]
    filled[rows] = np.interp(time_s[rows], time_s[known], voltage_v[known])
    if rows.size:
        remarks.append(f"{rows.size} samples without voltage: interpolated")
    if gone.size > rows.size:
        remarks.append(f"{gone.size - rows.size} samples without voltage left out")
    return filled


def _filled_temperature(
    temperature_c: FloatArray, path: Path, vehicle: Vehicle, remarks: list[str]
) -> FloatArray:
    known = np.isfinite(temperature_c)
    if not known.any():
        raise InputError(
            "the capture gives no temperature",
            source=path,
            field=None if vehicle.temperature is None else vehicle.temperature.message,
            cure="give --temperature °C",
        )
    if known.all():
        return temperature_c
    rows = np.flatnonzero(known)
    latest = np.searchsorted(rows, np.arange(known.size), side="right") - 1
    remarks.append(f"{np.count_nonzero(~known)} samples without temperature: the nearest is used")
    return np.asarray(temperature_c[rows[np.maximum(latest, 0)]])


def _check_values(log: Log, vehicle: Vehicle) -> None:
    values = {
        "time_s": log.time_s,
        "current_a": log.current_a,
        "voltage_v": log.voltage_v,
        "temperature_c": log.temperature_c,
    }
    if log.soc_pct is not None:
        values["soc_pct"] = log.soc_pct
    labels = {
        "current_a": vehicle.current.codec.name,
        "voltage_v": vehicle.voltage.codec.name,
        "time_s": "time stamps",
    }
    if vehicle.temperature is not None:
        labels["temperature_c"] = vehicle.temperature.codec.name
    if vehicle.soc_reference is not None:
        labels["soc_pct"] = vehicle.soc_reference.codec.name
    refuse_wrong_units(values, source=log.source, labels=labels)
