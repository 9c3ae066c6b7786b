"""Canonical logs: they read back exactly; errors name the column and row."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from log_strategies import logs

from cangauge.errors import InputError
from cangauge.logs.canonical import write_log, write_table
from cangauge.logs.log import Log
from cangauge.logs.read import read_log

CSV = "time_s,current_a,voltage_v,temperature_c\n0.0,1.5,380.0,20\n0.1,-2.5,381.0,20.5\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8", newline="")
    return path


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(log=logs(), suffix=st.sampled_from([".parquet", ".csv"]))
def test_what_is_written_reads_back_exactly(log: Log, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"log{suffix}"
    write_log(log, path)
    back = read_log(path)
    for channel in ("time_s", "current_a", "voltage_v", "temperature_c"):
        np.testing.assert_array_equal(getattr(back, channel), getattr(log, channel))
    if log.soc_pct is None:
        assert back.soc_pct is None
    else:
        np.testing.assert_array_equal(back.soc_pct, log.soc_pct)
    assert back.temperature_source == log.temperature_source
    assert back.name == "log"
    assert not [text for text in back.remarks if not text.startswith("current looks inverted")]


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_delimiters_case_blanks_and_quotes(tmp_path: Path, delimiter: str) -> None:
    text = CSV.replace("current_a", ' "Current_A"').replace("voltage_v", "voltage_V ")
    log = read_log(write(tmp_path / "x.txt", text.replace(",", delimiter)))
    np.testing.assert_array_equal(log.current_a, [1.5, -2.5])
    np.testing.assert_array_equal(log.temperature_c, [20.0, 20.5])
    assert log.soc_pct is None


def test_decimal_comma_with_semicolons(tmp_path: Path) -> None:
    log = read_log(write(tmp_path / "x.csv", CSV.replace(",", ";").replace(".", ",")))
    np.testing.assert_array_equal(log.time_s, [0.0, 0.1])
    np.testing.assert_array_equal(log.voltage_v, [380.0, 381.0])


def test_byte_order_mark_and_utf16_of_spreadsheets(tmp_path: Path) -> None:
    for encoding in ("utf-8-sig", "utf-16"):
        path = tmp_path / f"{encoding}.csv"
        path.write_bytes(CSV.encode(encoding))
        assert len(read_log(path)) == 2


def test_content_decides_not_the_suffix(tmp_path: Path, small_log: Log) -> None:
    write_log(small_log, tmp_path / "log.parquet")
    disguised = tmp_path / "log.csv"
    disguised.write_bytes(gzip.compress((tmp_path / "log.parquet").read_bytes()))
    assert len(read_log(disguised)) == len(small_log)


def test_extra_columns_are_ignored_with_a_remark(tmp_path: Path) -> None:
    lines = CSV.splitlines()
    text = "\n".join(f"{a},{b}" for a, b in zip(lines, ["speed", "3", "fast"], strict=True)) + "\n"
    log = read_log(write(tmp_path / "x.csv", text))
    assert log.remarks == ("1 other column ignored: speed",)


def test_soc_may_be_missing_anywhere(tmp_path: Path) -> None:
    rows = ["time_s,current_a,voltage_v,temperature_c,soc_pct"]
    rows += [f"{k},1,380,20,{soc}" for k, soc in enumerate(["", "NaN", "80", "null", "79.5"])]
    log = read_log(write(tmp_path / "x.csv", "\n".join(rows) + "\n"))
    np.testing.assert_array_equal(log.soc_pct, [np.nan, np.nan, 80.0, np.nan, 79.5])
    assert log.first_soc() == (2, 80.0)


def test_same_stamps_are_dropped_with_a_remark(tmp_path: Path) -> None:
    text = CSV + "0.1,9,999,20\n0.1,9,999,20\n0.2,3,380,20\n"
    log = read_log(write(tmp_path / "x.csv", text))
    np.testing.assert_array_equal(log.time_s, [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(log.current_a, [1.5, -2.5, 3.0])  # the first of them stays
    assert "2 rows with the time stamp of the row before dropped (the first is row 3)" in (
        log.remarks
    )


@pytest.mark.parametrize(
    ("row", "field", "words", "value"),
    [
        ("-0.5,1,380,20", "time_s", "time runs backwards at row 3", -0.5),
        ("0.2,,380,20", "current_a", "row 3 holds no number", None),
        ("0.2,1,NaN,20", "voltage_v", "row 3 holds no number", None),
        ("0.2,1,380,inf", "temperature_c", "row 3 holds no number", None),
        ("0.2,1,abc,20", "voltage_v", "row 3 is not a number", "abc"),
        ("0.2,1,380,20,7", None, "row 3 has 5 cells where the others have 4", None),
    ],
)
def test_a_bad_row_is_named(
    tmp_path: Path, row: str, field: str | None, words: str, value: object
) -> None:
    path = write(tmp_path / "x.csv", f"{CSV}{row}\n0.3,1,380,20\n")
    with pytest.raises(InputError, match=words) as caught:
        read_log(path)
    assert caught.value.source == str(path)
    assert caught.value.field == field
    assert caught.value.cure
    if value is not None:
        assert caught.value.value == value


def test_a_last_line_that_was_cut_is_left_out_with_a_remark(tmp_path: Path) -> None:
    log = read_log(write(tmp_path / "x.csv", CSV + "0.2,1"))
    assert len(log) == 2
    assert any("last line is cut off" in text for text in log.remarks)
    whole = read_log(write(tmp_path / "x.csv", CSV.rstrip("\n")))
    assert len(whole) == 2
    assert any("no line end" in text for text in whole.remarks)


def test_missing_and_double_columns_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"voltage_v: this column is missing.*voltage_mv"):
        read_log(write(tmp_path / "x.csv", CSV.replace("voltage_v", "voltage_mv")))
    with pytest.raises(InputError, match="current_a: 2 columns have this name"):
        read_log(write(tmp_path / "x.csv", CSV.replace("voltage_v", "current_A")))
    with pytest.raises(InputError, match="there are no rows below the header"):
        read_log(write(tmp_path / "x.csv", CSV.splitlines()[0] + "\n"))


def test_a_temperature_can_be_given_where_the_file_has_none(tmp_path: Path) -> None:
    text = "\n".join(line.rpartition(",")[0] for line in CSV.splitlines()) + "\n"
    path = write(tmp_path / "x.csv", text)
    with pytest.raises(InputError, match=r"temperature_c: the file holds no temperature .*--temp"):
        read_log(path)
    log = read_log(path, temperature_c=-5.0, temperature_source="pack")
    np.testing.assert_array_equal(log.temperature_c, [-5.0, -5.0])
    assert log.temperature_source == "pack"
    assert "temperature -5 °C as given" in log.remarks


def test_temperature_source_words_are_checked(tmp_path: Path) -> None:
    rows = [
        f"{a},{b}"
        for a, b in zip(CSV.splitlines(), ["Temperature_Source", "Room", ""], strict=True)
    ]
    assert read_log(write(tmp_path / "x.csv", "\n".join(rows) + "\n")).temperature_source == "room"
    for word, words in (
        ("oven", "not a known temperature"),
        ("pack", "one word throughout"),
    ):
        text = "\n".join([*rows, f"0.2,1,380,20,{word}"] if word == "pack" else rows)
        with pytest.raises(InputError, match=words):
            read_log(write(tmp_path / "x.csv", text.replace("Room", word, word != "pack") + "\n"))
    with pytest.raises(InputError, match="not a known temperature"):
        read_log(tmp_path / "x.csv", temperature_source="oven")  # type: ignore[arg-type]  # on purpose


def test_parquet_of_other_types(tmp_path: Path) -> None:
    columns = {
        "time_s": pa.array([0, 1], pa.int64()),
        "current_A": pa.array([1.0, 2.0], pa.float32()),
        "voltage_V": pa.array(["380", "381"]).dictionary_encode(),
        "temperature_C": pa.array([20, 21], pa.int8()),
    }
    path = tmp_path / "x.parquet"
    pq.write_table(pa.table(columns), path)
    np.testing.assert_array_equal(read_log(path).voltage_v, [380.0, 381.0])
    columns["time_s"] = pa.array([0, 1], pa.timestamp("ms"))
    pq.write_table(pa.table(columns), path)
    with pytest.raises(InputError, match="time_s: the column does not hold numbers") as caught:
        read_log(path)
    assert caught.value.value == "timestamp[ms]"


def test_a_flipped_bit_in_parquet_is_noticed(tmp_path: Path) -> None:
    time = np.arange(500) / 10
    log = Log(time, np.sin(time), 380 + np.cos(time), 20 + time / 100)
    path = tmp_path / "x.parquet"
    write_log(log, path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match="cut off or damaged"):
        read_log(path)


def test_writing_needs_a_known_suffix_and_leaves_nothing(tmp_path: Path, small_log: Log) -> None:
    with pytest.raises(InputError, match=r"'\.xlsx'.*\.parquet or \.csv"):
        write_log(small_log, tmp_path / "x.xlsx")
    with pytest.raises(InputError, match="folder of this file does not exist"):
        write_log(small_log, tmp_path / "absent" / "x.csv")
    assert list(tmp_path.iterdir()) == []


def test_tables_of_any_columns(tmp_path: Path) -> None:
    columns = {"time_s": np.array([0.0, 1.0]), "status": pa.array(["valid", "a,b"])}
    write_table(columns | {"soc": np.array([np.nan, 0.1])}, tmp_path / "x.csv")
    assert (tmp_path / "x.csv").read_text() == 'time_s,status,soc\n0,"valid",\n1,"a,b",0.1\n'


def test_a_temperature_of_another_name_is_read(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = [f"{t},{20 + 10 * (t // 30 % 3)},{378 - t // 30 % 3},22" for t in range(600)]
    header = "Time_s,Current_A,Voltage_V,Cell_Temperature_C"
    path.write_text("\n".join([header, *rows]) + "\n")
    log = read_log(path)
    assert log.temperature_c[0] == 22.0
    assert log.current_a[0] == 20.0
