"""Open a bus: any interface of python-can, with a one-line error and its cure on failure.

The default is SocketCAN's vcan0 where it exists, else `udp_multicast`, which needs no driver and
connects the programs of this machine: its packets do not leave it, and on the default bus packets
from elsewhere are dropped. Where interface or channel are named, anybody who reaches the port may
send.
"""

from __future__ import annotations

import errno
import ipaddress
import os
import select
import socket
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import can
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.socketcan.socketcan import capture_message
from can.interfaces.udp_multicast import UdpMulticastBus
from can.typechecking import CanFilter
from can.util import cast_from_string

from cangauge.errors import InputError

try:
    import msgpack
except ImportError:  # in a light install; then there is no UDP bus either
    msgpack = None

BusOption = str | int | float | bool
Stamps = Literal["kernel", "sender", "driver"]

MULTICAST_CHANNEL: Final = "239.74.163.2"
"""IPv4 group of python-can; its default is an IPv6 group, which some machines cannot reach."""
RECEIVE_BUFFER_BYTES: Final = 16 << 20
"""Requested receive buffer of sockets, for pauses: Linux's default holds about 270 frames. Without
CAP_NET_ADMIN the system limits it to net.core.rmem_max."""

_DEFAULT_CHANNELS: Final = {
    "socketcan": "vcan0",
    "udp_multicast": MULTICAST_CHANNEL,
    "virtual": "cangauge",
}
_ON_SOCKETS: Final = {"socketcan", "udp_multicast"}

# Those of a missing library or a wrong option too (NameError: kvaser without canlib).
_DRIVER_ERRORS: Final = (
    can.CanError,
    OSError,
    ValueError,
    TypeError,
    NotImplementedError,
    NameError,
    AttributeError,
    ImportError,
)


class DriverMissingError(InputError):
    """A driver or library is not installed: waiting does not help."""


@dataclass(frozen=True)
class BusAddress:
    """Address of a bus: one of `can.VALID_INTERFACES`, channel, further arguments of the driver.

    `local_only` drops packets that other machines send; for `udp_multicast`.
    """

    interface: str
    channel: str
    options: Mapping[str, BusOption] = field(default_factory=dict)
    local_only: bool = False

    def __str__(self) -> str:
        return f"{self.interface} {self.channel}"

    @property
    def echoes(self) -> bool:
        """Whether own frames are received too."""
        always = self.interface == "udp_multicast"
        return always or bool(self.options.get("receive_own_messages", False))

    @property
    def stamps(self) -> Stamps:
        """Origin of the time stamps.

        "kernel": arrival, however late the frame is read (SO_TIMESTAMPNS). "sender": sending,
        within one process. "driver": by the adapter's clock, or when the frame is read.
        """
        if self.interface == "virtual":
            return "sender"
        # On systems other than Linux, python-can stamps UDP packets when it reads them.
        has_kernel_stamps = self.interface == "socketcan" or (
            self.interface == "udp_multicast" and sys.platform == "linux"
        )
        return "kernel" if has_kernel_stamps else "driver"


def bus_address(
    interface: str | None = None,
    channel: str | None = None,
    options: Mapping[str, BusOption] | None = None,
) -> BusAddress:
    """Complete a partial address.

    Default interface: SocketCAN if it has that channel (default vcan0), else `udp_multicast`, which
    is `local_only` if neither a channel nor `hop_limit` is given. Raises InputError if the
    interface is unknown or needs a channel, or no default interface has the channel.
    """
    options = dict(options or {})
    local_only = interface is None and channel is None and "hop_limit" not in options
    interface = interface or _guess_interface(channel)
    if interface not in can.VALID_INTERFACES:
        cure = f"use one of: {', '.join(sorted(can.VALID_INTERFACES))}"
        raise InputError("unknown interface", field="--interface", value=interface, cure=cure)
    channel = _DEFAULT_CHANNELS.get(interface) if channel is None else channel
    if channel is None:
        raise InputError(f"{interface} needs a channel", field="--channel", cure="name one")
    if interface != "udp_multicast":
        return BusAddress(interface, channel, options)
    if not is_multicast(channel):
        cure = f"use one such as {MULTICAST_CHANNEL}"
        raise InputError("no multicast address", field="--channel", value=channel, cure=cure)
    # 0: packets sent stay on this machine; 1 (`--bus-option hop_limit=1`): local network.
    return BusAddress(interface, channel, {"hop_limit": 0, **options}, local_only)


def _guess_interface(channel: str | None) -> str:
    if has_socketcan(channel or _DEFAULT_CHANNELS["socketcan"]):
        return "socketcan"
    if channel is None or is_multicast(channel):
        return "udp_multicast"
    problem = "there is no such SocketCAN interface on this machine"
    cure = f"{_cure_of_missing(channel)}; or name the interface too: --interface udp_multicast"
    raise InputError(problem, field="--channel", value=channel, cure=cure)


