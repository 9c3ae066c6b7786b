"""CPU time and memory of the live page, beside the service without it.

    python benchmarks/live_page.py [--minutes 10] [--case NAME]... [--keep]

1,000 wanted frames/s by UDP multicast on this machine; `cangauge run` without the page, with it and
no viewer, with it and one viewer in headless Chromium, with it and four of which three only listen.
The cases run side by side, so that other work on the machine counts for each. Linux only: CPU time
and memory are read from /proc.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

from rich.table import Table
from tornado.websocket import websocket_connect

from cangauge.bus.open import BusAddress, bus_address, open_bus
from cangauge.bus.vehicle import Vehicle
from cangauge.replay.encoder import FrameEncoder
from cangauge.replay.player import Pacer
from cangauge.types import Sample
from figures import publish
from live_service import service

FRAMES_PER_S: Final = 1000
GROUP: Final = "239.74.163.92"
BUS_PORT: Final = 43_561
PAGE_PORT: Final = 18_643
"""Ports of the first case; each further one has the next."""
WARM_S: Final = 10.0
"""Time from the first viewer to the measurement [s]."""
TICK_S: Final = 1.0 / os.sysconf("SC_CLK_TCK")
CASES: Final = {
    "without the page": (False, 0, 0),
    "page, no viewer": (True, 0, 0),
    "page, one viewer in Chromium": (True, 1, 0),
    "page, four viewers": (True, 1, 3),
}


def children(process: int) -> list[int]:
    """Return the ids of a process and all its descendants."""
    parents: dict[int, int] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int(_fields(int(folder.name))[1])
        except OSError:  # ended in the meantime
            continue
    found = [process]
    for each in found:
        found += [child for child, parent in parents.items() if parent == each]
    return found


def _fields(process: int) -> list[str]:
    return Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()


def cpu_s(processes: list[int]) -> float:
    """Return the CPU time of processes [s]."""
    return sum(TICK_S * (int(f[11]) + int(f[12])) for f in map(_fields, processes))


def memory_mb(processes: list[int]) -> float:
    """Return the memory that belongs to these processes alone or in part [MB]."""
    total = 0
    for each in processes:
        lines = Path(f"/proc/{each}/smaps_rollup").read_text(encoding="utf-8").splitlines()
        total += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total / 1e3


@contextmanager
def frames(address: BusAddress) -> Iterator[None]:
    """Send wanted frames from a thread."""
    done = threading.Event()

    def send() -> None:
        encoder, bus, sent = FrameEncoder(Vehicle.load("generic")), open_bus(address), 0
        pacer = Pacer(1.0, done.is_set)
        pacer.wait(0)
        while not done.is_set():
            time_s = sent / FRAMES_PER_S
            current_a = 20.0 + 10.0 * math.sin(time_s)
            for frame in encoder.encode(Sample(time_s, current_a, 380.0, 25.0)):
                bus.send(frame)
                sent += 1
            pacer.wait(int(sent * 1e6 / FRAMES_PER_S))
        bus.shutdown()

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


@contextmanager
def chromium(port: int) -> Iterator[Any]:
    """Open the page in headless Chromium; yield its driver."""
    from selenium import webdriver  # noqa: PLC0415 - an extra of development

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        options = webdriver.ChromeOptions()
        for argument in ("headless", "no-sandbox", "disable-gpu", f"user-data-dir={folder}"):
            options.add_argument(f"--{argument}")
        driver = webdriver.Chrome(
            options=options,
            service=webdriver.ChromeService(executable_path=shutil.which("chromedriver")),
        )
        driver.get(f"http://127.0.0.1:{port}/")
        try:
            yield driver
        finally:
            driver.quit()


@contextmanager
def listener(port: int) -> Iterator[None]:
    """Listen as a viewer does, without drawing."""
    done = threading.Event()

    async def listen() -> None:
        stream = await websocket_connect(f"ws://127.0.0.1:{port}/stream")
        await stream.write_message('{"span": "10min"}')
        while not done.is_set():
            json.loads(str(await stream.read_message()))
        stream.close()

    thread = threading.Thread(target=lambda: asyncio.run(listen()))
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def measure(number: int, case: str, seconds: float) -> dict[str, Any]:
    """Return CPU [% of a core] and memory [MB] of service, page and browser."""
    has_page, browsers, listeners = CASES[case]
    address = bus_address("udp_multicast", GROUP, {"port": BUS_PORT + number})
    port = PAGE_PORT + number
    arguments = ["--initial-soc", "70", "--status-socket", f"/tmp/live-page-{number}.sock"]  # noqa: S108
    arguments += ["--dashboard", str(port)] if has_page else []
    running = service(address, *arguments, until_idle_s=3.0)
    with running as process, frames(address), ExitStack() as stack:
        time.sleep(5.0)
        groups = {"service": [process.pid]}
        if has_page:
            groups["page"] = children(process.pid)[1:]
        viewers = [stack.enter_context(chromium(port)) for _ in range(browsers)]
        for _ in range(listeners):
            stack.enter_context(listener(port))
        time.sleep(WARM_S)
        if viewers:
            groups["browser"] = children(viewers[0].service.process.pid)
        before = {name: cpu_s(each) for name, each in groups.items()}
        first = {name: memory_mb(each) for name, each in groups.items()}
        began = time.monotonic()
        time.sleep(seconds)
        took = time.monotonic() - began
        used = {name: 100.0 * (cpu_s(each) - before[name]) / took for name, each in groups.items()}
        memory = {name: memory_mb(each) for name, each in groups.items()}
    return {"cpu_pct": used, "memory_mb": memory, "memory_at_first_mb": first}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--case", choices=CASES, action="append", help="default: all")
    parser.add_argument("--keep", action="store_true", help="keep the figures for the page")
    given = parser.parse_args()
    cases = given.case or list(CASES)
    with ThreadPoolExecutor(len(cases)) as pool:
        jobs = [
            pool.submit(measure, number, case, 60.0 * given.minutes)
            for number, case in enumerate(cases)
        ]
        results = {case: job.result() for case, job in zip(cases, jobs, strict=True)}
    table = Table(
        "",
        "service",
        "page",
        "browser",
        title="CPU [% of a core], memory at first → at the end [MB]",
    )
    for case, result in results.items():
        cells = [
            f"{result['cpu_pct'][name]:.1f} %, {result['memory_at_first_mb'][name]:.0f}"
            f" → {result['memory_mb'][name]:.0f} MB"
            if name in result["cpu_pct"]
            else "–"
            for name in ("service", "page", "browser")
        ]
        table.add_row(case, *cells)
    describes = ["src/cangauge/service", "src/cangauge/extras/live"]
    publish("live-page", [table], describes, keeps=given.keep)


if __name__ == "__main__":
    main()
