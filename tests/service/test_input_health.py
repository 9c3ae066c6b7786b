"""Frames that fail, on their whole way: what the estimator gets, what is told, what comes back."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import can
import pytest

from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.protection import GENERIC_RULE
from cangauge.bus.publish import SocEstimate, SocReader
from cangauge.bus.vehicle import Vehicle, VehicleSignal, load_vehicle
from cangauge.estimate.offline import samples_of
from cangauge.estimate.settings import EstimatorSettings
from cangauge.estimate.validity import Estimate, Reason, Sample, Status
from cangauge.service.pipeline import Pipeline, PipelineSettings
from live import leaf_model, short_log

START = EstimatorSettings(initial_soc_pct=80.0)
BEGINS_S, ENDS_S = 100.0, 104.0
"""The fault."""
VEHICLE = load_vehicle("generic")
CURRENT, VOLTAGE, TEMPERATURE = 0x400, 0x401, 0x402
SIGNALS: dict[int, VehicleSignal] = {signal.key: signal for signal in VEHICLE.signals}
Spoil = Callable[[can.Message], None]


def recorded(seconds: float = 130.0, vehicle: Vehicle = VEHICLE) -> list[can.Message]:
    """Frames of a drive; the temperature comes with every sample, as from a cyclic sender."""
    log = short_log(seconds)
    frames = []
    for sample in samples_of(log):
        frames += FrameEncoder(vehicle).encode(sample)  # a new one: slow signals are always due
    counters: dict[int, int] = {}
    for frame in frames:
        counter = counters.get(frame.arbitration_id, 0)
        counters[frame.arbitration_id] = counter + 1
        frame.data = bytearray(GENERIC_RULE.protect(frame.data, counter))
    return frames


FRAMES = recorded()


def with_value(value: float) -> Spoil:
    """The value in a frame that is whole."""

    def spoil(frame: can.Message) -> None:
        counter = GENERIC_RULE.counter(frame.data)
        SIGNALS[frame.arbitration_id].encode_into(frame.data, value)
        frame.data = bytearray(GENERIC_RULE.protect(frame.data, counter))

    return spoil


def flip(frame: can.Message) -> None:
    frame.data[0] ^= 0x40


def stand_still(frame: can.Message) -> None:
    frame.data = bytearray(GENERIC_RULE.protect(frame.data, 7))


def cut(frame: can.Message) -> None:
    frame.data = frame.data[:-1]


@dataclass
class Told:
    """What came out: samples and estimates, and what a heartbeat said after every sample time."""

    samples: list[Sample]
    estimates: list[Estimate]
    heard: dict[float, SocEstimate]
    pipeline: Pipeline

    def heard_at(self, time_s: float) -> SocEstimate:
        return self.heard[min(self.heard, key=lambda each: abs(each - time_s))]


def run(frames: list[can.Message], settings: EstimatorSettings = START) -> Told:
    pipeline, reader = Pipeline(VEHICLE, leaf_model(), PipelineSettings(settings)), SocReader()
    told = Told([], [], {}, pipeline)
    for frame in copy.deepcopy(frames):
        before = pipeline.samples
        pipeline.handle(frame)
        if pipeline.samples != before:
            assert pipeline.latest_sample is not None
            told.samples.append(pipeline.latest_sample)
            told.estimates.append(pipeline.latest)
        heard = reader.read(pipeline.heartbeat(is_stale=False)[0])
        assert isinstance(heard, SocEstimate)
        told.heard[frame.timestamp] = heard
    return told


def spoilt(frame_id: int, spoil: Spoil, begins_s: float = BEGINS_S, ends_s: float = ENDS_S):  # type: ignore[no-untyped-def] # a list of frames
    frames = copy.deepcopy(FRAMES)
    for frame in frames:
        if frame.arbitration_id == frame_id and begins_s <= frame.timestamp < ends_s:
            spoil(frame)
    return frames


@pytest.fixture(scope="module")
def undisturbed() -> Told:
    return run(FRAMES)


FAULTS = {
    "crc": (flip, Reason.PROTECTION_FAILED),
    "counter": (stand_still, Reason.PROTECTION_FAILED),
    "short": (cut, Reason.PROTECTION_FAILED),
    "not available": (with_value(math.nan), Reason.NONE),
    "out of range": (with_value(9000.0), Reason.IMPLAUSIBLE_INPUT),
}
FAULTS_OF = {
    CURRENT: {**FAULTS},
    VOLTAGE: {**FAULTS, "next to nothing": (with_value(3.0), Reason.IMPLAUSIBLE_INPUT)},
    TEMPERATURE: {
        **{name: fault for name, fault in FAULTS.items() if name != "out of range"},
        "out of range": (with_value(200.0), Reason.IMPLAUSIBLE_INPUT),
        "too fast": (with_value(60.0), Reason.IMPLAUSIBLE_INPUT),
    },
}
CASES = [(frame_id, name) for frame_id, faults in FAULTS_OF.items() for name in faults]
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


def test_a_drive_without_faults_has_nothing_to_say(undisturbed: Told) -> None:
    assert len(undisturbed.samples) == 1300
    after = [each.reasons for each in undisturbed.estimates]
    assert not any(reasons & HEALTH for reasons in after)
    counts = undisturbed.pipeline.counts
    assert (counts.implausible, counts.stuck, counts.held_back, counts.repeated) == (0, 0, 0, 0)


@pytest.mark.parametrize(("frame_id", "name"), CASES)
def test_what_fails_is_told_and_never_reaches_the_estimator(
    undisturbed: Told, frame_id: int, name: str
) -> None:
    spoil, why = FAULTS_OF[frame_id][name]
    ends_s = BEGINS_S + 1.5 if name == "too fast" else ENDS_S  # a lasting step is believed then
    told = run(spoilt(frame_id, spoil, ends_s=ends_s))
    # Nothing but what was sent before, or nothing at all.
    sent = {sample.time_s: sample for sample in undisturbed.samples}
    for sample in told.samples:
        for value, good in zip(sample, sent[sample.time_s], strict=True):
            assert value == good or math.isnan(value)
    # Still valid after four failures, missing after five, and why.
    missing = MISSING[frame_id]
    before = told.heard_at(BEGINS_S + 0.35)
    assert not before.reasons & missing
    during = told.heard_at(ends_s - 0.05)
    assert during.reasons & HEALTH == missing | why
    invalid = frame_id == CURRENT
    assert during.status is (Status.INVALID if invalid else Status.DEGRADED)
    assert math.isfinite(during.soc_pct)  # old, not unknown
    # Two good values are not enough to come back, three are.
    assert told.heard_at(ends_s + 0.1).reasons & missing
    after = told.heard_at(ends_s + 0.3)
    assert not after.reasons & HEALTH & ~Reason.CURRENT_GAP
    assert after.status is not Status.INVALID
    assert told.estimates[-1].soc_pct == pytest.approx(undisturbed.estimates[-1].soc_pct, abs=0.1)


@pytest.mark.parametrize("frame_id", [CURRENT, VOLTAGE, TEMPERATURE])
def test_a_few_bad_frames_are_not_worth_a_word(frame_id: int) -> None:
    told = run(spoilt(frame_id, flip, ends_s=BEGINS_S + 0.35))
    assert told.pipeline.counts.crc_errors == 4
    assert not any(heard.reasons & HEALTH for heard in list(told.heard.values())[10:])


def test_one_sample_without_voltage_is_not_degraded() -> None:
    settled = run(recorded(80.0))
    assert settled.estimates[-1].status is Status.VALID
    told = run([f for f in recorded(80.0) if f.arbitration_id != VOLTAGE or f.timestamp != 75.0])
    without = [n for n, sample in enumerate(told.samples) if math.isnan(sample.voltage_v)]
    assert len(without) == 1
    assert told.estimates[without[0]].status is Status.VALID


@pytest.mark.parametrize(("frame_id", "missing"), list(MISSING.items()))
def test_a_message_that_stops_times_out_in_bus_time(frame_id: int, missing: Reason) -> None:
    frames = [f for f in FRAMES if f.arbitration_id != frame_id or f.timestamp < BEGINS_S]
    told = run(frames)
    timeout_s = 10.0 if frame_id == TEMPERATURE else 1.0  # ten periods of a cyclic message
    assert not told.heard_at(BEGINS_S + timeout_s - 0.25).reasons & missing
    late = told.heard_at(BEGINS_S + timeout_s + 0.15)
    assert late.reasons & HEALTH == missing
    assert late.status is (Status.INVALID if frame_id == CURRENT else Status.DEGRADED)


def test_a_jump_of_the_counter_is_loss_and_costs_nothing(undisturbed: Told) -> None:
    frames = [f for f in FRAMES if not BEGINS_S < f.timestamp < BEGINS_S + 0.45]
    told = run(frames)
    assert told.pipeline.counts.lost == 12
    assert told.pipeline.counts.repeated == told.pipeline.counts.held_back == 0
    assert len(told.samples) == len(undisturbed.samples) - 4
    assert not any(heard.reasons & HEALTH for heard in list(told.heard.values())[10:])


def test_doubled_frames_change_nothing_but_the_count(undisturbed: Told) -> None:
    told = run([frame for frame in FRAMES for _ in range(2)])
    assert told.pipeline.counts.repeated == len(FRAMES)
    assert told.estimates == undisturbed.estimates


def test_a_frozen_voltage_is_found_and_charge_counted_on() -> None:
    seen: list[float] = []

    def freeze(frame: can.Message) -> None:
        signal = SIGNALS[VOLTAGE]
        seen.append(signal.decode(frame.data))
        with_value(seen[0])(frame)

    told = run(spoilt(VOLTAGE, freeze, begins_s=30.0, ends_s=120.0))
    heard = told.heard_at(119.9)
    assert heard.reasons & HEALTH == Reason.VOLTAGE_MISSING | Reason.SIGNAL_STUCK
    assert heard.status is Status.DEGRADED
    assert len(told.samples) == 1300
    assert told.pipeline.counts.stuck > 100
    assert not told.estimates[-1].reasons & HEALTH


def test_a_frozen_current_makes_the_estimate_invalid() -> None:
    frames = copy.deepcopy(FRAMES)
    for frame in frames:
        if frame.arbitration_id == CURRENT and frame.timestamp >= 60.0:
            with_value(11.0)(frame)
        if frame.arbitration_id == VOLTAGE and frame.timestamp >= 60.0:
            # The short drive's currents are gentle: this is what a spirited one shows.
            with_value(370.0 + 12.0 * math.sin(frame.timestamp))(frame)
    heard = run(frames).heard_at(129.0)
    assert heard.status is Status.INVALID
    assert heard.reasons & HEALTH == Reason.CURRENT_MISSING | Reason.SIGNAL_STUCK
    assert math.isfinite(heard.soc_pct)


def test_heartbeats_and_their_clock_never_change_the_numbers() -> None:
    """The estimator's input is a function of the frames and their stamps alone."""
    frames = spoilt(CURRENT, flip)
    watched = run(frames).estimates
    pipeline = Pipeline(VEHICLE, leaf_model(), PipelineSettings(START))
    alone = [pipeline.latest for frame in copy.deepcopy(frames) if pipeline.handle(frame)]
    assert watched == alone


