"""Latency from a frame to its SoC, and frames lost at high rates, compared with a bare loop.

    python benchmarks/latency.py [--only latency|loss]… [--interface I --channel C]
                                 [--seconds 20] [--rounds 3] [--minutes 10] [--bare-minutes 10]
                                 [--highest HZ] [--wanted SHARE]… [--json]

latency  1,000 wanted frames/s (current and voltage at 500 Hz each, and REPLAY_CLOCK). SOC_DETAIL
         has the number of samples, which identifies the frame that completed the last of them;
         both times are kernel stamps at one listener. In alternation with a bare python-can loop
         that receives, decodes by cantools and sends as often.
loss     finds the highest rate that a bare python-can receive loop carries without loss; then the
         service receives that rate for --minutes, and after it the bare loop again. Twice: with 5 %
         of the frames wanted, as on a car's bus, and with all of them. Exit status 1 if the service
         lost a frame and the bare loop did not, or if its memory grew by more than 5 % from its
         first tenth to the end.

On UDP multicast on this machine, or on SocketCAN (`--interface socketcan --channel vcan0`). The
service listens before the first frame, so start-up does not count.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import multiprocessing.pool
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import can
import cantools
import numpy as np
from rich.console import Console
from rich.table import Table

from cangauge._resources import shared_file
from cangauge.bus.open import BusAddress, bus_address, open_bus
from cangauge.bus.time_source import clock_frame
from cangauge.bus.vehicle import Vehicle
from cangauge.replay.encoder import FrameEncoder
from cangauge.replay.player import Pacer
from cangauge.types import Sample
from faults.line import udp
from live_service import service

SOC_DETAIL_ID: Final = 0x5A1
SAMPLES_MODULO: Final = 1 << 16
"""Modulus of the sample count in SOC_DETAIL."""
SAMPLE_HZ: Final = 500
"""Sample rate; two wanted frames each [Hz]."""
BARE_EVERY: Final = 4
"""Samples between frames of the bare loop, as the service acknowledges."""
LARGEST_GROWTH: Final = 0.05
WARM_S: Final = 1.0
"""Excluded start of each round [s]."""
WANTED_SHARE: Final = 0.05
"""Share of wanted frames on a car's bus: 200 of 4,000."""
TRY_S: Final = 4.0
"""Duration of a trial of a rate; longer than the socket buffer can bridge [s]."""
HIGHEST_HZ: Final = 64_000.0

CONTEXT: Final = multiprocessing.get_context("spawn")
Result = dict[str, Any]


def latency(address: BusAddress, seconds: float, rounds: int) -> Result:
    """Measure service and bare loop in alternation."""
    found: dict[str, list[float]] = {"service": [], "bare": []}
    for number in range(rounds):
        sys.stderr.write(f"latency: round {number + 1} of {rounds} …\n")
        with service(address, "--time-source", "replay-clock"):
            found["service"] += _latencies(address, seconds)
        with _bare(address, _echo):
            found["bare"] += _latencies(address, seconds)
    result: Result = {}
    for name, values in found.items():
        if not values:
            raise SystemExit(f"{name}: nothing was published")
        p50, p99 = np.percentile(values, [50, 99]).tolist()
        result[name] = {"count": len(values), "p50_us": 1e6 * p50, "p99_us": 1e6 * p99}
    for key in ("p50_us", "p99_us"):
        result[f"{key[:3]}_ratio"] = result["service"][key] / result["bare"][key]
    return result


