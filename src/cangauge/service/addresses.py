"""Addresses that serve a service's status: HTTP with tokens, and unix sockets.

HTTP beyond loopback requires a bearer token. The token comes from a file or the environment, never
from the command line, which other users of the machine can read. Unix sockets are open to their
owner and group.
"""

from __future__ import annotations

import ipaddress
import logging
import os
import re
import socket
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Final

from cangauge._files import open_regular
from cangauge._logging import emit
from cangauge.errors import InputError

_LOG = logging.getLogger(__name__)

TOKEN_VARIABLE: Final = "CANGAUGE_HTTP_TOKEN"  # noqa: S105 - the variable's name, no secret
MQTT_PASSWORD_VARIABLE: Final = "CANGAUGE_MQTT_PASSWORD"  # noqa: S105 - as above
LOOPBACK: Final = "127.0.0.1"
SHORTEST_TOKEN: Final = 16
LONGEST_TOKEN: Final = 1024


@dataclass(frozen=True, slots=True)
class HttpAddress:
    """Address to listen on.

    Parameters
    ----------
    host : str
        IP address, or "localhost".
    port : int
        0: any free one.
    token : str or None
        Bearer token that requests need.
    """

    host: str
    port: int
    token: str | None = field(default=None, repr=False)

    def __str__(self) -> str:
        """Return the address as in a URL."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def http_address(
    text: str,
    token_file: str | PathLike[str] | None = None,
    environment: Mapping[str, str] | None = None,
    field: str = "http",
) -> HttpAddress:
    """Return the address and its token; an address beyond loopback needs one.

    Parameters
    ----------
    text : str
        "9464" (on loopback), "127.0.0.1:9464", "0.0.0.0:9464", "[::1]:9464".
    token_file : path-like, optional
        By default the environment variable `TOKEN_VARIABLE`, if there is one.
    environment : mapping, optional
    field : str
        Key of the address, for messages.

    Raises
    ------
    InputError
        If the address is invalid, the token cannot be read or is too short, or the address is
        not loopback and there is no token.
    """
    host, port = _host_and_port(text, field)
    token = read_token(token_file, os.environ if environment is None else environment)
    if token is None and not is_loopback_name(host):
        raise InputError(
            "this address is reachable from the network, and there is no token",
            field=field,
            value=text,
            cure=f"put a token into a file for --http-token-file or into {TOKEN_VARIABLE},"
            f" or listen on {LOOPBACK}:{port}",
        )
    return HttpAddress(host, port, token)


def is_loopback_name(host: str) -> bool:
    """Return whether a host is this machine's loopback: "localhost", 127.…, ::1."""
    host = host.removeprefix("[").removesuffix("]").lower()
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _host_and_port(text: str, field: str) -> tuple[str, int]:
    host, colon, port = text.strip().rpartition(":")
    if not colon:
        host = LOOPBACK
    host = host.removeprefix("[").removesuffix("]")
    try:
        if host.lower() != "localhost":
            ipaddress.ip_address(host)
        number = int(port)
    except ValueError:
        number = -1
    if not 0 <= number <= 65535:
        raise InputError(
            "not an address HOST:PORT with an IP address or localhost",
            field=field,
            value=text,
            cure=f"write it as {LOOPBACK}:9464",
        )
    return host, number


def read_token(path: str | PathLike[str] | None, environment: Mapping[str, str]) -> str | None:
    """Return the token in a file, or in the environment; None if there is neither.

    Raises
    ------
    InputError
        If it cannot be read, is too short, or is not printable text.
    """
    if path is None:
        given = environment.get(TOKEN_VARIABLE)
        return None if given is None else _checked(given, TOKEN_VARIABLE)
    text = _read_secret(path, "http.token_exposed", "token", "http_token_file")
    return _checked(text, str(path))


def read_mqtt_password(
    path: str | PathLike[str] | None, environment: Mapping[str, str]
) -> str | None:
    """Return the password in a file, or in the environment; None if there is neither.

    Raises
    ------
    InputError
        If it cannot be read, or is empty, too long or not UTF-8 text of one line.
    """
    if path is None:
        return environment.get(MQTT_PASSWORD_VARIABLE)
    text = _read_secret(path, "mqtt.password_exposed", "password", "mqtt.password_file")
    password = text.rstrip("\r\n")
    if not 0 < len(password) <= LONGEST_TOKEN or not password.isprintable():
        raise InputError(
            f"a password is one line of 1 to {LONGEST_TOKEN} printable characters",
            source=path,
            field="mqtt.password_file",
        )
    return password


