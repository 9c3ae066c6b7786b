"""Cost of a restart: the service is killed at random times and continues from its state file.

    python benchmarks/restarts.py [--kills 1000] [--real 20] [--seed 1] [--json]

in-process  A 10 Hz drive is estimated by an uninterrupted service and by one that is killed
            repeatedly. A kill discards everything but the state file as written by then. The file
            is written one second after the start and every 10 s of the drive, as by the service;
            one kill in ten interrupts the writing and leaves half a temporary file. Between the
            kill and the next frame 0.2 to 3 s of the drive are lost.
process     `cangauge run` on a bus (udp_multicast) is killed by SIGKILL at random times, started
            again, and compared with an uninterrupted one; the state is written every second. The
            time of the start is that of the machine.

For each restart: the permanent error of the counted charge (process: the step of the SoC, since the
bus resolves the count to 0.025 % only), the charge that flowed in both directions between the last
writing and the first frame; and the SoC minus that of the uninterrupted service.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cangauge._resources import shared_file
from cangauge.bus.open import BusAddress, open_bus
from cangauge.bus.publish import SocReader
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.config import RunConfig
from cangauge.service.loop import FIRST_CHECKPOINT_S
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.state import StateKeeper
from cangauge.settings import FrameIds
from cangauge.types import Estimate, Reason, Sample
from live_service import ENTRY, Traffic

EVERY_S = RunConfig.model_fields["state_every_s"].default
RATE_HZ = 10
BEGIN_PCT = 75.0
MEAN_BETWEEN_KILLS_S = 60.0
EPOCH_S = 1_700_000_000.0
PORT = 43_777
CHANNEL = "239.74.163.2"
REAL_EVERY_S = 1.0

Result = dict[str, Any]


@dataclass(frozen=True)
class Restart:
    """One kill and its consequences."""

    unsaved_s: float
    """Time from the last writing to the first frame after the restart [s]."""
    flowed_pct: float
    """Charge in both directions in that time [% of capacity]."""
    net_pct: float
    """Net charge in that time: the loss without counting across it [% of capacity]."""
    lost_pct: float
    """Permanent error of the counted charge [% of capacity]."""
    soc_pct: float
    """SoC minus that of the uninterrupted service at the first frame [%]."""
    later_pct: float
    """The same at the next kill, about a minute later [%]."""


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--real", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    console = Console(stderr=True)
    minutes = (options.kills * 0.25 + options.real * 7.0) / 60.0
    console.print(f"about {minutes:.0f} minutes on an idle machine")
    results: Result = {}
    with tempfile.TemporaryDirectory() as folder:
        if options.kills:
            results["in-process"] = in_process(options.kills, options.seed, Path(folder), console)
        if options.real:
            results["process"] = real_process(options.real, options.seed, Path(folder), console)
    if options.json:
        print(json.dumps(results))
    else:
        Console().print(table_of(results))


def drive(seconds: float, model: Model, seed: int) -> list[Sample]:
    """Return a drive with pulses, discharging and charging in turn, with the model's voltage."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    edges = np.cumsum(rng.uniform(2.0, 15.0, int(seconds / 5.0) + 10))
    levels = rng.normal(0.0, 30.0, edges.size + 1)
    # Down for an hour, up for an hour, about 25 % each.
    mean_a = 0.25 * model.capacity_ah * np.sign(np.sin(np.pi * time_s / 3600.0) + 1e-12)
    current_a = levels[np.searchsorted(edges, time_s)] + mean_a
    out_pct = np.concatenate(([0.0], np.cumsum((current_a[1:] + current_a[:-1]) / 2.0)))
    soc_pct = BEGIN_PCT - out_pct * 100.0 / (3600.0 * RATE_HZ * model.capacity_ah)
    voltage_model = model.voltage_model()
    delayed = np.column_stack(
        [np.interp(time_s - delay, time_s, current_a) for delay in voltage_model.loads.delays_s]
    )
    temperature_c = 23.0 + 2.0 * np.sin(time_s / 2000.0)
    loads = voltage_model.load_columns(temperature_c, delayed)
    voltage_v = voltage_model.pseudo_ocv(np.clip(soc_pct, 5.0, 98.0))
    voltage_v += loads @ voltage_model.load_coefficients
    voltage_v += rng.normal(0.0, 0.5, time_s.size)
    columns = (time_s + EPOCH_S, current_a, voltage_v, temperature_c)
    return [Sample(*row) for row in zip(*(column.tolist() for column in columns), strict=True)]


