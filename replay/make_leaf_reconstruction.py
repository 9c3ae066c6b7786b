"""Write the logs in this folder: a reconstruction of the published 2012 Leaf test.

The original log (Argonne, chassis dynamometer) must not be redistributed, and this is NOT that log.
The battery power comes from a road-load model of the car on the public drive schedules, the voltage
from the published equation and coefficients; a measurement error is added.

    python replay/make_leaf_reconstruction.py --schedules DIR [-o DIR]

DIR holds udds.csv, us06.csv and hwfet.csv (seconds and m/s, 1 Hz, one header line) of the PyPI
package fastsim 2.1, folder fastsim/resources/cycles. All seeds are fixed: the same schedules give
the same values.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cangauge._files import atomic_path
from cangauge._typing import FloatArray
from cangauge.errors import CangaugeError, InputError
from cangauge.logs.gaps import discharged_ah
from cangauge.model.delay_line import delayed_currents
from cangauge.model.published import CAPACITY_AH, VOLTAGE_MAE_PCT, leaf_2012_model

BoolArray = NDArray[np.bool_]

RATE_HZ = 10
STEP_S = 1.0 / RATE_HZ

ORDER = ("udds", "hwfet", "udds", "us06", "hwfet", "udds", "us06", "hwfet", "udds")
"""Order of the schedules; the pack is empty before the last one ends."""

SEEDS = {"pedal": 1, "room": 2, "white": 3, "correlated": 4}
"""Seeds of numpy's default generator."""

NOTICE = (
    "A RECONSTRUCTION, not the measured log: published voltage equation of the 2012 Nissan Leaf,"
    " road-load model of the car, public drive schedules, simulated error of measurement."
)


@dataclass(frozen=True)
class Car:
    """A 2012 Leaf on the dynamometer; road load and losses within the published range."""

    mass_kg: float = 1640.0
    """Test mass: kerb mass of 1,520 kg, driver and instruments [kg]."""
    rotating: float = 1.04
    """Factor on the mass for wheels and motor [-]."""
    road_n: float = 160.0
    """Rolling resistance of tyres and bearings [N]."""
    drag_n_per_m2_s2: float = 0.49
    """Air drag and rolls [N/(m/s)²]; the body alone has 0.5·1.2 kg/m³·0.29·2.3 m² = 0.40."""
    drive_efficiency: float = 0.89
    """Battery to wheels [-]."""
    regen_efficiency: float = 0.88
    """Wheels to battery during regeneration [-]."""
    drive_limit_w: float = 70e3
    """Largest power of the inverter [W]."""
    regen_limit_w: float = 19.5e3
    """Largest regeneration [W]; the friction brakes take the rest."""
    regen_fade_m_s: tuple[float, float] = (1.5, 4.5)
    """Speeds between which regeneration fades out [m/s]."""
    accessory_w: float = 900.0
    """Pumps, fans, lamps and control units of the car switched on [W]."""


@dataclass(frozen=True)
class Stop:
    """Stop between two schedules: on, off (contactor open), on."""

    on_s: float = 10.0
    off_s: float = 30.0
    precharge_s: float = 0.5
    """Precharge of the link behind the contactor at the end of the off time [s]."""
    precharge_tau_s: float = 0.1
    collapse_tau_s: float = 0.4
    """Time constant of the discharge of the link after the contactor opens [s]."""


@dataclass(frozen=True)
class Driver:
    """Follows the schedule with preview and pedal noise."""

    preview_s: float = 1.0
    lag_s: float = 0.3
    pedal_n: float = 50.0
    """Standard deviation of the pedal noise as a force at the wheels [N]."""
    pedal_tau_s: float = 1.5


def read_schedule(folder: Path, name: str) -> FloatArray:
    """Return the speeds of one schedule at 10 Hz [m/s], interpolated linearly from 1 Hz."""
    path = folder / f"{name}.csv"
    try:
        table = np.loadtxt(path, delimiter=",", skiprows=1, usecols=(0, 1), ndmin=2)
    except FileNotFoundError as error:
        raise InputError(
            "the drive schedule does not exist",
            source=path,
            field="--schedules",
            cure="name the folder of udds.csv, us06.csv and hwfet.csv, e.g."
            " fastsim/resources/cycles of the PyPI package fastsim 2.1",
        ) from error
    except ValueError as error:
        raise InputError(
            f"not a schedule of seconds and m/s: {error}", source=path, field="--schedules"
        ) from error
    steps = np.diff(table[:, 0])
    if steps.size == 0 or not np.isfinite(table).all() or steps.min() <= 0.0:
        raise InputError(
            "time must increase and every value be a number", source=path, field="--schedules"
        )
    at = np.arange(round(table[-1, 0]) * RATE_HZ) / RATE_HZ
    return np.asarray(np.interp(at, table[:, 0], table[:, 1]))


