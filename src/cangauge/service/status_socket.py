"""Unix sockets for the status: made so that only their owner's and group's users ask there."""

from __future__ import annotations

import os
import re
import socket
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from cangauge.errors import InputError

SOCKET_MODE: Final = 0o660
LONGEST_NAME: Final = 40
SYSTEM_FOLDER: Final = Path("/run/cangauge")
"""Where the systemd unit has its services put them, each in a folder of its own."""

_PROBE_S: Final = 1.0


def has_unix_sockets() -> bool:
    """Return whether this system has them (Python on Windows has not)."""
    return hasattr(socket, "AF_UNIX")


def open_unix(path: Path) -> socket.socket:
    """Return a listening unix socket; one that nobody serves any more is replaced.

    Raises
    ------
    InputError
        If another service serves it, a file stands there, or it cannot be made.
    """
    if not has_unix_sockets():
        raise _bad(path, "this system has no unix sockets in Python", "take --http, or off")
    if is_served(path):
        raise _bad(path, "another service shows its status there", "name another one")
    try:
        if path.is_socket():
            path.unlink()
        server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            server.setblocking(False)
            server.bind(str(path))
            path.chmod(SOCKET_MODE)
            server.listen(16)
        except (OSError, ValueError):
            server.close()
            raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise _bad(path, f"cannot be made: {reason}", "name a writable folder, or off") from error
    return server


def is_served(path: Path) -> bool:
    """Return whether somebody listens on a unix socket."""
    try:
        if not path.is_socket():
            return False
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.settimeout(_PROBE_S)
            probe.connect(str(path))
    except (ConnectionRefusedError, FileNotFoundError):
        return False
    except (OSError, ValueError):  # busy, or not ours to ask: somebody's
        return True
    return True


def default_path(bus: str) -> Path:
    """Return where a service on a bus puts its socket, if it is not told.

    The folder is made; sockets that ended services left behind in it are removed.

    Raises
    ------
    InputError
        If the folder cannot be made, or belongs to somebody else.
    """
    folder = _own_folder()
    for left in folder.glob("*.sock"):
        if not is_served(left):
            left.unlink(missing_ok=True)
    name = re.sub(r"[^A-Za-z0-9.]+", "-", bus).strip("-.")[:LONGEST_NAME]
    return folder / f"{name or 'bus'}-{os.getpid()}.sock"


def served_sockets() -> list[Path]:
    """Return the sockets of the services that run, as far as this user can see them."""
    return [path for path in _candidates() if is_served(path)]


def _candidates() -> Iterator[Path]:
    if not has_unix_sockets():
        return
    seen = set()
    for folder in (*_folders(), SYSTEM_FOLDER, *sorted(SYSTEM_FOLDER.glob("*"))):
        try:
            found = sorted(folder.glob("*.sock"))
        except OSError:  # a folder that this user may not read
            continue
        for path in found:
            if path not in seen:
                seen.add(path)
                yield path


def _folders() -> list[Path]:
    """Return where a socket may be put, the best place first."""
    runtime = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    session = os.environ.get("XDG_RUNTIME_DIR", "")
    folders = [Path(runtime)] if runtime else []
    folders += [Path(session) / "cangauge"] if session else []
    # Anybody may write there, so the folder is used only if it is ours alone.
    return [*folders, Path("/tmp") / f"cangauge-{os.getuid()}"]  # noqa: S108 - see above


def _own_folder() -> Path:
    folder = _folders()[0]
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = folder.lstat()
    except OSError as error:
        raise _bad(folder, f"cannot be made: {error.strerror}", "name a socket") from error
    others_write = stat.S_IMODE(state.st_mode) & 0o022
    if not stat.S_ISDIR(state.st_mode) or state.st_uid != os.getuid() or others_write:
        raise _bad(folder, "this folder is not this user's alone", "name a socket elsewhere")
    return folder


def _bad(path: Path, problem: str, cure: str) -> InputError:
    return InputError(problem, source=path, field="status_socket", cure=cure)
