"""A machine that starts no further thread, as at a limit of processes (TasksMax=, ulimit -u)."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

from cangauge.bus.open import BusAddress
from cangauge.bus.reconnecting import ReconnectingBus
from cangauge.errors import CangaugeError
from cangauge.extras.inverter.gateway import Gateway
from cangauge.service.record import Recorder
from cangauge.service.status_client import SCHEMA, StatusSocket
from live import loop_config, waits
from running import RunningService

REFUSED = "can't start new thread"


def refuse(*_: object) -> None:
    raise RuntimeError(REFUSED)


def closed_bus() -> ReconnectingBus:
    return ReconnectingBus(BusAddress("virtual", "no threads"), [])


STARTS: dict[str, Callable[[Path], object]] = {
    "recording": lambda folder: Recorder(folder / "r.log"),
    "gateway": lambda _: Gateway(closed_bus(), closed_bus(), {}),
    "status": lambda folder: StatusSocket(folder / "s.sock", dict),
}


@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS.keys())
def test_a_start_without_threads_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start: Callable[[Path], object]
) -> None:
    monkeypatch.setattr(threading, "_start_new_thread", refuse)
    with pytest.raises(CangaugeError, match=REFUSED):
        start(tmp_path)
    assert not list(tmp_path.glob("*.sock"))  # a client would wait for an answer


def test_a_reload_without_threads_is_refused_and_the_service_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with RunningService(tmp_path) as running:

        def status() -> Any:
            with urlopen(f"{running.endpoint}/status") as answer:  # noqa: S310 - http
                return json.load(answer)

        with monkeypatch.context() as patch:
            patch.setattr(threading, "_start_new_thread", refuse)
            running.service.reload()
            assert waits(lambda: REFUSED in str(status()["config"]["problem"]))
        before = status()["samples"]
        running.service.reload()
        assert waits(lambda: status()["config"]["problem"] is None)
        assert waits(lambda: status()["samples"] > before)
    assert running.summary is not None


def test_what_serves_networks_without_threads_ends_and_says_so(tmp_path: Path) -> None:
    script = (
        "import threading; from cangauge.extras.live.serve import main\n"
        f"def refuse(*_): raise RuntimeError({REFUSED!r})\n"
        "threading._start_new_thread = refuse\nmain()"
    )
    with closing(StatusSocket(tmp_path / "s.sock", lambda: {"schema": SCHEMA, "bus": "x"})):
        config = loop_config(http="127.0.0.1:0", status_socket=str(tmp_path / "s.sock"))
        found = subprocess.run(
            [sys.executable, "-c", script],
            input=config.model_dump_json(),
            capture_output=True,
            text=True,
            timeout=60.0,
            check=False,
        )
    assert found.returncode == 1
    assert REFUSED in found.stderr.splitlines()[-1]
