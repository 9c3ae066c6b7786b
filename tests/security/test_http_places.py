"""Missing descriptors stop neither the estimate nor, once there are some again, a health probe."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

import can
import pytest

from live import COMMAND, leaf_model_path, waits

GROUP = "239.74.163.80"


def get(port: int | None, path: str) -> Any:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=5.0) as answer:
        return json.load(answer)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_few_descriptors_leave_the_processor_to_the_estimate() -> None:
    """Before, accepting again and again took a whole core."""
    port, http = 45_000 + time.monotonic_ns() % 900, _free_port()
    arguments = [
        "run", "-m", str(leaf_model_path()), "--interface", "udp_multicast", "--channel", GROUP,
        "--bus-option", f"port={port}", "--http", f"127.0.0.1:{http}", "--status-socket", "off",
    ]  # fmt: skip

    limited = ["/bin/sh", "-c", 'ulimit -n 30; exec "$@"', ""]
    with can.Bus(interface="udp_multicast", channel=GROUP, port=port) as watcher:
        service = subprocess.Popen(
            [*limited, sys.executable, "-c", COMMAND, *arguments],
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert waits(lambda: watcher.recv(0.1) is not None, 30.0)
        clients = [socket.create_connection(("127.0.0.1", http)) for _ in range(60)]
        time.sleep(0.5)
        while watcher.recv(0.0) is not None:
            pass
        busy_s, frames, until_s = _cpu_s(service.pid), 0, time.monotonic() + 1.5
        while time.monotonic() < until_s:
            message = watcher.recv(0.1)
            frames += message is not None and message.arbitration_id == 0x5A0
        assert _cpu_s(service.pid) - busy_s < 0.5
        assert frames >= 12
        for each in clients:
            each.close()
        assert get(http, "/healthz")["ok"]
    service.terminate()
    _, err = service.communicate(timeout=20.0)
    assert service.returncode == 0
    assert 1 <= err.count("http.exhausted") <= 4  # rate-limited
    assert "Traceback" not in err


def _cpu_s(pid: int) -> float:
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / 100.0


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
