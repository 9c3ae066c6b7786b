"""What the loop shows of itself: snapshots, durations, signs of life, changes of the status."""

from __future__ import annotations

import dataclasses
import json
import logging
import time

import pytest
from watched import StandInPort, Watched

from cangauge._logging import RateLimitFilter
from cangauge.estimation.cells import CellReport
from cangauge.service.lifecycle import Notifier
from cangauge.service.status import BOUNDS_S, Histogram, as_json
from cangauge.types import Reason, Status


class CountingNotifier(Notifier):
    def __init__(self, watchdog_s: float | None) -> None:
        super().__init__(None, watchdog_s)
        self.pings = 0

    def ping(self) -> None:
        self.pings += 1


def test_before_the_first_frame() -> None:
    watched = Watched()
    content = as_json(watched.monitor.latest, watched.now_s)
    assert content["status"] == "initialising"
    assert content["sample"] is None
    assert content["health"] is content["power"] is content["cells"] is None
    assert content["estimate"]["soc_pct"] is None
    assert content["latency"]["p99_at_most_s"] is None
    json.dumps(content, allow_nan=False)


def test_a_snapshot_has_estimate_frames_and_bus() -> None:
    watched = Watched()
    watched.drive(90.0)
    watched.turn()
    snapshot = watched.monitor.latest
    assert snapshot.samples == 900
    assert snapshot.estimate.status is Status.VALID
    assert snapshot.estimate.soc_pct == watched.pipeline.latest.soc_pct
    assert snapshot.frames == snapshot.wanted == watched.pipeline.counts.frames > 1800
    assert snapshot.rejected == 0
    assert snapshot.bus == {"garbled": 1, "error_frames": 2, "unsent": 3, "queue_drops": 4}
    assert snapshot.step.count == 900
    assert snapshot.age_s(watched.now_s + 2.0) == pytest.approx(3.0)
    content = as_json(snapshot, watched.now_s)
    assert content["frames"]["used"] == snapshot.frames
    json.dumps(content, allow_nan=False)


