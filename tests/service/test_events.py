"""Events: one a line, with stable names; repetitions are rate-limited."""

from __future__ import annotations

import io
import json
import logging
import threading
from itertools import pairwise

import pytest

from cangauge._logging import emit
from cangauge.service.events import (
    FIRST_INTERVAL_S,
    LogFormat,
    RateLimitedHandler,
    logging_to,
    release_held,
)
from live import waits

LOG = logging.getLogger("cangauge.test")


def logged(log_format: LogFormat, level: str = "info") -> list[str]:
    stream = io.StringIO()
    with logging_to(log_format, level, stream):  # type: ignore[arg-type] # a level
        emit(LOG.info, "bus.lost", "can0 is\ndown", retry_s=0.25, why=float("nan"))
        emit(LOG.debug, "bus.detail", "too much")
        emit(LOG.warning, "bus.said", "100 % busy")
        logging.getLogger("can.socketcan").warning("libraries chatter")
        logging.getLogger("asyncio").error("oh %s", "no", exc_info=OSError("gone"))
    return stream.getvalue().splitlines()


def test_json_is_one_object_a_line_with_fields_and_event() -> None:
    lines = [json.loads(line) for line in logged("json")]
    assert [line["event"] for line in lines] == ["bus.lost", "bus.said", "log"]
    assert lines[0].pop("time").endswith("Z")
    assert lines[0] == {
        "level": "info", "event": "bus.lost", "message": "can0 is\ndown",
        "logger": "cangauge.test", "retry_s": 0.25, "why": None,
    }  # fmt: skip
    assert lines[2]["logger"] == "asyncio"
    assert "gone" in lines[2]["message"]


def test_text_is_one_line_an_event_and_what_was_before_is_restored() -> None:
    root = logging.getLogger()
    before = root.handlers[:], root.level
    lines = logged("text")
    assert len(lines) == 3
    assert lines[0].endswith("INFO bus.lost: can0 is down (retry_s=0.25 why=nan)")
    assert lines[1].endswith("WARNING bus.said: 100 % busy")
    assert len(logged("text", "warning")) == 2
    assert len(logged("text", "debug")) == 5
    assert (root.handlers, root.level) == before


def test_a_closed_stream_is_ignored(capsys: pytest.CaptureFixture[str]) -> None:
    stream = io.StringIO()
    with logging_to("text", stream=stream):
        stream.close()
        emit(LOG.info, "bus.lost", "nobody hears it")
    assert capsys.readouterr().err == ""


class Limited(RateLimitedHandler):
    """A handler on a clock that keeps what it writes."""

    def __init__(self, now_s: float = 0.0) -> None:
        super().__init__(clock=lambda: self.now_s)
        self.now_s, self.written = now_s, list[tuple[float, str, int]]()

    def emit(self, record: logging.LogRecord) -> None:
        suppressed = getattr(record, "suppressed", 0)
        self.written.append((self.now_s, record.getMessage(), suppressed))

    def passes(self, event: str = "bus.lost", text: str = "x") -> bool:
        made = logging.LogRecord("cangauge.bus", logging.WARNING, "", 0, "%s", (text,), None)
        made.event = made.limit = event
        return self.handle(made)


def test_repetitions_are_written_at_growing_intervals() -> None:
    limited = Limited()
    for tenth in range(10_000):
        limited.now_s = 0.1 * tenth
        limited.passes()
    times = [time_s for time_s, _, _ in limited.written]
    assert [round(time_s) for time_s in times][:7] == [0, 1, 3, 7, 15, 31, 63]
    assert limited.written[1][2] == 9
    assert sum(left + 1 for _, _, left in limited.written) <= 10_000
    assert all(later - before <= 60.2 for before, later in pairwise(times))
    limited.now_s += 61.0  # quiet for a minute: new again
    assert limited.passes()
    limited.now_s += FIRST_INTERVAL_S
    assert limited.passes()


def test_the_first_is_written_unless_filtered_in_bounded_memory() -> None:
    limited = Limited(-1e9)
    limited.addFilter(lambda record: "secret" not in record.getMessage())
    assert not limited.passes(text="a secret")
    assert limited.passes(text="x")
    assert not limited.passes()
    assert [text for _, text, _ in limited.written] == ["x"]
    for number in range(5_000):
        assert limited.passes(f"made.up_{number}")
    assert limited.passes()  # the oldest is forgotten


def test_the_latest_suppressed_record_follows_its_interval() -> None:
    limited = Limited(100.0)
    assert limited.passes("bus.lost", "down")
    for number in range(5):
        limited.now_s += 0.1
        assert not limited.passes("bus.lost", f"try {number}")
    limited.now_s = 100.99
    limited.release_due()
    assert len(limited.written) == 1
    limited.now_s = 101.0
    limited.release_due()
    limited.release_due()
    assert limited.written[1:] == [(101.0, "try 4", 4)]


def test_suppressed_records_are_written_when_due() -> None:
    stream, before = io.StringIO(), threading.active_count()
    with logging_to("text", stream=stream):
        for number in range(3):
            emit(LOG.info, "bus.lost", f"try {number}")

        def is_released() -> bool:
            release_held()
            return "try 2 (repeats_suppressed=1)" in stream.getvalue()

        assert waits(is_released)
        assert threading.active_count() == before


def test_events_of_one_limit_supersede_each_other() -> None:
    stream = io.StringIO()
    with logging_to("text", stream=stream):
        for number in range(3):
            emit(LOG.warning, "bus.lost", f"lost {number}", limit="bus.state")
            emit(LOG.info, "bus.back", f"back {number}", limit="bus.state")
            emit(LOG.info, "a.c", f"other {number}")
    lines = [line.partition(" ")[2] for line in stream.getvalue().splitlines()]
    assert lines == [
        "WARNING bus.lost: lost 0",
        "INFO a.c: other 0",
        "INFO bus.back: back 2 (repeats_suppressed=4)",
        "INFO a.c: other 2 (repeats_suppressed=1)",
    ]
