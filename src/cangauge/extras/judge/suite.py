"""A conformance suite for gauges: drives with faults, played to a program that publishes a SoC.

The gauge under test reads the frames of `generic_pack.dbc` and publishes SOC_ESTIMATE of
`soc_estimate.dbc` (signals soc_pct and soc_std_pct; counter and CRC are not checked). It takes its
time from REPLAY_CLOCK, so that an hour is played in seconds, and publishes after each voltage; once
before the first frame, to say that it is ready. Each run is a process of its own.
"""

from __future__ import annotations

import logging
import math
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from cangauge._resources import shared_file
from cangauge._typing import BoolArray, FloatArray
from cangauge.bus.connection import BusConnection
from cangauge.bus.database import load_dbc, signal_codec
from cangauge.bus.open import bus_address, open_bus
from cangauge.bus.time_source import MICROSECONDS, clock_frame
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import CangaugeError, InputError
from cangauge.extras.judge.gauge import published_pct
from cangauge.extras.validation.twin.simulation import simulate
from cangauge.identify.fit import fit
from cangauge.logs.gaps import discharged_ah
from cangauge.logs.log import Log
from cangauge.logs.read import open_log
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.types import Sample

ANSWER_EVERY_S: Final = 20.0
"""Log time between two readings of the gauge [s]: as often it is compared with the truth."""
QUIET_S: Final = 0.02
"""Time without a frame after which a gauge that owes no answer has none under way [s]."""
ANSWER_WITHIN_S: Final = 10.0
"""Longest wait for an answer that a gauge owes [s]: a busy machine changes no score."""
READY_WITHIN_S: Final = 30.0
"""Longest wait for the first frame of a gauge [s]."""

_LOG: Final = logging.getLogger(__name__)

Drive = tuple[Log, Model]
"""A log with the true SoC in each row, and a model of its pack."""


class CountFault(NamedTuple):
    """What is wrong with the count that a gauge can make; currents over the capacity [1/h]."""

    name: str
    offset_c: float = 0.0
    """Added to the current."""
    step_c: float = 0.0
    """Resolution of the current, below what it reads zero, and the largest that it reads."""
    dead_c: float = 0.0
    limit_c: float = math.inf
    gain: float = 1.0
    start_pct: float = 0.0
    """Error of the stated start [% SoC]."""
    lost: float = 0.0
    """Share of the samples whose frames are lost."""
    gap_s: float = 0.0
    """Without frames, from a quarter of the drive on [s]."""
    late_rows: int = 0
    """Rows by which the current is late."""

    def current_a(self, log: Log, capacity_ah: float) -> FloatArray:
        """Return the current that the gauge reads [A]."""
        late = np.maximum(np.arange(len(log)) - self.late_rows, 0)
        rate_c = self.gain * log.current_a[late] / capacity_ah + self.offset_c
        if self.step_c:
            rate_c = self.step_c * np.round(rate_c / self.step_c)
        rate_c = np.where(np.abs(rate_c) < self.dead_c, 0.0, rate_c)
        return np.asarray(capacity_ah * np.clip(rate_c, -self.limit_c, self.limit_c))

    def sent(self, log: Log) -> BoolArray:
        """Return whether the frames of each row are sent; the first ones always are."""
        since_s = log.time_s - log.time_s[0]
        begin_s = 0.25 * since_s[-1]
        is_lost = np.random.default_rng(0).random(len(log)) < self.lost
        is_lost |= (since_s > begin_s) & (since_s < begin_s + self.gap_s)
        return np.asarray(~is_lost | (since_s < ANSWER_EVERY_S))


FAULTS: Final = (
    CountFault("none"),
    *(CountFault(f"offset {a:+g} A", offset_c=a / 60.0) for a in (-2.0, -1.0, -0.5, 0.5, 1.0, 2.0)),
    *(CountFault(f"gain {100 * (g - 1):+.0f} %", gain=g) for g in (0.95, 0.99, 1.01, 1.05)),
    *(CountFault(f"start {p:+g} %", start_pct=p) for p in (-20.0, -5.0, 5.0, 20.0)),
    CountFault("1 % of the frames lost", lost=0.01),
    CountFault("10 % of the frames lost", lost=0.1),
    CountFault("a minute without frames", gap_s=60.0),
    CountFault("ten minutes without frames", gap_s=600.0),
    CountFault("current in steps of 2 A, late by 2 s", step_c=2.0 / 60.0, late_rows=2),
    CountFault("zero below 2 A, limited to 1 C", dead_c=2.0 / 60.0, limit_c=1.0),
)
"""No fault, and twenty; names state the current of a pack of 60 Ah."""


