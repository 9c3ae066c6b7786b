"""Ten kinds of files, each from file to SoC plot in at most three commands.

    pip install 'cangauge[mf4]' scapy batterydf pandas
    python examples/own_data.py FOLDER

Makes each file by a tool of its kind, where that is installed, and takes one real export from the
source package of battery-data-toolkit. Runs the commands of `docs/logs.md` and `docs/captures.md`,
and prints what each gave. `--kind NAME` runs one kind, `--hours H` shortens the drives.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tarfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import can
import numpy as np

import cangauge
from cangauge.replay.encoder import FrameEncoder

MY_DBC = """VERSION ""
NS_ :
BS_:
BU_: BMS
BO_ 848 BMS_Power: 8 BMS
 SG_ I_Batt : 7|16@0- (0.1,0) [-1000|1000] "A" BMS
 SG_ U_Batt : 23|16@0+ (0.05,0) [0|1000] "V" BMS
BO_ 849 BMS_State: 8 BMS
 SG_ T_Batt : 0|8@1+ (1,-40) [-40|100] "degC" BMS
 SG_ SoC_Display : 8|16@1+ (0.01,0) [0|100] "%" BMS
"""
MY_MAP = """name = "my car"
dbc = "mycar.dbc"
temperature_source = "pack"
[current]
message = "BMS_Power"
signal = "I_Batt"
sign = -1
[voltage]
message = "BMS_Power"
signal = "U_Batt"
[temperature]
message = "BMS_State"
signal = "T_Batt"
[soc_reference]
message = "BMS_State"
signal = "SoC_Display"
"""


class Kind(NamedTuple):
    """A kind of file: how one is made, its suffix, options that it needs, and more for the fit."""

    write: Callable[[cangauge.Log, Path], None]
    suffix: str
    options: list[str]
    fit: Sequence[str] = ()


def frames(log: cangauge.Log, vehicle: cangauge.Vehicle) -> Iterator[can.Message]:
    """Yield a log as frames of a vehicle, with stamps from 1970."""
    encoder = FrameEncoder(vehicle)
    assert log.soc_pct is not None
    columns = (log.time_s, log.current_a, log.voltage_v, log.temperature_c)
    samples = map(cangauge.Sample._make, zip(*(each.tolist() for each in columns), strict=True))
    for sample, soc_pct in zip(samples, log.soc_pct.tolist(), strict=True):
        for frame in encoder.encode(sample, soc_pct):
            frame.timestamp = 1.75e9 + sample.time_s
            yield frame


def write_mf4(log: cangauge.Log, path: Path) -> None:
    """Write signals on three rasters by asammdf, as calibration tools do."""
    import asammdf

    def signal(name: str, unit: str, values: np.ndarray, every: int) -> asammdf.Signal:
        return asammdf.Signal(values[::every], log.time_s[::every], unit=unit, name=name)

    assert log.soc_pct is not None
    with asammdf.MDF(version="4.10") as file:
        file.append([signal("BMS_PackCurrent", "A", -log.current_a, 1)])
        file.append([signal("BMS_PackVoltage", "V", log.voltage_v, 1)])
        file.append([signal("BMS_PackTemperature", "°C", log.temperature_c, 20)])
        file.append([signal("BMS_Soc", "%", log.soc_pct, 20)])
        file.save(path, overwrite=True)


def packets(log: cangauge.Log, vehicle: str) -> list[Any]:
    """Return SocketCAN packets of scapy."""
    from scapy.layers.can import CAN

    made = []
    for frame in frames(log, cangauge.Vehicle.load(vehicle)):
        packet = CAN(identifier=frame.arbitration_id, length=frame.dlc, data=bytes(frame.data))
        packet.time = frame.timestamp
        made.append(packet)
    return made


def write_pcap(log: cangauge.Log, path: Path) -> None:
    """Write SocketCAN frames by scapy, as tcpdump -i can0 captures them."""
    from scapy.utils import wrpcap

    wrpcap(str(path), packets(log, "generic"))


def write_pcapng(log: cangauge.Log, path: Path) -> None:
    """Write the same by scapy as PCAPNG, Wireshark's own format."""
    from scapy.utils import wrpcapng

    wrpcapng(str(path), packets(log, "leaf_aze0"))


