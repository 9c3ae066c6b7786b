"""`cangauge init`: files that decode the car, refusals, choices, known vehicles and a DBC."""

from __future__ import annotations

import os
import re
import threading
import time
from pathlib import Path

import can
import pytest

from cangauge.bus.captures import open_capture
from cangauge.bus.open import bus_address, open_bus
from cangauge.bus.recording import capture_to_log
from cangauge.bus.vehicle import Vehicle
from cangauge.logs.sign import sign_of_current
from cangauge.service.config import load_config
from cangauge.service.setup import load_vehicle
from drive_captures import CARS, capture
from live import in_process, refused, succeeds
from selection import nightly_except


def write_drive(path: Path, seconds: float) -> Path:
    car = next(each for each in CARS if each.name == "mitsubishi")
    with can.CanutilsLogWriter(path) as writer:
        for message in capture(car, seconds=seconds):
            message.channel = "can0"
            writer.on_message_received(message)
    return path


@pytest.fixture(scope="module")
def mitsubishi(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("captures") / "drive.log", 30.0)


DBC = (
    'VERSION "1"\nNS_ :\nBS_:\nBU_: V\nBO_ 883 BMS_Status: 8 V\n'
    ' SG_ PackCurrent : 23|16@0+ {scale} [0|0] "A" V\n'
    ' SG_ PackVoltage : 39|16@0+ (0.1,0) [0|0] "V" V\n'
    ' SG_ MaxChargeCurrent : 7|8@0+ (1,0) [0|0] "A" V\n'
    ' SG_ MinCellVoltage : 15|8@0+ (0.02,0) [0|0] "V" V\n'
)
CHOICE = ("--choose", "current=1", "--choose", "voltage=1")


def test_an_unclear_pair_exits_with_one_and_names_three(mitsubishi: Path, tmp_path: Path) -> None:
    done = in_process("init", mitsubishi, "-o", tmp_path / "car")
    assert done.code == 1
    assert "1   0x373 23|16@0+" in done.out
    assert done.out.startswith("No map: no current and no voltage is clearly the pack's")
    assert "the scale of the voltage is open (--nominal-voltage V decides it)" in done.err
    assert "0x373" not in done.err  # the tables name them
    assert "by halves" not in done.out
    assert "voltage falls when" in done.out
    assert done.err.endswith("choose by --choose current=N --choose voltage=N\n")  # it has steps
    assert not list((tmp_path / "car").glob("*"))


def test_chosen_candidates_make_files_that_decode(mitsubishi: Path, tmp_path: Path) -> None:
    given = ("init", mitsubishi, "-o", tmp_path / "car", *CHOICE, "--nominal-voltage", 330)
    result = succeeds(*given, "--json").json
    assert result["method"] == "physics"
    assert len(result["candidates"]["current"]) == 3
    assert result["proof"]["samples"] > 2900
    assert result["voltage_levels"] == []  # the stated voltage decides
    log = capture_to_log(mitsubishi, Vehicle.load(map=tmp_path / "car" / "car.toml"))
    assert 280.0 < log.voltage_v.min() < log.voltage_v.max() < 350.0
    assert log.current_a.max() - log.current_a.min() > 200.0
    config = load_config(tmp_path / "car" / "run.toml")
    assert Path(str(config.map)).name == "car.toml"
    assert "--force" in in_process(*given).err
    succeeds(*given, "--force")


@pytest.mark.parametrize(
    ("scale", "sign"),
    nightly_except([("(-0.01,327.68)", -1)], [("(0.01,-327.68)", 1), ("(-0.01,327.68)", -1)]),
)
def test_a_dbc_gives_signals_by_name_and_their_sign_is_proven(
    tmp_path: Path, scale: str, sign: int
) -> None:
    minute = write_drive(tmp_path / "drive.log", 60.0)
    (tmp_path / "car.dbc").write_text(DBC.format(scale=scale))
    done = succeeds("init", minute, "--dbc", tmp_path / "car.dbc", "-o", tmp_path / "out")
    assert f"The map has sign = {sign}." in done.err
    assert ("positive values charge on this bus" in done.err) == (sign < 0)
    assert "the files assume 20 °C" in done.err
    answer, _, tables = done.out.partition("\n")
    assert answer.startswith("Found by names: current BMS_Status.PackCurrent, voltage BMS_Status")
    table = tables.partition("voltage")[0]
    ends, *_ = re.findall(r"(\S+ … \S+ A)", table)
    assert ends in done.err  # one range, of one sign, of the whole capture
    assert ends in (tmp_path / "out" / "car.toml").read_text(encoding="utf-8")
    assert "BMS_Status" in table
    assert "PackCurrent" in table
    assert "score" not in table
    car = Vehicle.load(map=tmp_path / "out" / "car.toml")
    assert (car.current.codec.name, car.voltage.codec.name) == ("PackCurrent", "PackVoltage")
    assert sign_of_current(capture_to_log(minute, car)).sign == 1


