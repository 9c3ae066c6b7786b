"""Frames in, frames out: the pipeline without a bus, against the offline estimator."""

from __future__ import annotations

import math

import can
import pytest

from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.publish import FrameIds, SocDetail, SocEstimate, SocReader
from cangauge.bus.time_source import ClockFrames
from cangauge.bus.vehicle import Vehicle, load_vehicle
from cangauge.errors import InputError
from cangauge.estimate.offline import run_estimator, samples_of
from cangauge.estimate.settings import EstimatorSettings
from cangauge.estimate.validity import Estimate, Reason, Status
from cangauge.logs.log import Log
from cangauge.service.pipeline import Pipeline, PipelineSettings
from live import leaf_model, short_log

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
    """As replay sends them: the clock ahead, stamps that mean nothing."""
    clock = ClockFrames()
    told = []
    for frame in frames:
        told += [clock.at(round(frame.timestamp * 1e6)), frame]
        frame.timestamp = 7.0
    return told


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
def test_live_is_offline_on_what_the_frames_hold(log: Log, preset: str, method: str) -> None:
    vehicle = load_vehicle(preset)
    settings = EstimatorSettings(method=method, initial_soc_pct=80.0)  # type: ignore[arg-type] # parametrised
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(settings, "replay-clock"))
    live = estimates(pipeline, with_clock(frames_of(log, vehicle)))
    offline = run_estimator(samples_of(FrameEncoder(vehicle).quantise(log)), leaf_model(), settings)
    assert len(live) == len(log)
    # To the last bit, and not only nearly.
    assert [each.soc_pct for each in live] == offline.soc_pct.tolist()
    assert [each.soc_std_pct for each in live] == offline.soc_std_pct.tolist()
    assert [each.residual_v for each in live] == offline.residual_v.tolist()


def test_receive_stamps_are_bus_time(log: Log) -> None:
    vehicle = load_vehicle("generic")
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(START))
    live = estimates(pipeline, frames_of(log, vehicle, shift_s=1.7e9))
    assert live[-1].time_s == pytest.approx(1.7e9 + log.time_s[-1])
    counted = run_estimator(samples_of(log), leaf_model(), START).soc_coulomb_pct
    assert live[-1].soc_coulomb_pct == pytest.approx(counted[-1], abs=1e-4)


def test_without_a_clock_frame_nothing_is_estimated(log: Log) -> None:
    vehicle = load_vehicle("generic")
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(START, "replay-clock"))
    frames = frames_of(log, vehicle)[:50]
    assert estimates(pipeline, frames) == []
    assert pipeline.counts.untimed == 50


def test_before_the_first_sample_it_says_that_it_knows_nothing() -> None:
    pipeline = Pipeline(load_vehicle("generic"), leaf_model())
    reader = SocReader()
    contents = [reader.read(frame) for frame in pipeline.heartbeat(is_stale=False)]
    assert isinstance(contents[0], SocEstimate)
    assert math.isnan(contents[0].soc_pct)
    assert contents[0].status is Status.INITIALISING
    assert contents[0].reasons & Reason.INPUT_STALE
    assert math.isnan(contents[0].age_s)
    assert contents[1] == SocDetail(*contents[1][:3], samples=0)  # type: ignore[index] # a SocDetail


def test_silence_is_published_as_invalid_with_the_last_soc(log: Log) -> None:
    vehicle = load_vehicle("generic")
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
    assert stale.soc_pct == fresh.soc_pct == pytest.approx(pipeline.latest.soc_pct, abs=0.001)
    assert (fresh.age_s, stale.age_s) == (0.0, 7.0)
    # Once frames come again, so does a valid estimate.
    again = frames_of(log.rows(slice(0, 2)), vehicle, shift_s=log.time_s[-1] + 0.1)
    assert estimates(pipeline, again)[-1].status is not Status.INVALID


def test_the_last_samples_are_acknowledged_once_it_is_quiet(log: Log) -> None:
    vehicle = load_vehicle("generic")
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(START, "replay-clock"))
    reader = SocReader()
    told = 0
    for frame in with_clock(frames_of(log.rows(slice(0, 7)), vehicle)):
        pipeline.handle(frame)
        for sent in pipeline.acknowledgement():
            content = reader.read(sent)
            told = content.samples if isinstance(content, SocDetail) else told
    assert told < 7
    contents = [reader.read(frame) for frame in pipeline.heartbeat(is_stale=False)]
    assert [each.samples for each in contents if isinstance(each, SocDetail)] == [7]


def test_a_second_replay_starts_anew_and_counting_goes_on(log: Log) -> None:
    vehicle = load_vehicle("generic")
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(START, "replay-clock"))
    first = estimates(pipeline, with_clock(frames_of(log, vehicle)))
    second = estimates(pipeline, with_clock(frames_of(log, vehicle)))
    assert [each.soc_pct for each in second] == [each.soc_pct for each in first]
    assert pipeline.samples == 2 * len(log)
    assert pipeline.counts.samples == 2 * len(log)
    assert pipeline.counts.beginnings == 1


def test_damaged_and_lost_frames_are_counted(log: Log) -> None:
    vehicle = load_vehicle("leaf_aze0")
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(START))
    frames = [each for each in frames_of(log, vehicle) if each.arbitration_id == 0x1DB]
    frames[10].data[0] ^= 0xFF
    del frames[20]
    assert len(estimates(pipeline, frames)) == len(log) - 2
    assert pipeline.counts.crc_errors == 1
    assert pipeline.counts.lost >= 1


def test_own_ids_must_not_be_the_vehicles() -> None:
    with pytest.raises(InputError, match="PACK_CURRENT"):
        Pipeline(
            load_vehicle("generic"),
            leaf_model(),
            PipelineSettings(ids=FrameIds(soc_estimate=0x400)),
        )


def test_only_wanted_ids_pass_the_filters() -> None:
    pipeline = Pipeline(load_vehicle("leaf_aze0"), leaf_model())
    assert {each["can_id"] for each in pipeline.filters} == {0x1DB, 0x55B, 0x5C0}
    assert all(each["can_mask"] == 0x7FF and each["extended"] is False for each in pipeline.filters)
    settings = PipelineSettings(time_source="replay-clock")
    clocked = Pipeline(load_vehicle("leaf_aze0"), leaf_model(), settings)
    assert {each["can_id"] for each in clocked.filters} == {0x1DB, 0x55B, 0x5C0, 0x5AF}


def test_a_wide_standard_deviation_is_degraded_on_the_bus_and_says_so(log: Log) -> None:
    reader = SocReader()
    for limit, status, reasons in (
        (0.5, Status.DEGRADED, Reason.SOC_UNCERTAIN),
        (1.5, Status.VALID, Reason.NONE),
    ):
        given = EstimatorSettings(initial_soc_pct=80.0, valid_std_pct=limit)
        pipeline = Pipeline(load_vehicle("generic"), leaf_model(), PipelineSettings(given))
        for frame in frames_of(log, load_vehicle("generic")):
            pipeline.handle(frame)
        told = reader.read(pipeline.heartbeat(is_stale=False)[0])
        assert isinstance(told, SocEstimate)
        assert (told.status, told.reasons) == (status, reasons)
