"""Stamps limited by the monotonic clock: whatever the stamps do, bus time keeps its rate."""

from __future__ import annotations

import math
from collections.abc import Callable
from random import Random

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.bus.time_source import TOLERANCE_S, StampLimiter

OFFSET_S = 1.7e9
"""Stamps minus monotonic time of an honest clock [s]."""
STEP_S = 0.01
READING_S = 0.0005
DAY_S = 86400.0

Stamp = Callable[[float, Random], float]
"""(arrival by the honest clock [s], random generator) → stamp [s]."""


def limited(
    stamp: Stamp,
    seconds: float = 30.0,
    *,
    limiter: StampLimiter | None = None,
    hold: Callable[[float], float] = lambda arrival_s: arrival_s,
) -> tuple[list[tuple[float, float]], StampLimiter]:
    """Return (arrival, bus time less the offset) of a frame every 10 ms, read when `hold` ends."""
    limiter = limiter or StampLimiter(TOLERANCE_S["kernel"], OFFSET_S)
    rng, out = Random(1), []  # noqa: S311 - must be repeatable
    waiting: list[tuple[float, can.Message]] = []
    since_s = 100.0
    for number in range(1, round(seconds / STEP_S)):
        arrival_s = 100.0 + number * STEP_S
        waiting.append((arrival_s, can.Message(timestamp=stamp(arrival_s + OFFSET_S, rng))))
        read_s = hold(arrival_s) + READING_S
        if read_s > arrival_s + STEP_S:
            continue
        limiter.limit([message for _, message in waiting], since_s, read_s)
        out += [(arrival, message.timestamp - OFFSET_S) for arrival, message in waiting]
        waiting, since_s = [], read_s
    return out, limiter


def errors(found: list[tuple[float, float]], from_s: float = 0.0) -> list[float]:
    return [abs(bus_s - arrival_s) for arrival_s, bus_s in found if arrival_s >= from_s]


@pytest.mark.parametrize("suspended_s", [0.0, 8.0])
def test_honest_stamps_are_left_as_they_are_also_over_a_pause(suspended_s: float) -> None:
    def hold(arrival_s: float) -> float:  # while suspended the frames wait in the socket
        until_s = 110.0 + suspended_s
        return until_s if 110.0 < arrival_s < until_s else arrival_s

    found, limiter = limited(lambda true_s, _: true_s, hold=hold)
    assert len(found) == 2999
    assert max(errors(found)) < 1e-6
    assert limiter.shift_s == 0.0


BROKEN: dict[str, Stamp] = {
    "stand still": lambda true_s, _: min(true_s, OFFSET_S + 105.0),
    "stand still from the start": lambda _t, _r: OFFSET_S + 100.0,
    "zero": lambda _t, _r: 0.0,
    "run backwards": lambda true_s, _: 2.0 * (OFFSET_S + 105.0) - true_s,
    "back by 1 µs each": lambda true_s, _: OFFSET_S + 105.0 - 1e-4 * (true_s - OFFSET_S - 105.0),
    "random ± 0.9 s": lambda true_s, rng: true_s + rng.uniform(-0.9, 0.9),
    "10 times faster": lambda true_s, _: OFFSET_S + 10.0 * (true_s - OFFSET_S),
    "NaN": lambda _t, _r: math.nan,
    "infinite": lambda _t, _r: math.inf,
    "negative": lambda true_s, _: -true_s,
    "still, then jumping": lambda true_s, _: OFFSET_S + 3.0 * math.floor((true_s - OFFSET_S) / 3),
    "NaN now and then": lambda true_s, rng: math.nan if rng.random() < 0.3 else true_s,
}


@pytest.mark.parametrize("name", BROKEN)
def test_unusable_stamps_become_the_time_of_receiving(name: str) -> None:
    found, limiter = limited(BROKEN[name])
    assert max(errors(found)) <= TOLERANCE_S["kernel"] + STEP_S + READING_S
    times = [bus_s for _, bus_s in found]
    assert times[-1] - times[0] == pytest.approx(29.98, abs=0.05)
    assert limiter.is_uncertain(100.0 + 30.0)


@pytest.mark.parametrize("by_s", [56.0 * 365 * DAY_S, DAY_S, 3600.0, -0.5, -5.0, -DAY_S])
def test_clock_that_was_set_costs_nothing(by_s: float) -> None:
    found, limiter = limited(
        lambda true_s, _: true_s + (by_s if true_s > OFFSET_S + 110.0 else 0.0)
    )
    assert max(errors(found)) <= STEP_S + READING_S
    assert max(errors(found, from_s=112.0)) < 2e-3
    assert limiter.shift_s == pytest.approx(-by_s, abs=2e-3)
    assert not limiter.is_uncertain(113.0)


def test_adapter_with_its_own_drifting_clock_is_followed() -> None:
    # 200 ppm off and from zero, as an adapter's crystal; 25 minutes at once.
    limiter = StampLimiter(0.25)
    found, _ = limited(
        lambda true_s, _: 1.0002 * (true_s - OFFSET_S - 100.0), 1500.0, limiter=limiter
    )
    first = found[0][1] - found[0][0]
    assert max(abs(bus_s - arrival_s - first) for arrival_s, bus_s in found) < 0.3
    assert not limiter.is_uncertain(1600.0)


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=1, max_size=40))
def test_any_stamps_give_times_that_are_possible(stamps: list[float]) -> None:
    limiter = StampLimiter(TOLERANCE_S["kernel"], OFFSET_S)
    for number, stamp_s in enumerate(stamps):
        message = can.Message(timestamp=stamp_s)
        came_s = limiter.limit([message], 100.0 + number, 101.0 + number)
        bus_s = message.timestamp - OFFSET_S
        assert 99.97 + number <= bus_s <= 101.03 + number
        assert 99.97 + number <= came_s <= 101.0 + number
