"""Start the process of the live page, and hand it the service's latest status."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from cangauge._logging import emit
from cangauge.errors import InputError
from cangauge.extras.live.addresses import HttpAddress, http_address
from cangauge.extras.live.http import open_tcp
from cangauge.service.output import Output
from cangauge.service.status import Snapshot

if TYPE_CHECKING:
    from cangauge.service.run import Service

NICE: Final = 5
"""Lower priority of the page's process, so that the estimate comes first."""
END_WITHIN_S: Final = 0.5
"""Time limit for the process to end by itself [s]."""

_LOG = logging.getLogger(__name__)


class LivePage(Output):
    """The live page of a service.

    A thread sends the latest snapshot and drops those that come while it sends, so that
    `on_snapshot` never waits. The constructor opens the sockets, so that errors show at once.

    Parameters
    ----------
    address : HttpAddress
    on_record : callable, optional
        Takes, in a thread, whether a recording shall run, once a viewer asks.

    Raises
    ------
    InputError
        If the address cannot be bound, or the system cannot hand sockets to another process.
    """

    def __init__(
        self, address: HttpAddress, on_record: Callable[[bool], None] = lambda _: None
    ) -> None:
        if os.name != "posix":
            raise InputError(
                "the live page needs Linux or macOS", field="dashboard", cure="run without it"
            )
        self._address = address
        self._sockets = open_tcp(address, "dashboard")
        self.port = int(self._sockets[0].getsockname()[1])
        self._on_record = on_record
        self._latest: Snapshot | None = None
        self._new = threading.Event()
        self._done = False
        self._thread = threading.Thread(target=self._run, name="cangauge-page", daemon=True)

        self._start()

    def _start(self) -> None:
        numbers = [each.fileno() for each in self._sockets]
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-P",
                "-m",
                "cangauge.extras.live.server",
            ],  # -P: not the working folder
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=numbers,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        self._first = {"sockets": numbers, "token": self._address.token, "nice": NICE}
        self._thread.start()
        threading.Thread(target=self._listen, name="cangauge-page-asks", daemon=True).start()
        host = f"[{self._address.host}]" if ":" in self._address.host else self._address.host
        emit(
            _LOG,
            logging.INFO,
            "dashboard.listening",
            f"live page: http://{host}:{self.port}/"
            + (", with a token" if self._address.token else ""),
            port=self.port,
        )

    def close(self) -> None:
        """End the page's process."""
        self._done = True
        self._new.set()
        self._thread.join(END_WITHIN_S)
        try:
            self._process.wait(END_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for each in self._sockets:
            each.close()

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Make a snapshot the latest one; returns at once."""
        self._latest = snapshot
        self._new.set()

    def _run(self) -> None:
        pipe = self._process.stdin
        assert pipe is not None  # noqa: S101 - as it was made
        try:
            with pipe:
                self._send(pipe.fileno(), self._first)
                while not self._done:
                    self._new.wait()
                    self._new.clear()
                    if self._latest is not None and not self._done:
                        self._send(pipe.fileno(), self._latest.at(time.monotonic()))
        except OSError as error:
            if not self._done:
                text = f"the live page is no longer served: {error}; the estimate continues"
                emit(_LOG, logging.WARNING, "dashboard.failed", text)

    def _listen(self) -> None:
        lines = self._process.stdout
        assert lines is not None  # noqa: S101 - as it was made
        with lines:
            for line in lines:
                self._on_record(json.loads(line)["active"])

    @staticmethod
    def _send(pipe: int, content: object) -> None:
        left = json.dumps(content, ensure_ascii=False).encode() + b"\n"
        while left:
            left = left[os.write(pipe, left) :]


def make_output(service: Service) -> LivePage:
    """Return the page that a service's configuration asks for; may raise InputError."""
    config = service.config
    address = http_address(str(config.dashboard), config.http_token_file, field="dashboard")
    return LivePage(address, lambda active: service.record(active=active))
