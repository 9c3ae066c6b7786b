"""UDP multicast as a bus: packets are checked before a message is made of them.

Anybody who reaches the port may send: the socket is bound to all network interfaces and takes
unicast too. python-can's bus makes a message of any fields, whose wrong types then fail later, in
the filters. A malformed packet raises `can.CanOperationError` with a cause, which counts as one
garbled packet.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any, Final

import can
from can.interfaces.udp_multicast import UdpMulticastBus

try:
    import msgpack
except ImportError:  # then there is no UDP bus either
    msgpack = None

_MAX_CHANNEL: Final = 64
"""Longest name of a channel in a packet [characters]: it is recorded with every frame."""


def _is_flag(value: object) -> bool:
    return isinstance(value, bool)


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_channel(value: object) -> bool:
    """Return whether a value is a channel that a line of a recording can hold as one word."""
    if isinstance(value, str):
        return 0 < len(value) <= _MAX_CHANNEL and value.isprintable() and " " not in value
    return value is None or _is_whole(value)


_FIELDS: Final[dict[str, Callable[[object], bool]]] = {
    "timestamp": lambda _: True,  # replaced
    "arbitration_id": _is_whole,
    "is_extended_id": _is_flag,
    "is_remote_frame": _is_flag,
    "is_error_frame": _is_flag,
    "channel": _is_channel,
    "dlc": _is_whole,
    "data": lambda value: isinstance(value, bytes),
    "is_fd": _is_flag,
    "bitrate_switch": _is_flag,
    "error_state_indicator": _is_flag,
}


def unpack_fields(packet: bytes) -> dict[str, Any]:
    """Return the fields of a packet, each of its type.

    Raises
    ------
    can.CanOperationError
        If it is no frame; the cause says why.
    """
    try:
        fields = msgpack.unpackb(packet, raw=False)
        wrong = [name for name, value in fields.items() if not _FIELDS[name](value)]
    except Exception as error:  # the packet's, whatever it is
        raise can.CanOperationError("could not unpack received message") from error
    if wrong:
        cause = TypeError(f"of a wrong type: {', '.join(wrong)}")
        raise can.CanOperationError("could not unpack received message") from cause
    return dict(fields)


def as_message(fields: dict[str, Any], stamp_s: float) -> can.Message:
    """Return the message of checked fields, with the time of its arrival [s since 1970].

    Raises
    ------
    can.CanOperationError
        If the values do not fit together.
    """
    fields["timestamp"] = stamp_s
    try:
        return can.Message(check=True, **fields)
    except Exception as error:
        raise can.CanOperationError("could not unpack received message") from error


class CheckedUdpBus(UdpMulticastBus):
    """python-can's bus, with checked packets.

    Parameters
    ----------
    *args, **kwargs
        Those of `UdpMulticastBus`.
    local_only : bool
        Drop packets whose sender is not an address of this machine. (The kernel drops packets
        from the network that pretend to be.)
    """

    def __init__(self, *args: Any, local_only: bool = False, **kwargs: Any) -> None:
        self._local_only = local_only
        self._local_host = ""
        super().__init__(*args, **kwargs)

    def is_accepted(self, sender: Any) -> bool:
        """Return whether a packet from this socket address is to be read."""
        if not self._local_only:
            return True
        host = str(sender[0])
        if host != self._local_host:
            if not _is_own_address(host):
                return False
            self._local_host = host
        return True

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        received = self._multicast.recv(timeout)
        if not received:
            return None, False
        packet, sender, stamp_s = received
        if not self.is_accepted(sender):
            return None, False
        message = as_message(unpack_fields(packet), stamp_s)
        carries_fd = self.protocol is can.CanProtocol.CAN_FD
        return (message if carries_fd or not message.is_fd else None), False


def _is_own_address(host: str) -> bool:
    """Return whether this machine has an address: only then a socket can be bound to it."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind((host, 0))
    except OSError:
        return False
    return True
