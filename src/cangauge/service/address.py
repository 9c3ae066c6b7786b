"""Where HTTP is served, and who may ask: loopback, or a bearer token.

The token comes from a file or the environment, never from the command line, which other users of
the machine can read.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Final

from cangauge.errors import InputError

TOKEN_VARIABLE: Final = "CANGAUGE_HTTP_TOKEN"  # noqa: S105 - the variable's name, no secret
LOOPBACK: Final = "127.0.0.1"
SHORTEST_TOKEN: Final = 16
LONGEST_TOKEN: Final = 1024


@dataclass(frozen=True, slots=True)
class HttpAddress:
    """Where to listen.

    Parameters
    ----------
    host : str
        IP address, or "localhost".
    port : int
        0: any free one.
    token : str or None
        What a request must bear.
    """

    host: str
    port: int
    token: str | None = field(default=None, repr=False)

    def __str__(self) -> str:
        """Return it as it is written in a URL."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def http_address(
    text: str,
    token_file: str | PathLike[str] | None = None,
    environment: Mapping[str, str] | None = None,
) -> HttpAddress:
    """Return where to listen and the token, if the two go together.

    Parameters
    ----------
    text : str
        "9464" (on loopback), "127.0.0.1:9464", "0.0.0.0:9464", "[::1]:9464".
    token_file : path-like, optional
        By default the environment variable `TOKEN_VARIABLE`, if there is one.
    environment : mapping, optional

    Raises
    ------
    InputError
        If it is no address, the token cannot be read or is too short, or the address is not
        loopback and there is no token.
    """
    host, port = _host_and_port(text)
    token = read_token(token_file, os.environ if environment is None else environment)
    if token is None and not is_loopback_name(host):
        raise InputError(
            "this address is open to the network, and there is no token",
            field="http",
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


def _host_and_port(text: str) -> tuple[str, int]:
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
            "no address of HOST:PORT, the host an IP address or localhost",
            field="http",
            value=text,
            cure=f"write it as {LOOPBACK}:9464",
        )
    return host, number


def read_token(path: str | PathLike[str] | None, environment: Mapping[str, str]) -> str | None:
    """Return the token in a file, or in the environment; None if there is neither.

    Raises
    ------
    InputError
        If it cannot be read, or is too short or no printable text.
    """
    if path is None:
        given = environment.get(TOKEN_VARIABLE)
        return None if given is None else _checked(given, TOKEN_VARIABLE)
    try:
        with Path(path).open("rb") as file:
            content = file.read(LONGEST_TOKEN + 2).decode("utf-8")
    except FileNotFoundError as error:
        raise InputError(
            "no such file", source=path, field="http_token_file", cure="check the path"
        ) from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise InputError(
            f"cannot be read: {reason}", source=path, field="http_token_file"
        ) from error
    return _checked(content, str(path))


def _checked(content: str, source: str) -> str:
    token = content.strip()
    if not SHORTEST_TOKEN <= len(token) <= LONGEST_TOKEN or not token.isascii() or " " in token:
        # The value is a secret, if a bad one: it is not repeated.
        raise InputError(
            f"a token is {SHORTEST_TOKEN} to {LONGEST_TOKEN} printable characters without spaces",
            source=source,
            field="http_token",
            cure="make one: python -c 'import secrets; print(secrets.token_urlsafe())'",
        )
    return token
