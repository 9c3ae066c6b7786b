"""Logs from and to tables in memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from log_strategies import logs

from cangauge.errors import InputError
from cangauge.logs.log import Log

CHANNELS = ("time_s", "current_a", "voltage_v", "temperature_c", "soc_pct")


def assert_same(back: Log, log: Log) -> None:
    for channel in CHANNELS:
        if getattr(log, channel) is None:
            assert getattr(back, channel) is None
        else:
            np.testing.assert_array_equal(getattr(back, channel), getattr(log, channel))


@settings(max_examples=60)
@given(log=logs())
def test_an_arrow_table_gives_the_log_back(log: Log) -> None:
    back = Log.from_dataframe(log.to_arrow())
    assert_same(back, log)
    assert back.temperature_source == log.temperature_source
    assert back.remarks == ()


def test_a_log_is_itself_a_table(small_log: Log) -> None:
    table = pa.table(small_log)
    assert table.column_names == list(CHANNELS)
    assert table.column("soc_pct").null_count == 1
    assert_same(Log.from_dataframe(small_log), small_log)


@pytest.mark.parametrize(
    ("package", "convert"), [("pandas", Log.to_pandas), ("polars", Log.to_polars)]
)
def test_dataframes_give_the_log_back(
    small_log: Log, package: str, convert: Callable[[Log], Any]
) -> None:
    library = pytest.importorskip(package)
    frame = convert(small_log)
    assert isinstance(frame, library.DataFrame)
    assert list(frame.columns) == list(CHANNELS)
    back = Log.from_dataframe(frame, name="drive", temperature_source="pack")
    assert_same(back, small_log)
    assert (back.name, back.temperature_source, back.remarks) == ("drive", "pack", ())


@pytest.mark.parametrize("package", ["pandas", "polars"])
def test_dataframes_of_other_types_and_columns(package: str) -> None:
    library = pytest.importorskip(package)
    frame = library.DataFrame(
        {
            "Voltage_V": [380, 379, 378],
            "driver": ["a", "b", "c"],
            "TIME_S": [0, 1, 2],
            "current_A": [1.5, 2.5, 3.5],
            "temperature_source": ["cell"] * 3,
        }
    )
    log = Log.from_dataframe(frame, temperature_c=21.0)
    np.testing.assert_array_equal(log.voltage_v, [380.0, 379.0, 378.0])
    assert set(log.temperature_c) == {21.0}
    assert "1 other column ignored: driver" in log.remarks


def test_a_pandas_index_is_no_column(small_log: Log) -> None:
    pytest.importorskip("pandas")
    log = Log.from_dataframe(small_log.to_pandas().iloc[::2])
    assert len(log) == 4
    assert log.remarks == ()


@pytest.mark.parametrize("package", ["pandas", "polars"])
def test_an_absent_package_is_named(
    small_log: Log, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(InputError, match=f"{package} is not installed.*pip install {package}"):
        getattr(small_log, f"to_{package}")()


def table(**columns: object) -> pa.Table:
    rows = {
        "time_s": [0.0, 1.0, 2.0],
        "current_a": [1.0, 2.0, 3.0],
        "voltage_v": [380.0, 379.0, 378.0],
        "temperature_c": [20.0, 20.0, 20.0],
    }
    return pa.table({name: values for name, values in (rows | columns).items() if values})


@pytest.mark.parametrize(
    ("columns", "field", "words"),
    [
        ({"current_a": None}, "current_a", "this column is missing"),
        ({"temperature_c": None}, "temperature_c", "holds no temperature"),
        ({"current_a": [1.0, None, 3.0]}, "current_a", "row 2 holds no number"),
        ({"current_a": [1.0, 2.0, float("inf")]}, "current_a", "row 3 holds no number"),
        ({"current_a": ["1", "two", "3"]}, "current_a", "does not hold numbers"),
        ({"current_a": [True, False, True]}, "current_a", "does not hold numbers"),
        ({"time_s": [0.0, 2.0, 1.0]}, "time_s", "backwards at row 3"),
        ({"voltage_v": [380e3, 379e3, 378e3]}, "voltage_v", "millivolts"),
        ({"Current_A": [1.0, 2.0, 3.0]}, "current_a", "2 columns have this name"),
        ({"temperature_source": ["oven"] * 3}, "temperature_source", "not a known temperature"),
    ],
)
def test_errors_name_column_and_row(columns: dict[str, object], field: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        Log.from_dataframe(table(**columns), name="drive")
    assert caught.value.field == field
    assert caught.value.source == "drive"


def test_labels_are_those_of_the_table() -> None:
    columns = {"current_a": None, "Current_A": [1.0, None, 3.0]}
    with pytest.raises(InputError, match="Current_A: row 2"):
        Log.from_dataframe(table(**columns))


def test_repeated_stamps_are_dropped_with_a_remark() -> None:
    log = Log.from_dataframe(table(time_s=[0.0, 1.0, 1.0]))
    assert len(log) == 2
    assert any("time stamp of the row before dropped" in remark for remark in log.remarks)


def test_an_empty_table_is_refused() -> None:
    with pytest.raises(InputError, match="no rows"):
        Log.from_dataframe(table().slice(0, 0))


def test_what_is_no_table_is_a_type_error() -> None:
    with pytest.raises(TypeError):
        Log.from_dataframe(7)
