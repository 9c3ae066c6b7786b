"""A conformance suite for gauges: drives with faults, played to a program that publishes a SoC.

The gauge under test reads the frames of `generic_pack.dbc` and publishes SOC_ESTIMATE of
`soc_estimate.dbc` (signals soc_pct and soc_std_pct; counter and CRC are not checked). It takes its
time from REPLAY_CLOCK, so that an hour is played in seconds, and publishes after each voltage; once
before the first frame, to say that it is ready. Each run is a process of its own.
"""

from __future__ import annotations

import math
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from cangauge._resources import shared_file
from cangauge._typing import BoolArray, FloatArray, IntArray
from cangauge.bus.connection import BusConnection
from cangauge.bus.database import SignalCodec, find_message, load_dbc, signal_codec
from cangauge.bus.open import BusAddress, bus_address, has_socketcan, open_bus
from cangauge.bus.time_source import MICROSECONDS, ClockFrames
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import CangaugeError, InputError
from cangauge.extras.validation.cases import draw_scenario
from cangauge.extras.validation.twin.recording import record_drive
from cangauge.identify.fit import fit
from cangauge.logs.gaps import discharged_ah
from cangauge.logs.log import Log
from cangauge.logs.read import open_log
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.types import Sample

PACKS: Final = (211, 212, 213, 214)
"""Seeds of the simulated packs; no table of the estimator or the diagnosis has them."""
DRIVES_A_PACK: Final = 3
HOURS: Final = 0.5
ANSWER_EVERY_S: Final = 20.0
"""Log time between two readings of the gauge [s]: as often it is compared with the truth."""
QUIET_S: Final = 0.02
"""Time without a frame after which a gauge that owes no answer has none under way [s]."""
ANSWER_WITHIN_S: Final = 10.0
"""Longest wait for an answer that a gauge owes [s]: a busy machine changes no score."""
READY_WITHIN_S: Final = 30.0
SILENT_AT_MOST: Final = 30
"""Readings without an answer after which a gauge counts as dead."""
JUMP_PCT: Final = 1.0
"""Change within `ANSWER_EVERY_S` beyond the charge that is a jump [%]."""
RECOVERED_PCT: Final = 5.0
TYPICAL_AH: Final = 60.0
"""Capacity for which currents of the faults are stated [Ah]; other packs: in proportion."""


@dataclass(frozen=True)
class PlayedDrive:
    """A drive with the true SoC [%] of its rows, and the model of its pack."""

    name: str
    log: Log
    true_pct: FloatArray
    model: Model


@dataclass(frozen=True)
class CountFault:
    """What is wrong with the count that a gauge can make.

    Parameters
    ----------
    name : str
    offset_a, step_a, dead_a : float
        Added to the current, its resolution, and below which it reads zero, at 60 Ah [A].
    gain : float
    start_pct : float
        Error of the stated start [% SoC].
    lost : float
        Share of the samples whose frames are lost.
    gap_s : float
        Without frames, from a quarter of the drive on [s].
    late_rows : int
        Rows by which the current is late.
    limit_c : float
        Largest current that is read, over the capacity [1/h].
    """

    name: str
    offset_a: float = 0.0
    step_a: float = 0.0
    dead_a: float = 0.0
    gain: float = 1.0
    start_pct: float = 0.0
    lost: float = 0.0
    gap_s: float = 0.0
    late_rows: int = 0
    limit_c: float = math.inf

    def current_a(self, log: Log, capacity_ah: float) -> FloatArray:
        """Return the current that the gauge reads [A]."""
        size = capacity_ah / TYPICAL_AH
        current = self.gain * log.current_a + size * self.offset_a
        if self.late_rows:
            current = np.concatenate([np.full(self.late_rows, current[0]), current])[: len(log)]
        if self.step_a:
            current = size * self.step_a * np.round(current / (size * self.step_a))
        current = np.where(np.abs(current) < size * self.dead_a, 0.0, current)
        limit_a = self.limit_c * capacity_ah
        return np.asarray(np.clip(current, -limit_a, limit_a))

    def sent(self, log: Log) -> BoolArray:
        """Return whether the frames of each row are sent; the first ones always are."""
        since_s = log.time_s - log.time_s[0]
        begin_s = 0.25 * since_s[-1]
        is_lost = np.random.default_rng(0).random(len(log)) < self.lost
        is_lost |= (since_s > begin_s) & (since_s < begin_s + self.gap_s)
        return np.asarray(~is_lost | (since_s < ANSWER_EVERY_S))


