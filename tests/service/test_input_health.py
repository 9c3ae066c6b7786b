"""Faulty frames through the whole pipeline: samples, estimates and published status."""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import can
import pytest
from simulated import estimate_in

from cangauge.bus.protection import RULES
from cangauge.bus.publish import SocReader
from cangauge.bus.vehicle import Vehicle, VehicleSignal
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.types import Estimate, Reason, Sample, Status
from live import frames_of, leaf_model, short_log
from selection import nightly_except

START = EstimatorSettings(initial_soc_pct=80.0)
BEGINS_S, ENDS_S = 40.0, 44.0
"""Start and end of the fault [s]."""
VEHICLE = Vehicle.load("generic")
CURRENT, VOLTAGE, TEMPERATURE = 0x400, 0x401, 0x402
SIGNALS: dict[int, VehicleSignal] = {signal.key: signal for signal in VEHICLE.signals}
Fault = Callable[[can.Message], None]


@cache
def recorded(seconds: float = 60.0) -> list[can.Message]:
    """Return the frames of a drive, temperature with every sample as from a cyclic sender."""
    frames: list[can.Message] = []
    for sample in samples_of(short_log(seconds)):
        frames += FrameEncoder(VEHICLE).encode(sample)  # a new encoder: slow signals are always due
    made = Counter[int]()
    for frame in frames:
        frame.data = bytearray(RULES["generic"].protect(frame.data, made[frame.arbitration_id]))
        made[frame.arbitration_id] += 1
    return frames


FRAMES = recorded()


def with_value(value: float) -> Fault:
    """Return a fault that puts a value into a frame and keeps its protection valid."""

    def fault(frame: can.Message) -> None:
        counter = RULES["generic"].counter(frame.data)
        SIGNALS[frame.arbitration_id].codec.encode_into(frame.data, value)
        frame.data = bytearray(RULES["generic"].protect(frame.data, counter))

    return fault


def flip(frame: can.Message) -> None:
    frame.data[0] ^= 0x40


def repeat_counter(frame: can.Message) -> None:
    frame.data = bytearray(RULES["generic"].protect(frame.data, 7))


def cut(frame: can.Message) -> None:
    frame.data = frame.data[:-1]


@dataclass
class Result:
    """Samples, estimates, and the heartbeat after the frames of each stamp."""

    samples: list[Sample]
    estimates: list[Estimate]
    published: dict[float, SimpleNamespace]
    pipeline: Pipeline

    def published_at(self, time_s: float) -> SimpleNamespace:
        return self.published[min(self.published, key=lambda each: abs(each - time_s))]


def run(frames: list[can.Message], settings: EstimatorSettings = START) -> Result:
    pipeline, reader = Pipeline(VEHICLE, leaf_model(), PipelineSettings(settings)), SocReader()
    result = Result([], [], {}, pipeline)
    stamps = [frame.timestamp for frame in frames]
    for frame, next_s in zip(copy.deepcopy(frames), [*stamps[1:], None], strict=True):
        before = pipeline.samples
        pipeline.handle(frame)
        if pipeline.samples != before:
            assert pipeline.latest_sample is not None
            result.samples.append(pipeline.latest_sample)
            result.estimates.append(pipeline.latest)
        if frame.timestamp == next_s:
            continue
        published = estimate_in(reader, pipeline.heartbeat()[0])
        assert published is not None
        result.published[frame.timestamp] = published
    return result


def with_fault(
    frame_id: int, fault: Fault, ends_s: float = ENDS_S, *, seconds: float = 60.0
) -> list[can.Message]:
    frames = list(recorded(seconds))
    for number, frame in enumerate(frames):
        if frame.arbitration_id == frame_id and BEGINS_S <= frame.timestamp < ends_s:
            frames[number] = copy.deepcopy(frame)
            fault(frames[number])
    return frames


@pytest.fixture(scope="module")
def undisturbed() -> Result:
    return run(FRAMES)


