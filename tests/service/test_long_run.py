"""Drives with damaged traffic and twenty `kill -9` of the service, beside the undisturbed drive."""

from __future__ import annotations

import multiprocessing
import os
import signal
from pathlib import Path

import can
import numpy as np
import pytest

import cangauge
from cangauge._resources import shared_file
from cangauge.bus.vehicle import Vehicle
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.types import Estimate, Sample, Status
from restarts import EPOCH_S, EVERY_S, RATE_HZ, ServiceRun, drive

pytestmark = pytest.mark.nightly

FORK = multiprocessing.get_context("fork")
KILLS, SHARE = 20, 0.01
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


def live(  # noqa: PLR0917 - one life of the service
    samples: list[Sample], model: Model, state: Path, begin: int, killed: int | None, out: Path
) -> None:
    """Run the service from a sample on; end it by SIGKILL at another, or write its estimates."""
    rng, encoder = np.random.default_rng(begin), FrameEncoder(Vehicle.load("generic"))
    run = ServiceRun(model, state)
    run.begin(samples[begin].time_s)
    assert run.keeper is not None
    assert run.keeper.restored == (begin > 0)
    found = []
    for number, sample in enumerate(samples[begin:], begin):
        run.now_s = sample.time_s
        for frame in disturbed(encoder.encode(sample), rng):
            run.pipeline.handle(frame)
        estimate = run.pipeline.latest
        found.append((estimate.soc_pct, estimate.status))
        if number == killed:
            os.kill(os.getpid(), signal.SIGKILL)
        if number % int(EVERY_S * RATE_HZ) == 0:
            run.save()
    np.save(out, np.array(found))


def undisturbed(samples: list[Sample], model: Model) -> list[Estimate]:
    """The estimates of the drive as it was."""
    run, encoder = ServiceRun(model, None), FrameEncoder(Vehicle.load("generic"))
    return [run.handle(sample, encoder) for sample in samples]


@pytest.fixture(params=["simulated", "TripA08", "TripB06", "TripB19"])
def samples_and_model(request: pytest.FixtureRequest) -> tuple[list[Sample], Model]:
    """A drive of hours of the published model, or a recorded one of an i3, at 10 Hz."""
    if request.param == "simulated":
        model = Model.load(shared_file("replay", "leaf2012_published_model.json"))
        return drive(2.0 * 3600.0, model, 5), model
    folder: Path = request.getfixturevalue("shared_data") / "bmw_i3"
    known = [folder / f"Trip{name}.csv.gz" for name in ("A01", "A04", "A09", "B03", "B17")]
    model = cangauge.fit(known, capacity_ah="from-soc", cells=96).model
    log = cangauge.read_log(folder / f"{request.param}.csv.gz")
    time_s = EPOCH_S + log.time_s - log.time_s[0]
    columns = (time_s, log.current_a, log.voltage_v, log.temperature_c)
    return [Sample(*row) for row in zip(*(each.tolist() for each in columns), strict=True)], model


def test_a_drive_with_twenty_kills(
    samples_and_model: tuple[list[Sample], Model], tmp_path: Path
) -> None:
    samples, model = samples_and_model
    rng, out = np.random.default_rng(5), tmp_path / "found.npy"
    ends = len(samples) - int(600.0 * RATE_HZ)
    kills = sorted(rng.choice(np.arange(1000, ends), KILLS, replace=False).tolist())
    begin = 0
    for killed in (*kills, None):
        process = FORK.Process(
            target=live, args=(samples, model, tmp_path / "state.json", begin, killed, out)
        )
        process.start()
        process.join()
        assert process.exitcode == (0 if killed is None else -signal.SIGKILL)
        begin = begin if killed is None else killed + 1
    whole = undisturbed(samples, model)[begin:]
    soc_pct, status = np.load(out).T
    since_s = (np.arange(soc_pct.size) + 1) / RATE_HZ
    apart = np.array([found - true.soc_pct for found, true in zip(soc_pct, whole, strict=True)])
    apart /= np.array([true.soc_std_pct for true in whole])
    # Where the undisturbed run is VALID within the time, so is the other.
    if any(true.status == Status.VALID for true in whole[: int(VALID_AGAIN_S * RATE_HZ)]):
        assert since_s[status == Status.VALID][0] <= VALID_AGAIN_S
    assert np.abs(apart[since_s > VALID_AGAIN_S]).max() <= LARGEST_STD
