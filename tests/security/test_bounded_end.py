"""A service ends after SIGTERM, and publishes until then, while its reader stands."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
from contextlib import suppress

import can
import pytest

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
        assert service.wait(60.0) == 0
    for each in full_pipe:
        os.close(each)


def test_a_second_sigterm_ends_a_service_that_cannot_end(full_pipe: tuple[int, int]) -> None:
    bus = ("--interface", "virtual", "--channel", "second")
    arguments = [str(each) for each in ("run", "-m", leaf_model_path(), *bus, "--json")]
    service = subprocess.Popen(
        [sys.executable, "-c", COMMAND, *arguments],
        stdout=full_pipe[1],  # takes no result
        stderr=subprocess.PIPE,
        text=True,
    )
    assert service.stderr is not None
    for line in service.stderr:
        if "service.ready" in line:
            service.terminate()
        if "service.stopped" in line:
            break
    assert service.poll() is None
    service.terminate()
    assert service.wait(60.0) == -signal.SIGTERM
    service.stderr.close()
    for each in full_pipe:
        os.close(each)