def test_an_open_scale_is_listed_and_not_ticked(mitsubishi: Path, tmp_path: Path) -> None:
    without = in_process("init", mitsubishi, "-o", tmp_path / "without", *CHOICE)
    assert "SoC: no candidate is certain, so the map has none" in without.err
    done = in_process("init", mitsubishi, "-o", tmp_path, *CHOICE, "--choose", "soc=1")
    assert "SoC: it stands still in at least one half of the capture" in done.err  # 45 … 45.4 %
    assert "1 ?" in done.out
    assert "1 ✓" not in done.out
    assert "V at 0.1 V a step of 16 bits (about" in done.err
    assert "do not tell the scale of the voltage" in done.err
    assert "do not tell the scale of the SoC" in done.err
    assert "% a step (" in done.err  # each with the capacity that follows
    assert "the data fit as well: " in (tmp_path / "car.toml").read_text(encoding="utf-8")


def test_what_is_not_there_cannot_be_chosen(mitsubishi: Path, tmp_path: Path) -> None:
    given = ("init", mitsubishi, "-o", tmp_path / "car")
    refused(in_process(*given, "--choose", "current=9"), "there are 3 candidates")
    refused(in_process(*given, "--interface", "virtual"), "omit one")
    error = in_process(*given, "--json").json["error"]
    assert "current: 1) 0x373 23|16@0+, 2) " in error["message"]
    assert not (tmp_path / "car").exists()


def test_nothing_to_look_at_is_refused(tmp_path: Path) -> None:
    refused(in_process("init", "-o", tmp_path), "give a capture")
    assert in_process("init", "x.log").code == 2
    refused(in_process("init", "x.log", "-o", tmp_path, "--choose", "speed=1"), "not ROLE=N")


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "preset"),
    [
        pytest.param("leaf_can/EV-CANeplus2.log.gz", "leaf_ze1_polled", marks=pytest.mark.nightly),
        ("leaf_can/62kWh-Battery-only-EVcan.txt.gz", "leaf_ze1"),
        ("leaf_can/10bars.csv.gz", "leaf_ze0"),
        ("can_captures/bmw_i3_battery_only.trc.gz", "bmw_i3"),
        ("can_captures/kona_2019_power_on_gvret.csv.gz", "hyundai_kona_64"),
    ],
)
def test_known_vehicles_are_recognised(
    shared_data: Path, tmp_path: Path, name: str, preset: str
) -> None:
    done = succeeds("init", shared_data / name, "-o", tmp_path, "--json")
    assert done.json["vehicle"] == preset
    config = load_config(tmp_path / "run.toml")
    assert load_vehicle(config).name == Vehicle.load(preset, temperature_c=20.0).name


def test_a_live_bus_is_listened_to(mitsubishi: Path, tmp_path: Path) -> None:
    port = 20_000 + (os.getpid() + 311) % 20_000
    bus = ("--interface", "udp_multicast", "--bus-option", f"port={port}")
    stop = threading.Event()

    def send() -> None:
        with open_bus(bus_address("udp_multicast", options={"port": port}), []) as sender:
            began_s = time.monotonic()
            for frame in open_capture(mitsubishi):
                if stop.wait(max(began_s + frame.timestamp / 12.0 - time.monotonic(), 0.0)):
                    return
                sender.send(frame)

    (tmp_path / "car.dbc").write_text(DBC.format(scale="(-0.01,327.68)"))
    thread = threading.Thread(target=send)
    thread.start()
    try:
        named = ("--dbc", tmp_path / "car.dbc", "-o", tmp_path / "car")
        done = succeeds("init", *bus, *named, "--seconds", "2", "--json")
    finally:
        stop.set()
        thread.join()
    assert done.json["proof"]["samples"] > 300
    config = load_config(tmp_path / "car" / "run.toml")
    assert config.interface == "udp_multicast"
    assert config.bus_options == {"port": port}