class ServiceRun:
    """A service from its start to its kill, on the clock of the samples."""

    def __init__(self, model: Model, path: Path | None, soc_pct: float | None = None) -> None:
        self.now_s = EPOCH_S
        settings = PipelineSettings(EstimatorSettings(initial_soc_pct=soc_pct))
        self.pipeline = Pipeline(Vehicle.load("generic"), model, settings)
        self.keeper: StateKeeper | None = None
        if path is not None:
            self.keeper = StateKeeper(path, self.pipeline, "bench", 86400.0, lambda: self.now_s)

    def begin(self, now_s: float) -> None:
        """Start at a moment [s]."""
        self.now_s = now_s
        if self.keeper is not None:
            self.keeper.__enter__()

    def handle(self, sample: Sample, encoder: FrameEncoder) -> Estimate:
        """Handle the frames of a sample."""
        self.now_s = sample.time_s
        for frame in encoder.encode(sample):
            self.pipeline.handle(frame)
        return self.pipeline.latest

    def save(self) -> None:
        """Write the state and wait until it is written."""
        if self.keeper is None:
            return
        self.keeper.checkpoint()
        written = threading.Event()
        self.keeper._worker.submit(written.set)  # noqa: SLF001 - after the write in its queue
        if not written.wait(30.0):
            raise TimeoutError("the state was not written within 30 s")


def in_process(kills: int, seed: int, folder: Path, console: Console) -> Result:
    """Kill services at random times of one drive."""
    rng = np.random.default_rng(seed)
    model = Model.load(shared_file("replay", "leaf2012_published_model.json"))
    path = folder / "state.json"
    lives = np.ceil((rng.exponential(MEAN_BETWEEN_KILLS_S, kills + 1) + 1.0) * RATE_HZ).astype(int)
    away = np.ceil(rng.uniform(0.2, 3.0, kills + 1) * RATE_HZ).astype(int)
    samples = drive(float(lives.sum() + away.sum()) / RATE_HZ, model, seed)
    flowed, net = flowed_pct(samples, model.capacity_ah)
    encoder, other = (FrameEncoder(Vehicle.load("generic")) for _ in range(2))
    whole, life = ServiceRun(model, None, BEGIN_PCT), ServiceRun(model, path, BEGIN_PCT)
    life.begin(EPOCH_S)
    restarts, begun = [], None
    first = saved = refused = 0
    was_pct = 0.0
    for number, (alive, down) in enumerate(zip(lives.tolist(), away.tolist(), strict=True)):
        due = first + int(FIRST_CHECKPOINT_S * RATE_HZ)
        for at in range(first, first + alive):
            truth, found = whole.handle(samples[at], other), life.handle(samples[at], encoder)
            if at == first and number:
                counted_pct = found.soc_coulomb_pct - truth.soc_coulomb_pct
                begun = (
                    (at - saved) / RATE_HZ, float(flowed[at] - flowed[saved]),
                    float(net[at] - net[saved]),
                    counted_pct - was_pct, found.soc_pct - truth.soc_pct,
                )  # fmt: skip
                was_pct = counted_pct
            if at >= due:
                life.save()
                due, saved = at + int(EVERY_S * RATE_HZ), at
        if begun is not None:
            restarts.append(Restart(*begun, found.soc_pct - truth.soc_pct))
        # Killed: only the state file is used again.
        if rng.random() < 0.1:
            (folder / f".state.{number:08x}.json").write_bytes(b'{"format": "cangauge-st')
        first += alive + down
        for at in range(first - down, min(first, len(samples))):
            whole.handle(samples[at], other)
        life = ServiceRun(model, path, BEGIN_PCT)
        life.begin(EPOCH_S + first / RATE_HZ)
        refused += not (life.keeper is not None and life.keeper.restored)
        console.print(f"{number} kills", end="\r")
    left = len(list(folder.glob(".state.*")))
    return summary(restarts, rms_30s_pct(samples, model.capacity_ah)) | {
        "refused": refused,
        "left_over": left,
    }


