"""Status by unix socket and HTTP: content, access, and limits of clients."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from watched import Watched

from cangauge.errors import CangaugeError, InputError
from cangauge.model.published import CAPACITY_AH
from cangauge.service.addresses import default_path, http_address, open_unix, served_sockets
from cangauge.service.http import MAX_CLIENTS, Endpoint
from cangauge.service.status_client import NotRunningError, fetch_status, find_socket
from live import in_process

TOKEN = "a-token-of-some-length"  # noqa: S105 - made up


@pytest.fixture
def watched() -> Watched:
    found = Watched()
    found.now_s = time.monotonic()
    found.drive(90.0)
    found.turn(0.5)
    return found


@pytest.fixture
def http(watched: Watched) -> Iterator[Endpoint]:
    with Endpoint(lambda: watched.monitor.latest, http=http_address("127.0.0.1:0", None, {})) as it:
        yield it


def get(port: int | None, path: str, **headers: str) -> tuple[int, bytes, Any]:
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=5.0) as answer:  # noqa: S310
            return answer.status, answer.read(), answer.headers
    except urllib.error.HTTPError as error:
        return error.code, error.read(), error.headers


def test_status_and_health(http: Endpoint) -> None:
    code, body, headers = get(http.port, "/status")
    content = json.loads(body)
    assert code == 200
    assert headers["Content-Type"] == "application/json"
    assert content["status"] == "valid"
    assert content["samples"] == 900
    assert content["health"]["capacity_ah"] == pytest.approx(CAPACITY_AH, rel=0.2)
    assert content["power"]["discharge_std_a"] >= 0.0
    assert content["cells"] is None
    assert content["notices"] == []
    code, body, _ = get(http.port, "/healthz")
    assert code == 200
    assert json.loads(body) == {"ok": True, "status": "valid"}
    assert get(http.port, "/")[0] == 404
    assert get(http.port, "/../etc/passwd")[0] == 404


def test_a_loop_that_does_not_turn_is_not_healthy(watched: Watched, http: Endpoint) -> None:
    watched.turn(-60.0)
    watched.now_s -= 1.0
    watched.monitor.latest = watched.monitor._snapshot(time.monotonic() - 60.0)
    code, body, _ = get(http.port, "/healthz")
    assert code == 503
    assert json.loads(body) == {"ok": False, "status": "invalid"}


def test_metrics_are_what_prometheus_reads(http: Endpoint) -> None:
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
    assert value["cangauge_status", "valid"] == 1
    assert value["cangauge_status", "invalid"] == 0
    assert value["cangauge_reason", "input_stale"] == 0
    assert 70 < value["cangauge_soc_percent",] < 85
    assert value["cangauge_capacity_ah",] == pytest.approx(CAPACITY_AH, rel=0.2)
    assert 0 < value["cangauge_capacity_std_ah",] < 0.2 * CAPACITY_AH
    assert 0.5 < value["cangauge_resistance_ratio",] < 1.5
    assert 0 < value["cangauge_discharge_amperes",] <= 200
    assert 5_000 < value["cangauge_energy_watt_hours",] < 20_000
    assert not any(name[0].startswith("cangauge_weakest") for name in value)
    assert value["cangauge_rejects_total", "crc_errors"] == 0
    assert value["cangauge_bus_queue_drops_total",] == 4
    assert value["cangauge_bus_up",] == 1
    assert value["cangauge_step_seconds_bucket", "+Inf"] == value["cangauge_step_seconds_count",]
    assert value["cangauge_step_seconds_sum",] == pytest.approx(900 * 30e-6)
    assert families["cangauge_latency_seconds"].type == "histogram"
    assert "cangauge_build_info" in families
    open_metrics = get(http.port, "/metrics", Accept="application/openmetrics-text; version=1.0.0")
    assert open_metrics[1].endswith(b"# EOF\n")


def test_a_token_is_required_where_there_is_one(watched: Watched) -> None:
    address = http_address("127.0.0.1:0", None, {"CANGAUGE_HTTP_TOKEN": TOKEN})
    assert TOKEN not in repr(address)
    with Endpoint(lambda: watched.monitor.latest, http=address) as endpoint:
        for path in ("/status", "/healthz", "/metrics", "/nothing"):
            code, body, headers = get(endpoint.port, path)
            assert (code, headers["WWW-Authenticate"]) == (401, "Bearer")
            assert b"soc" not in body
            for wrong in (TOKEN, f"Bearer {TOKEN}x", f"Basic {TOKEN}", "Bearer", "Bearer é"):
                assert get(endpoint.port, path, Authorization=wrong)[0] == 401, wrong
        assert get(endpoint.port, "/status", Authorization=f"Bearer {TOKEN}")[0] == 200


def test_without_a_token_only_loopback_names_are_answered(http: Endpoint) -> None:
    assert get(http.port, "/status", Host="evil.example")[0] == 403
    assert get(http.port, "/status", Host="localhost:1")[0] == 200


@pytest.mark.parametrize(
    ("text", "say"),
    [
        ("0.0.0.0:9464", "reachable from the network"),
        ("[::]:9464", "reachable from the network"),
        ("192.168.1.7:9464", "--http-token-file"),
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


def test_addresses_that_are_taken(tmp_path: Path) -> None:
    assert str(http_address("9464", None, {})) == "127.0.0.1:9464"
    assert str(http_address("[::1]:9464", None, {})) == "[::1]:9464"
    assert http_address("localhost:1", None, {}).token is None
    path = tmp_path / "token"
    path.write_text(TOKEN + "\n")
    assert http_address("0.0.0.0:9464", path, {}).token == TOKEN


@pytest.mark.parametrize("content", ["", "short", "two words of a token", "x" * 2000, "ü" * 30])
def test_bad_tokens_are_refused_without_being_quoted(tmp_path: Path, content: str) -> None:
    path = tmp_path / "token"
    path.write_text(content)
    with pytest.raises(InputError, match="token") as caught:
        http_address("127.0.0.1:1", path, {})
    assert not content or content not in str(caught.value)
    with pytest.raises(InputError, match="no such file"):
        http_address("127.0.0.1:1", tmp_path / "nowhere", {})


def test_a_taken_port_is_one_clear_error(watched: Watched, http: Endpoint) -> None:
    with pytest.raises(InputError, match="cannot be bound"):
        Endpoint(
            lambda: watched.monitor.latest,
            http=http_address(f"127.0.0.1:{http.port}", None, {}),
        )


def test_the_unix_socket_and_the_command(watched: Watched, tmp_path: Path) -> None:
    path = tmp_path / "status.sock"
    with Endpoint(lambda: watched.monitor.latest, unix_path=path):
        assert stat.S_IMODE(path.stat().st_mode) == 0o660
        assert fetch_status(str(path))["samples"] == 900
        ended = in_process("status", "--endpoint", path, "--json")
        assert ended.code == 0
        assert ended.json["status"] == "valid"
        ended = in_process("status", "--endpoint", path)
        assert ended.code == 0
        assert "± " in ended.out
        assert "valid" in ended.out
        watched.pipeline.heartbeat(is_stale=True)
        watched.turn()
        ended = in_process("status", "--endpoint", path, "--json")
        assert (ended.code, ended.json["reasons"]) == (1, ["input_stale"])
        with pytest.raises(InputError, match="another service"):
            open_unix(path)
    assert not path.exists()
    ended = in_process("status", "--endpoint", path, "--json")
    assert (ended.code, ended.json["running"]) == (1, False)
    ended = in_process("status", "--endpoint", path)
    assert (ended.code, ended.out) == (1, "")
    assert len(ended.err.splitlines()) == 1


def test_the_command_by_http(http: Endpoint) -> None:
    ended = in_process("status", "--endpoint", f"http://127.0.0.1:{http.port}", "--json")
    assert ended.code == 0
    ended = in_process("status", "--endpoint", "http://[::1")
    assert ended.code == 2


def test_a_socket_left_behind_is_replaced_and_a_file_is_not(tmp_path: Path) -> None:
    path = tmp_path / "status.sock"
    open_unix(path).close()
    assert path.exists()
    open_unix(path).close()
    path.unlink()
    path.write_text("precious")
    with pytest.raises(InputError, match="cannot be created"):
        open_unix(path)
    assert path.read_text() == "precious"
    with pytest.raises(InputError, match="cannot be created"):
        open_unix(tmp_path / "no" / "folder.sock")
    with pytest.raises(InputError, match="cannot be created"):
        open_unix(tmp_path / ("long" * 50))


def test_services_are_found_where_they_put_their_sockets(
    watched: Watched, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    left = tmp_path / "cangauge" / "old-1.sock"
    path = default_path("socketcan can0")
    assert path.parent == tmp_path / "cangauge"
    assert path.name == f"socketcan-can0-{os.getpid()}.sock"
    open_unix(left).close()
    assert default_path("socketcan can0") == path
    assert not left.exists()
    with Endpoint(lambda: watched.monitor.latest, unix_path=path):
        assert path in served_sockets()
        second = tmp_path / "cangauge" / "b.sock"
        with (
            Endpoint(lambda: watched.monitor.latest, unix_path=second),
            pytest.raises(InputError, match="several services are running"),
        ):
            find_socket()
    (tmp_path / "cangauge").chmod(0o777)
    with pytest.raises(InputError, match="not private to this user"):
        default_path("can0")


@pytest.mark.parametrize(
    "answer",
    [
        b"",
        b"nonsense\r\n\r\n",
        b"HTTP/1.1 200 OK\r\n\r\n[[[",
        b'HTTP/1.1 200 OK\r\n\r\n{"schema": 99}',
        b"HTTP/1.1 200 OK\r\nContent-Length: 99999999999\r\n\r\n{}",
        b"HTTP/1.1 500 No\r\n\r\noops",
        b"HTTP/1.1 200 OK\r\n\r\n" + b"[" * 100_000,
    ],
)
def test_answers_that_are_none(tmp_path: Path, answer: bytes) -> None:
    path = tmp_path / "x.sock"
    server = open_unix(path)
    server.setblocking(True)

    def serve() -> None:
        peer, _ = server.accept()
        with peer:
            peer.recv(4096)
            peer.sendall(answer)

    thread = threading.Thread(target=serve)
    thread.start()
    with pytest.raises((CangaugeError, NotRunningError)):
        fetch_status(str(path))
    thread.join()
    server.close()


def test_slow_and_greedy_clients_block_nobody(http: Endpoint) -> None:
    assert get(http.port, "/status")[0] == 200  # so that all is open that will be
    files = len(list(Path("/proc/self/fd").iterdir()))
    slow = [socket.create_connection(("127.0.0.1", http.port or 0)) for _ in range(200)]
    time.sleep(0.3)
    # Both ends are in this process: 200 here, and no more than are answered at once there.
    assert len(list(Path("/proc/self/fd").iterdir())) - files <= 200 + MAX_CLIENTS
    for each in slow[10:]:
        each.close()
    slow = slow[:10]
    time.sleep(0.5)  # until the others' places are free again
    for each in slow:
        each.sendall(b"GET /status HTTP/1.1\r\nX: ")
    greedy = socket.create_connection(("127.0.0.1", http.port or 0))
    with contextlib.suppress(OSError):  # it may be thrown out already
        greedy.sendall(b"GET /status HTTP/1.1\r\nX: " + b"y" * 100_000)
    began = time.monotonic()
    assert get(http.port, "/status")[0] == 200
    assert time.monotonic() - began < 2.0
    # They are thrown out after a few seconds.
    slow[0].settimeout(10.0)
    with contextlib.suppress(ConnectionResetError):
        assert slow[0].recv(100) == b""
    for each in (*slow, greedy):
        each.close()


@pytest.mark.parametrize(
    "first", ["", "GET /healthz HTTP/1.1\r\nX: ", "POST / HTTP/1.1\r\nContent-Length: 9\r\n\r\n"]
)
def test_slow_clients_leave_a_place_for_a_probe(http: Endpoint, first: str) -> None:
    slow = [socket.create_connection(("127.0.0.1", http.port or 0)) for _ in range(64)]
    for each in slow:
        each.sendall(first.encode())
    began = time.monotonic()
    for _ in range(3 * MAX_CLIENTS):
        assert get(http.port, "/healthz")[0] == 200
    assert time.monotonic() - began < 3.0
    for each in slow:
        each.close()


def test_closing_takes_no_time_even_with_a_client_in_between(watched: Watched) -> None:
    endpoint = Endpoint(lambda: watched.monitor.latest, http=http_address("127.0.0.1:0", None, {}))
    with endpoint:
        client = socket.create_connection(("127.0.0.1", endpoint.port or 0))
        client.sendall(b"GET /st")
        time.sleep(0.1)
        began = time.monotonic()
    assert time.monotonic() - began < 0.5
    client.close()


def test_without_prometheus_client_one_line_says_so(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    monkeypatch.delitem(sys.modules, "cangauge.extras.live.metrics", raising=False)
    with pytest.raises(InputError, match=r"cangauge\[metrics\]"):
        Endpoint(lambda: watched.monitor.latest, http=http_address("127.0.0.1:0", None, {}))