FAULTS: Final = (
    CountFault("none"),
    *(CountFault(f"offset {a:+g} A", offset_a=a) for a in (-2.0, -1.0, -0.5, 0.5, 1.0, 2.0)),
    *(CountFault(f"gain {100 * (g - 1):+.0f} %", gain=g) for g in (0.95, 0.99, 1.01, 1.05)),
    *(CountFault(f"start {p:+g} %", start_pct=p) for p in (-20.0, -5.0, 5.0, 20.0)),
    CountFault("1 % of the frames lost", lost=0.01),
    CountFault("10 % of the frames lost", lost=0.1),
    CountFault("a minute without frames", gap_s=60.0),
    CountFault("ten minutes without frames", gap_s=600.0),
    CountFault("current in steps of 2 A, late by 2 s", step_a=2.0, late_rows=2),
    CountFault("zero below 2 A, limited to 1 C", dead_a=2.0, limit_c=1.0),
)
"""No fault, and twenty."""


@dataclass(frozen=True)
class Score:
    """What a gauge made of a fault, over all drives.

    Errors in % SoC; shares of the readings. `recovery_s` is the time after which the error stays
    below 5 %, on the median drive; infinite: it does not. `cover_2sigma` is None without a
    published σ.
    """

    fault: str
    mae_pct: float
    worst_pct: float
    jumps_per_h: float
    recovery_s: float
    cover_2sigma: float | None
    silent: float


def simulated_drives() -> list[PlayedDrive]:
    """Return twelve drives of four simulated packs, with models of other drives of theirs."""
    found = []
    for seed in PACKS:
        scenario = draw_scenario(seed, n_training=3, n_temperatures=2)
        training = [replace(each.log, soc_pct=each.true_soc_pct) for each in scenario.training]
        model = fit(training, capacity_ah=scenario.pack.capacity_ah).model
        drives = scenario.draw_drives(np.random.default_rng(seed), DRIVES_A_PACK, HOURS)
        for number, drive in enumerate(drives, start=1):
            made = record_drive(scenario.plant, drive, ())
            rows = _every_second(made.log)
            found.append(
                PlayedDrive(f"{seed}/{number}", made.log.rows(rows), made.true_soc_pct[rows], model)
            )
    return found


def recorded_drives(paths: Sequence[Path], model: Model) -> list[PlayedDrive]:
    """Return drives of recorded logs of a model's pack; may raise InputError."""
    found = []
    for path in paths:
        log = open_log(path).read()
        if log.soc_pct is None or not np.isfinite(log.soc_pct).all():
            cure = "give logs with the true SoC in each row"
            raise InputError("the true SoC is missing", source=path, field="soc_pct", cure=cure)
        rows = _every_second(log)
        found.append(PlayedDrive(path.stem, log.rows(rows), log.soc_pct[rows], model))
    return found


def _every_second(log: Log) -> slice:
    step_s = float(np.median(np.diff(log.time_s)))
    return slice(None, None, max(1, round(1.0 / step_s)))


