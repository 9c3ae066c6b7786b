"""Answer the browsers of the live page.

Each viewer is sent what is new once it has taken what came before, so a slow or hidden one costs
nothing, here or in the service.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import secrets
import time
from contextlib import suppress
from pathlib import Path
from socket import socket
from typing import Any, Final

from bokeh.resources import Resources
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from cangauge.extras.live.addresses import HttpAddress
from cangauge.extras.live.charts import CHARTS, STATUS_COLOURS, STATUS_NAMES, chart_parts
from cangauge.extras.live.history import LOG_NAME, REASONS, History, last_hour, shown_columns
from cangauge.extras.live.http import WRONG_FORMS, Brake, Handler, Nothing, has_token, serve
from cangauge.service.output import Output
from cangauge.service.status_client import Snapshot

COOKIE: Final = "cangauge"
IDLE_S: Final = 30.0
"""Time after which a connection without a request is closed [s]."""
ALIVE_S: Final = 0.25
"""Longest time without a message to a viewer [s]."""
_FILES: Final = Path(__file__).with_name("page")
_OWN: Final = ("enter.html", "live.js", "live.css")
_BOKEH: Final = "bokeh.min.js"
_POLICY: Final = (
    "default-src 'none'; script-src 'self'; connect-src 'self'; img-src 'self' data: blob:;"
    " style-src 'self' 'unsafe-inline'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
)


class LivePage(Output):
    """Serve the page on the running loop.

    Parameters
    ----------
    address : HttpAddress
        A viewer must know its token.
    listening : socket
        Bound to it.
    """

    def __init__(self, address: HttpAddress, listening: socket) -> None:
        self.token = token = address.token
        self.brake = Brake()
        self._turn = asyncio.Lock()
        self.history = History()
        self.id = secrets.token_hex(8)
        """Key of this run; another one means that the row numbers start again."""
        # The same after a restart, so that an open page stays logged in; does not reveal the token.
        self.pass_word = "" if token is None else _cookie_of(token)
        self._news = asyncio.Event()
        self.texts = self._texts()
        pages: dict[str, type[Handler]] = {
            "/": _Live,
            "/enter": _Enter,
            r"/files/([a-z.]+)": _StaticFile,
            "/rows": _Rows,
            "/stream": _Stream,
            f"/{LOG_NAME}": _LastHour,
            ".*": _Elsewhere,
        }
        limits = {"idle_connection_timeout": IDLE_S, "body_timeout": IDLE_S}
        serve(self, listening, pages, limits)

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


class _LiveHandler(Handler):
    """A page that takes the cookie as well as a bearer token."""

    def set_default_headers(self) -> None:
        super().set_default_headers()
        self.set_header("Referrer-Policy", "no-referrer")
        self.set_header("Content-Security-Policy", _POLICY)

    def is_known(self, token: str) -> bool:
        given = self.get_cookie(COOKIE, "") or ""
        same = hmac.compare_digest(given.encode(), self.server.pass_word.encode())
        return same or super().is_known(token)


class _Live(_LiveHandler):
    def refuse_unknown(self) -> None:
        self.redirect("/enter")

    def get(self) -> None:
        self.finish(self.server.texts["live.html"])


class _Enter(_LiveHandler):
    needs_token = False

    def get(self) -> None:
        self.finish(self.server.texts["enter.html"])

    def post(self) -> None:
        token = self.server.token
        given, peer = self.get_body_argument("token", ""), str(self.request.remote_ip)
        self.server.brake.check(peer, WRONG_FORMS)
        if token is not None and not has_token(f"Bearer {given}", token):
            self.server.brake.note_wrong(peer)
            self.set_status(401)
            self.finish(self.server.texts["enter.html"])
            return
        self.set_cookie(
            COOKIE, self.server.pass_word, httponly=True, samesite="Strict", expires_days=None
        )
        self.redirect("/")


class _StaticFile(_LiveHandler):
    needs_token = False
    _TYPES: Final = {"js": "text/javascript; charset=utf-8", "css": "text/css; charset=utf-8"}

    def get(self, name: str) -> None:
        kind = self._TYPES.get(name.rpartition(".")[2])
        if kind is None or name not in self.server.texts:
            self.refuse(404, "no such file")
            return
        self.set_header("Content-Type", kind)
        self.finish(self.server.texts[name])


class _Rows(_LiveHandler):
    async def get(self) -> None:
        """Return the status, what is wrong, and the rows of a span after those already known."""
        name, key, after = (self.get_query_argument(part, "") for part in ("span", "key", "after"))
        number = int(after) if after.isdecimal() and len(after) < 16 else 0
        await self.server.in_turn()
        self.send_json(self.server.answer(name, key, number))


class _Stream(_LiveHandler, WebSocketHandler):
    """Send what `/rows` answers, as it comes: from each question of the viewer on.

    The next message is made once the viewer's connection has taken the one before.
    """

    def open(self, *_: str, **__: str) -> None:
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
        self._sending.cancel()

    async def _send(self) -> None:
        await self._is_asked.wait()
        with suppress(WebSocketClosedError):
            while True:
                question = self._question
                name, key, after = (question.get(part) for part in ("span", "key", "after"))
                number = after if isinstance(after, int) and after >= 0 else 0
                await self.server.in_turn()
                answer = self.server.answer(str(name), str(key), number)
                self._question = question | {"key": answer.get("key"), "after": answer.get("added")}
                await self.write_message(json.dumps(answer, ensure_ascii=False, allow_nan=False))
                await self.server.news()


class _LastHour(_LiveHandler):
    async def get(self) -> None:
        self.set_header("Content-Type", "text/csv; charset=utf-8")
        self.set_header("Content-Disposition", f'attachment; filename="{LOG_NAME}"')
        await self.server.in_turn()
        self.finish(last_hour(self.server.history))


class _Elsewhere(_LiveHandler, Nothing):
    needs_token = False  # browsers ask for /favicon.ico by themselves
    text = "there is nothing here: the live page is at /"


def _cookie_of(token: str) -> str:
    return hmac.new(token.encode(), b"cangauge live page", hashlib.sha256).hexdigest()
