"""A recording gives the live numbers, bit for bit."""

from __future__ import annotations

from pathlib import Path

import can
import numpy as np
import pytest

from cangauge.bus.time_source import ClockFrames
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimation.offline import samples_of
from cangauge.replay.encoder import FrameEncoder
from cangauge.service import record
from cangauge.service.offline import estimate_capture
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.record import Recorder
from cangauge.types import Estimate
from live import leaf_model, short_log

NUMBERS = ("soc_pct", "soc_std_pct", "soc_newton_pct", "voltage_model_v", "residual_v")


@pytest.fixture(autouse=True)
def patient_recorder(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a busy machine take its time to complete the recording."""
    monkeypatch.setattr(record, "CLOSE_WITHIN_S", 30.0)


def live_and_recorded(
    frames: list[can.Message], settings: PipelineSettings, path: Path, preset: str
) -> tuple[list[Estimate], Path]:
    """Handle frames as the loop does; return the estimates and the recording."""
    pipeline = Pipeline(Vehicle.load(preset), leaf_model(), settings)
    found = []
    with Recorder(path) as recorder:
        for frame in frames:
            recorder.write(frame)
            before = pipeline.samples
            pipeline.handle(frame)
            if pipeline.samples != before:
                found.append(pipeline.latest)
        before = pipeline.samples
        pipeline.finish()
        if pipeline.samples != before:
            found.append(pipeline.latest)
    return found, recorder.written


def assert_same(live: list[Estimate], path: Path, preset: str) -> None:
    recorded = estimate_capture(path, Vehicle.load(preset), leaf_model())
    assert len(live) == recorded.table.soc_pct.size > 0
    for name in NUMBERS:
        expected = np.array([getattr(each, name) for each in live])
        assert np.array_equal(getattr(recorded.table, name), expected, equal_nan=True), name


@pytest.mark.parametrize(("suffix", "preset"), [(".log", "leaf_aze0"), (".log.gz", "generic")])
def test_recorded_stamps_are_the_live_ones(tmp_path: Path, suffix: str, preset: str) -> None:
    rng = np.random.default_rng(5)
    encoder = FrameEncoder(Vehicle.load(preset))
    frames = []
    for sample in samples_of(short_log(90.0)):
        for frame in encoder.encode(sample, 55.0):
            frame.timestamp += 1.7e9
            frames.append(frame)
    # Kernel stamps, to the nanosecond, and a clock that is set back.
    for frame, late_s in zip(frames, np.sort(rng.uniform(0.0, 1.0, len(frames))), strict=True):
        frame.timestamp += float(late_s) - (4000.0 if late_s > 0.5 else 0.0)
    path = tmp_path / f"drive{suffix}"
    live, path = live_and_recorded(frames, PipelineSettings(), path, preset)
    assert_same(live, path, preset)


def test_recorded_replay_uses_the_logs_time(tmp_path: Path) -> None:
    clock, encoder = ClockFrames(), FrameEncoder(Vehicle.load("generic"))
    frames = []
    for _ in range(2):  # two replays in a row: each log is estimated separately
        for sample in samples_of(short_log(30.0)):
            frames.append(clock.at(round(sample.time_s * 1e6)))
            frames += encoder.encode(sample)
    for number, frame in enumerate(frames):
        frame.timestamp = 1.7e9 + 1e-4 * number
    path = tmp_path / "replayed.log"
    settings = PipelineSettings(time_source="replay-clock")
    live, _ = live_and_recorded(frames, settings, path, "generic")
    assert_same(live, path, "generic")
    recorded = estimate_capture(path, Vehicle.load("generic"), leaf_model())
    assert recorded.time_source == "replay-clock"
    assert recorded.counts.beginnings == 1
    assert recorded.table.time_s[:3].tolist() == [0.0, 0.1, 0.2]


def test_samples_without_voltage_are_estimated_too(tmp_path: Path) -> None:
    encoder = FrameEncoder(Vehicle.load("generic"))
    frames = []
    for row, sample in enumerate(samples_of(short_log(30.0))):
        for frame in encoder.encode(sample):
            if frame.arbitration_id != 0x401 or row % 3:  # every third voltage is missing
                frames.append(frame)  # noqa: PERF401 - two loops and a condition read better so
    path = tmp_path / "gappy.log"
    live, _ = live_and_recorded(frames, PipelineSettings(), path, "generic")
    assert_same(live, path, "generic")
    recorded = estimate_capture(path, Vehicle.load("generic"), leaf_model())
    assert np.count_nonzero(np.isnan(recorded.recorded.voltage_v)) == 100


def test_capture_of_another_bus_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.log"
    with Recorder(path) as recorder:
        recorder.write(can.Message(timestamp=1.0, arbitration_id=5, data=b"1"))
    with pytest.raises(InputError, match="no sample"):
        estimate_capture(path, Vehicle.load("generic"), leaf_model())
