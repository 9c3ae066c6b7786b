"""Simulated packs: cell chemistry, size, impedance, thermal masses and sensors; drawn at random.

The open-circuit voltage tables follow the published shape of such curves (half-cell plateaus, knees
near empty), not one product, and every specimen deviates by some millivolts. A monotone cubic
(PCHIP, Fritsch and Butland 1984) interpolates them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import PchipInterpolator

from cangauge._typing import FloatArray
from cangauge.errors import InputError

KELVIN: Final = 273.15
LOWEST, HIGHEST = -0.06, 1.04
"""SoC range of the tables [-]: a weak cell is discharged below its 0 %."""
_POINTS: Final = 2201
_BEND_V: Final = 0.006

# State of charge [%] → open-circuit voltage of one cell at 25 °C [V].
_OCV: Final[dict[str, tuple[tuple[float, float], ...]]] = {
    "nmc": (
        (0, 3.00),
        (1, 3.15),
        (2, 3.25),
        (3, 3.33),
        (5, 3.42),
        (7.5, 3.485),
        (10, 3.52),
        (15, 3.57),
        (20, 3.605),
        (25, 3.632),
        (30, 3.655),
        (40, 3.695),
        (50, 3.745),
        (60, 3.822),
        (70, 3.912),
        (80, 4.010),
        (90, 4.108),
        (95, 4.152),
        (98, 4.178),
        (100, 4.200),
    ),
    "lmo": (
        (0, 2.80),
        (1, 3.02),
        (2, 3.17),
        (3, 3.28),
        (5, 3.42),
        (7.5, 3.505),
        (10, 3.555),
        (15, 3.625),
        (20, 3.675),
        (30, 3.745),
        (40, 3.792),
        (50, 3.835),
        (60, 3.888),
        (70, 3.945),
        (80, 4.000),
        (90, 4.058),
        (95, 4.090),
        (98, 4.118),
        (100, 4.145),
    ),
    "nca": (
        (0, 2.75),
        (1, 2.95),
        (2, 3.08),
        (3, 3.17),
        (5, 3.29),
        (7.5, 3.375),
        (10, 3.425),
        (15, 3.490),
        (20, 3.540),
        (30, 3.610),
        (40, 3.668),
        (50, 3.742),
        (60, 3.832),
        (70, 3.920),
        (80, 4.000),
        (90, 4.080),
        (95, 4.128),
        (98, 4.165),
        (100, 4.190),
    ),
    "lfp": (
        (0, 2.55),
        (1, 2.80),
        (2, 2.94),
        (3, 3.02),
        (5, 3.11),
        (7.5, 3.170),
        (10, 3.200),
        (15, 3.230),
        (20, 3.250),
        (25, 3.266),
        (30, 3.278),
        (35, 3.287),
        (40, 3.292),
        (50, 3.297),
        (55, 3.302),
        (60, 3.312),
        (65, 3.325),
        (70, 3.330),
        (80, 3.334),
        (90, 3.339),
        (95, 3.346),
        (98, 3.370),
        (99, 3.400),
        (100, 3.450),
    ),
}

# State of charge [%] → dU/dT of one cell [mV/K].
_ENTROPY: Final[dict[str, tuple[tuple[float, float], ...]]] = {
    "nmc": (
        (0, -0.42),
        (8, -0.33),
        (20, -0.24),
        (35, -0.16),
        (50, -0.05),
        (65, 0.04),
        (80, 0.02),
        (92, -0.04),
        (100, -0.10),
    ),
    "lmo": (
        (0, -0.30),
        (10, -0.22),
        (25, -0.15),
        (40, -0.02),
        (55, 0.12),
        (70, 0.08),
        (85, -0.06),
        (100, -0.12),
    ),
    "nca": (
        (0, -0.50),
        (10, -0.38),
        (25, -0.20),
        (40, -0.08),
        (55, 0.03),
        (75, 0.05),
        (90, 0.01),
        (100, -0.05),
    ),
    "lfp": (
        (0, -0.45),
        (10, -0.25),
        (25, -0.12),
        (38, 0.02),
        (50, 0.06),
        (62, 0.20),
        (75, 0.14),
        (90, 0.10),
        (100, 0.02),
    ),
}

CHEMISTRIES: Final = tuple(_OCV)


@dataclass(frozen=True, eq=False)
class CellChemistry:
    """Open-circuit voltage and entropy of one cell over its state of charge.

    Parameters
    ----------
    name : str
    grid : array of shape (m,)
        State of charge [-], evenly spaced from `LOWEST` to `HIGHEST`.
    ocv_table_v : array of shape (m,)
        Open-circuit voltage at 25 °C [V], strictly rising.
    entropy_table_v_k : array of shape (m,)
        dU/dT [V/K].
    """

    name: str
    grid: FloatArray
    ocv_table_v: FloatArray
    entropy_table_v_k: FloatArray

    def ocv(self, soc: FloatArray) -> FloatArray:
        """Return the open-circuit voltage of one cell at 25 °C [V]; soc [-] of any shape."""
        return np.interp(soc, self.grid, self.ocv_table_v)

    def entropy(self, soc: FloatArray) -> FloatArray:
        """Return dU/dT of one cell [V/K]; soc [-] of any shape."""
        return np.interp(soc, self.grid, self.entropy_table_v_k)


def chemistry(name: str, rng: np.random.Generator, entropy_scale: float = 1.0) -> CellChemistry:
    """Draw one specimen of a chemistry, some millivolts off its table.

    Parameters
    ----------
    name : {"nmc", "lmo", "nca", "lfp"}
        `lmo` is the LMO-rich blend of the first Leafs.
    rng : Generator
    entropy_scale : float
        Factor on dU/dT [-].

    Raises
    ------
    InputError
        For an unknown chemistry.
    """
    if name not in _OCV:
        raise InputError("unknown chemistry", value=name, cure=f"use {', '.join(CHEMISTRIES)}")
    soc, volts = np.array(_OCV[name]).T
    # Extended beyond both ends, for weak and overcharged cells.
    soc = np.concatenate(([-6.0, -3.0], soc, [104.0])) / 100.0
    volts = np.concatenate(([volts[0] - 1.35, volts[0] - 0.62], volts, [volts[-1] + 0.12]))
    grid = np.linspace(LOWEST, HIGHEST, _POINTS)
    table = PchipInterpolator(soc, volts)(grid)
    # A slow wave; smaller for the flat table of LFP, which must keep rising.
    waves = sum(
        rng.normal() / order * np.sin(order * np.pi * grid + rng.uniform(0.0, 2.0 * np.pi))
        for order in (1, 2, 3)
    )
    size = _BEND_V * (0.05 if name == "lfp" else 1.0)
    table = np.maximum.accumulate(table + size * waves) + 1e-6 * grid
    entropy_soc, entropy = np.array(_ENTROPY[name]).T
    curve = PchipInterpolator(entropy_soc / 100.0, entropy * 1e-3, extrapolate=False)
    entropy_table = curve(np.clip(grid, 0.0, 1.0)) * entropy_scale
    return CellChemistry(name, grid, table, entropy_table)


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
    current_noise_a: float
    voltage_step_v: float
    voltage_noise_v: float
    temperature_step_k: float
    temperature_lag_s: float
    rate_hz: float
    jitter: float
    drop_share: float
    start_soc_std_pct: float


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
    weights : array of shape (g,)
        Cells in each group.
    capacity_factor, resistance_factor, soc_shift : array of shape (g,)
        Deviation of each group from the mean cell [-].
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
    weights: FloatArray
    capacity_factor: FloatArray
    resistance_factor: FloatArray
    soc_shift: FloatArray
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
    def one_c_a(self) -> float:
        """1C current [A]."""
        return self.capacity_ah

    @property
    def nominal_v(self) -> float:
        """Open-circuit voltage at 50 % SoC [V]."""
        return float(self.cells * self.chemistry.ocv(np.array([0.5]))[0])

    @property
    def energy_kwh(self) -> float:
        """Nominal energy [kWh]."""
        return self.nominal_v * self.capacity_ah / 1000.0

    @property
    def resistance_ohm(self) -> float:
        """Pack resistance at 25 °C within seconds of a current step [Ω]."""
        transfer = 0.02569 / self.exchange_a
        return self.cells * (self.ohmic_ohm + transfer) + self.busbar_ohm


# Kind → cells in series, capacity range [Ah], probability of each chemistry.
KINDS: Final[dict[str, tuple[int, float, float, dict[str, float]]]] = {
    "leaf24": (96, 48.0, 66.0, {"lmo": 1.0}),
    "leaf40": (96, 100.0, 116.0, {"nmc": 1.0}),
    "car60": (96, 140.0, 168.0, {"nmc": 0.6, "nca": 0.4}),
    "car60lfp": (106, 150.0, 165.0, {"lfp": 1.0}),
    "compact": (108, 55.0, 94.0, {"nmc": 0.8, "nca": 0.2}),
    "module12": (12, 30.0, 120.0, {"nmc": 0.5, "lmo": 0.3, "nca": 0.2}),
}
_KIND_ODDS: Final = {
    "leaf24": 3,
    "leaf40": 2,
    "car60": 2,
    "car60lfp": 1,
    "compact": 2,
    "module12": 1,
}


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
    if kind is not None and kind not in KINDS:
        raise InputError("unknown pack", value=kind, cure=f"use {', '.join(KINDS)}")
    if kind is None:
        odds = np.array(list(_KIND_ODDS.values()), dtype=float)
        kind = str(rng.choice(list(_KIND_ODDS), p=odds / odds.sum()))
    cells, low_ah, high_ah, names = KINDS[kind]
    capacity = float(rng.uniform(low_ah, high_ah))
    name = str(rng.choice(list(names), p=list(names.values())))
    entropy_scale = float(np.exp(rng.uniform(-0.2, 1.1)))
    specimen = chemistry(chemistry_name or name, rng, entropy_scale)
    # Overpotential of one cell at 1C, divided among the processes.
    volts = rng.uniform(0.050, 0.095)
    share = rng.dirichlet(np.array([9.0, 5.0, 3.0]))
    ohmic, transfer, electrolyte = volts * share / capacity
    taus = float(np.exp(rng.uniform(np.log(12.0), np.log(28.0))))
    split = rng.uniform(0.4, 0.7)
    quick = float(np.exp(rng.uniform(np.log(18.0), np.log(45.0))))
    swing = rng.uniform(0.012, 0.030) / capacity
    energy = cells * 3.7 * capacity / 1000.0
    heat_j_k = energy * rng.uniform(5500.0, 8500.0)
    quantiles = np.array([-1.75, -0.85, 0.0, 0.85, 1.75])  # of the cell spread, for the groups
    return TwinPack(
        name=kind,
        chemistry=specimen,
        cells=cells,
        capacity_ah=capacity,
        weights=np.array([0.1, 0.2, 0.4, 0.2, 0.1]) * cells,
        capacity_factor=1.0 + rng.uniform(0.003, 0.012) * rng.permutation(quantiles),
        resistance_factor=1.0 + rng.uniform(0.01, 0.05) * rng.permutation(quantiles),
        soc_shift=rng.uniform(0.001, 0.006) * rng.permutation(quantiles),
        ohmic_ohm=float(ohmic),
        ohmic_vogel_k=float(rng.uniform(150.0, 320.0)),
        busbar_ohm=float(cells * ohmic * rng.uniform(0.03, 0.15)),
        exchange_a=float(0.02569 / transfer),
        exchange_activation_k=float(rng.uniform(4000.0, 6500.0)),
        anodic=float(rng.uniform(0.42, 0.58)),
        double_layer_s=float(np.exp(rng.uniform(np.log(0.04), np.log(0.5)))),
        electrolyte_ohm=(float(electrolyte * split), float(electrolyte * (1.0 - split))),
        electrolyte_tau_s=(taus, taus * float(rng.uniform(2.0, 3.0))),
        solid_swing=tuple(float(swing * part) for part in (0.62, 0.25, 0.13)),
        solid_tau_s=(quick * 1.8, quick * 0.5, quick * 0.16),
        diffusion_activation_k=float(rng.uniform(2200.0, 4000.0)),
        core_j_k=float(0.75 * heat_j_k),
        surface_j_k=float(0.25 * heat_j_k),
        core_surface_w_k=float(energy * rng.uniform(4.0, 10.0)),
        surface_ambient_w_k=float(heat_j_k / rng.uniform(9000.0, 30000.0)),
        sensors=_draw_sensors(rng, pack_v=cells * 3.7, capacity_ah=capacity),
    )


def _draw_sensors(rng: np.random.Generator, pack_v: float, capacity_ah: float) -> Sensors:
    car = pack_v > 100.0
    steps_v = (0.05, 0.1, 0.25, 0.5) if car else (0.005, 0.01, 0.02)
    step_a = float(rng.choice((0.02, 0.05, 0.1, 0.25, 0.5)))
    return Sensors(
        current_step_a=step_a,
        current_noise_a=float(capacity_ah * rng.uniform(0.0004, 0.003)),
        voltage_step_v=float(rng.choice(steps_v)),
        voltage_noise_v=float(pack_v * rng.uniform(0.0001, 0.0005)),
        temperature_step_k=float(rng.choice((0.1, 0.25, 0.5, 1.0))),
        temperature_lag_s=float(rng.uniform(5.0, 30.0)),
        rate_hz=float(rng.choice((1.0, 2.0, 5.0, 10.0), p=(0.6, 0.2, 0.1, 0.1))),
        jitter=float(rng.uniform(0.0, 0.06)),
        drop_share=float(rng.choice((0.0, rng.uniform(0.0005, 0.006)))),
        start_soc_std_pct=float(rng.uniform(0.02, 0.12)),
    )
