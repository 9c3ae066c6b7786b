"""Simulated packs: cell chemistry, size, impedance, thermal masses and sensors; drawn at random.

A monotone cubic (PCHIP, Fritsch and Butland 1984) interpolates the tables of `packs.toml`; every
specimen deviates from them by some millivolts.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from cangauge._typing import FloatArray
from cangauge.errors import InputError

KELVIN: Final = 273.15
GRID: Final = np.linspace(-0.06, 1.04, 2201)
"""SoC of the tables [-]: a weak cell is discharged below its 0 %."""
THERMAL_V: Final = 0.02569
"""R·T/F at 25 °C [V]."""


def read_table(name: str) -> dict[str, Any]:
    """Return a table beside this file."""
    return tomllib.loads(Path(__file__).with_name(name).read_text(encoding="utf-8"))


_TABLE: Final = read_table("packs.toml")
KINDS: Final = tuple(_TABLE["kinds"])
CHEMISTRIES: Final = tuple(_TABLE["cells"])
TYPICAL: Final[dict[str, Any]] = _TABLE["typical"]


@dataclass(frozen=True, eq=False)
class CellChemistry:
    """Open-circuit voltage and entropy of one cell over its state of charge.

    Parameters
    ----------
    name : str
    ocv_table_v : array of shape (m,)
        Open-circuit voltage at 25 °C [V] over `GRID`, strictly rising.
    entropy_table_v_k : array of shape (m,)
        dU/dT over `GRID` [V/K].
    empty_v : float
        Voltage of the lowest cell at which the car stops [V].
    """

    name: str
    ocv_table_v: FloatArray
    entropy_table_v_k: FloatArray
    empty_v: float

    @classmethod
    def tabulated(
        cls, name: str, soc: ArrayLike, volts: FloatArray, bend_v: ArrayLike, like: str
    ) -> CellChemistry:
        """Return the cell of a table over the SoC, with a bend over `GRID` [V].

        The table is extended beyond both ends, for weak and overcharged cells; `like` is the
        chemistry whose entropy and empty voltage it has.
        """
        soc = np.concatenate(([-0.06, -0.03], soc, [1.04]))
        volts = np.concatenate((volts[0] - [1.35, 0.62], volts, [volts[-1] + 0.12]))
        table_v = np.maximum.accumulate(PchipInterpolator(soc, volts)(GRID) + bend_v)
        table = _TABLE["cells"][like]
        soc_pct, entropy_mv_k = np.array(table["entropy_mv_k"]).T
        curve = PchipInterpolator(soc_pct / 100.0, entropy_mv_k * 1e-3)
        entropy_v_k = curve(np.clip(GRID, 0.0, 1.0))
        return cls(name, table_v + 1e-6 * GRID, entropy_v_k, table["empty_v"])

    def ocv(self, soc: FloatArray) -> FloatArray:
        """Return the open-circuit voltage of one cell at 25 °C [V]; soc [-] of any shape."""
        return np.interp(soc, GRID, self.ocv_table_v)

    def entropy(self, soc: FloatArray) -> FloatArray:
        """Return dU/dT of one cell [V/K]; soc [-] of any shape."""
        return np.interp(soc, GRID, self.entropy_table_v_k)


def chemistry(name: str, rng: np.random.Generator) -> CellChemistry:
    """Draw one specimen of a chemistry, some millivolts off its table.

    Parameters
    ----------
    name : {"nmc", "lmo", "nca", "lfp"}
        `lmo` is the LMO-rich blend of the first Leafs.
    rng : Generator

    Raises
    ------
    InputError
        For an unknown chemistry.
    """
    if name not in CHEMISTRIES:
        raise InputError("unknown chemistry", value=name, cure=f"use {', '.join(CHEMISTRIES)}")
    table = _TABLE["cells"][name]
    soc_pct, volts = np.array(table["ocv_v"]).T
    waves = sum(
        rng.normal() / order * np.sin(order * np.pi * GRID + rng.uniform(0.0, 2.0 * np.pi))
        for order in (1, 2, 3)
    )
    bend_v = waves * table["bend_v"]
    return CellChemistry.tabulated(name, soc_pct / 100.0, volts, bend_v, name)


@dataclass(frozen=True)
class Sensors:
    """Sensors of a healthy pack.

    Parameters
    ----------
    current_step_a, voltage_step_v, temperature_step_k : float
        Resolution [A, V, K].
    current_noise_a, voltage_noise_v : float
        Standard deviation of the noise [A, V].
    temperature_lag_s : float
        Time constant [s].
    rate_hz : float
        Sampling rate [Hz].
    jitter : float
        Standard deviation of the sampling instant, in sampling periods [-].
    drop_share : float
        Fraction of lost samples [-].
    start_soc_std_pct : float
        Standard deviation of the assumed initial SoC [%].
    """

    current_step_a: float
    voltage_step_v: float
    temperature_step_k: float
    current_noise_a: float = 0.0
    voltage_noise_v: float = 0.0
    temperature_lag_s: float = 0.0
    rate_hz: float = 1.0
    jitter: float = 0.0
    drop_share: float = 0.0
    start_soc_std_pct: float = 0.0

    @classmethod
    def draw(cls, rng: np.random.Generator, pack_v: float, capacity_ah: float) -> Sensors:
        """Draw the sensors of a pack of a nominal voltage [V] and capacity [Ah]."""
        steps_v = (0.05, 0.1, 0.25, 0.5) if pack_v > 100.0 else (0.005, 0.01, 0.02)
        return cls(
            current_step_a=float(rng.choice((0.02, 0.05, 0.1, 0.25, 0.5))),
            current_noise_a=capacity_ah * rng.uniform(0.0004, 0.003),
            voltage_step_v=float(rng.choice(steps_v)),
            voltage_noise_v=pack_v * rng.uniform(0.0001, 0.0005),
            temperature_step_k=float(rng.choice((0.1, 0.25, 0.5, 1.0))),
            temperature_lag_s=rng.uniform(5.0, 30.0),
            rate_hz=float(rng.choice((1.0, 2.0, 5.0, 10.0), p=(0.6, 0.2, 0.1, 0.1))),
            jitter=rng.uniform(0.0, 0.06),
            drop_share=float(rng.choice((0.0, rng.uniform(0.0005, 0.006)))),
            start_soc_std_pct=rng.uniform(0.02, 0.12),
        )


@dataclass(frozen=True, eq=False)
class TwinPack:
    """A pack of lithium-ion cells in series.

    Resistances are those of one cell at 25 °C [Ω]. Cell spread is represented by g groups of equal
    cells.

    Parameters
    ----------
    name : str
    chemistry : CellChemistry
    cells : int
    capacity_ah : float
    groups : array of shape (4, g)
        By group: number of cells, capacity and resistance relative to the mean cell [-], and its
        SoC beyond the mean cell's [-].
    ohmic_ohm : float
    ohmic_vogel_k : float
        B of exp(B/(T − 170 K)), electrolyte conductivity (Vogel–Fulcher–Tammann) [K].
    busbar_ohm : float
        Copper of the whole pack, independent of temperature [Ω].
    exchange_a : float
        Exchange current at 25 °C and 50 % SoC [A].
    exchange_activation_k : float
        Its activation energy over the gas constant [K].
    anodic : float
        Anodic charge transfer coefficient [-].
    double_layer_s : float
        Time constant of the double layer [s].
    electrolyte_ohm, electrolyte_tau_s : tuple of float
        Modes of the electrolyte's concentration overpotential [Ω, s].
    solid_swing, solid_tau_s : tuple of float
        Modes of the surface minus mean SoC per ampere [1/A, s].
    diffusion_activation_k : float
        Activation energy of diffusion over the gas constant [K].
    core_j_k, surface_j_k : float
        Heat capacities [J/K].
    core_surface_w_k, surface_ambient_w_k : float
        Thermal conductances [W/K].
    sensors : Sensors
    """

    name: str
    chemistry: CellChemistry
    cells: int
    capacity_ah: float
    groups: FloatArray
    ohmic_ohm: float
    ohmic_vogel_k: float
    busbar_ohm: float
    exchange_a: float
    exchange_activation_k: float
    anodic: float
    double_layer_s: float
    electrolyte_ohm: tuple[float, ...]
    electrolyte_tau_s: tuple[float, ...]
    solid_swing: tuple[float, ...]
    solid_tau_s: tuple[float, ...]
    diffusion_activation_k: float
    core_j_k: float
    surface_j_k: float
    core_surface_w_k: float
    surface_ambient_w_k: float
    sensors: Sensors

    @property
    def nominal_v(self) -> float:
        """Open-circuit voltage at 50 % SoC [V]."""
        return float(self.cells * self.chemistry.ocv(np.array(0.5)))

    @property
    def energy_kwh(self) -> float:
        """Nominal energy [kWh]."""
        return self.nominal_v * self.capacity_ah / 1000.0

    @property
    def resistance_ohm(self) -> float:
        """Pack resistance at 25 °C within seconds of a current step [Ω]."""
        return self.cells * (self.ohmic_ohm + THERMAL_V / self.exchange_a) + self.busbar_ohm


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw uniformly in the logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def pick(rng: np.random.Generator, odds: Mapping[str, float]) -> str:
    """Draw a name by its odds."""
    p = np.array(list(odds.values()), dtype=float)
    return str(rng.choice(list(odds), p=p / p.sum()))


def draw_pack(
    rng: np.random.Generator, kind: str | None = None, chemistry_name: str | None = None
) -> TwinPack:
    """Draw a pack.

    Parameters
    ----------
    rng : Generator
    kind : str, optional
        One of `KINDS`; drawn by default.
    chemistry_name : {"nmc", "lmo", "nca", "lfp"}, optional
        By default one that the kind is built with.

    Raises
    ------
    InputError
        For an unknown kind or chemistry.
    """
    kind, table = _draw_kind(rng, kind)
    cells, capacity_ah = table["cells"], rng.uniform(*table["capacity_ah"])
    usual = pick(rng, table["chemistry"])
    entropy = float(np.exp(rng.uniform(-0.2, 1.1)))
    cell = chemistry(chemistry_name or usual, rng)
    # Overpotential of one cell at 1C, divided among the processes.
    volts = rng.uniform(0.050, 0.095)
    share = rng.dirichlet([9.0, 5.0, 3.0])
    ohmic, transfer, electrolyte = (volts * share / capacity_ah).tolist()
    slow_s = log_uniform(rng, 12.0, 28.0)
    split = rng.uniform(0.4, 0.7)
    quick_s = log_uniform(rng, 18.0, 45.0)
    swing = rng.uniform(0.012, 0.030) / capacity_ah
    energy_kwh = cells * 3.7 * capacity_ah / 1000.0
    heat_j_k = energy_kwh * rng.uniform(5500.0, 8500.0)
    return TwinPack(
        name=kind,
        chemistry=replace(cell, entropy_table_v_k=entropy * cell.entropy_table_v_k),
        cells=cells,
        capacity_ah=capacity_ah,
        groups=_draw_groups(rng, cells),
        ohmic_ohm=ohmic,
        ohmic_vogel_k=rng.uniform(150.0, 320.0),
        busbar_ohm=cells * ohmic * rng.uniform(0.03, 0.15),
        exchange_a=THERMAL_V / transfer,
        exchange_activation_k=rng.uniform(4000.0, 6500.0),
        anodic=rng.uniform(0.42, 0.58),
        double_layer_s=log_uniform(rng, 0.04, 0.5),
        electrolyte_ohm=(electrolyte * split, electrolyte * (1.0 - split)),
        electrolyte_tau_s=(slow_s, slow_s * rng.uniform(2.0, 3.0)),
        solid_swing=(swing * 0.62, swing * 0.25, swing * 0.13),
        solid_tau_s=(quick_s * 1.8, quick_s * 0.5, quick_s * 0.16),
        diffusion_activation_k=rng.uniform(2200.0, 4000.0),
        core_j_k=0.75 * heat_j_k,
        surface_j_k=0.25 * heat_j_k,
        core_surface_w_k=energy_kwh * rng.uniform(4.0, 10.0),
        surface_ambient_w_k=heat_j_k / rng.uniform(9000.0, 30000.0),
        sensors=Sensors.draw(rng, cells * 3.7, capacity_ah),
    )


def _draw_kind(rng: np.random.Generator, kind: str | None) -> tuple[str, dict[str, Any]]:
    """Return a kind of pack and its table, drawn by its odds where none is given."""
    kinds = _TABLE["kinds"]
    if kind is None:
        kind = pick(rng, {name: each["odds"] for name, each in kinds.items()})
    if kind not in kinds:
        raise InputError("unknown pack", value=kind, cure=f"use {', '.join(KINDS)}")
    return kind, kinds[kind]


def _draw_groups(rng: np.random.Generator, cells: int) -> FloatArray:
    """Draw `groups` of a healthy pack, shape (4, 5): the quantiles of each spread, shuffled."""
    quantiles = np.array([-1.75, -0.85, 0.0, 0.85, 1.75])
    return np.array(
        [
            np.array([0.1, 0.2, 0.4, 0.2, 0.1]) * cells,
            1.0 + rng.uniform(0.003, 0.012) * rng.permutation(quantiles),
            1.0 + rng.uniform(0.01, 0.05) * rng.permutation(quantiles),
            rng.uniform(0.001, 0.006) * rng.permutation(quantiles),
        ]
    )
