"""A drive of hours with damaged traffic and twenty kills of the service, beside the whole drive.

A kill here is the end of a pipeline of which only the state file is used again;
`benchmarks/restarts.py` ends processes by SIGKILL.
"""

from __future__ import annotations

from pathlib import Path

import can
import numpy as np
import pytest

from cangauge._resources import shared_file
from cangauge.bus.vehicle import Vehicle
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.types import Status
from restarts import EPOCH_S, EVERY_S, RATE_HZ, ServiceRun, drive

pytestmark = [pytest.mark.slow, pytest.mark.nightly]

HOURS, KILLS, SHARE = 2.0, 20, 0.01
"""Share of the frames that is dropped, doubled, and swapped with the next, each."""
VALID_AGAIN_S = 300.0
LARGEST_STD = 1.5
"""Largest distance from the undisturbed run, in its standard deviations."""


def disturbed(frames: list[can.Message], rng: np.random.Generator) -> list[can.Message]:
    """Return frames of which some are dropped, doubled or swapped."""
    drawn = rng.uniform(size=len(frames))
    found = [
        frame
        for frame, at in zip(frames, drawn, strict=True)
        if at >= SHARE
        for _ in range(2 if at < 2 * SHARE else 1)
    ]
    if len(found) > 1 and rng.uniform() < SHARE * len(frames):
        found[-2:] = found[:-3:-1]
    return found


def test_a_long_drive_with_twenty_kills(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    model = Model.load(shared_file("replay", "leaf2012_published_model.json"))
    samples = drive(HOURS * 3600.0, model, 5)
    ends = len(samples) - int(600.0 * RATE_HZ)
    kills = set(rng.choice(np.arange(1000, ends), KILLS, replace=False).tolist())
    one, two = (FrameEncoder(Vehicle.load("generic")) for _ in range(2))
    path = tmp_path / "state.json"
    whole, life = ServiceRun(model, None), ServiceRun(model, path)
    life.begin(EPOCH_S)
    apart: list[float] = []
    valid_s: list[float] = []
    for number, sample in enumerate(samples):
        truth = whole.handle(sample, one)
        life.now_s = sample.time_s
        for frame in disturbed(two.encode(sample), rng):
            life.pipeline.handle(frame)
        found = life.pipeline.latest
        if number % int(EVERY_S * RATE_HZ) == 0:
            life.save()
        if number in kills:
            life = ServiceRun(model, path)
            life.begin(sample.time_s)
            assert life.keeper is not None
            assert life.keeper.restored
        since_s = (number - max(kills)) / RATE_HZ
        if since_s > 0.0 and found.status == Status.VALID:
            valid_s.append(since_s)
        if since_s > VALID_AGAIN_S:
            apart.append(abs(found.soc_pct - truth.soc_pct) / truth.soc_std_pct)
    assert min(valid_s) <= VALID_AGAIN_S
    # The drive's current leaves the model's range at times.
    assert valid_s[-1] > (len(samples) - 1 - max(kills)) / RATE_HZ - VALID_AGAIN_S
    assert max(apart) <= LARGEST_STD
