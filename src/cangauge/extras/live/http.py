"""Serve the status of a running service by HTTP: `/status`, `/healthz` and `/metrics`.

All pages are read-only and show the latest snapshot. There is no encryption: beyond a trusted
network, put a TLS proxy in front.
"""

from __future__ import annotations

import hmac
import json
import logging
import socket
import time
from collections import Counter
from collections.abc import Mapping
from typing import Any, Final
from urllib.parse import urlsplit

from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream
from tornado.web import Application, HTTPError, RequestHandler

from cangauge._logging import emit
from cangauge._text import plain
from cangauge.errors import InputError
from cangauge.extras.live.addresses import HttpAddress, is_loopback_name
from cangauge.service.output import Output
from cangauge.service.status_client import Snapshot

MAX_HEADER_BYTES: Final = 8192
MAX_BODY_BYTES: Final = 1024
MAX_CLIENTS: Final = 200
"""Most simultaneous connections of an address: two fit in the usual 1,024 file descriptors. A
further one takes the place of the oldest of the peer that has most: a client with many connections
cannot starve health checks."""
WRONG_FORMS: Final = 3
WRONG_HEADERS: Final = 30
"""Wrong tokens of one peer before it waits a second for each further one: typed into the form, and
sent by a program. A token of 16 characters is then not found by trying."""
PEERS_AT_MOST: Final = 1000
"""Peers whose wrong tokens are counted."""
REQUEST_WITHIN_S: Final = 3.0
"""Time limit for receiving a request [s]."""
PING_S: Final = 10.0
"""Interval at which a viewer of the live page must show that it still listens [s]."""
_LOG = logging.getLogger(__name__)


