"""Tables of any logger: spellings of public exporters, the user's own columns, refusals."""

from __future__ import annotations

import contextlib
import datetime as dt
import math
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.logs.units import unit_of

ROWS = 60
TIME_S = np.arange(ROWS, dtype=float)
CURRENT_A = np.where(TIME_S.astype(int) % 2 == 1, 40.0, -10.0)
"""Steps every second, so that the data show the sign; positive = discharge."""
VOLTAGE_V = 380.0 - 0.1 * CURRENT_A
TEMPERATURE_C = 21.5
SOC_PCT = 80.0 - 0.1 * TIME_S
START = dt.datetime(2024, 3, 13, 23, 59, 30, tzinfo=dt.UTC)

Row = Callable[[int], str]


def at(k: int) -> tuple[float, float, float, float]:
    """Return time, current (positive = discharge), voltage and SoC of a row."""
    return float(k), float(CURRENT_A[k]), float(VOLTAGE_V[k]), float(SOC_PCT[k])


def german(value: float) -> str:
    return f"{value:.3f}".replace(".", ",")


def stamp(k: int, form: str) -> str:
    return (START + dt.timedelta(seconds=k)).strftime(form)


def hms(k: int) -> str:
    return f"{k // 3600:02d}:{k // 60 % 60:02d}:{k % 60:02d}"


@dataclass(frozen=True)
class Table:
    """Text of a table: everything above the data, and a row of it."""

    head: str
    row: Row
    encoding: str = "utf-8"
    temperature_c: float | None = None
    """Given by the user; None: the table's own."""
    has_soc: bool = False
    options: dict[str, Any] = field(default_factory=dict)
    foot: str = ""
    ends: str = "\n"

    @property
    def content(self) -> bytes:
        rows = "".join(self.row(k) + "\n" for k in range(ROWS))
        text = (self.head + "\n" + rows + self.foot).replace("\n", self.ends)
        return text.encode(self.encoding)


def charging(k: int) -> tuple[float, float, float, float]:
    """Return the same with positive = charge."""
    time, current, voltage, soc = at(k)
    return time, -current, voltage, soc


def line(template: str, source: Callable[[int], tuple[float, float, float, float]] = at) -> Row:
    """Return rows by a template with {k}, {t}, {i}, {u}, {s}, {hms}."""

    def row(k: int) -> str:
        t, i, u, s = source(k)
        return template.format(k=k, t=t, i=i, u=u, s=s, hms=hms(k), iso=stamp(k, "%FT%TZ"))

    return row


