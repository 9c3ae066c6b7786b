"""Process control: stop and reload signals, and notifications to systemd (sd_notify(3)).

The sd_notify protocol is implemented here, `KEY=value` datagrams to the socket in NOTIFY_SOCKET:
the available packages need a C library or are unmaintained.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Final, Self

from cangauge._text import printable

PINGS_PER_TIMEOUT: Final = 4
"""Watchdog pings per time-out of systemd."""
END_WITHIN_S: Final = 6.0
"""Longest time from SIGTERM to the end [s]: what is written at the end has 5 s, and the systemd
unit kills after 10 s."""


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether SIGINT (Ctrl-C) or SIGTERM was received.

    A second signal has its default effect, so that a hanging process can be ended. For the main
    thread only.
    """
    received: list[int] = []
    kinds = (signal.SIGINT, signal.SIGTERM)
    before = {kind: signal.getsignal(kind) for kind in kinds}

    def note(number: int, _frame: FrameType | None) -> None:
        received.append(number)
        for kind in kinds:
            signal.signal(kind, before[kind])

    for kind in kinds:
        signal.signal(kind, note)
    try:
        yield lambda: bool(received)
    finally:
        for kind in kinds:
            signal.signal(kind, before[kind])


@contextmanager
def deadline_after_signal(within_s: float = END_WITHIN_S) -> Iterator[None]:
    """End the process a while after SIGINT or SIGTERM if the block has not ended by itself.

    Nothing that can hang (a disk, a pipe whose reader has stopped) must keep a service from ending.
    For the main thread of a command; the exit code is then 1.

    Parameters
    ----------
    within_s : float
        Time from the signal to that end [s].
    """
    if sys.platform == "win32":  # it has no wake-up by a pipe
        yield
        return
    signals, wakeup = os.pipe()
    os.set_blocking(wakeup, False)
    before = signal.set_wakeup_fd(wakeup, warn_on_full_buffer=False)
    is_over = threading.Event()

    def watch() -> None:
        with os.fdopen(signals, "rb", buffering=0) as received:
            while (new := received.read(64)) and not {signal.SIGINT, signal.SIGTERM} & {*new}:
                pass
        if not is_over.wait(within_s):
            with suppress(OSError):  # not by `logging`, whose lock may be what hangs
                os.set_blocking(2, False)
                os.write(2, b"error: ended, although something still hangs\n")
            os._exit(1)

    threading.Thread(target=watch, name="cangauge-deadline", daemon=True).start()
    try:
        yield
    finally:
        is_over.set()
        signal.set_wakeup_fd(before)
        os.close(wakeup)  # ends the thread, which owns the other end


class _Hangups:
    """Handler of SIGHUP that remembers it; SIGHUP from a closing terminal becomes SIGTERM."""

    def __init__(self) -> None:
        self._received = False
        self._had_terminal = _has_terminal()

    def note(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        if self._had_terminal and not _has_terminal():
            signal.raise_signal(signal.SIGTERM)
        else:
            self._received = True

    def take(self) -> bool:
        received, self._received = self._received, False
        return received


def hold_hangups() -> None:
    """Remember SIGHUP for `note_hangups` from now until the process ends.

    By default the signal would end a service that still loads, or just ends. For the main thread
    only.
    """
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, _Hangups().note)


@contextmanager
def note_hangups() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether SIGHUP was received since its last call.

    One that `hold_hangups` remembered counts. For the main thread only; without effect on Windows,
    which has no SIGHUP.
    """
    if not hasattr(signal, "SIGHUP"):
        yield lambda: False
        return
    before = signal.getsignal(signal.SIGHUP)
    held = getattr(before, "__self__", None)
    hangups = held if isinstance(held, _Hangups) else _Hangups()
    signal.signal(signal.SIGHUP, hangups.note)
    try:
        yield hangups.take
    finally:
        signal.signal(signal.SIGHUP, before)


def _has_terminal() -> bool:
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
    except OSError:
        return False
    return True


class Notifier:
    """Notify systemd; without effect where there is no address.

    Parameters
    ----------
    address : str, optional
        Path of the datagram socket; a leading "@" denotes the abstract namespace.
    watchdog_s : float, optional
        Watchdog time-out of systemd [s].

    Attributes
    ----------
    ping_every_s : float or None
        Longest interval between calls of `ping` [s]; None without a watchdog.
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
        """Create one from NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID."""
        given = os.environ if environment is None else environment
        address = given.get("NOTIFY_SOCKET", "")
        if not address.startswith(("/", "@")) or not hasattr(socket, "AF_UNIX"):
            return cls()
        for_us = given.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        text = given.get("WATCHDOG_USEC", "")
        microseconds = int(text) if for_us and text.isdecimal() and len(text) < 20 else 0
        return cls(address, microseconds / 1e6 if microseconds else None)

    @property
    def active(self) -> bool:
        """Whether systemd listens."""
        return self._socket is not None

    def ready(self, status: str) -> None:
        """Report the end of start-up or reload; `status` is a line for `systemctl status`."""
        self._send("READY=1", f"STATUS={_line(status)}")

    def status(self, status: str) -> None:
        """Report the status line."""
        self._send(f"STATUS={_line(status)}")

    def ping(self) -> None:
        """Reset the watchdog; call it from the receive loop only, which it supervises."""
        self._send("WATCHDOG=1")

    def reloading(self) -> None:
        """Report the start of a reload; `ready` ends it."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """Report that the service stops."""
        self._send("STOPPING=1", "STATUS=stopping")

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, *lines: str) -> None:
        if self._socket is not None and self._address is not None:
            with suppress(OSError):  # systemd restarts, or its queue is full
                self._socket.sendto("\n".join(lines).encode(), self._address)


def _line(text: str) -> str:
    return printable(" ".join(text.split()))
