"""A pack and a drive shared by tests of the twin."""

from __future__ import annotations

import numpy as np
import pytest

from cangauge.extras.validation.twin.drive import Drive, draw_drive
from cangauge.extras.validation.twin.pack import TwinPack, draw_pack


@pytest.fixture(scope="session")
def pack() -> TwinPack:
    """A 96-cell pack with a sampling rate of 1 Hz."""
    for seed in range(100):
        found = draw_pack(np.random.default_rng(seed), "leaf24")
        if found.sensors.rate_hz == 1.0:
            return found
    pytest.fail("no pack with a rate of 1 Hz")


@pytest.fixture(scope="session")
def drive(pack: TwinPack) -> Drive:
    """A cool drive from 90 % to 10 % SoC."""
    return draw_drive(
        np.random.default_rng(3),
        pack,
        hours=1.6,
        ambient_c=4.0,
        start_soc_pct=90,
        end_soc_pct=10,
        discharge=True,
    )
