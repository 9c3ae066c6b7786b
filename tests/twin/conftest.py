"""Packs and days that several tests of the twin share."""

from __future__ import annotations

import numpy as np
import pytest

from cangauge.validation.twin.day import Day, draw_day
from cangauge.validation.twin.pack import Pack, draw_pack
from cangauge.validation.twin.plant import TwinPlant


@pytest.fixture(scope="session")
def pack() -> Pack:
    """A 96-cell pack whose sensors send once a second."""
    for seed in range(100):
        found = draw_pack(np.random.default_rng(seed), "leaf24")
        if found.sensors.rate_hz == 1.0:
            return found
    pytest.fail("no pack sends once a second")


@pytest.fixture(scope="session")
def plant(pack: Pack) -> TwinPlant:
    return TwinPlant(pack)


@pytest.fixture(scope="session")
def day(pack: Pack) -> Day:
    """A drive from 90 % in cool weather, long enough to come down to a tenth."""
    return draw_day(
        np.random.default_rng(3),
        pack,
        hours=1.6,
        ambient_c=4.0,
        start_soc=0.9,
        end_soc=0.10,
        discharge=True,
    )


def constant_day(
    current_a: np.ndarray, *, start_soc: float = 0.6, celsius: float = 25.0, step_s: float = 0.5
) -> Day:
    """A day of one given current, at one temperature."""
    time_s = np.arange(current_a.size) * step_s
    return Day(time_s, current_a, np.full_like(time_s, celsius), celsius, start_soc, seed=1)