def flowed_pct(samples: list[Sample], capacity_ah: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the charge since the first sample in both directions and net [%], shape (n,) each."""
    current_a = np.array([sample.current_a for sample in samples])
    each = (current_a[1:] + current_a[:-1]) / 2.0 / RATE_HZ * 100.0 / (3600.0 * capacity_ah)
    either = np.concatenate(([0.0], np.cumsum(np.abs(each))))
    return either, np.concatenate(([0.0], np.cumsum(each)))


def rms_30s_pct(samples: list[Sample], capacity_ah: float) -> float:
    """Return the charge of 30 s at the RMS current [%]."""
    rms_a = float(np.sqrt(np.mean([sample.current_a**2 for sample in samples])))
    return 100.0 * rms_a * 30.0 / (3600.0 * capacity_ah)


def summary(restarts: list[Restart], rms_30s_pct: float) -> Result:
    """Summarize the restarts."""
    columns = {
        name: np.abs([getattr(each, name) for each in restarts])
        for name in ("unsaved_s", "flowed_pct", "net_pct", "lost_pct", "soc_pct", "later_pct")
    }
    result: Result = {"restarts": len(restarts)}
    for name, values in columns.items():
        result[name] = {
            "median": float(np.median(values)),
            "p99": float(np.quantile(values, 0.99)),
            "most": float(values.max()),
        }
    beyond = columns["lost_pct"] > columns["flowed_pct"] + 1e-9
    result["lost_more_than_flowed"] = int(beyond.sum())
    result["rms_30s_pct"] = rms_30s_pct
    result["lost_more_than_30s"] = int((columns["lost_pct"] > rms_30s_pct).sum())
    return result


KILLED_ID, WHOLE_ID = 0x5A0, 0x5B0
"""SOC_ESTIMATE of the killed and of the uninterrupted service."""


def real_process(kills: int, seed: int, folder: Path, console: Console) -> Result:
    """Kill `cangauge run` by SIGKILL, and compare with an uninterrupted one."""
    rng = np.random.default_rng(seed)
    model_path = shared_file("replay", "leaf2012_published_model.json")
    model = Model.load(model_path)
    lives = rng.uniform(1.5, 6.0, kills)
    samples = drive(kills * 30.0 + 300.0, model, seed)
    flowed, net = flowed_pct(samples, model.capacity_ah)
    restarts = []
    with Player(samples, folder / "service.txt") as player:
        service = [player.service(model_path, KILLED_ID, folder / "real.json")]
        other = player.service(model_path, WHOLE_ID, None)
        try:
            player.wait_for_both()
            for number, seconds in enumerate(lives.tolist()):
                time.sleep(seconds)
                before_pct, saved = player.apart_pct(), player.sent
                service[0].send_signal(signal.SIGKILL)
                service[0].wait()
                player.forget()
                service[0] = player.service(model_path, KILLED_ID, folder / "real.json")
                player.wait_for_both()
                back = player.sent
                after_pct = player.apart_pct()
                saved = max(saved - int((REAL_EVERY_S + 0.5) * RATE_HZ), 0)
                time.sleep(1.0)
                restarts.append(
                    Restart(
                        (back - saved) / RATE_HZ, float(flowed[back] - flowed[saved]),
                        float(net[back] - net[saved]),
                        after_pct - before_pct, after_pct, player.apart_pct(),
                    )
                )  # fmt: skip
                console.print(f"{number + 1} real kills", end="\r")
        finally:
            for process in (*service, other):
                process.kill()
                process.wait()
    found = summary(restarts, rms_30s_pct(samples, model.capacity_ah))
    return found | {"refused": kills - player.restored()}


class Player(Traffic):
    """Sends a drive to a bus in real time and reads the SoC of two services."""

    def __init__(self, samples: list[Sample], log: Path) -> None:
        self._bus = open_bus(BusAddress("udp_multicast", CHANNEL, {"port": PORT}))
        super().__init__(self._bus)
        self._samples = samples
        self._log = log
        self._latest: dict[int, float] = {}
        self._readers = [SocReader(FrameIds(each, each + 1, each + 15)) for each in
                         (KILLED_ID, WHOLE_ID)]  # fmt: skip
        self.sent = 0

    def run(self) -> None:
        """Send frames and receive in between."""
        encoder = FrameEncoder(Vehicle.load("generic"))
        began_s = time.monotonic()
        for number, sample in enumerate(self._samples):
            for frame in encoder.encode(sample):
                self._bus.send(frame)
            self.sent = number
            while (left_s := began_s + (number + 1) / RATE_HZ - time.monotonic()) > 0.0:
                message = self._bus.recv(left_s)
                if message is not None:
                    self._read(message)
            if self._over.is_set():
                return

    def _read(self, message: can.Message) -> None:
        for frame_id, reader in zip((KILLED_ID, WHOLE_ID), self._readers, strict=True):
            name, content = reader.read(message)
            if name == "soc_estimate" and not content["reason"] & Reason.INPUT_STALE:
                self._latest[frame_id] = content["soc_pct"]

    def forget(self) -> None:
        """Drop the SoC of the killed service."""
        time.sleep(0.2)
        self._latest.pop(KILLED_ID, None)

    def wait_for_both(self) -> None:
        """Wait until both services publish a SoC."""
        until_s = time.monotonic() + 60.0
        while not {KILLED_ID, WHOLE_ID} <= self._latest.keys():
            if time.monotonic() > until_s:
                raise TimeoutError("no estimate within 60 s")
            time.sleep(0.02)

    def apart_pct(self) -> float:
        """Return the SoC of the killed service minus that of the other [%]."""
        return self._latest[KILLED_ID] - self._latest[WHOLE_ID]

    def service(self, model: Path, frame_id: int, state: Path | None) -> subprocess.Popen[bytes]:
        """Start `cangauge run`."""
        names = ("soc_estimate", "soc_detail", "soc_health", "soc_power", "soc_cells")
        ids = {name: frame_id + k for k, name in enumerate(names)}
        ids["replay_clock"] = frame_id + 15
        lines = [
            f"model = {json.dumps(str(model))}",
            f'interface = "udp_multicast"\nchannel = "{CHANNEL}"',
            f"bus_options = {{ port = {PORT} }}",
            f"initial_soc = {BEGIN_PCT}",
            f"ids = {{ {', '.join(f'{name} = {each}' for name, each in ids.items())} }}",
            'log_format = "json"\nstatus_socket = "off"',
        ]
        if state is not None:
            lines.append(f"state = {json.dumps(str(state))}\nstate_every_s = {REAL_EVERY_S}")
        config = self._log.with_name(f"{frame_id:X}.toml")
        config.write_text("\n".join(lines) + "\n", encoding="utf-8")
        arguments = ["run", "--config", str(config)]
        with self._log.open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-c", ENTRY, *arguments],
                stderr=log,
                stdout=subprocess.DEVNULL,
            )

    def restored(self) -> int:
        """Return the number of starts that restored a state, by the log of the service."""
        return self._log.read_text(encoding="utf-8").count('"state.restored"')


def table_of(results: Result) -> Table:
    """Return the results as a table."""
    table = Table(title="Cost of a restart", title_justify="left")
    for name in ("", *results):
        table.add_column(name, justify="right" if name else "left")
    rows = {
        "unsaved_s": "time from the last writing to the first frame after the restart [s]",
        "flowed_pct": "charge in both directions in that time [%]",
        "net_pct": "net charge in that time: lost without counting across the gap [%]",
        "lost_pct": "permanent error of the charge (process: of the SoC) [%]",
        "soc_pct": "SoC error at the first frame after the restart [%]",
        "later_pct": "SoC error at the next kill [%]",
    }
    table.add_row("restarts", *(str(each["restarts"]) for each in results.values()))
    for name, words in rows.items():
        cells = [
            " / ".join(f"{each[name][part]:.3f}" for part in ("median", "p99", "most"))
            for each in results.values()
        ]
        table.add_row(escape(f"{words}: median / p99 / maximum"), *cells)
    carried = (f"{each['rms_30s_pct']:.3f}" for each in results.values())
    table.add_row("charge of 30 s at the RMS current of the drive [%]", *carried)
    for name, words in (
        ("lost_more_than_30s", "restarts with a larger charge error than that"),
        ("lost_more_than_flowed", "restarts with a charge error above the charge that flowed"),
        ("refused", "starts without a usable state"),
        ("left_over", "temporary files left"),
    ):
        table.add_row(words, *(str(each.get(name, "–")) for each in results.values()))
    return table


if __name__ == "__main__":
    main()
