"""Errors about the values of a capture name what to change in the map file, no column."""

from __future__ import annotations

from pathlib import Path

import can
import numpy as np
import pytest

from cangauge.bus.recording import capture_to_log
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from live import succeeds

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


def write_drive(folder: Path, bits: int, current_a: np.ndarray, kind: str = "+") -> None:
    """Write a capture of a signed current in steps of 0.1 A, and a DBC that states its kind."""
    (folder / "a.dbc").write_text(
        f'BO_ 256 BMS: 8 X\n SG_ PackCurrent : 0|{bits}@1{kind} (0.1,0) [0|0] "A" X\n'
        ' SG_ PackVoltage : 16|16@1+ (0.1,0) [0|0] "V" X\n'
    )
    with can.CanutilsLogWriter(folder / "a.log") as log:
        for row, amps in enumerate(current_a):
            volts = round(10 * (370.0 - 0.1 * min(amps, 500.0)))
            data = (round(10 * amps) % (1 << bits)).to_bytes(2, "little")
            data += volts.to_bytes(2, "little") + bytes(4)
            log(can.Message(0.1 * row, arbitration_id=256, data=data, is_extended_id=False))


DRIVE_A = np.repeat(np.random.default_rng(1).uniform(-90.0, 180.0, 120), 5)


@pytest.mark.parametrize("bits", [16, 15, 12])
def test_a_current_read_unsigned_is_named_with_its_cure(tmp_path: Path, bits: int) -> None:
    amps = 0.2 * DRIVE_A if bits == 12 else DRIVE_A
    write_drive(tmp_path, bits, amps)
    text = 'dbc = "a.dbc"\ncurrent = "PackCurrent"\nvoltage = "PackVoltage"\n'
    text += "temperature.fixed_c = 20\n"
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(InputError, match=r"signed = true under \[current\]") as caught:
        capture_to_log(tmp_path / "a.log", Vehicle.load(map=tmp_path / "a.toml"))
    assert f"just below {0.1 * (1 << bits):.6g} A" in caught.value.problem
    assert caught.value.field == "PackCurrent"
    mended = text.replace('"PackCurrent"', '{ signal = "PackCurrent", signed = true }')
    (tmp_path / "a.toml").write_text(mended)
    log = capture_to_log(tmp_path / "a.log", Vehicle.load(map=tmp_path / "a.toml"))
    assert log.current_a == pytest.approx(amps, abs=0.051)


def test_a_current_of_a_bit_less_than_its_signal_is_named(tmp_path: Path) -> None:
    write_drive(tmp_path, 15, DRIVE_A)
    dbc = (tmp_path / "a.dbc").read_text()
    (tmp_path / "a.dbc").write_text(dbc.replace("0|15@1+", "0|16@1+"))
    (tmp_path / "a.toml").write_text(
        'dbc = "a.dbc"\ncurrent = "PackCurrent"\nvoltage = "PackVoltage"\n'
    )
    car = Vehicle.load(map=tmp_path / "a.toml", temperature_c=20.0)
    with pytest.raises(InputError, match=r"just below 3276\.8 A.*a signed signal of 15 bits"):
        capture_to_log(tmp_path / "a.log", car)


PULSES_A = np.where(np.arange(600) % 40 < 20, 5.0, 350.0) + np.arange(600) % 7


@pytest.mark.parametrize(
    ("bits", "current_a"),
    [(16, np.abs(DRIVE_A)), (16, np.abs(DRIVE_A) + 100.0), (12, PULSES_A)],
    ids=["from zero", "above zero", "pulses"],
)
def test_a_current_that_is_unsigned_is_left_so(
    tmp_path: Path, bits: int, current_a: np.ndarray
) -> None:
    code = (1 << bits) - 1
    current_a = current_a.copy()
    current_a[:3] = 0.1 * code  # not available: three frames of one code
    write_drive(tmp_path, bits, current_a)
    (tmp_path / "a.toml").write_text(
        'dbc = "a.dbc"\nvoltage = "PackVoltage"\ntemperature.fixed_c = 20\n'
        f'[current]\nsignal = "PackCurrent"\nnot_available = [{code}]\n'
    )
    log = capture_to_log(tmp_path / "a.log", Vehicle.load(map=tmp_path / "a.toml"))
    assert log.current_a == pytest.approx(current_a[3:], abs=0.051)


def test_init_writes_that_a_current_is_signed(tmp_path: Path) -> None:
    write_drive(tmp_path, 16, DRIVE_A)
    given = ("--dbc", tmp_path / "a.dbc", "-o", tmp_path / "out")
    done = succeeds("init", tmp_path / "a.log", *given)
    assert "signed = true" in (tmp_path / "out" / "car.toml").read_text(encoding="utf-8")
    assert "signed = true" in done.err
    log = capture_to_log(tmp_path / "a.log", Vehicle.load(map=tmp_path / "out" / "car.toml"))
    assert log.current_a == pytest.approx(DRIVE_A, abs=0.051)
