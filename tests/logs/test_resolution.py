"""A signed current that was read as unsigned is found, and no other current is."""

from __future__ import annotations

from pathlib import Path

import can
import numpy as np
import pytest

from cangauge.bus.recording import capture_to_log, read_log
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.logs.resolution import wrapped_current

ROWS = 1200
DBC = """VERSION ""
BU_: BMS
BO_ 256 PACK: 4 BMS
 SG_ I : 0|16@1+ (0.1,0) [0|6553.5] "A" BMS
 SG_ U : 16|16@1+ (0.1,0) [0|1000] "V" BMS
"""
MAP = """dbc = "pack.dbc"
[current]
signal = "I"
[voltage]
signal = "U"
"""


def drive(seed: int, lowest_a: float, highest_a: float) -> tuple[np.ndarray, np.ndarray]:
    """Return current [A], with rests, and voltage [V] of a drive."""
    rng = np.random.default_rng(seed)
    load = np.repeat(rng.uniform(lowest_a, highest_a, ROWS // 10), 10)
    load[:20] = load[600:640] = 0.0
    current = load + np.where(load, rng.normal(0.0, 1.0, ROWS), 0.0)
    voltage = 380.0 - 0.1 * current - 0.001 * np.cumsum(current) / 36.0
    return current, np.round(voltage + rng.normal(0.0, 0.05, ROWS), 1)


def wrapped(current: np.ndarray, bits: int, step_a: float) -> np.ndarray:
    """Return a current as it is read from a field without a sign."""
    codes = np.round(current / step_a).astype(np.int64)
    return np.mod(codes, 1 << bits) * step_a


@pytest.mark.parametrize(
    ("bits", "step_a"), [(16, 0.01), (16, 0.1), (15, 0.1), (15, 0.02), (32, 0.001), (12, 0.5)]
)
@pytest.mark.parametrize("lowest_a", [-60.0, -150.0])
@pytest.mark.parametrize("highest_a", [150.0, 30.0])
def test_where_a_current_wraps(bits: int, step_a: float, lowest_a: float, highest_a: float) -> None:
    for sign in (1.0, -1.0):
        current, voltage = drive(bits, lowest_a, highest_a)
        found = wrapped_current(wrapped(sign * current, bits, step_a), voltage)
        assert found is not None
        assert found[0] == pytest.approx(2**bits * step_a)


@pytest.mark.parametrize("seed", range(20))
def test_no_current_of_one_sign_wraps(seed: int) -> None:
    current, voltage = drive(seed, 0.0, 40.0 + 20.0 * seed)
    assert wrapped_current(np.abs(current), voltage) is None
    assert wrapped_current(-np.abs(current), voltage) is None
    constant = np.where(np.arange(ROWS) % 60 < 30, 65.4, 0.0)
    assert wrapped_current(constant, 3.6 - 0.002 * constant) is None


def test_three_rows_prove_no_wrap() -> None:
    assert wrapped_current(np.array([980.0, 802.0, 1959.0]), np.array([1.0, 2.0, 2.0])) is None


@pytest.mark.parametrize("wraps_at_a", [32.768, 65.536, 655.36])
def test_a_load_that_only_comes_near_a_fields_end_does_not_wrap(wraps_at_a: float) -> None:
    current = np.random.default_rng(4).uniform(0.55 * wraps_at_a, 0.99 * wraps_at_a, ROWS)
    assert wrapped_current(current, 3.6 - 0.002 * current) is None
    charge = np.mod(-np.round(current[::-1] - 0.54 * wraps_at_a, 2), 655.36)
    assert wrapped_current(charge, 3.6 + 0.002 * current) is not None


def test_a_table_whose_current_wraps_is_refused(tmp_path: Path) -> None:
    current, voltage = drive(1, -150.0, 60.0)
    rows = zip(wrapped(current, 16, 0.1), voltage, strict=True)
    lines = [f"{k},{i:.1f},{u:.1f},21" for k, (i, u) in enumerate(rows)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["Time [s],Current [A],Voltage [V],Temp [C]", *lines, ""]))
    with pytest.raises(InputError, match=r"wraps at 6553\.6 A \(16 bits unsigned of 0\.1 A\)"):
        read_log(path)


def test_a_map_whose_current_wraps_is_refused_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "pack.dbc").write_text(DBC)
    (tmp_path / "car.toml").write_text(MAP)
    current, voltage = drive(2, -150.0, 60.0)
    with can.Logger(tmp_path / "drive.log") as writer:
        for k, (i, u) in enumerate(zip(current, voltage, strict=True)):
            data = round(10.0 * i).to_bytes(2, "little", signed=True)
            data += round(10.0 * u).to_bytes(2, "little")
            writer(can.Message(timestamp=float(k), arbitration_id=256, is_extended_id=False,
                               data=data))  # fmt: skip
    car = Vehicle.load(map=tmp_path / "car.toml", temperature_c=20.0)
    with pytest.raises(InputError, match=r"6553\.6 A") as caught:
        capture_to_log(tmp_path / "drive.log", car)
    assert caught.value.cure == "state signed = true under [current] of the map file"
