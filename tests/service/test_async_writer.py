"""The asynchronous writer: order, limits, failures, end."""

from __future__ import annotations

import threading

from cangauge.service.async_writer import AsyncWriter
from live import waits


def fail() -> None:
    raise OSError(28, "No space left on device")


def test_jobs_run_in_order_and_close_waits_for_them() -> None:
    done: list[int] = []
    writer = AsyncWriter("test")
    for number in range(100):
        assert writer.submit(lambda number=number: done.append(number))  # type: ignore[misc] # bound now
    assert writer.close(30.0) == []
    assert done == list(range(100))


def test_a_failed_job_is_reported_and_dropped() -> None:
    errors: list[Exception] = []
    writer = AsyncWriter("test", on_error=errors.append)
    writer.submit(fail)
    assert writer.flush(30.0)
    assert writer.problem == "No space left on device"
    writer.submit(lambda: None)
    assert writer.close(30.0) == []
    assert (len(errors), writer.problem) == (1, None)


def test_with_retries_a_failed_job_is_repeated_before_the_next() -> None:
    done, recovered = list[str](), list[bool]()
    fails = [True, True]
    writer = AsyncWriter("test", retry_s=0.01, on_recovery=lambda: recovered.append(True))

    def first() -> None:
        if fails:
            fails.pop()
            fail()
        done.append("first")

    writer.submit(first)
    writer.submit(lambda: done.append("second"))
    assert writer.flush(30.0)
    assert (done, recovered) == (["first", "second"], [True])


def test_a_writer_that_is_stuck_rejects_jobs_and_returns_them_at_the_end() -> None:
    free = threading.Event()
    writer = AsyncWriter("test", max_waiting_bytes=10)
    assert writer.submit(lambda: free.wait(60.0) and None, 11)
    assert not writer.submit(fail, 1)
    assert writer.submit(fail)  # no memory of its own
    assert len(writer.close(0.01)) == 2
    free.set()


def test_a_replacing_job_supersedes_waiting_ones() -> None:
    free, done = threading.Event(), list[int]()
    writer = AsyncWriter("test")
    writer.submit(lambda: free.wait(60.0) and None)
    assert waits(lambda: writer._running is not None, 30.0)
    for number in range(5):
        writer.replace(lambda number=number: done.append(number))  # type: ignore[misc] # bound now
    free.set()
    assert writer.close(30.0) == []
    assert done == [4]
