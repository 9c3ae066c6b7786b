"""Unix sockets for the status: made so that only their owner's and group's users ask there.

Where others look at a running service: a unix socket, and HTTP where it is asked for.

`/status` (JSON), `/healthz` and, where the extra `metrics` is installed, `/metrics`. Everything is
read-only and runs in a thread that takes the latest snapshot; the loop neither knows nor waits.

HTTP binds to loopback unless told otherwise, and then requires a bearer token. There is no
encryption: beyond a trusted network, put a proxy with TLS in front.
"""

from __future__ import annotations

import asyncio
import errno
import hmac
import json
import logging
import os
import re
import socket
import stat
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream
from tornado.netutil import bind_sockets
from tornado.web import Application, RequestHandler

from cangauge._logging import emit
from cangauge.errors import InputError
from cangauge.service.config import HttpAddress, is_loopback_name
from cangauge.service.status import Snapshot, as_json

# --- Unix sockets for the status: made so that only their owner's and group's users ask there

SOCKET_MODE: Final = 0o660
LONGEST_NAME: Final = 40
SYSTEM_FOLDER: Final = Path("/run/cangauge")
"""Where the systemd unit has its services put them, each in a folder of its own."""

_PROBE_S: Final = 1.0


def has_unix_sockets() -> bool:
    """Return whether this system has them (Python on Windows has not)."""
    return hasattr(socket, "AF_UNIX")


def open_unix(path: Path) -> socket.socket:
    """Return a listening unix socket; one that nobody serves any more is replaced.

    Raises
    ------
    InputError
        If another service serves it, a file stands there, or it cannot be made.
    """
    if not has_unix_sockets():
        raise _bad(path, "this system has no unix sockets in Python", "take --http, or off")
    if is_served(path):
        raise _bad(path, "another service shows its status there", "name another one")
    try:
        if path.is_socket():
            path.unlink()
        server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            server.setblocking(False)
            server.bind(str(path))
            path.chmod(SOCKET_MODE)
            server.listen(16)
        except (OSError, ValueError):
            server.close()
            raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise _bad(path, f"cannot be made: {reason}", "name a writable folder, or off") from error
    return server


def is_served(path: Path) -> bool:
    """Return whether somebody listens on a unix socket."""
    try:
        if not path.is_socket():
            return False
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.settimeout(_PROBE_S)
            probe.connect(str(path))
    except (ConnectionRefusedError, FileNotFoundError):
        return False
    except (OSError, ValueError):  # busy, or not ours to ask: somebody's
        return True
    return True


def default_path(bus: str) -> Path:
    """Return where a service on a bus puts its socket, if it is not told.

    The folder is made; sockets that ended services left behind in it are removed.

    Raises
    ------
    InputError
        If the folder cannot be made, or belongs to somebody else.
    """
    folder = _own_folder()
    for left in folder.glob("*.sock"):
        if not is_served(left):
            left.unlink(missing_ok=True)
    name = re.sub(r"[^A-Za-z0-9.]+", "-", bus).strip("-.")[:LONGEST_NAME]
    return folder / f"{name or 'bus'}-{os.getpid()}.sock"


def served_sockets() -> list[Path]:
    """Return the sockets of the services that run, as far as this user can see them."""
    return [path for path in _candidates() if is_served(path)]


def _candidates() -> Iterator[Path]:
    if not has_unix_sockets():
        return
    seen = set()
    for folder in (*_folders(), SYSTEM_FOLDER, *sorted(SYSTEM_FOLDER.glob("*"))):
        try:
            found = sorted(folder.glob("*.sock"))
        except OSError:  # a folder that this user may not read
            continue
        for path in found:
            if path not in seen:
                seen.add(path)
                yield path


def _folders() -> list[Path]:
    """Return where a socket may be put, the best place first."""
    runtime = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    session = os.environ.get("XDG_RUNTIME_DIR", "")
    folders = [Path(runtime)] if runtime else []
    folders += [Path(session) / "cangauge"] if session else []
    # Anybody may write there, so the folder is used only if it is ours alone.
    return [*folders, Path("/tmp") / f"cangauge-{os.getuid()}"]  # noqa: S108 - see above


def _own_folder() -> Path:
    folder = _folders()[0]
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = folder.lstat()
    except OSError as error:
        raise _bad(folder, f"cannot be made: {error.strerror}", "name a socket") from error
    others_write = stat.S_IMODE(state.st_mode) & 0o022
    if not stat.S_ISDIR(state.st_mode) or state.st_uid != os.getuid() or others_write:
        raise _bad(folder, "this folder is not this user's alone", "name a socket elsewhere")
    return folder


