"""What a reader of tables may get wrong without a word: units, doubled names, rows, zones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.logs.read import read_log

ROWS = 600


def table(path: Path, head: str, row: str, rows: int = ROWS) -> Path:
    """Write a table whose rows are a format of their number `k`."""
    lines = [row.format(k=k, ms=20 * k, us=20_000 * k, amps=k % 7) for k in range(rows)]
    path.write_text("\n".join([head, *lines, ""]))
    return path


@pytest.mark.parametrize(("heading", "cell"), [("TimeMS", "{ms}"), ("TimeUS", "{us}")])
def test_a_time_of_milliseconds_or_microseconds_by_its_name(
    tmp_path: Path, heading: str, cell: str
) -> None:
    path = table(tmp_path / "t.csv", f"{heading},Current,Voltage,Temp", cell + ",{amps},360,20")
    assert read_log(path).duration_s == pytest.approx(0.02 * (ROWS - 1))


def test_a_unit_in_the_cells_of_one_probe_is_not_that_of_the_other(tmp_path: Path) -> None:
    path = table(tmp_path / "t.csv", "time [s],current [A],voltage [V],T1,T2",
                 "{k},{amps},360,20 °C,68 °F")  # fmt: skip
    with pytest.raises(InputError):
        read_log(path, columns="temperature=T1+T2")


def test_a_canonical_time_that_wraps_is_not_replaced_by_another_column(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    head = "time_s,current_a,voltage_v,temperature_c,timestamp"
    lines = [f"{k % 300},{k % 7},360,20,{1.7e9 + k}" for k in range(ROWS)]
    path.write_text("\n".join([head, *lines, ""]))
    with pytest.raises(InputError, match="runs backwards at row 301"):
        read_log(path)


@pytest.mark.parametrize("name", ["time_s", "current_a", "soc_pct"])
def test_doubled_canonical_names_are_refused(tmp_path: Path, name: str) -> None:
    head = f"time_s,current_a,voltage_v,temperature_c,soc_pct,{name}"
    path = table(tmp_path / "t.csv", head, "{k},{amps},360,20,50,{k}")
    with pytest.raises(InputError, match=name):
        read_log(path)
    columns = [np.arange(9.0)] * 6
    with pytest.raises(InputError, match=name):
        Log.from_dataframe(pa.Table.from_arrays(list(map(pa.array, columns)), head.split(",")))


def test_rows_in_errors_are_those_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    head = "time_s,current_a,voltage_v,temperature_c"
    stamps = [(k if k < 60 else k - 30) // 5 for k in range(100)]  # each second logged five times
    path.write_text("\n".join([head, *(f"{at},1,360,20" for at in stamps), ""]))
    with pytest.raises(InputError, match="row 61"):
        read_log(path)
