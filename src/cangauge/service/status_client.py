"""Fetch the status of a running service by its unix socket or by HTTP."""

from __future__ import annotations

import http.client
import json
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, cast
from urllib.parse import urlsplit

from cangauge.errors import CangaugeError, InputError
from cangauge.service.addresses import read_token, served_sockets

SCHEMA: Final = 1
"""Version of the JSON object of `/status`. Defined here, so that a client need not import the
estimator."""
ANSWER_WITHIN_S: Final = 3.0
LARGEST_ANSWER: Final = 1 << 20


class NotRunningError(CangaugeError):
    """No service answers."""


def find_socket() -> Path:
    """Return the unix socket of the running service.

    Raises
    ------
    NotRunningError
        If no service runs.
    InputError
        If several services run.
    """
    found = served_sockets()
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


def fetch_status(endpoint: str, token_file: Path | None = None) -> dict[str, Any]:
    """Return the status of a service: the JSON object of `/status`.

    Parameters
    ----------
    endpoint : str
        Path of a unix socket, or "http://host:port".
    token_file : Path, optional
        File with the token for HTTP; by default the environment's. A unix socket needs none.

    Raises
    ------
    InputError
        If the endpoint is neither of both.
    NotRunningError
        If no service answers.
    CangaugeError
        If the request is refused, or the answer is not a status.
    """
    headers = {}
    connection: http.client.HTTPConnection
    if "://" in endpoint:
        connection = _http(endpoint)
        token = read_token(token_file, os.environ)
        if token is not None:
            headers["Authorization"] = f"Bearer {token}"
    else:
        connection = _UnixConnection(endpoint)
    timer: threading.Timer | None = None
    try:
        connection.connect()
        # The time-out of the socket is one of each read: a server could answer byte by byte.
        timer = threading.Timer(ANSWER_WITHIN_S, _shut_down, (connection.sock,))
        timer.start()
        connection.request("GET", "/status", headers=headers)
        response = connection.getresponse()
        body = response.read(LARGEST_ANSWER)
    except (OSError, http.client.HTTPException) as error:
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise NotRunningError(f"{endpoint}: no service answers: {reason}") from error
    finally:
        if timer is not None:
            timer.cancel()
        connection.close()
    if response.status != http.client.OK:
        answer = " ".join(body[:200].decode("utf-8", "replace").split())
        raise CangaugeError(f"{endpoint}: refused ({response.status}): {answer}")
    return _content(body, endpoint)


def _shut_down(connected: socket.socket) -> None:
    with suppress(OSError):
        connected.shutdown(socket.SHUT_RDWR)


def _http(endpoint: str) -> http.client.HTTPConnection:
    try:
        parts = urlsplit(endpoint)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if host is None or parts.scheme not in {"http", "https"}:
        raise InputError(
            "neither the path of a unix socket nor a URL",
            field="--endpoint",
            value=endpoint,
            cure="write it as http://127.0.0.1:9464",
        )
    kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
    return kind(host, port, timeout=ANSWER_WITHIN_S)


class _UnixConnection(http.client.HTTPConnection):
    def __init__(self, path: str) -> None:
        super().__init__("localhost", timeout=ANSWER_WITHIN_S)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(ANSWER_WITHIN_S)
        self.sock.connect(self._path)


def _content(body: bytes, endpoint: str) -> dict[str, Any]:
    try:
        content = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise CangaugeError(f"{endpoint}: the answer is not a status of cangauge") from error
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        raise CangaugeError(f"{endpoint}: the answer is not a status of this release of cangauge")
    for problem in _misfits(content, _SHAPE, ""):
        raise CangaugeError(f"{endpoint}: the answer is not a status of cangauge:{problem}")
    return cast("dict[str, Any]", content)


_Number = (int, float, type(None))
_Durations: Final = {"count": int, "p50_at_most_s": _Number, "p99_at_most_s": _Number}
_SHAPE: Final[dict[str, Any]] = {
    **dict.fromkeys(("version", "bus", "vehicle", "model", "method"), str),
    **dict.fromkeys(("time_source", "core", "status"), str),
    "reasons": [str],
    "uptime_s": (int, float),
    "loop_stuck": bool,
    "estimate": dict.fromkeys(
        (
            "soc_pct",
            "soc_std_pct",
            "soc_newton_pct",
            "soc_coulomb_pct",
            "voltage_model_v",
            "residual_v",
        ),
        _Number,
    ),
    "sample": (
        None,
        dict.fromkeys(("age_s", "current_a", "voltage_v", "temperature_c"), _Number),
    ),
    "samples": int,
    "samples_per_s": _Number,
    "frames": {"received": int, "used": int, "lost": int},
    "rejects": {"": int},
    "bus_up": bool,
    "bus_counts": {"": int},
    "bus_trouble": (str, type(None)),
    "config": {"reloading": bool, "problem": (str, type(None))},
    "health": (
        None,
        dict.fromkeys(
            ("capacity_ah", "capacity_std_ah", "resistance_ratio", "resistance_std", "offset_a"),
            _Number,
        ),
    ),
    "power": (
        None,
        dict.fromkeys(
            (
                "discharge_a",
                "discharge_std_a",
                "charge_a",
                "charge_std_a",
                "energy_wh",
                "energy_std_wh",
            ),
            _Number,
        ),
    ),
    "cells": (
        None,
        {
            "weakest": (int, type(None)),
            "cells": int,
            **dict.fromkeys(
                ("soc_pct", "soc_std_pct", "spread_pct", "sum_error_v", "sum_std_v"), _Number
            ),
        },
    ),
    "notices": [str],
    "latency": _Durations,
    "step": _Durations,
    "record": (
        None,
        {
            "path": str,
            "frames": int,
            "lost_frames": int,
            "written_bytes": int,
            "problem": (str, type(None)),
            "active": bool,
        },
    ),
}
"""What `cangauge status` and `cangauge monitor` need of an answer: types by key, of every item of a
list, of every value of an object whose keys may be any (""); a pair with None may be null."""
_LARGEST: Final = 1e18


def _misfits(value: Any, shape: Any, place: str) -> Iterator[str]:
    """Yield where a value differs from a shape."""
    if isinstance(shape, tuple) and shape[0] is None:
        if value is not None:
            yield from _misfits(value, shape[1], place)
    elif isinstance(shape, list | dict):
        if not isinstance(value, type(shape)):
            yield f"{place} has a wrong type"
            return
        for key, of_key in _items(value, shape):
            if isinstance(value, dict) and key not in value:
                yield f"{place} {key} is missing"
            else:
                yield from _misfits(value[key], of_key, f"{place} {key}")
    elif not isinstance(value, shape) or (isinstance(value, bool) and shape is not bool):
        yield f"{place} has a wrong type"
    elif isinstance(value, int) and abs(value) > _LARGEST:
        yield f"{place} is too large"


def _items(value: Any, shape: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each key or index that a list or an object must have, with its shape."""
    if isinstance(shape, list):
        yield from ((index, shape[0]) for index in range(len(value)))
    elif "" in shape:
        yield from ((key, shape[""]) for key in value)
    else:
        yield from shape.items()
