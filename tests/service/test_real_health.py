"""Recorded cars: no false alarms about signals; damaged real frames are refused."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import can
import pytest

from cangauge.bus.recording import open_vehicle_capture, read_log
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.types import Estimate, Reason, Status
from live import leaf_model, quantized
from selection import nightly_except

pytestmark = pytest.mark.real

ALARMS = (
    Reason.CURRENT_MISSING
    | Reason.PROTECTION_FAILED
    | Reason.SIGNAL_STUCK
    | Reason.IMPLAUSIBLE_INPUT
)
CAPTURES = {
    "10bars.csv.gz": "leaf_ze0",
    "12bars95.csv.gz": "leaf_ze0",
    "62kWh-Battery-only-EVcan.txt.gz": "leaf_ze1",
    "AZE0w40kWhv2.48.log.gz": "leaf_aze0",
    "EV-CANeplus2.log.gz": "leaf_ze1",
    "ZE0_Shift_P_D_ECO_N.log.gz": "leaf_ze0",
    "ZE0w24kWhstock.log.gz": "leaf_ze0",
    "env200-2015-with-40kWh-startup-nobridge.crtd.gz": "leaf_aze0",
    "leaf_2012_orig_start_stop.csv.gz": "leaf_ze0",
}
IN_SUITE = ("10bars.csv.gz", "62kWh-Battery-only-EVcan.txt.gz", "AZE0w40kWhv2.48.log.gz")
"""A capture of each preset; the others run in `make nightly`."""
START = EstimatorSettings(initial_soc_pct=60.0)


def capture(shared_data: Path, name: str) -> tuple[Pipeline, list[can.Message]]:
    preset = CAPTURES[name]
    vehicle = Vehicle.load(preset, temperature_c=20.0 if preset == "leaf_ze1" else None)
    frames = list(open_vehicle_capture(shared_data / "leaf_can" / name, vehicle))
    return Pipeline(vehicle, leaf_model(), PipelineSettings(START)), frames


@pytest.mark.parametrize("name", nightly_except(IN_SUITE, CAPTURES))
def test_real_leaf_captures_raise_no_alarm(shared_data: Path, name: str) -> None:
    pipeline, frames = capture(shared_data, name)
    estimates = [pipeline.latest for frame in frames if pipeline.handle(frame)]
    assert not any(each.reasons & ALARMS for each in estimates)
    counts = pipeline.counts
    assert not any(counts[name] for name in ("implausible", "stuck", "held_back", "repeated"))
    assert not pipeline.estimate_now().reasons & (
        ALARMS | Reason.VOLTAGE_MISSING | Reason.TEMPERATURE_MISSING
    )


@pytest.mark.parametrize(
    ("trip", "preset"),
    [
        ("TripA13", "leaf_aze0"),
        ("TripA14", "generic"),
        *(
            pytest.param("TripB18", preset, marks=pytest.mark.nightly)
            for preset in ("generic", "leaf_aze0")
        ),
    ],
)
def test_replayed_trips_raise_no_alarm_and_match_offline(
    shared_data: Path, trip: str, preset: str
) -> None:
    """Signals in steps of 0.0001 V or 0.5 V and whole degrees, in traffic and at rest."""
    vehicle = Vehicle.load(preset)
    log = read_log(shared_data / "bmw_i3" / f"{trip}.csv.gz")
    pipeline = Pipeline(vehicle, leaf_model(), PipelineSettings(START))
    encoder = FrameEncoder(vehicle)
    estimates: list[Estimate] = []
    for sample in samples_of(quantized(vehicle, log)):
        frames = encoder.encode(sample)
        estimates += [pipeline.latest for frame in frames if pipeline.handle(frame)]
    counts = pipeline.counts
    assert not any(counts[name] for name in ("implausible", "stuck", "held_back"))
    settings = replace(START, temperature_source=vehicle.temperature_source)
    offline = run_estimator(samples_of(quantized(encoder.vehicle, log)), leaf_model(), settings)
    assert [each.soc_pct for each in estimates] == offline.soc_pct.tolist()
    assert [each.status for each in estimates] == offline.status.tolist()


def flip(frame: can.Message) -> None:
    frame.data[2] ^= 0x10


def test_real_frames_damaged_for_a_second_are_refused(shared_data: Path) -> None:
    pipeline, frames = capture(shared_data, "ZE0w24kWhstock.log.gz")
    whole, _ = capture(shared_data, "ZE0w24kWhstock.log.gz")
    begins_s = frames[0].timestamp + 30.0
    published: dict[float, Estimate] = {}
    frames = [frame for frame in frames if frame.arbitration_id in {0x1DB, 0x55B, 0x5C0}]
    for frame in frames:
        whole.handle(copy.copy(frame))
        at_s = frame.timestamp - begins_s
        if frame.arbitration_id == 0x1DB and 0.0 <= at_s < 1.0:
            flip(frame)
        pipeline.handle(frame)
        published[at_s] = pipeline.estimate_now()
    during = [each for at_s, each in published.items() if 0.1 < at_s < 1.0]
    assert all(each.status is Status.INVALID for each in during)
    assert all(
        each.reasons & (Reason.PROTECTION_FAILED | Reason.CURRENT_MISSING)
        == Reason.PROTECTION_FAILED | Reason.CURRENT_MISSING
        for each in during
    )
    after = [each for at_s, each in published.items() if at_s > 1.05]
    assert not any(each.reasons & ALARMS for each in after)
    assert pipeline.counts["crc_errors"] >= 99
    assert pipeline.latest.soc_pct == pytest.approx(whole.latest.soc_pct, abs=0.01)
