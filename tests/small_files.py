"""Small valid files of every format that cangauge reads."""

from __future__ import annotations

import gzip
import io
import json
import struct
import tempfile
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import can
import pyarrow as pa
import pyarrow.parquet as pq

from cangauge._resources import shared_file
from cangauge.bus.vehicle import Vehicle
from cangauge.model.effects.base import Pack, Parameter
from cangauge.model.effects.library import LIBRARY, effect_entries
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.types import Sample

ROWS = 12

DBC = """VERSION "1"
NS_ :
BS_:
BU_: BMS VCU
BO_ 256 BMS_Status: 8 BMS
 SG_ PackCurrent : 7|16@0- (0.1,0) [-1000|1000] "A" VCU
 SG_ PackVoltage : 23|16@0+ (0.1,0) [0|1000] "V" VCU
 SG_ Counter : 48|4@1+ (1,0) [0|15] "" VCU
BO_ 2566844926 BMS_Temp: 8 BMS
 SG_ Selector M : 0|8@1+ (1,0) [0|255] "" VCU
 SG_ PackTemperature m2 : 8|8@1- (0.5,-40) [-40|80] "degC" VCU
 SG_ DisplaySoc m1 : 8|16@1+ (0.1,0) [0|100] "%" VCU
CM_ SG_ 256 PackCurrent "positive charges";
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 256 10;
VAL_ 256 PackVoltage 65535 "not available" ;
SIG_VALTYPE_ 256 PackCurrent : 0;
SG_MUL_VAL_ 2566844926 PackTemperature Selector 2-2;
"""

MAP = """name = "my car"
dbc = "car.dbc"
temperature_source = "pack"
pair_within_s = 0.02
[current]
message = "BMS_Status"
signal = "PackCurrent"
sign = -1
scale = 1.0
timeout_s = 2.0
[voltage]
signal = "PackVoltage"
not_available = [65534]
[temperature]
message = 0x18FEF1FE
signal = "PackTemperature"
when = { Selector = 2 }
[soc_reference]
signal = "DisplaySoc"
offset = 0.0
[messages.BMS_Status]
protection = "mine"
period_s = 0.01
[rules.mine]
polynomial = 0x2F
initial = 0xFF
crc_byte = 7
counter_byte = 6
counter_bits = 4
"""

CONFIG = """model = "model.json"
interface = "udp_multicast"
channel = "239.74.163.2"
vehicle = "leaf_aze0"
temperature = 21.5
temperature_source = "pack"
method = "ekf"
initial_soc = "auto"
initial_soc_std = 1
capacity_ah = 51.5
max_gap_s = 2.0
pair_within_s = 0.02
time_source = "receive"
timeout_s = 2.0
record = "drive.log"
duration_s = 60
until_idle_s = 3
[bus_options]
bitrate = 500000
fd = false
[ids]
soc_estimate = 0x5A0
soc_detail = 1441
"""

OWN_CAR = 'model = "model.json"\ndbc = "car.dbc"\nmap = "car.toml"\ninitial_soc = 80\n'


def current_a(row: int) -> float:
    """Return a stepping current, positive = discharge [A]."""
    return 40.0 if row % 2 else -10.0


def log_rows() -> list[tuple[float, ...]]:
    """Return rows of time [s], current [A], voltage [V], temperature [°C], SoC [%]."""
    return [
        (k / 10, current_a(k), 380.0 - 0.1 * current_a(k), 21.0, 80.0 - k / 100)
        for k in range(ROWS)
    ]


def csv_log() -> bytes:
    """Return a canonical log as CSV."""
    head = "time_s,current_a,voltage_v,temperature_c,soc_pct,temperature_source\n"
    return (
        head + "".join(",".join(f"{v:g}" for v in row) + ",pack\n" for row in log_rows())
    ).encode()


def parquet_log(*, checked: bool = False, compression: str = "none") -> bytes:
    """Return a canonical log as Parquet; without checksums mutants reach the decoder."""
    names = ("time_s", "current_a", "voltage_v", "temperature_c", "soc_pct")
    columns = dict(zip(names, map(list, zip(*log_rows(), strict=True)), strict=True))
    table = pa.table({**columns, "temperature_source": ["pack"] * ROWS})
    out = io.BytesIO()
    pq.write_table(table, out, write_page_checksum=checked, compression=compression)
    return out.getvalue()


