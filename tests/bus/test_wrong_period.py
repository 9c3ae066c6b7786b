"""A stated period that is much too long is not used, and is reported."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.plausibility import SignalChecks, SignalHealth
from cangauge.bus.vehicle import Vehicle
from live import frames_of, short_log


@pytest.mark.parametrize(("stated_s", "timeout_s"), [(0.1, 1.0), (0.4, 2.0), (100.0, 1.0)])
def test_the_time_out_is_of_the_frames(stated_s: float, timeout_s: float) -> None:
    health = SignalHealth(SignalChecks(), stated_s)
    for number in range(30):
        health.update(20.0, 0.1 * number)
    assert health.timeout_s == pytest.approx(timeout_s)
    assert health.is_faster_than_stated is (stated_s > 10.0)
    assert math.isnan(SignalHealth(SignalChecks()).period_s)


def test_a_burst_does_not_contradict_a_right_period() -> None:
    """As of an adapter that hands on what it has collected, six frames of 0.1 s every 0.6 s."""
    health = SignalHealth(SignalChecks(), 0.1)
    for number in range(120):
        health.update(20.0, 0.6 * (number // 6) + 3e-4 * (number % 6))
        assert not health.is_faster_than_stated
    assert health.timeout_s == pytest.approx(1.0)


def test_the_message_is_named() -> None:
    vehicle = Vehicle.load("generic")
    for stated_s, named in [(100.0, ["PACK_CURRENT"]), (0.1, [])]:
        messages = dict(vehicle.messages)
        messages[0x400] = messages[0x400]._replace(period_s=stated_s)
        decoder = SampleDecoder(replace(vehicle, messages=messages))
        for frame in frames_of(short_log(3.0)):
            decoder.handle(frame)
        assert list(decoder.wrong_periods) == named
        assert all("each 0.1 s" in text for text in decoder.wrong_periods.values())
