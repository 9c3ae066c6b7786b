"""Cell voltages in frames: arrays of signals, multiplexed or not, and numbered groups."""

from __future__ import annotations

import math
from pathlib import Path

import can
import pytest

from cangauge._resources import shared_file
from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cells_bus import CAR, CELLS_DBC, cell_frames, numbered_frames

CELLS_V = [round(3.6 + 0.003 * number, 3) for number in range(12)]


def vehicle(folder: Path, cells: str) -> Vehicle:
    (folder / "cells.dbc").write_text(CELLS_DBC)
    (folder / "car.toml").write_text(CAR + cells)
    return Vehicle.load(dbc=shared_file("dbc", "generic_pack.dbc"), map=folder / "car.toml")


ARRAY = '[cells]\nsignal = "CELL_{n}_V"\ncount = 12\n'
GROUPS = (
    '[cells]\nmessage = "CELL_GROUPS"\nindex = "group_number"\ncount = 11\n'
    'signals = ["cell_a", "cell_b", "cell_c"]\n'
)


def after(car: Vehicle, frames: list[can.Message]) -> list[float]:
    decoder = SampleDecoder(car)
    for frame in frames:
        decoder.handle(frame)
    assert decoder.cells is not None
    return decoder.cells.take(frames[-1].timestamp)[0]


def test_a_multiplexed_array_of_signals(tmp_path: Path) -> None:
    car = vehicle(tmp_path, ARRAY)
    assert 0x440 in car.wanted_ids
    assert {"can_id": 0x440, "can_mask": 0x7FF, "extended": False} in car.filters
    assert after(car, cell_frames(CELLS_V)) == pytest.approx(CELLS_V)
    partly = after(car, cell_frames(CELLS_V)[:2])
    assert partly[:6] == pytest.approx(CELLS_V[:6])
    assert all(math.isnan(each) for each in partly[6:])


def test_groups_numbered_by_a_signal(tmp_path: Path) -> None:
    car = vehicle(tmp_path, GROUPS)
    # The last group is filled up: a twelfth cell does not exist.
    assert after(car, numbered_frames(CELLS_V)) == pytest.approx(CELLS_V[:11])
    shifted = vehicle(tmp_path, GROUPS + "first_index = 1\n")
    assert after(shifted, numbered_frames(CELLS_V, first=1)) == pytest.approx(CELLS_V[:11])


def test_old_implausible_and_missing_voltages_are_not_used(tmp_path: Path) -> None:
    car = vehicle(tmp_path, ARRAY + "lowest = 2.5\ntimeout_s = 3\n")
    decoder = SampleDecoder(car)
    assert decoder.cells is not None
    for frame in cell_frames([1.0, math.nan, *CELLS_V[2:]], time_s=10.0):
        decoder.handle(frame)
    volts, times = decoder.cells.take(11.0)
    assert [math.isnan(each) for each in volts[:3]] == [True, True, False]
    assert times[2] == 10.0
    assert decoder.cells.refused == 1
    # Each value is used once, and not once it is old.
    assert all(math.isnan(each) for each in decoder.cells.take(11.5)[0])
    for frame in cell_frames(CELLS_V, time_s=20.0):
        decoder.handle(frame)
    assert all(math.isnan(each) for each in decoder.cells.take(24.0)[0])


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ('[cells]\nsignal = "CELL_{n}_V"\ncount = 13\n', "CELL_13_V"),
        ('[cells]\nsignal = "CELL_V"\ncount = 12\n', "{n}"),
        ('[cells]\nsignal = "CELL_{m}_V"\ncount = 12\n', "{n}"),
        ("[cells]\ncount = 12\n", "either signal"),
        ('[cells]\nindex = "group_number"\ncount = 12\n', "signals and message"),
        (GROUPS.replace("CELL_GROUPS", "NOTHING"), "NOTHING"),
        ('[cells]\nsignal = "CELL_{n}_V"\ncount = 1\n', "count"),
        ('[cells]\nsignal = "CELL_{n}_V"\ncount = 5000\n', "count"),
    ],
)
def test_a_wrong_map_names_the_field(tmp_path: Path, cells: str, words: str) -> None:
    with pytest.raises(InputError) as refused:
        vehicle(tmp_path, cells)
    assert words in str(refused.value)
    assert "cells" in str(refused.value)
