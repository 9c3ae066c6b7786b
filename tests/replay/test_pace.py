"""Pacing of moments of log time."""

from __future__ import annotations

import time

import pytest

from cangauge.replay.player import Pacer
from live import never


@pytest.mark.parametrize(("speed", "log_s"), [(1.0, 1.0), (10.0, 5.0)])
def test_the_total_time_is_log_time_over_speed(speed: float, log_s: float) -> None:
    pacer = Pacer(speed, never)
    began = time.monotonic()
    for step in range(int(log_s * 1000) + 1):  # a moment every log millisecond
        pacer.wait(7_000_000 + 1000 * step)
    assert time.monotonic() - began == pytest.approx(log_s / speed, abs=0.02)


def test_a_late_moment_does_not_delay_the_rest() -> None:
    pacer = Pacer(1.0, never)
    began = time.monotonic()
    pacer.wait(0)
    time.sleep(0.3)  # the machine is busy
    pacer.wait(100_000)
    assert time.monotonic() - began == pytest.approx(0.3, abs=0.02)
    pacer.wait(500_000)
    assert time.monotonic() - began == pytest.approx(0.5, abs=0.02)


def test_a_long_wait_can_be_stopped() -> None:
    ends = time.monotonic() + 0.3
    pacer = Pacer(1.0, lambda: time.monotonic() > ends)
    pacer.wait(0)
    began = time.monotonic()
    pacer.wait(3_600_000_000)
    assert time.monotonic() - began < 0.7
