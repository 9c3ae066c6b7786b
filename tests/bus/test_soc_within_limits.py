"""A car's own SoC outside 0–100 % is a code, and no start."""

from __future__ import annotations

from pathlib import Path

import can
import pytest

from cangauge.bus.recording import capture_to_log
from cangauge.bus.vehicle import Vehicle

DBC = """BO_ 256 BMS: 8 X
 SG_ I : 0|16@1- (0.1,0) [0|0] "A" X
 SG_ U : 16|16@1+ (0.1,0) [0|0] "V" X
 SG_ Z : 32|8@1+ (0.4,0) [0|0] "%" X
"""
MAP = 'dbc = "a.dbc"\ncurrent = "I"\nvoltage = "U"\ntemperature.fixed_c = 20\n[soc]\nsignal = "Z"\n'


@pytest.mark.parametrize(
    ("stated", "first_pct"), [("", 70.0), ("highest = 110\n", 102.0), ("lowest = 71\n", None)]
)
def test_a_code_above_100_is_no_soc(tmp_path: Path, stated: str, first_pct: float | None) -> None:
    (tmp_path / "a.dbc").write_text(DBC)
    (tmp_path / "a.toml").write_text(MAP + stated)
    with can.CanutilsLogWriter(tmp_path / "a.log") as log:
        for row in range(200):
            code = 255 if row < 50 else 175  # 102 %, then 70 %
            data = bytes([10 * (row % 7), 0, 0xA0, 0x0F, code, 0, 0, 0])
            log(can.Message(timestamp=0.1 * row, arbitration_id=256, data=data,
                            is_extended_id=False))  # fmt: skip
    log = capture_to_log(tmp_path / "a.log", Vehicle.load(map=tmp_path / "a.toml"))
    known = [] if log.soc_pct is None else log.soc_pct[log.soc_pct == log.soc_pct].tolist()
    assert (known[0] if known else None) == first_pct
    refused = [each for each in log.remarks if "outside their limits" in each]
    assert bool(refused) is (first_pct != 102.0)