TABLES: dict[str, Table] = {
    "plain with brackets": Table(
        "Time [s],Pack Current [A],Pack Voltage [V],Battery Temperature [°C],SoC [%]",
        line("{t},{i},{u},21.5,{s}"), has_soc=True,
    ),
    "months as words, units in the cells": Table(
        "time,amps,volts,fahrenheit,Disp SoC",
        lambda k: (
            f'"{stamp(k, "%b %d, %Y %I:%M:%S")}\u202f{stamp(k, "%p")}",{at(k)[1]},{at(k)[2]},70.7,'
            f"{at(k)[3]}%"
        ),
        has_soc=True,
    ),
    "day before the month's name": Table(
        "time,current,voltage,celsius",
        lambda k: f"{stamp(k, '%d %B %Y %H:%M:%S')},{at(k)[1]},{at(k)[2]},21.5",
    ),
    "plain without units": Table(
        "time,current,voltage,temperature,soc", line("{t},{i},{u},21.5,{s}"), has_soc=True
    ),
    "German export": Table(
        "Zeit [s];Strom [A];Spannung [V];Temperatur [°C];Ladezustand [%]",
        lambda k: ";".join(german(x) for x in (*at(k)[:3], 21.5, at(k)[3])),
        encoding="latin-1", has_soc=True,
    ),
    "German thousands": Table(
        "Zeit [s];Strom [mA];Spannung [V];Temperatur [°C]",
        lambda k: f"{k};{at(k)[1] * 1e3:,.1f};{german(at(k)[2])};21,5".replace(
            f"{at(k)[1] * 1e3:,.1f}",
            f"{at(k)[1] * 1e3:,.1f}".translate(str.maketrans(",.", ".,")),
        ),
    ),
    "UTF-16 with a BOM and tabs": Table(
        "Time (s)\tCurrent (A)\tVoltage (V)\tTemp (°C)", line("{t}\t{i}\t{u}\t21.5"),
        encoding="utf-16",
    ),
    "UTF-8 with a BOM": Table(
        "Time [s],Current [A],Voltage [V],Temp [°C]", line("{t},{i},{u},21.5"),
        encoding="utf-8-sig", ends="\r\n",
    ),
    "kiloampere, millivolt, fahrenheit, fraction": Table(
        "t [ms],I [kA],U [mV],T [°F],SoC [-]",
        lambda k: f"{at(k)[0] * 1e3},{at(k)[1] / 1e3},{at(k)[2] * 1e3},70.7,{at(k)[3] / 100}",
        has_soc=True,
    ),
    "kelvin and SoC from 0 to 1": Table(
        "t_s,I_A,U_V,T_K,SOC", lambda k: f"{k},{at(k)[1]},{at(k)[2]},294.65,{at(k)[3] / 100}",
        has_soc=True,
    ),
    "preamble and a row of units": Table(
        "Report of the bench\nOperator;A. Volta\n\nTime;Current;Voltage;Temperature\ns;A;mV;°C",
        lambda k: f"{k};{at(k)[1]};{at(k)[2] * 1e3};21.5",
    ),
    "Arbin MITS": Table(
        "Data_Point,Test_Time(s),Date_Time,Step_Time(s),Step_Index,Cycle_Index,Current(A),"
        "Voltage(V),Charge_Capacity(Ah),Discharge_Capacity(Ah),dV/dt(V/s),Internal_Resistance(Ohm),"
        "Aux_Temperature_1(C)",
        line("{k},{t},03/13/2024 23:59:30,{t},1,1,{i},{u},0,0,0,0,21.5", charging),
    ),
    "Arbin Link export": Table(
        "Date Time,Test Time (s),Step Time (s),Cycle Index,Step Index,Current (A),Voltage (V),"
        "Aux_Voltage_1 (V),Charge Capacity (Ah)",
        line("2024-03-13 23:59:30,{t},0,1,1,{i},{u},3.1,0", charging), temperature_c=21.5,
    ),
    "Maccor": Table(
        "Today's Date 03/13/2024\nDate of Test:\t03/13/2024\n"
        "Rec#\tCyc#\tStep\tTest (Sec)\tStep (Sec)\tAmp-hr\tWatt-hr\tAmps\tVolts\tState\tES"
        "\tDPt Time",
        line("{k}\t0\t1\t{t}\t{t}\t0.0\t0.0\t{i}\t{u}\tD\t1\t03/13/2024 23:59:30", charging),
        temperature_c=21.5,
    ),
    "Maccor with days": Table(
        "Rec,Cyc#,Step,TestTime,StepTime,Amp-hr,Watt-hr,Amps,Volts,State",
        line("{k},0,1,0d {hms}.00,0d {hms}.00,0,0,{i},{u},D", charging), temperature_c=21.5,
    ),
    "Neware": Table(
        "DataPoint,Cycle Index,Step Index,Step Type,Time,Total Time,Current(A),Voltage(V),"
        "Capacity(Ah),Energy(Wh),Date,Power(W),T1(℃)",
        line("{k},1,1,CC DChg,0:00:00,{hms},{i},{u},0,0,2024-03-13 23:59:30,0,21.5", charging),
    ),
    "Neware in Chinese": Table(
        "数据序号,循环号,工步类型,时间(h:min:s.ms),总时间,电流(mA),电压(V),温度(℃)",
        lambda k: f"{k},1,放电,{hms(k % 10)}.000,{hms(k)},{-at(k)[1] * 1e3},{at(k)[2]},21.5",
    ),
    "BioLogic MPT": Table(
        "EC-Lab ASCII FILE\nNb header lines : 5\n\nAcquisition started on : 03/13/2024\n"
        "mode\tox/red\terror\tcontrol/V/mA\ttime/s\tcontrol/mA\tEwe/V\t<I>/mA\tdQ/mA.h\t"
        "Temperature/°C",
        lambda k: f"1\t0\t0\t5\t{k}\t5\t{at(k)[2]}\t{-at(k)[1] * 1e3}\t0\t21.5",
        encoding="latin-1",
    ),
    "Digatron": Table(
        "Schedule;X\nStep;Status;Prog Time;Step Time;Cycle;Current;Voltage;AhAccu;LogTemp01\n"
        ";;hh:mm:ss;hh:mm:ss;;A;V;Ah;°C",
        line("1;DCH;{hms};{hms};1;{i};{u};0;21.5", charging),
        options={"columns": "temperature=LogTemp01"},
    ),
    "Basytec": Table(
        "~Resultfile from Basytec Battery Test System\n~Date and Time of Data Converting:\n"
        "~Time[h]\tDataSet\tt-Step[h]\tLine\tU[V]\tI[A]\tAh[Ah]\tT1[°C]",
        lambda k: f"{k / 3600:.12f}\t{k}\t0\t1\t{at(k)[2]}\t{-at(k)[1]}\t0\t21.5",
    ),
    "LeafSpy": Table(
        "Date/Time,Lat,Long,Elv,Speed,Gids,SOC,AHr,Pack Volts,Pack Amps,Max CP mV,Min CP mV,"
        "Pack T1 F,Pack T1 C,Pack T2 F,Pack T2 C,12v Bat Amps,Hx,12v Bat Volts,Odo(km),Epoch Time",
        lambda k: f"{stamp(k, '%m/%d/%Y %H:%M:%S')},52 1.2,13 4.5,40,30,200,{at(k)[3] * 1e4:.0f},"
        f"50.1,{at(k)[2]},{at(k)[1]},3950,3930,69.8,21,71.6,22,1.2,80,14.2,12000,"
        f"{START.timestamp() + k:.0f}",
        has_soc=True,
    ),
    "Torque": Table(
        "GPS Time, Device Time, Longitude, Latitude,Speed (OBD)(km/h),[HV] Battery Current(A),"
        "[HV] Battery Voltage(V),[HV] Battery Temp(°C),[HV] SOC(%)",
        lambda k: f"Wed Mar 13 23:59:30 GMT 2024,{stamp(k, '%d-%b-%Y %H:%M:%S')}.000,13.4,52.5,30,"
        f"{at(k)[1]},{at(k)[2]},21.5,{at(k)[3]}",
        has_soc=True,
    ),
    "Scan My Tesla": Table(
        "Time,Battery voltage,Battery current,Battery power,SOC,Max cell temp,Cell temp mid",
        lambda k: f"{k * 1000},{at(k)[2]},{at(k)[1]},0,{at(k)[3]},23,21.5",
        has_soc=True, options={"columns": "time=Time[ms]"},
    ),
    "OVMS": Table(
        "timestamp,v.b.soc,v.b.voltage,v.b.current,v.b.temp,v.b.power",
        line("{iso},{s},{u},{i},21.5,0"), has_soc=True,
    ),
    "Victron VRM": Table(
        "timestamp,Battery Monitor [279],Battery Monitor [279],Battery Monitor [279]\n"
        "Europe/Amsterdam (+01:00),Voltage,Current,State of charge\n,V,A,%",
        lambda k: f"{stamp(k, '%F %T')},{at(k)[2]},{-at(k)[1]},{at(k)[3]}",
        temperature_c=21.5, has_soc=True,
    ),
    "Daly BMS app": Table(
        "Time,Total Voltage(V),Current(A),SOC(%),Max Voltage(V),Min Voltage(V),Temp1(℃),"
        "MOS Temp(℃)",
        lambda k: f"{stamp(k, '%F %T')},{at(k)[2]}V,{-at(k)[1]}A,{at(k)[3]}%,3.9,3.8,21.5,40",
        has_soc=True,
    ),
    "JBD BMS app": Table(
        "date;time;pack voltage;pack current;rsoc;temp 1;temp 2",
        lambda k: f"{stamp(k, '%d.%m.%Y')};{stamp(k, '%H:%M:%S')};{at(k)[2]};{-at(k)[1]};"
        f"{at(k)[3]};21;22",
        has_soc=True,
    ),
    "CANape CSV": Table(
        "time;BMS.PackCurrent;BMS.PackVoltage;BMS.PackTemp\ns;A;V;degC",
        lambda k: f"{k};;{at(k)[2]};21.5\n{k + 0.01:.2f};{at(k)[1]};;",
    ),
    "INCA ASCII": Table(
        "ETASAsciiItemFile\trecord\tcutTime\ndescription\tBench\nsampleCount\t60\n"
        "time\tI_Batt\tU_Batt\tT_Batt\\ETKC:1\nf8\tf8\tf8\tf8\ns\tA\tV\t°C",
        line("{t}\t{i}\t{u}\t21.5"),
    ),
    "PEAK": Table(
        "; PCAN-Explorer export\nTime (s);PackCurrent (A);PackVoltage (V);PackTemp (°C)",
        lambda k: ";".join(german(x) for x in (*at(k)[:3], 21.5)),
    ),
    "Vector CANoe": Table(
        "Time[s],BMS::Status::PackCurrent[A],BMS::Status::PackVoltage[V],BMS::Temp::CellTempAvg[°C]",
        line("{t},{i},{u},21.5"),
    ),
    "Kvaser": Table(
        '"Time","Battery.Current [A]","Battery.Voltage [V]","Battery.Temp [°C]"',
        line('"{t}","{i}","{u}","21.5"'),
    ),
    "epoch in milliseconds": Table(
        "timestamp,current,voltage,temperature",
        lambda k: f"{(START.timestamp() + k) * 1e3:.0f},{at(k)[1]},{at(k)[2]},21.5",
    ),
    "American dates with am and pm": Table(
        "Date and Time,Current (A),Voltage (V),Temperature (F)",
        lambda k: f"{stamp(k, '%m/%d/%Y %I:%M:%S %p')},{at(k)[1]},{at(k)[2]},70.7",
    ),
    "local dates of a zone": Table(
        "Timestamp,Current,Voltage,Temp",
        lambda k: f"{stamp(k, '%F %T')},{at(k)[1]},{at(k)[2]},21.5",
        options={"columns": "time=Timestamp[Europe/Berlin]"},
    ),
    "without a header": Table(
        "bench 7", line("{t};{u};{i};21.5", charging),
        options={"columns": "time=#1,voltage=#2,current=#3[A]:-1,temperature=#4"},
    ),
    "own headings": Table(
        "Stempel,Wert a,Wert b,Wert c", line("{t},{i},{u},21.5"),
        options={"columns": {"time": "Stempel", "current": "Wert a",
                             "voltage": {"heading": "Wert b", "unit": "V"},
                             "temperature": "Wert c[°C]"}},
    ),
    "a comma in a heading": Table(
        'Time [s],"Current, pack [A]",Voltage [V],Temp [°C]', line("{t},{i},{u},21.5"),
        options={"columns": "current=Current, pack [A]"},
    ),
    "sign stated": Table(
        "Time [s],Current [A],Voltage [V],Temp [°C]", line("{t},{i},{u},21.5", charging),
        options={"sign": "charge"},
    ),
}  # fmt: skip


