"""SIGHUP: a reload, or the end if the terminal was closed."""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path

import pytest

from cangauge.service.lifecycle import reload_on_hangup, stop_on_signals
from live import leaf_model_path, waits

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP on this system")


def test_a_hangup_reloads_also_one_held_back_during_the_start() -> None:
    handler, calls = signal.getsignal(signal.SIGHUP), list[str]()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGHUP])
    try:
        signal.raise_signal(signal.SIGHUP)
        assert calls == []
        with (
            stop_on_signals(lambda: calls.append("stop")),
            reload_on_hangup(lambda: calls.append("reload")),
        ):
            assert calls == ["reload"]
            signal.raise_signal(signal.SIGHUP)
            assert calls == ["reload", "reload"]
        # Held back again: one that comes at the end does not kill the process before its result.
        assert signal.SIGHUP in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    assert signal.getsignal(signal.SIGHUP) == handler


LOOP = """
import sys, time
from cangauge.service.lifecycle import reload_on_hangup, stop_on_signals
calls, stops = [], []
with stop_on_signals(lambda: stops.append(1)), reload_on_hangup(lambda: calls.append(1)):
    print("ready", flush=True)
    until = time.monotonic() + 20.0
    while not stops and time.monotonic() < until:
        if calls:
            print("again", flush=True)
            calls.clear()
        time.sleep(0.01)
open(sys.argv[1], "w").write("stopped" if stops else "went on")
"""


def read_until(terminal: int, text: bytes) -> None:
    found = b""
    while text not in found:
        found += os.read(terminal, 1024)


@pytest.mark.skipif(sys.platform == "win32", reason="no terminals of that kind")
def test_a_closed_terminal_stops_the_process(tmp_path: Path) -> None:
    import pty  # noqa: PLC0415 - not on every system

    said = tmp_path / "said"
    child, terminal = pty.fork()
    if child == 0:
        os.execv(sys.executable, [sys.executable, "-c", LOOP, str(said)])  # noqa: S606 - no shell wanted
    read_until(terminal, b"ready")
    os.kill(child, signal.SIGHUP)
    # With its end: a terminal takes the line in parts, and one that is closed in between fails it.
    read_until(terminal, b"again\r\n")
    os.close(terminal)
    os.waitpid(child, 0)
    assert said.read_text() == "stopped"


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_terminal_closed_during_the_start_ends_it() -> None:
    import pty  # noqa: PLC0415 - not on every system

    command = [sys.executable, "-m", "cangauge", "run", "-m", str(leaf_model_path())]
    child, terminal = pty.fork()
    if child == 0:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run under nohup
        os.execv(sys.executable, command)  # noqa: S606 - no shell wanted
    process = Path(f"/proc/{child}")
    assert waits(lambda: b"\0cangauge\0" in (process / "cmdline").read_bytes())
    assert waits(lambda: "numpy" in (process / "maps").read_text())  # it loads
    os.close(terminal)
    late = threading.Timer(30.0, os.kill, (child, signal.SIGKILL))
    late.start()
    _, status = os.waitpid(child, 0)
    late.cancel()
    # 0: the service was up already on a machine that is slow to see it load.
    assert os.waitstatus_to_exitcode(status) in {-signal.SIGHUP, 0}
