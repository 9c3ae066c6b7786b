"""Events: one a line, with stable names; repetitions are rate-limited."""

from __future__ import annotations

import io
import itertools
import json
import logging
import sys
import threading

import pytest

from cangauge._logging import emit
from cangauge.service.events import LogFormat, RateLimitFilter, logging_to, release_held
from live import waits

LOG = logging.getLogger("cangauge.test")


def record(event: str, text: str = "x") -> logging.LogRecord:
    made = logging.LogRecord("cangauge.bus", logging.WARNING, "", 0, "%s", (text,), None)
    made.event = made.limit = event
    return made


def logged(log_format: LogFormat, level: str = "info") -> io.StringIO:
    stream = io.StringIO()
    with logging_to(log_format, level, stream):  # type: ignore[arg-type] # a level
        emit(LOG, logging.INFO, "bus.lost", "can0 is\ndown", retry_s=0.25, why=float("nan"))
        emit(LOG, logging.DEBUG, "bus.detail", "too much")
        emit(LOG, logging.WARNING, "bus.said", "100 % busy")
        logging.getLogger("can.socketcan").warning("libraries chatter")
        logging.getLogger("asyncio").error("oh %s", "no", exc_info=OSError("gone"))
    return stream


def test_json_is_one_object_a_line_with_fields_and_event() -> None:
    lines = [json.loads(line) for line in logged("json").getvalue().splitlines()]
    assert [line["event"] for line in lines] == ["bus.lost", "bus.said", "log"]
    assert lines[0]["level"] == "info"
    assert lines[0]["message"] == "can0 is\ndown"
    assert lines[0]["retry_s"] == 0.25
    assert lines[0]["why"] is None
    assert lines[0]["time"].endswith("Z")
    assert lines[2]["logger"] == "asyncio"
    assert "gone" in lines[2]["message"]


def test_text_is_one_line_an_event() -> None:
    lines = logged("text").getvalue().splitlines()
    assert len(lines) == 3
    assert lines[0].endswith("INFO bus.lost: can0 is down (retry_s=0.25 why=nan)")
    assert lines[1].endswith("WARNING bus.said: 100 % busy")


def test_levels_and_what_was_before_is_restored() -> None:
    root = logging.getLogger()
    before = root.handlers[:], root.level
    assert len(logged("text", "warning").getvalue().splitlines()) == 2
    assert len(logged("text", "debug").getvalue().splitlines()) == 5
    assert (root.handlers, root.level) == before


def test_a_closed_stream_is_ignored(capsys: pytest.CaptureFixture[str]) -> None:
    stream = io.StringIO()
    with logging_to("text", stream=stream):
        stream.close()
        emit(LOG, logging.INFO, "bus.lost", "nobody hears it")
    assert capsys.readouterr().err == ""


def test_repetitions_are_written_at_growing_intervals() -> None:
    now = [0.0]
    repeats = RateLimitFilter(print, clock=lambda: now[0])
    written = []
    for tenth in range(10_000):
        now[0] = 0.1 * tenth
        each = record("bus.lost")
        if repeats.filter(each):
            written.append((now[0], getattr(each, "suppressed", 0)))
    assert [round(time_s) for time_s, _ in written][:7] == [0, 1, 3, 7, 15, 31, 63]
    assert written[1][1] == 9
    assert sum(left + 1 for _, left in written) <= 10_000
    assert all(later[0] - before[0] <= 60.2 for before, later in itertools.pairwise(written))
    now[0] += 61.0  # quiet for a minute: new again
    assert repeats.filter(record("bus.lost"))


def test_events_are_limited_separately() -> None:
    stream = io.StringIO()
    with logging_to("text", stream=stream):
        for _ in range(3):
            emit(LOG, logging.INFO, "a.b", "x")
            emit(LOG, logging.INFO, "a.c", "x")
        events = [line.split()[2] for line in stream.getvalue().splitlines()]
    assert events == ["a.b:", "a.c:"]


def test_many_different_events_use_bounded_memory() -> None:
    repeats = RateLimitFilter(print, clock=lambda: 0.0)
    for number in range(5_000):
        repeats.filter(record(f"made.up_{number}"))
    assert sys.getsizeof(repeats._events) < 100_000


def test_the_first_of_an_event_is_always_written() -> None:
    limiter = RateLimitFilter(print, clock=lambda: -1e9)
    assert limiter.filter(record("bus.lost"))
    assert not limiter.filter(record("bus.lost"))


def test_the_latest_suppressed_record_follows_its_interval() -> None:
    now, written = [100.0], list[str]()
    limiter = RateLimitFilter(lambda each: written.append(each.getMessage()), lambda: now[0])
    assert limiter.filter(record("bus.lost", "down"))
    for number in range(5):
        now[0] += 0.1
        assert not limiter.filter(record("bus.lost", f"try {number}"))
    now[0] = 100.99
    limiter.release_due()
    assert written == []
    now[0] = 101.0
    limiter.release_due()
    limiter.release_due()
    assert written == ["try 4"]


def test_suppressed_records_are_written_when_due_and_at_the_end() -> None:
    stream, before = io.StringIO(), threading.active_count()
    with logging_to("text", stream=stream):
        for number in range(3):
            emit(LOG, logging.INFO, "bus.lost", f"try {number}")
        threads = threading.active_count()

        def is_released() -> bool:
            release_held()
            return len(stream.getvalue().splitlines()) == 2

        assert waits(is_released)
        assert threading.active_count() == threads == before
        emit(LOG, logging.INFO, "bus.lost", "last")
    lines = stream.getvalue().splitlines()
    assert [line.split("lost: ")[1] for line in lines] == [
        "try 0", "try 2 (repeats_suppressed=1)", "last"
    ]  # fmt: skip


def test_events_of_one_limit_supersede_each_other() -> None:
    stream = io.StringIO()
    with logging_to("text", stream=stream):
        for number in range(3):
            emit(LOG, logging.WARNING, "bus.lost", f"lost {number}", limit="bus.state")
            emit(LOG, logging.INFO, "bus.back", f"back {number}", limit="bus.state")
    lines = stream.getvalue().splitlines()
    assert lines[0].endswith("WARNING bus.lost: lost 0")
    assert lines[1].endswith("INFO bus.back: back 2 (repeats_suppressed=4)")
    assert len(lines) == 2
