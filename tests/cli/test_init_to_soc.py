"""From captures of an unknown car to a live SoC: `init`, `fit` and `run`."""

from __future__ import annotations

import os
from pathlib import Path

import can
import numpy as np
import pytest

from cangauge import simulate
from cangauge.logs.canonical import write_log
from frame_layouts import STEP_S, Bits, Frame, encode
from live import Command, Ended, in_process

PACK = Frame(
    0x100,
    0.1,
    signals={
        "voltage_v": Bits(0, 16, False, 0.1),
        "current_a": Bits(16, 16, False, 0.1, -500.0),
        "soc_pct": Bits(32, 16, False, 0.1),
    },
)
POWER = Frame(
    0x210,
    0.1,
    signals={"power_kw": Bits(0, 12, False, 0.1, -100.0)},
    counter=Bits(56, 4, False, 1.0),
    crc_byte=6,
)


def cangauge(*arguments: object, codes: tuple[int, ...] = (0,)) -> Ended:
    done = in_process(*arguments)
    assert done.code in codes, done.err
    return done


def drive(folder: Path, name: str, **options: float) -> None:
    """Write a capture NAME.log of a drive of the twin at 20 °C, and its truth as NAME.csv."""
    table = folder / f"{name}.csv"
    write_log(simulate(seed=5, ambient_c=20.0, **options).log, table)
    log = np.genfromtxt(table, delimiter=",", names=True, usecols=range(5))
    at = np.arange(log["time_s"][0], log["time_s"][-1], STEP_S)
    truth = {
        key: np.interp(at, log["time_s"], log[key]) for key in ("current_a", "voltage_v", "soc_pct")
    }
    truth["power_kw"] = truth["current_a"] * truth["voltage_v"] / 1000.0
    with can.CanutilsLogWriter(folder / f"{name}.log") as writer:
        for message in encode([PACK, POWER], truth, np.random.default_rng(0)):
            message.channel = "can0"
            writer.on_message_received(message)


@pytest.fixture(scope="module")
def car(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with captures, and what `init` and `fit` make of them."""
    folder = tmp_path_factory.mktemp("car")
    drive(folder, "full", discharge=True, hours=0.7)
    drive(folder, "trip", drive=2, hours=0.1)
    choice = ("--choose", "current=1", "--choose", "voltage=1", "--nominal-voltage", "420")
    trips, mine = (folder / "trip.log", folder / "full.log"), folder / "mycar"
    cangauge("init", *trips, "--no-presets", "-o", mine, *choice)
    cangauge("fit", trips[1], "--map", mine / "car.toml", "-o", mine / "model.json")
    return folder


def test_the_files_hold_the_cars_own_scales(car: Path) -> None:
    text = (car / "mycar" / "car.dbc").read_text()
    assert "current_a : 16|16@1+ (0.1,-500)" in text
    assert "voltage_v : 0|16@1+ (0.1,0)" in text
    assert "soc_pct : 32|16@1+ (0.1,0)" in text
    # Frames of 0.1 s pair within a little more than their period.
    assert "pair_within_s = 0.12 " in (car / "mycar" / "car.toml").read_text(encoding="utf-8")


def test_the_service_reaches_the_cars_soc(car: Path) -> None:
    bus = ("--interface", "udp_multicast", "--channel", "239.74.163.34",
           "--bus-option", f"port={22_000 + os.getpid() % 20_000}")  # fmt: skip
    socket = ("--status-socket", car / "run.sock")
    service = Command("run", "--config", car / "mycar" / "run.toml", *bus,
                      "--time-source", "replay-clock", *socket)  # fmt: skip
    service.wait_for("service.ready")
    try:
        played = (car / "trip.log", "--map", car / "mycar" / "car.toml", "--speed", "max")
        cangauge("replay", *played, *bus)
        # 1: the replay is over, its input stale.
        status = cangauge("status", "--endpoint", car / "run.sock", "--json", codes=(0, 1)).json
    finally:
        service.process.terminate()
        service.end()
    truth = np.genfromtxt(car / "trip.csv", delimiter=",", names=True, usecols=range(5))
    estimate = status["estimate"]
    assert abs(estimate["soc_pct"] - truth["soc_pct"][-1]) < 3.0 * estimate["soc_std_pct"]
    assert estimate["soc_std_pct"] < 5.0
