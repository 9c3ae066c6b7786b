"""Addresses reachable over the network, and their secrets.

An address beyond loopback requires a bearer token. Secrets come from a file or the environment,
never from the command line, which other users of the machine can read.
"""

from __future__ import annotations

import ipaddress
import logging
import os
import socket
import ssl
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from typing import TYPE_CHECKING, Final

from cangauge._files import open_regular
from cangauge._logging import emit
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.service.config import MqttConfig, RunConfig

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
        IP address.
    port : int
        0: any free one.
    token : str or None
        Bearer token that requests need.
    key : str
        Key of the configuration, for messages.
    """

    host: str
    port: int
    token: str | None = field(default=None, repr=False)
    key: str = "http"

    def __str__(self) -> str:
        """Return the address as in a URL."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    def listen(self) -> socket.socket:
        """Return a listening socket; raise InputError if the address cannot be bound."""
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        try:
            return socket.create_server((self.host, self.port), family=family, backlog=128)
        except OSError as error:
            raise InputError(
                f"cannot listen: {error.strerror or error}",
                field=self.key,
                value=str(self),
                cure="choose another port",
            ) from error


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
    host, colon, port = text.strip().rpartition(":")
    host = host.removeprefix("[").removesuffix("]") if colon else LOOPBACK
    if host.lower() == "localhost":
        host = LOOPBACK
    try:
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
    token = read_token(token_file, os.environ if environment is None else environment)
    if token is None and not is_loopback_name(host):
        raise InputError(
            "this address is reachable from the network, and there is no token",
            field=field,
            value=text,
            cure=f"put a token into a file for http_token_file or into {TOKEN_VARIABLE},"
            f" or listen on {LOOPBACK}:{number}",
        )
    return HttpAddress(host, number, token, field)


def is_loopback_name(host: str) -> bool:
    """Return whether a host is this machine's loopback: "localhost", 127.…, ::1."""
    host = host.removeprefix("[").removesuffix("]").lower()
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def read_token(path: str | PathLike[str] | None, environment: Mapping[str, str]) -> str | None:
    """Return the token in a file, or in the environment; None if there is neither.

    Raises
    ------
    InputError
        If it cannot be read, is too short, or is not printable text.
    """
    text = environment.get(TOKEN_VARIABLE)
    if path is not None:
        text = _read_secret(path, "http.token_exposed", "token", "http_token_file")
    if text is None:
        return None
    token = text.strip()
    if not SHORTEST_TOKEN <= len(token) <= LONGEST_TOKEN or not token.isascii() or " " in token:
        # The value is not quoted: it may be a secret.
        raise InputError(
            f"a token is {SHORTEST_TOKEN} to {LONGEST_TOKEN} printable characters without spaces",
            source=path or TOKEN_VARIABLE,
            field="http_token",
            cure="make one: python -c 'import secrets; print(secrets.token_urlsafe())'",
        )
    return token


def http_addresses(config: RunConfig) -> dict[str, HttpAddress]:
    """Return the addresses that a configuration has, by key; may raise InputError."""
    given = {"http": config.http, "dashboard": config.dashboard}
    return {
        key: http_address(text, config.http_token_file, field=key)
        for key, text in given.items()
        if text is not None
    }


def mqtt_password(config: MqttConfig) -> str | None:
    """Return the password in its file, or in the environment; None if there is neither.

    Raises
    ------
    InputError
        If it cannot be read, is no line of text, or belongs to no user.
    """
    password = os.environ.get(MQTT_PASSWORD_VARIABLE)
    if (path := config.password_file) is not None:
        text = _read_secret(path, "mqtt.password_exposed", "password", "mqtt.password_file")
        password = text.rstrip("\r\n")
        if not 0 < len(password) <= LONGEST_TOKEN or not password.isprintable():
            raise InputError(
                f"a password is one line of 1 to {LONGEST_TOKEN} printable characters",
                source=path,
                field="mqtt.password_file",
            )
    if password is not None and config.user is None:
        cure = "name the user whose password is given"
        raise InputError("is missing", field="mqtt.user", cure=cure)
    return password


def mqtt_tls(config: MqttConfig) -> ssl.SSLContext | None:
    """Return the certificates to check the broker by; None where it is not encrypted.

    Raises
    ------
    InputError
        If they cannot be read.
    """
    if not config.tls:
        return None
    try:
        return ssl.create_default_context(cafile=config.ca_file)
    except OSError as error:
        raise InputError(
            f"no certificates can be read: {error}",
            field="mqtt.ca_file",
            value=config.ca_file,
            cure="name a PEM file",
        ) from error


def _read_secret(path: str | PathLike[str], event: str, kind: str, key: str) -> str:
    with open_regular(path) as file:
        rights = os.fstat(file.fileno()).st_mode
        data = file.read(LONGEST_TOKEN + 2)
    if rights & (stat.S_IROTH | stat.S_IWOTH):
        text = f"{path}: every user of this machine can read or change this {kind}: chmod 600 it"
        emit(_LOG.warning, event, text, path=str(path))
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError("not UTF-8 text", source=path, field=key) from error
