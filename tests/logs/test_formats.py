"""What single formats define: instruments, set points, excluded rows, rasters, probes."""

from __future__ import annotations

import datetime as dt
import gzip
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from log_cases import CASES, CURRENT_A, START, TIME_S, VOLTAGE_V, content_of

from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.logs.log import Log


def changed(folder: Path, name: str, old: str, new: str, file_name: str = "") -> Log:
    """Read a case with a text replaced in it."""
    text = content_of(CASES[name]).decode("latin-1")
    assert re.search(old, text)
    path = folder / (file_name or CASES[name].get("name", "x.csv"))
    path.write_text(re.sub(old, new, text), encoding="latin-1")
    return read_log(path)


# ---- D3, cyclers, probes


def test_200_a_clamp_is_the_second_choice(tmp_path: Path) -> None:
    name = "d3-2012"
    assert changed(tmp_path, name, "w/500A", "w/9A").current_a[3] == 20.0  # that clamp saturates
    log = changed(tmp_path, name, r"\t-?\d+\.0(\t[\d.]+\t20)\b", r"\t\1")
    assert any("500A max clamp [A] is empty and was not used" in text for text in log.remarks)
    assert "current_a from the 200 A clamp" in log.remarks
    assert "1 row before time 0 (the wait before the test) dropped" in log.remarks


def test_instrument_is_never_turned_a_can_copy_may_be(tmp_path: Path) -> None:
    log = changed(tmp_path, "d3-can-copy", "current_wide_CAN5", "Curr_Hioki_I1")
    np.testing.assert_array_equal(log.current_a, -CURRENT_A)
    assert {"current_a from the power analyser", "voltage_v from the car's CAN"} <= set(log.remarks)
    assert any(text.startswith("current looks inverted and was kept") for text in log.remarks)


