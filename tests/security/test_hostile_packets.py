"""What anybody on the network can send to a `udp_multicast` bus: garbled, never more."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import can
import msgpack
import pytest

from cangauge.bus import open as open_module
from cangauge.bus.connection import BusConnection
from cangauge.bus.open import BusAddress, bus_address, open_bus
from cangauge.bus.publish import standard_filter
from live import Command, leaf_model_path, waits

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="kernel stamps are Linux's")
PORT = 43_500 + os.getpid() % 1000
GROUP = "239.74.163.77"
ADDRESS = bus_address("udp_multicast", GROUP, {"port": PORT})
ID = 0x400

WRONG: dict[str, dict[object, object]] = {
    "unseen float id": {"arbitration_id": 0.5},
    "float id": {"arbitration_id": float(ID)},
    "flag as id": {"arbitration_id": True},
    "text id": {"arbitration_id": "0x400"},
    "negative id": {"arbitration_id": -1},
    "unhashable id": {"arbitration_id": [1, 2]},
    "float dlc": {"dlc": 8.0},
    "huge dlc": {"dlc": 2**40},
    "text data": {"data": "12345678"},
    "list data": {"data": [1, 2, 3]},
    "number as data": {"data": 2**31},
    "text flag": {"is_fd": "yes"},
    "float extended id": {"arbitration_id": float(ID), "is_extended_id": True},
    "number for a flag": {"is_error_frame": 3},
    "extra field": {"surprise": 1},
    "number as a field": {1: 1},
    "map of maps": {"channel": {"a": {"b": []}}},
    "line in a channel": {"channel": "x 1#00\n(0.0) can0 400#0000000000000000"},
    "word in a channel": {"channel": "can0 400#00"},
    "escape in a channel": {"channel": "\x1b[2J"},
    "empty channel": {"channel": ""},
    "endless channel": {"channel": "x" * 1000},
}


def packet(changes: dict[object, object] | None = None) -> bytes:
    fields: dict[object, object] = {
        "timestamp": 0.0, "arbitration_id": ID, "is_extended_id": False,
        "is_remote_frame": False, "is_error_frame": False, "channel": None, "dlc": 8,
        "data": bytes(8), "is_fd": False, "bitrate_switch": False,
        "error_state_indicator": False,
    }  # fmt: skip
    return bytes(msgpack.packb(fields | (changes or {}), use_bin_type=True))


HOSTILE = [
    b"\xc1\xff\x00",
    bytes(msgpack.packb([1, 2, 3])),
    b"",
    packet()[:-3],
    b"\x91" * 4000,
    *(packet(each) for each in WRONG.values()),
]


@pytest.fixture
def sender() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        yield sender


def send(sender: socket.socket, *packets: bytes) -> None:
    for each in packets:
        sender.sendto(each, (GROUP, PORT))


def test_malformed_packets_count_as_garbled(sender: socket.socket) -> None:
    """By both ways of reading, filtered, before and after a good frame with the same id."""
    wanted = [standard_filter(ID)]
    with (
        BusConnection(open_bus(ADDRESS, wanted), ADDRESS) as single,
        BusConnection(open_bus(ADDRESS, wanted), ADDRESS) as pending,
    ):
        for hostile in HOSTILE:
            send(sender, hostile, packet(), hostile)
            frames = [single.receive(0.1) for _ in range(2)]
            assert [each is None for each in frames] == [False, True], hostile
            assert len(pending.receive_pending(1.0)) == 1, hostile
        assert single.garbled == pending.garbled == 2 * len(HOSTILE)


def test_a_channel_of_one_word_is_kept(sender: socket.socket) -> None:
    with BusConnection(open_bus(ADDRESS), ADDRESS) as port:
        for channel in (None, 0, "can0", "Größe-1"):
            send(sender, packet({"channel": channel}))
            assert [each.channel for each in port.receive_pending(1.0)] == [channel]


def test_the_default_bus_drops_what_other_machines_send(
    sender: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(open_module, "has_socketcan", lambda _: False)
    assert bus_address(options={"port": PORT}).local_only
    assert not bus_address(options={"hop_limit": 1}).local_only
    assert not ADDRESS.local_only
    local = BusAddress("udp_multicast", GROUP, {"port": PORT, "hop_limit": 0}, local_only=True)
    with (
        BusConnection(open_bus(local), local) as single,
        BusConnection(open_bus(local), local) as pending,
        BusConnection(open_bus(ADDRESS), ADDRESS) as named,
    ):
        send(sender, packet())
        assert single.receive(1.0) is not None
        assert len(pending.receive_pending(1.0)) == 1
        with monkeypatch.context() as elsewhere:
            # No packet from another machine can be had here: this machine disowns its address.
            elsewhere.setattr(open_module, "_is_own_address", lambda _: False)
            for port in (single, pending):
                port._bus._local_host = ""
            send(sender, packet())
            assert single.receive(0.2) is None
            assert pending.receive_pending(0.2) == []
        assert single.garbled == pending.garbled == 0
        assert len(named.receive_pending(1.0)) == 2
    assert open_module._is_own_address("127.0.0.1")
    assert not open_module._is_own_address("192.0.2.1")  # reserved for documentation
    assert not open_module._is_own_address("2001:db8::1")


def test_hangups_at_the_start_and_malformed_packets_do_not_end_the_service(
    sender: socket.socket,
) -> None:
    service = Command(
        "run", "-m", leaf_model_path(), "--interface", "udp_multicast", "--channel", GROUP,
        "--bus-option", f"port={PORT}", "--json",
    )  # fmt: skip
    process = Path(f"/proc/{service.process.pid}")
    assert waits(lambda: _holds_hangups(process))
    assert "numpy" not in (process / "maps").read_text()  # the imports that take time come later
    with can.Bus(interface="udp_multicast", channel=GROUP, port=PORT) as watcher:
        published = False
        until_s = time.monotonic() + 30.0
        while not published and time.monotonic() < until_s:
            service.process.send_signal(signal.SIGHUP)
            published = watcher.recv(0.05) is not None
        assert published
        for hostile in HOSTILE:
            send(sender, hostile, packet(), hostile)
        time.sleep(0.3)
        service.wait_for("config.reloaded")
    service.process.send_signal(signal.SIGTERM)
    ended = service.end()
    assert ended.code == 0, ended.err
    assert "Traceback" not in ended.err
    assert "config.reloaded" in ended.err
    assert ended.json["bus_counts"]["losses"] == 0
    assert ended.json["bus_counts"]["garbled"] == 2 * len(HOSTILE)


def _holds_hangups(process: Path) -> bool:
    for line in (process / "status").read_text().splitlines():
        if line.startswith("SigBlk:"):
            return bool(int(line.split()[1], 16) & 1 << (signal.SIGHUP - 1))
    return False
