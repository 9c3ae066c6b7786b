"""A headless Chromium for tests of pages, and what axe-core says of them."""

from __future__ import annotations

import importlib.util
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

CHROMIUM, DRIVER = (
    next(filter(None, map(shutil.which, names)), None)
    for names in (("chromium", "chromium-browser", "google-chrome"), ("chromedriver",))
)
MARKS = [
    pytest.mark.skipif(
        CHROMIUM is None or DRIVER is None, reason="needs chromium and chromedriver"
    ),
]
_ARGUMENTS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--window-size=1280,1000",
)  # fmt: skip


@contextmanager
def chromium() -> Iterator[Any]:
    """Yield a driver that keeps the logs of console and network."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="needs selenium")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        options = webdriver.ChromeOptions()
        options.binary_location = str(CHROMIUM)
        for argument in (*_ARGUMENTS, f"--user-data-dir={folder}"):
            options.add_argument(argument)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        driver = webdriver.Chrome(
            options=options, service=webdriver.ChromeService(executable_path=DRIVER)
        )
        try:
            yield driver
        finally:
            driver.quit()


def set_scheme(browser: Any, scheme: str) -> None:
    """Prefer a light or a dark page."""
    feature = {"name": "prefers-color-scheme", "value": scheme}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})


def faults(browser: Any) -> list[str]:
    """Return the serious faults of accessibility that axe-core finds."""
    source = Path(str(importlib.util.find_spec("axe_core_python").origin)).parent / "axe.min.js"
    browser.execute_script(source.read_text(encoding="utf-8"))
    result = browser.execute_async_script(
        "axe.run(document, {resultTypes: ['violations']}).then(arguments[0])"
    )
    assert len(result["passes"]) > 10
    return [
        f"{each['id']}: {[node['html'][:80] for node in each['nodes']]}"
        for each in result["violations"]
        if each["impact"] in {"serious", "critical"}
    ]
