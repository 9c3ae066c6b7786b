"""Load, speed, timing and memory of the live service.

    python benchmarks/bus_load.py [--only load|max|offline|timing|memory]… [--seconds 20] [--keep]

load     4,000 frames/s (a saturated 500 kbit/s bus), 200 of them wanted: CPU time of `cangauge run`
         and lost wanted frames, compared with a bare python-can loop on the same bus.
max      a 2.5 h, 10 Hz log from `cangauge replay --speed max` to `cangauge run`.
offline  the same log as by `cangauge estimate`.
timing   a capture of 120 s in real time.
memory   24 h of bus time at 10 Hz.

The bus is udp_multicast on this machine, where every frame reaches the process and Python filters.
On SocketCAN the kernel filters, and the 3,800 unwanted frames cost the process nothing.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import can
import numpy as np
from rich.table import Table

from cangauge._resources import shared_file
from cangauge.bus.open import BusAddress, bus_address, open_bus
from cangauge.bus.recording import read_log
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import estimate_log
from cangauge.estimation.settings import EstimatorSettings
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.replay.player import Pacer
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.record import Recorder
from cangauge.types import Sample
from figures import publish
from live_service import MODEL, command, service

RATE_HZ = 4000
"""Frame rate of a saturated 500 kbit/s bus [1/s]."""
WANTED_RATE_HZ = 200
PORT = 43_555

Result = dict[str, Any]
Row = tuple[str, str, str]


def long_log() -> Log:
    """Return a drive of at least 2.5 h at 10 Hz."""
    return read_log(shared_file("replay", "leaf2012_reconstruction_white.parquet"))


def bus() -> BusAddress:
    """Return a bus of this benchmark only."""
    return bus_address("udp_multicast", options={"port": PORT})


def load(seconds: float) -> list[Row]:
    """Measure `cangauge run` and a bare loop on a saturated bus."""
    with service(bus(), until_idle_s=1.5) as process:
        sent = send_load(seconds)
        out, _ = process.communicate(timeout=60)
    run = json.loads(out)
    bare = bare_loop(seconds)
    wanted = int(sent["wanted"])
    # Waiting 1.5 s for the end costs no CPU time.
    run_cores = run["cpu_seconds"] / sent["seconds"]
    bare_cores = bare["cpu_seconds"] / sent["seconds"]
    lost = wanted - run["frames"]["received"]
    bare_lost = sent["frames"] - bare["frames"]
    return [
        ("frames sent", f"{sent['frames'] / sent['seconds']:.0f}/s over {sent['seconds']:.1f} s",
         f"{RATE_HZ}/s"),
        ("wanted frames", f"{wanted / sent['seconds']:.0f}/s", ""),
        ("wanted frames lost", f"{lost} of {wanted}", "0"),
        ("CPU of `cangauge run`", f"{100 * run_cores:.1f} % of a core", "< 50 %"),
        ("CPU of a bare python-can loop", f"{100 * bare_cores:.1f} % of a core", ""),
        ("frames lost by the bare loop", f"{bare_lost} of {sent['frames']}", ""),
        ("CPU of `cangauge run` / CPU of the bare loop", f"{run_cores / bare_cores:.2f}×", ""),
    ]  # fmt: skip


def send_load(seconds: float) -> Result:
    """Send wanted frames (current and voltage at 100 Hz) among others, evenly."""
    encoder = FrameEncoder(Vehicle.load("generic"))
    others = itertools.cycle(
        can.Message(arbitration_id=0x200 + number, is_extended_id=False, data=bytes(8))
        for number in range(100)
    )
    every = RATE_HZ // WANTED_RATE_HZ
    sender = open_bus(bus())
    pacer = Pacer(1.0, lambda: False)
    began = time.monotonic()
    pacer.wait(0)
    frames = wanted = 0
    queue: list[can.Message] = []
    for number in range(int(seconds * RATE_HZ)):
        if number % every == 0:
            if not queue:
                time_s = number / RATE_HZ
                queue = encoder.encode(Sample(time_s, 20 + 10 * math.sin(time_s), 380.0, 25.0))
            sender.send(queue.pop(0))
            wanted += 1
        else:
            sender.send(next(others))
        frames += 1
        if number % 4 == 3:
            pacer.wait(int((number + 1) * 1e6 / RATE_HZ))
    took = time.monotonic() - began
    sender.shutdown()
    return {"frames": frames, "wanted": wanted, "seconds": took}


def bare_loop(seconds: float) -> Result:
    """Count the same load with python-can alone."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_count_frames, args=(theirs,))
    process.start()
    ours.recv()
    send_load(seconds)
    result: Result = ours.recv()
    process.join()
    return result


def _count_frames(pipe: Any) -> None:
    receiver = open_bus(bus())
    pipe.send("ready")
    cpu, frames = time.process_time(), 0
    while True:
        message = receiver.recv(1.5 if frames else 30.0)
        if message is None:
            break
        frames += 1
    pipe.send({"frames": frames, "cpu_seconds": time.process_time() - cpu})
    receiver.shutdown()


