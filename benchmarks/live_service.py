"""`cangauge` commands on a bus, in separate processes, and what sends to them."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from tempfile import NamedTemporaryFile
from typing import Self

import can

from cangauge._resources import shared_file
from cangauge.bus.open import BusAddress

MODEL = shared_file("replay", "leaf2012_published_model.json")
ENTRY = "import sys; from cangauge.cli.app import main; main()"
"""Code that runs the command line."""


def command(address: BusAddress, name: str, *arguments: object) -> list[str]:
    """Return the command line of a `cangauge` command on a bus, with `--json`."""
    on = ["--interface", address.interface, "--channel", address.channel]
    for key, value in address.options.items():
        on += ["--bus-option", f"{key}={value}"]
    return [sys.executable, "-c", ENTRY, name, *map(str, arguments), *on, "--json"]


@contextmanager
def service(
    address: BusAddress, *arguments: object, until_idle_s: float | None = None
) -> Iterator[subprocess.Popen[str]]:
    """Run `cangauge run`; enter the block once it listens, and kill it afterwards."""
    with NamedTemporaryFile("w", suffix=".toml") as config:
        if until_idle_s is not None:
            config.write(f"until_idle_s = {until_idle_s}\n")
            config.flush()
        process = subprocess.Popen(
            command(address, "run", "--config", config.name, "-m", MODEL, *arguments),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            if not any("listening" in line for line in process.stderr or ()):
                raise SystemExit("cangauge run does not start")
            yield process
        finally:
            process.kill()
            process.communicate()


class Traffic(threading.Thread):
    """Sends on buses, from the start of a block to its end."""

    def __init__(self, *buses: can.BusABC) -> None:
        super().__init__(daemon=True)
        self._buses = buses
        self._over = threading.Event()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self.join()
        for bus in self._buses:
            bus.shutdown()
