"""The status of a running service: its object, its unix socket, and a client of that.

There is one path: BUS.sock in the runtime folder of the user or of systemd. A connection to it
answers with one JSON object and ends, so `nc -U PATH` shows it.
"""

from __future__ import annotations

import json
import logging
import os
import re
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

from cangauge._files import is_own, written_name
from cangauge._logging import emit
from cangauge.errors import CangaugeError, InputError
from cangauge.service.worker import start_thread
from cangauge.types import Reason, reason_name

SCHEMA: Final = 1
"""Version of the JSON object of `/status`. This module imports no estimator."""
SHOW_EVERY_S: Final = 0.1
"""Interval of the snapshots [s]: that of SOC_ESTIMATE."""
STUCK_S: Final = 2.0
"""Age of a snapshot above which the receive loop counts as stuck, and its SoC as stale [s]."""
BOUNDS_S: Final = (
    5e-6,
    1e-5,
    2e-5,
    5e-5,
    1e-4,
    2e-4,
    5e-4,
    1e-3,
    2e-3,
    5e-3,
    1e-2,
    2e-2,
    5e-2,
    0.1,
    0.2,
    0.5,
    1.0,
)
"""Upper bounds of the buckets of a histogram [s]; one more bucket holds larger values."""
ANSWER_WITHIN_S: Final = 3.0
"""Longest wait for an answer [s]."""
SEND_WITHIN_S: Final = 0.5
"""Longest wait for a client that does not read [s]; the next one waits as long."""
SYSTEM_FOLDER: Final = Path("/run/cangauge")
"""Folder of the systemd units, one subfolder for each service."""
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The object of `/status` (finite numbers, text and None) as of a monotonic time [s]."""

    made_s: float
    status: dict[str, Any]

    def at(self, now_s: float) -> dict[str, Any]:
        """Return the object of `/status` at a monotonic time [s]: older, stale once stuck."""
        status = dict(self.status)
        later_s = max(now_s - self.made_s, 0.0)
        status["uptime_s"] += later_s
        status["loop_age_s"] += later_s
        sample = status["sample"]
        if sample is not None and sample["age_s"] is not None:
            status["sample"] = sample | {"age_s": sample["age_s"] + later_s}
        if status["loop_age_s"] > STUCK_S:
            status |= {"loop_stuck": True, "status": "invalid"}
            status["reasons"] = sorted({*status["reasons"], *reason_ids(Reason.INPUT_STALE)})
        return status


def value_at(table: Mapping[str, Any], place: str) -> Any:
    """Return the value at a place in nested tables, such as "sample.current_a"; None if absent."""
    value: Any = table
    for part in place.split("."):
        value = None if value is None else value.get(part)
    return value


def reason_ids(reasons: Reason) -> list[str]:
    """Return the names of the reasons, such as "delay_line_filling"."""
    return [reason_name(each).replace(" ", "_") for each in Reason if each and reasons & each]


class NotRunningError(CangaugeError):
    """No service answers."""


def runtime_folders() -> list[Path]:
    """Return the folders for sockets, the preferred one first."""
    runtime = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    session = os.environ.get("XDG_RUNTIME_DIR", "")
    folders = [Path(runtime)] if runtime else []
    folders += [Path(session) / "cangauge"] if session else []
    user = os.getuid() if hasattr(os, "getuid") else 0
    return [*folders, Path("/tmp") / f"cangauge-{user}"]  # noqa: S108 - private: mode 0700


def _is_anothers(folder: Path) -> bool:
    """Return whether a folder is another user's, who can replace the sockets in it."""
    try:
        return not is_own(folder.lstat())
    except OSError:  # none there
        return False


def socket_path(bus: str) -> Path:
    """Return the socket of a service on a bus, such as "socketcan can0"."""
    name = re.sub(r"[^A-Za-z0-9.]+", "-", bus).strip("-.")[:40]
    return runtime_folders()[0] / f"{name}.sock"


