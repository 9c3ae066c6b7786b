"""CPU time and memory of the live page, beside the service without it.

    python benchmarks/live_page.py [--seconds 120] [--json]

1,000 wanted frames/s by UDP multicast on this machine; `cangauge run` without the page, with it and
no viewer, with it and one viewer in headless Chromium, with it and four of which three only fetch.
Linux only: CPU time and memory are read from /proc.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.table import Table

from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.open import bus_address, open_bus
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.validity import Sample
from cangauge.replay.player import Pacer
from live_service import service

FRAMES_PER_S: Final = 1000
BUS = bus_address("udp_multicast", "239.74.163.92", {"port": 43_561})
PAGE_PORT: Final = 18_643
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
def frames() -> Iterator[None]:
    """Send wanted frames from a thread."""
    done = threading.Event()

    def send() -> None:
        encoder, bus, sent = FrameEncoder(Vehicle.load("generic")), open_bus(BUS), 0
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
def chromium() -> Iterator[Any]:
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
        driver.get(f"http://127.0.0.1:{PAGE_PORT}/")
        try:
            yield driver
        finally:
            driver.quit()


@contextmanager
def fetcher() -> Iterator[None]:
    """Ask as a viewer does, ten times a second."""
    done = threading.Event()

    def ask() -> None:
        key, after = "", 0
        while not done.wait(0.1):
            url = f"http://127.0.0.1:{PAGE_PORT}/rows?span=10min&key={key}&after={after}"
            with urllib.request.urlopen(url) as answer:
                content = json.load(answer)
            key, after = content["key"], content["added"]

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def measure(case: str, seconds: float) -> dict[str, Any]:
    """Return CPU [% of a core] and memory [MB] of service, page and browser, and the delay."""
    has_page, browsers, fetchers = CASES[case]
    arguments = ["--until-idle", "3", "--initial-soc", "70", "--status-socket", "off"]
    arguments += ["--dashboard", str(PAGE_PORT)] if has_page else []
    with service(BUS, *arguments) as process, frames():
        with ExitStack() as stack:
            time.sleep(5.0)
            groups = {"service": [process.pid]}
            if has_page:
                groups["page"] = children(process.pid)[1:]
            viewers = [stack.enter_context(chromium()) for _ in range(browsers)]
            for _ in range(fetchers):
                stack.enter_context(fetcher())
            time.sleep(10.0)
            if viewers:
                groups["browser"] = children(viewers[0].service.process.pid)
            before = {name: cpu_s(each) for name, each in groups.items()}
            began = time.monotonic()
            time.sleep(seconds)
            took = time.monotonic() - began
            used = {
                name: 100.0 * (cpu_s(each) - before[name]) / took for name, each in groups.items()
            }
            memory = {name: memory_mb(each) for name, each in groups.items()}
        return {"cpu_pct": used, "memory_mb": memory}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    results = {case: measure(case, given.seconds) for case in CASES}
    if given.json:
        print(json.dumps(results))
        return
    table = Table("", "service", "page", "browser", title="CPU [% of a core], memory [MB]")
    for case, result in results.items():
        cells = [
            f"{result['cpu_pct'][name]:.1f} %, {result['memory_mb'][name]:.0f} MB"
            if name in result["cpu_pct"]
            else "–"
            for name in ("service", "page", "browser")
        ]
        table.add_row(case, *cells)
    Console().print(table)


if __name__ == "__main__":
    main()
