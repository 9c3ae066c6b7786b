"""Process of the service: start, signals, and detection of an unexpected end.

Processes are forked from one that has imported the service (multiprocessing's forkserver), so that
many start quickly.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Final

Target = Callable[[list[str]], None]
"""Entry point with command line arguments; importable by name."""

CONTEXT: Final = multiprocessing.get_context("forkserver")
PRELOAD: Final = [
    "faults.process",
    "faults.stamps",
    "cangauge.cli.app",
    "cangauge.cli.run",
    "cangauge.estimation.ekf",
    "can.interfaces.udp_multicast",
    "can.interfaces.socketcan",
]
_COMMAND: Final = "from cangauge.__main__ import main; main()"
_CHILDREN: Final = threading.Lock()
"""Held while a process starts and while its status is read: a start reads the status of every
process that has ended, and it can be read only once."""


def cangauge(arguments: list[str]) -> None:
    """Run the command line."""
    from cangauge.cli.app import main  # noqa: PLC0415 - in the service's process alone

    sys.argv = ["cangauge", *arguments]
    main()


def prepare() -> None:
    """Start the fork server and let it import the service."""
    os.environ["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    CONTEXT.set_forkserver_preload(PRELOAD)
    warm = CONTEXT.Process(target=_nothing)
    warm.start()
    warm.join()


def run_command(arguments: list[str]) -> int:
    """Run a command in a fresh interpreter; return its exit status."""
    return subprocess.run(
        [sys.executable, "-c", _COMMAND, *arguments], capture_output=True, timeout=60.0, check=False
    ).returncode


class Process:
    """One service.

    Parameters
    ----------
    arguments : list of str
    log : Path
        Receives stdout and stderr.
    target : callable
    """

    def __init__(self, arguments: list[str], log: Path, target: Target = cangauge) -> None:
        self._arguments = arguments
        self._log = log
        self._target = target
        self._child: BaseProcess | None = None
        self._stop_requested = False
        self.started_s = 0.0
        self.stop_seconds: list[float] = []
        """Times from SIGTERM to the end [s]."""
        self.incidents: list[str] = []
        """Unexpected ends, and exit statuses other than 0."""

    def start(self) -> None:
        """Start the process."""
        self._stop_requested = False
        child = CONTEXT.Process(target=_enter, args=(self._target, self._arguments, str(self._log)))
        with _CHILDREN:
            child.start()
        self._child = child
        self.started_s = time.monotonic()

    def signal(self, number: signal.Signals) -> None:
        """Send a signal, if the process runs."""
        if self.check() and self._child is not None and self._child.pid is not None:
            os.kill(self._child.pid, number)

    def kill(self) -> None:
        """Kill the process and wait for its end."""
        if self.check() and self._child is not None:
            self._stop_requested = True
            self._child.kill()
            self._wait(10.0)

    def stop(self, seconds: float = 10.0) -> None:
        """Stop the process by SIGTERM; after a time-out kill it and record the incident."""
        if not self.check() or self._child is None:
            return
        self._stop_requested = True
        began = time.monotonic()
        self._child.terminate()
        code = self._wait(seconds)
        if code is None:
            self.incidents.append(f"did not end within {seconds:.0f} s of SIGTERM")
            self._child.kill()
            self._wait(10.0)
            return
        self.stop_seconds.append(time.monotonic() - began)
        if code != 0:
            self.incidents.append(f"exit status {code} after SIGTERM")

    def check(self) -> bool:
        """Return whether the process runs; record an unexpected end once."""
        code = self._code()
        if code is None:
            return self._child is not None
        if not self._stop_requested and self._child is not None:
            self._stop_requested = True
            self.incidents.append(f"ended by itself, status {code}")
        return False

    def output(self) -> str:
        """Return the output of the process."""
        return self._log.read_text(errors="replace") if self._log.exists() else ""

    def _code(self) -> int | None:
        if self._child is None:
            return 0
        with _CHILDREN:
            return self._child.exitcode

    def _wait(self, seconds: float) -> int | None:
        until = time.monotonic() + seconds
        while (code := self._code()) is None and time.monotonic() < until:
            time.sleep(0.005)
        return code


def _nothing() -> None:
    pass


def _enter(target: Target, arguments: list[str], log: str) -> None:
    out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(out, 1)
    os.dup2(out, 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    target(arguments)