def _latencies(address: BusAddress, seconds: float) -> list[float]:
    """Return the times from the last frame of a sample to its SOC_DETAIL [s]."""
    listener = open_bus(address)
    sender = CONTEXT.Process(target=_send_samples, args=(address, seconds))
    sender.start()
    layout = _messages()[SOC_DETAIL_ID]
    done_s: list[float] = []
    found: list[tuple[int, float]] = []
    first: float | None = None
    while (message := listener.recv(1.5 if done_s else 30.0)) is not None:
        if message.arbitration_id == 0x401:
            done_s.append(message.timestamp)
            first = first or message.timestamp
            continue
        if message.arbitration_id != SOC_DETAIL_ID or first is None:
            continue
        samples = int(layout.decode(message.data)["samples"])
        # Unwrap the count, which is close to the number of samples sent.
        number = len(done_s) - (len(done_s) - samples) % SAMPLES_MODULO
        is_new = 0 < number <= len(done_s) and len(done_s) - number < SAMPLE_HZ
        if is_new and done_s[number - 1] > first + WARM_S:
            found.append((number, message.timestamp - done_s[number - 1]))
        if message.timestamp - done_s[-1] > 1.0:
            break  # from here on the service only repeats frames
    sender.join()
    listener.shutdown()
    # The heartbeat repeats a count: its first frame is that of the sample.
    return list(dict(reversed(found)).values())


def _send_samples(address: BusAddress, seconds: float) -> None:
    encoder = FrameEncoder(Vehicle.load("generic"))
    bus, pacer = open_bus(address), Pacer(1.0, lambda: False)
    for number in range(int(seconds * SAMPLE_HZ)):
        time_us = number * 1_000_000 // SAMPLE_HZ
        time_s = time_us / 1e6
        frames = encoder.encode(Sample(time_s, 20.0 + 10.0 * math.sin(time_s), 380.0, 25.0))
        pacer.wait(time_us)
        bus.send(clock_frame(time_us))
        for frame in frames:
            bus.send(frame)
    time.sleep(0.2)
    bus.shutdown()


@contextmanager
def _bare(address: BusAddress, loop: Any) -> Iterator[Connection]:
    ours, theirs = CONTEXT.Pipe()
    process = CONTEXT.Process(target=loop, args=(theirs, address), daemon=True)
    process.start()
    ours.recv()
    try:
        yield ours
    finally:
        process.kill()
        process.join()


def _echo(pipe: Connection, address: BusAddress) -> None:
    """Receive, decode and send: the minimum work of a service."""
    messages = _messages()
    wanted = [0x400, 0x401, 0x402, 0x403, 0x5AF]
    filters = [{"can_id": each, "can_mask": 0x7FF, "extended": False} for each in wanted]
    bus, samples = open_bus(address, filters), 0
    detail = messages[SOC_DETAIL_ID]
    nothing = {signal.name: 0.0 for signal in detail.signals}
    pipe.send("ready")
    while True:
        message = bus.recv(1.0)
        if message is None:
            continue
        messages[message.arbitration_id].decode(message.data)
        if message.arbitration_id != 0x401:
            continue
        samples += 1
        if samples % BARE_EVERY == 0:
            values = {**nothing, "samples": samples % SAMPLES_MODULO}
            data = detail.encode(values, strict=False)
            bus.send(can.Message(arbitration_id=SOC_DETAIL_ID, is_extended_id=False, data=data))


def _messages() -> dict[int, cantools.database.can.Message]:
    """Return the messages of the DBC files by id."""
    found = {}
    for name in ("generic_pack.dbc", "soc_estimate.dbc"):
        database = cantools.database.load_file(shared_file("dbc", name))
        found |= {each.frame_id: each for each in database.messages}
    return found


@dataclass(frozen=True)
class Sent:
    """Frames that a sender sent."""

    frames: int
    wanted: int
    seconds: float

    @property
    def rate_hz(self) -> float:
        """Frame rate [1/s]."""
        return self.frames / self.seconds


