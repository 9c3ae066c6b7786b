"""The service in a process of its own: started, signalled, and watched for an end unasked for.

Processes are forked from one that has imported the service already (multiprocessing's
forkserver), so that many can be started at once; `cold` starts a fresh interpreter, as a
supervisor would.
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
"""Takes the arguments of the command line; importable by name."""

CONTEXT: Final = multiprocessing.get_context("forkserver")
PRELOAD: Final = [
    "faults.process",
    "cangauge.cli.app",
    "cangauge.cli.run",
    "cangauge.estimate.ekf",
    "can.interfaces.udp_multicast",
    "can.interfaces.socketcan",
]
_COLD: Final = "import sys; from cangauge.cli.app import main; main()"
_STARTING: Final = threading.Lock()


def cangauge(arguments: list[str]) -> None:
    """Run the command line."""
    from cangauge.cli.app import main  # noqa: PLC0415 - in the service's process alone

    sys.argv = ["cangauge", *arguments]
    main()


def prepare() -> None:
    """Let the server of processes import what they need; the first start then is quick."""
    os.environ["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    CONTEXT.set_forkserver_preload(PRELOAD)
    warm = CONTEXT.Process(target=_nothing)
    warm.start()
    warm.join()


class Process:
    """One service.

    Parameters
    ----------
    arguments : list of str
    log : Path
        Takes stdout and stderr of all its starts.
    target : callable
    cold : bool
        In a fresh interpreter; for `cangauge` only.
    """

    def __init__(
        self, arguments: list[str], log: Path, target: Target = cangauge, *, cold: bool = False
    ) -> None:
        self._arguments = arguments
        self._log = log
        self._target = target
        self._cold = cold
        self._child: BaseProcess | subprocess.Popen[bytes] | None = None
        self._asked = False
        self.started_s = 0.0
        self.stop_seconds: list[float] = []
        """How long it took to end when told so by SIGTERM [s]."""
        self.troubles: list[str] = []
        """Ends that nobody asked for, and other ends than by exit status 0."""

    def start(self) -> None:
        """Start it."""
        self._asked = False
        if self._cold:
            with self._log.open("ab") as out:
                self._child = subprocess.Popen(
                    [sys.executable, "-c", _COLD, *self._arguments], stdout=out, stderr=out
                )
        else:
            child = CONTEXT.Process(
                target=_enter, args=(self._target, self._arguments, str(self._log))
            )
            with _STARTING:
                child.start()
            self._child = child
        self.started_s = time.monotonic()

    def signal(self, number: signal.Signals) -> None:
        """Send it a signal; one that is gone already is noted as trouble by `check`."""
        if self.check() and self._child is not None and self._child.pid is not None:
            os.kill(self._child.pid, number)

    def kill(self) -> None:
        """End it by SIGKILL and wait."""
        if self.check() and self._child is not None:
            self._asked = True
            self._child.kill()
            self._wait(10.0)

    def stop(self, seconds: float = 10.0) -> None:
        """Ask it by SIGTERM to end; one that does not is killed and noted."""
        if not self.check() or self._child is None:
            return
        self._asked = True
        began = time.monotonic()
        self._child.terminate()
        code = self._wait(seconds)
        if code is None:
            self.troubles.append(f"did not end within {seconds:.0f} s of SIGTERM")
            self._child.kill()
            self._wait(10.0)
            return
        self.stop_seconds.append(time.monotonic() - began)
        if code != 0:
            self.troubles.append(f"exit status {code} after SIGTERM")

    def check(self) -> bool:
        """Return whether it runs; an end that nobody asked for is noted, once."""
        code = self._code()
        if code is None:
            return self._child is not None
        if not self._asked and self._child is not None:
            self._asked = True
            self.troubles.append(f"ended by itself, status {code}")
        return False

    def said(self) -> str:
        """Return what it wrote."""
        return self._log.read_text(errors="replace") if self._log.exists() else ""

    def _code(self) -> int | None:
        child = self._child
        if child is None:
            return 0
        return child.poll() if isinstance(child, subprocess.Popen) else child.exitcode

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