def plan(schedules: Mapping[str, FloatArray], stop: Stop) -> tuple[FloatArray, BoolArray]:
    """Return the target speed [m/s] and whether the contactor is closed, at 10 Hz."""
    speed, closed = [], []
    for index, name in enumerate(ORDER):
        if index:
            for seconds, on in ((stop.on_s, True), (stop.off_s, False), (stop.on_s, True)):
                rows = round(seconds * RATE_HZ)
                speed.append(np.zeros(rows))
                closed.append(np.full(rows, on))
        speed.append(schedules[name])
        closed.append(np.full(schedules[name].size, True))
    return np.concatenate(speed), np.concatenate(closed)


def room_temperature(rows: int) -> FloatArray:
    """Return the temperature of the test room to 0.01 °C: drift, control cycle, random walk."""
    t = np.arange(rows) * STEP_S
    wander = coloured_noise(rows, [200.0], np.random.default_rng(SEEDS["room"]))
    drift = 1.7 * np.sin(2.0 * np.pi * (t / 5400.0 - 0.1))
    cycle = 1.0 * np.sin(2.0 * np.pi * t / 780.0)
    return np.asarray(np.round(np.clip(23.0 + drift + cycle + 0.15 * wander, 20.0, 26.0), 2))


def coloured_noise(rows: int, tau_s: Sequence[float], rng: np.random.Generator) -> FloatArray:
    """Return a sum of stationary Ornstein–Uhlenbeck processes of equal variance, in total 1."""
    total = np.zeros(rows)
    for tau in tau_s:
        keep = math.exp(-STEP_S / tau)
        fresh = math.sqrt(1.0 - keep * keep)
        value = float(rng.standard_normal())
        path = [value]
        for kick in rng.standard_normal(rows - 1).tolist():
            value = keep * value + fresh * kick
            path.append(value)
        total += path
    return total / math.sqrt(len(tau_s))


def wheel_power(speed: FloatArray, car: Car, driver: Driver) -> FloatArray:
    """Return the battery power of driving [W], negative during regeneration."""
    preview = round(driver.preview_s * RATE_HZ)
    ahead = np.concatenate([speed[preview:], np.zeros(preview)]).tolist()
    rng = np.random.default_rng(SEEDS["pedal"])
    pedal = (driver.pedal_n * coloured_noise(speed.size, [driver.pedal_tau_s], rng)).tolist()
    inertia = car.mass_kg * car.rotating
    fade_from, fade_to = car.regen_fade_m_s
    v = force = 0.0
    power = []
    for target, unsteady in zip(ahead, pedal, strict=True):
        road = car.road_n + car.drag_n_per_m2_s2 * v * v
        if target == 0.0 and v < 0.3:
            v = force = 0.0  # standstill
            power.append(0.0)
            continue
        wanted = inertia * (target - v) / driver.preview_s + road + (unsteady if v > 1.0 else 0.0)
        force += (wanted - force) * STEP_S / driver.lag_s
        at_wheels = force
        if force >= 0.0:
            drawn = force * v / car.drive_efficiency
            if drawn > car.drive_limit_w:
                drawn = car.drive_limit_w
                at_wheels = drawn * car.drive_efficiency / v
        else:
            share = min(max((v - fade_from) / (fade_to - fade_from), 0.0), 1.0)
            drawn = max(force * v * car.regen_efficiency * share, -car.regen_limit_w)
        v = max(0.0, v + STEP_S * (at_wheels - (road if v > 0.0 else 0.0)) / inertia)
        power.append(drawn)
    return np.array(power)


def battery_current(
    power_w: FloatArray, closed: BoolArray, temperature_c: FloatArray
) -> FloatArray:
    """Return the current for a power until the pack is empty, to 0.01 A [A].

    Solves U·I = P with U = E + R1·I, where E is the published voltage without the present current.
    """
    model = leaf_2012_model()
    r1, *r_past = model.loads.resistance_ohm
    back = [round(delay * RATE_HZ) for delay in model.loads.delays_s[1:]]
    offset = (model.loads.kt_v_per_k * (temperature_c - model.loads.t_ref_c)).tolist()
    current: list[float] = []
    charge_as = 0.0
    for k, (power, on) in enumerate(zip(power_w.tolist(), closed.tolist(), strict=True)):
        soc = 100.0 - charge_as / (36.0 * CAPACITY_AH)
        e = model.pseudo_ocv_at(soc)[0] + offset[k]
        if current:
            e += sum(r * current[max(k - n, 0)] for r, n in zip(r_past, back, strict=True))
        value = round((math.sqrt(e * e + 4.0 * r1 * power) - e) / (2.0 * r1), 2) if on else 0.0
        if current:
            charge_as += (value + current[-1]) * STEP_S / 2.0
        if charge_as > 3600.0 * CAPACITY_AH:
            return np.array(current)
        current.append(value)
    raise InputError(
        "the schedules end before the pack is empty", field="--schedules", value=round(soc, 1)
    )