class StatusServer(Output):
    """Serve snapshots on the running loop.

    Parameters
    ----------
    address : HttpAddress
        Its token is needed by requests.
    listening : socket
        Bound to it.

    Attributes
    ----------
    latest : Snapshot or None
        None before the first.
    """

    def __init__(self, address: HttpAddress, listening: socket.socket) -> None:
        self.token = address.token
        self.brake = Brake()
        self.latest: Snapshot | None = None
        pages: dict[str, type[Handler]] = {
            "/status": _StatusPage,
            "/healthz": _Health,
            "/metrics": _Metrics,
            ".*": Nothing,
        }
        limits = {
            "no_keep_alive": True,
            "max_buffer_size": MAX_HEADER_BYTES + MAX_BODY_BYTES,
            "idle_connection_timeout": REQUEST_WITHIN_S,
            "body_timeout": REQUEST_WITHIN_S,
        }
        serve(self, listening, pages, limits)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Make a snapshot the latest one."""
        self.latest = snapshot


def _log_nothing(_handler: RequestHandler) -> None:
    """Log no request: a client could fill the disk."""


def serve(
    server: Output,
    listening: socket.socket,
    pages: Mapping[str, type[Handler]],
    limits: Mapping[str, Any],
) -> None:
    """Serve pages by patterns of their paths, with limits of tornado's `HTTPServer`.

    The first pattern that matches counts.
    """
    context = {"server": server}
    application = Application(
        [(path, page, context) for path, page in pages.items()],
        log_function=_log_nothing,
        websocket_ping_interval=PING_S,
        websocket_max_message_size=MAX_BODY_BYTES,
    )
    listening.setblocking(False)
    sizes = {"max_header_size": MAX_HEADER_BYTES, "max_body_size": MAX_BODY_BYTES}
    _Server(application, **sizes, **limits).add_socket(listening)


class _Server(HTTPServer):
    """Limit the number of simultaneous connections."""

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        self._clients: dict[IOStream, str] = {}  # with their peers, the oldest first
        super().initialize(*args, **kwargs)

    def handle_stream(self, stream: IOStream, address: Any) -> None:
        if len(self._clients) >= MAX_CLIENTS:
            [(crowd, _)] = Counter(self._clients.values()).most_common(1)
            oldest = next(each for each, peer in self._clients.items() if peer == crowd)
            del self._clients[oldest]
            oldest.close()
        self._clients[stream] = str(address[0]) if isinstance(address, tuple) else ""
        super().handle_stream(stream, address)

    def on_close(self, server_conn: Any) -> None:
        self._clients.pop(server_conn.stream, None)
        super().on_close(server_conn)


class Brake:
    """Let a peer try tokens slowly: each wrong one counts for a second."""

    def __init__(self) -> None:
        self._until_s: dict[str, float] = {}

    def check(self, peer: str, wrong_at_most: int) -> None:
        """Raise the HTTP error 429 if a peer has given too many wrong tokens lately."""
        if self._until_s.get(peer, 0.0) - time.monotonic() > wrong_at_most:
            raise HTTPError(429, reason="Too many wrong tokens: wait a second")

    def note_wrong(self, peer: str) -> None:
        """Count a wrong token."""
        now_s = time.monotonic()
        self._until_s[peer] = max(self._until_s.pop(peer, now_s), now_s) + 1.0
        if len(self._until_s) > PEERS_AT_MOST:
            del self._until_s[next(iter(self._until_s))]


def has_token(header: str, token: str) -> bool:
    """Return whether an Authorization header bears the token; takes the same time for each."""
    scheme, _, given = header.partition(" ")
    same = hmac.compare_digest(given.strip().encode("utf-8", "replace"), token.encode("utf-8"))
    return same and scheme.lower() == "bearer"


class Handler(RequestHandler):
    """Access control and plain-text errors of all pages."""

    needs_token = True

    def initialize(self, server: Any) -> None:
        """Take the server, which has the token."""
        self.server = server

    def set_default_headers(self) -> None:
        """Let no answer be stored."""
        self.clear_header("Server")
        self.set_header("Cache-Control", "no-store")
        self.set_header("X-Content-Type-Options", "nosniff")

    def prepare(self) -> None:
        """Refuse a request that lacks the token, or is by a foreign name."""
        try:
            urlsplit(self.request.headers.get("Origin", ""))
        except ValueError:  # tornado would fail on it
            self.refuse(400, "the origin is no address")
            return
        token = self.server.token
        # Against DNS rebinding: a web page could otherwise read this under another name.
        if token is None and not is_loopback_name(self.request.host_name):
            self.refuse(403, "request this by a loopback address")
        elif token is not None and self.needs_token and not self.is_known(token):
            self.refuse_unknown()

    def is_known(self, token: str) -> bool:
        """Return whether the request bears the token."""
        header, peer = self.request.headers.get("Authorization", ""), str(self.request.remote_ip)
        if not header:
            return False
        self.server.brake.check(peer, WRONG_HEADERS)
        if has_token(header, token):
            return True
        self.server.brake.note_wrong(peer)
        return False

    def refuse_unknown(self) -> None:
        """Answer a request without the token."""
        self.set_header("WWW-Authenticate", "Bearer")
        self.refuse(401, "a bearer token is required")
        text = f"refused {self.request.remote_ip}: missing or wrong token"
        emit(_LOG, logging.WARNING, "http.refused", text, remote=self.request.remote_ip)

    def refuse(self, code: int, text: str) -> None:
        """Answer with an error in plain text."""
        self.set_status(code)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(text + "\n")

    def write_error(self, status_code: int, **_: Any) -> None:
        """Answer with tornado's reason, without a trace."""
        self.refuse(status_code, f"{status_code} {self._reason}")

    def send_json(self, content: dict[str, Any]) -> None:
        """Answer with a JSON object; a number that is not finite is null."""
        self.set_header("Content-Type", "application/json")
        self.finish(json.dumps(plain(content), ensure_ascii=False) + "\n")


class _Page(Handler):
    def prepare(self) -> None:
        super().prepare()
        if self.server.latest is None and not self._finished:
            self.refuse(503, "the service has just started")

    @property
    def status(self) -> dict[str, Any]:
        """The status now."""
        return dict(self.server.latest.at(time.monotonic()))


class _StatusPage(_Page):
    def get(self) -> None:
        self.send_json(self.status)


class _Health(_Page):
    def get(self) -> None:
        """Return whether the receive loop runs; `/status` has the validity of the SoC."""
        status = self.status
        if status["loop_stuck"]:
            self.set_status(503)
        self.send_json({"ok": not status["loop_stuck"], "status": status["status"]})


class _Metrics(_Page):
    def get(self) -> None:
        try:
            # An extra: only this page needs it.
            from cangauge.extras.live.metrics import render  # noqa: PLC0415
        except InputError as error:
            self.refuse(404, str(error))
            return
        body, content_type = render(self.status, self.request.headers.get("Accept", ""))
        self.set_header("Content-Type", content_type)
        self.finish(body)


class Nothing(Handler):
    """Answer of all other paths."""

    text = "available: /status, /healthz, /metrics"

    def prepare(self) -> None:
        """Refuse any request."""
        super().prepare()
        if not self._finished:
            self.refuse(404, self.text)