def test_a_snapshot_never_changes() -> None:
    watched = Watched()
    watched.drive(10.0)
    watched.turn()
    snapshot = watched.monitor.latest
    before = as_json(snapshot, 0.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        snapshot.samples = 3  # type: ignore[misc] # that is the point
    watched.drive(10.0)
    watched.turn()
    assert watched.monitor.latest is not snapshot
    assert as_json(snapshot, 0.0) == before


def test_health_and_power_are_renewed_every_second() -> None:
    watched = Watched()
    watched.drive(90.0)
    watched.turn()
    first = watched.monitor.latest.report
    assert first is not None
    assert first.health == watched.pipeline.estimator.health
    watched.turn(0.5)
    assert watched.monitor.latest.report is first
    watched.drive(10.0)
    watched.turn(1.0)
    assert watched.monitor.latest.report == watched.pipeline.report()


def test_a_wrong_sum_of_cells_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    watched = Watched()
    watched.drive(5.0)
    cells = CellReport(96, 3, 50.0, 1.0, 2.0, -2.5, 0.1, is_sum_wrong=True)
    report = watched.pipeline.report()._replace(cells=cells)
    watched.pipeline.report = lambda: report  # type: ignore[method-assign] # a sensor that is wrong
    with caplog.at_level(logging.WARNING, logger="cangauge"):
        for _ in range(4):
            watched.turn(1.0)
    found = [each for each in caplog.records if "-2.50 V" in each.getMessage()]
    assert len(found) == 1
    content = as_json(watched.monitor.latest, watched.now_s)
    assert "-2.50 V" in content["notices"][0]
    assert content["cells"]["weakest"] == 3
    json.dumps(content, allow_nan=False)


def test_refused_frames_are_counted_by_reason() -> None:
    watched = Watched()
    watched.drive(5.0)
    for counters in watched.pipeline.decoder.statistics.messages.values():
        counters.crc_errors += 2
        counters.not_available += 1
    watched.turn()
    snapshot = watched.monitor.latest
    messages = len(watched.pipeline.decoder.statistics.messages)
    assert snapshot.rejects["crc_errors"] == 2 * messages
    assert snapshot.rejects["not_available"] == messages
    # A value that is not available refuses no frame.
    assert snapshot.rejected == 2 * messages


def test_a_stuck_loop_makes_the_soc_invalid() -> None:
    watched = Watched()
    watched.drive(90.0)
    watched.turn()
    snapshot = watched.monitor.latest
    assert snapshot.estimate_at(watched.now_s + 1.9).status is Status.VALID
    old = snapshot.estimate_at(watched.now_s + 2.1)
    assert old.status is Status.INVALID
    assert old.reasons & Reason.INPUT_STALE
    assert as_json(snapshot, watched.now_s + 2.1)["loop_stuck"] is True


def test_a_stale_estimate_is_shown_as_invalid() -> None:
    watched = Watched()
    watched.drive(90.0)
    watched.pipeline.heartbeat(is_stale=True)
    watched.turn()
    assert watched.monitor.latest.estimate.status is Status.INVALID


def test_latency_is_that_of_the_latest_sample_once_it_is_sent() -> None:
    watched = Watched()
    watched.monitor.sent()  # no sample yet
    watched.monitor.stepped(time.time() - 0.5, 1e-6, watched.now_s)
    watched.monitor.stepped(time.time() - 0.0015, 1e-6, watched.now_s)
    watched.monitor.sent()
    watched.monitor.sent()  # told already
    watched.monitor.stepped(time.time() + 5.0, 1e-6, watched.now_s)  # the clock was set
    watched.monitor.sent()
    watched.monitor.stepped(12.0, 1e-6, watched.now_s)  # stamps of another clock
    watched.monitor.sent()
    watched.turn()
    latency = watched.monitor.latest.latency
    assert latency.count == 1
    assert 0.0015 <= latency.total_s < 0.4


def test_watchdog_pings_come_with_turns_only() -> None:
    notifier = CountingNotifier(2.0)
    watched = Watched(notifier=notifier)
    for _ in range(100):
        watched.turn(0.1)
    assert 19 <= notifier.pings <= 50
    before = notifier.pings
    watched.now_s += 60.0
    assert notifier.pings == before


def test_status_changes_are_logged_and_the_last_always(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "cangauge")
    watched = Watched()
    written: list[logging.LogRecord] = []
    limiter = RateLimitFilter(written.append, lambda: watched.now_s)

    def turn(later_s: float) -> None:
        caplog.clear()
        watched.turn(later_s)
        written.extend(filter(limiter.filter, caplog.records))
        limiter.release_due()

    turn(1.0)
    watched.drive(90.0)
    for number in range(200):
        watched.pipeline.heartbeat(is_stale=number % 2 == 0)
        turn(0.3)
    watched.pipeline.heartbeat(is_stale=True)
    for _ in range(400):
        turn(0.3)
    limiter.close()
    told = [each for each in written if getattr(each, "event", "") == "status.changed"]
    assert 4 <= len(told) < 15  # 200 changes in a minute
    assert told[-1].fields["status"] == "invalid"  # type: ignore[attr-defined] # extra of `emit`
    assert told[-1].levelno == logging.WARNING


def test_a_bus_that_is_off_is_shown() -> None:
    watched = Watched(port=StandInPort(is_off=True, queue_drops=None))
    assert not watched.monitor.latest.bus_up
    assert "queue_drops" not in watched.monitor.latest.bus


def test_a_histogram_counts_every_value_once() -> None:
    histogram = Histogram()
    values = [*BOUNDS_S, 1e-7, 3e-5, 7.0]
    for value in values:
        histogram.add(value)
    copy = histogram.copy()
    histogram.add(1.0)
    assert copy.count == len(values)
    assert copy.total_s == pytest.approx(sum(values))
    assert copy.counts[0] == 2  # the bound itself belongs to its bucket
    assert copy.counts[-1] == 1
    assert copy.at_most_s(0.5) == 1e-3  # the tenth of twenty
    assert copy.at_most_s(1.0) == float("inf")
    assert Histogram().copy().at_most_s(0.5) is None


def test_watching_costs_little() -> None:
    watched = Watched()
    watched.drive(5.0)
    began = time.perf_counter()
    for _ in range(2000):
        watched.monitor.stepped(time.time(), 30e-6, watched.now_s)
        watched.monitor.sent()
        watched.monitor.turn(watched.now_s)
    # About 2 µs each where the machine is not busy; a copy of everything each time would be 50.
    assert (time.perf_counter() - began) / 2000 < 40e-6