class StatusSocket:
    """Answer each connection with the JSON object that `status` returns, in a thread.

    A socket that nobody serves is replaced. InputError if another service uses it, another file
    has this name, or it cannot be created.
    """

    def __init__(self, path: Path, status: Callable[[], dict[str, Any]]) -> None:
        self._path = path
        self._status = status
        self._is_closed = False
        try:
            if not hasattr(socket, "AF_UNIX"):
                raise OSError("this system has no unix sockets in Python")  # noqa: TRY301 - as below
            written_name(path)  # not through a link of another user
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            if path.parent in runtime_folders() and _is_anothers(path.parent):
                raise OSError("another user has made its folder")  # noqa: TRY301 - as below
            if is_served(path):
                raise OSError("another service uses this socket")  # noqa: TRY301 - as below
            if path.is_socket():
                path.unlink()
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            self._socket.bind(str(path))
            path.chmod(0o660)
            self._socket.listen(16)
        except OSError as error:
            raise InputError(
                f"cannot be created: {error.strerror or error}",
                source=path,
                field="status_socket",
                cure="name another one, or off",
            ) from error
        try:
            start_thread(self._serve, "cangauge-status")
        except CangaugeError:
            self.close()
            raise

    def close(self) -> None:
        """Remove the socket; the thread ends."""
        self._is_closed = True
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes the thread
        self._socket.close()
        self._path.unlink(missing_ok=True)

    def _serve(self) -> None:
        while not self._is_closed:
            try:
                connection, _ = self._socket.accept()
            except OSError as error:  # out of descriptors, or closed
                if not self._is_closed:
                    emit(_LOG.warning, "status.failed", f"no connection accepted: {error}")
                    time.sleep(SEND_WITHIN_S)
                continue
            with connection, suppress(OSError):
                connection.settimeout(SEND_WITHIN_S)
                connection.sendall(json.dumps(self._status(), ensure_ascii=False).encode() + b"\n")


def is_served(path: Path) -> bool:
    """Return whether a process listens on a unix socket."""
    try:
        with _connected(path):
            return True
    except OSError as error:  # one that is busy, or of another user, is served
        return path.is_socket() and not isinstance(error, ConnectionRefusedError)


def find_socket(name: str = "*.sock") -> Path:
    """Return the socket of the running service, if several by its name.

    Raises
    ------
    NotRunningError
        If there is none.
    InputError
        If there are several.
    """
    found: list[Path] = []
    with suppress(OSError):  # a folder that this user may not read
        own = [each for each in runtime_folders() if not _is_anothers(each)]
        for folder in (*own, SYSTEM_FOLDER, *SYSTEM_FOLDER.glob("*")):
            found += [each for each in sorted(folder.glob(name)) if is_served(each)]
    found = list(dict.fromkeys(found))
    if not found:
        raise NotRunningError(
            "no running service found: start `cangauge run`, or give --endpoint"
            " (another user's service may need more permissions)"
        )
    if len(found) > 1:
        raise InputError(
            "several services are running",
            field="--endpoint",
            cure=f"give one of {', '.join(str(path) for path in found)}",
        )
    return found[0]


def fetch_status(path: Path) -> dict[str, Any]:
    """Return the status of the service at a unix socket: the JSON object of `/status`.

    Raises
    ------
    NotRunningError
        If no service answers.
    CangaugeError
        If the answer is not a status.
    """
    answer = b""
    until_s = time.monotonic() + ANSWER_WITHIN_S
    try:
        with _connected(path) as connection:
            while len(answer) < 1 << 20 and (part := connection.recv(1 << 16)):
                answer += part
                connection.settimeout(max(until_s - time.monotonic(), 1e-3))
    except OSError as error:
        raise NotRunningError(f"{path}: no service answers: {error.strerror or error}") from error
    try:
        content = json.loads(answer)
        if content["schema"] == SCHEMA:
            return cast("dict[str, Any]", content)
    except (ValueError, KeyError, TypeError, RecursionError):
        pass
    raise no_status(path)


def no_status(path: Path) -> CangaugeError:
    """Return the error for an answer that is no status."""
    return CangaugeError(f"{path}: the answer is not a status of this release of cangauge")


def _connected(path: Path) -> socket.socket:
    """Return a connection to a unix socket; may raise OSError."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.settimeout(ANSWER_WITHIN_S)
    try:
        connection.connect(str(path))
    except OSError:
        connection.close()
        raise
    return connection