FAULTS: dict[tuple[int, str], tuple[Fault, Reason]] = {
    (CURRENT, "crc"): (flip, Reason.PROTECTION_FAILED),
    (CURRENT, "counter"): (repeat_counter, Reason.PROTECTION_FAILED),
    (CURRENT, "short"): (cut, Reason.PROTECTION_FAILED),
    (CURRENT, "not available"): (with_value(math.nan), Reason.NONE),
    (CURRENT, "out of range"): (with_value(9000.0), Reason.IMPLAUSIBLE_INPUT),
    (VOLTAGE, "crc"): (flip, Reason.PROTECTION_FAILED),
    (VOLTAGE, "next to nothing"): (with_value(3.0), Reason.IMPLAUSIBLE_INPUT),
    (TEMPERATURE, "not available"): (with_value(math.nan), Reason.NONE),
    (TEMPERATURE, "too fast"): (with_value(60.0), Reason.IMPLAUSIBLE_INPUT),
}
MISSING = {
    CURRENT: Reason.CURRENT_MISSING,
    VOLTAGE: Reason.VOLTAGE_MISSING,
    TEMPERATURE: Reason.TEMPERATURE_MISSING,
}
HEALTH = (
    Reason.CURRENT_MISSING
    | Reason.VOLTAGE_MISSING
    | Reason.TEMPERATURE_MISSING
    | Reason.PROTECTION_FAILED
    | Reason.IMPLAUSIBLE_INPUT
    | Reason.SIGNAL_STUCK
)


@pytest.mark.parametrize(
    ("frame_id", "name"),
    nightly_except(set(FAULTS) - {(CURRENT, "not available"), (VOLTAGE, "crc")}, FAULTS),
)
def test_faulty_values_are_reported_and_never_used(
    undisturbed: Result, frame_id: int, name: str
) -> None:
    fault, why = FAULTS[frame_id, name]
    ends_s = BEGINS_S + 1.5 if name == "too fast" else ENDS_S  # a lasting step is accepted then
    result = run(with_fault(frame_id, fault, ends_s=ends_s))
    # Only values that were sent before, or none.
    sent = {sample.time_s: sample for sample in undisturbed.samples}
    for sample in result.samples:
        for value, good in zip(sample, sent[sample.time_s], strict=True):
            assert value == good or math.isnan(value)
    # Still valid after four failures; missing after five, with the cause.
    missing = MISSING[frame_id]
    before = result.published_at(BEGINS_S + 0.34)
    assert not before.reasons & missing
    during = result.published_at(ends_s - 0.05)
    assert during.reasons & HEALTH == missing | why
    invalid = frame_id == CURRENT
    assert during.status is (Status.INVALID if invalid else Status.DEGRADED)
    assert math.isfinite(during.soc_pct)  # old, but known
    # It takes three good values to recover.
    assert result.published_at(ends_s + 0.1).reasons & missing
    after = result.published_at(ends_s + 0.3)
    assert not after.reasons & HEALTH & ~Reason.CURRENT_GAP
    assert after.status is not Status.INVALID
    assert result.estimates[-1].soc_pct == pytest.approx(undisturbed.estimates[-1].soc_pct, abs=0.1)


def test_one_sample_without_voltage_is_not_degraded() -> None:
    result = run([f for f in recorded(80.0) if f.arbitration_id != VOLTAGE or f.timestamp != 75.0])
    without = [n for n, sample in enumerate(result.samples) if math.isnan(sample.voltage_v)]
    assert len(without) == 1
    around = result.estimates[without[0] - 1 : without[0] + 2]
    assert [each.status for each in around] == [Status.VALID] * 3


@pytest.mark.parametrize(("frame_id", "missing"), list(MISSING.items()))
def test_missing_message_times_out_in_bus_time(frame_id: int, missing: Reason) -> None:
    frames = [f for f in FRAMES if f.arbitration_id != frame_id or f.timestamp < BEGINS_S]
    result = run(frames)
    timeout_s = 10.0 if frame_id == TEMPERATURE else 1.0  # ten periods of a cyclic message
    assert not result.published_at(BEGINS_S + timeout_s - 0.25).reasons & missing
    late = result.published_at(BEGINS_S + timeout_s + 0.15)
    assert late.reasons & HEALTH == missing
    assert late.status is (Status.INVALID if frame_id == CURRENT else Status.DEGRADED)


