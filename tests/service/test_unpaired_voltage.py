"""A voltage whose frames come, but pair with no current, is missing; a slow one is not."""

from __future__ import annotations

from cangauge.bus.time_source import clock_frame
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.settings import EstimatorSettings
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.types import Reason
from live import frames_of, leaf_model, short_log, virtual_port, virtual_service, waits

VOLTAGE = 0x401


def reasons_after(first_s: float, *, shift_s: float, every: int = 1) -> dict[float, Reason]:
    """Return the reasons at each sample; from `first_s` on the voltage comes later, or seldom."""
    frames = []
    for frame in frames_of(short_log(80.0)):
        if frame.arbitration_id == VOLTAGE and frame.timestamp >= first_s:
            if round(10.0 * frame.timestamp) % every:
                continue
            frame.timestamp += shift_s
        frames.append(frame)
    settings = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
    pipeline, found = Pipeline(Vehicle.load("generic"), leaf_model(), settings), {}
    for frame in sorted(frames, key=lambda each: each.timestamp):
        if pipeline.handle(frame) and pipeline.latest_sample is not None:
            is_missing = bool(pipeline.latest.reasons & Reason.VOLTAGE_MISSING)
            assert pipeline.is_unpaired is is_missing
            found[pipeline.latest_sample.time_s] = pipeline.latest.reasons
    return found


def test_a_voltage_that_no_longer_pairs_becomes_missing() -> None:
    found = reasons_after(60.0, shift_s=0.05)
    missing = [time_s for time_s, each in found.items() if each & Reason.VOLTAGE_MISSING]
    # The time-out of a voltage each 0.1 s is 1 s.
    assert 60.8 < min(missing) < 61.2
    assert missing == [time_s for time_s in found if time_s >= min(missing)]


def test_a_voltage_that_comes_seldom_is_not_missing() -> None:
    found = reasons_after(20.0, shift_s=0.0, every=10)
    assert not any(each & Reason.VOLTAGE_MISSING for each in found.values())


def test_the_service_says_how_to_pair_them() -> None:
    """On log time, so that nothing waits for it."""
    settings = PipelineSettings(time_source="replay-clock")
    frames = frames_of(short_log(20.0))
    for frame in frames:
        if frame.arbitration_id == VOLTAGE:
            frame.timestamp += 0.05
    bus = virtual_port("unpaired")
    with virtual_service("unpaired", settings) as service:
        for frame in sorted(frames, key=lambda each: each.timestamp):
            bus.send(clock_frame(round(1e6 * frame.timestamp)))
            bus.send(frame)
        assert waits(lambda: any("pair_within_s" in line for line in service.warnings))
    bus.close()