def test_a_unit_that_is_converted_is_said(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    rows = "".join(f"{k},{k % 7},3.8,293.15\n" for k in range(60))
    path.write_text(f"Test Time / s,Current / A,Voltage / V,Surface Temperature T1 / K\n{rows}")
    log = read_log(path)
    assert log.temperature_c[0] == pytest.approx(20.0)
    assert log.assumed == ('temperature = "Surface Temperature T1 / K" [K]',)


def test_rate_in_a_file_name_is_no_set_point(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the file holds no temperature"):
        changed(tmp_path, "bitrode-without-a-header", "No", "No", "2C-Discharge.csv")


def test_rows_that_bitrode_excludes_are_dropped(tmp_path: Path) -> None:
    log = changed(tmp_path, "bitrode-without-a-header", "No,5.0", "Yes,5.0")
    assert log.time_s[:7].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 7.0]
    assert "1 row that the cycler excludes dropped" in log.remarks


def test_rows_without_a_value_are_dropped_with_a_remark(tmp_path: Path) -> None:
    log = changed(tmp_path, "bmw-i3", r"\n5\.0;0;[\d.]*;", "\n5.0;0;;")
    assert len(log) == 59
    assert any(text.startswith("1 row without time, current, volt") for text in log.remarks)


@pytest.mark.parametrize(
    ("head", "row", "mean_c", "words"),
    [
        ("T1,T2,T3", "21,22,-40", 21.0, "T1 and T2 and T3 are 21 and 22 and -40 °C in row 1"),
        ("T1 [°F],T2 [°F],T3 [°F]", "69.8,71.6,419", 22.0, "one of the probes fails"),
        ("T1,T2,T3", "15,21,28", 21.0, ""),
        ("T1,T2", "31,-40", -4.5, "one of the probes fails"),
        ("T1,T2,T3", "20,127,", 73.5, "one of the probes fails"),
        ("T,T1,T2", "20,21,22", 20.0, ""),
    ],
)
def test_probe_far_from_the_others_has_a_remark(
    tmp_path: Path, head: str, row: str, mean_c: float, words: str
) -> None:
    rows = zip(TIME_S, CURRENT_A, VOLTAGE_V, strict=True)
    lines = [f"time,current,voltage,{head}", *(f"{t},{i},{u},{row}" for t, i, u in rows)]
    (tmp_path / "x.csv").write_text("\n".join(lines) + "\n")
    log = read_log(tmp_path / "x.csv")
    assert log.temperature_c == pytest.approx(mean_c, abs=0.01)
    told = [text for text in log.remarks if "probe" in text]
    assert len(told) == bool(words)
    assert re.search(words, "".join(told))


# ---- what the user states, and what was assumed


def test_what_was_assumed_and_ignored_is_told(tmp_path: Path) -> None:
    log = changed(tmp_path, "plain-without-units", "soc", "driver")
    assert log.assumed == (
        'time = "time" [s, assumed]',
        'current = "current" [A, assumed]',
        'voltage = "voltage" [V, assumed]',
        'temperature = "temperature" [°C, assumed]',
        "positive current discharges, found from the data",
    )
    assert "1 other column ignored: driver" in log.remarks


def test_a_hot_temperature_may_be_in_fahrenheit(tmp_path: Path) -> None:
    log = changed(tmp_path, "plain-without-units", r",21\.5,", ",70.7,")
    words = "temperature 71 °C is unusually hot: .* --columns 'temperature=temperature.°F."
    assert any(re.match(words, text) for text in log.remarks)


def test_a_stated_sign_is_kept_and_a_doubt_is_told(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes(content_of(CASES["plain-with-brackets"]))
    log = read_log(path, sign="charge")
    np.testing.assert_array_equal(log.current_a, -CURRENT_A)
    assert any("the stated sign of current looks inverted" in text for text in log.remarks)
    path.write_bytes(content_of(CASES["bmw-i3"]))  # a format that defines it: charge
    np.testing.assert_array_equal(read_log(path, sign="charge").current_a, CURRENT_A)
    np.testing.assert_array_equal(read_log(path, sign="discharge").current_a, -CURRENT_A)


def test_a_voltage_is_held_for_a_second_where_rows_hold_changes(tmp_path: Path) -> None:
    rows = [f"{k},,380,20\n{k}.4,{k % 3},," for k in range(20)]
    rows += [f"{20 + k}.4,{k % 3},," for k in range(5)]  # 0.4 s and more after the last voltage
    path = tmp_path / "x.csv"
    path.write_text("\n".join(["Time,Current,Voltage,Temp", *rows]) + "\n")
    log = read_log(path)
    assert len(log) == 20
    assert any("20 rows with a current kept, with the latest" in text for text in log.remarks)


def test_soc_against_the_charge_is_left_out(tmp_path: Path) -> None:
    rows = (
        f"{k},{40.0 if k % 4 < 2 else -4.0},{380.0 - (4.0 if k % 4 < 2 else -0.4)},21,{10 + k / 50}"
        for k in range(200)
    )
    path = tmp_path / "x.csv"
    path.write_text("\n".join(["time,current,voltage,temp,soc", *rows]) + "\n")
    log = read_log(path)
    assert log.soc_pct is None
    assert log.current_a[0] == 40.0
    assert any(text.startswith("SoC left out: it moves from 10") for text in log.remarks)


def test_columns_of_the_user_make_a_table_of_any_format(tmp_path: Path) -> None:
    path = tmp_path / "cell_P25_S1.csv"
    path.write_bytes(content_of(CASES["arbin"]))
    log = read_log(path, columns="current=Current(A):-2", temperature_c=20.0)
    np.testing.assert_array_equal(log.current_a, 2.0 * CURRENT_A)
    assert 'current = "Current(A)" × -2 [A]' in log.assumed


def test_constant_temperature_in_place_of_the_files(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes(content_of(CASES["canonical"]))
    log = read_log(path, temperature_c=-5.0, temperature_source="pack")
    assert set(log.temperature_c) == {-5.0}
    assert log.temperature_source == "pack"
    assert "temperature -5 °C as given in place of the file's" in log.remarks


# ---- workbooks, MF4


def test_workbook_reads_as_its_longest_sheet(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["Global info"])
    sheet = book.create_sheet("Channel_1")
    sheet.append(["Date_Time", "Current (A)", "Voltage (V)", "Temp (°C)"])
    for k in range(60):
        when = (START + dt.timedelta(seconds=k)).replace(tzinfo=None)
        sheet.append([when, float(CURRENT_A[k]), float(VOLTAGE_V[k]), 21.5])
    path = tmp_path / "log.xlsx"
    book.save(path)
    log = read_log(path)
    np.testing.assert_allclose(log.time_s - log.time_s[0], TIME_S)
    np.testing.assert_array_equal(log.current_a, CURRENT_A)
    assert "sheet 'Channel_1' is read, the longest; not read: 'Sheet' (1 rows)" in log.remarks
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(InputError, match=r"log\.xlsx: the zip file is cut off or damaged"):
        read_log(path)


def test_mf4_signals_of_several_rasters_become_a_log(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    fast, slow = np.arange(0.0, 60.0, 0.1), np.arange(0.0, 60.0)
    current = np.where(fast % 10.0 < 5.0, 40.0, -10.0)
    voltage = 380.0 - 0.1 * np.interp(slow, fast, current)
    path = tmp_path / "trip.mf4"
    with asammdf.MDF(version="4.10") as file:
        signal = asammdf.Signal
        file.append([signal(current, fast, unit="A", name="BMS_PackCurrent")])
        file.append(
            [
                signal(voltage, slow, unit="V", name="BMS_PackVoltage"),
                signal(np.full(60, 12.6), slow, unit="V", name="LowVoltage_12V"),
            ]
        )
        file.append([signal(20.0 + slow // 30, slow, unit="°C", name="BMS_PackTemp")])
        file.save(path, overwrite=True)
    log = read_log(path)
    whole = log.time_s <= 59.0
    np.testing.assert_allclose(log.time_s, fast[: len(log)])
    np.testing.assert_array_equal(log.current_a, current[: len(log)])
    between = np.interp(log.time_s[whole], slow, voltage)
    np.testing.assert_allclose(log.voltage_v[whole], between)
    assert set(log.temperature_c) == {20.0, 21.0}
    assert log.remarks[0] == "MF4 with 4 channels"
    assert "BMS_PackVoltage [V]: interpolated between its 60 values" in log.remarks
    packed = tmp_path / "trip.mf4.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert set(read_log(packed, columns="voltage=LowVoltage_12V").voltage_v) == {12.6}
    with pytest.raises(InputError, match=r"BMS_Voltag.*did you mean BMS_PackVoltage"):
        read_log(path, columns="voltage=BMS_Voltag")
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(InputError, match=r"trip\.mf4: "):
        read_log(path)


# ---- a reader of another package


READER = """
import numpy as np

from cangauge.logs.draft import DraftLog


class MyLogger:
    name = "my logger"
    takes_columns = False

    def matches(self, head):
        return head.first_line.startswith("MYLOGGER")

    def read(self, head, _columns=None, /):
        rows = [line.split() for line in head.read().decode().splitlines()[1:]]
        names = "time_s", "current_a", "voltage_v"
        return DraftLog(head.name, str(head.path), dict(zip(names, np.array(rows, float).T)))
"""


def test_other_packages_add_readers(tmp_path: Path) -> None:
    (tmp_path / "mypackage.py").write_text(READER)
    package = tmp_path / "mypackage-1.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Name: mypackage\nVersion: 1\n")
    (package / "entry_points.txt").write_text("[cangauge.readers]\nmine = mypackage:MyLogger\n")
    rows = (f"{t} {i} {u}\n" for t, i, u in zip(TIME_S, CURRENT_A, VOLTAGE_V, strict=True))
    (tmp_path / "mine.txt").write_text("MYLOGGER 1\n" + "".join(rows))
    read = (
        "import cangauge; print(cangauge.read_log('mine.txt', temperature_c=20).current_a.tolist())"
    )
    done = subprocess.run(
        [sys.executable, "-c", read], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    np.testing.assert_array_equal(json.loads(done.stdout), CURRENT_A)


def test_influxdb_repeats_its_header_above_each_table(tmp_path: Path) -> None:
    notes = (
        "#group,false,false,true,true,true\n#datatype,string,long,dateTime:RFC3339,double,string"
    )
    header = f"{notes}\n#default,_result,,,,\n,result,table,_time,_value,_field"
    series = {"current": lambda k: 10.0 * (k % 2), "voltage": lambda k: 380.0 - k % 2}
    blocks = [
        "\n".join([header, *(f",,0,2024-03-13T12:00:{k:02d}Z,{of(k)},{name}" for k in range(60))])
        for name, of in series.items()
    ]
    path = tmp_path / "query.csv"
    path.write_text("\n\n".join([*blocks, ""]), encoding="utf-8")
    log = read_log(path, temperature_c=20.0)
    np.testing.assert_array_equal(log.current_a, [10.0 * (k % 2) for k in range(60)])
    np.testing.assert_array_equal(log.voltage_v, [380.0 - k % 2 for k in range(60)])