def read(tmp_path: Path, table: Table, **more: Any) -> Log:
    path = tmp_path / "table.csv"
    path.write_bytes(table.content)
    return read_log(path, temperature_c=table.temperature_c, **(table.options | more))


@pytest.mark.parametrize("name", TABLES)
def test_table_reads_to_the_same_log(tmp_path: Path, name: str) -> None:
    table = TABLES[name]
    log = read(tmp_path, table)
    np.testing.assert_allclose(log.time_s - log.time_s[0], TIME_S, atol=1e-6)
    np.testing.assert_allclose(log.current_a, CURRENT_A, atol=1e-6)
    np.testing.assert_allclose(log.voltage_v, VOLTAGE_V, atol=1e-3)
    assert np.ptp(log.temperature_c) < 1e-6
    assert log.temperature_c[0] == pytest.approx(TEMPERATURE_C, abs=0.01)
    assert (log.soc_pct is not None) == table.has_soc
    if log.soc_pct is not None:
        np.testing.assert_allclose(log.soc_pct, SOC_PCT, atol=1e-3)


@pytest.mark.parametrize("name", TABLES)
def test_damaged_tables_raise_nothing_but_input_errors(tmp_path: Path, name: str) -> None:
    table, rng = TABLES[name], np.random.default_rng(11)
    path = tmp_path / "x.csv"
    for _ in range(8):
        data = bytearray(table.content)
        for place in rng.integers(len(data), size=rng.integers(1, 5)):
            mark = int(rng.choice(list(b",;.-\t")))
            data[place] = int(rng.integers(256)) if rng.random() < 0.5 else mark
        path.write_bytes(bytes(data))
        with contextlib.suppress(InputError):
            log = read_log(path, temperature_c=table.temperature_c, **table.options)
            assert np.isfinite(log.voltage_v).all()


