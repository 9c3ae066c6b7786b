"""The rows of the live page stay bounded; what is wrong is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from statuses import Clock, driven, status

from cangauge import read_log
from cangauge.extras.live.history import COLUMNS, LOG_NAME, History, Span


def row(time_s: float) -> np.ndarray:
    return np.array([1e3 * time_s, *range(1, len(COLUMNS))], dtype=float)


def test_a_window_keeps_the_latest_rows() -> None:
    span = Span(0.1, 50)
    for tenth in range(200):
        span.add(row(0.1 * tenth))
    assert span.columns()["time_ms"] == pytest.approx(np.arange(150, 200) * 100.0)
    assert len(span.rows(after=195)) == 5
    assert len(span.rows(after=200)) == 0
    assert span.generation == 0


def test_everything_stays_in_bounds_by_thinning() -> None:
    span = Span(1.0, 100, thins=True)
    for second in range(10_000):
        span.add(row(float(second)))
    times_s = 1e-3 * np.array(span.columns()["time_ms"])
    assert 50 <= times_s.size <= 100
    assert times_s[0] == 0.0
    assert times_s[-1] > 9_700.0
    assert np.ptp(np.diff(times_s)) == 0.0
    assert span.generation == 7


def test_a_slower_span_takes_its_share_of_rows() -> None:
    history = driven(30.0, Clock())
    assert history.spans["10min"].added == 300
    assert history.spans["1h"].added in {30, 31}


def test_a_clock_set_back_does_not_stop_the_rows() -> None:
    clock = Clock()
    history = driven(5.0, clock)
    before = history.spans["1h"].added
    clock.now_s -= 3600.0
    history.add(status(5.0))
    assert history.spans["1h"].added == before + 1


def test_rates_are_those_of_the_last_second() -> None:
    history = driven(5.0, Clock())
    assert history.latest()["frames_per_s"] == pytest.approx(20.0, rel=0.1)
    assert history.latest()["latency_ms"] == pytest.approx(2.0)
    assert history.latest()["residual_mv"] == pytest.approx(100.0)
    assert np.isnan(history.latest()["soc_newton_pct"])


@pytest.mark.parametrize(
    ("rate_hz", "age_s", "is_said"),
    [(10.0, 0.9, True), (1.0, 0.99, False), (1.0, 3.5, True)],
    ids=["within a second", "a slow bus is not silent", "it can become silent"],
)
def test_a_silent_bus_is_said(rate_hz: float, age_s: float, is_said: bool) -> None:
    history = driven(4.0, Clock(), samples_per_s=rate_hz)
    samples = history.status["samples"]  # type: ignore[index] # there is one
    history.add(status(4.0 + age_s, age_s=age_s, samples=samples, samples_per_s=rate_hz))
    said = [f"The bus is silent: no sample for {age_s:.1f} s."]
    assert history.troubles() == (said if is_said else [])


def test_samples_that_waited_are_no_silence() -> None:
    assert driven(4.0, Clock(), age_s=6.0).troubles() == []


def test_a_service_that_stops_is_said_within_a_second() -> None:
    clock = Clock()
    history = driven(2.0, clock)
    clock.now_s += 0.9
    assert history.troubles() == ["The service has not reported for 0.9 s. The values are old."]
    assert History(clock).troubles() == ["Waiting for the service."]


def test_the_last_hour_is_a_log_that_begins_after_a_jump_back(tmp_path: Path) -> None:
    clock = Clock()
    history = driven(5.0, clock)
    for time_s, sample in (
        (100.0, {}),
        (100.0, {}),
        (100.5, {}),
        (100.7, {"sample": None}),
        (101.0, {}),
    ):
        clock.now_s += 0.1
        history.add(status(time_s, **sample))
    path = tmp_path / LOG_NAME
    path.write_text(history.last_hour())
    assert "\n100.7" not in path.read_text()  # without a current
    log = read_log(path)
    assert log.time_s.tolist() == [*(0.1 * np.arange(50)).round(6), 100.0, 100.5, 101.0]
    assert set(log.current_a) == {12.5}
    clock.now_s += 0.1
    history.add(status(50.0))
    assert history.last_hour().splitlines()[1:] == ["50.000000,12.5,380.1,20"]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"loop_stuck": True}, "hangs"),
        ({"bus_up": False, "bus_trouble": "Network is down"}, "lost: Network is down"),
        ({"sample": None}, "no sample yet"),
        ({"config": {"problem": "model: no such file"}}, "refused: model"),
        ({"notices": ["cells differ"]}, "cells differ"),
    ],
)
def test_other_troubles_are_said(changed: dict[str, object], said: str) -> None:
    history = History(Clock())
    history.add(status(**changed))
    assert said in " ".join(history.troubles())