def run_suite(
    command: Sequence[str],
    drives: Sequence[PlayedDrive],
    faults: Sequence[CountFault] = FAULTS,
    show: Callable[[str], None] = lambda _: None,
) -> list[Score]:
    """Play all drives with all faults to a gauge; return a score for each fault.

    Parameters
    ----------
    command : sequence of str
        The gauge. `{interface}`, `{channel}`, `{port}`, `{model}`, `{capacity_ah}` and `{soc}`
        stand for its bus, the pack's model file and capacity [Ah], and the stated start [%].
    drives, faults : sequence
    show : callable, optional
        Takes what is played at present.

    Raises
    ------
    CangaugeError
        If the gauge cannot be started, or says nothing.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:  # for suites side by side
        free.bind(("", 0))
        port = int(free.getsockname()[1])
    found = bus_address("socketcan" if has_socketcan("vcan0") else "udp_multicast")
    address = replace(found, options={**found.options} | {"port": port})
    scores = []
    with (
        tempfile.TemporaryDirectory(prefix="cangauge-suite-") as folder,
        BusConnection(open_bus(address), str(address)) as bus,
    ):
        gauge = _Gauge(bus, address, Path(folder), [*command])
        for number, fault in enumerate(faults, start=1):
            show(f"fault {number} of {len(faults)}: {fault.name}")
            runs = [gauge.play(drive, fault) for drive in drives]
            scores.append(_score(fault, drives, runs))
    return scores


Reading = tuple[IntArray, FloatArray, FloatArray]
"""Row of the drive, SoC and σ [%] of each reading; NaN where the gauge said nothing."""


class _Gauge:
    def __init__(
        self, bus: BusConnection, address: BusAddress, folder: Path, command: list[str]
    ) -> None:
        self._bus, self._address, self._folder, self._command = bus, address, folder, command
        path = shared_file("dbc", "soc_estimate.dbc")
        message = find_message(load_dbc(path), "SOC_ESTIMATE", source=path, field="SOC_ESTIMATE")
        signals = {signal.name: signal for signal in message.signals}
        self._id = message.frame_id
        self._codecs: list[SignalCodec] = [
            signal_codec(message, signals[name], source=path, field=name)
            for name in ("soc_pct", "soc_std_pct")
        ]
        self._vehicle, self._clock = Vehicle.load("generic"), ClockFrames()
        self._was_ready = False
        self._answers_a_sample = 1.0

    def play(self, drive: PlayedDrive, fault: CountFault) -> Reading:
        """Play a drive to a new gauge."""
        capacity_ah = drive.model.capacity_ah
        model = self._folder / f"{drive.model.made.fingerprint[:16]}.json"
        drive.model.save(model)
        start_pct = min(max(float(drive.true_pct[0]) + fault.start_pct, 0.0), 100.0)
        places = {
            "interface": self._address.interface,
            "channel": self._address.channel,
            "port": self._address.options["port"],
            "model": model,
            "capacity_ah": f"{capacity_ah:g}",
            "soc": f"{start_pct:.2f}",
        }
        command = [_filled(word, places) for word in self._command]
        with (self._folder / "gauge.log").open("wb") as log:
            try:
                process = subprocess.Popen(command, stdout=log, stderr=log)  # noqa: S603 - given
            except OSError as error:
                raise InputError(f"cannot be started: {error}", field="COMMAND") from error
            try:
                is_ready = self._becomes_ready(process)
                self._was_ready = True
                return self._readings(drive, fault, is_ready=is_ready)
            finally:
                process.terminate()
                try:
                    process.wait(5.0)
                except subprocess.TimeoutExpired:
                    process.kill()

    def _becomes_ready(self, process: subprocess.Popen[bytes]) -> bool:
        """Wait until a gauge publishes; raise CangaugeError if none of this command ever did."""
        until_s = time.monotonic() + QUIET_S
        while time.monotonic() < until_s and self._bus.receive(0.0) is not None:
            pass  # of the gauge before
        until_s = time.monotonic() + READY_WITHIN_S
        while time.monotonic() < until_s and process.poll() is None:
            message = self._bus.receive(0.1)
            if message is not None and message.arbitration_id == self._id:
                return True
        if self._was_ready:
            return False
        said = (self._folder / "gauge.log").read_text(errors="replace").strip()[-500:]
        ended = process.poll() is not None
        problem = "ended before" if ended else f"ran for {READY_WITHIN_S:g} s without"
        text = f"{' '.join(self._command)}: {problem} publishing SOC_ESTIMATE"
        raise CangaugeError(f"{text}; it said: {said}" if said else text)

    def _readings(self, drive: PlayedDrive, fault: CountFault, *, is_ready: bool) -> Reading:
        """Send a drive to a gauge that is ready, and read it every `ANSWER_EVERY_S`."""
        log, encoder = drive.log, FrameEncoder(self._vehicle)
        current_a = fault.current_a(log, drive.model.capacity_ah)
        sent = fault.sent(log)
        since_s = log.time_s - log.time_s[0]
        parted = np.flatnonzero(np.diff((since_s / ANSWER_EVERY_S).astype(int))) + 1
        batches = np.split(np.arange(len(log)), parted)
        readings, silent = np.full((len(batches), 2), np.nan), 0
        for number, rows in enumerate(batches if is_ready else ()):
            for row in rows[sent[rows]]:
                values = (log.time_s, current_a, log.voltage_v, log.temperature_c)
                sample = Sample(*(float(column[row]) for column in values))
                self._bus.send(self._clock.at(round(since_s[row] * MICROSECONDS)))
                for frame in encoder.encode(sample):
                    self._bus.send(frame)
            readings[number] = self._answer(int(sent[rows].sum()))
            silent = 0 if math.isfinite(readings[number, 0]) else silent + 1
            if silent >= SILENT_AT_MOST:
                break
        ends = np.array([rows[-1] for rows in batches])
        return ends, readings[:, 0], readings[:, 1]

    def _answer(self, samples: int) -> tuple[float, float]:
        """Return SoC and σ after so many samples; NaN if the gauge said nothing.

        It owes as many answers as its samples: the clock of the samples is that of the bus. One
        that has sent fewer is not waited for as long again.
        """
        found, got = (math.nan, math.nan), 0
        if not samples:
            return found
        owed = math.ceil(samples * self._answers_a_sample)
        until_s = time.monotonic() + ANSWER_WITHIN_S
        while time.monotonic() < until_s:
            # What it sends by its own clock counts too: listen on until it is quiet.
            message = self._bus.receive(until_s - time.monotonic() if got < owed else QUIET_S)
            if message is None:
                break
            if message.arbitration_id == self._id and len(message.data) == 8:
                got += 1
                soc_pct, std_pct = (codec.decode(message.data) for codec in self._codecs)
                found = soc_pct, std_pct
        if got < owed:
            self._answers_a_sample = got / samples
        return found


def _filled(word: str, places: Mapping[str, object]) -> str:
    """Return a word of a command with its places filled; other braces are the command's own."""
    for name, value in places.items():
        word = word.replace(f"{{{name}}}", str(value))
    return word


