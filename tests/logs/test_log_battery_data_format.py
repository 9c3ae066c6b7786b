"""Battery Data Format: both spellings, written and read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.logs.read import read_log

CELL = Log(
    time_s=np.arange(200.0),
    current_a=np.where(np.arange(200) % 20 < 10, 2.0, 0.0),
    voltage_v=np.where(np.arange(200) % 20 < 10, 3.6, 3.7),
    temperature_c=np.full(200, 25.5),
    temperature_source="cell",
)


@pytest.mark.parametrize("name", ["cell.bdf", "cell.bdf.csv"])
def test_written_and_read_back_exactly(tmp_path: Path, name: str) -> None:
    write_log(CELL, tmp_path / name)
    header = (tmp_path / name).read_text().splitlines()[0]
    assert header == "Test Time / s,Voltage / V,Current / A,Surface Temperature T1 / degC"
    log = read_log(tmp_path / name)
    for field in ("time_s", "current_a", "voltage_v", "temperature_c"):
        assert np.array_equal(getattr(log, field), getattr(CELL, field)), field
    assert (log.name, log.temperature_source) == ("cell", "cell")
    assert "current negated: Battery Data Format stores discharge as negative" in log.remarks


def test_the_room_is_used_where_no_sensor_is_filled(tmp_path: Path) -> None:
    path = tmp_path / "InstitutionCode__A0001__20241031_001.bdf.csv"
    head = (
        "Test Time / s,Voltage / V,Current / A,Unix Time / s,Ambient Temperature / degC,"
        "Surface Temperature T1 / degC\n"
    )
    path.write_text(head + "".join(f"{k},3.7,-1.5,{1.7e9 + k},23.0,\n" for k in range(5)))
    log = read_log(path)
    assert (log.temperature_c[0], log.temperature_source) == (23.0, "room")
    assert log.current_a[0] == 1.5


@pytest.mark.parametrize(
    "head",
    [
        "test_time_second,voltage_volt,current_ampere,cycle_count,temperature_t1_celsius\n",
        "test_time_s,voltage_v,current_a,cycle_index,temperature_t1_deg_c\n",
    ],
)
def test_machine_readable_names(tmp_path: Path, head: str) -> None:
    path = tmp_path / "x.csv"
    path.write_text(head + "".join(f"{k},3.7,-1.5,1,24.0\n" for k in range(5)))
    log = read_log(path)
    assert (log.current_a[0], log.temperature_c[0]) == (1.5, 24.0)


def test_a_missing_value_names_row_and_column(tmp_path: Path) -> None:
    path = tmp_path / "x.bdf"
    path.write_text(
        "Test Time / s,Voltage / V,Current / A,Surface Temperature T1 / degC\n"
        "0,3.7,1,20\n1,3.7,oops,20\n"
    )
    with pytest.raises(InputError, match=r"x\.bdf: Current / A: row 2 is not a number.*oops"):
        read_log(path)
