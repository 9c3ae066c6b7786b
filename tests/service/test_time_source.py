"""Bus time: whole microseconds, the replay clock, clocks that are set."""

from __future__ import annotations

import math

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge._resources import shared_file
from cangauge.bus.database import load_dbc
from cangauge.bus.time_source import (
    COUNT_EVERY,
    ReceiveTime,
    ReplayClock,
    clock_frame,
    count_frame,
    is_clock,
    time_source,
)
from cangauge.bus.vehicle import Vehicle
from cangauge.service.pipeline import Pipeline, PipelineSettings
from live import leaf_model

DBC = load_dbc(shared_file("dbc", "soc_estimate.dbc"))


def frame(time_s: float = 0.0, frame_id: int = 0x401) -> can.Message:
    return can.Message(timestamp=time_s, arbitration_id=frame_id, is_extended_id=False, data=b"12")


@given(st.integers(0, 2_000_000_000_000_000))
def test_a_stamp_of_whole_microseconds_stays_what_it_is(time_us: int) -> None:
    assert ReceiveTime().time_of(frame(time_us / 1e6)) == time_us / 1e6
    # What a candump file holds reads back as the same number.
    assert float(f"{time_us / 1e6:f}") == time_us / 1e6


@pytest.mark.parametrize(
    ("stamps", "times"),
    [
        ([1.23456789], [1.234568]),
        ([5000.0, 1400.0, 1400.5, 1401.0], [5000.0, 5000.0, 5000.5, 5001.0]),  # set back
        ([10.0, 9.9, 10.1], [10.0, 9.9, 10.1]),  # a little out of order
        *(
            ([no_time, 5.0, no_time], [0.0, 5.0, 5.0])
            for no_time in (math.nan, math.inf, -math.inf, 1e300)
        ),
    ],
)
def test_receive_stamps_as_bus_time(stamps: list[float], times: list[float]) -> None:
    source = ReceiveTime()
    assert [source.time_of(frame(stamp_s)) for stamp_s in stamps] == times


@given(st.integers(-(1 << 52), 1 << 52))
def test_the_replay_clock_carries_any_time_exactly(time_us: int) -> None:
    clock = ReplayClock()
    message = clock_frame(time_us)
    assert clock.time_of(message) is None
    assert clock.time_of(frame()) == time_us / 1e6
    assert DBC.decode_message("REPLAY_CLOCK", message.data)["log_time_us"] == time_us


def test_a_damaged_clock_frame_is_refused() -> None:
    clock = ReplayClock()
    assert clock.time_of(frame(3.0)) is None  # before the first clock
    clock.time_of(clock_frame(1_000_000))
    broken = clock_frame(9_000_000)
    broken.data[0] ^= 1
    clock.time_of(broken)
    assert (clock.time_of(frame()), clock.refused) == (1.0, 1)


def test_the_replay_clock_jumping_back_is_a_new_log() -> None:
    clock = ReplayClock()
    for time_us in (0, 100_000_000, 99_500_000):
        clock.time_of(clock_frame(time_us))
    assert clock.beginnings == 0
    clock.time_of(clock_frame(0))
    assert clock.beginnings == 1


def test_an_extended_frame_with_the_clocks_number_is_no_clock() -> None:
    clock = time_source("replay-clock", 0x123)
    message = clock_frame(5, 0x123)
    message.is_extended_id = True
    clock.time_of(message)
    assert clock.time_of(frame()) is None
    assert clock.time_of(clock_frame(7, 0x123)) is None
    assert clock.time_of(frame()) == pytest.approx(7e-6)


def replayed(times: int) -> list[can.Message]:
    """Return the frames of a replay's clock: a count at the start, after each 64, and the end."""
    frames = []
    for sent in range(times):
        frames += [count_frame(sent)] if sent % COUNT_EVERY == 0 else []
        frames.append(clock_frame(100_000 * sent))
    last = count_frame(times)
    assert DBC.decode_message("REPLAY_COUNT", last.data)["clocks_sent"] == times
    return [*frames, last]


@pytest.mark.parametrize("lost", [0, 1, 16, 160, 480])
def test_lost_log_times_are_counted_also_in_whole_turns_of_counters(lost: int) -> None:
    source, frames = ReplayClock(), replayed(500)
    for frame in [*frames[:5], *frames[5 + lost :]]:
        source.time_of(frame)
    kept = sum(is_clock(frame) for frame in [*frames[:5], *frames[5 + lost :]])
    assert source.lost == 500 - kept
    for frame in replayed(100):  # another replay begins
        source.time_of(frame)
    assert source.lost == 500 - kept


def test_the_service_counts_what_a_replay_lost() -> None:
    settings = PipelineSettings(time_source="replay-clock")
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model(), settings)
    for frame in replayed(500)[:1] + replayed(500)[-1:]:
        pipeline.handle(frame)
    assert pipeline.counts["lost"] == 500
    assert pipeline.counts["untimed"] == 0