def write_gvret(log: cangauge.Log, path: Path) -> None:
    """Write SavvyCAN's own CSV."""
    with path.open("w") as file:
        file.write("Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n")
        for frame in frames(log, cangauge.Vehicle.load("leaf_aze0")):
            time_us = round((frame.timestamp - 1.75e9) * 1e6)
            data = frame.data.ljust(8, b"\0").hex(",").upper()
            file.write(f"{time_us},{frame.arbitration_id:08X},false,Rx,0,{frame.dlc},{data},\n")


def write_carbus(log: cangauge.Log, path: Path) -> None:
    """Write a trace of CARBUS Analyzer, of a car that only its DBC describes."""
    (path.parent / "mycar.dbc").write_text(MY_DBC)
    (path.parent / "mycar.toml").write_text(MY_MAP)
    vehicle = cangauge.Vehicle.load(map=path.parent / "mycar.toml")
    with path.open("w", newline="") as file:
        file.write("@ TEXT @ 3 @ 64 @ 0 @ 0 @ 0 @ 00:00:00.000 @\r")
        for frame in frames(log, vehicle):
            seconds, micros = divmod(round((frame.timestamp - 1.75e9) * 1e6), 1_000_000)
            data = frame.data.hex(" ").upper()
            file.write(
                f"{seconds},{micros:06}\t1\t00000004\t{frame.arbitration_id:03X}\t{frame.dlc}"
                f"\t{data:23}\t00000000\t{'':8}\t\r"
            )


def write_bdf(log: cangauge.Log, path: Path) -> None:
    """Write the Battery Data Format by its own package."""
    import pandas as pd
    from bdf.io import save

    save(
        pd.DataFrame(
            {
                "Test Time / s": log.time_s,
                "Voltage / V": log.voltage_v,
                "Current / A": -log.current_a,
                "Surface Temperature T1 / degC": log.temperature_c,
            }
        ),
        path,
        human=True,
    )


def write_table(
    log: cangauge.Log, path: Path, headings: Sequence[str], scale: Sequence[float], **style: Any
) -> None:
    """Write time, current, voltage, temperature and SoC by pandas, under a logger's headings."""
    import pandas as pd

    assert log.soc_pct is not None
    columns = (log.time_s, -log.current_a, log.voltage_v, log.temperature_c, log.soc_pct)
    table = {
        name: factor * values for name, factor, values in zip(headings, scale, columns, strict=True)
    }
    pd.DataFrame(table).to_csv(path, index=False, **style)


def write_german(log: cangauge.Log, path: Path) -> None:
    """Write a German export: semicolons, decimal commas, Windows-1252."""
    names = ["Messzeit [min]", "Batteriestrom [A]", "Batteriespannung [V]",
             "Zelltemperatur [°C]", "Ladezustand [%]"]  # fmt: skip
    style = {"sep": ";", "decimal": ",", "encoding": "cp1252"}
    write_table(log, path, names, [1 / 60, 1.0, 1.0, 1.0, 1.0], **style)


def write_utf16(log: cangauge.Log, path: Path) -> None:
    """Write tab-separated UTF-16 without a BOM."""
    names = ["Time (s)", "Current (A)", "Voltage (V)", "Temperature (°C)", "SOC (0-1)"]
    style = {"sep": "\t", "encoding": "utf-16-le"}
    write_table(log, path, names, [1.0, 1.0, 1.0, 1.0, 0.01], **style)


def write_bzip2(log: cangauge.Log, path: Path) -> None:
    """Write Neware's headings, packed by bzip2."""
    names = ["Test_Time(s)", "Cur(mA)", "Vol(mV)", "T_batt", "SOC"]
    write_table(log, path, names, [1.0, 1e3, 1e3, 1.0, 1.0], compression="bz2")


KINDS = {
    "MF4 signals": Kind(write_mf4, ".mf4", []),
    "PCAP": Kind(write_pcap, ".pcap", ["--vehicle", "generic"]),
    "PCAPNG": Kind(write_pcapng, ".pcapng", ["--vehicle", "leaf_aze0"]),
    "SavvyCAN GVRET": Kind(write_gvret, ".csv", ["--vehicle", "leaf_aze0"]),
    "CARBUS trace": Kind(write_carbus, ".trc", ["--map", "mycar.toml"]),
    "German CSV": Kind(write_german, ".csv", []),
    "UTF-16 text": Kind(write_utf16, ".txt", []),
    "CSV in bzip2": Kind(write_bzip2, ".csv.bz2", []),
    "Battery Data Format": Kind(write_bdf, ".bdf.csv", [], ["--initial-soc", "100"]),
}
ARBIN = "Arbin export"
ARBIN_OPTIONS = ["--sign", "charge"]
"""This export does not say that positive current charges, and its drive is too short to show it."""


