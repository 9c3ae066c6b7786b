"""`cangauge status` reads any server's answer: one line and exit 1, never a traceback or a hang."""

from __future__ import annotations

import copy
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cangauge.cli import status as status_module
from cangauge.cli.monitor import status_line
from cangauge.cli.monitor_screen import lines as screen_lines
from cangauge.errors import CangaugeError
from cangauge.service import status_client
from cangauge.service.status_client import fetch_status
from cangauge.service.status_feed import StatusFeed
from live import in_process

NUMBERS = dict.fromkeys(
    (
        "soc_pct", "soc_std_pct", "soc_newton_pct", "soc_coulomb_pct", "voltage_model_v",
        "residual_v",
    ),
    1.5,
)  # fmt: skip
GOOD: dict[str, Any] = {
    "schema": 1, "version": "0.1.0", "bus": "can0", "vehicle": "x", "model": "m.json",
    "method": "ekf", "time_source": "receive", "core": "python",
    "status": "valid", "reasons": ["input_stale"],
    "uptime_s": 3.0, "loop_stuck": False, "estimate": NUMBERS,
    "sample": {"age_s": 0.1, "current_a": 1.0, "voltage_v": None, "temperature_c": 20},
    "samples": 5, "samples_per_s": 1.0, "frames": {"received": 1, "used": 1, "lost": 0},
    "rejects": {"crc_errors": 2}, "bus_up": True, "bus_counts": {"losses": 0}, "bus_trouble": None,
    "health": {
        "capacity_ah": 60.0, "capacity_std_ah": 2.0, "resistance_ratio": 1.0,
        "resistance_std": 0.1, "offset_a": None,
    },
    "power": dict.fromkeys(
        (
            "discharge_a", "discharge_std_a", "charge_a", "charge_std_a", "energy_wh",
            "energy_std_wh",
        ),
        5.0,
    ),
    "cells": {
        "weakest": 3, "cells": 96, "soc_pct": 50.0, "soc_std_pct": 1.0, "spread_pct": 2.0,
        "sum_error_v": 0.1, "sum_std_v": None,
    },
    "notices": ["the cells' sum differs"],
    "config": {"reloading": False, "problem": "broken"},
    "latency": {"count": 1, "p50_at_most_s": 0.001, "p99_at_most_s": None},
    "step": {"count": 0, "p50_at_most_s": None, "p99_at_most_s": None},
    "record": {
        "path": "r.log", "frames": 1, "lost_frames": 0, "written_bytes": 9, "problem": None,
        "active": True,
    },
}  # fmt: skip


@contextmanager
def server(path: Path, answer: Callable[[socket.socket], None]) -> Iterator[None]:
    """Answer each connection to a unix socket."""
    listening = socket.socket(socket.AF_UNIX)
    listening.bind(str(path))
    listening.listen(8)

    def serve() -> None:
        while True:
            try:
                client, _ = listening.accept()
            except OSError:
                return
            with client, suppress(OSError):
                client.recv(4096)
                answer(client)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield
    finally:
        listening.shutdown(socket.SHUT_RDWR)
        listening.close()
        thread.join(5.0)


def as_http(content: object) -> bytes:
    body = content if isinstance(content, bytes) else json.dumps(content).encode()
    return b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % len(body) + body


def places(content: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items: Any = ()
    if isinstance(content, dict):
        items = content.items()
    elif isinstance(content, list):
        items = enumerate(content)
    return [place] * bool(place) + [
        each for key, item in items for each in places(item, (*place, key))
    ]


ODD: list[Any] = [
    None, True, 0, -1, 10**30, 10**400, 1e308, "", "x", [], [1], {}, {"x": "y"}, [[]], "\x1b[2J",
]  # fmt: skip


@settings(
    max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    changes=st.lists(
        st.tuples(st.sampled_from(places(GOOD)), st.sampled_from([*ODD, "remove"])), max_size=3
    )
)
def test_any_object_is_shown_or_refused(changes: list[tuple[tuple[Any, ...], Any]]) -> None:
    content = copy.deepcopy(GOOD)
    for place, value in changes:
        inner = content
        try:
            for part in place[:-1]:
                inner = inner[part]
            if value == "remove":
                del inner[place[-1]]
            else:
                inner[place[-1]] = value
        except (LookupError, TypeError, AttributeError):
            continue  # an earlier change replaced the place
    body = json.dumps(content).encode()
    try:
        found = status_client._content(body, "x")
    except CangaugeError:
        return
    assert status_module.status_rows(found)
    assert isinstance(found["status"] in status_module.USABLE, bool)
    feed = StatusFeed("x")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cangauge.service.status_feed.fetch_status", lambda *_: found)
        feed.poll()
    assert status_line(feed.view())
    assert len(screen_lines(feed.view(), 80, 23, 60.0, is_paused=False)) >= 20


def test_a_good_answer_is_shown(tmp_path: Path) -> None:
    with server(tmp_path / "s", lambda client: client.sendall(as_http(GOOD))):
        ended = in_process("status", "--endpoint", tmp_path / "s")
    assert ended.code == 0
    assert "the latest one is REFUSED" in ended.out


@pytest.mark.parametrize(
    "answer",
    [
        as_http([1]),
        as_http({"schema": 1}),
        as_http(GOOD | {"status": [1]}),
        as_http(GOOD | {"samples": 10**400}),
        as_http(b"[" * 100_000),
        as_http(b"\xff\xfe"),
        b"HTTP/1.1 200 OK\r\n\r\n" + b"x" * (3 << 20),
        b"HTTP/1.1 200 OK\r\n" + b"X: y\r\n" * 100_000,
        b"HTTP/1.1 200 OK\r\nX: " + b"y" * 1_000_000,
        b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzzz\r\n",
        b"",
        b"\x00\x1b[2J\n",
    ],
    ids=range(12),
)
def test_a_wrong_answer_is_one_line(tmp_path: Path, answer: bytes) -> None:
    with server(tmp_path / "s", lambda client: client.sendall(answer)):
        for more in ([], ["--json"]):
            ended = in_process("status", "--endpoint", tmp_path / "s", *more)
            assert ended.code == 1
            assert "Traceback" not in ended.err
            assert "\x1b" not in ended.err + ended.out
            assert len(ended.err.splitlines()) <= 1


def test_an_answer_byte_by_byte_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status_client, "ANSWER_WITHIN_S", 0.5)

    def drip(client: socket.socket) -> None:
        client.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 1000\r\n\r\n")
        for _ in range(50):
            time.sleep(0.1)
            client.sendall(b" ")

    began_s = time.monotonic()
    with (
        server(tmp_path / "s", drip),
        pytest.raises(CangaugeError),
    ):
        fetch_status(str(tmp_path / "s"))
    assert time.monotonic() - began_s < 3.0
