"""Captures of simulated drives with the layouts of public DBC files of several makes.

A minute of town traffic: speed, torque, current and voltage hang together as in a car, and every
bus carries what misleads a search: torque and power that follow the current, a second voltage at
the inverter, wheel speeds, counters, CRCs, limits and multiplexed temperatures.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import can
import numpy as np

from frame_layouts import Bits, Frame, encode


@dataclass(frozen=True)
class Car:
    """A make: frames, and where current and voltage of its pack are."""

    name: str
    frames: tuple[Frame, ...]
    current: tuple[int, Bits]
    voltage: tuple[int, Bits]
    charge_positive: bool = False
    volts: float = 360.0
    ohm: float = 0.09


def drive(seed: int, volts: float, ohm: float, seconds: float = 60.0) -> dict[str, np.ndarray]:
    """Return the physical signals of a drive at 100 Hz."""
    rng = np.random.default_rng(seed)
    n, dt = int(seconds * 100), 0.01
    target = np.zeros(n)
    at = 0
    while at < n:
        length = int(rng.uniform(200, 900))
        target[at : at + length] = rng.choice([0.0, 5.0, 9.0, 14.0, 18.0])
        at += length
    speed, acceleration = np.zeros(n), np.zeros(n)
    for k in range(1, n):
        wanted = np.clip(0.8 * (target[k] - speed[k - 1]), -2.5, 2.2)
        acceleration[k] = acceleration[k - 1] + 0.04 * (wanted - acceleration[k - 1])
        speed[k] = max(speed[k - 1] + acceleration[k] * dt, 0.0)
    # A pack of fewer cells drives a smaller vehicle.
    force = volts / 360.0 * (1600.0 * acceleration + 0.5 * speed**2 + 150.0 * (speed > 0.1))
    power = force * speed
    power = np.where(power > 0.0, power / 0.88, power * 0.75)
    heater = 600.0 + 400.0 * (np.sin(np.arange(n) * dt / 7.0) > 0.5)
    power += volts / 360.0 * heater
    current = power / volts + rng.normal(0.0, 0.4, n)
    polar = np.zeros(n)
    for k in range(1, n):
        polar[k] = polar[k - 1] + dt / 12.0 * (0.5 * ohm * current[k] - polar[k - 1])
    voltage = volts - ohm * current - polar + rng.normal(0.0, 0.08, n)
    charge = np.cumsum(current) * dt / 3600.0
    voltage -= 0.4 * charge
    return {
        "current": current,
        "voltage": voltage,
        "inverter_voltage": voltage - 0.004 * current + rng.normal(0.0, 0.4, n),
        "inverter_current": (power - 700.0) / volts + rng.normal(0.0, 1.0, n),
        "power": power / 1000.0,
        "speed": 3.6 * speed,
        "rpm": speed * 80.0,
        "torque": force * 0.035 + rng.normal(0.0, 0.3, n),
        "pedal": np.clip(acceleration * 30.0 + speed, 0.0, 100.0),
        "steering": np.cumsum(rng.normal(0.0, 1.0, n)) * 0.2,
        "lateral": rng.normal(0.0, 0.05, n) + 0.2 * np.sin(np.arange(n) * dt / 3.0),
        "soc": 71.0 - charge / 0.6,
        "aux": 14.1 + 0.05 * np.sin(np.arange(n) * dt) + rng.normal(0.0, 0.01, n),
        "cell_high": voltage / 96.0 + 0.004,
        "cell_low": voltage / 96.0 - 0.005,
        "temperature": 21.0 + np.arange(n) * dt / 60.0,
        "limit": 90.0 - np.arange(n) * dt / 100.0,
    }


def capture(car: Car, seed: int = 1, seconds: float = 60.0) -> Iterator[can.Message]:
    """Yield the frames of a minute's drive, in time."""
    rng = np.random.default_rng(seed + 1000)
    truth = drive(seed, car.volts, car.ohm, seconds)
    if car.charge_positive:
        truth["current"] = -truth["current"]
    yield from encode(car.frames, truth, rng)


def _others(base: int) -> tuple[Frame, ...]:
    """Return frames that every car has, in mixed layouts."""
    return (
        Frame(
            base + 0x01,
            0.01,
            8,
            {"torque": Bits(7, 16, True, 0.5, -400.0), "rpm": Bits(23, 16, True, 1.0)},
            counter=Bits(51, 4, True, 1.0),
            crc_byte=7,
        ),
        Frame(
            base + 0x02,
            0.02,
            8,
            {"speed": Bits(0, 16, False, 0.01), "lateral": Bits(16, 12, False, 0.01, -20.48)},
        ),
        Frame(
            base + 0x03,
            0.01,
            8,
            {"steering": Bits(7, 16, True, 0.1, -800.0)},
            counter=Bits(48, 4, False, 1.0),
        ),
        Frame(
            base + 0x04,
            0.02,
            8,
            {"pedal": Bits(8, 8, False, 0.4), "power": Bits(16, 12, False, 0.1, -100.0)},
        ),
        Frame(
            base + 0x05,
            0.02,
            8,
            {
                "inverter_voltage": Bits(15, 12, True, 0.25),
                "inverter_current": Bits(31, 12, True, 0.5, -1000.0),
            },
        ),
        Frame(
            base + 0x06,
            0.1,
            8,
            {"aux": Bits(0, 8, False, 0.1), "temperature": Bits(8, 8, False, 1.0, -40.0)},
        ),
        Frame(
            base + 0x07,
            0.1,
            8,
            {"cell_high": Bits(7, 16, True, 0.001), "cell_low": Bits(23, 16, True, 0.001)},
        ),
        Frame(
            base + 0x08,
            0.1,
            8,
            {"limit": Bits(0, 10, False, 0.25), "soc": Bits(16, 10, False, 0.1)},
        ),
        Frame(
            base + 0x09,
            0.01,
            8,
            {"speed": Bits(7, 13, True, 0.05)},
            counter=Bits(59, 4, True, 1.0),
            crc_byte=0,
        ),
    )


