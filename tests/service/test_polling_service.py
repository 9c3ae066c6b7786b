"""A service that polls a battery controller on a bus; refusals of `[poll]`."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from cangauge.bus.open import BusAddress, bus_address
from cangauge.errors import InputError
from cangauge.service.config import load_config
from cangauge.service.setup import Setup
from live import leaf_model_path, waits
from polled_battery import (
    NEGATIVE,
    PENDING,
    SILENT,
    Battery,
    polling_service,
    temperature_and_cells_come,
)
from selection import nightly_except


def test_temperature_and_cells_are_polled_over_udp() -> None:
    port = 20_000 + (os.getpid() + 6007) % 20_000
    temperature_and_cells_come(bus_address("udp_multicast", options={"port": port}))


@pytest.mark.parametrize("manner", nightly_except((NEGATIVE,), (NEGATIVE, PENDING, SILENT)))
def test_silence_and_other_testers_cost_no_more_than_the_replies(manner: str) -> None:
    address = BusAddress("virtual", f"polled {manner}")
    with Battery(address, manner) as battery, polling_service(address) as service:
        polls = service.monitor.polls
        assert polls is not None
        wanted = {NEGATIVE: "negative", PENDING: "answers", SILENT: "unanswered"}[manner]
        assert waits(lambda: polls[wanted] >= 2)
        before = len(battery.requests)
        battery.manner = ""
        assert waits(lambda: polls["answers"] >= (4 if manner == PENDING else 2))
        assert len(battery.requests) - before <= 8
        assert battery.early == 0
        temperature = service.pipeline.decoder.health["temperature"]
        assert waits(lambda: temperature.value_at(time.time()) == 20.0)
        # Another tester pauses the requests.
        battery.ask(4)
        assert waits(lambda: polls["other_tester"] >= 1)
        time.sleep(0.3)
        requests = polls["requests"]
        time.sleep(1.5)
        assert polls["requests"] == requests
    assert service.error is None


def read(tmp_path: Path, text: str) -> Setup:
    path = tmp_path / "service.toml"
    path.write_text(f'model = "{leaf_model_path()}"\n{text}', encoding="utf-8")
    return Setup.of(load_config(path))


def test_polling_is_off_unless_configured(tmp_path: Path) -> None:
    assert read(tmp_path, 'vehicle = "leaf_ze1_polled"').config.poll is None
    assert read(tmp_path, 'vehicle = "leaf_ze1_polled"\n[poll]').config.poll is not None


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('vehicle = "leaf_ze1"\ntemperature = 20\n[poll]', "leaf_ze1_polled"),
        ('vehicle = "leaf_ze1_polled"\n[poll]\nevery_s = 0.1', "every_s"),
        ('vehicle = "leaf_ze1_polled"\ntime_source = "replay-clock"\n[poll]', "replay"),
        ('vehicle = "leaf_ze1_polled"\nbus_options = {listen_only = true}\n[poll]', "listen_only"),
    ],
)
def test_polling_that_cannot_work_is_refused(tmp_path: Path, text: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        read(tmp_path, text)
