"""Events of a running service, one a line on stderr: for people, or as JSON for machines.

Anything that has something to say takes a logger of the standard library and names its event::

    _LOG = logging.getLogger(__name__)
    emit(_LOG, logging.WARNING, "bus.lost", "socketcan can0 is down", retry_s=1.0)

Event names are stable (`area.what_happened`), so that they can be searched and counted; the text
may change. An event that repeats is told at growing intervals, with how often it was left out.

Saying what happens to a bus without flooding anybody: a line a second at most.
"""

from __future__ import annotations

import json
import logging
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any, Final, Literal, TextIO

# --- Events of a running service, one a line on stderr: for people, or as JSON for machines

LogFormat = Literal["text", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]

FIRST_REPEAT_S: Final = 1.0
"""An event is told again so long after it was told first [s] …"""
LONGEST_REPEAT_S: Final = 60.0
"""… then after twice as long each time, up to this [s]. Quiet for longer, it is new again."""
EVENTS_KEPT: Final = 256
"""Of so many different events it is known when they were told."""

_UNNAMED: Final = "log"
"""The event of a record that has none: what a library logs."""


def emit(
    logger: logging.Logger,
    level: int,
    event: str,
    text: str,
    *,
    always: bool = False,
    **fields: object,
) -> None:
    """Log one event.

    Parameters
    ----------
    logger : logging.Logger
    level : int
        `logging.INFO`, `logging.WARNING`, …
    event : str
        Its stable name, such as "bus.lost".
    text : str
        One line for people.
    always : bool
        Tell it however often it repeats.
    **fields
        Further values, with units in their names. JSON has them as keys.
    """
    logger.log(level, "%s", text, extra={"event": event, "always": always, "fields": fields})


def speaker(logger: logging.Logger, event: str, *, always: bool = False) -> Callable[[str], None]:
    """Return a function that logs lines of text as one event; "warning: …" is a warning.

    Parameters
    ----------
    logger : logging.Logger
    event : str
    always : bool
        Where who speaks keeps a measure of their own.
    """

    def say(text: str) -> None:
        words = text.removeprefix("warning: ")
        level = logging.INFO if words == text else logging.WARNING
        emit(logger, level, event, words, always=always)

    return say


@contextmanager
def logging_to(
    log_format: LogFormat, level: LogLevel = "info", stream: TextIO | None = None
) -> Iterator[None]:
    """Write what is logged to a stream while the block runs, then restore what was before.

    Parameters
    ----------
    log_format : {"text", "json"}
    level : {"debug", "info", "warning", "error"}
        What is less is left out; of other libraries all but errors, unless it is "debug".
    stream : file, optional
        stderr by default.
    """
    handler = _Handler(stream or sys.stderr)
    handler.setFormatter(JsonFormatter() if log_format == "json" else TextFormatter())
    handler.addFilter(RepeatFilter())
    root, own = logging.getLogger(), logging.getLogger("cangauge")
    bus = logging.getLogger("can")
    before = root.handlers[:], root.level, own.level, bus.level
    root.handlers[:] = [handler]
    root.setLevel(logging.DEBUG if level == "debug" else logging.ERROR)
    own.setLevel(_number(level))
    # What python-can logs as an error it raises as well, at each try to open a bus that is away.
    bus.setLevel(logging.NOTSET if level == "debug" else logging.CRITICAL)
    try:
        yield
    finally:
        root.handlers[:] = before[0]
        root.setLevel(before[1])
        own.setLevel(before[2])
        bus.setLevel(before[3])


def _number(level: LogLevel) -> int:
    return logging.getLevelNamesMapping()[level.upper()]


class _Handler(logging.StreamHandler[TextIO]):
    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        """Do nothing: a stderr that is gone must not end the service, and cannot be told of."""


