"""A machine that starts no further thread, as at a limit of processes (TasksMax=, ulimit -u)."""

from __future__ import annotations

import json
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
from cangauge.extras.live import launch
from cangauge.extras.live.addresses import http_address, mqtt_options
from cangauge.extras.live.launch import Live
from cangauge.service.config import MqttConfig
from cangauge.service.record import Recorder
from cangauge.service.status_client import StatusSocket
from live import LoggedLines, waits
from running import RunningService

REFUSED = "can't start new thread"


def refuse(*_: object) -> None:
    raise RuntimeError(REFUSED)


def closed_bus() -> ReconnectingBus:
    return ReconnectingBus(BusAddress("virtual", "no threads"), [])


STARTS: dict[str, Callable[[Path], object]] = {
    "recording": lambda folder: Recorder(folder / "r.log"),
    "page": lambda _: Live(http=http_address("127.0.0.1:0", None, {})),
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


def test_a_live_process_without_threads_says_so_and_is_started_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("paho.mqtt.client")
    popen, places = launch.subprocess.Popen, iter(range(100))

    def without_threads(_: list[str], **options: Any) -> Any:
        script = (
            "import threading; from cangauge.extras.live.process import main\n"
            "places, start = iter(range(9)), threading._start_new_thread\n"
            "def refuse(*given):\n"
            f"    if next(places) >= {next(places)}: raise RuntimeError({REFUSED!r})\n"
            "    return start(*given)\n"
            "threading._start_new_thread = refuse\nmain()"
        )
        return popen([sys.executable, "-c", script], **options)

    monkeypatch.setattr(launch.subprocess, "Popen", without_threads)
    monkeypatch.setattr(launch, "PAUSE_S", (0.05, 60.0))
    options = mqtt_options(MqttConfig(broker="127.0.0.1", port=1), "virtual x")
    with LoggedLines("cangauge.extras.live") as logged, closing(Live(mqtt=options)) as page:
        # Neither of its two threads; then one; then both.
        assert waits(lambda: "started again (2 so far)" in page.trouble, 30.0)
        assert waits(lambda: any("not reachable" in line for line in logged.lines), 30.0)
        logged.release_due(everything=True)
    assert sum(REFUSED in line for line in logged.lines) == 2
    assert "it ended by itself" in page.trouble