def loss(
    address: BusAddress,
    seconds: float,
    bare_seconds: float,
    shares: list[float],
    highest_hz: float,
) -> Result:
    """Measure the loss of the service, then of the bare loop, at the highest rate of the latter."""
    result: Result = {}
    for share in shares:
        name = "all wanted" if share == 1.0 else f"{100.0 * share:.0f} % wanted"
        rate_hz = highest_rate(address, share, highest_hz)
        sys.stderr.write(f"loss, {name}: {rate_hz:.0f} frames/s for {seconds:.0f} s …\n")
        with service(address, until_idle_s=5.0) as process:
            watched = multiprocessing.pool.ThreadPool(1).apply_async(_sizes_mb, (process,))
            sent = _send(address, rate_hz, seconds, share)
            out, _ = process.communicate(timeout=seconds + 120.0)
        sizes_mb = watched.get()
        run = json.loads(out)
        # The bare loop again for longer: it carried the rate for a moment only.
        bare, bare_got = _bare_count(address, rate_hz, bare_seconds, share)
        result[name] = {
            "rate_hz": sent.rate_hz,
            "seconds": sent.seconds,
            "frames": sent.frames,
            "wanted": sent.wanted,
            "wanted_lost": sent.wanted - run["frames"]["received"],
            "bare_seconds": bare.seconds,
            "bare_lost": bare.wanted - bare_got,
            "cpu_share": run["cpu_seconds"] / sent.seconds,
            "resident_mb": [sizes_mb[len(sizes_mb) // 10], sizes_mb[-1]],
        }
    return result


def _sizes_mb(process: subprocess.Popen[str]) -> list[float]:
    """Return the resident memory of a process each second until it ends [MB]."""
    page_mb, sizes_mb = os.sysconf("SC_PAGE_SIZE") / 1e6, []
    while process.poll() is None:
        pages = Path(f"/proc/{process.pid}/statm").read_text().split()[1]
        sizes_mb.append(int(pages) * page_mb)
        time.sleep(1.0)
    return [size for size in sizes_mb if size > 0.0]


def highest_rate(address: BusAddress, share: float, highest_hz: float = HIGHEST_HZ) -> float:
    """Find the highest rate that the bare loop carries without loss, to 10 % [frames/s]."""
    good, rate_hz, bad = 0.0, min(2000.0, highest_hz), 1.1 * highest_hz
    while good < highest_hz and bad > 1.1 * max(good, 1.0):
        sent, got = _bare_count(address, rate_hz, TRY_S, share)
        is_carried = got == sent.wanted and sent.rate_hz > 0.95 * rate_hz
        sys.stderr.write(
            f"  bare loop at {rate_hz:.0f}/s: sent {sent.rate_hz:.0f}/s,"
            f" {sent.wanted - got} of {sent.wanted} lost\n"
        )
        if is_carried:
            good = rate_hz
            rate_hz = min(2.0 * rate_hz, 0.5 * (good + bad), highest_hz)
        else:
            bad = rate_hz
            rate_hz = 0.5 * (good + bad)
    return good


def _bare_count(
    address: BusAddress, rate_hz: float, seconds: float, share: float
) -> tuple[Sent, int]:
    with _bare(address, _count) as pipe:
        sent = _send(address, rate_hz, seconds, share)
        got: int = pipe.recv()
    return sent, got


def _count(pipe: Connection, address: BusAddress) -> None:
    """Count wanted frames until none arrives for two seconds."""
    filters = [{"can_id": 0x400, "can_mask": 0x7FE, "extended": False}]
    bus, frames = open_bus(address, filters), 0
    pipe.send("ready")
    while bus.recv(2.0 if frames else 60.0) is not None:
        frames += 1
    pipe.send(frames)


def _send(address: BusAddress, rate_hz: float, seconds: float, share: float) -> Sent:
    ours, theirs = CONTEXT.Pipe()
    process = CONTEXT.Process(target=_flood, args=(theirs, address, rate_hz, seconds, share))
    process.start()
    sent: Sent = ours.recv()
    process.join()
    return sent


def _flood(
    pipe: Connection, address: BusAddress, rate_hz: float, seconds: float, share: float
) -> None:
    """Send current and voltage alternately among foreign frames, evenly."""
    encoder, bus = FrameEncoder(Vehicle.load("generic")), open_bus(address, [])
    every = round(1.0 / share)
    # Encoded in advance: the frames repeat after 16 samples, as the counters do.
    ready = [
        frame
        for number in range(16)
        for frame in encoder.encode(Sample(float(number), 20.0, 380.0, math.nan))
    ]
    other = can.Message(arbitration_id=0x123, is_extended_id=False, data=bytes(8))
    pacer, began, wanted = Pacer(1.0, lambda: False), time.monotonic(), 0
    total = int(rate_hz * seconds)
    burst = max(round(rate_hz / 1000.0), 1)
    pacer.wait(0)
    for number in range(total):
        if number % every == 0:
            _put(bus, ready[wanted % len(ready)])
            wanted += 1
        else:
            _put(bus, other)
        if number % burst == 0:
            pacer.wait(round(number * 1e6 / rate_hz))
    pipe.send(Sent(total, wanted, time.monotonic() - began))
    bus.shutdown()


def _put(bus: can.BusABC, frame: can.Message) -> None:
    while True:
        try:
            bus.send(frame)
        except can.CanOperationError as error:
            if "buffer" not in str(error).lower():
                raise
            time.sleep(0.0005)
        else:
            return


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--only", action="append", choices=("latency", "loss"))
    parser.add_argument("--interface", default="udp_multicast")
    parser.add_argument("--channel")
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of a latency round")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument(
        "--minutes", type=float, default=1.0, help="duration of the loss part (target: 10)"
    )
    parser.add_argument(
        "--bare-minutes", type=float, help="duration of the bare loop after it; default: the same"
    )
    parser.add_argument(
        "--highest", type=float, default=HIGHEST_HZ, metavar="HZ",
        help="upper end of the search; a 1 Mbit/s bus carries less than 20,000 frames/s",
    )  # fmt: skip
    parser.add_argument(
        "--wanted", action="append", type=float, help="shares of wanted frames; default: 0.05 and 1"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    more = udp(0).options if options.interface == "udp_multicast" else {}
    address = bus_address(options.interface, options.channel, more)
    parts = options.only or ["latency", "loss"]
    result: Result = {"bus": str(address)}
    if "latency" in parts:
        result["latency"] = latency(address, options.seconds, options.rounds)
    if "loss" in parts:
        seconds = 60.0 * options.minutes
        bare_seconds = seconds if options.bare_minutes is None else 60.0 * options.bare_minutes
        shares = options.wanted or [WANTED_SHARE, 1.0]
        result["loss"] = loss(address, seconds, bare_seconds, shares, options.highest)
    if options.json:
        sys.stdout.write(json.dumps(result) + "\n")
    else:
        _show(result, Console())
    found = result.get("loss", {}).values()
    return int(any(map(_has_failed, found)))


def _has_failed(found: Result) -> bool:
    """Whether frames were lost that the bare loop took, or the memory grew."""
    first, last = found["resident_mb"]
    is_lost = found["wanted_lost"] > 0 and found["bare_lost"] == 0
    return is_lost or last > (1.0 + LARGEST_GROWTH) * first


def _show(result: Result, console: Console) -> None:
    table = Table("", "service", "bare loop", "target", title=result["bus"])
    if "latency" in result:
        found = result["latency"]
        for key in ("p50", "p99"):
            wanted = "≤ 3×" if key == "p99" else ""
            table.add_row(
                f"latency at 1,000 frames/s, {key}",
                f"{found['service'][f'{key}_us']:.0f} µs ({found[f'{key}_ratio']:.2f}×)",
                f"{found['bare'][f'{key}_us']:.0f} µs",
                wanted,
            )
    for name, found in result.get("loss", {}).items():
        table.add_row(
            f"lost at {found['rate_hz']:.0f} frames/s for {found['seconds']:.0f} s, {name}",
            f"{found['wanted_lost']} of {found['wanted']} ({100 * found['cpu_share']:.0f} % CPU)",
            f"{found['bare_lost']} in {found['bare_seconds']:.0f} s",
            "0",
        )
        first, last = found["resident_mb"]
        table.add_row(
            "  memory, at first and at the end", f"{first:.1f}, {last:.1f} MB", "", "+ 5 %"
        )
    console.print(table)


if __name__ == "__main__":
    raise SystemExit(main())
