"""A live service whose frames have impossible stamps: time, freshness, and the recording."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random
from types import SimpleNamespace

import pytest
from simulated import EPOCH_S, GIVEN, SimulatedPort, frames_every, simulate

from cangauge.bus.open import BusAddress
from cangauge.bus.recording import capture_samples
from cangauge.bus.time_source import clock_frame
from cangauge.bus.vehicle import Vehicle
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.offline import estimate_capture
from cangauge.service.pipeline import Pipeline
from cangauge.service.record import Recorder
from cangauge.types import Reason, Sample, Status
from live import LoggedLines, Rows, frames_of, leaf_model, loop_config, short_log

GENERIC = Vehicle.load("generic")
KERNEL = BusAddress("socketcan", "can0")


def run(
    path: Path, seconds: float, stamp: Callable[[float], float]
) -> tuple[Pipeline, list[float], list[SimpleNamespace], list[str]]:
    """Record a service whose frames are stamped by a function of their arrival [s].

    Returns the pipeline, bus time of the samples, published estimates, and lines of the loop. The
    recording gives the same numbers.
    """
    port = SimulatedPort(frames_every(0.02, seconds, stamp=stamp))
    port.address = KERNEL
    pipeline, rows = Pipeline(GENERIC, leaf_model(), GIVEN), Rows([])
    with closing(Recorder(path)) as recorder, LoggedLines("cangauge.service.loop") as logged:
        simulate(port, seconds, pipeline, outputs=[rows, recorder])
    recorded = estimate_capture(path, GENERIC, leaf_model(), GIVEN.estimator).table
    assert recorded.soc_pct.tolist() == [each.soc_pct for _, each in rows.rows]
    assert recorded.reasons.tolist() == [int(each.reasons) for _, each in rows.rows]
    assert recorded.time_s.tolist() == [each.time_s for _, each in rows.rows]
    times = [time_s for time_s, _ in rows.rows]
    return pipeline, times, [content for _, content in port.published], logged.lines


@pytest.mark.parametrize("kind", ["still", "random"])
def test_impossible_stamps_are_replaced_and_reported(kind: str, tmp_path: Path) -> None:
    rng = Random(1)  # noqa: S311 - must be repeatable

    def stamp(at_s: float) -> float:
        return EPOCH_S + (min(at_s, 0.5) if kind == "still" else at_s + rng.uniform(-0.9, 0.9))

    pipeline, times, published, lines = run(tmp_path / "bus.log", 4.0, stamp)
    assert pipeline.taken > 0.9 * pipeline.samples
    assert times[-1] - times[0] == pytest.approx(4.0, abs=0.1)
    assert max(each.age_s for each in published if not math.isnan(each.age_s)) <= 1.0
    last = published[-1]
    assert last.reasons & Reason.TIME_UNCERTAIN
    assert last.status is Status.DEGRADED
    assert not last.reasons & Reason.INPUT_STALE
    assert sum("contradict the monotonic clock" in line for line in lines) == 1


def test_clock_set_in_mid_drive_costs_nothing(tmp_path: Path) -> None:
    def stamp(at_s: float) -> float:
        return EPOCH_S + at_s + (86_400.0 if at_s > 1.0 else 0.0)

    pipeline, times, published, lines = run(tmp_path / "bus.log", 2.5, stamp)
    assert times[-1] - times[0] == pytest.approx(2.5, abs=0.1)
    assert all(two >= one for one, two in pairwise(times))
    reasons = published[-1].reasons
    assert not reasons & (Reason.TIME_UNCERTAIN | Reason.CURRENT_GAP | Reason.INPUT_STALE)
    assert any("was set by +86400.0 s" in line for line in lines)
    # A state refers to the stamps as they come after a restart.
    state = pipeline.snapshot()
    assert state is not None
    later = Pipeline(GENERIC, leaf_model(), GIVEN)
    later.restore(state, 1.0)
    for frame in FrameEncoder(GENERIC).encode(Sample(stamp(3.5), 1.0, 380.0, 20.0)):
        later.handle(frame)
    assert later.taken == 1
    assert not later.latest.reasons & Reason.CURRENT_GAP


def test_samples_that_are_refused_do_not_make_it_fresh() -> None:
    frames = [  # a replay whose clock stands still after a second
        (at_s, message)
        for at_s, frame in frames_every(0.05, 4.0)
        for message in (clock_frame(min(round(at_s * 1e6), 1_000_000)), frame)
    ]
    pipeline = Pipeline(GENERIC, leaf_model(), replace(GIVEN, time_source="replay-clock"))
    settings = loop_config(timeout_s=0.3, duration_s=4.0)
    last = simulate(SimulatedPort(frames), settings, pipeline).published[-1][1]
    assert pipeline.samples > pipeline.taken + 30
    assert last.status is Status.INVALID
    assert last.reasons & Reason.INPUT_STALE
    assert last.age_s >= 1.0


def test_uncertainty_grows_while_no_charge_is_counted() -> None:
    pipeline = Pipeline(GENERIC, leaf_model())
    for each in frames_of(short_log(100.0)):
        pipeline.handle(each)
    published = []
    for silent_s in (0.0, 1.0, 10.0, 60.0):
        pipeline.heartbeat(silent_s, 0.5)
        published.append(pipeline.published.soc_std_pct)
    assert published[0] == pipeline.latest.soc_std_pct
    assert published == sorted(published)
    # A minute of the drive's mean square current.
    assert published[-1] > published[0] + 0.1
    pipeline.heartbeat()
    assert pipeline.published.soc_std_pct == published[0]


def test_two_adapters_in_a_capture_keep_their_own_time(tmp_path: Path) -> None:
    lines = [
        f"({1e9 + each.timestamp + shift_s:.6f}) {bus} {each.arbitration_id:03X}#{each.data.hex()}"
        for each in frames_of(short_log(60.0))
        for bus, shift_s in (("can0", 0.0), ("can1", -3.0))
    ]
    path = tmp_path / "two.log"
    path.write_text("\n".join([*lines, ""]))
    found = estimate_capture(path, GENERIC, leaf_model())
    assert found.recorded.duration_s == pytest.approx(59.9)
    read = capture_samples(path, GENERIC)
    assert read.time_s[-1] - read.time_s[0] == pytest.approx(59.9)
