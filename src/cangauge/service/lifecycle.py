"""Process control: stop and reload signals, files held by one service, notes to systemd."""

from __future__ import annotations

import errno
import os
import signal
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from os import PathLike
from pathlib import Path
from types import FrameType
from typing import BinaryIO

from cangauge._files import NO_LINK, has_name, is_own, written_name
from cangauge._text import printable
from cangauge.errors import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment] # checked before use


@contextmanager
def _handler(handle: Callable[[int, FrameType | None], None], *kinds: int) -> Iterator[None]:
    """Handle signals while the block runs; for the main thread only."""
    before = {kind: signal.signal(kind, handle) for kind in kinds}
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)


@contextmanager
def stop_on_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` on SIGINT (Ctrl-C) or SIGTERM while the block runs.

    A second signal has its default effect, so that a hanging process can be ended. For the main
    thread only, which `stop` interrupts anywhere: it may set a flag, and take no lock.
    """
    with ExitStack() as stack:

        def handle(_number: int, _frame: FrameType | None) -> None:
            stop()
            stack.close()

        stack.enter_context(_handler(handle, signal.SIGINT, signal.SIGTERM))
        yield


@contextmanager
def reload_on_hangup(reload: Callable[[], None]) -> Iterator[None]:
    """Call `reload` on SIGHUP while the block runs; when the terminal closes, stop as on SIGTERM.

    As `stop_on_signals`; without effect on Windows, which has no SIGHUP.
    """
    had_terminal = _has_terminal()

    def handle(_number: int, _frame: FrameType | None) -> None:
        if had_terminal and not _has_terminal():
            signal.raise_signal(signal.SIGTERM)
        else:
            reload()

    kinds = [signal.SIGHUP] if hasattr(signal, "SIGHUP") else []
    with _handler(handle, *kinds):
        if not kinds:
            yield
            return
        # Handle one that was held back while the service loaded (`__main__`).
        before = signal.pthread_sigmask(signal.SIG_UNBLOCK, kinds)
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _has_terminal() -> bool:
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
    except OSError:
        return False
    return True


@contextmanager
def sole_writer(path: str | PathLike[str]) -> Iterator[None]:
    """Hold a file for this process while the block runs, by a lock on a hidden file beside it.

    The kernel releases the lock at the latest when the process ends. The block runs without a lock
    where there can be none (a read-only disk, a network file system without locks, Windows), and
    where another user, who owns neither file nor folder, has taken its name.

    Raises
    ------
    InputError
        If another process holds it; names that process.
    """
    target = written_name(path)
    lock = target.with_name(f".{target.name}.lock")
    with ExitStack() as stack:
        # Without a lock where there can be none; where nothing can be written, writing reports it.
        with suppress(OSError):
            stack.enter_context(_locked(lock, path))
            stack.callback(lock.unlink, missing_ok=True)
        yield


def _locked(lock: Path, shown: str | PathLike[str]) -> BinaryIO:
    """Return an open lock file that is locked and has its name; may raise OSError."""
    if fcntl is None:
        raise OSError(errno.ENOLCK, "no file locks")
    while True:
        opened = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | NO_LINK, 0o600)
        with ExitStack() as closing:
            file = closing.enter_context(open(opened, "r+b", buffering=0))  # noqa: PTH123
            info = os.fstat(file.fileno())
            if not is_own(info) and info.st_uid != lock.parent.stat().st_uid:
                raise OSError(errno.EPERM, "another user's file")
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                pid = file.read(20).decode("ascii", "replace")
                holder = f" (process {pid})" if pid else ""
                raise InputError(
                    f"another service{holder} writes this file",
                    source=shown,
                    cure="stop that one, or name another file",
                ) from error
            # Its holder removes the name before the lock ends: then it is made anew.
            if has_name(info, lock):
                closing.pop_all()
                with suppress(OSError):  # a full disk: without the process in messages
                    file.truncate(0)
                    file.write(str(os.getpid()).encode())
                return file


class Notifier:
    """Notify systemd by datagrams of `KEY=value` lines; without effect where it does not listen.

    The environment has NOTIFY_SOCKET (a path; a leading "@" denotes the abstract namespace; whether
    it is there is `active`). The socket stays open: a service that is out of file descriptors must
    still reset the watchdog.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        address = (environment or {}).get("NOTIFY_SOCKET", "")
        self.active = address.startswith(("/", "@")) and hasattr(socket, "AF_UNIX")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        if self.active:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    def send(self, **values: object) -> None:
        """Send values of sd_notify(3), such as READY=1; STATUS is a line for `systemctl status`.

        Send WATCHDOG=1 from the receive loop only, which the watchdog supervises.
        """
        if self.active:
            lines = (f"{key}={printable(' '.join(str(v).split()))}" for key, v in values.items())
            with suppress(OSError):  # systemd restarts, or its queue is full
                self._socket.sendto("\n".join(lines).encode(), self._address)

    def close(self) -> None:
        """Close the socket."""
        if self.active:
            self._socket.close()