KIA_CURRENT, KIA_VOLTAGE = Bits(32, 16, False, 0.1, signed=True), Bits(48, 16, False, 0.1)
TESLA_CURRENT, TESLA_VOLTAGE = Bits(16, 16, False, 0.1, signed=True), Bits(0, 16, False, 0.01)
MEB_CURRENT, MEB_VOLTAGE = Bits(24, 14, False, 0.25, -2047.0), Bits(38, 12, False, 0.25)
ZOE_CURRENT, ZOE_VOLTAGE = Bits(11, 12, True, 0.25, -500.0), Bits(7, 10, True, 0.5)
PRIUS_CURRENT, PRIUS_VOLTAGE = Bits(3, 12, True, 0.1, signed=True), Bits(23, 16, True, 1.0)
BOLT_CURRENT, BOLT_VOLTAGE = Bits(4, 13, True, 0.15, signed=True), Bits(36, 13, True, 0.125)
MIEV_CURRENT, MIEV_VOLTAGE = Bits(23, 16, True, 0.01, -327.68), Bits(39, 16, True, 0.1)

CARS = (
    Car(
        "hyundai_kia",
        (
            Frame(0x595, 0.1, 8, {"current": KIA_CURRENT, "voltage": KIA_VOLTAGE}),
            *_others(0x200),
        ),
        (0x595, KIA_CURRENT),
        (0x595, KIA_VOLTAGE),
    ),
    Car(
        "tesla_3",
        (
            Frame(
                0x132,
                0.01,
                8,
                {"current": TESLA_CURRENT, "voltage": TESLA_VOLTAGE},
                constant={Bits(48, 12, False, 1.0): 4095},
            ),
            *_others(0x100),
        ),
        (0x132, TESLA_CURRENT),
        (0x132, TESLA_VOLTAGE),
        charge_positive=True,
        ohm=0.06,
    ),
    Car(
        "vw_meb",
        (
            Frame(
                0x0CF,
                0.01,
                8,
                {"current": MEB_CURRENT, "voltage": MEB_VOLTAGE},
                counter=Bits(8, 4, False, 1.0),
                crc_byte=0,
            ),
            Frame(
                0x12DD54D0,
                0.02,
                32,
                {
                    "inverter_voltage": Bits(100, 12, False, 0.25),
                    "power": Bits(130, 12, False, 0.1, -100.0),
                    "cell_low": Bits(200, 12, False, 0.001),
                },
                counter=Bits(8, 4, False, 1.0),
                crc_byte=0,
                extended=True,
            ),
            *_others(0x300),
        ),
        (0x0CF, MEB_CURRENT),
        (0x0CF, MEB_VOLTAGE),
        ohm=0.07,
    ),
    Car(
        "renault_zoe",
        (
            Frame(
                0x155,
                0.01,
                8,
                {"current": ZOE_CURRENT, "soc": Bits(39, 16, True, 0.0025)},
                constant={Bits(7, 4, True, 1.0): 7},
            ),
            Frame(
                0x425, 0.1, 8, {"voltage": ZOE_VOLTAGE, "cell_low": Bits(39, 9, True, 0.01, 1.0)}
            ),
            *_others(0x500),
        ),
        (0x155, ZOE_CURRENT),
        (0x425, ZOE_VOLTAGE),
        charge_positive=True,
        ohm=0.12,
    ),
    Car(
        "toyota_prius",
        (
            Frame(0x03B, 0.01, 5, {"current": PRIUS_CURRENT, "voltage": PRIUS_VOLTAGE}, crc_byte=4),
            *_others(0x400),
        ),
        (0x03B, PRIUS_CURRENT),
        (0x03B, PRIUS_VOLTAGE),
        volts=220.0,
        ohm=0.12,
    ),
    Car(
        "chevrolet_bolt",
        (
            Frame(0x260, 0.02, 8, {"current": BOLT_CURRENT}),
            Frame(0x262, 0.1, 8, {"voltage": BOLT_VOLTAGE}),
            *_others(0x600),
        ),
        (0x260, BOLT_CURRENT),
        (0x262, BOLT_VOLTAGE),
    ),
    Car(
        "mitsubishi",
        (
            Frame(
                0x373,
                0.01,
                8,
                {"current": MIEV_CURRENT, "voltage": MIEV_VOLTAGE},
                constant={Bits(7, 8, True, 1.0): 210, Bits(15, 8, True, 1.0): 209},
            ),
            *_others(0x280),
        ),
        (0x373, MIEV_CURRENT),
        (0x373, MIEV_VOLTAGE),
        volts=330.0,
        ohm=0.15,
    ),
)
