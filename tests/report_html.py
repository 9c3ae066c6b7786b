"""Report pages as a parser sees them."""

from __future__ import annotations

import re
from html.parser import HTMLParser

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
