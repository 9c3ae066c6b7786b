"""Access to the live page, and its process."""

from __future__ import annotations

import asyncio
import http.client
import json
import os
import signal
import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tornado.websocket import websocket_connect

from cangauge.bus.open import UNKNOWN_INTERFACE
from cangauge.bus.vehicle import Vehicle
from cangauge.extras.live import launch
from cangauge.extras.live.addresses import http_address
from cangauge.extras.live.launch import Live
from cangauge.service.pipeline import Pipeline
from cangauge.service.status import Monitor
from cangauge.service.status_client import Snapshot
from live import LoggedLines, leaf_model, leaf_model_path, waits

AT_ONCE_S = (0.05, 60.0)
"""Pauses before a process that has ended is started again [s]."""
TOKEN = "a-token-of-some-length"  # noqa: S105 - made up


def snapshot() -> Snapshot:
    port = SimpleNamespace(name="virtual x", capabilities=UNKNOWN_INTERFACE)
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    return Monitor(pipeline, port, str(leaf_model_path())).latest  # type: ignore[arg-type] # no bus


def get(page: Live, path: str, **options: Any) -> tuple[int, dict[str, str], bytes]:
    """Return code, headers and body."""
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=120.0)
    try:
        connection.request(options.pop("method", "GET"), path, **options)
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        connection.close()


@contextmanager
def live_page(token_file: Path | None = None) -> Iterator[Live]:
    """Serve a page of one snapshot, by a process that is started again at once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(launch, "PAUSE_S", AT_ONCE_S)
        with closing(Live(dashboard=http_address("127.0.0.1:0", token_file, {}))) as page:
            page.on_snapshot(snapshot())
            yield page


@pytest.fixture(scope="module")
def page() -> Iterator[Live]:
    with live_page() as page:
        yield page


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    file = tmp_path_factory.mktemp("token") / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    with live_page(file) as page:
        yield page


def test_the_latest_status_is_served(page: Live) -> None:
    # The process may still be starting.
    assert waits(lambda: json.loads(get(page, "/rows")[2])["status"] is not None)
    content = json.loads(get(page, "/rows?span=10min")[2])
    assert content["status"]["bus"] == "virtual x"
    assert content["added"] == len(content["columns"]["time_ms"]) == 1
    again = json.loads(get(page, f"/rows?span=10min&key={content['key']}&after=1")[2])
    assert again["is_known"]
    assert again["columns"]["time_ms"] == []


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
    page: Live, path: str, code: int
) -> None:
    assert get(page, path)[0] == code


def test_what_a_browser_asks_by_itself_is_no_refusal(guarded: Live) -> None:
    with LoggedLines("cangauge.extras.live") as log:
        code, _, body = get(guarded, "/favicon.ico")
        assert (code, body) == (404, b"there is nothing here: the live page is at /\n")
        assert get(guarded, "/rows")[0] == 401
        assert waits(lambda: bool(log.lines))
    (line,) = log.lines
    assert "missing or wrong token" in line


def test_the_page_allows_no_content_from_elsewhere(page: Live) -> None:
    code, headers, body = get(page, "/")
    assert code == 200
    assert headers["Content-Security-Policy"].startswith("default-src 'none'; script-src 'self';")
    assert b"http://" not in body
    assert b"https://" not in body


def test_a_slow_viewer_does_not_hold_the_others(page: Live) -> None:
    with socket.create_connection(("127.0.0.1", page.port)) as slow:
        slow.sendall(b"GET /files/bokeh.min.js HTTP/1.1\r\nHost: localhost\r\n\r\n")
        for _ in range(20):
            page.on_snapshot(snapshot())
            assert get(page, "/rows?span=10min")[0] == 200


UPGRADE = {
    "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}  # fmt: skip


def test_the_stream_is_for_the_own_page_only(page: Live, guarded: Live) -> None:
    evil = UPGRADE | {"Origin": "https://evil.example"}
    assert get(page, "/stream", headers=evil)[0] == 403
    assert get(page, "/stream", headers=UPGRADE | {"Host": "evil.example"})[0] == 403
    assert get(guarded, "/stream", headers=UPGRADE)[0] == 401


def test_the_stream_sends_what_is_new(page: Live) -> None:
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
            page.on_snapshot(snapshot())
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


def entered(page: Live, token: str) -> tuple[int, str]:
    """Give a token to the form; return the code, and the cookie of an answer that has one."""
    options = {"method": "POST", "body": f"token={token}", "headers": FORM}
    code, headers, _ = get(page, "/enter", **options)
    return code, headers.get("Set-Cookie", "")


def test_a_token_is_needed_for_which_the_browser_is_asked(guarded: Live) -> None:
    for path in ("/rows", "/cangauge-last-hour.csv"):
        assert get(guarded, path)[0] == 401
        assert get(guarded, path, headers={"Cookie": "cangauge=guess"})[0] == 401
        assert get(guarded, path, headers={"Authorization": f"Bearer {TOKEN}"})[0] == 200
    code, headers, _ = get(guarded, "/")
    assert (code, headers["Location"]) == (302, "/enter")
    assert entered(guarded, "wrong") == (401, "")
    code, cookie = entered(guarded, TOKEN)
    assert code == 302
    assert TOKEN not in cookie
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    assert get(guarded, "/rows", headers={"Cookie": cookie.split(";")[0]})[0] == 200


def test_a_process_that_dies_is_started_again_and_the_cookie_holds(guarded: Live) -> None:
    cookie = entered(guarded, TOKEN)[1].split(";")[0]
    with LoggedLines("cangauge.extras.live") as lines:
        before = guarded.pid
        assert before is not None
        os.kill(before, signal.SIGKILL)
        assert waits(lambda: guarded.pid not in {None, before})
        assert get(guarded, "/rows", headers={"Cookie": cookie})[0] == 200  # the port is the same
        assert "ended by itself" in guarded.trouble
    assert sum("has ended" in line for line in lines.lines) == 1


def test_the_process_ends_with_the_service(guarded: Live) -> None:
    process = guarded.pid
    assert process is not None
    guarded.close()
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", guarded.port), 1.0)


def test_a_process_that_hangs_is_started_again(page: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    assert get(page, "/rows")[0] == 200
    before = page.pid
    assert before is not None
    monkeypatch.setattr(launch, "SILENT_S", 1.0)
    os.kill(before, signal.SIGSTOP)
    assert waits(lambda: "answer" in page.trouble, 20.0)
    monkeypatch.setattr(launch, "SILENT_S", 300.0)  # a busy machine is no reason
    assert waits(lambda: page.pid not in {None, before})
    page.on_snapshot(snapshot())
    assert get(page, "/rows")[0] == 200
    assert "so far)" in page.trouble


def test_a_process_that_grows_is_ended(page: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch, "LARGEST_BYTES", 1 << 20)
    assert waits(lambda: "MiB of memory" in page.trouble, 20.0)