def simulated_drives() -> list[Drive]:
    """Return twelve drives of four simulated packs, with models of other drives of theirs."""
    found = []
    for seed in range(211, 215):  # of no table of the estimator or the diagnosis
        runs = [simulate(seed=seed, discharge=True)]
        runs += [simulate(seed=seed, drive=drive, hours=0.5) for drive in range(2, 8)]
        logs = [replace(run.log, soc_pct=run.recording.true_soc_pct) for run in runs]
        model = fit(logs[:4], capacity_ah=runs[0].pack.capacity_ah).model
        found += [(_every_second(log), model) for log in logs[4:]]
    return found


def recorded_drives(paths: Sequence[Path], model: Model) -> list[Drive]:
    """Return drives of recorded logs of a model's pack; may raise InputError."""
    logs = [open_log(path).read() for path in paths]
    for log in logs:
        if not np.isfinite(published_pct(log)).all():
            problem, cure = "the true SoC is missing", "give logs with the true SoC in each row"
            raise InputError(problem, source=log.source, field="soc_pct", cure=cure)
    return [(_every_second(log), model) for log in logs]


def _every_second(log: Log) -> Log:
    return log.rows(np.diff(np.floor(log.time_s - log.time_s[0]), prepend=-1.0) > 0.0)


def run_suite(
    command: Sequence[str],
    drives: Sequence[Drive],
    faults: Sequence[CountFault] = FAULTS,
    show: Callable[[str], None] = _LOG.debug,
) -> list[dict[str, Any]]:
    """Play all drives with all faults to a gauge; return the scores of each fault.

    Parameters
    ----------
    command : sequence of str
        The gauge. `{interface}`, `{channel}`, `{port}`, `{model}`, `{capacity_ah}` and `{soc}`
        stand for its bus, the pack's model file and capacity [Ah], and the stated start [%].
    drives, faults : sequence
    show : callable, optional
        Takes what is played at present.

    Returns
    -------
    list of dict
        `fault`; `mae_pct` and `worst_pct`, errors over all drives [% SoC]; `jumps_per_h`;
        `recovery_s`, the time after which the error stays below 5 %, on the median drive, infinite
        if it does not; `cover_2sigma`, share of the readings, None without a published σ; `silent`,
        share of the readings without an answer.

    Raises
    ------
    CangaugeError
        If the gauge cannot be started, or says nothing.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:  # for suites side by side
        free.bind(("", 0))
        port = int(free.getsockname()[1])
    address = bus_address(options={"port": port})
    scores = []
    with (
        tempfile.TemporaryDirectory(prefix="cangauge-suite-") as folder,
        BusConnection(open_bus(address), address) as bus,
    ):
        gauge = _Gauge(bus, Path(folder), command)
        for number, fault in enumerate(faults, start=1):
            show(f"fault {number} of {len(faults)}: {fault.name}")
            readings = [gauge.play(*drive, fault) for drive in drives]
            scores.append({"fault": fault.name, **_score(drives, readings)})
    return scores


class _Gauge:
    """A gauge under test on a bus."""

    def __init__(self, bus: BusConnection, folder: Path, command: Sequence[str]) -> None:
        self._bus, self._folder, self._command = bus, folder, command
        database = load_dbc(shared_file("dbc", "soc_estimate.dbc"))
        message = database.get_message_by_name("SOC_ESTIMATE")
        self._id = message.frame_id
        self._codecs = [
            signal_codec(message, message.get_signal_by_name(name))
            for name in ("soc_pct", "soc_std_pct")
        ]
        self._was_ready = False
        self._answers_a_sample = 1.0

    def play(self, log: Log, model: Model, fault: CountFault) -> FloatArray:
        """Play a drive to a new gauge; return row, SoC and σ [%] of each reading, shape (3, n).

        SoC and σ are NaN where the gauge said nothing.
        """
        model.save(self._folder / "model.json")
        start_pct = float(np.clip(published_pct(log)[0] + fault.start_pct, 0.0, 100.0))
        address, command = self._bus.address, list(self._command)
        for name, value in {
            "interface": address.interface,
            "channel": address.channel,
            "port": address.options["port"],
            "model": self._folder / "model.json",
            "capacity_ah": f"{model.capacity_ah:g}",
            "soc": f"{start_pct:.2f}",
        }.items():  # other braces are the command's own
            command = [word.replace(f"{{{name}}}", str(value)) for word in command]
        while self._bus.receive_pending(0.0):
            pass  # of the gauge before
        with (self._folder / "gauge.log").open("wb") as output:
            try:
                process = subprocess.Popen(command, stdout=output, stderr=output)  # noqa: S603 - given
            except OSError as error:
                raise InputError(f"cannot be started: {error}", field="COMMAND") from error
        try:
            is_ready = self._becomes_ready(process)
            return self._readings(log, model, fault, is_ready=is_ready)
        finally:
            process.terminate()
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()

    def _becomes_ready(self, process: subprocess.Popen[bytes]) -> bool:
        """Wait until a gauge publishes; raise CangaugeError if none of this command ever did."""
        until_s = time.monotonic() + READY_WITHIN_S
        while time.monotonic() < until_s and process.poll() is None:
            message = self._bus.receive(0.1)
            if message is not None and message.arbitration_id == self._id:
                self._was_ready = True
                return True
        if not self._was_ready:
            ended = (
                f"ran for {READY_WITHIN_S:g} s without"
                if process.poll() is None
                else "ended before"
            )
            said = (self._folder / "gauge.log").read_text(errors="replace").strip()[-500:]
            raise CangaugeError(
                f"{' '.join(self._command)}: {ended} publishing SOC_ESTIMATE; it said: {said}"
            )
        return False

    def _readings(self, log: Log, model: Model, fault: CountFault, *, is_ready: bool) -> FloatArray:
        """Send a drive to a gauge that is ready, and read it every `ANSWER_EVERY_S`."""
        encoder, since_s = FrameEncoder(Vehicle.load("generic")), log.time_s - log.time_s[0]
        current_a, is_sent = fault.current_a(log, model.capacity_ah), fault.sent(log)
        columns = np.array([log.time_s, current_a, log.voltage_v, log.temperature_c])
        ends = np.flatnonzero(np.diff(since_s // ANSWER_EVERY_S, append=np.inf))
        readings = np.full((3, ends.size), np.nan)
        readings[0] = ends
        for number, rows in enumerate(np.split(np.arange(len(log)), ends[:-1] + 1)):
            if not is_ready:
                break
            for row in rows[is_sent[rows]]:
                self._bus.send(clock_frame(round(since_s[row] * MICROSECONDS)))
                for frame in encoder.encode(Sample(*columns[:, row].tolist())):
                    self._bus.send(frame)
            readings[1:, number] = self._answer(int(is_sent[rows].sum()))
        return readings

    def _answer(self, samples: int) -> tuple[float, float]:
        """Return SoC and σ after so many samples; NaN if the gauge said nothing.

        It owes as many answers as its samples: the clock of the samples is that of the bus. One
        that has sent fewer is not waited for as long again. What it sends by its own clock counts
        too, until it is quiet.
        """
        found, got = (math.nan, math.nan), 0
        owed = math.ceil(samples * self._answers_a_sample)
        last_s = time.monotonic() + ANSWER_WITHIN_S
        until_s = last_s if owed else time.monotonic() + QUIET_S
        while samples and (left_s := until_s - time.monotonic()) > 0.0:
            message = self._bus.receive(left_s)
            if message and message.arbitration_id == self._id and len(message.data) == 8:
                got += 1
                soc_pct, std_pct = (codec.decode(message.data) for codec in self._codecs)
                found = soc_pct, std_pct
                if got >= owed:
                    until_s = min(last_s, time.monotonic() + QUIET_S)
        if got < owed:
            self._answers_a_sample = got / samples
        return found


def _score(drives: Sequence[Drive], readings: Sequence[FloatArray]) -> dict[str, Any]:
    errors, stds, recoveries, jumps, hours = [], [], [], 0, 0.0
    for (log, model), (rows, soc_pct, std_pct) in zip(drives, readings, strict=True):
        at = rows.astype(np.intp)
        error, since_s = soc_pct - published_pct(log)[at], log.time_s[at] - log.time_s[0]
        is_bad = ~(np.abs(error) < 5.0)  # silence is no recovery
        recoveries.append(math.inf if is_bad[-1] else float(np.max(since_s[is_bad], initial=0.0)))
        drawn_pct = 100.0 * discharged_ah(log.time_s, log.current_a)[at] / model.capacity_ah
        jumps += int((np.abs(np.diff((soc_pct + drawn_pct)[np.isfinite(error)])) > 1.0).sum())
        hours += since_s[-1] / 3600.0
        errors.append(np.abs(error))
        stds.append(std_pct)
    error, std = np.concatenate(errors), np.concatenate(stds)
    known = np.isfinite(error)
    sizes = error[known] if known.any() else np.array([math.nan])
    covered = (error <= 2.0 * std)[known & np.isfinite(std)]
    return {
        "mae_pct": float(sizes.mean()),
        "worst_pct": float(sizes.max()),
        "jumps_per_h": jumps / hours if known.any() else math.nan,
        "recovery_s": float(np.median(recoveries)),
        "cover_2sigma": float(covered.mean()) if covered.size else None,
        "silent": float(1.0 - known.mean()),
    }
