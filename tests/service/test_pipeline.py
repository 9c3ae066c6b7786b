"""The pipeline without a bus, against the offline estimator."""

from __future__ import annotations

import math

import can
import numpy as np
import pytest

from cangauge.bus.publish import FrameIds, SocDetail, SocEstimate, SocReader
from cangauge.bus.time_source import ClockFrames
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimation.offline import run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.logs.log import Log
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.types import Estimate, Reason, Status
from live import leaf_model, quantized, short_log

START = EstimatorSettings(initial_soc_pct=80.0)


@pytest.fixture(scope="module")
def log() -> Log:
    return short_log(150.0)


def frames_of(log: Log, vehicle: Vehicle, shift_s: float = 0.0) -> list[can.Message]:
    encoder = FrameEncoder(vehicle)
    frames = []
    for sample in samples_of(log):
        frames += encoder.encode(sample._replace(time_s=sample.time_s + shift_s))
    return frames


def with_clock(frames: list[can.Message]) -> list[can.Message]:
    """Return the frames as `replay` sends them: after their clock, with arbitrary stamps."""
    clock = ClockFrames()
    sent = []
    for frame in frames:
        sent += [clock.at(round(frame.timestamp * 1e6)), frame]
        frame.timestamp = 7.0
    return sent


def estimates(pipeline: Pipeline, frames: list[can.Message]) -> list[Estimate]:
    found = []
    for frame in frames:
        before = pipeline.samples
        pipeline.handle(frame)
        if pipeline.samples != before:
            found.append(pipeline.latest)
    return found


@pytest.mark.parametrize("preset", ["generic", "leaf_aze0"])
@pytest.mark.parametrize("method", ["ekf", "newton", "coulomb"])
def test_live_equals_offline_on_quantized_values(log: Log, preset: str, method: str) -> None:
    vehicle = Vehicle.load(preset)
    settings = EstimatorSettings(method=method, initial_soc_pct=80.0)  # type: ignore[arg-type] # parametrised
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(settings, "replay-clock"))
    live = estimates(pipeline, with_clock(frames_of(log, vehicle)))
    offline = run_estimator(samples_of(quantized(vehicle, log)), leaf_model(), settings)
    assert len(live) == len(log)
    for name in ("soc_pct", "soc_std_pct", "residual_v"):  # to the last bit
        numbers = [getattr(each, name) for each in live]
        assert np.array_equal(numbers, getattr(offline, name), equal_nan=True), name


def test_receive_stamps_are_bus_time(log: Log) -> None:
    vehicle = Vehicle.load("generic")
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(START))
    live = estimates(pipeline, frames_of(log, vehicle, shift_s=1.7e9))
    assert live[-1].time_s == pytest.approx(1.7e9 + log.time_s[-1])
    counted = run_estimator(samples_of(log), leaf_model(), START).soc_coulomb_pct
    assert live[-1].soc_coulomb_pct == pytest.approx(counted[-1], abs=1e-4)


def test_no_estimate_before_the_first_replay_clock(log: Log) -> None:
    vehicle = Vehicle.load("generic")
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(START, "replay-clock"))
    frames = frames_of(log, vehicle)[:50]
    assert estimates(pipeline, frames) == []
    assert pipeline.counts.untimed == 50


def test_initialising_before_the_first_sample() -> None:
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    reader = SocReader()
    contents = [reader.read(frame) for frame in pipeline.heartbeat(is_stale=False)]
    assert isinstance(contents[0], SocEstimate)
    assert math.isnan(contents[0].soc_pct)
    assert contents[0].status is Status.INITIALISING
    assert contents[0].reasons & Reason.INPUT_STALE
    assert math.isnan(contents[0].age_s)
    assert contents[1] == SocDetail(*contents[1][:3], samples=0)  # type: ignore[index] # a SocDetail


