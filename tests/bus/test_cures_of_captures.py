"""Errors about the values of a capture name what to change in the map file, no column."""

from __future__ import annotations

from pathlib import Path

import can
import pytest

from cangauge.bus.recording import capture_to_log
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError

DBC = """BO_ 256 BMS: 8 X
 SG_ I : 0|16@1- (0.1,0) [0|0] "A" X
 SG_ U : 16|16@1+ ({factor},0) [0|0] "V" X
"""


@pytest.mark.parametrize(
    ("factor", "first", "cure"),
    [(0.1, 65535, r"not_available = \[65535\] under \[voltage\]"),
     (10.0, 4000, r"state scale and offset under \[voltage\] of the map file")],
)  # fmt: skip
def test_the_cure_is_in_the_map_file(tmp_path: Path, factor: float, first: int, cure: str) -> None:
    (tmp_path / "a.dbc").write_text(DBC.format(factor=factor))
    text = 'dbc = "a.dbc"\ncurrent = "I"\nvoltage = "U"\ntemperature.fixed_c = 20\n'
    (tmp_path / "a.toml").write_text(text)
    with can.CanutilsLogWriter(tmp_path / "a.log") as log:
        for row in range(100):
            volts = first if row < 10 else 4000
            data = bytes([10, 0]) + volts.to_bytes(2, "little") + bytes(4)
            log(can.Message(0.1 * row, arbitration_id=256, data=data, is_extended_id=False))
    with pytest.raises(InputError, match=cure) as caught:
        capture_to_log(tmp_path / "a.log", Vehicle.load(map=tmp_path / "a.toml"))
    assert caught.value.field == "U"
    assert "remove the row" not in str(caught.value)
    assert "--columns" not in str(caught.value)
