"""Any frames in any order: no exception, no SoC outside 0–100 %, every published frame readable."""

from __future__ import annotations

import math
import warnings
from functools import cache
from random import Random

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cangauge.bus.protection import RULES
from cangauge.bus.publish import SocPublisher, SocReader
from cangauge.bus.time_source import StampLimiter, clock_frame
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.published import leaf_2012_model_file
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.types import Estimate, Sample
from small_files import DBC, MAP, log_rows

FRAMES = 200
STREAMS = 300
STEPS_S = (0.01, 0.01, 0.01, 0.0, 1.0, 5.0, -0.5, 1e5, -1e6, 1e-9)
ODD_STAMPS_S = (math.nan, math.inf, -math.inf, -1.0, 0.0, 1e300, 1e11, -1e-6)
ODD_BYTES = (0, 255, 127, 128)


@pytest.fixture(scope="module")
def vehicles(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Vehicle]:
    folder = tmp_path_factory.mktemp("car")
    (folder / "car.dbc").write_text(DBC)
    (folder / "car.toml").write_text(MAP)
    return {
        "leaf_aze0": Vehicle.load("leaf_aze0"),
        "generic": Vehicle.load("generic"),
        "leaf_ze1": Vehicle.load("leaf_ze1", temperature_c=20.0),
        "own": Vehicle.load(map=folder / "car.toml"),
    }


@pytest.mark.parametrize("name", ["leaf_aze0", "generic", "leaf_ze1", "own"])
def test_any_frames_give_a_possible_soc(name: str, vehicles: dict[str, Vehicle]) -> None:
    vehicle = vehicles[name]
    good = good_frames(vehicle)

    @settings(
        max_examples=STREAMS // len(vehicles),
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(rng=st.randoms(use_true_random=False))
    def check(rng: Random) -> None:
        run_stream(rng, vehicle, good)

    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # numpy's: a user would see it on stderr
        check()


def run_stream(rng: Random, vehicle: Vehicle, good: list[can.Message]) -> None:
    """Handle damaged frames with odd stamps, and check every estimate and published frame."""
    estimator = EstimatorSettings(
        method=rng.choice(("ekf", "ekf", "newton", "coulomb")),
        initial_soc_pct=rng.choice((None, 0.0, 50.0, 100.0)),
    )
    source = rng.choice(("receive", "receive", "replay-clock"))
    pipeline = Pipeline(vehicle, model(), PipelineSettings(estimator, source), publishes=False)
    reader, publisher = SocReader(), SocPublisher()
    limiter = rng.choice((None, StampLimiter(0.02), StampLimiter(0.25, 1.7e9)))
    now_s = rng.choice((0.0, 1000.0, 1.7e9))
    for number in range(FRAMES):
        frame = damaged(rng, good[number % len(good)], vehicle)
        now_s += rng.choice(STEPS_S)
        frame.timestamp = now_s if rng.randrange(20) else rng.choice(ODD_STAMPS_S)
        if limiter is not None:
            check_limited(rng, limiter, frame, number)
        is_complete = pipeline.handle(frame)
        reader.read(frame)
        if is_complete:
            check_estimate(pipeline.latest)
            for message in publisher.publish(pipeline.latest, pipeline.samples):
                check_readable(rng, reader, message)
    pipeline.finish()
    if pipeline.samples:
        check_estimate(pipeline.latest)


def check_estimate(estimate: Estimate) -> None:
    assert math.isnan(estimate.soc_pct) or 0.0 <= estimate.soc_pct <= 100.0
    assert not estimate.soc_std_pct < 0.0


def check_limited(rng: Random, limiter: StampLimiter, frame: can.Message, number: int) -> None:
    """Bus time stays in the interval in which the frame arrived."""
    begin_s = 100.0 + 0.1 * number
    limiter.limit([frame], begin_s, begin_s + rng.choice((0.0, 0.001, 0.1)))
    assert abs(frame.timestamp - (limiter.offset_s + begin_s)) <= 1.0


def check_readable(rng: Random, reader: SocReader, message: can.Message) -> None:
    assert reader.read(message)[1]
    data = bytearray(message.data)
    data[rng.randrange(6)] ^= 1 << rng.randrange(8)
    message.data = bytearray(RULES["generic"].protect(data, rng.randrange(16)))
    reader.read(message)


@cache
def model() -> object:
    return leaf_2012_model_file()


def good_frames(vehicle: Vehicle) -> list[can.Message]:
    encoder = FrameEncoder(vehicle)
    frames: list[can.Message] = []
    for time_s, current_a, voltage_v, temperature_c, soc_pct in log_rows():
        frames.append(clock_frame(round(time_s * 1e6)))
        frames += encoder.encode(Sample(time_s, current_a, voltage_v, temperature_c), soc_pct)
    return frames


def damaged(rng: Random, frame: can.Message, vehicle: Vehicle) -> can.Message:
    """Return a frame with up to two faults, often with a right CRC, which reaches the decoder."""
    data = bytearray(frame.data)
    number, extended = frame.arbitration_id, frame.is_extended_id
    kinds: dict[str, bool] = {}
    for _ in range(rng.choice((0, 0, 1, 1, 2))):
        fault = rng.choice(("byte", "byte", "byte", "short", "long", "id", "kind"))
        if fault == "byte" and data:
            data[rng.randrange(len(data))] = rng.choice((*ODD_BYTES, rng.randrange(256)))
        elif fault == "short":
            data = data[: rng.randrange(9)]
        elif fault == "long":
            data += bytes(rng.randrange(57))
        elif fault == "id":
            ids = ((0, False), (number, True), (0x5A0, False), (0x5A1, False))
            number, extended = rng.choice(ids)
        elif fault == "kind":
            kinds = {rng.choice(("is_error_frame", "is_remote_frame", "is_fd")): True}
    wanted = vehicle.messages.get(number)
    rule = None if wanted is None else wanted.rule
    if rule is not None and rng.randrange(3) and rule.fits(len(data)):
        data = bytearray(rule.protect(data, rng.randrange(16)))
    return can.Message(arbitration_id=number, is_extended_id=extended, data=data, **kinds)
