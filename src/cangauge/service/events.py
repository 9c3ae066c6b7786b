"""The log of a running service: an event a line on stderr, for people or as JSON, rate-limited."""

from __future__ import annotations

import json
import logging
import math
import select
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from operator import attrgetter
from typing import IO, Final, Literal, TextIO

from cangauge._text import plain, printable, printable_json

LogFormat = Literal["text", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]

FIRST_INTERVAL_S: Final = 1.0
"""Minimum time between the first two records of an event [s]; doubles with each repetition …"""
LONGEST_INTERVAL_S: Final = 60.0
"""… up to this [s]. An event that was quiet for longer starts again at the first interval."""


@dataclass(slots=True)
class _Repetitions:
    """State of one event; `held` is the latest suppressed record."""

    latest_s: float = -math.inf
    next_s: float = -math.inf
    interval_s: float = 0.0
    suppressed: int = 0
    held: logging.LogRecord | None = None


class RateLimitedHandler(logging.StreamHandler[TextIO]):
    """Write each event at most once per interval, as a line of text or as a JSON object.

    The latest suppressed record of an event is written by `release_due` once its interval has
    ended. It says how many were suppressed. A reader that has stopped costs lines: the service
    never waits for it.

    Parameters
    ----------
    log_format : {"text", "json"}
    stream : file, optional
        Default: stderr.
    clock : callable
        Monotonic time [s].
    """

    def __init__(
        self,
        log_format: LogFormat = "text",
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(stream)
        self._log_format = log_format
        self._clock = clock
        self._events: dict[tuple[str, str], _Repetitions] = {}

    def handle(self, record: logging.LogRecord) -> bool:
        """Write a record, or hold it; return whether it was written."""
        if not self.filter(record):
            return False
        key = (record.name, str(getattr(record, "limit", record.msg)))
        with self.lock:  # type: ignore[union-attr] # made by Handler
            now_s = self._clock()
            event = self._events[key] = self._events.pop(key, _Repetitions())
            if len(self._events) > 256:  # bounds the memory: the one quiet for longest goes
                del self._events[next(iter(self._events))]
            if now_s - event.latest_s > LONGEST_INTERVAL_S:
                event.interval_s = 0.0
            event.latest_s = now_s
            if now_s < event.next_s:
                event.suppressed += 1
                event.held = record
                return False
            self._write(event, record, now_s)
        return True

    def release_due(self, *, everything: bool = False) -> None:
        """Write the suppressed records whose interval has ended, or all of them."""
        with self.lock:  # type: ignore[union-attr] # made by Handler
            now_s = self._clock()
            held = [each for each in self._events.values() if each.held is not None]
            for event in sorted(held, key=attrgetter("held.created")):
                if event.held is not None and (everything or now_s >= event.next_s):
                    event.suppressed -= 1
                    self._write(event, event.held, now_s)

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record; drop it if the stream's reader has stopped."""
        if takes_text(self.stream):
            super().emit(record)

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as one line, such as `TIME WARNING bus.lost: can0 is down (retry_s=1)`.

        As JSON it is an object with `time`, `level`, `event`, `message`, `logger` and the fields.
        The event of other libraries is "log".
        """
        stamp = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        time_text = stamp.replace("+00:00", "Z")
        event = str(getattr(record, "event", "log"))
        message = record.getMessage()
        fields = dict(getattr(record, "fields", {}))
        if record.exc_info is not None:
            message = f"{message}: {record.exc_info[1]!r}"
        if hasattr(record, "suppressed"):
            fields["repeats_suppressed"] = record.suppressed
        if self._log_format == "json":
            content = plain(fields) | {
                "time": time_text,
                "level": record.levelname.lower(),
                "event": event,
                "message": message,
                "logger": record.name,
            }
            return printable_json(json.dumps(content, ensure_ascii=False, default=str))
        pairs = " ".join(
            f"{name}={value:.6g}" if isinstance(value, float) else f"{name}={value}"
            for name, value in fields.items()
        )
        line = f"{time_text} {record.levelname} {event}: {message}"
        return printable(" ".join((f"{line} ({pairs})" if pairs else line).splitlines()))

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        """Ignore errors: a closed stderr must not end the service, and cannot be reported."""

    def _write(self, event: _Repetitions, record: logging.LogRecord, now_s: float) -> None:
        if event.suppressed:
            record.suppressed = event.suppressed
        event.suppressed = 0
        event.held = None
        event.interval_s = min(2.0 * event.interval_s, LONGEST_INTERVAL_S) or FIRST_INTERVAL_S
        event.next_s = now_s + event.interval_s
        self.emit(record)


@contextmanager
def logging_to(
    log_format: LogFormat, level: LogLevel = "info", stream: TextIO | None = None
) -> Iterator[None]:
    """Write log records to a stream (stderr) while the block runs, then restore the set-up.

    `level` is the lowest one written; other libraries are limited to errors, unless it is "debug".
    """
    handler = RateLimitedHandler(log_format, stream)
    # python-can logs and raises the same error, at each attempt to open a missing bus.
    levels: dict[str, int | str] = {
        "": logging.ERROR,
        "cangauge": level.upper(),
        "can": logging.CRITICAL,
    }
    if level == "debug":
        levels |= {"": logging.DEBUG, "can": logging.NOTSET}
    loggers = {logging.getLogger(name): least for name, least in levels.items()}
    root = logging.getLogger()
    before = root.handlers
    levels_before = {logger: logger.level for logger in loggers}
    root.handlers = [handler]
    for logger, least in loggers.items():
        logger.setLevel(least)
    try:
        yield
    finally:
        handler.release_due(everything=True)
        root.handlers = before
        for logger, number in levels_before.items():
            logger.setLevel(number)


def release_held() -> None:
    """Write the suppressed records whose interval has ended; the receive loop calls this."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler, RateLimitedHandler):
            handler.release_due()


def takes_text(stream: IO[str]) -> bool:
    """Return whether a stream takes a line without waiting.

    A pipe whose reader has stopped, or a terminal after Ctrl-S, does not: whoever writes there
    would stop with it.
    """
    try:
        ready = select.poll()
        ready.register(stream.fileno(), select.POLLOUT)
        return bool(ready.poll(0))
    except (AttributeError, OSError, ValueError):  # Windows; no real file
        return True