def has_socketcan(channel: str) -> bool:
    """Return whether this machine has SocketCAN and that interface."""
    if not hasattr(socket, "AF_CAN"):
        return False
    try:
        socket.if_nametoindex(channel)
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW):
            return True
    except OSError:
        return False


def is_multicast(channel: str) -> bool:
    """Return whether a channel is a multicast address, not the name of a network interface."""
    try:
        return ipaddress.ip_address(channel).is_multicast
    except ValueError:
        return False


def parse_bus_options(given: Sequence[str]) -> dict[str, BusOption]:
    """Parse `K=V` texts; numbers, true and false get their type, as in python-can's options."""
    options: dict[str, BusOption] = {}
    for text in given:
        key, equals, value = text.partition("=")
        if not equals or not key.isidentifier():
            problem, cure = "not of the form K=V", "e.g. bitrate=500000"
            raise InputError(problem, field="--bus-option", value=text, cure=cure)
        try:
            options[key] = cast_from_string(value)
        except ValueError as error:  # a number of more than 4,300 digits
            raise InputError(str(error), field="--bus-option", value=text[:40]) from error
    return options


def open_bus(address: BusAddress, filters: Sequence[CanFilter] | None = None) -> can.BusABC:
    """Open a bus; `filters` apply in the kernel on SocketCAN, else in Python.

    Raises
    ------
    InputError
        If there is no such bus or it is down, an option is wrong, or a permission is missing.
    DriverMissingError
        If the driver or a library of it is missing.
    """
    arguments: dict[str, Any] = dict(address.options)
    if filters is not None:
        arguments["can_filters"] = list(filters)
    channel: str | int = address.channel
    if address.interface not in _ON_SOCKETS and address.channel.isdigit():
        channel = int(channel)  # as python-can's own configuration
    try:
        bus: can.BusABC
        if address.interface == "udp_multicast":
            bus = CheckedUdpBus(channel, local_only=address.local_only, **arguments)
        elif address.interface == "socketcan":
            bus = PolledSocketcanBus(address.channel, **arguments)
        else:
            arguments |= {"interface": address.interface, "ignore_config": True}
            bus = can.Bus(channel=channel, **arguments)
    except _DRIVER_ERRORS as error:
        raise _refusal(address, error) from error
    if address.interface in _ON_SOCKETS and sys.platform != "win32":
        with socket_of(bus) as own:
            forced = [33] if sys.platform == "linux" else []  # SO_RCVBUFFORCE
            for option in (socket.SO_RCVBUF, *forced):
                with suppress(OSError):  # the system may refuse, or cap the size silently
                    own.setsockopt(socket.SOL_SOCKET, option, RECEIVE_BUFFER_BYTES)
            # SocketCAN opens an interface that is down; the error comes with the next call.
            code = own.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if code:
            bus.shutdown()
            down = OSError(code, os.strerror(code))
            raise _refusal(address, down) from down
    return bus


def socket_of(bus: can.BusABC) -> socket.socket:
    """Return a duplicate of a driver's private socket, to be closed; OSError without one."""
    return socket.socket(fileno=os.dup(bus.fileno()))


def _refusal(address: BusAddress, error: BaseException) -> InputError:
    """Return a driver's error in one line with a cure."""
    cause = error
    while not isinstance(cause, OSError) and cause.__cause__ is not None:
        cause = cause.__cause__
    code = cause.errno if isinstance(cause, OSError) else None
    interface, channel = address.interface, address.channel
    reason = " ".join(str(cause).split()) or type(cause).__name__
    kind, field, value = InputError, "--channel", channel
    if code in {errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT} and interface == "socketcan":
        problem, field, value = "this machine has no SocketCAN", "--interface", interface
        cure = "use another interface, e.g. --interface udp_multicast"
    elif code in {errno.ENETUNREACH, errno.EADDRNOTAVAIL} and interface == "udp_multicast":
        problem = "no network interface of this machine carries multicast"
        field, value = "--interface", interface
        cure = "bring a network interface up, or use SocketCAN"
    elif code == errno.ENETDOWN:
        problem, cure = "this bus is down", f"bring it up: sudo ip link set {channel} up"
    elif code in {errno.ENODEV, errno.ENXIO, errno.ENOENT}:
        problem = f"{interface} has no such bus"
        cure = "check it"
        if interface == "socketcan":
            cure = _cure_of_missing(channel)
    elif code in {errno.EPERM, errno.EACCES}:
        problem = f"no permission to open this bus ({interface})"
        cure = "run as a user with that permission"
    elif isinstance(error, can.CanInterfaceNotImplementedError | ImportError | NameError) or any(
        word in reason for word in ("library", "module", "install")
    ):
        kind, field, value = DriverMissingError, "--interface", interface
        problem = f"a library for this interface is missing ({reason})"
        cure = f"install the library that python-can's documentation names for {interface}"
        if interface == "udp_multicast":
            cure = "install msgpack (pip install 'python-can[multicast]')"
    else:
        problem = f"{interface} cannot open this bus ({reason})"
        cure = "check channel and --bus-option"
    return kind(problem, field=field, value=value, cure=cure)


