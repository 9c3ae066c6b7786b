"""Events: one a line, with stable names; repeats at growing intervals."""

from __future__ import annotations

import io
import itertools
import json
import logging
import sys

import pytest

from cangauge._logging import LogFormat, Pace, RepeatFilter, emit, logging_to, speaker

LOG = logging.getLogger("cangauge.test")


def logged(log_format: LogFormat, level: str = "info") -> io.StringIO:
    stream = io.StringIO()
    with logging_to(log_format, level, stream):  # type: ignore[arg-type] # a level
        emit(LOG, logging.INFO, "bus.lost", "can0 is\ndown", retry_s=0.25, why=float("nan"))
        emit(LOG, logging.DEBUG, "bus.detail", "too much")
        emit(LOG, logging.WARNING, "bus.said", "100 % busy")
        logging.getLogger("can.socketcan").warning("libraries chatter")
        logging.getLogger("tornado").error("oh %s", "no", exc_info=OSError("gone"))
    return stream


def test_json_is_one_object_a_line_with_fields_and_event() -> None:
    lines = [json.loads(line) for line in logged("json").getvalue().splitlines()]
    assert [line["event"] for line in lines] == ["bus.lost", "bus.said", "log"]
    assert lines[0]["level"] == "info"
    assert lines[0]["message"] == "can0 is\ndown"
    assert lines[0]["retry_s"] == 0.25
    assert lines[0]["why"] is None
    assert lines[0]["time"].endswith("Z")
    assert lines[2]["logger"] == "tornado"
    assert "gone" in lines[2]["message"]


def test_text_is_one_line_an_event() -> None:
    lines = logged("text").getvalue().splitlines()
    assert len(lines) == 3
    assert lines[0].endswith("INFO bus.lost: can0 is down (retry_s=0.25 why=nan)")
    assert lines[1].endswith("WARNING bus.said: 100 % busy")


def test_a_speaker_takes_lines_as_they_were() -> None:
    stream = io.StringIO()
    with logging_to("text", stream=stream):
        say = speaker(LOG, "bus.told", always=True)
        say("warning: can0 is down")
        say("can0: back")
    lines = stream.getvalue().splitlines()
    assert lines[0].endswith("WARNING bus.told: can0 is down")
    assert lines[1].endswith("INFO bus.told: can0: back")


def test_levels_and_what_was_before_is_restored() -> None:
    root = logging.getLogger()
    before = root.handlers[:], root.level
    assert len(logged("text", "warning").getvalue().splitlines()) == 2
    assert len(logged("text", "debug").getvalue().splitlines()) == 5
    assert (root.handlers, root.level) == before


def test_a_stream_that_is_gone_ends_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    stream = io.StringIO()
    with logging_to("text", stream=stream):
        stream.close()
        emit(LOG, logging.INFO, "bus.lost", "nobody hears it")
    assert capsys.readouterr().err == ""


def test_repeats_are_told_at_growing_intervals_with_what_was_left_out() -> None:
    now = [0.0]
    repeats = RepeatFilter(lambda: now[0])
    told = []
    for tenth in range(10_000):
        now[0] = 0.1 * tenth
        record = logging.LogRecord("cangauge.bus", 30, "", 0, "%s", ("x",), None)
        record.event = "bus.lost"
        if repeats.filter(record):
            told.append((now[0], getattr(record, "left_out", 0)))
    assert [round(time_s) for time_s, _ in told][:7] == [0, 1, 3, 7, 15, 31, 63]
    assert told[1][1] == 9
    assert sum(left + 1 for _, left in told) <= 10_000
    assert all(later[0] - before[0] <= 60.2 for before, later in itertools.pairwise(told))
    now[0] += 61.0  # quiet for a minute: new again
    record = logging.LogRecord("cangauge.bus", 30, "", 0, "%s", ("x",), None)
    record.event = "bus.lost"
    assert repeats.filter(record)


def test_other_events_and_those_told_always_pass() -> None:
    stream = io.StringIO()
    with logging_to("text", stream=stream):
        for _ in range(3):
            emit(LOG, logging.INFO, "a.b", "x")
            emit(LOG, logging.INFO, "a.c", "x")
            emit(LOG, logging.INFO, "a.d", "x", always=True)
    events = [line.split()[2] for line in stream.getvalue().splitlines()]
    assert events == ["a.b:", "a.c:", "a.d:", "a.d:", "a.d:"]


def test_many_different_events_take_no_memory() -> None:
    repeats = RepeatFilter(lambda: 0.0)
    for number in range(5_000):
        record = logging.LogRecord("cangauge.bus", 30, "", 0, "%s", ("x",), None)
        record.event = f"made.up_{number}"
        repeats.filter(record)
    assert sys.getsizeof(repeats._paces) < 100_000


def test_a_pace_begins_at_once() -> None:
    pace = Pace()
    assert pace.allows(-1e9)
    assert not pace.allows(-1e9 + 0.5)
    assert pace.left_out == 1