def test_silence_is_invalid_with_the_last_soc(log: Log) -> None:
    vehicle = Vehicle.load("generic")
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(START))
    estimates(pipeline, frames_of(log, vehicle))
    reader = SocReader()
    fresh = reader.read(pipeline.heartbeat(is_stale=False)[0])
    stale = reader.read(pipeline.heartbeat(is_stale=True, silent_s=7.9)[0])
    assert isinstance(fresh, SocEstimate)
    assert isinstance(stale, SocEstimate)
    assert not fresh.reasons & Reason.INPUT_STALE
    assert stale.status is Status.INVALID
    assert stale.reasons & Reason.INPUT_STALE
    assert stale.soc_pct == fresh.soc_pct == pytest.approx(pipeline.latest.soc_pct, abs=0.005)
    assert (fresh.age_s, stale.age_s) == (0.0, 7.0)
    # The estimate recovers with the next frames.
    again = frames_of(log.rows(slice(0, 2)), vehicle, shift_s=log.time_s[-1] + 0.1)
    assert estimates(pipeline, again)[-1].status is not Status.INVALID


def test_heartbeat_acknowledges_the_last_samples(log: Log) -> None:
    vehicle = Vehicle.load("generic")
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(START, "replay-clock"))
    reader = SocReader()
    acknowledged = 0
    for frame in with_clock(frames_of(log.rows(slice(0, 7)), vehicle)):
        for sent in pipeline.acknowledgement(pipeline.latest) if pipeline.handle(frame) else []:
            content = reader.read(sent)
            acknowledged = content.samples if isinstance(content, SocDetail) else acknowledged
    assert acknowledged < 7
    contents = [reader.read(frame) for frame in pipeline.heartbeat(is_stale=False)]
    assert [each.samples for each in contents if isinstance(each, SocDetail)] == [7]


def test_second_replay_restarts_the_estimator(log: Log) -> None:
    vehicle = Vehicle.load("generic")
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(START, "replay-clock"))
    first = estimates(pipeline, with_clock(frames_of(log, vehicle)))
    second = estimates(pipeline, with_clock(frames_of(log, vehicle)))
    assert [each.soc_pct for each in second] == [each.soc_pct for each in first]
    assert pipeline.samples == 2 * len(log)
    assert pipeline.counts.samples == 2 * len(log)
    assert pipeline.counts.beginnings == 1


def test_damaged_and_lost_frames_are_counted(log: Log) -> None:
    vehicle = Vehicle.load("leaf_aze0")
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(START))
    frames = [each for each in frames_of(log, vehicle) if each.arbitration_id == 0x1DB]
    frames[10].data[0] ^= 0xFF
    del frames[20]
    assert len(estimates(pipeline, frames)) == len(log) - 2
    assert pipeline.counts.crc_errors == 1
    assert pipeline.counts.lost >= 1


def test_published_id_of_a_vehicle_signal_is_refused() -> None:
    with pytest.raises(InputError, match="PACK_CURRENT"):
        Pipeline(
            Vehicle.load("generic"),
            leaf_model(),
            PipelineSettings(ids=FrameIds(soc_estimate=0x400)),
        )


def test_only_wanted_ids_pass_the_filters() -> None:
    pipeline = Pipeline(Vehicle.load("leaf_aze0"), leaf_model())
    assert {each["can_id"] for each in pipeline.filters} == {0x1DB, 0x55B, 0x5C0}
    assert all(each["can_mask"] == 0x7FF and each["extended"] is False for each in pipeline.filters)
    settings = PipelineSettings(time_source="replay-clock")
    clocked = Pipeline(Vehicle.load("leaf_aze0"), leaf_model(), settings)
    assert {each["can_id"] for each in clocked.filters} == {0x1DB, 0x55B, 0x5C0, 0x5AF}


def test_uncertain_soc_is_published_as_degraded(log: Log) -> None:
    reader = SocReader()
    for limit, status, reasons in (
        (0.5, Status.DEGRADED, Reason.SOC_UNCERTAIN),
        (1.5, Status.VALID, Reason.NONE),
    ):
        given = EstimatorSettings(initial_soc_pct=80.0, valid_std_pct=limit)
        pipeline = Pipeline(Vehicle.load("generic"), leaf_model(), PipelineSettings(given))
        for frame in frames_of(log, Vehicle.load("generic")):
            pipeline.handle(frame)
        found = reader.read(pipeline.heartbeat(is_stale=False)[0])
        assert isinstance(found, SocEstimate)
        assert (found.status, found.reasons) == (status, reasons)
