"""What serves networks, as a process of its own beside a status socket that a test feeds."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, Self

from cangauge.extras.live.serve import Offer, to_json
from cangauge.service.output import Output
from cangauge.service.status_client import Snapshot, StatusSocket
from live import waits


class Shown(Output):
    """Shows each snapshot of a loop by what serves networks."""

    def __init__(self, served: Served) -> None:
        self._served = served

    def on_snapshot(self, snapshot: Snapshot) -> None:
        self._served.show(snapshot)


class Served:
    """The process; `show` makes a snapshot the service's latest one, `lines` are its events.

    Parameters
    ----------
    offer : Offer
        Port 0 for addresses: `port` is the first one's.
    snapshot : Snapshot
        The first one.
    """

    def __init__(self, offer: Offer, snapshot: Snapshot) -> None:
        self.show(snapshot)
        self._folder = tempfile.TemporaryDirectory()
        endpoint = Path(self._folder.name, "s.sock")
        self.service = StatusSocket(endpoint, lambda: self._snapshot.at(time.monotonic()))
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "cangauge.extras.live.serve"],
            stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.process.stdin is not None
        with self.process.stdin as stdin:
            stdin.write(to_json(endpoint, offer, "json", "info"))
        self.lines: list[dict[str, Any]] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        if offer.http or offer.dashboard:
            assert waits(lambda: any("port" in line for line in self.lines)), self.lines
            self.port = next(line["port"] for line in self.lines if "port" in line)

    def show(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot

    def said(self, text: str) -> bool:
        """Return whether an event so far has a text."""
        return any(text in line["message"] for line in self.lines)

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(json.loads(line))

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(20.0)
        self._reader.join(20.0)
        self.service.close()
        self._folder.cleanup()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