def true_voltage(
    time_s: FloatArray,
    current_a: FloatArray,
    temperature_c: FloatArray,
    closed: BoolArray,
    stop: Stop,
) -> tuple[FloatArray, FloatArray]:
    """Return SoC [%] and the error-free voltage behind the contactor [V]."""
    model = leaf_2012_model()
    soc = 100.0 * (1.0 - discharged_ah(time_s, current_a) / CAPACITY_AH)
    delayed = delayed_currents(time_s, current_a, model.loads.delays_s, time_s)
    load_columns = model.load_columns(temperature_c, delayed)
    pack = model.pseudo_ocv(soc) + load_columns @ model.load_coefficients
    link = pack.copy()
    edges = np.flatnonzero(np.diff(closed.astype(int))) + 1
    for opened, reclosed in zip(edges[::2], edges[1::2], strict=True):
        since = (np.arange(opened, reclosed) - opened + 1) * STEP_S
        link[opened:reclosed] = pack[opened - 1] * np.exp(-since / stop.collapse_tau_s)
        first = reclosed - round(stop.precharge_s * RATE_HZ)
        rise = (np.arange(first, reclosed) - first + 1) * STEP_S
        link[first:reclosed] = pack[first:reclosed] * -np.expm1(-rise / stop.precharge_tau_s)
    return soc, link


def with_error(voltage_v: FloatArray, shape: FloatArray, closed: BoolArray) -> FloatArray:
    """Add a relative error with the published MAE to the voltage, to 0.01 V [V].

    The MAE is the mean of |error| / voltage over the 1 Hz rows with a closed contactor.
    """
    kept = (np.arange(shape.size) % RATE_HZ == 0) & closed
    relative = shape * (VOLTAGE_MAE_PCT / 100.0 / np.mean(np.abs(shape[kept])))
    return np.asarray(np.round(voltage_v * (1.0 + relative), 2))


def write_reconstruction(path: Path, columns: Mapping[str, FloatArray], about: str) -> None:
    """Write one log as Parquet, with its origin in the metadata."""
    table = pa.table(dict(columns)).replace_schema_metadata(
        {
            "cangauge.temperature_source": "room",
            "title": "2012 Nissan Leaf, reconstruction",
            "notice": NOTICE,
            "variant": about,
            "made_by": "replay/make_leaf_reconstruction.py",
            "seeds": ", ".join(f"{name} {seed}" for name, seed in SEEDS.items()),
        }
    )
    with atomic_path(path) as part:
        pq.write_table(
            table,
            part,
            compression="zstd",
            compression_level=19,
            # Smallest encoding of each column: 0.5 MB instead of 0.9 MB in total.
            use_dictionary=["current_a", "voltage_v"],
            use_byte_stream_split=["time_s"],
            write_page_checksum=True,
        )


def make(schedules: Path, out: Path) -> list[Path]:
    """Write the three logs to `out` and return their paths."""
    stop = Stop()
    speed, closed = plan({name: read_schedule(schedules, name) for name in set(ORDER)}, stop)
    power = wheel_power(speed, Car(), Driver()) + Car().accessory_w
    temperature = room_temperature(speed.size)
    current = battery_current(power, closed, temperature)
    rows = current.size
    closed, temperature = closed[:rows], temperature[:rows]
    time_s = np.arange(rows) / RATE_HZ
    soc, voltage = true_voltage(time_s, current, temperature, closed, stop)
    white = np.random.default_rng(SEEDS["white"]).standard_normal(rows)
    correlated = coloured_noise(
        rows, [60.0, 120.0, 300.0], np.random.default_rng(SEEDS["correlated"])
    )

    def columns(error: FloatArray, part: slice = slice(None)) -> dict[str, FloatArray]:
        return {
            "time_s": np.round(time_s[part] - time_s[part][0], 1),
            "current_a": current[part],
            "voltage_v": with_error(voltage, error, closed)[part],
            "temperature_c": temperature[part],
            "soc_pct": np.round(soc[part], 3),
        }

    third_stop = np.flatnonzero(np.diff(closed.astype(int)) < 0)[2]
    short = slice(third_stop - 60 * RATE_HZ, third_stop + 540 * RATE_HZ)
    outputs = {
        "white": (columns(white), "white error of voltage, independent in each 10 Hz row"),
        "correlated": (
            columns(correlated),
            "correlated error of voltage: sum of three processes of 60, 120 and 300 s",
        ),
        "10min": (columns(white, short), "10 minutes of the white one, around the first US06"),
    }
    paths = []
    for name, (data, about) in outputs.items():
        path = out / f"leaf2012_reconstruction_{name}.parquet"
        write_reconstruction(path, data, about)
        paths.append(path)
    return paths


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--schedules", type=Path, required=True, metavar="DIR", help="udds.csv, us06.csv, hwfet.csv"
    )
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path(__file__).parent,
        metavar="DIR",
        help="folder of the logs (default: that of this script)",
    )
    options = parser.parse_args()
    try:
        for path in make(options.schedules, options.out):
            sys.stderr.write(f"wrote {path} ({path.stat().st_size / 1024:.0f} KiB)\n")
    except CangaugeError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
