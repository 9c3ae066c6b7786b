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

from cangauge.service.output import Output
from cangauge.service.status_client import Snapshot, StatusSocket
from live import loop_config, waits


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
    snapshot : Snapshot
        The first one.
    **keys
        Of the configuration. Port 0 for addresses: `port` is the first one's.
    """

    def __init__(self, snapshot: Snapshot, **keys: Any) -> None:
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
            config = loop_config(status_socket=str(endpoint), log_format="json", **keys)
            stdin.write(config.model_dump_json())
        self.lines: list[dict[str, Any]] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        if {"http", "dashboard"} & keys.keys():
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
