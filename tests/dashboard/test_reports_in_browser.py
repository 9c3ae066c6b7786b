"""The reports of fit, estimate, gap and inspect in a real browser: on a screen, a phone, paper."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from headless import MARKS, chromium, faults, set_scheme

from cangauge.logs.canonical import write_log
from live import in_process, waits
from report_html import MAX_PAGE_BYTES
from selection import nightly_except
from synthetic import synthetic_log

pytestmark = MARKS


FIT = ("-o", "model.json", "--capacity-ah", "51.5")
WITH_MODEL = ("-m", "model.json")
LEGENDS_ARE_WHOLE = """
    const plots = Bokeh.index.roots.filter(each => each.model.type === "Figure");
    const legends = plots.flatMap(each => each.model.above.map(it => each.views.find_one(it)));
    return legends.every(each => each.bbox.width === 0 || each.bbox.left >= 0);
"""


def run(folder: Path, command: str, *arguments: str) -> None:
    """Run a command in a folder, with a report there."""
    with contextlib.chdir(folder):
        ended = in_process(command, *arguments, "--report", f"{command}.html")
    assert ended.code == 0, ended.err


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a log with two gaps and its model."""
    folder = tmp_path_factory.mktemp("reports")
    whole = synthetic_log(hours=0.7, noise_v=0.5, name="trip")
    write_log(whole.rows(~((whole.time_s % 1500.0) > 1100.0)), folder / "trip.parquet")
    with contextlib.chdir(folder):
        assert in_process("fit", "trip.parquet", *FIT).code == 0
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as driver:
        yield driver


@pytest.fixture(
    scope="module", params=nightly_except(("fit",), ("fit", "estimate", "gap", "inspect"))
)
def page(reports: Path, browser: Any, request: pytest.FixtureRequest) -> Any:
    """The browser once a report has drawn all its figures."""
    file = reports / f"{request.param}.html"
    arguments = {"fit": FIT, "estimate": (*WITH_MODEL, "-o", "soc.csv"), "gap": WITH_MODEL}
    run(reports, request.param, "trip.parquet", *arguments.get(request.param, ()))
    assert file.stat().st_size < MAX_PAGE_BYTES
    browser.get(file.as_uri())
    is_drawn = "return Bokeh.documents.length > 0 && Bokeh.documents.every(each => each.is_idle)"
    assert waits(lambda: browser.execute_script(is_drawn))
    return browser


@pytest.mark.parametrize("scheme", nightly_except(("dark",), ("light", "dark")))
def test_a_report_is_accessible_and_free_of_errors(page: Any, scheme: str) -> None:
    set_scheme(page, scheme)
    assert faults(page) == []
    assert [each for each in page.get_log("browser") if each["level"] == "SEVERE"] == []


def test_a_report_fits_a_phone(page: Any) -> None:
    size = {"width": 400, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        assert page.execute_script("return document.documentElement.scrollWidth") <= 400
        assert waits(lambda: page.execute_script(LEGENDS_ARE_WHOLE))
    finally:
        page.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_a_printed_report_has_all_figures(page: Any) -> None:
    figures = page.execute_script("return document.querySelectorAll('figure').length")
    pictures = page.execute_script(
        "dispatchEvent(new Event('beforeprint'));"
        "return [...document.querySelectorAll('.printed')].map(canvas => new Set("
        "canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data).size)"
    )
    assert len(pictures) == figures
    assert min(pictures) > 5  # shades in a picture; an empty one has one or two
    page.execute_script("dispatchEvent(new Event('afterprint'))")
    assert page.execute_script("return document.querySelectorAll('.printed').length") == 0
