"""The SoC belongs to what decodes current and voltage: over restarts, and over reloads."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from cangauge._resources import shared_file
from cangauge.bus.vehicle import Vehicle
from cangauge.service.run import Service
from cangauge.service.setup import Setup
from cangauge.service.state import StateKeeper
from cangauge.types import Reason, Status
from live import LoggedLines, frames_of, leaf_model_path, short_log

MAP = """dbc = ["pack.dbc"]
[current]
signal = "current_a"
sign = {sign}
[voltage]
signal = "voltage_v"
{voltage}
[temperature]
signal = "temperature_c"
"""


class Car:
    """A service with a map file of two changing lines."""

    def __init__(self, folder: Path, sign: int = 1) -> None:
        self.folder = folder
        shutil.copy(shared_file("dbc", "generic_pack.dbc"), folder / "pack.dbc")
        self.write(sign)
        path = folder / "run.toml"
        path.write_text(f'model = "{leaf_model_path()}"\nmap = "car.toml"\ninitial_soc = 80\n')
        self.service = Service(path)
        self.pipeline = self.service.pipeline

    def write(self, sign: int = 1, voltage: str = "") -> None:
        (self.folder / "car.toml").write_text(MAP.format(sign=sign, voltage=voltage))

    def drive(self, seconds: float, shift_s: float = 0.0) -> None:
        for frame in frames_of(short_log(seconds), shift_s=shift_s):
            self.pipeline.handle(frame)

    def reload(self) -> str:
        with LoggedLines("cangauge.service.run") as logged:
            self.service.apply(Setup.of(self.service.config))
        return logged.lines[0]


def test_a_state_is_continued_with_the_map_that_decoded_it_only(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    car = Car(tmp_path)
    car.drive(100.0)
    StateKeeper(path, car.pipeline, "bus", 1e9).__exit__()
    for voltage, sign, is_same in (("highest = 900.0", 1, True), ("", -1, False)):
        car.write(sign, voltage)
        next_one = Service(tmp_path / "run.toml")
        with StateKeeper(path, next_one.pipeline, "bus", 1e9) as keeper:
            assert keeper.restored is is_same


def test_a_reload_that_changes_the_sign_starts_from_the_voltage(tmp_path: Path) -> None:
    car = Car(tmp_path, sign=-1)
    car.drive(300.0)
    car.write(sign=1)
    said = car.reload()
    assert "content of map or DBC; current or voltage are decoded otherwise" in said
    assert car.pipeline.estimate_now().status is Status.INITIALISING
    assert car.pipeline.snapshot() is None
    car.drive(300.0, shift_s=300.0)
    after = car.pipeline.latest
    assert not after.reasons & (Reason.MODEL_MISMATCH | Reason.SIGN_SUSPECT)
    assert after.soc_pct == pytest.approx(77.0, abs=3.0 * after.soc_std_pct)


def test_a_reload_of_a_check_continues_and_says_what_changed(tmp_path: Path) -> None:
    car = Car(tmp_path)
    car.drive(100.0)
    before = car.pipeline.latest.soc_pct
    car.write(voltage="highest = 900.0")
    assert car.reload() == "configuration reloaded; changed: content of map or DBC"
    assert car.pipeline.latest.soc_pct == before
    assert car.reload().endswith("changed: nothing")


def test_another_battery_of_the_same_units_is_another(tmp_path: Path) -> None:
    assert Vehicle.load("generic").battery != Vehicle.load("leaf_ze0").battery
    car = Car(tmp_path)
    assert car.pipeline.vehicle.battery == Vehicle.load("generic").battery
