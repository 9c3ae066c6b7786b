"""Serve the status of a running service on a unix socket, and by HTTP on request.

Pages: `/status` (JSON), `/healthz` and, with the extra `metrics`, `/metrics`. All are read-only. A
thread serves them from the latest snapshot and never blocks the receive loop. There is no
encryption: beyond a trusted network, put a TLS proxy in front.
"""

from __future__ import annotations

import asyncio
import errno
import hmac
import json
import logging
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream
from tornado.netutil import bind_sockets
from tornado.web import Application, RequestHandler

from cangauge._logging import emit
from cangauge.errors import InputError
from cangauge.service.addresses import HttpAddress, is_loopback_name, open_unix
from cangauge.service.status import Snapshot, as_json

if TYPE_CHECKING:
    from cangauge.extras.live.metrics import Exposition

MAX_HEADER_BYTES: Final = 8192
MAX_BODY_BYTES: Final = 1024
MAX_CLIENTS: Final = 32
"""Most simultaneous connections, to save file descriptors. A further one takes the place of the
slowest of the peer that has most: whoever holds many places cannot keep a health probe out."""
ACCEPTS_PER_TURN: Final = 16
"""Connections accepted before others are served."""
EXHAUSTED_S: Final = 1.0
"""Pause of accepting after the system had no descriptor or memory left [s]."""
REQUEST_WITHIN_S: Final = 3.0
"""Time limit for receiving a request [s]."""
_EXHAUSTED: Final = {errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM}
CLOSE_WITHIN_S: Final = 0.3
"""Time limit for the thread to end [s]; it is a daemon."""

_LOG = logging.getLogger(__name__)
_Latest = Callable[[], Snapshot]


