"""Telling systemd how the service fares: the datagrams of sd_notify(3).

Own code on purpose: the protocol is `KEY=value` lines to the socket that NOTIFY_SOCKET names; the
packages for it bring a C library or have not been kept for years.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping
from typing import Final, Self

NOTIFY_SOCKET: Final = "NOTIFY_SOCKET"
PINGS_PER_TIMEOUT: Final = 4
"""So many signs of life fall within systemd's time-out."""


class Notifier:
    """Speaks to systemd; does nothing where no systemd asked for it.

    Parameters
    ----------
    address : str, optional
        Path of the datagram socket; "@" at its beginning stands for the abstract name space.
    watchdog_s : float, optional
        systemd's time-out for signs of life [s].

    Attributes
    ----------
    ping_every_s : float or None
        How often `ping` should be called at least [s]; None: nobody waits for it.
    """

    def __init__(self, address: str | None = None, watchdog_s: float | None = None) -> None:
        self._address = "\0" + address[1:] if address and address[0] == "@" else address
        self.ping_every_s = None if watchdog_s is None else watchdog_s / PINGS_PER_TIMEOUT
        self._socket: socket.socket | None = None
        if self._address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] | None = None) -> Self:
        """Return the one that systemd asks for by NOTIFY_SOCKET, WATCHDOG_USEC, WATCHDOG_PID."""
        given = os.environ if environment is None else environment
        address = given.get(NOTIFY_SOCKET, "")
        if not address.startswith(("/", "@")) or not hasattr(socket, "AF_UNIX"):
            return cls()
        for_us = given.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        microseconds = given.get("WATCHDOG_USEC", "")
        watched = for_us and microseconds.isdecimal() and int(microseconds) > 0
        return cls(address, int(microseconds) / 1e6 if watched else None)

    @property
    def active(self) -> bool:
        """Whether anybody listens."""
        return self._socket is not None

    def ready(self, status: str) -> None:
        """Say that start-up, or a reload, is done; `status` is a line for `systemctl status`."""
        self._send("READY=1", f"STATUS={_line(status)}")

    def status(self, status: str) -> None:
        """Say in a line how things stand."""
        self._send(f"STATUS={_line(status)}")

    def ping(self) -> None:
        """Give a sign of life: only from the loop whose turning is to be proved."""
        self._send("WATCHDOG=1")

    def reloading(self) -> None:
        """Say that the configuration is read again; `ready` ends it."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self, status: str = "stopping") -> None:
        """Say that the service is about to end."""
        self._send("STOPPING=1", f"STATUS={_line(status)}")

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, *lines: str) -> None:
        if self._socket is None or self._address is None:
            return
        try:
            self._socket.sendto("\n".join(lines).encode(), self._address)
        except OSError:
            # systemd is restarting or its queue is full: the next one will do. If it stays so,
            # the watchdog acts, which is what it is for.
            return


def _line(text: str) -> str:
    return " ".join(text.split())