def test_what_was_assumed_is_told(tmp_path: Path) -> None:
    log = read(tmp_path, TABLES["plain without units"])
    assert log.assumed == (
        'time = "time" [s, assumed]',
        'current = "current" [A, assumed]',
        'voltage = "voltage" [V, assumed]',
        'temperature = "temperature" [°C, assumed]',
        'soc = "soc" [%, assumed]',
        "positive current discharges, found from the data",
    )


def test_columns_that_are_not_read_are_told(tmp_path: Path) -> None:
    table = Table("time,current,voltage,temperature,driver,Motor rpm", line("{t},{i},{u},21.5,A,9"))
    assert "2 other columns ignored: driver, Motor rpm" in read(tmp_path, table).remarks


@pytest.mark.parametrize(
    ("head", "row", "mean_c", "words"),
    [
        ("T1,T2,T3", "21,22,-40", 21.5, "T3 left out in 60 rows, .*20 K.*first -40"),
        ("T1 [°F],T2 [°F],T3 [°F]", "69.8,71.6,419", 21.5, r"T3 \[°F\] left out"),
        ("T1,T2,T3", "15,21,27", 21.0, ""),
        ("T1,T2", "31,-40", -4.5, "T1 and T2 are 31 and -40 in row 1: one of the probes fails"),
        ("T1,T2", "15,27", 21.0, ""),
        ("T1,T2,T3", "20,127,", 73.5, "one of the probes fails"),
        ("T1,T2,T3,T4", "20,21,127,127", 73.75, "one of the probes fails"),
    ],
)
def test_a_probe_far_from_the_others_has_a_remark(
    tmp_path: Path, head: str, row: str, mean_c: float, words: str
) -> None:
    log = read(tmp_path, Table(f"time,current,voltage,{head}", line("{t},{i},{u}," + row)))
    assert log.temperature_c == pytest.approx(mean_c, abs=0.01)
    told = [text for text in log.remarks if "probe" in text]
    assert len(told) == bool(words)
    assert re.search(words, "".join(told))


