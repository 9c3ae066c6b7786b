"""A message with two senders: refused, said, and without effect on the SoC."""

from __future__ import annotations

import can

from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.types import Reason, Status
from live import leaf_model, short_log


def forged_drive(seconds: float) -> list[can.Message]:
    """Return a drive with false frames between the true ones in its middle third."""
    vehicle = Vehicle.load("generic")
    encoder, false, out = FrameEncoder(vehicle), FrameEncoder(vehicle), []
    for sample in samples_of(short_log(seconds)):
        out += encoder.encode(sample)
        if seconds / 3.0 <= sample.time_s < 2.0 * seconds / 3.0:
            wrong = sample._replace(current_a=300.0, voltage_v=300.0, time_s=sample.time_s + 0.03)
            out += false.encode(wrong)
    return sorted(out, key=lambda each: each.timestamp)


def test_false_frames_do_not_move_the_soc() -> None:
    settings = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model(), settings, publishes=False)
    during, after = [], []
    for each in forged_drive(300.0):
        time_s = each.timestamp
        pipeline.handle(each)
        if 105.0 < time_s < 205.0:
            during.append(pipeline.estimate_now())
        elif time_s > 260.0:
            after.append(pipeline.estimate_now())
    assert all(each.reasons & Reason.DUPLICATE_SENDER for each in during)
    assert all(each.status is Status.INVALID for each in during)
    # 300 V alone would be an empty pack.
    assert max(abs(each.soc_pct - 79.0) for each in during) < 1.0
    assert all(abs(each.soc_pct - 77.2) < 3.0 * each.soc_std_pct for each in after)
    assert max(each.soc_std_pct for each in after) > 1.5 * during[0].soc_std_pct
    assert pipeline.counts.samples < 2200