def test_while_nothing_arrives_the_clock_of_the_loop_decides() -> None:
    told = run(FRAMES[:1200])
    reader = SocReader()

    def heard(silent_s: float) -> SocEstimate:
        content = reader.read(told.pipeline.heartbeat(is_stale=False, silent_s=silent_s)[0])
        assert isinstance(content, SocEstimate)
        return content

    assert heard(0.9).status is not Status.INVALID  # ten periods of 0.1 s
    assert heard(1.1).status is Status.INVALID
    assert heard(1.1).reasons & Reason.INPUT_STALE
    assert (heard(1.1).age_s, heard(29.0).age_s, heard(86400.0).age_s) == (1.0, 29.0, 30.0)
    assert heard(86400.0).soc_pct == heard(0.0).soc_pct


def test_a_slow_source_is_not_stale_between_its_samples() -> None:
    log = short_log(200.0, rate_hz=0.2)
    pipeline = Pipeline(VEHICLE, leaf_model(), PipelineSettings(START))
    encoder = FrameEncoder(VEHICLE)
    for sample in samples_of(log):
        for frame in encoder.encode(sample):
            pipeline.handle(frame)
    assert pipeline.least_timeout_s == pytest.approx(15.0)
    replayed = Pipeline(VEHICLE, leaf_model(), PipelineSettings(START, "replay-clock"))
    assert replayed.least_timeout_s == 0.0


def test_never_seen_and_always_refused_says_why() -> None:
    frames = copy.deepcopy(FRAMES[:100])
    for frame in frames:
        flip(frame)
    told = run(frames)
    heard = told.heard_at(frames[-1].timestamp)
    assert heard.status is Status.INITIALISING
    assert math.isnan(heard.soc_pct)
    assert math.isnan(heard.age_s)
    assert heard.reasons & Reason.PROTECTION_FAILED
    assert heard.reasons & Reason.NO_INITIAL_SOC