class Endpoint:
    """Serve snapshots from a thread; use it in a `with` block.

    The constructor opens the sockets, so that errors show at once.

    Parameters
    ----------
    latest : callable
        Returns the latest snapshot.
    unix_path : Path, optional
        Unix socket, for the file's owner and group.
    http : HttpAddress, optional
        Address for HTTP; needs prometheus-client.

    Raises
    ------
    InputError
        If an address is in use or cannot be bound, or prometheus-client is missing.
    """

    def __init__(
        self, latest: _Latest, *, unix_path: Path | None = None, http: HttpAddress | None = None
    ) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._done: asyncio.Event | None = None
        self._servers: list[tuple[_Server, list[socket.socket]]] = []
        self._unix_path: Path | None = None
        self.port: int | None = None
        """TCP port of HTTP; None without."""
        try:
            if http is not None:
                self._add_http(latest, http)
            if unix_path is not None:
                self._add(_application(latest, None, None), [open_unix(unix_path)])
                self._unix_path = unix_path
        except InputError:
            self._close_sockets()
            raise
        self._thread = threading.Thread(target=self._run, name="cangauge-status", daemon=True)

    def _add_http(self, latest: _Latest, http: HttpAddress) -> None:
        # An optional dependency: the import raises the error if it is missing.
        from cangauge.extras.live.metrics import Exposition  # noqa: PLC0415

        sockets = open_tcp(http)
        self.port = int(sockets[0].getsockname()[1])
        self._add(_application(latest, Exposition(latest), http), sockets)

    def _add(self, application: Application, sockets: list[socket.socket]) -> None:
        server = _Server(
            application,
            no_keep_alive=True,
            max_header_size=MAX_HEADER_BYTES,
            max_body_size=MAX_BODY_BYTES,
            max_buffer_size=MAX_HEADER_BYTES + MAX_BODY_BYTES,
            idle_connection_timeout=REQUEST_WITHIN_S,
            body_timeout=REQUEST_WITHIN_S,
        )
        self._servers.append((server, sockets))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the thread and remove the unix socket."""
        loop, done = self._loop, self._done
        if loop is not None and done is not None and not loop.is_closed():
            try:
                loop.call_soon_threadsafe(done.set)
            except RuntimeError:  # closed in the meantime
                _LOG.debug("the status thread had ended")
        if self._thread.is_alive():
            self._thread.join(CLOSE_WITHIN_S)
        self._close_sockets()
        if self._unix_path is not None:
            self._unix_path.unlink(missing_ok=True)

    def _close_sockets(self) -> None:
        for _, sockets in self._servers:
            for each in sockets:
                each.close()

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except Exception as error:  # noqa: BLE001 - an error here must not end the estimate
            emit(
                _LOG,
                logging.ERROR,
                "status.failed",
                f"status and metrics are no longer served: {error!r}",
            )

    async def _serve(self) -> None:
        self._done = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        doors = [_Door(server, each) for server, sockets in self._servers for each in sockets]
        for door in doors:
            door.open()
        await self._done.wait()
        for door in doors:
            door.close()


class _Server(HTTPServer):
    """Limit the number of simultaneous connections."""

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        self._clients: dict[IOStream, str] = {}  # with their peers, the oldest first
        super().initialize(*args, **kwargs)

    def handle_stream(self, stream: IOStream, address: Any) -> None:
        if len(self._clients) >= MAX_CLIENTS:
            self.drop_slowest()
        self._clients[stream] = str(address[0]) if isinstance(address, tuple) else ""
        super().handle_stream(stream, address)

    def drop_slowest(self) -> bool:
        """Close the oldest connection of the peer that has most; return False if there is none."""
        if not self._clients:
            return False
        [(crowd, _)] = Counter(self._clients.values()).most_common(1)
        slowest = next(stream for stream, peer in self._clients.items() if peer == crowd)
        del self._clients[slowest]
        slowest.close()
        return True

    def on_close(self, server_conn: Any) -> None:
        self._clients.pop(server_conn.stream, None)
        super().on_close(server_conn)


class _Door:
    """Accept the connections of a listening socket.

    tornado's own loop would accept again at once, forever, while no descriptor is left.
    """

    def __init__(self, server: _Server, listening: socket.socket) -> None:
        self._server = server
        self._listening = listening
        self._loop = asyncio.get_running_loop()

    def open(self) -> None:
        self._loop.add_reader(self._listening, self._accept)

    def close(self) -> None:
        self._loop.remove_reader(self._listening)

    def _accept(self) -> None:
        for _ in range(ACCEPTS_PER_TURN):
            try:
                connection, address = self._listening.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno in _EXHAUSTED:
                    text = f"no connection can be accepted: {error.strerror}"
                    emit(_LOG, logging.WARNING, "http.exhausted", f"{text}; the estimate continues")
                    if self._server.drop_slowest():
                        continue
                    self.close()
                    self._loop.call_later(EXHAUSTED_S, self.open)
                return  # or the client went away
            connection.setblocking(False)
            stream = IOStream(connection, max_buffer_size=self._server.max_buffer_size)
            self._server.handle_stream(stream, address)


def open_tcp(http: HttpAddress, field: str = "http") -> list[socket.socket]:
    """Return listening sockets; raise InputError, with this field, if they cannot be bound."""
    try:
        return bind_sockets(http.port, http.host)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"cannot be bound: {reason}",
            field=field,
            value=str(http),
            cure="in use by another service? Choose another port"
            if getattr(error, "errno", None) == errno.EADDRINUSE
            else "name an address of this machine, such as 127.0.0.1:9464",
        ) from error


def _application(
    latest: _Latest, exposition: Exposition | None, http: HttpAddress | None
) -> Application:
    context = {"latest": latest, "exposition": exposition, "http": http}
    pages: Sequence[tuple[str, type[RequestHandler]]] = (
        ("/status", _Status),
        ("/healthz", _Health),
        ("/metrics", _Metrics),
    )
    return Application(
        [(path, page, context) for path, page in pages],
        default_handler_class=_Nothing,
        default_handler_args=context,
        log_function=_log_request,
    )


def _log_request(handler: RequestHandler) -> None:
    _LOG.debug("%s %s: %d", handler.request.method, handler.request.path, handler.get_status())


class _Page(RequestHandler):
    """Access control and plain-text errors of all pages."""

    def initialize(
        self, latest: _Latest, exposition: Exposition | None, http: HttpAddress | None
    ) -> None:
        self._latest = latest
        self._exposition = exposition
        self._http = http

    def set_default_headers(self) -> None:
        self.clear_header("Server")
        self.set_header("Cache-Control", "no-store")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Content-Type", "text/plain; charset=utf-8")

    def prepare(self) -> None:
        if self._http is None:  # unix socket: file permissions apply
            return
        token = self._http.token
        if token is None:
            # Against DNS rebinding: a web page could otherwise read this under another name.
            if not is_loopback_name(self.request.host_name):
                self._refuse(403, "request this by a loopback address")
        elif not has_token(self.request.headers.get("Authorization", ""), token):
            self.set_header("WWW-Authenticate", "Bearer")
            self._refuse(401, "a bearer token is required")
            emit(
                _LOG,
                logging.WARNING,
                "http.refused",
                f"refused {self.request.remote_ip}: missing or wrong token",
                remote=self.request.remote_ip,
            )

    def _refuse(self, code: int, text: str) -> None:
        self.set_status(code)
        self.finish(text + "\n")

    def write_error(self, status_code: int, **_: Any) -> None:
        self.finish(f"{status_code} {self._reason}\n")

    def send_json(self, content: dict[str, Any]) -> None:
        self.set_header("Content-Type", "application/json")
        self.finish(json.dumps(content, ensure_ascii=False) + "\n")


class _Status(_Page):
    def get(self) -> None:
        self.send_json(as_json(self._latest(), time.monotonic()))


class _Health(_Page):
    def get(self) -> None:
        """Return whether the receive loop runs; `/status` has the validity of the SoC."""
        snapshot, now_s = self._latest(), time.monotonic()
        if snapshot.is_stuck(now_s):
            self.set_status(503)
        self.send_json(
            {
                "ok": not snapshot.is_stuck(now_s),
                "status": snapshot.estimate_at(now_s).status.name.lower(),
            }
        )


class _Metrics(_Page):
    def get(self) -> None:
        if self._exposition is None:
            self._refuse(404, "metrics need HTTP: start the service with --http")
            return
        body, content_type = self._exposition.render(self.request.headers.get("Accept", ""))
        self.set_header("Content-Type", content_type)
        self.finish(body)


class _Nothing(_Page):
    def prepare(self) -> None:
        super().prepare()
        if not self._finished:
            self._refuse(404, "available: /status, /healthz, /metrics")


def has_token(header: str, token: str) -> bool:
    """Return whether an Authorization header bears the token; takes the same time for each."""
    scheme, _, given = header.partition(" ")
    same = hmac.compare_digest(given.strip().encode("utf-8", "replace"), token.encode("utf-8"))
    return same and scheme.lower() == "bearer"
