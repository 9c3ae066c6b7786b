"""A service ends soon after SIGTERM, and publishes until then, whatever its files do."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import can
import pytest

from cangauge.service import estimate_table
from cangauge.service.estimate_table import EstimateWriter
from cangauge.service.lifecycle import END_WITHIN_S
from cangauge.service.pipeline import NOTHING_YET
from cangauge.types import Sample
from live import COMMAND, leaf_model_path, waits

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="sizes of pipes are Linux's")
GROUP = "239.74.163.79"


@pytest.fixture
def full_pipe() -> tuple[int, int]:
    """A pipe that takes nothing more: its reader has stopped."""
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    os.set_blocking(writer, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writer, b"x" * 512)
    os.set_blocking(writer, True)
    return reader, writer


def test_a_stopped_reader_of_its_messages_stops_nothing(full_pipe: tuple[int, int]) -> None:
    port = 44_900 + os.getpid() % 90
    bus = ("--interface", "udp_multicast", "--channel", GROUP, "--bus-option", f"port={port}")
    arguments = [str(each) for each in ("run", "-m", leaf_model_path(), *bus)]
    with can.Bus(interface="udp_multicast", channel=GROUP, port=port) as watcher:
        service = subprocess.Popen([sys.executable, "-c", COMMAND, *arguments], stderr=full_pipe[1])
        assert waits(lambda: watcher.recv(0.1) is not None)
        service.terminate()
        assert service.wait(END_WITHIN_S + 54.0) == 0
    for each in full_pipe:
        os.close(each)


def test_whatever_hangs_ends_after_the_signal(full_pipe: tuple[int, int]) -> None:
    code = (
        "import os, sys\n"
        "from cangauge.service.lifecycle import deadline_after_signal, stop_on_signals\n"
        "with deadline_after_signal(0.3), stop_on_signals():\n"
        "    sys.stderr.write('ready'); sys.stderr.flush()\n"
        "    os.write(1, b'x' * 100000)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=full_pipe[1], stderr=subprocess.PIPE
    )
    assert process.stderr is not None
    assert process.stderr.read(5) == b"ready"
    time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60.0) == 1
    process.stderr.close()
    for each in full_pipe:
        os.close(each)


def test_without_a_signal_there_is_no_deadline() -> None:
    code = (
        "import os, signal, time\n"
        "from cangauge.service.lifecycle import deadline_after_signal, stop_on_signals\n"
        "with stop_on_signals() as stopped:\n"
        "    with deadline_after_signal(0.2):\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n"
        "    time.sleep(0.5)\n"
        "    assert stopped()\n"
        "with deadline_after_signal(0.2):\n"
        "    time.sleep(0.5)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=20.0, check=False).returncode == 0


def test_a_table_on_a_hanging_disk_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate_table, "_CLOSE_WITHIN_S", 0.2)
    hanging = threading.Event()
    with EstimateWriter(tmp_path / "t.csv") as writer:
        monkeypatch.setattr(writer, "_write", lambda _: hanging.wait(300.0))
        writer.on_sample(Sample(0.0, 1.0, 380.0, 20.0), NOTHING_YET)
    assert writer.failed
    assert not list(tmp_path.iterdir())
    hanging.set()
