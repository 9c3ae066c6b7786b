"""HTTP: pages, access, and limits of clients."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from watched import Watched

from cangauge.errors import InputError
from cangauge.extras.live.addresses import http_address, read_token
from cangauge.extras.live.http import MAX_CLIENTS
from cangauge.model.published import CAPACITY_AH
from cangauge.service.status_client import Snapshot
from live import waits
from served import Served

TOKEN = "a-token-of-some-length"  # noqa: S105 - made up


@pytest.fixture(scope="module")
def watched() -> Watched:
    found = Watched()
    found.now_s = time.monotonic()
    found.drive(90.0)
    found.turn(0.5)
    return found


@pytest.fixture(scope="module")
def http(watched: Watched) -> Iterator[Served]:
    with Served(watched.monitor.latest, http="127.0.0.1:0") as server:
        yield server


def get(port: int, path: str, **headers: str) -> tuple[int, bytes, Any]:
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=60.0) as answer:  # noqa: S310
            return answer.status, answer.read(), answer.headers
    except urllib.error.HTTPError as error:
        return error.code, error.read(), error.headers


def test_status_and_health(http: Served, watched: Watched) -> None:
    def show(age_s: float = 0.0, **changed: object) -> None:
        status = watched.monitor.latest.status | changed
        http.show(Snapshot(time.monotonic() - age_s, status))

    assert waits(lambda: get(http.port, "/status")[0] == 200)  # after seconds on a busy machine
    show()
    code, body, headers = get(http.port, "/status")
    assert (code, headers["Content-Type"]) == (200, "application/json")
    assert json.loads(body)["samples"] == 900
    answers = []

    def is_healthy() -> bool:
        show()  # no old one, however slow the machine is
        answers.append(get(http.port, "/healthz"))
        return bool(answers[-1][0] == 200)

    assert waits(is_healthy)
    assert json.loads(answers[-1][1])["ok"]
    for path in ("/", "/../etc/passwd"):
        assert get(http.port, path)[:2] == (404, b"available: /status, /healthz, /metrics\n")
    # A number that is not finite is null.
    show(samples_per_s=math.nan, estimate={"soc_pct": math.inf})
    assert waits(lambda: b'"soc_pct": null' in get(http.port, "/status")[1])
    assert b'"samples_per_s": null' in get(http.port, "/status")[1]
    # A loop that does not turn is not healthy.
    show(age_s=60.0)
    assert waits(lambda: get(http.port, "/healthz")[0] == 503)
    assert json.loads(get(http.port, "/healthz")[1]) == {"ok": False, "status": "invalid"}


def test_metrics_are_what_prometheus_reads(http: Served) -> None:
    code, body, headers = get(http.port, "/metrics")
    assert code == 200
    assert "text/plain" in headers["Content-Type"]
    families = {each.name: each for each in text_string_to_metric_families(body.decode())}
    value = {
        (sample.name, *sample.labels.values()): sample.value
        for family in families.values()
        for sample in family.samples
    }
    assert value["cangauge_samples_total",] == 900
    assert value["cangauge_status", "valid"] + value["cangauge_status", "invalid"] == 1
    assert 70 < value["cangauge_soc_percent",] < 85
    assert value["cangauge_capacity_ah",] == pytest.approx(CAPACITY_AH, rel=0.2)
    assert 0 < value["cangauge_discharge_amperes",] <= 200
    assert not any(name[0].startswith("cangauge_weakest") for name in value)
    assert value["cangauge_rejects_total", "crc_errors"] == 0
    assert value["cangauge_bus_queue_drops_total",] == 4
    assert value["cangauge_bus_up",] == 1
    assert value["cangauge_loop_age_seconds",] >= 0.0
    assert value["cangauge_step_seconds_bucket", "+Inf"] == value["cangauge_step_seconds_count",]
    assert value["cangauge_step_seconds_sum",] == pytest.approx(900 * 30e-6)
    assert families["cangauge_latency_seconds"].type == "histogram"
    open_metrics = get(http.port, "/metrics", Accept="application/openmetrics-text; version=1.0.0")
    assert open_metrics[1].endswith(b"# EOF\n")


def test_a_token_is_required_where_there_is_one(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CANGAUGE_HTTP_TOKEN", TOKEN)
    assert TOKEN not in repr(http_address("127.0.0.1:0"))
    with Served(watched.monitor.latest, http="127.0.0.1:0") as server:
        assert waits(lambda: get(server.port, "/status", Authorization=f"Bearer {TOKEN}")[0] == 200)
        for path in ("/status", "/healthz", "/metrics", "/nothing"):
            code, body, headers = get(server.port, path)
            assert (code, headers["WWW-Authenticate"]) == (401, "Bearer")
            assert b"soc" not in body
            for wrong in (TOKEN, f"Bearer {TOKEN}x", f"Basic {TOKEN}", "Bearer", "Bearer é"):
                assert get(server.port, path, Authorization=wrong)[0] == 401, wrong
        assert get(server.port, "/status", Authorization=f"Bearer {TOKEN}")[0] == 200


def test_without_a_token_only_loopback_names_are_answered(http: Served) -> None:
    assert get(http.port, "/status", Host="evil.example")[0] == 403
    assert get(http.port, "/status", Host="localhost:1")[0] == 200


@pytest.mark.parametrize(
    ("text", "say"),
    [
        ("0.0.0.0:9464", "reachable from the network"),
        ("[::]:9464", "reachable from the network"),
        ("192.168.1.7:9464", "http_token_file"),
        ("example.org:9464", "HOST:PORT"),
        ("127.0.0.1", "HOST:PORT"),
        ("127.0.0.1:99999", "HOST:PORT"),
        (":9464", "HOST:PORT"),
    ],
)
def test_addresses_that_are_refused(text: str, say: str) -> None:
    with pytest.raises(InputError, match=say) as caught:
        http_address(text, None, {})
    assert caught.value.field == "http"


def test_addresses_and_tokens(tmp_path: Path, http: Served) -> None:
    assert str(http_address("9464", None, {})) == "127.0.0.1:9464"
    assert str(http_address("[::1]:9464", None, {})) == "[::1]:9464"
    path = tmp_path / "token"
    path.write_text(TOKEN + "\n")
    assert http_address("0.0.0.0:9464", path, {}).token == TOKEN
    for content in ("", "short", "two words of a token", "x" * 2000, "ü" * 30):
        path.write_text(content)
        with pytest.raises(InputError, match="token") as caught:
            read_token(path, {})
        assert not content or content not in str(caught.value)
    with pytest.raises(InputError, match="cannot listen"):
        http_address(f"127.0.0.1:{http.port}", None, {}).listen()


def test_slow_clients_leave_a_place_for_a_probe(http: Served) -> None:
    slow = [socket.create_connection(("127.0.0.1", http.port)) for _ in range(2 * MAX_CLIENTS)]
    begun = ("", "GET /healthz HTTP/1.1\r\nX: ", "POST / HTTP/1.1\r\nContent-Length: 9\r\n\r\n")
    for each, first in zip(slow, itertools.cycle(begun), strict=False):
        with contextlib.suppress(OSError):  # thrown out already
            each.sendall(first.encode())
    for _ in range(5):
        assert get(http.port, "/healthz")[0] in {200, 503}
    # The slow ones are thrown out after a few seconds.
    for each in slow:
        each.settimeout(60.0)
        with contextlib.suppress(ConnectionResetError):
            while each.recv(4096):
                pass
        each.close()


def test_a_header_without_end_is_cut_off(http: Served) -> None:
    greedy = socket.create_connection(("127.0.0.1", http.port), 60.0)
    with greedy, contextlib.suppress(OSError):
        greedy.sendall(b"GET /status HTTP/1.1\r\nX: " + b"y" * 100_000)
        assert b"200" not in greedy.recv(4096)
    assert get(http.port, "/healthz")[0] in {200, 503}
