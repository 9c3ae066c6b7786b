"""Serve the status of a running service by HTTP: `/status`, `/healthz` and `/metrics`.

All pages are read-only and show the latest snapshot. There is no encryption: beyond a trusted
network, put a TLS proxy in front.
"""

from __future__ import annotations

import hmac
import json
import logging
import time
from collections import Counter
from dataclasses import replace
from typing import Any, Final
from urllib.parse import urlsplit

from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream
from tornado.web import Application, HTTPError, RequestHandler

from cangauge._logging import emit
from cangauge._text import plain
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
_POLICY: Final = (
    "default-src 'none'; script-src 'self'; connect-src 'self'; img-src 'self' data: blob:;"
    " style-src 'self' 'unsafe-inline'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
)
_LOG = logging.getLogger(__name__)

Routes = dict[str, tuple[type["Handler"], bool]]
"""Patterns of paths, the first that matches counts: who answers, and whether a token is needed."""


class Site(Output):
    """Pages of one address, served on the running loop, and who may read them.

    Parameters
    ----------
    address : HttpAddress
        Its token is needed by requests.
    title : str
        Of the pages, with "{}" for the address, to log where they are.
    routes : dict
        Pages by patterns of their paths.
    keeps_alive : bool
        A connection may ask several times, or become a WebSocket.

    Raises
    ------
    InputError
        If the address cannot be bound.

    Attributes
    ----------
    cookie : str or None
        Cookie that is as good as the token.
    latest : Snapshot or None
        None before the first.
    """

    cookie: str | None = None
    latest: Snapshot | None = None

    def __init__(
        self, address: HttpAddress, title: str, routes: Routes, *, keeps_alive: bool = False
    ) -> None:
        self.token = address.token
        self._blocked_until_s: dict[str, float] = {}  # by peer: a second for each wrong token
        application = Application(
            [
                (path, page, {"site": self, "needs_token": needs_token})
                for path, (page, needs_token) in routes.items()
            ],
            log_function=_log_nothing,
            websocket_ping_interval=PING_S,
            websocket_max_message_size=MAX_BODY_BYTES,
        )
        listening = address.listen()
        listening.setblocking(False)
        server = _Server(
            application,
            no_keep_alive=not keeps_alive,
            max_header_size=MAX_HEADER_BYTES,
            max_body_size=MAX_BODY_BYTES,
            max_buffer_size=MAX_HEADER_BYTES + MAX_BODY_BYTES,
            idle_connection_timeout=REQUEST_WITHIN_S,
            body_timeout=REQUEST_WITHIN_S,
        )
        server.add_socket(listening)
        port = listening.getsockname()[1]
        access = "without a token" if self.token is None else "with a token"
        text = f"{title.format(replace(address, port=port))}, {access}"
        emit(_LOG.info, f"{address.key}.listening", text, port=port)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Make a snapshot the latest one."""
        self.latest = snapshot

    def check_token(self, header: str, peer: str, wrong_at_most: int) -> bool:
        """Return whether an Authorization header bears the token; takes the same time for each.

        Raise the HTTP error 429 if the peer has given too many wrong ones lately.
        """
        now_s = time.monotonic()
        if self._blocked_until_s.get(peer, 0.0) - now_s > wrong_at_most:
            raise HTTPError(429, reason="Too many wrong tokens: wait a second")
        if self.token is None:
            return True
        scheme, _, given = header.partition(" ")
        same = hmac.compare_digest(given.strip().encode("utf-8", "replace"), self.token.encode())
        if same and scheme.lower() == "bearer":
            return True
        until_s = max(self._blocked_until_s.pop(peer, now_s), now_s)
        self._blocked_until_s[peer] = until_s + 1.0
        if len(self._blocked_until_s) > PEERS_AT_MOST:
            del self._blocked_until_s[next(iter(self._blocked_until_s))]
        return False


def _log_nothing(_handler: RequestHandler) -> None:
    """Log no request: a client could fill the disk."""


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


class Handler(RequestHandler):
    """Access control and plain-text errors of all pages."""

    def initialize(self, site: Any, *, needs_token: bool) -> None:
        """Take the site, which has the token."""
        self.site, self._needs_token = site, needs_token

    def set_default_headers(self) -> None:
        """Let no answer be stored, nor load anything from elsewhere."""
        self.clear_header("Server")
        self.set_header("Cache-Control", "no-store")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Referrer-Policy", "no-referrer")
        self.set_header("Content-Security-Policy", _POLICY)

    def prepare(self) -> None:
        """Refuse a request that lacks the token, or is by a foreign name."""
        try:
            urlsplit(self.request.headers.get("Origin", ""))
        except ValueError:  # tornado would fail on it
            self.refuse(400, "the origin is no address")
            return
        # Against DNS rebinding: a web page could otherwise read this under another name.
        if self.site.token is None and not is_loopback_name(self.request.host_name):
            self.refuse(403, "request this by a loopback address")
        elif self._needs_token and not self.has_token():
            self.set_header("WWW-Authenticate", "Bearer")
            self.refuse(401, "a bearer token is required")
            text = f"refused {self.request.remote_ip}: missing or wrong token"
            emit(_LOG.warning, "http.refused", text, remote=self.request.remote_ip)

    def has_token(self) -> bool:
        """Return whether the request bears the token or the cookie, where they are needed."""
        site, cookie = self.site, self.get_cookie("cangauge", "") or ""
        if site.token is None:
            return True
        if site.cookie is not None and hmac.compare_digest(cookie.encode(), site.cookie.encode()):
            return True
        header = self.request.headers.get("Authorization", "")
        peer = str(self.request.remote_ip)
        return bool(header) and site.check_token(header, peer, WRONG_HEADERS)

    def refuse(self, code: int, text: str) -> None:
        """Answer with an error in plain text."""
        self.set_status(code)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(text + "\n")

    def write_error(self, status_code: int, **_: Any) -> None:
        """Answer with tornado's reason, without a trace."""
        self.refuse(status_code, f"{status_code} {self._reason}")

    def send_json(self, text: str) -> None:
        """Answer with JSON."""
        self.set_header("Content-Type", "application/json")
        self.finish(text + "\n")


class StatusPage(Handler):
    """The status, whether the receive loop runs, and metrics."""

    def get(self, name: str) -> None:
        """Answer a request for "status", "healthz" or "metrics"."""
        if name not in {"status", "healthz", "metrics"}:
            self.refuse(404, "available: /status, /healthz, /metrics")
        elif self.site.latest is None:
            self.refuse(503, "the service has just started")
        else:
            getattr(self, f"_send_{name}")(self.site.latest.at(time.monotonic()))

    def _send_status(self, status: dict[str, Any]) -> None:
        self.send_json(to_json(status))

    def _send_healthz(self, status: dict[str, Any]) -> None:  # the status has the SoC's validity
        self.set_status(503 if status["loop_stuck"] else 200)
        self.send_json(to_json({"ok": not status["loop_stuck"], "status": status["status"]}))

    def _send_metrics(self, status: dict[str, Any]) -> None:
        # Of another extra than the live page, which serves no metrics.
        from cangauge.extras.live.metrics import render  # noqa: PLC0415

        body, content_type = render(status, self.request.headers.get("Accept", ""))
        self.set_header("Content-Type", content_type)
        self.finish(body)


STATUS: Final[Routes] = {"/(.*)": (StatusPage, True)}


def to_json(content: dict[str, Any]) -> str:
    """Return a JSON object; a number that is not finite is null."""
    return json.dumps(plain(content), ensure_ascii=False)
