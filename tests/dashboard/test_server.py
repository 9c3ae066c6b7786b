"""Access to the live page, and the program that serves it."""

from __future__ import annotations

import asyncio
import http.client
import json
import select
import signal
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tornado.websocket import websocket_connect

from cangauge.bus.open import BusAddress
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.extras.live.addresses import http_address
from cangauge.extras.live.history import COLUMNS, Span
from cangauge.extras.live.launch import Live
from cangauge.extras.live.server import LivePage
from cangauge.service.pipeline import Pipeline
from cangauge.service.run import Service
from cangauge.service.status import Monitor
from cangauge.service.status_client import Snapshot, StatusSocket
from live import Command, LoggedLines, leaf_model, leaf_model_path, loop_config, waits
from running import free_port
from served import Served

TOKEN = "a-token-of-some-length"  # noqa: S105 - made up
BEARER = {"Authorization": f"Bearer {TOKEN}"}


def snapshot() -> Snapshot:
    port = SimpleNamespace(name="virtual x", address=BusAddress("pcan", "x"))
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    return Monitor(pipeline, port, str(leaf_model_path())).latest  # type: ignore[arg-type] # no bus


def get(page: Served, path: str, **options: Any) -> tuple[int, dict[str, str], bytes]:
    """Return code, headers and body."""
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=120.0)
    try:
        connection.request(options.pop("method", "GET"), path, **options)
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        connection.close()


def live_page(token_file: str | None = None) -> Served:
    """Serve a page of one snapshot."""
    return Served(snapshot(), dashboard="127.0.0.1:0", http_token_file=token_file)


@pytest.fixture(scope="module")
def page() -> Iterator[Served]:
    with live_page() as page:
        yield page


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    file = tmp_path_factory.mktemp("token") / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    with live_page(str(file)) as page:
        yield page


def test_the_latest_status_is_served(page: Served) -> None:
    # The process may still be starting.
    assert waits(lambda: json.loads(get(page, "/rows")[2])["status"] is not None)
    content = json.loads(get(page, "/rows?span=10min")[2])
    assert content["status"]["bus"] == "virtual x"
    added = content["added"]
    assert added == len(content["columns"]["time_ms"]) >= 1
    again = json.loads(get(page, f"/rows?span=10min&key={content['key']}&after={added}")[2])
    assert again["is_known"]
    assert len(again["columns"]["time_ms"]) == again["added"] - added


@pytest.mark.parametrize(
    ("path", "code"),
    [
        ("/rows?span=nonsense&after=x", 200),
        ("/rows?span=10min&key=x&after=-1e400", 200),
        (f"/rows?span=10min&after={'9' * 5000}", 200),
        ("/cangauge-last-hour.csv", 200),
        ("/files/server.py", 404),
        ("/files/..", 404),
        ("/files/", 404),
        ("/nothing", 404),
    ],
)
def test_odd_questions_are_answered_and_nothing_else_is_served(
    page: Served, path: str, code: int
) -> None:
    assert get(page, path)[0] == code


def test_what_a_browser_asks_by_itself_is_no_refusal(guarded: Served) -> None:
    before = len(guarded.lines)
    code, _, body = get(guarded, "/favicon.ico")
    assert (code, body) == (404, b"there is nothing here: the live page is at /\n")
    assert get(guarded, "/rows")[0] == 401
    assert waits(lambda: len(guarded.lines) > before)
    (line,) = guarded.lines[before:]
    assert "missing or wrong token" in line["message"]


def test_the_page_allows_no_content_from_elsewhere(page: Served) -> None:
    code, headers, body = get(page, "/")
    assert code == 200
    assert headers["Content-Security-Policy"].startswith("default-src 'none'; script-src 'self';")
    assert b"http://" not in body
    assert b"https://" not in body


def test_a_slow_viewer_does_not_hold_the_others(page: Served) -> None:
    with socket.create_connection(("127.0.0.1", page.port)) as slow:
        slow.sendall(b"GET /files/bokeh.min.js HTTP/1.1\r\nHost: localhost\r\n\r\n")
        for _ in range(20):
            page.show(snapshot())
            assert get(page, "/rows?span=10min")[0] == 200


class CountedSpan(Span):
    """Counts the rows that are read."""

    rows_read = 0

    def rows(self, after: int = 0) -> np.ndarray:
        found = super().rows(after)
        self.rows_read += len(found)
        return found


def test_a_span_is_read_once_however_many_ask_for_it() -> None:
    async def rows_read() -> int:
        page = LivePage(http_address("0", None, {}, "dashboard"))
        page.history.spans["all"] = span = CountedSpan(0.1, 6000)
        for tenth in range(6050):
            span.add(np.full(len(COLUMNS), 100.0 * tenth))
        key = json.loads(page.answer("all", "", 0)[0])["key"]
        for after in range(50):
            span.add(np.full(len(COLUMNS), 1e6 + 100.0 * after))
            for known in ("", key):
                text, *_ = page.answer("all", known, after)
                if after % 10 == 0:
                    assert len(json.loads(text)["columns"]["time_ms"]) == 6000
        return span.rows_read

    assert asyncio.run(rows_read()) == 6000


