"""Notifications to systemd, of the class and of the real service, which it reloads and stops."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from cangauge.service.lifecycle import Notifier
from cangauge.service.status_client import fetch_status
from live import Command, leaf_model_path, waits


class FakeSystemd:
    def __init__(self, path: Path) -> None:
        self.path = path
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(path))
        self.socket.settimeout(20.0)

    def next(self) -> dict[str, str]:
        lines = self.socket.recv(4096).decode().splitlines()
        return dict(line.split("=", 1) for line in lines)

    def drain(self) -> int:
        """Take what is there; return how much it was."""
        self.socket.settimeout(0.0)
        taken = 0
        with contextlib.suppress(BlockingIOError):
            while self.socket.recv(4096):
                taken += 1
        self.socket.settimeout(20.0)
        return taken

    def until(self, key: str) -> dict[str, str]:
        """Return the next message with this key."""
        while key not in (heard := self.next()):
            pass
        return heard


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[FakeSystemd]:
    fake = FakeSystemd(tmp_path / "notify")
    yield fake
    fake.socket.close()


def test_every_message_also_by_the_abstract_name_space(systemd: FakeSystemd) -> None:
    with closing(Notifier({"NOTIFY_SOCKET": str(systemd.path)})) as notifier:
        notifier.send(READY=1, STATUS="on\ncan0")
        assert systemd.next() == {"READY": "1", "STATUS": "on can0"}
        for _ in range(10_000):  # a full queue does not block
            notifier.send(WATCHDOG=1)
    name = f"cangauge-test-{os.getpid()}"
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as fake,
        closing(Notifier({"NOTIFY_SOCKET": "@" + name})) as notifier,
    ):
        fake.bind("\0" + name)
        fake.settimeout(5.0)
        notifier.send(WATCHDOG=1)
        assert fake.recv(100) == b"WATCHDOG=1"


def test_the_watchdog_is_reset_without_a_free_file_descriptor(systemd: FakeSystemd) -> None:
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    with closing(Notifier({"NOTIFY_SOCKET": str(systemd.path)})) as notifier:
        resource.setrlimit(resource.RLIMIT_NOFILE, (0, limits[1]))
        try:
            notifier.send(WATCHDOG=1)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    systemd.socket.settimeout(0.0)
    assert systemd.next() == {"WATCHDOG": "1"}


@pytest.mark.parametrize(
    ("environment", "active"),
    [({}, False), ({"NOTIFY_SOCKET": "vsock:2:1"}, False), ({"NOTIFY_SOCKET": "/x"}, True)],
)
def test_what_the_environment_asks_for(environment: dict[str, str], active: bool) -> None:
    with closing(Notifier(environment)) as notifier:
        assert notifier.active == active
        notifier.send(WATCHDOG=1)  # where nobody listens, nothing happens


def test_a_service_is_watched_reloaded_and_stopped(
    systemd: FakeSystemd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(systemd.path))
    config, status = tmp_path / "car.toml", tmp_path / "status.sock"
    config.write_text("timeout_s = 1\n")
    service = Command(
        "run", "-m", leaf_model_path(), "--interface", "udp_multicast", "--bus-option",
        f"port={20_000 + os.getpid() % 20_000}", "--config", config, "--status-socket", status,
        "--json",
    )  # fmt: skip
    process = service.process
    assert "listening" in systemd.until("READY")["STATUS"]
    heard = [systemd.next() for _ in range(12)]
    assert sum("WATCHDOG" in each for each in heard) > 5
    assert "initialising" in [each["STATUS"] for each in heard if "STATUS" in each][-1]
    # Stopped in its loop, it gives no sign of life, so that systemd would act.
    process.send_signal(signal.SIGSTOP)
    time.sleep(0.3)
    systemd.drain()
    time.sleep(0.6)
    assert systemd.drain() == 0
    process.send_signal(signal.SIGCONT)
    systemd.until("WATCHDOG")
    # A hangup reads the configuration again.
    config.write_text("timeout_s = [")
    process.send_signal(signal.SIGHUP)
    assert int(systemd.until("RELOADING")["MONOTONIC_USEC"]) > 0
    assert "REFUSED" in systemd.until("READY")["STATUS"]
    service.wait_for("config.refused")
    assert waits(lambda: "not TOML" in str(fetch_status(status)["config"]["problem"]))
    config.write_text("timeout_s = 0.5\n")
    process.send_signal(signal.SIGHUP)
    service.wait_for("config.reloaded")
    # An interrupt ends the service.
    process.send_signal(signal.SIGINT)
    systemd.until("STOPPING")
    ended = service.end()
    assert ended.code == 0
    assert ended.json["stamps"] == "kernel"
    assert ended.json["bus_counts"]["foreign"] == 0  # its own frames come back on this bus
    assert (ended.json["samples"], ended.json["estimate"]["soc_pct"]) == (0, None)
    assert "0 samples" in ended.err
