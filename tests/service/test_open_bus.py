"""Opening a bus: defaults, and one-line errors with nothing else on stderr."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path

import can
import pytest

from cangauge.bus import open as opening
from cangauge.bus.open import (
    RECEIVE_BUFFER_BYTES,
    BusAddress,
    bus_address,
    open_bus,
    parse_bus_options,
)
from cangauge.errors import InputError

GROUP = "239.74.163.2"


def test_udp_multicast_stays_on_this_machine() -> None:
    address = bus_address("udp_multicast")
    assert address.channel == GROUP
    assert address.options["hop_limit"] == 0
    bus = open_bus(address)
    try:
        with socket.socket(fileno=os.dup(bus.fileno())) as own:
            assert own.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == 0
    finally:
        bus.shutdown()
    assert bus_address("udp_multicast", options={"hop_limit": 1}).options["hop_limit"] == 1


@pytest.mark.skipif(sys.platform != "linux", reason="the limit is Linux's")
def test_the_receive_buffer_is_as_large_as_the_system_allows() -> None:
    allowed = int(Path("/proc/sys/net/core/rmem_max").read_text())
    with (
        open_bus(bus_address("udp_multicast")) as bus,
        socket.socket(fileno=os.dup(bus.fileno())) as own,
    ):
        size = own.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    # Linux doubles the requested size, for its own bookkeeping.
    assert 2 * min(RECEIVE_BUFFER_BYTES, allowed) <= size <= 2 * RECEIVE_BUFFER_BYTES


def test_without_socketcan_the_default_is_multicast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opening, "has_socketcan", lambda _channel: False)
    assert bus_address().interface == "udp_multicast"
    assert bus_address(None, "239.1.1.1").channel == "239.1.1.1"
    monkeypatch.setattr(socket, "if_nameindex", lambda: [(1, "lo"), (2, "can0")])
    with pytest.raises(InputError, match=r"no such SocketCAN interface.*this machine has can0;"):
        bus_address(None, "can1")
    with pytest.raises(InputError, match="sudo ip link add dev vcan7 type vcan"):
        bus_address(None, "vcan7")
    monkeypatch.setattr(opening, "has_socketcan", lambda channel: channel == "vcan0")
    assert (bus_address().interface, bus_address().channel) == ("socketcan", "vcan0")


@pytest.mark.parametrize(
    ("interface", "channel", "field", "text"),
    [
        ("carrier_pigeon", None, "--interface", "use one of"),
        ("pcan", None, "--channel", "needs a channel"),
        ("udp_multicast", "vcan0", "--channel", "no multicast address"),
        ("udp_multicast", "10.0.0.1", "--channel", "no multicast address"),
    ],
)
def test_invalid_addresses_are_refused(
    interface: str, channel: str | None, field: str, text: str
) -> None:
    with pytest.raises(InputError, match=text) as caught:
        bus_address(interface, channel)
    assert caught.value.field == field


@pytest.mark.parametrize(
    ("address", "say"),
    [
        (BusAddress("pcan", "PCAN_USBBUS1"), "library"),
        # Either the machine has no SocketCAN at all, or not this interface.
        (BusAddress("socketcan", "nosuch0"), "no SocketCAN|nosuch0"),
    ],
)
def test_a_missing_driver_or_interface_is_named_in_one_line(
    capfd: pytest.CaptureFixture[str], address: BusAddress, say: str
) -> None:
    with pytest.raises(InputError, match=say) as caught:
        open_bus(address)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_multicast_without_msgpack_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("can.interfaces.udp_multicast.utils.msgpack", None)
    with pytest.raises(InputError, match="msgpack") as caught:
        open_bus(bus_address("udp_multicast"))
    assert caught.value.field == "--interface"


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (PermissionError(1, "Operation not permitted"), "no permission"),
        (OSError(19, "No such device"), "no such bus"),
        (ValueError("bitrate 3 is no bitrate"), "bitrate 3"),
        (ImportError("No module named 'canlib'"), "library"),
    ],
)
def test_driver_errors_are_explained(
    monkeypatch: pytest.MonkeyPatch, error: Exception, text: str
) -> None:
    def refuse(**_: object) -> object:
        raise error

    monkeypatch.setattr(can, "Bus", refuse)
    with pytest.raises(InputError, match=text) as caught:
        open_bus(BusAddress("pcan", "PCAN_USBBUS1"))
    assert caught.value.exit_code == 2


def test_bus_options_get_their_types() -> None:
    assert parse_bus_options(["bitrate=500000", "fd=True", "x=10", "f=0.5", "name=a=b"]) == {
        "bitrate": 500000, "fd": True, "x": 10, "f": 0.5, "name": "a=b",
    }  # fmt: skip
    for text in ("bitrate", "=5", "a b=3"):
        with pytest.raises(InputError, match="K=V"):
            parse_bus_options([text])
