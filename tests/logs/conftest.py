"""Small files of every format, as their makers write them."""

from __future__ import annotations

import gzip
import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log

D3_HEADERS = {
    "2012": [
        "Timestamp [sec]",
        "Dyno Speed [mph]",
        "Dyno Tractive Effort [N]",
        "Cell Temp [C]",
        "Phase #",
        "HV Battery Voltage w/500A max clamp [V]",
        "HV Battery Current w/500A max clamp [A]",
        "HV Battery Voltage w/200A max clamp [V]",
        "HV Battery Current w/200A max clamp [A]",
    ],
    "2013": [
        "Time[sec]",
        "Dyno_Speed[mph]",
        "Test_Cell_Temp[C]",
        "HV_Battery_SOC[%]",
        "HV_Battery_Current[A]",
        "HV_Battery_Voltage[V]",
    ],
    "later": [
        "DAQ_Time[s]",
        "Time[s]",
        "Dyno_Spd[mph]",
        "Cell_Temp[C]",
        "HVBatt_voltage_CAN5__V",
        "HVBatt_current_wide_CAN5__A",
        "HVBatt_SOC_CAN5__per",
        "HVBatt_Volt_Hioki_U1__V",
        "HVBatt_Curr_Hioki_I1__A",
    ],
}


def current_at(time_s: float) -> float:
    """A current [A] that steps every second, positive = discharge."""
    return 40.0 if int(np.floor(time_s)) % 2 else -10.0


def voltage_at(time_s: float) -> float:
    return 380.0 - 0.1 * current_at(time_s)


def d3_text(header: list[str], *, start_s: float = -1.0, end_s: float = 40.0) -> str:
    """A D3 file; the 200 A clamp saturates at 20 A, copies from CAN have the sign inverted."""
    lines = ["\t".join(header)]
    for tick in range(round(start_s * 10), round(end_s * 10)):
        time = tick / 10
        lines.append("\t".join(f"{_d3_value(name, time):.4f}" for name in header))
    return "\r\n".join(lines) + "\r\n"


def _d3_value(name: str, time: float) -> float:
    lower = name.lower()
    if "current" in lower or "curr_" in lower:
        current = current_at(time)
        if "200a" in lower:
            return min(current, 20.0)
        return -current if "can" in lower else current
    if "volt" in lower:
        return voltage_at(time)
    if "time" in lower:
        return time
    if "soc" in lower:
        return 90.0 - time / 100.0
    return 23.5 if "temp" in lower else 0.0


@pytest.fixture(scope="session")
def d3_headers() -> dict[str, list[str]]:
    return D3_HEADERS


@pytest.fixture(scope="session")
def build_d3() -> Callable[..., str]:
    return d3_text


@pytest.fixture
def small_log() -> Log:
    rows = 8
    time = np.arange(rows) * 0.1
    soc = np.linspace(80.0, 79.0, rows)
    soc[3] = np.nan
    return Log(
        time_s=time,
        current_a=np.linspace(-10.0, 55.5, rows),
        voltage_v=380.0 - time,
        temperature_c=np.full(rows, 21.0),
        soc_pct=soc,
        temperature_source="pack",
    )


I3_HEADER = (
    "Time [s];Velocity [km/h];Regenerative Braking Signal ;Battery Voltage [V];"
    "Battery Current [A];Battery Temperature [°C];max. Battery Temperature [°C];SoC [%];"
    "displayed SoC [%];max. SoC [%)"
)


def i3_text(rows: list[str]) -> bytes:
    return "\r\n".join([I3_HEADER, *rows, ""]).encode("latin-1")


@pytest.fixture(scope="session")
def build_i3() -> Callable[[list[str]], bytes]:
    return i3_text


@pytest.fixture
def every_format(tmp_path: Path, small_log: Log) -> dict[str, bytes]:
    """Content of a small valid file of every format, by file name."""
    for name in ("log.parquet", "log.csv"):
        write_log(small_log, tmp_path / name)
    csv = (tmp_path / "log.csv").read_bytes()
    files = {
        "log.parquet": (tmp_path / "log.parquet").read_bytes(),
        "log.csv": csv,
        "log.csv.gz": gzip.compress(csv, mtime=0),
        "log;.csv": csv.replace(b",", b";").replace(b".", b","),
    }
    for spelling, header in D3_HEADERS.items():
        files[f"{spelling} Test Data.txt"] = d3_text(header, start_s=-0.2, end_s=0.3).encode()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("61201019 Test Data.txt", files["2012 Test Data.txt"])
        archive.writestr("readme.pdf", b"%PDF")
    files["leaf.zip"] = packed.getvalue()
    files["TripA01.csv.gz"] = gzip.compress(
        i3_text([f"{k / 10};0;0;391.4;-{k}.2;21;22;86.9;100;90" for k in range(6)]), mtime=0
    )
    files["A123_OCV_P25_S1.csv"] = (
        "Data_Point,Test_Time(s),Date_Time,Step_Index,Current(A),Voltage(V)\n"
        + "".join(f"{k},{k * 60.01:.2f},09/23/2013 16:21:09,1,-0.1,3.5\n" for k in range(4))
    ).encode()
    files["A123_DYN_50_P25_s1.csv"] = (
        "time, step, current, voltage, chgAh, disAh\n"
        + "".join(f"{k + 60.01:.4f}, 1.0000, -0.0000, 3.5764, 0.0, 0.0\n" for k in range(4))
    ).encode()
    files["Cell-HPPC-10C.csv"] = "".join(
        f"No,{k}.0,1,1,1,1,1,{k}.0,-{k}.00,3.09{k},0.0,0.00,0.00,DCHG, ,\r\n" for k in range(1, 5)
    ).encode()
    files["module.csv"] = (
        "Test Name,170410\nNotes, 5.25b\n\n"
        "Total Time,Cycle,Current,Voltage,Amp-Hours,Temperature A1,Temperature A2,Mode,\n"
        + "".join(f"{k}.0,1,-{k},24.9,0,22,23,DCHG,\n" for k in range(1, 5))
        + "Total Number of Data Lines in the Database: 0000000004\n"
    ).encode()
    files["logger.csv"] = (
        "Zeit;Strom;Spannung;Temperatur\n;mA;V;°C\n"
        + "".join(f"13.03.2024 10:00:0{k},5;{k}000,5;38{k},25;21,5\n" for k in range(6))
    ).encode("latin-1")
    files["history.csv"] = (
        "entity_id,state,last_changed\n"
        + "".join(
            f"sensor.battery_{name},{value},2024-03-13T23:59:3{k}.000Z\n"
            for k in range(6)
            for name, value in (("current", k), ("voltage", 380 + k), ("temperature", 21))
        )
    ).encode()
    return files
