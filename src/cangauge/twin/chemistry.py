"""Open-circuit voltage and entropy of some cell chemistries, as tables.

The tables are drawn after the published shape of such curves (half-cell plateaus, knees near
empty), not after one product; every pack bends its own a little. Between the points a monotone
cubic (PCHIP, Fritsch and Butland 1984) keeps the voltage rising with charge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from cangauge.errors import InputError

FloatArray = NDArray[np.float64]

LOWEST, HIGHEST = -0.06, 1.04
"""Stoichiometry covered by the dense tables [-]: a weak cell goes below its own 0 %."""
_POINTS: Final = 2201
_BEND_V: Final = 0.006

# State of charge [%] → open-circuit voltage of one cell at 25 °C [V].
_OCV: Final[dict[str, tuple[tuple[float, float], ...]]] = {
    "nmc": (
        (0, 3.00), (1, 3.15), (2, 3.25), (3, 3.33), (5, 3.42), (7.5, 3.485), (10, 3.52),
        (15, 3.57), (20, 3.605), (25, 3.632), (30, 3.655), (40, 3.695), (50, 3.745), (60, 3.822),
        (70, 3.912), (80, 4.010), (90, 4.108), (95, 4.152), (98, 4.178), (100, 4.200),
    ),
    "lmo": (
        (0, 2.80), (1, 3.02), (2, 3.17), (3, 3.28), (5, 3.42), (7.5, 3.505), (10, 3.555),
        (15, 3.625), (20, 3.675), (30, 3.745), (40, 3.792), (50, 3.835), (60, 3.888), (70, 3.945),
        (80, 4.000), (90, 4.058), (95, 4.090), (98, 4.118), (100, 4.145),
    ),
    "nca": (
        (0, 2.75), (1, 2.95), (2, 3.08), (3, 3.17), (5, 3.29), (7.5, 3.375), (10, 3.425),
        (15, 3.490), (20, 3.540), (30, 3.610), (40, 3.668), (50, 3.742), (60, 3.832),
        (70, 3.920), (80, 4.000), (90, 4.080), (95, 4.128), (98, 4.165), (100, 4.190),
    ),
    "lfp": (
        (0, 2.55), (1, 2.80), (2, 2.94), (3, 3.02), (5, 3.11), (7.5, 3.170), (10, 3.200),
        (15, 3.230), (20, 3.250), (25, 3.266), (30, 3.278), (35, 3.287), (40, 3.292), (50, 3.297),
        (55, 3.302), (60, 3.312), (65, 3.325), (70, 3.330), (80, 3.334), (90, 3.339), (95, 3.346),
        (98, 3.370), (99, 3.400), (100, 3.450),
    ),
}  # fmt: skip

# State of charge [%] → dU/dT of one cell [mV/K].
_ENTROPY: Final[dict[str, tuple[tuple[float, float], ...]]] = {
    "nmc": ((0, -0.42), (8, -0.33), (20, -0.24), (35, -0.16), (50, -0.05), (65, 0.04),
            (80, 0.02), (92, -0.04), (100, -0.10)),
    "lmo": ((0, -0.30), (10, -0.22), (25, -0.15), (40, -0.02), (55, 0.12), (70, 0.08),
            (85, -0.06), (100, -0.12)),
    "nca": ((0, -0.50), (10, -0.38), (25, -0.20), (40, -0.08), (55, 0.03), (75, 0.05),
            (90, 0.01), (100, -0.05)),
    "lfp": ((0, -0.45), (10, -0.25), (25, -0.12), (38, 0.02), (50, 0.06), (62, 0.20),
            (75, 0.14), (90, 0.10), (100, 0.02)),
}  # fmt: skip

CHEMISTRIES: Final = tuple(_OCV)


@dataclass(frozen=True, eq=False)
class Chemistry:
    """Voltage and entropy of one cell against its state of charge.

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


def chemistry(name: str, rng: np.random.Generator, entropy_scale: float = 1.0) -> Chemistry:
    """Return one specimen of a chemistry: its table, bent by some millivolts.

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
        If there is no such chemistry.
    """
    if name not in _OCV:
        raise InputError(
            "no such chemistry", value=name, cure=f"use one of: {', '.join(CHEMISTRIES)}"
        )
    soc, volts = np.array(_OCV[name]).T
    # A full cell's table ends at 100 %; a weak or overfull one goes on beyond both ends.
    soc = np.concatenate(([-6.0, -3.0], soc, [104.0])) / 100.0
    volts = np.concatenate(([volts[0] - 1.35, volts[0] - 0.62], volts, [volts[-1] + 0.12]))
    grid = np.linspace(LOWEST, HIGHEST, _POINTS)
    table = PchipInterpolator(soc, volts)(grid)
    # Bent by a slow wave; the flat table of LFP is bent less, so that it keeps rising.
    waves = sum(
        rng.normal() / order * np.sin(order * np.pi * grid + rng.uniform(0.0, 2.0 * np.pi))
        for order in (1, 2, 3)
    )
    size = _BEND_V * (0.05 if name == "lfp" else 1.0)
    table = np.maximum.accumulate(table + size * waves) + 1e-6 * grid
    entropy_soc, entropy = np.array(_ENTROPY[name]).T
    curve = PchipInterpolator(entropy_soc / 100.0, entropy * 1e-3, extrapolate=False)
    entropy_table = curve(np.clip(grid, 0.0, 1.0)) * entropy_scale
    return Chemistry(name, grid, table, entropy_table)