@pytest.mark.parametrize(
    ("begins", "problem", "rate"),
    [("2024-03-31T01:59:30", "ahead at row 31", 1), ("2024-10-27T02:59:30", "back at row 31", 1),
     ("2024-03-31T04:59:30", "", 1), ("2024-03-31T01:59:50", "ahead at row 31", 3)],
)  # fmt: skip
def test_an_hour_of_daylight_saving_names_the_cure(
    tmp_path: Path, begins: str, problem: str, rate: int
) -> None:
    began = dt.datetime.fromisoformat(begins)
    hours = {"ahead": 1, "back": -1}.get(problem.partition(" ")[0], 0)

    def row(k: int) -> str:
        now = began + dt.timedelta(seconds=k // rate, hours=hours if k >= 30 else 0)
        return f"{now:%F %T},{at(k)[1]},{at(k)[2]},21.5"

    table = Table("Stamp time,current,voltage,temperature", row)
    remarks: list[str] = []
    try:
        remarks += read(tmp_path, table).remarks
    except InputError as error:
        remarks += [str(error)]
    assert any("[Europe/Berlin]" in text for text in remarks) == bool(problem)
    assert any(problem in text for text in remarks) or not problem
    zoned = read(tmp_path, table, columns="time=Stamp time[Europe/Berlin]")
    assert np.diff(zoned.time_s) == pytest.approx(1.0)  # repeated stamps are dropped


def test_sign_is_found_from_the_data(tmp_path: Path) -> None:
    log = read(tmp_path, TABLES["Basytec"])
    assert log.assumed[-1] == "positive current charges, found from the data"
    assert any("current negated" in remark for remark in log.remarks)


def test_stated_sign_that_the_data_contradict_warns(tmp_path: Path) -> None:
    log = read(tmp_path, TABLES["plain with brackets"], sign="charge")
    assert log.current_a == pytest.approx(-CURRENT_A)
    assert any("the stated sign of current looks inverted" in item for item in log.remarks)


def test_stated_sign_agrees_with_a_format_that_defines_it(
    tmp_path: Path, every_format: dict[str, bytes]
) -> None:
    path = tmp_path / "TripA01.csv.gz"
    path.write_bytes(every_format["TripA01.csv.gz"])
    plain = read_log(path)
    assert read_log(path, sign="charge").current_a == pytest.approx(plain.current_a)
    assert read_log(path, sign="discharge").current_a == pytest.approx(-plain.current_a)


def test_history_of_entities_reads_as_a_log(tmp_path: Path) -> None:
    rows = ["entity_id,state,last_changed"]
    names = ("current", "voltage", "temperature", "soc")
    for k in range(ROWS):
        values = (-at(k)[1], at(k)[2], 21.5, at(k)[3])
        for name, value in zip(names, values, strict=True):
            if name != "temperature" or k in {0, 30}:  # recorded when it changes
                rows.append(f"sensor.battery_{name},{value},{stamp(k, '%FT%T')}.000Z")
    rows.insert(8, "sensor.battery_soc,unavailable,2024-03-13T23:59:31.000Z")
    path = tmp_path / "history.csv"
    path.write_text("\n".join(rows) + "\n")
    log = read_log(path)
    assert log.time_s - log.time_s[0] == pytest.approx(TIME_S)
    assert log.current_a == pytest.approx(CURRENT_A)
    assert log.voltage_v == pytest.approx(VOLTAGE_V)
    assert log.temperature_c == pytest.approx(TEMPERATURE_C)


def test_workbook_reads_as_its_longest_sheet(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["Global info"])
    sheet = book.create_sheet("Channel_1")
    sheet.append(["Date_Time", "Current (A)", "Voltage (V)", "Temp (°C)"])
    for k in range(ROWS):
        when = (START + dt.timedelta(seconds=k)).replace(tzinfo=None)
        sheet.append([when, float(CURRENT_A[k]), float(VOLTAGE_V[k]), 21.5])
    book.save(tmp_path / "log.xlsx")
    log = read_log(tmp_path / "log.xlsx")
    assert log.time_s - log.time_s[0] == pytest.approx(TIME_S)
    assert log.current_a == pytest.approx(CURRENT_A)


def test_workbook_that_unpacks_to_too_much_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("openpyxl")
    path = tmp_path / "bomb.xlsx"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")
        archive.writestr("xl/worksheets/sheet1.xml", b"0" * (20 << 20))
    with pytest.raises(InputError, match="unpacks to 20 MiB"):
        read_log(path)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match=r"bomb\.xlsx"):
        read_log(path)


