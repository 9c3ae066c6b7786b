"""A PGN that two source addresses send at a time is not mixed."""

from __future__ import annotations

from pathlib import Path

import can
import numpy as np
import pytest

from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.vehicle import Vehicle
from cangauge.types import Reason

DBC = """BO_ 2565867763 HVESSD1: 8 X
 SG_ I : 0|16@1- (0.1,0) [0|0] "A" X
 SG_ U : 16|16@1+ (0.1,0) [0|0] "V" X
"""
MAP = """dbc = "a.dbc"
current = "I"
voltage = "U"
temperature.fixed_c = 20
messages.HVESSD1.j1939 = true
"""


@pytest.mark.parametrize("first", [0xF3, 0xF5])  # as in the DBC, or another
def test_two_packs_are_not_mixed(tmp_path: Path, first: int) -> None:
    (tmp_path / "a.dbc").write_text(DBC)
    (tmp_path / "a.toml").write_text(MAP)
    decoder, times_s = SampleDecoder(Vehicle.load(map=tmp_path / "a.toml")), []
    for time_s in np.arange(0.0, 60.0, 0.1).tolist():
        # The other pack sends from 20 to 30 s; then the first one's address changes.
        own = first if time_s < 45.0 else 0xF7
        for source in (own, 0xF4) if 20.0 <= time_s < 30.0 else (own,):
            amps = 50 if source == 0xF4 else 10
            frame = can.Message(time_s, 0x18F00800 | source, data=[amps, 0, 0xA0, 0x0F, 0, 0, 0, 0])
            if (sample := decoder.handle(frame)) is not None:
                assert sample.current_a == 1.0
                times_s.append(time_s)
        if time_s == pytest.approx(25.0):
            assert decoder.reasons(time_s) & Reason.DUPLICATE_SENDER
    hole = np.diff(times_s) > 1.0
    assert np.array(times_s)[:-1][hole] == pytest.approx([20.0, 44.9])
    assert np.array(times_s)[1:][hole] == pytest.approx([40.0, 55.1], abs=0.3)
