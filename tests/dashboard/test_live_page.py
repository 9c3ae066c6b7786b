"""The live page in a real browser, over a real service on a bus."""

from __future__ import annotations

import importlib
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cantools
import pytest
from headless import MARKS, chromium, faults, set_scheme

from cangauge._resources import shared_file
from cangauge.types import Sample
from live import virtual_port, waits
from running import SAMPLE_S, RunningService, free_port
from selection import nightly_except

pytestmark = MARKS

CURRENT_A, VOLTAGE_V, TEMPERATURE_C = 12.5, 378.2, 23.0
TIMES_MS = "return Bokeh.documents[0].get_model_by_name('rows').data.time_ms"


class Bench:
    """A service with its page, and a car that sends one steady sample."""

    def __init__(self, folder: Path) -> None:
        self._folder, self.record, self._port = folder, folder / "drive.log", free_port()
        self.url = f"http://127.0.0.1:{self._port}/"
        self.start()

    def start(self) -> None:
        text = f'dashboard = "127.0.0.1:{self._port}"\nrecord = "drive.log"\n'
        steady = Sample(0.0, CURRENT_A, VOLTAGE_V, TEMPERATURE_C)
        self.running = RunningService(self._folder, text, steady=steady).__enter__()

    def stop(self) -> None:
        self.running.__exit__()


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    bench = Bench(tmp_path_factory.mktemp("recordings"))
    yield bench
    bench.stop()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as driver:
        yield driver


@pytest.fixture
def page(bench: Bench, browser: Any) -> Any:
    """The browser on a fresh page that shows values."""
    browser.get(bench.url)
    assert waits(lambda: tile(browser, "Current") == f"{CURRENT_A:.2f} A")
    return browser


def text(browser: Any, name: str) -> str:
    return str(browser.execute_script(f"return document.getElementById('{name}').textContent"))


def tile(browser: Any, name: str) -> str | None:
    found: str | None = browser.execute_script(
        "return [...document.querySelectorAll('#tiles > div')]"
        ".find(tile => tile.firstChild.textContent === arguments[0])?.lastChild.textContent",
        name,
    )
    return found


def published(bench: Bench) -> dict[str, Any]:
    """Return the signals of the next SOC_ESTIMATE on the bus."""
    database = cantools.database.load_file(shared_file("dbc", "soc_estimate.dbc"))
    message = database.get_message_by_name("SOC_ESTIMATE")
    with virtual_port(bench.record.parent.name) as bus:
        while True:
            frame = bus.receive(2.0)
            assert frame is not None, "no SOC_ESTIMATE"
            if frame.arbitration_id == message.frame_id:
                decoded: dict[str, Any] = message.decode(bytes(frame.data))
                return decoded


def is_shown(browser: Any, words: str, seconds: float = 5.0) -> bool:
    return waits(lambda: words in text(browser, "troubles"), seconds)


def test_the_page_shows_what_the_bus_carries(bench: Bench, page: Any) -> None:
    assert tile(page, "Voltage") == f"{VOLTAGE_V:.2f} V"
    assert tile(page, "Temperature") == f"{TEMPERATURE_C:.1f} °C"
    frame = published(bench)
    soc, std = map(float, text(page, "soc").removesuffix(" %").split(" ± "))
    # Half a step of the frame and of the text; ten more samples may have come in between.
    assert soc == pytest.approx(frame["soc_pct"], abs=0.005 + 0.005 + 0.02)
    assert std == pytest.approx(frame["soc_std_pct"], abs=0.025 + 0.005 + 0.01)
    assert text(page, "state") == str(frame["status"])
    # The largest current of the model's logs is a lower bound; this pack holds more than 1 kWh.
    assert tile(page, "Possible discharge, 10 s") == "at least 200 A"
    assert str(tile(page, "Energy left")).endswith(" kWh")
    drawn = page.execute_script(
        "const rows = Bokeh.documents[0].get_model_by_name('rows').data;"
        "return ['current_a', 'voltage_v', 'soc_pct'].map(name => rows[name].at(-1))"
    )
    assert drawn[:2] == [CURRENT_A, VOLTAGE_V]
    assert drawn[2] == pytest.approx(soc, abs=0.03)


def messages(browser: Any, method: str) -> list[dict[str, Any]]:
    """Return the parameters of what the browser's network has reported since the last call."""
    found = (json.loads(each["message"])["message"] for each in browser.get_log("performance"))
    return [each["params"] for each in found if each["method"] == method]


def test_the_values_come_ten_times_a_second(bench: Bench, page: Any) -> None:
    messages(page, "")
    began = bench.running.service.pipeline.samples
    time.sleep(1.0)
    came = len(messages(page, "Network.webSocketFrameReceived"))
    # Of the car, whose samples come later where the machine is busy.
    seconds = SAMPLE_S * (bench.running.service.pipeline.samples - began)
    assert came / seconds > 5.0