def test_a_viewer_that_lacks_few_rows_is_sent_those() -> None:
    async def answers(*lacking: int) -> list[dict[str, Any]]:
        page = LivePage(http_address("0", None, {}, "dashboard"))
        span = page.history.spans["10min"]
        for tenth in range(1000):
            span.add(np.full(len(COLUMNS), 100.0 * tenth))
        key = json.loads(page.answer("10min", "", 0)[0])["key"]
        return [json.loads(page.answer("10min", key, 1000 - rows)[0]) for rows in lacking]

    *some, whole = asyncio.run(answers(0, 1, 100, 900))
    for rows, answer in zip((0, 1, 100), some, strict=True):
        assert answer["is_known"]
        assert len(answer["columns"]["time_ms"]) == rows
    assert not whole["is_known"]
    assert len(whole["columns"]["time_ms"]) == whole["added"] == 1000


UPGRADE = {
    "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}  # fmt: skip


def test_the_stream_is_for_the_own_page_only(page: Served, guarded: Served) -> None:
    evil = UPGRADE | {"Origin": "https://evil.example"}
    assert get(page, "/stream", headers=evil)[0] == 403
    assert get(page, "/stream", headers=UPGRADE | {"Host": "evil.example"})[0] == 403
    assert get(guarded, "/stream", headers=UPGRADE)[0] == 401


def test_the_stream_sends_what_is_new(page: Served) -> None:
    async def watch() -> list[dict[str, Any]]:
        stream = await websocket_connect(f"ws://127.0.0.1:{page.port}/stream")
        found = []
        for question in ("[", '{"span": 1, "after": -1e400}', '{"span": "10min"}'):
            await stream.write_message(question)
            found.append(json.loads(str(await stream.read_message())))
        while "columns" not in found[-1]:
            found.append(json.loads(str(await stream.read_message())))
        for _ in range(3):
            await asyncio.sleep(0.15)  # rows are 0.1 s apart
            page.show(snapshot())
            found.append(json.loads(str(await stream.read_message())))
        stream.close()
        return found

    assert waits(lambda: json.loads(get(page, "/rows")[2])["status"] is not None)
    found = [each for each in asyncio.run(watch()) if "columns" in each]
    assert len(found) > 3
    known = found[0]["added"]
    for each in found[1:]:
        assert len(each["columns"]["time_ms"]) == each["added"] - known
        known = each["added"]
    assert known > found[0]["added"]


FORM = {"Content-Type": "application/x-www-form-urlencoded"}


def entered(page: Served, token: str) -> tuple[int, str]:
    """Give a token to the form; return the code, and the cookie of an answer that has one."""
    options = {"method": "POST", "body": f"token={token}", "headers": FORM}
    code, headers, _ = get(page, "/enter", **options)
    return code, headers.get("Set-Cookie", "")


def test_a_token_is_needed_for_which_the_browser_is_asked(guarded: Served) -> None:
    for path in ("/rows", "/cangauge-last-hour.csv"):
        assert get(guarded, path)[0] == 401
        assert get(guarded, path, headers={"Cookie": "cangauge=guess"})[0] == 401
        assert get(guarded, path, headers=BEARER)[0] == 200
    code, headers, _ = get(guarded, "/")
    assert (code, headers["Location"]) == (302, "/enter")
    assert entered(guarded, "wrong") == (401, "")
    code, cookie = entered(guarded, TOKEN)
    assert code == 302
    assert TOKEN not in cookie
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    assert get(guarded, "/rows", headers={"Cookie": cookie.split(";")[0]})[0] == 200


def test_it_ends_with_the_service() -> None:
    with live_page() as page:
        assert get(page, "/rows")[0] == 200
        page.service.close()
        assert page.process.wait(20.0) == 0
        assert page.said("has ended")


def test_a_service_that_hangs_is_shown_as_gone(page: Served) -> None:
    assert waits(lambda: json.loads(get(page, "/rows")[2])["status"] is not None)
    old = snapshot()
    page.show(Snapshot(old.made_s - 60.0, old.status))
    assert waits(lambda: json.loads(get(page, "/rows")[2])["status"]["loop_stuck"])
    page.show(snapshot())
    assert waits(lambda: not json.loads(get(page, "/rows")[2])["status"]["loop_stuck"])


@pytest.fixture
def child(tmp_path: Path) -> Iterator[Live]:
    """The child of a service, with the page on a port that is free."""
    config = loop_config(dashboard=str(free_port()))
    with (
        closing(StatusSocket(tmp_path / "s.sock", lambda: snapshot().status)),
        closing(Live(tmp_path / "s.sock", config)) as child,
    ):
        child.on_snapshot(snapshot())
        assert child.trouble == ""
        yield child


def test_a_child_that_dies_is_reported_once_with_the_cure(child: Live) -> None:
    with LoggedLines("cangauge.extras.live") as lines:
        child.process.kill()
        child.process.wait()
        child.on_snapshot(snapshot())
        child.on_snapshot(snapshot())
    assert "exit code -9" in child.trouble
    assert "cangauge live CONFIG" in child.trouble
    assert len(lines.lines) == 1


def test_the_child_ends_with_the_service_though_it_hangs(child: Live) -> None:
    child.process.send_signal(signal.SIGSTOP)
    child.close()
    assert child.process.poll() is not None


def test_an_address_that_is_taken_is_refused_at_the_start(page: Served, tmp_path: Path) -> None:
    service = Service(
        model=str(leaf_model_path()),
        interface="virtual",
        channel="taken",
        status_socket=str(tmp_path / "s.sock"),
        dashboard=f"127.0.0.1:{page.port}",
    )
    with pytest.raises(InputError, match="cannot listen") as caught:
        service.run()
    assert caught.value.field == "dashboard"


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Serve health checks, on `port`, and the live page, with a token."""
    file = tmp_path_factory.mktemp("token") / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    address = "127.0.0.1:0"
    with Served(snapshot(), http=address, dashboard=address, http_token_file=str(file)) as served:
        assert waits(lambda: served.said("live page: "))
        yield served


def connected(port: int, request: bytes) -> socket.socket:
    client = socket.create_connection(("127.0.0.1", port), 60.0)
    client.sendall(request)
    return client


def page_port(served: Served) -> int:
    return int([line["port"] for line in served.lines if "port" in line][1])


def test_a_health_check_comes_before_many_viewers(both: Served) -> None:
    assert waits(lambda: b"ok" in get(both, "/healthz", headers=BEARER)[2])
    ask = (
        f"GET /cangauge-last-hour.csv HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {TOKEN}\r\n\r\n"
    )
    answered = []
    for _ in range(5):  # a busy machine may hold this process back
        both.process.send_signal(signal.SIGSTOP)  # so that all ask at once
        viewers = [connected(page_port(both), ask.encode()) for _ in range(120)]
        probe = connected(both.port, ask.replace("cangauge-last-hour.csv", "healthz").encode())
        both.process.send_signal(signal.SIGCONT)
        assert probe.recv(9) == b"HTTP/1.1 "
        answered.append(len(select.select(viewers, [], [], 0.0)[0]))
        for viewer in viewers:
            assert viewer.recv(12) == b"HTTP/1.1 200"
            viewer.close()
        probe.close()
    assert min(answered) < 60, answered


def test_connections_are_limited(both: Served) -> None:
    clients = [connected(page_port(both), b"GET / HTTP/1.1\r\nX: ") for _ in range(230)]
    pid = both.process.pid
    assert waits(lambda: len(list(Path(f"/proc/{pid}/fd").iterdir())) > 150)
    assert b"ok" in get(both, "/healthz", headers=BEARER)[2]
    open_ones = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    assert open_ones < 225
    for client in clients:
        client.close()


def test_guesses_of_the_token_are_slowed_down(both: Served) -> None:
    def answers(requests: list[str]) -> list[int]:
        both.process.send_signal(signal.SIGSTOP)  # so that all come at once, on a busy machine too
        clients = [connected(page_port(both), request.encode()) for request in requests]
        both.process.send_signal(signal.SIGCONT)
        with ExitStack() as stack:
            return [int(stack.enter_context(each).recv(12).split()[1]) for each in clients]

    def entered(token: str) -> str:
        form = (
            f"Content-Type: application/x-www-form-urlencoded\r\nContent-Length: {6 + len(token)}"
        )
        return f"POST /enter HTTP/1.1\r\nHost: x\r\n{form}\r\n\r\ntoken={token}"

    # The right one too, or a guess that is right would show.
    assert answers([*[entered("guess")] * 20, entered(TOKEN)])[-1] == 429
    bearer = "GET /rows HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer guess\r\n\r\n"
    codes = answers([bearer] * 60)
    assert (codes[0], codes[-1]) == (401, 429)


@pytest.mark.parametrize("origin", ["http://[", "http://[::1", "http://a]b"])
def test_an_origin_that_is_no_address_is_a_bad_request(page: Served, origin: str) -> None:
    assert get(page, "/stream", headers=UPGRADE | {"Origin": origin})[0] == 400
    assert get(page, "/rows", headers={"Origin": origin})[0] == 400


@pytest.mark.parametrize("states_socket", [True, False])
def test_the_live_command_finds_the_service_of_its_configuration(
    states_socket: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    own = tmp_path / "own.sock" if states_socket else tmp_path / "run" / "virtual-found-by-bus.sock"
    lines = [f'model = "{leaf_model_path()}"', 'http = "0"', 'interface = "virtual"']
    lines += ['channel = "found by bus"', f'status_socket = "{own if states_socket else "auto"}"']
    config = tmp_path / "car.toml"
    config.write_text("\n".join(lines))
    other = StatusSocket(tmp_path / "run" / "other.sock", dict)
    with closing(other), closing(StatusSocket(own, lambda: snapshot().status)) as service:
        live = Command("live", config)
        live.wait_for("http.listening")
        service.close()
        ended = live.end()
    assert ended.code == 0
    assert f"the service at {own} has ended" in ended.err