class TextFormatter(logging.Formatter):
    """`2026-10-17T08:30:00.123Z WARNING bus.lost: socketcan can0 is down (retry_s=1.0)`."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        pairs = " ".join(f"{name}={_short(value)}" for name, value in _fields(record).items())
        line = f"{_time(record)} {record.levelname} {_event(record)}: {_message(record)}"
        return " ".join((f"{line} ({pairs})" if pairs else line).splitlines())


class JsonFormatter(logging.Formatter):
    """One JSON object a line: `time`, `level`, `event`, `message`, `logger` and the fields."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        content = {name: _plain(value) for name, value in _fields(record).items()} | {
            "time": _time(record),
            "level": record.levelname.lower(),
            "event": _event(record),
            "message": _message(record),
            "logger": record.name,
        }
        return json.dumps(content, ensure_ascii=False)


class Pace:
    """How often something may be told: at once, then at growing intervals while it goes on.

    Attributes
    ----------
    left_out : int
        How often it was not told since it was told last.
    """

    def __init__(self) -> None:
        self.left_out = 0
        self._asked_s = self._next_s = -math.inf
        self._wait_s = FIRST_REPEAT_S

    def allows(self, now_s: float) -> bool:
        """Return whether it may be told now (monotonic clock [s]); if so, it counts as told."""
        is_new = now_s - self._asked_s > LONGEST_REPEAT_S
        self._asked_s = now_s
        if is_new:
            self._wait_s = FIRST_REPEAT_S
        elif now_s < self._next_s:
            self.left_out += 1
            return False
        else:
            self._wait_s = min(2.0 * self._wait_s, LONGEST_REPEAT_S)
        self._next_s = now_s + self._wait_s
        return True


class RepeatFilter(logging.Filter):
    """Lets an event pass that is new, and one that repeats at growing intervals.

    Parameters
    ----------
    clock : callable
        Monotonic time [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._paces: dict[tuple[str, str], Pace] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether the record is told; one that is carries what was left out before it."""
        event = _event(record)
        key = (record.name, event if event != _UNNAMED else str(record.msg))
        pace = self._paces.pop(key, None) or Pace()
        self._paces[key] = pace
        if len(self._paces) > EVENTS_KEPT:
            del self._paces[next(iter(self._paces))]  # the one not seen for longest
        if not (getattr(record, "always", False) or pace.allows(self._clock())):
            return False
        if pace.left_out:
            record.left_out, pace.left_out = pace.left_out, 0
        return True


def _time(record: logging.LogRecord) -> str:
    stamp = datetime.fromtimestamp(record.created, UTC)
    return stamp.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _event(record: logging.LogRecord) -> str:
    return str(getattr(record, "event", _UNNAMED))


def _message(record: logging.LogRecord) -> str:
    text = record.getMessage()
    return text if record.exc_info is None else f"{text}: {record.exc_info[1]!r}"


def _fields(record: logging.LogRecord) -> dict[str, Any]:
    fields = dict(getattr(record, "fields", {}))
    if hasattr(record, "left_out"):
        fields["repeats_left_out"] = record.left_out
    return fields


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value if isinstance(value, str | int | bool) or value is None else str(value)


# --- Saying what happens to a bus without flooding anybody: a line a second at most

EVERY_S: Final = 1.0


class Voice:
    """Says lines, at most one in `EVERY_S`; of those that come sooner the last is said later.

    Parameters
    ----------
    say : callable
        Takes a line of text.
    clock : callable, optional
        Returns monotonic time [s].
    """

    def __init__(
        self, say: Callable[[str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._say = say
        self._clock = clock
        self._last_s = -math.inf
        self._held: str | None = None
        self._left_out = 0

    def say(self, text: str) -> None:
        """Say a line now, or when it is time (see `look`)."""
        if self._held is not None:
            self._left_out += 1
        self._held = text
        self.look()

    def look(self) -> None:
        """Say what was held back, if it is time."""
        if self._held is None:
            return
        now_s = self._clock()
        if now_s - self._last_s < EVERY_S:
            return
        text = self._held
        if self._left_out:
            text += f" (lines left out: {self._left_out})"
        self._held, self._left_out, self._last_s = None, 0, now_s
        self._say(text)