def test_a_silent_bus_is_shown_within_a_second(bench: Bench, page: Any) -> None:
    bench.running.silent.set()
    try:
        page.execute_script(
            "new MutationObserver(() => { window.first ??= "
            "document.getElementById('troubles').textContent || undefined; })"
            ".observe(document.getElementById('troubles'),"
            " {childList: true, characterData: true, subtree: true})"
        )
        assert is_shown(page, "The bus is silent: no sample for")
        first_s = float(page.execute_script("return window.first").split(" for ")[1].split(" ")[0])
        assert first_s <= 1.0
    finally:
        bench.running.silent.clear()
    assert waits(lambda: text(page, "troubles") == "")


@pytest.mark.parametrize(
    ("tab", "scheme"),
    nightly_except(
        [("tab-gap", "light"), ("tab-live", "dark")],
        [("tab-gap", "light"), ("tab-gap", "dark"), ("tab-live", "light"), ("tab-live", "dark")],
    ),
)
def test_axe_finds_no_serious_fault(page: Any, tab: str, scheme: str) -> None:
    page.find_element("id", tab).click()
    set_scheme(page, scheme)
    assert faults(page) == []


@pytest.mark.nightly
def test_two_viewers_see_the_same(bench: Bench, page: Any) -> None:
    first = page.current_window_handle
    page.switch_to.new_window("window")
    page.get(bench.url)
    handles = page.window_handles
    assert len(handles) == 2
    for handle in handles:
        page.switch_to.window(handle)
        assert waits(lambda: tile(page, "Voltage") == f"{VOLTAGE_V:.2f} V")
    for handle in handles:
        page.switch_to.window(handle)
        if handle != first:
            page.close()
    page.switch_to.window(first)


def test_pause_span_zoom_and_tabs_by_keyboard(page: Any) -> None:
    keys = importlib.import_module("selenium.webdriver.common.keys").Keys
    by_id = lambda name: page.find_element("id", name)  # noqa: E731
    by_id("pause").send_keys(keys.ENTER)
    assert text(page, "pause") == "Resume"
    added = f"{TIMES_MS}.length"
    before = page.execute_script(added)
    time.sleep(0.5)
    assert page.execute_script(added) == before
    width = "const r = Bokeh.documents[0].get_model_by_name('time'); return r.end - r.start"
    whole = page.execute_script(width)
    by_id("in").send_keys(keys.ENTER)
    assert page.execute_script(width) == pytest.approx(whole / 2.0)
    by_id("pause").send_keys(keys.ENTER)
    assert waits(lambda: page.execute_script(added) > before)
    page.find_element("css selector", "[value='10min']").send_keys(keys.ARROW_RIGHT)
    assert waits(lambda: 0 < page.execute_script(added) < before)
    by_id("tab-live").send_keys(keys.ARROW_RIGHT)
    assert by_id("gap").is_displayed()
    assert not by_id("live").is_displayed()
    assert waits(lambda: text(page, "command").startswith("cangauge gap cangauge-last-hour.csv"))


def test_no_error_and_no_request_leaves_the_machine(bench: Bench, page: Any) -> None:
    """And reloading shows the page as at first, whatever a viewer has chosen."""
    assert [each for each in page.get_log("browser") if each["level"] == "SEVERE"] == []
    page.refresh()
    assert waits(lambda: tile(page, "Voltage") == f"{VOLTAGE_V:.2f} V")
    found = [json.loads(each["message"])["message"] for each in page.get_log("performance")]
    asked = [
        each["params"].get("url") or each["params"]["request"]["url"]
        for each in found
        if each["method"] in {"Network.requestWillBeSent", "Network.webSocketCreated"}
    ]
    assert len(asked) > 5
    own = (bench.url, bench.url.replace("http", "ws"), "data:", "blob:", "chrome:")
    assert [url for url in asked if not url.startswith(own)] == []


def test_an_open_page_survives_a_restart(bench: Bench, page: Any) -> None:
    before = page.execute_script(TIMES_MS)
    assert text(page, "recording").startswith(f"Recording to {bench.record}: ")
    bench.stop()
    # Longer than the page draws a line over.
    assert is_shown(page, "The service does not answer for 3 s", 20.0)
    bench.start()
    assert waits(lambda: text(page, "troubles") == "")
    assert tile(page, "Current") == f"{CURRENT_A:.2f} A"
    assert waits(lambda: page.execute_script(TIMES_MS)[-1] > before[-1] + 500.0)
    after = page.execute_script(TIMES_MS)
    # Many rows are drawn by stretches, the last of which has grown since.
    assert after[0] == before[0]
    assert max(each for each in after if each <= before[-1]) > before[-1] - 2000.0
    assert after == sorted(after)
    broken = 'return Bokeh.documents[0].get_model_by_name("rows").data.soc_pct.some(Number.isNaN)'
    assert page.execute_script(broken)  # no line over the time without a service
    again = bench.record.with_name("drive-0001-000001.log")
    assert text(page, "recording").startswith(f"Recording to {again}: ")