def full_speed() -> list[Row]:
    """Measure a 2.5 h log through the bus."""
    path = shared_file("replay", "leaf2012_reconstruction_white.parquet")
    with service(bus(), "--time-source", "replay-clock", until_idle_s=1.0) as process:
        done = subprocess.run(
            command(bus(), "replay", path, "--speed", "max"),
            capture_output=True,
            text=True,
            check=True,
        )
        out, _ = process.communicate(timeout=60)
    replay, run = json.loads(done.stdout), json.loads(out)
    lost = replay["samples"] - run["samples"]
    return [
        ("log", f"{replay['log_seconds'] / 3600:.2f} h, {replay['samples']} samples", ""),
        ("time through the bus", f"{replay['seconds']:.1f} s", "< 60 s"),
        ("samples lost", str(lost), "0"),
        ("CPU of `cangauge run`", f"{run['cpu_seconds']:.1f} s", ""),
        ("step, mean", f"{1e6 * run['step']['mean_s']:.0f} µs", ""),
    ]


def offline() -> list[Row]:
    """Measure the same log offline."""
    began = time.monotonic()
    log = long_log()
    read_s = time.monotonic() - began
    settings = EstimatorSettings(temperature_source=log.temperature_source)
    _, scores = estimate_log(log, Model.load(MODEL), settings)
    return [
        ("log", f"{log.duration_s / 3600:.2f} h, {len(log)} samples", ""),
        ("estimation", f"{scores.seconds:.2f} s", "< 5 s"),
        ("reading", f"{read_s:.2f} s", ""),
    ]


def timing(seconds: float = 120.0) -> list[Row]:
    """Measure a capture in real time: 100 frames/s of the battery, 100 others."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "capture.log"
        rng = np.random.default_rng(1)
        stamps = np.sort(rng.uniform(0.0, seconds, int(200 * seconds) - 2))
        with closing(Recorder(path)) as recorder:
            for stamp in [0.0, *stamps.tolist(), seconds]:
                recorder.on_frame(
                    can.Message(timestamp=1.7e9 + stamp, arbitration_id=0x1F2, is_extended_id=False)
                )
        done = subprocess.run(
            command(bus(), "replay", path), capture_output=True, text=True, check=True
        )
    replay: Result = json.loads(done.stdout)
    return [
        ("capture", f"{replay['log_seconds']:.3f} s, {replay['frames']} frames", ""),
        ("duration of the replay", f"{replay['seconds']:.3f} s", f"{seconds:.1f} ± 0.1 s"),
    ]


def memory(hours: float = 24.0) -> list[Row]:
    """Measure the memory of a process over a day of bus time."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_handle_a_day, args=(theirs, hours))
    process.start()
    result: Result = ours.recv()
    process.join()
    return [
        ("bus time, samples", f"{hours:.0f} h, {result['samples']}", ""),
        ("memory after half an hour", f"{result['mb_first']:.1f} MB", ""),
        ("memory at the end", f"{result['mb_last']:.1f} MB", ""),
        ("growth", f"{result['mb_last'] - result['mb_first']:+.2f} MB", "flat"),
        ("computation", f"{result['seconds']:.0f} s", ""),
    ]


def _handle_a_day(pipe: Any, hours: float) -> None:
    vehicle = Vehicle.load("generic")
    pipeline = Pipeline(vehicle, Model.load(MODEL), PipelineSettings())
    encoder = FrameEncoder(vehicle)
    log = long_log()
    columns = (log.current_a.tolist(), log.voltage_v.tolist(), log.temperature_c.tolist())
    rows = itertools.cycle(list(zip(*columns, strict=True)))
    for _ in range(len(log)):  # itertools.cycle stores its items: fill it before measuring
        next(rows)
    began, first = time.monotonic(), math.nan
    total = int(hours * 36_000)
    for number in range(total):
        sample = Sample(1.7e9 + 0.1 * number, *next(rows))
        for frame in encoder.encode(sample):
            pipeline.handle(frame)
        pipeline.heartbeat()
        if number == min(18_000, total // 2):
            first = _resident_mb()
    pipe.send(
        {
            "samples": pipeline.samples,
            "mb_first": first,
            "mb_last": _resident_mb(),
            "seconds": time.monotonic() - began,
        }
    )


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the load")
    parser.add_argument("--keep", action="store_true", help="keep the figures for the page")
    parts: dict[str, Callable[[], list[Row]]] = {
        "load": lambda: load(options.seconds),
        "max": full_speed,
        "offline": offline,
        "timing": timing,
        "memory": memory,
    }
    parser.add_argument("--only", action="append", choices=list(parts), help="repeat for several")
    options = parser.parse_args()
    table = Table("part", "", "measured", "target")
    for name in options.only or parts:
        sys.stderr.write(f"measuring: {name} …\n")
        for row in parts[name]():
            table.add_row(name, *row)
    publish("bus-load", [table], ["src/cangauge/bus", "src/cangauge/service"], keeps=options.keep)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
