"""Faulty frames through the whole pipeline: samples, estimates and published status."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import can
import pytest

from cangauge.bus.protection import GENERIC_RULE
from cangauge.bus.publish import SocEstimate, SocReader
from cangauge.bus.vehicle import Vehicle, VehicleSignal
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.types import Estimate, Reason, Sample, Status
from live import leaf_model, short_log
from selection import nightly_except

START = EstimatorSettings(initial_soc_pct=80.0)
BEGINS_S, ENDS_S = 40.0, 44.0
"""Start and end of the fault [s]."""
VEHICLE = Vehicle.load("generic")
CURRENT, VOLTAGE, TEMPERATURE = 0x400, 0x401, 0x402
SIGNALS: dict[int, VehicleSignal] = {signal.key: signal for signal in VEHICLE.signals}
Fault = Callable[[can.Message], None]


@cache
def recorded(seconds: float = 60.0, vehicle: Vehicle = VEHICLE) -> list[can.Message]:
    """Return the frames of a drive, temperature with every sample as from a cyclic sender."""
    log = short_log(seconds)
    frames = []
    for sample in samples_of(log):
        frames += FrameEncoder(vehicle).encode(sample)  # a new encoder: slow signals are always due
    counters: dict[int, int] = {}
    for frame in frames:
        counter = counters.get(frame.arbitration_id, 0)
        counters[frame.arbitration_id] = counter + 1
        frame.data = bytearray(GENERIC_RULE.protect(frame.data, counter))
    return frames


FRAMES = recorded()


def with_value(value: float) -> Fault:
    """Return a fault that puts a value into a frame and keeps its protection valid."""

    def fault(frame: can.Message) -> None:
        counter = GENERIC_RULE.counter(frame.data)
        SIGNALS[frame.arbitration_id].codec.encode_into(frame.data, value)
        frame.data = bytearray(GENERIC_RULE.protect(frame.data, counter))

    return fault


def flip(frame: can.Message) -> None:
    frame.data[0] ^= 0x40


def repeat_counter(frame: can.Message) -> None:
    frame.data = bytearray(GENERIC_RULE.protect(frame.data, 7))


def cut(frame: can.Message) -> None:
    frame.data = frame.data[:-1]


@dataclass
class Result:
    """Samples, estimates, and the heartbeat after the frames of each stamp."""

    samples: list[Sample]
    estimates: list[Estimate]
    published: dict[float, SocEstimate]
    pipeline: Pipeline

    def published_at(self, time_s: float) -> SocEstimate:
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
        published = reader.read(pipeline.heartbeat()[0])
        assert isinstance(published, SocEstimate)
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


def test_drive_without_faults_raises_no_reason(undisturbed: Result) -> None:
    assert len(undisturbed.samples) == 600
    after = [each.reasons for each in undisturbed.estimates]
    assert not any(reasons & HEALTH for reasons in after)
    counts = undisturbed.pipeline.counts
    assert (counts.implausible, counts.stuck, counts.held_back, counts.repeated) == (0, 0, 0, 0)


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


def test_a_few_bad_frames_raise_no_reason() -> None:
    result = run(with_fault(CURRENT, flip, ends_s=BEGINS_S + 0.34))
    assert result.pipeline.counts.crc_errors == 4
    assert not any(published.reasons & HEALTH for published in list(result.published.values())[10:])


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


def test_alive_counter_jump_counts_as_loss_only(undisturbed: Result) -> None:
    frames = [f for f in FRAMES if not BEGINS_S < f.timestamp < BEGINS_S + 0.45]
    result = run(frames)
    assert result.pipeline.counts.lost == 12
    assert result.pipeline.counts.repeated == result.pipeline.counts.held_back == 0
    assert len(result.samples) == len(undisturbed.samples) - 4
    assert not any(published.reasons & HEALTH for published in list(result.published.values())[10:])


def test_doubled_frames_change_only_the_counts(undisturbed: Result) -> None:
    result = run([frame for frame in FRAMES for _ in range(2)])
    assert result.pipeline.counts.repeated == len(FRAMES)
    assert result.estimates == undisturbed.estimates


def test_stuck_voltage_is_found_and_charge_still_counted() -> None:
    seen: list[float] = []

    def freeze(frame: can.Message) -> None:
        signal = SIGNALS[VOLTAGE]
        seen.append(signal.codec.decode(frame.data))
        with_value(seen[0])(frame)

    result = run(with_fault(VOLTAGE, freeze, ends_s=120.0, seconds=130.0))
    published = result.published_at(119.9)
    assert published.reasons & HEALTH == Reason.VOLTAGE_MISSING | Reason.SIGNAL_STUCK
    assert published.status is Status.DEGRADED
    assert len(result.samples) == 1300
    assert result.pipeline.counts.stuck > 100
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


def test_silence_is_timed_by_the_loops_clock() -> None:
    result = run(FRAMES[:1200])
    reader = SocReader()

    def published(silent_s: float) -> SocEstimate:
        content = reader.read(result.pipeline.heartbeat(silent_s)[0])
        assert isinstance(content, SocEstimate)
        return content

    assert published(0.9).status is not Status.INVALID  # ten periods of 0.1 s
    assert published(1.1).status is Status.INVALID
    assert published(1.1).reasons & Reason.INPUT_STALE
    assert (published(1.1).age_s, published(29.0).age_s, published(86400.0).age_s) == (
        1.0,
        29.0,
        30.0,
    )
    assert published(86400.0).soc_pct == published(0.0).soc_pct


def test_slow_source_is_not_stale_between_samples() -> None:
    log = short_log(200.0, rate_hz=0.2)
    pipeline = Pipeline(VEHICLE, leaf_model(), PipelineSettings(START))
    encoder = FrameEncoder(VEHICLE)
    for sample in samples_of(log):
        for frame in encoder.encode(sample):
            pipeline.handle(frame)
    stale = []
    for silent_s in (14.9, 15.1):
        pipeline.heartbeat(silent_s, 2.0)
        stale.append(bool(pipeline.published.reasons & Reason.INPUT_STALE))
    assert stale == [False, True]


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