def run(folder: Path, *arguments: str) -> tuple[dict[str, object], str]:
    """Run a command of cangauge; return its JSON and its notes."""
    command = [sys.executable, "-m", "cangauge", *arguments, "--json"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(arguments)}: {done.stderr.strip()}")
    return json.loads(done.stdout), done.stderr


def fetch_arbin(folder: Path) -> str | None:
    """Fetch the real export by pip; None where that is not possible."""
    name = "battery-data-toolkit"
    command = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--no-binary", name,
               "-d", str(folder), f"{name}==0.4.6"]  # fmt: skip
    subprocess.run(command, capture_output=True, check=False)
    for archive in folder.glob("battery_data_toolkit-*.tar.gz"):
        with tarfile.open(archive) as content:
            member = content.extractfile(f"{archive.name[:-7]}/tests/files/arbin_example.csv")
            if member is not None:
                (folder / "arbin.csv").write_bytes(member.read())
                return "arbin.csv"
    return None


def shown(value: object) -> str:
    """Return a result as text, numbers with three digits."""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def show(name: str, commands: list[list[str]], folder: Path) -> None:
    """Run the commands of a kind and print what they gave."""
    print(f"\n{name}")
    assumed = ""
    for arguments in commands:
        began_s = time.perf_counter()
        result, notes = run(folder, *arguments)
        seconds = time.perf_counter() - began_s
        assumed = assumed or next((each for each in notes.splitlines() if "read as" in each), "")
        keys = ("format", "frames", "rows", "capacity_ah", "voltage_mae_pct", "soc_mae_pct")
        found = [
            f"{key} {shown(result[key])}"
            for key in keys
            if isinstance(result.get(key), int | float | str)
        ]
        print(f"  cangauge {' '.join(arguments)}\n    {', '.join(found)} ({seconds:.1f} s)")
    if assumed:
        print(f"  {assumed}")


def main() -> None:
    """Make the files, run the commands, print the outcome."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kind", choices=[*KINDS, ARBIN])
    parser.add_argument("--hours", type=float, default=1.0)
    options = parser.parse_args()
    folder = options.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    weather: dict[str, Any] = {"seed": 5, "ambient_c": 20.0}
    full = cangauge.simulate(drive=1, discharge=True, hours=2.5 * options.hours, **weather).log
    trip = cangauge.simulate(drive=9, start_soc_pct=80.0, hours=options.hours, **weather).log
    for name, kind in KINDS.items():
        if options.kind not in {None, name}:
            continue
        place = folder / name.replace(" ", "_")
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        full_name, trip_name = f"full{kind.suffix}", f"trip{kind.suffix}"
        try:
            kind.write(full, place / full_name)
            kind.write(trip, place / trip_name)
        except ImportError as error:
            print(f"\n{name}: skipped ({error})")
            continue
        commands = [
            ["inspect", trip_name, *kind.options],
            ["fit", full_name, *kind.options, *kind.fit, "-o", "pack.json"],
            ["estimate", trip_name, *kind.options, "-m", "pack.json", "-o", "soc.csv",
             "--report", "soc.html"],
        ]  # fmt: skip
        show(name, commands, place)
    if options.kind in {None, ARBIN}:
        place = folder / ARBIN.replace(" ", "_")
        place.mkdir(exist_ok=True)
        arbin = fetch_arbin(place)
        if arbin is None:
            print(f"\n{ARBIN}: skipped (not to be fetched)")
            return
        start = ["--initial-soc", "82"]
        commands = [
            ["inspect", arbin, *ARBIN_OPTIONS],
            ["fit", arbin, *ARBIN_OPTIONS, *start, "--capacity-ah", "1.07", "-o", "pack.json"],
            ["estimate", arbin, *ARBIN_OPTIONS, *start, "-m", "pack.json", "-o", "soc.csv",
             "--report", "soc.html"],
        ]  # fmt: skip
        show(ARBIN, commands, place)


if __name__ == "__main__":
    main()
