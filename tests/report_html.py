"""Report pages as a parser and a browser see them."""

from __future__ import annotations

import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest

MAX_PAGE_BYTES = 3_000_000


class Html(HTMLParser):
    """A rendered page: what it would fetch, its headings, its tables, its text without scripts."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.headings: list[str] = []
        self.tables = 0
        self.text = re.sub(r"<(script|style).*?</\1>", "", page, flags=re.DOTALL)
        self._open = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._open = tag
        self.tables += tag == "table"
        for name, value in attrs:
            is_local = (value or "").startswith("#")
            if tag == "link" or name == "src" or (name == "href" and not is_local):
                self.fetched.append(f"{tag} {name}={value}")

    def handle_data(self, data: str) -> None:
        if self._open in {"h2", "h3"} and data.strip():
            self.headings.append(data.strip())
        if self._open == "style":
            self.fetched += re.findall(r"@import.*|url\(.*?\)", data)

    def handle_endtag(self, _tag: str) -> None:
        self._open = ""


def title_after_scripts(page: Path, window: str) -> str:
    """Return a page's title in a headless browser after its scripts; skip without a browser."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium on this machine")
    dumped = subprocess.run(
        [browser, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=8000",
         f"--window-size={window}", "--dump-dom", page.as_uri()],
        capture_output=True, text=True, timeout=60, check=True,
    ).stdout  # fmt: skip
    return re.search(r"<title>(.*?)</title>", dumped).group(1)


def excess_width_px(page: str, folder: Path) -> int:
    """Return by how much a page is wider than a screen of 400 px."""
    # In a frame, since a browser's window cannot be that narrow.
    measuring = """<script>setTimeout(() => { const page = document.documentElement;
      parent.postMessage(page.scrollWidth - page.clientWidth, '*') }, 3000)</script></body>"""
    (folder / "inner.html").write_text(page.replace("</body>", measuring), encoding="utf-8")
    outer = folder / "outer.html"
    outer.write_text(
        "<title>-</title><iframe src='inner.html' style='width:400px;height:9000px'></iframe>"
        "<script>addEventListener('message', e => document.title = e.data)</script>"
    )
    return int(title_after_scripts(outer, "1000,9000"))