def _cure_of_missing(channel: str) -> str:
    """Return what to do about a SocketCAN interface that does not exist."""
    if channel.startswith("vcan"):
        return f"make it: sudo ip link add dev {channel} type vcan; sudo ip link set {channel} up"
    names = []
    with suppress(OSError):
        names = [name for _, name in socket.if_nameindex() if "can" in name]
    return f"check adapter and name; this machine has {', '.join(names) or 'no CAN interface'}"


class PolledSocketcanBus(SocketcanBus):
    """python-can's bus, read with one system call per pending frame where python-can needs three.

    Its waits use the monotonic clock, whereas python-can's follow a clock that can be set.
    """

    def __init__(self, channel: str, **kwargs: Any) -> None:
        super().__init__(channel, **kwargs)
        self.socket.setblocking(False)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame; None if none came in time [s]."""
        if timeout:
            select.select([self.socket], [], [], timeout)
        try:
            message = capture_message(self.socket)
        except can.CanOperationError as error:
            if error.error_code == errno.EAGAIN:
                return None
            raise
        if message is None or not (self._is_filtered or self._matches_filters(message)):
            return None  # the kernel takes no more than 512 filters
        message.channel = self.channel
        return message


# --- UDP multicast. Anybody who reaches the port may send: the socket is bound to all network
# interfaces and takes unicast too. python-can's bus makes a message of any fields, whose wrong
# types then fail later, in the filters.

_TYPES: Final[dict[str, type]] = {
    "arbitration_id": int,
    "dlc": int,
    "data": bytes,
    "is_extended_id": bool,
    "is_remote_frame": bool,
    "is_error_frame": bool,
    "is_fd": bool,
    "bitrate_switch": bool,
    "error_state_indicator": bool,
}
MOST_UNWANTED: Final = 1024
"""Most packets that are read for one frame: about 15 ms."""


def message_of(packet: bytes, stamp_s: float) -> can.Message:
    """Return the frame of a packet, with the time of its arrival [s since 1970].

    Raises can.CanOperationError with a cause if it is no frame: it counts as one garbled packet.
    """
    try:
        fields = msgpack.unpackb(packet, raw=False)
        fields["timestamp"] = stamp_s
        wrong = [name for name, kind in _TYPES.items() if type(fields[name]) is not kind]
        if wrong or not _is_channel(fields["channel"]):
            raise TypeError(f"of a wrong type: {', '.join(wrong) or 'channel'}")  # noqa: TRY301
        return can.Message(check=True, **fields)
    except Exception as error:  # the packet's, whatever it is
        raise can.CanOperationError("could not unpack received message") from error


def _is_channel(value: object) -> bool:
    """Return whether a value is a channel that a line of a recording holds as one short word."""
    if isinstance(value, str):
        return 0 < len(value) <= 64 and value.isprintable() and " " not in value
    return value is None or type(value) is int


class CheckedUdpBus(UdpMulticastBus):
    """python-can's bus, with checked packets.

    `local_only` drops packets whose sender is not an address of this machine. (The kernel drops
    packets from the network that pretend to be.) Packets of another group are another bus's.
    """

    def __init__(self, *args: Any, local_only: bool = False, **kwargs: Any) -> None:
        self._local_only = local_only
        self._local_host = ""
        super().__init__(*args, **kwargs)
        if sys.platform == "linux":
            # IP_MULTICAST_ALL, IPV6_MULTICAST_ALL (Linux 4.20): while set, as by default, a socket
            # receives the packets of every group that any program of the machine has joined.
            with socket_of(self) as own:
                for level, option in ((socket.IPPROTO_IP, 49), (socket.IPPROTO_IPV6, 29)):
                    with suppress(OSError):
                        own.setsockopt(level, option, 0)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame; None if none came in time [s].

        A flood of other packets does not hold the caller for longer.
        """
        wait_s = timeout or 0.0
        until_s = time.monotonic() + wait_s
        carries_fd = self.protocol is can.CanProtocol.CAN_FD
        for _ in range(MOST_UNWANTED):
            received = self._multicast.recv(wait_s)
            if not received:
                break
            packet, sender, stamp_s = received
            if not self._local_only or self._is_local(str(sender[0])):
                message = message_of(packet, stamp_s)
                if (carries_fd or not message.is_fd) and self._matches_filters(message):
                    return message
            wait_s = max(until_s - time.monotonic(), 0.0)
        return None

    def _is_local(self, host: str) -> bool:
        if host != self._local_host and _is_own_address(host):
            self._local_host = host
        return host == self._local_host


def _is_own_address(host: str) -> bool:
    """Return whether this machine has an address: only then a socket can be bound to it."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind((host, 0))
    except OSError:
        return False
    return True
