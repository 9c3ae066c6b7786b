"""Answer the browsers of the live page.

A viewer gets new rows only after it has read the previous ones, so that a slow or hidden viewer
costs nothing, here or in the service. A whole span is encoded once and sent to all who request it,
so that many requests do not delay other viewers.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import re
import secrets
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from bokeh.resources import Resources
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from cangauge.extras.live.addresses import HttpAddress
from cangauge.extras.live.charts import CHARTS, STATUS_COLOURS, chart_parts
from cangauge.extras.live.history import LOG_NAME, History
from cangauge.extras.live.http import WRONG_FORMS, Handler, Site, to_json
from cangauge.service.status_client import Snapshot
from cangauge.types import REASON_WORDS, Status

NEW_ROWS: Final = 200
"""Most rows sent as new ones: 20 s of ten a second. A viewer that lacks more gets the whole span,
which is at most half as many rows old."""
ALIVE_S: Final = 0.25
"""Longest time without a message to a viewer [s]."""
_FILES: Final = Path(__file__).with_name("page")
_OWN: Final = ("enter.html", "live.js", "live.css")
_BOKEH: Final = "bokeh.min.js"
_TYPES: Final = {"js": "text/javascript; charset=utf-8", "css": "text/css; charset=utf-8"}


class LivePage(Site):
    """Serve the page on the running loop; a viewer must know the token."""

    def __init__(self, address: HttpAddress) -> None:
        self._turn = asyncio.Lock()
        self.history = History()
        self._made: dict[str, tuple[str, int, str]] = {}
        self.id = secrets.token_hex(8)
        """Key of this run; another one means that the row numbers start again."""
        self._news = asyncio.Event()
        self.texts = self._texts()
        if address.token is not None:
            # The same after a restart, so that an open page stays logged in; does not reveal the
            # token.
            key = address.token.encode()
            self.cookie = hmac.new(key, b"cangauge live page", hashlib.sha256).hexdigest()
        super().__init__(
            address,
            "live page: http://{}/",
            {
                "/(enter)?": (Entrance, False),
                f"/(rows|{re.escape(LOG_NAME)})": (HistoryPage, True),
                "/stream": (LiveStream, True),
                "/(?:files/)?(.*)": (StaticFile, False),  # browsers ask for /favicon.ico too
            },
            keeps_alive=True,
        )

    def _texts(self) -> dict[str, str]:
        """Return the files of the page by their names."""
        script, elements = chart_parts()
        spans = self.history.spans.items()
        facts = {
            "reasons": {int(each): words for each, words in REASON_WORDS.items()},
            "statuses": {int(each): each.name.lower() for each in Status},
            "colours": STATUS_COLOURS,
            "rows_at_most": {name: span.rows_at_most for name, span in spans},
        }
        environment = Environment(
            loader=FileSystemLoader(_FILES), autoescape=True, undefined=StrictUndefined
        )
        page = environment.get_template("live.html")
        bokeh = Path(Resources(mode="server").base_dir, "js", _BOKEH)
        return {
            "live.html": page.render(charts=CHARTS, elements=elements, log_name=LOG_NAME),
            "charts.js": f"window.FACTS = {json.dumps(facts)};\n{script}",
            **{path.name: path.read_text("utf-8") for path in (bokeh, *map(_FILES.joinpath, _OWN))},
        }

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Add a status, and wake those who wait for it."""
        self.history.add(snapshot.at(time.monotonic()))
        news, self._news = self._news, asyncio.Event()
        news.set()

    async def news(self) -> None:
        """Wait for the next status, at most `ALIVE_S`."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self._news.wait(), ALIVE_S)

    async def in_turn(self) -> None:
        """Wait until the answers asked for before are made, and health checks had their turn."""
        async with self._turn:
            await asyncio.sleep(0.0)

    def answer(self, name: object, key: object, after: Any) -> tuple[str, str, int]:
        """Return JSON with the status, what is wrong, and the rows of a span that a viewer lacks.

        Parameters
        ----------
        name : str
            Name of the span; anything else for no rows.
        key : str
            Key of the answer that the viewer had last.
        after : int
            Number of rows ever added to the span then.

        Returns
        -------
        str, str, int
            The JSON; key and number to continue with.
        """
        history = self.history
        content: dict[str, Any] = {"status": history.status, "troubles": history.troubles()}
        content["latest"] = history.latest()
        span = history.spans.get(str(name))
        if span is None:
            return to_json(content), "", 0
        present, added = f"{self.id}-{span.generation}", span.added
        is_known = key == present and isinstance(after, int) and 0 <= added - after <= NEW_ROWS
        if is_known:
            columns = span.to_json(after)
        else:
            added, columns = self.made(str(name), present, added, span.to_json, NEW_ROWS // 2)
        about = {"span": name, "key": present, "is_known": is_known, "added": added}
        text = to_json(content | about | {"every_ms": 1e3 * span.every_s})
        return f'{text[:-1]}, "columns": {columns}}}', present, added

    def made(
        self, name: str, key: str, rows: int, make: Callable[[], str], lag: int = 0
    ) -> tuple[int, str]:
        """Return a text made of rows, and their number; made again once more than `lag` are new."""
        made_key, made_rows, text = self._made.get(name, ("", 0, ""))
        if made_key != key or rows - made_rows > lag:
            made_rows, text = rows, make()
            self._made[name] = key, rows, text
        return made_rows, text


class Entrance(Handler):
    """The page, and the form that asks for the token."""

    def get(self, form: str | None) -> None:
        """Send the page to a viewer who has the token, else to the form."""
        if form is None and not self.has_token():
            self.redirect("/enter")
            return
        self.finish(self.site.texts["live.html" if form is None else "enter.html"])

    def post(self, _: str | None) -> None:
        """Take the token from the form."""
        header, peer = f"Bearer {self.get_body_argument('token', '')}", str(self.request.remote_ip)
        if not self.site.check_token(header, peer, WRONG_FORMS):
            self.set_status(401)
            self.finish(self.site.texts["enter.html"])
            return
        if self.site.cookie is not None:
            self.set_cookie(
                "cangauge", self.site.cookie, httponly=True, samesite="Strict", expires_days=None
            )
        self.redirect("/")


class StaticFile(Handler):
    """Scripts and styles of the page."""

    def get(self, name: str) -> None:
        """Send a file of the page."""
        kind = _TYPES.get(name.rpartition(".")[2])
        if kind is None or name not in self.site.texts:
            self.refuse(404, "there is nothing here: the live page is at /")
            return
        self.set_header("Content-Type", kind)
        self.finish(self.site.texts[name])


class HistoryPage(Handler):
    """The history as JSON, those rows that a viewer lacks; or a log of the last hour."""

    async def get(self, name: str) -> None:
        """Send the status, what is wrong, and the rows of a span after those already known."""
        await self.site.in_turn()
        if name == LOG_NAME:
            history = self.site.history
            _, log = self.site.made(name, name, history.hour.added, history.last_hour)
            self.set_header("Content-Type", "text/csv; charset=utf-8")
            self.set_header("Content-Disposition", f'attachment; filename="{LOG_NAME}"')
            self.finish(log)
            return
        span, key, after = (self.get_query_argument(part, "") for part in ("span", "key", "after"))
        number = int(after) if after.isdecimal() and len(after) < 16 else 0
        self.send_json(self.site.answer(span, key, number)[0])


class LiveStream(WebSocketHandler, Handler):
    """Send what `/rows` answers, as it comes: from each question of the viewer on.

    The next message is made once the viewer's connection has taken the one before.
    """

    def open(self, *_: str, **__: str) -> None:
        """Wait for a question."""
        self._question: dict[str, Any] = {}
        self._is_asked = asyncio.Event()
        self._sending = asyncio.ensure_future(self._send())

    def on_message(self, message: str | bytes) -> None:
        """Take a question: `{"span": "10min", "key": "", "after": 0}`."""
        try:
            question = json.loads(message)
        except (ValueError, RecursionError):
            question = None
        self._question = question if isinstance(question, dict) else {}
        self._is_asked.set()

    def on_close(self) -> None:
        """End."""
        self._sending.cancel()

    async def _send(self) -> None:
        await self._is_asked.wait()
        with suppress(WebSocketClosedError):
            while True:
                question = self._question
                await self.site.in_turn()
                text, key, added = self.site.answer(*map(question.get, ("span", "key", "after")))
                self._question = question | {"key": key, "after": added}
                await self.write_message(text)
                await self.site.news()