def test_lost_and_doubled_frames_change_only_the_counts(undisturbed: Result) -> None:
    doubled = run([frame for frame in FRAMES for _ in range(2)])
    assert doubled.pipeline.counts["repeated"] == len(FRAMES)
    assert doubled.estimates == undisturbed.estimates
    lost = run([f for f in FRAMES if not BEGINS_S < f.timestamp < BEGINS_S + 0.45])
    counts = lost.pipeline.counts
    assert [counts[name] for name in ("lost", "repeated", "held_back")] == [12, 0, 0]
    assert len(lost.samples) == len(undisturbed.samples) - 4
    assert not any(published.reasons & HEALTH for published in list(lost.published.values())[10:])


def test_stuck_voltage_is_found_and_charge_still_counted() -> None:
    seen: list[bytes] = []

    def freeze(frame: can.Message) -> None:
        seen.append(bytes(frame.data))
        with_value(SIGNALS[VOLTAGE].codec.decode(seen[0]))(frame)

    result = run(with_fault(VOLTAGE, freeze, ends_s=120.0, seconds=130.0))
    published = result.published_at(119.9)
    assert published.reasons & HEALTH == Reason.VOLTAGE_MISSING | Reason.SIGNAL_STUCK
    assert published.status is Status.DEGRADED
    assert len(result.samples) == 1300
    assert result.pipeline.counts["stuck"] > 100
    assert not result.estimates[-1].reasons & HEALTH


def test_stuck_current_makes_the_estimate_invalid() -> None:
    frames = copy.deepcopy(recorded(130.0))
    for frame in frames:
        if frame.arbitration_id == CURRENT and frame.timestamp >= 60.0:
            with_value(11.0)(frame)
        if frame.arbitration_id == VOLTAGE and frame.timestamp >= 60.0:
            # Voltage swings of a drive with stronger currents than the log's.
            with_value(370.0 + 12.0 * math.sin(frame.timestamp))(frame)
    published = run(frames).published_at(129.0)
    assert published.status is Status.INVALID
    assert published.reasons & HEALTH == Reason.CURRENT_MISSING | Reason.SIGNAL_STUCK
    assert math.isfinite(published.soc_pct)


def test_heartbeats_never_change_the_numbers() -> None:
    """Estimates depend on the frames and their stamps only."""
    frames = with_fault(CURRENT, flip)
    watched = run(frames).estimates
    pipeline = Pipeline(VEHICLE, leaf_model(), PipelineSettings(START))
    alone = [pipeline.latest for frame in copy.deepcopy(frames) if pipeline.handle(frame)]
    assert watched == alone


@pytest.mark.parametrize(
    ("seconds", "rate_hz", "timeout_s", "fresh_s", "stale_s"),
    [
        (60.0, 10.0, math.inf, 0.9, 1.1),  # ten periods of 0.1 s
        (200.0, 0.2, 2.0, 14.9, 15.1),  # not between the samples of a slow source
    ],
)
def test_silence_is_timed_by_the_loops_clock(
    seconds: float, rate_hz: float, timeout_s: float, fresh_s: float, stale_s: float
) -> None:
    pipeline = Pipeline(VEHICLE, leaf_model(), PipelineSettings(START))
    for frame in frames_of(short_log(seconds, rate_hz)):
        pipeline.handle(frame)
    found = []
    for silent_s in (fresh_s, stale_s):
        pipeline.heartbeat(silent_s, timeout_s)
        found.append(pipeline.published)
    assert [bool(each.reasons & Reason.INPUT_STALE) for each in found] == [False, True]
    assert [each.status is Status.INVALID for each in found] == [False, True]
    assert found[1].soc_pct == found[0].soc_pct


def test_reason_is_given_for_signals_never_accepted() -> None:
    frames = copy.deepcopy(FRAMES[:100])
    for frame in frames:
        flip(frame)
    result = run(frames)
    published = result.published_at(frames[-1].timestamp)
    assert published.status is Status.INITIALISING
    assert math.isnan(published.soc_pct)
    assert math.isnan(published.age_s)
    assert published.reasons & Reason.PROTECTION_FAILED
    assert published.reasons & Reason.NO_INITIAL_SOC
