"""Answer the browsers of the live page.

Each viewer is sent what is new once it has taken what came before, so a slow or hidden one costs
nothing, here or in the service.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import re
import secrets
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from bokeh.resources import Resources
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from cangauge.extras.live.addresses import HttpAddress
from cangauge.extras.live.charts import CHARTS, STATUS_COLOURS, STATUS_NAMES, chart_parts
from cangauge.extras.live.history import LOG_NAME, REASONS, History, last_hour, shown_columns
from cangauge.extras.live.http import WRONG_FORMS, Handler, Nothing, Site
from cangauge.service.status_client import Snapshot

IDLE_S: Final = 30.0
"""Time after which a connection without a request is closed [s]."""
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
                r"/files/([a-z.]+)": (StaticFile, False),
                f"/(rows|{re.escape(LOG_NAME)})": (HistoryPage, True),
                "/stream": (LiveStream, True),
                ".*": (Nothing, False),  # browsers ask for /favicon.ico by themselves
            },
            "there is nothing here: the live page is at /",
            idle_connection_timeout=IDLE_S,
            body_timeout=IDLE_S,
        )

    def _texts(self) -> dict[str, str]:
        """Return the files of the page by their names."""
        script, elements = chart_parts()
        spans = self.history.spans.items()
        facts = {
            "reasons": REASONS,
            "statuses": STATUS_NAMES,
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

    def answer(self, name: str, key: str, after: int) -> dict[str, Any]:
        """Return the status, what is wrong, and the rows of a span that are new to a viewer.

        Parameters
        ----------
        name : str
            Name of the span; another one for no rows.
        key : str
            Key of the answer that the viewer had last.
        after : int
            Number of rows ever added to the span then.
        """
        history = self.history
        content: dict[str, Any] = {"status": history.status, "troubles": history.troubles()}
        content["latest"] = history.latest()
        span = history.spans.get(name)
        if span is None:
            return content
        present = f"{self.id}-{span.generation}"
        return content | {
            "span": name,
            "key": present,
            "is_known": key == present,
            "added": span.added,
            "every_ms": 1e3 * span.every_s,
            "columns": shown_columns(span.rows(after if key == present else 0)),
        }


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
            self.refuse(404, "no such file")
            return
        self.set_header("Content-Type", kind)
        self.finish(self.site.texts[name])


class HistoryPage(Handler):
    """HistoryPage of the history: those that a viewer lacks, or a log of the last hour."""

    async def get(self, name: str) -> None:
        """Send the status, what is wrong, and the rows of a span after those already known."""
        await self.site.in_turn()
        if name == LOG_NAME:
            self.set_header("Content-Type", "text/csv; charset=utf-8")
            self.set_header("Content-Disposition", f'attachment; filename="{LOG_NAME}"')
            self.finish(last_hour(self.site.history))
            return
        span, key, after = (self.get_query_argument(part, "") for part in ("span", "key", "after"))
        number = int(after) if after.isdecimal() and len(after) < 16 else 0
        self.send_json(self.site.answer(span, key, number))


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
                name, key, after = (question.get(part) for part in ("span", "key", "after"))
                number = after if isinstance(after, int) and after >= 0 else 0
                await self.site.in_turn()
                answer = self.site.answer(str(name), str(key), number)
                self._question = question | {"key": answer.get("key"), "after": answer.get("added")}
                await self.write_message(json.dumps(answer, ensure_ascii=False, allow_nan=False))
                await self.site.news()