def test_index_of_times_is_the_time(tmp_path: Path) -> None:
    stamps = pa.array([k * 1_000_000 for k in range(ROWS)], pa.timestamp("us"))
    table = pa.table(
        {"Current [A]": CURRENT_A, "Voltage [V]": VOLTAGE_V, "__index_level_0__": stamps}
    )
    log = Log.from_dataframe(table, temperature_c=20.0)
    assert log.time_s == pytest.approx(TIME_S)


@pytest.mark.parametrize("kind", ["parquet", "frame"])
def test_other_tables_take_the_same_columns(tmp_path: Path, kind: str) -> None:
    stamps = pa.array([START.timestamp() * 1e6 + k * 1e6 for k in range(ROWS)], pa.int64())
    table = pa.table(
        {
            "when": stamps.cast(pa.timestamp("us", "UTC")),
            "I_batt": -1e3 * CURRENT_A,
            "U_batt": VOLTAGE_V,
            "T1": np.full(ROWS, 21.0),
            "T2": np.full(ROWS, 22.0),
            "SoC": [f"{value}%" for value in SOC_PCT],
        }
    )
    columns = {"time": "when", "current": "I_batt[mA]:-1"}
    if kind == "parquet":
        pq.write_table(table, tmp_path / "t.parquet")
        log = read_log(tmp_path / "t.parquet", columns=columns)
    else:
        log = Log.from_dataframe(table, columns=columns)
    assert log.time_s - log.time_s[0] == pytest.approx(TIME_S)
    assert log.current_a == pytest.approx(CURRENT_A)
    assert log.temperature_c == pytest.approx(TEMPERATURE_C)
    assert log.soc_pct == pytest.approx(SOC_PCT)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_headings_that_differ_in_case_only_are_two(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    table = pa.table(
        {"t": TIME_S, "T": np.full(ROWS, TEMPERATURE_C), "I": CURRENT_A, "U": VOLTAGE_V}
    )
    if suffix == ".csv":
        pacsv.write_csv(table, path)
    else:
        pq.write_table(table, path)
    log = read_log(path, columns="time=t,temperature=T,current=I[A],voltage=u")
    assert log.time_s == pytest.approx(TIME_S)
    assert log.temperature_c == pytest.approx(TEMPERATURE_C)
    assert log.voltage_v == pytest.approx(VOLTAGE_V)


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        (
            "Stamp,Ibatt_x,Uq,T\n" + "1,2,300,20\n" * 4, {},
            r"no plain heading of current and voltage \(found: Stamp, Ibatt_x, Uq, T\); name"
            r" the columns, e\.g\. --columns 'time=Stamp,current=Ibatt_x,voltage=\?",
        ),
        (
            "Time,Current 1,Current 2,Voltage\n" + "1,2,3,300\n" * 4, {},
            r"no plain heading of current .*--columns 'time=Time,current=Current 1",
        ),
        (
            "Time,Current,Voltage\n" + "1,2,300\n" * 4, {"columns": "current=Curent"},
            r"no column has this heading .*Curent.*did you mean Current\?",
        ),
        (
            "Time,Current,Voltage\n" + "1,2,300\n" * 4, {"columns": "current=Voltage,voltage=#3"},
            r"is the column of current too .*#3.*give each quantity a column of its own",
        ),
        (
            "Time,Current,Voltage\n" + "1,2,300\n" * 4, {"columns": "currant=Current"},
            "not a quantity of a log",
        ),
        (
            "Time,Current,Voltage\n" + "1,2,300\n" * 4, {"columns": "Current"},
            "not a column .*give NAME=HEADING",
        ),
        (
            "Time,Current,Voltage,Temp\n" + "".join(f"{k},2,300000,20\n" for k in range(4)), {},
            r"voltage looks like millivolts .*--columns 'voltage=Voltage\[mV\]'",
        ),
        (
            "Time,Current,Voltage,Temp\n1,2,300,20\nsoon,2,300,20\n", {},
            "Time: row 2 is not a number",
        ),
        (
            "Time,Current,Voltage,Temp\n2024-03-01 10:00:00,2,300,20\nsoon,2,300,20\n", {},
            r"Time: row 2 is not a time \(got 'soon'\)",
        ),
        ("Time,Current,Voltage,Temp\n1,2,300,20\n", {"sign": "up"}, "not a sign"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused_with_the_cure(
    tmp_path: Path, text: str, options: dict[str, Any], words: str
) -> None:
    path = tmp_path / "x.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_log(path, **options)


@given(
    current_unit=st.sampled_from(["A", "mA", "kA"]),
    voltage_unit=st.sampled_from(["V", "mV", "kV"]),
    temperature_unit=st.sampled_from(["°C", "K", "°F"]),
    time_unit=st.sampled_from(["s", "ms", "min", "h"]),
    factor=st.sampled_from([1.0, -1.0, 0.5, -10.0, 1e-3]),
    seed=st.integers(0, 2**16),
)
def test_units_signs_and_factors_round_trip(
    *,
    current_unit: str,
    voltage_unit: str,
    temperature_unit: str,
    time_unit: str,
    factor: float,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    time_s = np.cumsum(rng.uniform(0.1, 2.0, 30))
    wanted = {
        "time_s": time_s,
        "current_a": rng.uniform(-200.0, 200.0, 30),
        "voltage_v": rng.uniform(300.0, 400.0, 30),
        "temperature_c": rng.uniform(-20.0, 50.0, 30),
    }
    units = dict(
        zip(wanted, (time_unit, current_unit, voltage_unit, temperature_unit), strict=True)
    )
    stored = {}
    for field_name, values in wanted.items():
        scale, offset = unit_of(field_name, units[field_name]) or (math.nan, math.nan)
        stored[field_name] = (values - offset) / scale
    stored["current_a"] = stored["current_a"] / factor
    table = pa.table(dict(zip("abcd", stored.values(), strict=True)))
    log = Log.from_dataframe(
        table,
        columns={
            "time": f"a[{time_unit}]",
            "current": f"b[{current_unit}]:{factor!r}",
            "voltage": {"heading": "c", "unit": voltage_unit},
            "temperature": f"d[{temperature_unit}]",
        },
        sign="discharge",
    )
    for field_name, values in wanted.items():
        assert getattr(log, field_name) == pytest.approx(values, rel=1e-9, abs=1e-9)


def test_the_unit_in_cells_counts_unless_the_heading_has_another(tmp_path: Path) -> None:
    table = Table("time,current,voltage,temperature", line("{t},{i},{u},68 °F"))
    assert read(tmp_path, table).temperature_c == pytest.approx(20.0)
    table = Table("time,current,voltage,temperature [°C]", line("{t},{i},{u},68 °F"))
    with pytest.raises(InputError, match="another unit than the heading"):
        read(tmp_path, table)