def _score(fault: CountFault, drives: Sequence[PlayedDrive], runs: Sequence[Reading]) -> Score:
    errors, recoveries, jumps, hours, covered = [], [], 0, 0.0, []
    silent = np.concatenate([np.isnan(soc) for _, soc, _ in runs])
    for drive, (at, soc_pct, std_pct) in zip(drives, runs, strict=True):
        error = soc_pct - drive.true_pct[at]
        known = np.isfinite(error)
        errors.append(error[known])
        since_s = drive.log.time_s[at] - drive.log.time_s[0]
        bad = np.flatnonzero(~(np.abs(error) < RECOVERED_PCT))  # silence is no recovery
        recoveries.append(
            0.0 if not bad.size else math.inf if bad[-1] == at.size - 1 else since_s[bad[-1]]
        )
        drawn_ah = discharged_ah(drive.log.time_s, drive.log.current_a)[at]
        moved = np.diff(soc_pct[known]) + 100.0 * np.diff(drawn_ah[known]) / drive.model.capacity_ah
        jumps += int((np.abs(moved) > JUMP_PCT).sum())
        hours += float(since_s[-1]) / 3600.0
        with_std = known & np.isfinite(std_pct)
        covered.append(np.abs(error[with_std]) <= 2.0 * std_pct[with_std])
    every, within = np.abs(np.concatenate(errors)), np.concatenate(covered)
    return Score(
        fault=fault.name,
        mae_pct=float(every.mean()) if every.size else math.nan,
        worst_pct=float(every.max()) if every.size else math.nan,
        jumps_per_h=jumps / hours if every.size else math.nan,
        recovery_s=float(np.median(recoveries)),
        cover_2sigma=float(within.mean()) if within.size else None,
        silent=float(silent.mean()),
    )
