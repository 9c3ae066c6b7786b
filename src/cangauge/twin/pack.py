"""What a simulated pack is made of, and how one is drawn at random."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cangauge.errors import InputError
from cangauge.twin.chemistry import CHEMISTRIES, Chemistry, chemistry

FloatArray = NDArray[np.float64]

KELVIN: Final = 273.15


@dataclass(frozen=True)
class Sensors:
    """The chain from the terminals to the frame, as the clean pack has it."""

    current_step_a: float
    current_noise_a: float
    voltage_step_v: float
    voltage_noise_v: float
    temperature_step_k: float
    temperature_lag_s: float
    rate_hz: float
    jitter: float
    """Standard deviation of the sampling instant, in sampling periods [-]."""
    drop_share: float
    """Share of the frames that get lost [-]."""
    start_soc_std_pct: float
    """Error of the SoC that the gauge assumes at the start [%]."""


@dataclass(frozen=True, eq=False)
class Pack:
    """A pack of lithium-ion cells in series.

    Resistances are of one cell at 25 °C [Ω], positive. Groups hold representative cells, shape
    (g,): how many cells each stands for and how it differs from the mean cell.
    """

    name: str
    chemistry: Chemistry
    cells: int
    capacity_ah: float
    weights: FloatArray
    capacity_factor: FloatArray
    resistance_factor: FloatArray
    soc_shift: FloatArray
    """Start SoC against the pack's [-]."""

    ohmic_ohm: float
    ohmic_vogel_k: float
    """B of exp(B/(T − 170 K)): conductivity of the electrolyte (Vogel–Fulcher–Tammann)."""
    busbar_ohm: float
    """Copper of the whole pack [Ω]; hardly depends on temperature."""
    exchange_a: float
    """Exchange current at 25 °C and half charge [A]."""
    exchange_activation_k: float
    """Activation energy over the gas constant [K]."""
    anodic: float
    """Share of the overpotential that helps discharge [-] (0.5: symmetric)."""
    double_layer_s: float
    electrolyte_ohm: tuple[float, ...]
    electrolyte_tau_s: tuple[float, ...]
    solid_swing: tuple[float, ...]
    """Surface against mean state of charge per ampere, one a mode [1/A]."""
    solid_tau_s: tuple[float, ...]
    diffusion_activation_k: float

    core_j_k: float
    surface_j_k: float
    core_surface_w_k: float
    surface_ambient_w_k: float
    sensors: Sensors
    knows_core: bool = False
    """Whether the gauge adds to the surface's temperature what the core stands above it while the
    pack is healthy."""

    @property
    def one_c_a(self) -> float:
        """Current that empties the pack in one hour [A]."""
        return self.capacity_ah

    @property
    def nominal_v(self) -> float:
        """Open-circuit voltage at half charge [V]."""
        return float(self.cells * self.chemistry.ocv(np.array([0.5]))[0])

    @property
    def energy_kwh(self) -> float:
        """Nominal energy [kWh]."""
        return self.nominal_v * self.capacity_ah / 1000.0

    @property
    def resistance_ohm(self) -> float:
        """Resistance of the pack at 25 °C against currents of some seconds [Ω]."""
        transfer = 0.02569 / self.exchange_a
        return self.cells * (self.ohmic_ohm + transfer) + self.busbar_ohm


# Name → cells in series, capacity [Ah] from … to, chemistries and how often each.
KINDS: Final[dict[str, tuple[int, float, float, dict[str, float]]]] = {
    "leaf24": (96, 48.0, 66.0, {"lmo": 1.0}),
    "leaf40": (96, 100.0, 116.0, {"nmc": 1.0}),
    "car60": (96, 140.0, 168.0, {"nmc": 0.6, "nca": 0.4}),
    "car60lfp": (106, 150.0, 165.0, {"lfp": 1.0}),
    "compact": (108, 55.0, 94.0, {"nmc": 0.8, "nca": 0.2}),
    "module12": (12, 30.0, 120.0, {"nmc": 0.5, "lmo": 0.3, "nca": 0.2}),
}
_KIND_ODDS: Final = {"leaf24": 3, "leaf40": 2, "car60": 2, "car60lfp": 1, "compact": 2,
                     "module12": 1}  # fmt: skip


def draw_pack(
    rng: np.random.Generator, kind: str | None = None, chemistry_name: str | None = None
) -> Pack:
    """Return a pack at random.

    Parameters
    ----------
    rng : Generator
    kind : str, optional
        One of `KINDS`; at random without.
    chemistry_name : {"nmc", "lmo", "nca", "lfp"}, optional
        Another chemistry than the kind's own.

    Raises
    ------
    InputError
        If there is no such kind or chemistry.
    """
    if kind is not None and kind not in KINDS:
        raise InputError("no such pack", value=kind, cure=f"use one of: {', '.join(KINDS)}")
    if kind is None:
        odds = np.array(list(_KIND_ODDS.values()), dtype=float)
        kind = str(rng.choice(list(_KIND_ODDS), p=odds / odds.sum()))
    cells, low_ah, high_ah, names = KINDS[kind]
    capacity = float(rng.uniform(low_ah, high_ah))
    drawn = str(rng.choice(list(names), p=list(names.values())))
    name = drawn if chemistry_name is None else chemistry_name
    if name not in CHEMISTRIES:
        raise InputError(
            "no such chemistry", value=name, cure=f"use one of: {', '.join(CHEMISTRIES)}"
        )
    specimen = chemistry(name, rng, entropy_scale=float(np.exp(rng.uniform(-0.2, 1.1))))
    # Volts that 1C costs in all, then shared among the processes.
    volts = rng.uniform(0.050, 0.095)
    share = rng.dirichlet(np.array([9.0, 5.0, 3.0]))
    ohmic, transfer, electrolyte = volts * share / capacity
    taus = float(np.exp(rng.uniform(np.log(12.0), np.log(28.0))))
    split = rng.uniform(0.4, 0.7)
    quick = float(np.exp(rng.uniform(np.log(18.0), np.log(45.0))))
    swing = rng.uniform(0.012, 0.030) / capacity
    energy = cells * 3.7 * capacity / 1000.0
    heat_j_k = energy * rng.uniform(5500.0, 8500.0)
    weights, quantiles = _spread(cells)
    return Pack(
        name=kind,
        chemistry=specimen,
        cells=cells,
        capacity_ah=capacity,
        weights=weights,
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


def _spread(cells: int) -> tuple[FloatArray, FloatArray]:
    shares = np.array([0.1, 0.2, 0.4, 0.2, 0.1])
    weights = shares * cells
    quantiles = np.array([-1.75, -0.85, 0.0, 0.85, 1.75])
    return weights, quantiles


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
