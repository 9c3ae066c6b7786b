"""Process control: stop and reload signals, files held by one service, notes to systemd."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from os import PathLike
from pathlib import Path
from types import FrameType
from typing import Final, Self

from cangauge._text import printable
from cangauge.errors import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment] # checked before use

PINGS_PER_TIMEOUT: Final = 4
"""Watchdog pings per time-out of systemd."""
END_WITHIN_S: Final = 6.0
"""Longest time from SIGTERM to the end [s]: what is written at the end has 5 s, and the systemd
unit kills after 10 s."""
_STOPS: Final = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether SIGINT (Ctrl-C) or SIGTERM was received.

    A second signal has its default effect, so that a hanging process can be ended. For the main
    thread only.
    """
    received: list[int] = []
    before = {kind: signal.getsignal(kind) for kind in _STOPS}

    def restore() -> None:
        for kind, handler in before.items():
            signal.signal(kind, handler)

    def note(number: int, _frame: FrameType | None) -> None:
        received.append(number)
        restore()

    for kind in _STOPS:
        signal.signal(kind, note)
    try:
        yield lambda: bool(received)
    finally:
        restore()


@contextmanager
def sole_writer(path: str | PathLike[str]) -> Iterator[None]:
    """Hold a file for this process while the block runs, by a lock on a hidden file beside it.

    The kernel releases the lock at the latest when the process ends. Where there can be no lock (a
    read-only disk, a network file system without locks, Windows) the block runs without.

    Raises
    ------
    InputError
        If another process holds it; names that process.
    """
    target = Path(os.path.realpath(path))
    with ExitStack() as stack:
        try:
            lock = target.with_name(f".{target.name[:200]}.lock")
            held = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            stack.callback(os.close, held)
            if fcntl is not None:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            stack.callback(lock.unlink, missing_ok=True)
            os.ftruncate(held, 0)
            os.write(held, f"{os.getpid()}\n".encode())
        except BlockingIOError as error:
            holder = os.read(held, 20).decode("ascii", "replace").strip()
            raise InputError(
                f"another service{f' (process {holder})' if holder else ''} writes this file",
                source=path,
                cure="stop that one, or name another file",
            ) from error
        except OSError:  # no lock here; where nothing can be written, writing reports it
            pass
        yield


@contextmanager
def deadline_after_signal(within_s: float = END_WITHIN_S) -> Iterator[None]:
    """End the process with code 1 if the block still runs `within_s` after SIGINT or SIGTERM.

    Nothing that can hang (a disk, a pipe whose reader has stopped) must keep a service from ending.
    The signal wakes a thread by a pipe, since a main thread that hangs runs no handler.
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
            while (new := received.read(64)) and not {*_STOPS} & {*new}:
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

    def __call__(self, _number: int, _frame: FrameType | None) -> None:
        if self._had_terminal and not _has_terminal():
            signal.raise_signal(signal.SIGTERM)
        else:
            self._received = True

    def forget(self) -> bool:
        """Return whether there was one since the last call."""
        received, self._received = self._received, False
        return received


def hold_hangups() -> None:
    """Remember SIGHUP for `note_hangups` from now on: it would end a service that still loads."""
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, _Hangups())


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
    hangups = before if isinstance(before, _Hangups) else _Hangups()
    signal.signal(signal.SIGHUP, hangups)
    try:
        yield hangups.forget
    finally:
        signal.signal(signal.SIGHUP, before)


def _has_terminal() -> bool:
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
    except OSError:
        return False
    return True


class Notifier:
    """Notify systemd by datagrams of `KEY=value` lines; without effect where it does not listen.

    The environment has NOTIFY_SOCKET (a path; a leading "@" denotes the abstract namespace; whether
    it is there is `active`), WATCHDOG_USEC and WATCHDOG_PID. `ping_every_s` is the longest interval
    between calls of `ping` [s]; None without a watchdog.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        given = environment or {}
        address = given.get("NOTIFY_SOCKET", "")
        self.active = address.startswith(("/", "@")) and hasattr(socket, "AF_UNIX")
        self.ping_every_s: float | None = None
        if not self.active:
            return
        self._address = "\0" + address[1:] if address[0] == "@" else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)
        text = given.get("WATCHDOG_USEC", "")
        is_ours = given.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        if is_ours and text.isdecimal() and int(text[:20]) > 0:
            self.ping_every_s = int(text[:20]) / 1e6 / PINGS_PER_TIMEOUT

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.active:
            self._socket.close()

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

    def _send(self, *lines: str) -> None:
        if self.active:
            with suppress(OSError):  # systemd restarts, or its queue is full
                self._socket.sendto("\n".join(lines).encode(), self._address)


def _line(text: str) -> str:
    return printable(" ".join(text.split()))