def _table(head: str, row: str, mark: str = "\n") -> bytes:
    lines = [
        row.format(t=t, i=i, n=-i, u=u, T=temp, s=soc, k=round(10 * t) + 1)
        for t, i, u, temp, soc in log_rows()
    ]
    return (head + mark + "".join(line + mark for line in lines)).encode("latin-1")


@cache
def log_files() -> dict[str, bytes]:
    """Return a small file of every log format, by file name."""
    d3 = {
        "2012": (
            "Timestamp [sec]\tDyno Speed [mph]\tCell Temp [C]\tPhase #"
            "\tHV Battery Voltage w/500A max clamp [V]\tHV Battery Current w/500A max clamp [A]",
            "{t}\t0\t{T}\t1\t{u}\t{i}",
        ),
        "2013": (
            "Time[sec]\tDyno_Speed[mph]\tTest_Cell_Temp[C]\tHV_Battery_SOC[%]"
            "\tHV_Battery_Current[A]\tHV_Battery_Voltage[V]",
            "{t}\t0\t{T}\t{s}\t{i}\t{u}",
        ),
        "later": (
            "DAQ_Time[s]\tDyno_Spd[mph]\tCell_Temp[C]\tHVBatt_voltage_CAN5__V"
            "\tHVBatt_current_wide_CAN5__A\tHVBatt_SOC_CAN5__per",
            "{t}\t0\t{T}\t{u}\t{n}\t{s}",
        ),
    }
    files = {
        "log.csv": csv_log(),
        "log;.csv": csv_log().replace(b",", b";").replace(b".", b","),
        "utf16.csv": csv_log().decode().encode("utf-16"),
        "log.parquet": parquet_log(),
        "checked.parquet": parquet_log(checked=True, compression="snappy"),
        "TripA01.csv": _table(
            "Time [s];Velocity [km/h];Battery Voltage [V];Battery Current [A];"
            "Battery Temperature [°C];SoC [%];max. SoC [%)",
            "{t};0;{u};{n};{T};{s};90",
            "\r\n",
        ),
        "A123_OCV_P25_S1.csv": _table(
            "Data_Point,Test_Time(s),Date_Time,Step_Index,Current(A),Voltage(V)",
            "{k},{t},09/23/2013 16:21:09,1,{n},{u}",
        ),
        "A123_DYN_50_P25_s1.csv": _table(
            "time, step, current, voltage, chgAh, disAh", "{t}, 1.0, {i}, {u}, 0.0, 0.0"
        ),
        "Cell-HPPC-10C.csv": _table(
            "No,0.0,1,1,1,1,1,0.0,1.00,381.0,0.0,0.00,0.00,DCHG, ,",
            "No,{k}.0,1,1,1,1,1,{t},{n},{u},0.0,0.00,0.00,DCHG, ,",
            "\r\n",
        ),
        "module.csv": _table(
            "Test Name,170410\nNotes, 5.25b\n\n"
            "Total Time,Cycle,Current,Voltage,Amp-Hours,Temperature A1,Temperature A2,Mode,",
            "{k}.0,1,{n},{u},0,22,23,DCHG,",
        )
        + b"Total Number of Data Lines in the Database: 0000000012\n",
    }
    files["x.bdf.csv"] = _table(
        "Test Time / s,Voltage / V,Current / A,Cycle Count / 1,Ambient Temperature / degC,"
        "Surface Temperature T1 / degC",
        "{t},{u},{n},1,21,{T}",
    )
    files["bds.csv"] = _table(
        "test_time_s,voltage_v,current_a,date_time,ambient_temperature_deg_c,temperature_t1_deg_c",
        "{t},{u},{n},,{T},",
    )
    for spelling, (head, row) in d3.items():
        files[f"{spelling} Test Data.txt"] = _table(head, row, "\r\n")
    files["log.csv.gz"] = gzip.compress(files["log.csv"], mtime=0)
    files["leaf.zip"] = zipped("61201019 Test Data.txt", files["2012 Test Data.txt"])
    return files


