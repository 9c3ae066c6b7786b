"""The pipeline without a bus, against the offline estimator."""

from __future__ import annotations

import can
import numpy as np
import pytest

from cangauge.bus.publish import ACKNOWLEDGE_EVERY, SocReader
from cangauge.bus.time_source import clock_frame
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimation.offline import run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.logs.log import Log
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.settings import FrameIds
from cangauge.types import Estimate
from live import frames_of, leaf_model, quantized, short_log

START = EstimatorSettings(initial_soc_pct=80.0)


@pytest.fixture(scope="module")
def log() -> Log:
    return short_log(150.0)


def with_clock(frames: list[can.Message]) -> list[can.Message]:
    """Return the frames as `replay` sends them: after their clock, with arbitrary stamps."""
    sent = []
    for frame in frames:
        sent += [clock_frame(round(frame.timestamp * 1e6)), frame]
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
    # To the last bit. Live, a residual is held until the next row; offline it stands in its own.
    is_row = np.isfinite(offline.residual_v)
    assert np.array_equal(
        np.array([each.residual_v for each in live])[is_row], offline.residual_v[is_row]
    )
    for name in ("soc_pct", "soc_std_pct"):
        numbers = [getattr(each, name) for each in live]
        assert np.array_equal(numbers, getattr(offline, name), equal_nan=True), name


def test_no_estimate_before_the_first_replay_clock(log: Log) -> None:
    vehicle = Vehicle.load("generic")
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(START, "replay-clock"))
    frames = frames_of(log, vehicle)[:50]
    assert estimates(pipeline, frames) == []
    assert pipeline.counts["untimed"] == 50


def test_samples_of_a_replay_are_acknowledged_while_they_come(log: Log) -> None:
    vehicle = Vehicle.load("generic")
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(START, "replay-clock"))
    reader, told = SocReader(), [0]
    for frame in with_clock(frames_of(log.rows(slice(0, 100)), vehicle)):
        for sent in pipeline.replay_frames(pipeline.latest) if pipeline.handle(frame) else []:
            name, content = reader.read(sent)
            told += [content["samples"]] if name == "soc_detail" else []
        assert pipeline.samples - told[-1] < ACKNOWLEDGE_EVERY
    assert told == sorted(told)


def test_published_id_of_a_vehicle_signal_is_refused() -> None:
    settings = PipelineSettings(ids=FrameIds(soc_estimate=0x400))
    with pytest.raises(InputError, match="PACK_CURRENT"):
        Pipeline(Vehicle.load("generic"), leaf_model(), settings)


def test_only_wanted_ids_pass_the_filters() -> None:
    settings = PipelineSettings(time_source="replay-clock")
    filters = Pipeline(Vehicle.load("leaf_aze0"), leaf_model(), settings).filters
    assert {each["can_id"] for each in filters} == {0x1DB, 0x55B, 0x5C0, 0x5AE, 0x5AF}
    assert all(each["can_mask"] == 0x7FF and each["extended"] is False for each in filters)
