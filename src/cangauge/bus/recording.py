"""Read a recording: a log of any format, or a capture decoded by its vehicle.

A capture is decoded to the samples of the live service; its log fills the values that single
samples lack.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import can
import numpy as np
from can.typechecking import Channel, StringPathLike

from cangauge._files import as_path
from cangauge._typing import BoolArray, FloatArray
from cangauge.bus.captures import (
    CLOCK,
    KNOWN_CAPTURES,
    Capture,
    find_capture,
    open_capture,
    parts_of_run,
)
from cangauge.bus.decoder import FrameStatistics, SampleDecoder, unsigned_reading
from cangauge.bus.readers import PAUSE_S
from cangauge.bus.time_source import ReplayClock, frames_of_buses, time_source
from cangauge.bus.vehicle import LOG_COLUMNS, Vehicle
from cangauge.errors import InputError, require_temperature
from cangauge.logs.agreement import WRAPPED, agreeing
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.log import Log
from cangauge.logs.quantities import known_temperature_source
from cangauge.logs.read import KNOWN_LOGS, LogFile, not_recognised, open_log
from cangauge.logs.sign import Sign
from cangauge.settings import TemperatureSource, TimeSourceName
from cangauge.types import Sample

VOLTAGE_FILL_S: Final = 1.0
"""Longest time between two voltages for interpolation [s], the step of identification; rows further
from one are dropped."""


def read_log(
    path: StringPathLike,
    vehicle: Vehicle | None = None,
    *,
    temperature_c: float | None = None,
    temperature_source: TemperatureSource | None = None,
    columns: Mapping[str, str] | str | None = None,
    sign: Sign | None = None,
) -> Log:
    """Read a log, or a CAN capture by its vehicle; the format is recognised by content.

    Logs: canonical Parquet and CSV, ANL D3 tests, BMW i3 trips, exports of Arbin, Bitrode and
    VisuaLCN cyclers, tables with plain headings or `columns`; plain, gzipped or in a zip.
    Captures: candump, CRTD, ASC, BLF, TRC, MF4, CSV; plain or gzipped. `Log.remarks` lists what
    was dropped, converted or assumed.

    Parameters
    ----------
    path : path-like
    vehicle : Vehicle, optional
        Decodes a capture (`Vehicle.load`). A log does not need it; it is then ignored with a
        remark.
    temperature_c : float, optional
        Constant temperature [°C], in place of the recording's own.
    temperature_source : {"cell", "pack", "coolant", "room", "unknown"}, optional
        Location of the temperature sensor, in place of the recording's own.
    columns : mapping or str, optional
        Columns of a table: {"current": "I_batt[mA]:-1"} or "time=t,current=I_batt[mA]:-1"; heading,
        unit and factor. What it leaves out is found by plain headings.
    sign : {"charge", "discharge"}, optional
        Effect of a positive current in a log; by default as the format defines it, or found from
        the data.

    Returns
    -------
    Log
        Positive current discharges. `soc_pct` of a capture is the car's own, if it sends one.

    Raises
    ------
    InputError
        File absent, empty, damaged or of no known format; a capture without a vehicle; missing
        column or signal; wrong unit; time that runs backwards; missing values.

    See Also
    --------
    cangauge.Log.from_dataframe : A log from a table in memory.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import mkdtemp
    >>> from cangauge.logs.canonical import write_log
    >>> path = Path(mkdtemp()) / "drive.parquet"
    >>> write_log(Log([0, 1], [10, 30], [380, 378], [21, 21]), path)
    >>> log = read_log(path)
    >>> log.name, log.current_a
    ('drive', array([10., 30.]))
    """
    is_table = columns is not None or sign is not None
    recording = open_log(path, columns=columns, sign=sign) if is_table else open_recording(path)
    return log_of(
        recording, vehicle, temperature_c=temperature_c, temperature_source=temperature_source
    )


def log_of(
    recording: LogFile | Capture,
    vehicle: Vehicle | None,
    *,
    temperature_c: float | None = None,
    temperature_source: TemperatureSource | None = None,
) -> Log:
    """Read an opened recording; arguments as in `read_log`."""
    require_temperature(temperature_c)
    if temperature_source is not None:
        known_temperature_source(temperature_source)
    if isinstance(recording, LogFile):
        log = recording.read(temperature_c=temperature_c, temperature_source=temperature_source)
        if vehicle is not None:
            log = replace(log, remarks=(*log.remarks, "a log, not a capture: no vehicle is needed"))
        return log
    if vehicle is None:
        raise capture_without_vehicle(recording.path)
    if temperature_c is not None:
        vehicle = replace(vehicle, temperature=None, fixed_temperature_c=temperature_c)
        vehicle = replace(vehicle, temperature_source="unknown")
    log = capture_to_log(recording.path, vehicle)
    return replace(log, temperature_source=temperature_source or log.temperature_source)


def open_recording(
    path: StringPathLike,
    *,
    columns: ColumnMap | None = None,
    mapped: ColumnMap | None = None,
    sign: Sign | None = None,
) -> LogFile | Capture:
    """Open a file as a log or a capture, recognised by its beginning; InputError if neither.

    `columns` are the user's: the file is then a table. `mapped` are a map file's, for tables of no
    known format. `sign` is the effect of a positive current in a log.
    """
    path = as_path(path)
    capture = open_capture(path) if columns is None and parts_of_run(path) else None
    if capture is None:
        log_file = open_log(path, columns=columns, sign=sign)
        is_mapped = mapped is not None and log_file.is_any_table
        if columns is not None or (log_file.reader is not None and not is_mapped):
            return log_file
        capture = None if is_mapped else find_capture(path)
    if capture is None:
        if mapped is not None:
            return open_log(path, columns=mapped, sign=sign)
        problem = "not a known kind of log, nor of capture"
        cure = f"known logs: {KNOWN_LOGS}; known captures (with --vehicle or --map):"
        raise not_recognised(log_file, problem, f"{cure} {KNOWN_CAPTURES}")
    if sign is not None:
        problem = "this is a capture, whose map states the sign"
        cure = "set sign = -1 under [current] of the map file"
        raise InputError(problem, source=path, field="--sign", value=sign, cure=cure)
    return capture


def refuse_single_row(recorded: Log | CaptureSamples) -> None:
    """Raise InputError for a log of one row: no charge can be counted."""
    if len(recorded) < 2:
        why = f" ({'; '.join(recorded.remarks)})" if recorded.remarks else ""
        problem = f"a single row: charge is counted from one row to the next{why}"
        raise InputError(problem, source=recorded.source, cure="give a log of minutes or hours")


def capture_without_vehicle(path: StringPathLike) -> InputError:
    """Return the error for a capture whose vehicle is not given."""
    cure = "give --vehicle or --map"
    return InputError("this is a CAN capture, not a log", source=path, cure=cure)


# --- Captures by a vehicle


@dataclass(frozen=True, eq=False)
class CaptureSamples:
    """All samples of a capture; shape (n,). Unlike a log's rows they may lack values (NaN).

    Times are bus times, `soc_pct` is the car's own SoC when the sample was made. Without a model no
    value is refused as impossible for the pack, but a SoC outside 0–100 % is. `statistics` are
    those of the chosen bus, `remarks` losses and refusals, for the user; `sessions` are the samples
    at which the stamps start again.
    """

    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    soc_pct: FloatArray
    source: str
    temperature_source: TemperatureSource
    statistics: FrameStatistics
    remarks: tuple[str, ...]
    sessions: tuple[int, ...] = ()

    def __len__(self) -> int:
        """Return the number of samples."""
        return int(self.time_s.size)

    @property
    def name(self) -> str:
        """Name of the file, without suffixes."""
        return Path(self.source).name.split(".")[0]

    @property
    def duration_s(self) -> float:
        """Time from the first sample to the last [s]."""
        return float(self.time_s[-1] - self.time_s[0])

    def as_log(self) -> Log | None:
        """Return the samples with a voltage and a new time, at 0 °C; None if fewer than 2.

        Enough to check the sign of the current.
        """
        rows = np.isfinite(self.voltage_v) & (np.diff(self.time_s, prepend=-np.inf) > 0.0)
        if rows.sum() < 2:
            return None
        return Log(
            self.time_s[rows],
            self.current_a[rows],
            self.voltage_v[rows],
            np.zeros(rows.sum()),
            self.soc_pct[rows],
            name=self.name,
            source=self.source,
        )


def open_vehicle_capture(path: StringPathLike, vehicle: Vehicle | None) -> Capture:
    """Open a capture; without stamps, the current message of a vehicle counts time."""
    clock = CLOCK
    if vehicle is not None and (period_s := vehicle.messages[vehicle.current.key].period_s):
        clock = vehicle.current.arbitration_id, period_s
    return open_capture(path, clock=clock)


def capture_samples(path: StringPathLike, vehicle: Vehicle) -> CaptureSamples:
    """Return the samples of a capture, bit for bit those of the live service.

    Each bus in the capture has its own decoder; the bus with most samples is returned. Bus time is
    that of REPLAY_CLOCK if the capture holds one, else the recorded stamps. Raises InputError if
    the capture cannot be read, or gives no sample.
    """
    capture = open_vehicle_capture(path, vehicle)
    buses: dict[Channel | None, _RecordedBus] = {}
    for bus, message in frames_of_buses(capture, buses, partial(_RecordedBus, vehicle)):
        bus.add(message)
    for bus in buses.values():
        bus.keep(bus.decoder.flush())
    channel = max(buses, key=lambda each: len(buses[each].values))
    bus, decoder = buses[channel], buses[channel].decoder
    if not bus.values:
        raise _without_current(path, decoder)
    time_s, current_a, voltage_v, temperature_c, soc_pct = np.array(bus.values).reshape(-1, 5).T
    if (wrapped := unsigned_reading(vehicle.current.codec, current_a)) is not None:
        problem, cure = wrapped
        raise InputError(problem, source=path, field=vehicle.current.codec.name, cure=cure)
    remarks = [*vehicle.remarks, *capture.info["remarks"], *_losses(decoder.statistics)]
    remarks += [*decoder.wrong_periods.values(), *decoder.never_decoded.values()]
    if sum(bool(each.values) for each in buses.values()) > 1:
        remarks.append(f"several buses carry the frames; bus {channel} is used: most samples")
    if isinstance(bus.time, ReplayClock):
        remarks.append("a recorded replay: time is its log's (REPLAY_CLOCK)")
    if bus.time.beginnings:
        remarks.append(f"{bus.time.beginnings + 1} logs were replayed: cut it into one each")
    if bus.sessions:
        remarks.append(f"the stamps start again: {len(bus.sessions) + 1} sessions in one file")
    return CaptureSamples(
        time_s,
        current_a,
        voltage_v,
        temperature_c,
        soc_pct,
        str(path),
        vehicle.temperature_source,
        decoder.statistics,
        tuple(remarks),
        tuple(bus.sessions),
    )


class _RecordedBus:
    """One bus of a capture: its time, its decoder, and its samples with the car's own SoC.

    `sessions` are the samples at which the stamps start again.
    """

    def __init__(self, vehicle: Vehicle, source: TimeSourceName) -> None:
        self.time, self.decoder = time_source(source), SampleDecoder(vehicle)
        self.values, self.sessions = array("d"), list[int]()

    def add(self, message: can.Message) -> None:
        """Decode a frame at its bus time."""
        if (now_s := self.time.time_of(message)) is not None:
            message.timestamp = now_s
            if self.time.steps_back > len(self.sessions):
                self.sessions.append(len(self.values) // 5)
            self.keep(self.decoder.handle(message))

    def keep(self, sample: Sample | None) -> None:
        """Add a sample, if any."""
        if sample is not None:
            self.values.extend((*sample, self.decoder.reference_soc_pct))


def _without_current(path: StringPathLike, decoder: SampleDecoder) -> InputError:
    current, statistics = decoder.vehicle.current, decoder.statistics
    name = f"0x{current.arbitration_id:X} ({current.message})"
    problem = f"the frames of {name} give no current ({'; '.join(_losses(statistics))})"
    if not statistics.messages[current.key]["wanted"]:
        problem = f"the capture holds no frames of {name}, which carries the current"
    cure = "check the vehicle; `cangauge inspect` lists the frames of a capture"
    if statistics.two_senders and decoder.vehicle.messages[current.key].by_pgn:
        cure = "two source addresses send it: number it in the DBC with the pack's own, and remove"
        cure += " j1939 = true"
    return InputError(problem, source=path, cure=cure)


def _losses(statistics: FrameStatistics) -> list[str]:
    jumps = f"counter jumps: at least {statistics.frames_lost} frames lost"
    texts = {
        "crc_errors": "frames refused: wrong CRC",
        "counter_repeats": "frames refused: repeated counter",
        "short": "frames refused: too short",
        "two_senders": "frames refused: two senders use their id or PGN",
        "not_available": "values refused: code for 'not available'",
        "implausible": "values refused: outside their limits (of a SoC: 0–100 %)",
        "counter_jumps": jumps,
    }
    counts = {text: getattr(statistics, name) for name, text in texts.items()}
    return [f"{count} {text}" for text, count in counts.items() if count]


def capture_to_log(path: StringPathLike, vehicle: Vehicle) -> Log:
    """Return a capture as a log; `soc_pct` is the car's own, if it sends one.

    A log has every value in every row. Time stamps that do not increase are dropped; voltage is
    interpolated over at most `VOLTAGE_FILL_S`; temperature is the latest one, before the first
    the first. Remarks count these rows and the lost frames. Raises InputError as `capture_samples`,
    and without voltage or temperature, or for values that are not a battery's.
    """
    samples = capture_samples(path, vehicle)
    remarks = list(samples.remarks)
    begun = np.searchsorted(samples.sessions, np.arange(len(samples)), side="right")
    time_s = samples.time_s + PAUSE_S * begun  # no charge is counted over it
    advances = time_s > np.concatenate([[-np.inf], np.maximum.accumulate(time_s)[:-1]])
    if 2 * advances.sum() < advances.size:
        problem = "time runs backwards or does not advance in the capture"
        cure = "split it where time starts again; record with stamps that increase (candump -l)"
        raise InputError(problem, source=path, cure=cure)
    rows = {name: getattr(samples, name)[advances] for name in LOG_COLUMNS.values()}
    rows["time_s"] = time_s[advances]
    filled, is_complete = _filled(rows["time_s"], rows["voltage_v"])
    if not is_complete.any():
        problem = "the capture gives no voltage that pairs with a current"
        where, cure = vehicle.voltage.message, "check the mapping, and pair_within_s"
        raise InputError(problem, source=path, field=where, cure=cure)
    warm = np.flatnonzero(np.isfinite(rows["temperature_c"]))
    if not warm.size:
        where = "" if vehicle.temperature is None else vehicle.temperature.message
        problem, cure = "the capture gives no temperature", "give --temperature °C"
        raise InputError(problem, source=path, field=where or None, cure=cure)
    latest = np.searchsorted(warm, np.arange(filled.size), side="right") - 1
    interpolated = is_complete & np.isnan(rows["voltage_v"])
    counts = {
        "dropped whose time does not advance": ~advances,
        "without voltage: interpolated": interpolated,
        "without voltage dropped": ~is_complete,
        "without temperature: the nearest is used": np.isnan(rows["temperature_c"]),
    }
    remarks += [f"{n} samples {text}" for text, of in counts.items() if (n := of.sum())]
    rows["voltage_v"] = filled
    rows["temperature_c"] = rows["temperature_c"][warm[np.maximum(latest, 0)]]
    rows = {name: column[is_complete] for name, column in rows.items()}
    if not np.isfinite(rows["soc_pct"]).any():
        del rows["soc_pct"]
    log = Log(
        **rows,
        name=samples.name,
        source=str(path),
        temperature_source=vehicle.temperature_source,
        remarks=tuple(remarks),
    )
    names = {LOG_COLUMNS[each.role]: each.codec.name for each in vehicle.signals}
    labels = {"time_s": "time stamps", **names}
    try:
        return agreeing(log, labels=labels, in_seconds=True)
    except InputError as error:
        raise _of_capture(error, vehicle) from error


def _filled(time_s: FloatArray, values: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return values interpolated between known ones, and which have a value now.

    None has between known ones more than `VOLTAGE_FILL_S` apart, nor outside them.
    """
    known_s = time_s[np.isfinite(values)]
    ends_s = np.concatenate([[-np.inf], known_s, [np.inf]])
    before = np.searchsorted(known_s, time_s, side="right")
    is_near = ends_s[before + 1] - ends_s[before] <= VOLTAGE_FILL_S
    filled = np.interp(time_s, known_s, values[np.isfinite(values)]) if known_s.size else values
    return filled, is_near | np.isfinite(values)


def _of_capture(error: InputError, vehicle: Vehicle) -> InputError:
    """Return an error about values with a cure in the map file, as a capture has no columns."""
    named = {each.codec.name: each for each in vehicle.signals}
    signal, value = named.get(error.field or ""), error.value
    if signal is None or not isinstance(value, float):
        return error
    table = f"under [{signal.role}] of the map file"
    cure = f"state scale and offset {table}: they replace the DBC's unit"
    if "swapped" in (error.cure or ""):
        cure = "exchange the two signals in the map file"
    elif error.problem.endswith(WRAPPED):
        cure = f"state signed = true {table}"
    elif error.problem.startswith("row "):
        raw = signal.codec.raw_numbers(np.array(value))
        cure = f"if it is a code without a value, state not_available = [{raw:.0f}] {table}"
        if signal.codec.float_format:
            cure = f"state lowest and highest {table}"
    return InputError(error.problem, source=error.source, field=error.field, value=value, cure=cure)