def _bad(path: Path, problem: str, cure: str) -> InputError:
    return InputError(problem, source=path, field="status_socket", cure=cure)


# --- Where others look at a running service: a unix socket, and HTTP where it is asked for

if TYPE_CHECKING:
    from cangauge.service.metrics import Exposition

MAX_HEADER_BYTES: Final = 8192
MAX_BODY_BYTES: Final = 1024
MAX_CLIENTS: Final = 32
"""So many are answered at once; more are turned away."""
REQUEST_WITHIN_S: Final = 3.0
"""A request must have arrived within this time [s]."""
CLOSE_WITHIN_S: Final = 0.3
"""At the end the thread may take so long [s]; it is left behind if it takes longer."""

_LOG = logging.getLogger(__name__)
_Latest = Callable[[], Snapshot]


class Endpoint:
    """Serves snapshots from a thread of its own; use it in a `with` block.

    The sockets are opened here, so that what is wrong with them shows at once.

    Parameters
    ----------
    latest : callable
        Returns the latest snapshot.
    unix_path : Path, optional
        Unix socket; its users are the file's owner and group.
    http : HttpAddress, optional
        Loads prometheus-client.

    Raises
    ------
    InputError
        If an address is taken, cannot be bound or may not be used, or prometheus-client misses.
    """

    def __init__(
        self, latest: _Latest, *, unix_path: Path | None = None, http: HttpAddress | None = None
    ) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._done: asyncio.Event | None = None
        self._servers: list[tuple[_Server, list[socket.socket]]] = []
        self._unix_path: Path | None = None
        self.port: int | None = None
        """The TCP port that is served, where HTTP is."""
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
        # Only who wants metrics pays for the package, and hears here that it misses.
        from cangauge.service.metrics import Exposition  # noqa: PLC0415

        sockets = _open_tcp(http)
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
            except RuntimeError:  # it closed in between
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
        except Exception as error:  # noqa: BLE001 - whatever it is must not end the estimate
            emit(
                _LOG,
                logging.ERROR,
                "status.failed",
                f"status and metrics are no longer served: {error!r}",
            )

    async def _serve(self) -> None:
        self._done = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        for server, sockets in self._servers:
            server.add_sockets(sockets)
        await self._done.wait()
        for server, _ in self._servers:
            server.stop()


class _Server(HTTPServer):
    """Answers so many at once: the files that the service itself needs to open stay free."""

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        self._clients = 0
        super().initialize(*args, **kwargs)

    def handle_stream(self, stream: IOStream, address: Any) -> None:
        if self._clients >= MAX_CLIENTS:
            stream.close()
            return
        self._clients += 1
        super().handle_stream(stream, address)

    def on_close(self, server_conn: object) -> None:
        self._clients -= 1
        super().on_close(server_conn)


def _open_tcp(http: HttpAddress) -> list[socket.socket]:
    try:
        return bind_sockets(http.port, http.host)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"cannot be bound: {reason}",
            field="http",
            value=str(http),
            cure="is another service there? Choose another port"
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
    """What all pages have in common: who may see them, and plain answers to errors."""

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
        if self._http is None:  # the unix socket: the file's rights decide
            return
        token = self._http.token
        if token is None:
            # A page in a browser on this machine could otherwise read along under another name.
            if not is_loopback_name(self.request.host_name):
                self._refuse(403, "ask for this by a loopback address")
        elif not _has_token(self.request.headers.get("Authorization", ""), token):
            self.set_header("WWW-Authenticate", "Bearer")
            self._refuse(401, "a bearer token is required")
            emit(
                _LOG,
                logging.WARNING,
                "http.refused",
                f"refused {self.request.remote_ip}: no or a wrong token",
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
        """Say whether the loop turns; whether its SoC is valid is `/status`'s to say."""
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
            self._refuse(404, "metrics are served by HTTP: start the service with --http")
            return
        body, content_type = self._exposition.render(self.request.headers.get("Accept", ""))
        self.set_header("Content-Type", content_type)
        self.finish(body)


class _Nothing(_Page):
    def prepare(self) -> None:
        super().prepare()
        if not self._finished:
            self._refuse(404, "there are /status, /healthz and /metrics")


def _has_token(header: str, token: str) -> bool:
    scheme, _, given = header.partition(" ")
    same = hmac.compare_digest(given.strip().encode("utf-8", "replace"), token.encode("utf-8"))
    return same and scheme.lower() == "bearer"