def zipped(name: str, data: bytes) -> bytes:
    """Return a zip of one test and a document."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo(name), data)
        archive.writestr(zipfile.ZipInfo("readme.pdf"), b"%PDF")
    return out.getvalue()


@cache
def leaf_frames() -> tuple[can.Message, ...]:
    """Return the rows as frames of a Leaf."""
    encoder = FrameEncoder(Vehicle.load("leaf_aze0"))
    frames: list[can.Message] = []
    for t, i, u, temp, soc in log_rows():
        for frame in encoder.encode(Sample(1000.0 + t, i, u, temp), soc):
            frame.channel = "can0"
            frames.append(frame)
    return tuple(frames)


def _hex(frame: can.Message, separator: str = " ") -> str:
    return frame.data.hex(" ").upper().replace(" ", separator)


_TEXTS: dict[str, tuple[str, Callable[[can.Message], str]]] = {
    "spaced.txt": (
        "", lambda f: f"{f.timestamp:.6f} {f.arbitration_id:08X} {f.dlc} {_hex(f)}\r\n"
    ),
    "table.csv": (
        "ParserFlags\tCh\tCounter\tT/R\tTime\tFlags\tCAN ID\tLen\tData\tParser\n",
        lambda f: f"1\t0\t1\tRX\t{1000 * f.timestamp:.0f}\t\t0x{f.arbitration_id:08x}\t{f.dlc}"
        f"\t0x{_hex(f)} \tDefault\n",
    ),
    "ovms.crtd": (
        "1000.000000 CXX OVMS CRTD\n",
        lambda f: f"{f.timestamp:.6f} 1R11 {f.arbitration_id:03x} {_hex(f)}\n",
    ),
    "screen.txt": (
        "", lambda f: f"  can0  {f.arbitration_id:03X}   [{f.dlc}]  {_hex(f)}\n"
    ),
    "stamped.txt": (
        "", lambda f: f" ({f.timestamp:.6f})  can0  RX - -  {f.arbitration_id:03X}   [{f.dlc}]"
        f"  {_hex(f)}\n",
    ),
    "candump.log": (
        "", lambda f: f"({f.timestamp:.6f}) can0 {f.arbitration_id:03X}#{_hex(f, '')}\n",
    ),
    "gvret.csv": (
        "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n",
        lambda f: f"{1e6 * f.timestamp:.0f},{f.arbitration_id:08X},false,Rx,0,{f.dlc}"
        f",{_hex(f, ',')},\n",
    ),
    "gvret_without_way.csv": (
        "\ufeffTime Stamp,ID,Extended,Bus,DLC,D1,D2,D3,D4,D5,D6,D7,D8\n",
        lambda f: f"{1e6 * f.timestamp:.0f},{f.arbitration_id:x},0,1,{f.dlc},{_hex(f, ',')}\n",
    ),
    "id_data.csv": ("ID,Data Bytes\n", lambda f: f"{f.arbitration_id:08X},{_hex(f)} \n"),
    "carbus.trc": (
        "@ TEXT @ 3 @ 64 @ 0 @ 48 @ 1100 @ 00:00:01.100 @\r",
        lambda f: f"{int(f.timestamp)},{round(1e6 * f.timestamp) % 1000000:06}\t1\t00000004"
        f"\t{f.arbitration_id:03X}\t{f.dlc}\t{_hex(f)}\t00000000\t        \t\r",
    ),
    "can_hacker.log": (
        "CAN speed 1: 500k CAN speed 2: 500k Id format: HEX | Data format: HEX\n\t \n",
        lambda f: f">\t0\t   0:16:{f.timestamp - 960.0:.0f}."
        f"{round(1e3 * f.timestamp) % 1000}:10.00\tSt\t0x{f.arbitration_id:X}\t0\t{f.dlc}"
        f"\t{_hex(f, chr(9))}\tp:1\n",
    ),
}  # fmt: skip
_WRITERS: dict[str, Callable[..., can.io.generic.MessageWriter]] = {
    "x.asc": can.ASCWriter,
    "x.blf": can.BLFWriter,
    "x.csv": can.CSVWriter,
    "x.trc": can.TRCWriter,
}


@cache
def capture_files() -> dict[str, bytes]:
    """Return a small file of every capture format, by file name (MF4 if asammdf is installed)."""
    files = {}
    for name, (head, line) in _TEXTS.items():
        files[name] = (head + "".join(map(line, leaf_frames()))).encode()
    for name in _WRITERS:
        files[name] = _written(name)
    # Uncompressed, so that mutants reach the content of a container.
    files["plain.blf"] = _written("x.blf", compression_level=0)
    files["candump.log.gz"] = gzip.compress(files["candump.log"], mtime=0)
    files["x.pcap"] = _pcap()
    files["x.pcapng"] = _pcapng()
    mf4 = _mf4()
    return files if mf4 is None else files | {"x.mf4": mf4}


def _written(name: str, **options: int) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        with _WRITERS[name](path, **options) as writer:
            for frame in leaf_frames():
                writer.on_message_received(_on_channel_0(frame))
        return path.read_bytes()


def _on_channel_0(frame: can.Message) -> can.Message:
    return can.Message(
        timestamp=frame.timestamp,
        arbitration_id=frame.arbitration_id,
        is_extended_id=frame.is_extended_id,
        data=frame.data,
        channel=0,
    )


def _socketcan(frame: can.Message) -> bytes:
    return struct.pack(">IBBxx", frame.arbitration_id, frame.dlc, 0) + frame.data.ljust(8, b"\0")


def _pcap() -> bytes:
    out = [struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, 227)]
    for frame in leaf_frames():
        packet = _socketcan(frame)
        seconds, ticks = divmod(round(1e6 * frame.timestamp), 1_000_000)
        out.append(struct.pack("<IIII", seconds, ticks, len(packet), len(packet)) + packet)
    return b"".join(out)


def _pcapng() -> bytes:
    def block(kind: int, body: bytes) -> bytes:
        size = struct.pack("<I", len(body) + 12)
        return struct.pack("<I", kind) + size + body + size

    options = struct.pack("<HH4sHH", 2, 4, b"can0", 9, 1) + b"\x09\0\0\0" + bytes(4)
    out = [
        block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)),
        block(1, struct.pack("<HHI", 227, 0, 262144) + options),
    ]
    for frame in leaf_frames():
        packet = _socketcan(frame)
        high, low = divmod(round(1e9 * frame.timestamp), 1 << 32)
        head = struct.pack("<IIIII", 0, high, low, len(packet), len(packet))
        out.append(block(6, head + packet))
    return b"".join(out)


def _mf4() -> bytes | None:
    try:
        import asammdf  # noqa: F401, PLC0415 - an extra
    except ModuleNotFoundError:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.mf4"
        with can.MF4Writer(path) as writer:
            for frame in leaf_frames():
                writer.on_message_received(_on_channel_0(frame))
        return path.read_bytes()


@cache
def mf4_signals() -> bytes | None:
    """Return the rows as MF4 signals on two rasters, None without asammdf."""
    try:
        import asammdf  # noqa: PLC0415 - an extra
        import numpy as np  # noqa: PLC0415
    except ModuleNotFoundError:
        return None
    times, current, voltage, temperature, soc = np.array(log_rows()).T
    signal = asammdf.Signal
    with tempfile.TemporaryDirectory() as folder, asammdf.MDF() as file:
        fast = [
            signal(current, times, unit="A", name="PackCurrent"),
            signal(voltage, times, unit="V", name="PackVoltage"),
        ]
        slow = [
            signal(temperature[::4], times[::4], unit="°C", name="PackTemperature"),
            signal(soc[::4], times[::4], unit="%", name="SoC"),
        ]
        file.append(fast)
        file.append(slow)
        path = Path(folder) / "x.mf4"
        file.save(path)
        return path.read_bytes()


@cache
def model_tree() -> dict[str, Any]:
    """Return the content of a model file with all effects and an information matrix."""
    path = shared_file("replay", "leaf2012_published_model.json")
    file = Model.load(path)
    tree: dict[str, Any] = json.loads(file.to_json())
    pack = Pack.of(file.voltage_model(), file.capacity_ah)
    tree["effects"] = effect_entries(
        [(effect, {p.name: _somewhere(p, pack) for p in effect.parameters})
         for effect in LIBRARY.values()]
    )  # fmt: skip
    names = list(tree["published"]["coefficients"])
    n = len(names)
    tree["information"] = {
        "columns": names,
        "root": [[float(i == k) for k in range(n)] for i in range(n)],
        "projected": [0.5] * n,
    }
    return tree


def _somewhere(parameter: Parameter, pack: Pack) -> float:
    low, high = parameter.bounds(pack)
    return low + 0.3 * (high - low)