def _read_secret(path: str | PathLike[str], event: str, kind: str, key: str) -> str:
    with open_regular(path) as file:
        rights = os.fstat(file.fileno()).st_mode
        data = file.read(LONGEST_TOKEN + 2)
    if rights & (stat.S_IROTH | stat.S_IWOTH):
        emit(
            _LOG,
            logging.WARNING,
            event,
            f"{path}: every user of this machine can read or change this {kind}: chmod 600 it",
            path=str(path),
        )
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError("not UTF-8 text", source=path, field=key) from error


def _checked(content: str, source: str) -> str:
    token = content.strip()
    if not SHORTEST_TOKEN <= len(token) <= LONGEST_TOKEN or not token.isascii() or " " in token:
        # The value is not quoted: it may be a secret.
        raise InputError(
            f"a token is {SHORTEST_TOKEN} to {LONGEST_TOKEN} printable characters without spaces",
            source=source,
            field="http_token",
            cure="make one: python -c 'import secrets; print(secrets.token_urlsafe())'",
        )
    return token


# --- Unix sockets

SOCKET_MODE: Final = 0o660
LONGEST_NAME: Final = 40
SYSTEM_FOLDER: Final = Path("/run/cangauge")
"""Folder of the systemd units, one subfolder for each service."""

_PROBE_S: Final = 1.0


def has_unix_sockets() -> bool:
    """Return whether Python has unix sockets here (not on Windows)."""
    return hasattr(socket, "AF_UNIX")


def open_unix(path: Path) -> socket.socket:
    """Return a listening unix socket; a stale one is replaced.

    Raises
    ------
    InputError
        If another service uses it, a file or another user's socket has this name, or it cannot be
        created.
    """
    if not has_unix_sockets():
        raise _bad(path, "this system has no unix sockets in Python", "use --http, or off")
    if is_served(path):
        raise _bad(path, "another service uses this socket", "name another one")
    try:
        if path.is_socket():
            if path.lstat().st_uid != os.geteuid():
                raise _bad(path, "this socket belongs to another user", "name another one")
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
        raise _bad(
            path, f"cannot be created: {reason}", "name a writable folder, or off"
        ) from error
    return server


def is_served(path: Path) -> bool:
    """Return whether a process listens on a unix socket."""
    try:
        if not path.is_socket():
            return False
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.settimeout(_PROBE_S)
            probe.connect(str(path))
    except (ConnectionRefusedError, FileNotFoundError):
        return False
    except (OSError, ValueError):  # busy, or of another user
        return True
    return True


def default_path(bus: str) -> Path:
    """Return the default socket of a service on a bus.

    The folder is created, and stale sockets in it are removed.

    Raises
    ------
    InputError
        If the folder cannot be created, or is not private to this user.
    """
    folder = _own_folder()
    for left in folder.glob("*.sock"):
        if left.is_socket() and not is_served(left):
            left.unlink(missing_ok=True)
    name = re.sub(r"[^A-Za-z0-9.]+", "-", bus).strip("-.")[:LONGEST_NAME]
    return folder / f"{name or 'bus'}-{os.getpid()}.sock"


def served_sockets() -> list[Path]:
    """Return the sockets of running services that this user can see.

    In a folder that anybody could have made (in `/tmp`), only those of this user or root.
    """
    return [path for path in _candidates() if _is_trusted(path) and is_served(path)]


def _is_trusted(path: Path) -> bool:
    """Return whether a socket is of this user or root, unless only they could have made it."""
    folder = path.parent
    try:
        if not folder.parent.stat().st_mode & stat.S_IWOTH:
            return True
        return all(
            each.st_uid in {os.getuid(), 0} and not each.st_mode & unwanted
            for each, unwanted in (
                (folder.lstat(), stat.S_IWGRP | stat.S_IWOTH),
                (path.lstat(), stat.S_IWOTH),
            )
        ) and stat.S_ISDIR(folder.lstat().st_mode)
    except OSError:  # gone, or in a folder that this user may not read
        return False


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
    """Return the folders for sockets, the preferred one first."""
    runtime = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    session = os.environ.get("XDG_RUNTIME_DIR", "")
    folders = [Path(runtime)] if runtime else []
    folders += [Path(session) / "cangauge"] if session else []
    # World-writable, so the folder is used only if it is private to this user.
    return [*folders, Path("/tmp") / f"cangauge-{os.getuid()}"]  # noqa: S108 - see above


def _own_folder() -> Path:
    folder = _folders()[0]
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = folder.lstat()
    except OSError as error:
        raise _bad(folder, f"cannot be created: {error.strerror}", "name a socket") from error
    others_write = stat.S_IMODE(state.st_mode) & 0o022
    if not stat.S_ISDIR(state.st_mode) or state.st_uid != os.getuid() or others_write:
        raise _bad(folder, "this folder is not private to this user", "name a socket elsewhere")
    return folder


def _bad(path: Path, problem: str, cure: str) -> InputError:
    return InputError(problem, source=path, field="status_socket", cure=cure)
