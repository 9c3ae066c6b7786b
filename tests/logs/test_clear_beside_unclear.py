"""A table of which only one reading makes a log is read; an unclear column beside it is not."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import cangauge
from cangauge.logs.log import Log
from cangauge.logs.read import open_log

ROWS = 180


def table(path: Path, head: str, row: Callable[[int], str]) -> Log:
    path.write_text("\n".join([head, *map(row, range(ROWS))]) + "\n", encoding="utf-8")
    return cangauge.read_log(path)


def values(k: int) -> str:
    return f"{10 * math.sin(k / 7):.2f};{380 - 0.3 * math.sin(k / 7):.2f};25.5"


@pytest.mark.parametrize("time", ["{h}:{m:02d} PM", "{h:02d}:{m:02d} AM", "1d {h:02d}:{m:02d}"])
def test_only_a_clock_has_halves_and_days(time: str, tmp_path: Path) -> None:
    log = table(
        tmp_path / "clock.csv",
        "Time;Current [A];Voltage [V];Temperature [°C]",
        lambda k: f"{time.format(h=1 + k // 60, m=k % 60)};{values(k)}",
    )
    assert np.all(np.diff(log.time_s) == 60.0)


@pytest.mark.parametrize("empty", [50, ROWS - 1])
def test_an_empty_time_tells_no_clock(empty: int, tmp_path: Path) -> None:
    with pytest.raises(cangauge.InputError, match="hours and minutes, or minutes and seconds"):
        table(
            tmp_path / "clock.csv",
            "Time;Current [A];Voltage [V];Temperature [°C]",
            lambda k: f"{'' if k == empty else f'{5 + k // 60:02d}:{k % 60:02d}'};{values(k)}",
        )


@pytest.mark.parametrize("extra", ["Capacity [mAh]", "Step", "Status code"])
def test_an_unclear_column_beside_the_log_is_left_out(extra: str, tmp_path: Path) -> None:
    log = table(
        tmp_path / "beside.csv",
        f"Time [s];Current [A];Voltage [V];Temperature [°C];SoC [%];Mode;{extra}",
        lambda k: (
            f"{k};{abs(round(20 * math.sin(k / 7)))};380;25;{90 - k // 60};"
            f"{'charge' if math.sin(k / 7) < 0 else 'discharge'};1,{200 + k}"
        ),
    )
    assert len(log) == ROWS


def test_the_reading_that_is_taken_is_said(tmp_path: Path) -> None:
    log = table(
        tmp_path / "marks.csv",
        "Time [s];Current [mA];Voltage [mV];Temperature [°C]",
        lambda k: f"{k};{round(100 * math.sin(k / 7))};3,{800 + k};25",
    )
    assert log.voltage_v[0] == pytest.approx(3.8)
    assert any("the mark in 3,800 separates thousands" in remark for remark in log.remarks)


def test_parquet_is_read_like_csv(tmp_path: Path) -> None:
    columns = {
        "Time [s]": [str(k) for k in range(ROWS)],
        "Current [mA]": [str(round(100 * math.sin(k / 7))) for k in range(ROWS)],
        "Voltage [mV]": [f"3,{800 + k}" for k in range(ROWS)],
    }
    pq.write_table(pa.table(columns), tmp_path / "marks.parquet")
    log = cangauge.read_log(tmp_path / "marks.parquet", temperature_c=25.0)
    assert log.voltage_v[0] == pytest.approx(3.8)


@pytest.mark.parametrize(
    ("pack", "cell_v"), [("Voltage [V];{v:.2f}", 3.801), ("Voltage [mV];7,{mv}", 3801.0)]
)
def test_cells_have_the_decimal_mark_of_their_log(pack: str, cell_v: float, tmp_path: Path) -> None:
    heading, _, voltage = pack.partition(";")
    head = f"Time [s];Current [mA];{heading};Temperature [°C];Cell 1 [V];Cell 2 [V]"
    rows = [
        f"{k};{round(100 * math.sin(k / 7))};"
        f"{voltage.format(v=7.6 + 0.01 * (k % 7), mv=600 + k)};25;3,{800 + k};3,{801 + k}"
        for k in range(ROWS)
    ]
    path = tmp_path / "cells.csv"
    path.write_text("\n".join([head, *rows, ""]).replace(".", ","), encoding="utf-8")
    file = open_log(path)
    cells = file.cells(file.read().time_s)
    assert cells is not None
    assert cells.voltage_v[0, 1] == pytest.approx(cell_v)


def test_a_slow_series_tells_no_daylight_saving_time(tmp_path: Path) -> None:
    def lines(k: int) -> str:
        at = f"2024-03-13 {10 + k // 360:02d}:{k // 6 % 60:02d}:{10 * (k % 6):02d}"
        rows = [
            f"{at};current [A];{10 * math.sin(k):.2f}",
            f"{at};voltage [V];{380 - math.sin(k):.2f}",
        ]
        return "\n".join([*rows, f"{at};temperature [°C];20.5"][: 3 if k % 360 == 0 else 2])

    path = tmp_path / "long.csv"
    path.write_text("\n".join(["time;name;value", *map(lines, range(1440))]), encoding="utf-8")
    log = cangauge.read_log(path)
    assert len(log) > ROWS
    assert not any("daylight" in remark for remark in log.remarks)
