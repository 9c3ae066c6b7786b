"""A large DBC takes none of the receive loop's time."""

from __future__ import annotations

import signal
import time
from itertools import pairwise
from pathlib import Path

import can
import pytest

from faults.large_dbc import write_large_dbc
from live import Command, in_process, leaf_model_path

GROUP = "239.74.163.78"


@pytest.mark.nightly
def test_frames_go_on_while_a_large_dbc_is_read(tmp_path: Path) -> None:
    write_large_dbc(tmp_path, 0.5)
    port = 44_500 + time.monotonic_ns() % 400
    config, socket = tmp_path / "run.toml", tmp_path / "status.sock"
    start = (
        f'model = "{leaf_model_path()}"\ninterface = "udp_multicast"\nchannel = "{GROUP}"\n'
        f'status_socket = "{socket}"\n'
    )
    bus = f"[bus_options]\nport = {port}\n"
    config.write_text(start + bus)
    service = Command("run", "--config", config)
    sent_s: list[float] = []
    with can.Bus(interface="udp_multicast", channel=GROUP, port=port) as watcher:

        def watch(seconds: float, enough: int = 1 << 30) -> None:
            until_s = time.monotonic() + seconds
            while time.monotonic() < until_s and len(sent_s) < enough:
                message = watcher.recv(0.1)
                if message is not None and message.arbitration_id == 0x5A0:
                    sent_s.append(time.monotonic())

        watch(120.0, 3)
        config.write_text(start + 'dbc = "large.dbc"\nmap = "map.toml"\n' + bus)
        service.process.send_signal(signal.SIGHUP)
        status = in_process("status", "--endpoint", socket, "--json").json
        for _ in range(600):
            watch(0.2)
            status = in_process("status", "--endpoint", socket, "--json").json
            if status["vehicle"] == "car of a large DBC":
                break
        assert status["config"] == {"reloading": False, "problem": None}
        assert status["vehicle"] == "car of a large DBC"
        config.write_text(start + "surprise = 1\n" + bus)
        service.process.send_signal(signal.SIGHUP)
        for _ in range(600):
            watch(0.1)
            status = in_process("status", "--endpoint", socket, "--json").json
            if status["config"]["problem"]:
                break
        assert "surprise" in status["config"]["problem"]
        assert status["vehicle"] == "car of a large DBC"
    service.process.terminate()
    ended = service.end()
    assert ended.code == 0
    assert "config.reloaded" in ended.err
    assert max(later - earlier for earlier, later in pairwise(sent_s)) < 1.0
