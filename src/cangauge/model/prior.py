"""Prior of a model's coefficients: typical cells of a chemistry, and how far packs differ.

    knots of the curve   N(cells·m(S), V0²·K)
        K = 0.02² + ∫∫ from 100 % of slope errors + (0.06·e^(−S/5 %))² + (3·10⁻⁴)²·1
        slope errors: (σ² + e(S)·e(S′)/3)·exp(−½·((S − S′)/20 %)²) + …
    kt                   N(0, (2.5·10⁻⁴·V0)²)
    resistances          N(h·V0/C, …), as in `RESISTANCE_H`
    factor b             N(1, 0.5²)

V0 and S0 are mean voltage and SoC of the logs, m is the voltage of a typical cell, C the capacity,
and e the slope of a second typical cell minus that of m: the share of the second cell in a pack is
uniform between 0 and 1 (mean square 1/3), and may change with SoC. Where the number of cells is
unknown, m is scaled to V0 at S0, slope errors count from there, and the level has 0.05². Everything
scales with the pack, so that one prior serves a cell and an 800 V pack. Constants without another
source were chosen on recorded development trips and kept for all others.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from cangauge._typing import FloatArray
from cangauge.model.curve import KNOTS_PCT, PublishedCurve, hermite_basis
from cangauge.model.voltage_model import DELAYS_S, REFERENCE_C, Functions, Loads, resistance_factor

ChemistryName = Literal["oxide", "lfp"]

LOW_PASS_S: Final = (10.0, 140.0)
"""Time constants of the low-passed currents [s]: the polarization of a drive has seconds to
minutes, and 70 s of delays cannot express it."""

LEVEL_STD: Final = 0.05
"""Standard deviation of the curve's level relative to V0, at S0, where the number of cells is
unknown: the two typical oxide cells differ by 4 % at half charge."""
FULL_STD: Final = 0.02
"""Standard deviation of the full cells' voltage relative to V0, where their number is known: a
gauge's 100 % is up to 0.1 V per cell below the 4.2 V that oxide cells are charged to."""
SLOPE_SPAN_PCT: Final = 20.0
"""Span of the slope errors [% SoC]: a phase of the electrodes."""
ROUGH_STD: Final = 2e-4
"""Second slope error [V0/%], …"""
ROUGH_SPAN_PCT: Final = 5.0
"""… of this span [% SoC]: features within a phase."""
KNEE_STD: Final = 0.06
"""Error of the knee near empty relative to V0: the cut-off voltage differs by 0.2 V per cell."""
KNEE_SPAN_PCT: Final = 5.0
"""SoC over which it decays [%]."""
NUGGET_STD: Final = 3e-4
"""Error of each knot on its own, relative to V0."""
GRID_PCT: Final = 0.5
"""Step of the integral over slope errors [% SoC]."""
KT_STD: Final = 2.5e-4
"""Standard deviation of kt [V0/K]: entropy of the cells (0.4 mV/K of 3.7 V), and self-heating that
the sensor does not see; Reynier, Yazami, Fultz, J. Power Sources 119–121 (2003) 850."""
RESISTANCE_H: Final = ((0.012, 0.012), *((0.002, 0.004),) * (len(DELAYS_S) + len(LOW_PASS_S) - 1))
"""Mean and standard deviation of each resistance [h], times V0/C in ohms: a cell of energy type
drops 2 % of its voltage at 1 C, half of it at once."""
B: Final = (1.0, 0.5)
"""Mean and standard deviation of the factor on the Arrhenius change [-]: all of the resistance
follows a(T), but for contacts and leads."""
RESIDUAL_STD: Final = 0.003
"""Rms residual of a pack without logs, relative to V0; also the voltage noise against which an
uncertain SoC is weighed: the published model leaves 0.25 %."""

BLOCK_S: Final = 30.0
"""Time over which voltages are averaged for one update of a filter [s]."""
SLOW_S: Final = 300.0
"""Time constant of the slow voltage error [s]: residuals of recorded trips correlate by 0.3–0.5 at
60 s and 0.1 at 300 s."""
SLOW_SHARE: Final = 0.4
"""Share of the residuals that is slow [-]: development packs."""
FAST_FLOOR: Final = 0.0003
"""Least noise of a block's mean, relative to the mean voltage [-]: development packs."""


@dataclass(frozen=True, eq=False)
class Chemistry:
    """Typical cell of a chemistry, and the errors of its voltage.

    Parameters
    ----------
    curve_v : array of shape (knots,)
        Open-circuit voltage of a typical cell at `KNOTS_PCT` [V].
    other_v : array of shape (knots,)
        That of a second typical cell [V].
    slope_std : float
        Standard deviation of the curve's slope error [V0/%].
    soc_std_pct : float
        Lasting uncertainty of SoC against voltage [% SoC]: surface, hysteresis, reference.
    level_std, slow_std : float
        Voltage error that lasts a log, and 300 s, relative to V0.
    fast_factor : float
        Noise of a block's mean in units of the residuals of the fit.
    functions : int
        Principal functions that a filter carries: more change no mean error by 0.1 %.
    cold_exponent : float
        Level, slow and fast noise grow as max(1, a(T)) to this power below 20 °C: model errors are
        polarization, so they grow with the resistance.
    """

    curve_v: FloatArray
    other_v: FloatArray
    slope_std: float
    soc_std_pct: float
    level_std: float
    slow_std: float
    fast_factor: float
    functions: int
    cold_exponent: float

    def level_v(self, mean_v: float, mean_c: ArrayLike = REFERENCE_C) -> FloatArray:
        """Return the voltage error that lasts a log, of mean voltage and temperature [V]."""
        a = np.maximum(1.0, resistance_factor(mean_c))
        return np.asarray(self.level_std * mean_v * a**self.cold_exponent)


def _curve(table: Mapping[float, float]) -> FloatArray:
    """Return voltages at `KNOTS_PCT` [V] from those at some SoC [%]."""
    return np.interp(KNOTS_PCT, list(table), list(table.values()))


_LAYERED_V: Final = _curve(
    {
        0: 3.08,
        2.5: 3.255,
        5: 3.36,
        10: 3.465,
        20: 3.565,
        30: 3.625,
        40: 3.675,
        50: 3.735,
        60: 3.815,
        70: 3.895,
        80: 3.975,
        90: 4.055,
        100: 4.14,
    }
)
_LEAF_2012: Final = PublishedCurve(
    (394.4, 48.89, -4.769, 0.2158, -0.003718, -54.59, 109.3, -3.141)  # k0 … k7 [V], of 96 cells
)
_SPINEL_V: Final = _LEAF_2012.values(KNOTS_PCT) / 96
_PHOSPHATE_V: Final = _curve(
    {
        0: 2.70,
        1: 2.90,
        2.5: 3.05,
        5: 3.13,
        10: 3.20,
        20: 3.25,
        30: 3.28,
        40: 3.29,
        50: 3.295,
        60: 3.305,
        70: 3.325,
        80: 3.333,
        90: 3.337,
        95: 3.342,
        97.5: 3.35,
        99: 3.37,
        100: 3.45,
    }
)
"""Open-circuit voltages of typical cells against graphite [V]:

layered oxides
    A smooth curve. Its shape is within 19 mV (1–100 %) of the mean open-circuit voltage of three
    published cells between 3.0 and 4.15 V: NMC811 (Chen et al. 2020, doi 10.1149/1945-7111/ab9050),
    NMC532 (Mohtat et al. 2020, doi 10.1149/1945-7111/aba5d1) and a nickel-cobalt oxide (Ecker et
    al. 2015, doi 10.1149/2.0551509jes).
manganese spinel, blended with layered oxide
    The published pseudo-OCV of the 2012 Leaf (`model.published`).
iron phosphate
    Within 12 mV (10–97.5 %) of LiFePO4 (Afshar et al. 2017, arXiv 1709.03970) against graphite
    (Mohtat et al. 2020) at stoichiometries 0.97–0.03 and 0.01–0.80.
"""

CHEMISTRIES: Final[Mapping[ChemistryName, Chemistry]] = {
    "oxide": Chemistry(
        _LAYERED_V,
        _SPINEL_V,
        slope_std=5e-4,
        soc_std_pct=0.3,
        level_std=0.0018,
        slow_std=0.0014,
        fast_factor=1.0,
        functions=8,
        cold_exponent=1.5,
    ),
    "lfp": Chemistry(
        _PHOSPHATE_V,
        _PHOSPHATE_V,
        slope_std=2e-4,
        soc_std_pct=3.0,
        level_std=0.008,
        slow_std=0.006,
        fast_factor=6.0,
        functions=12,
        cold_exponent=0.0,
    ),
}
"""The chemistries that differ in shape: oxides, and iron phosphate, whose plateau is flat."""


@dataclass(frozen=True, eq=False)
class Distribution:
    """Normal distribution of a pack's coefficients: the prior, or the posterior of its logs.

    Parameters
    ----------
    coefficients : array of shape (p,)
        Means: knots [V], kt [V/K], resistances [Ω], b [-].
    covariance : array of shape (p, p)
    arrhenius_ohm : array of shape (M,)
        Resistances R⁰ that b scales [Ω]; negative.
    residual_v : float
        Rms residual of the logs' rows, or that expected without logs [V].
    mean_v, mean_c : float
        Mean voltage V0 [V] and temperature T̄ [°C] of the logs.
    scale : float
        κ²: how much larger than stated the errors of left-out logs are.
    strain : float
        What a left-out log teaches, relative to its mean under the model; 1 at most.
    """

    coefficients: FloatArray
    covariance: FloatArray
    arrhenius_ohm: FloatArray
    residual_v: float
    mean_v: float
    mean_c: float
    scale: float = 1.0
    strain: float = 1.0


@lru_cache(maxsize=256)
def shape_covariance(start: float, chemistry: Chemistry) -> FloatArray:
    """Return the covariance of the knots relative to V0², without that of the level.

    An integrated process of the slope, the knee, and an error of each knot on its own.

    Parameters
    ----------
    start : float
        SoC from which the slope counts, a multiple of `GRID_PCT` [%].
    chemistry : Chemistry
    """
    edges = np.arange(0.0, 100.0 + GRID_PCT, GRID_PCT)
    grid = 0.5 * (edges[1:] + edges[:-1])
    gap = grid[:, None] - grid
    away_v = np.interp(edges, KNOTS_PCT, chemistry.other_v - chemistry.curve_v)
    between = np.diff(away_v) / GRID_PCT / np.interp(50.0, KNOTS_PCT, chemistry.curve_v)
    slope = chemistry.slope_std**2 + np.outer(between, between) / 3.0
    slope *= np.exp(-0.5 * (gap / SLOPE_SPAN_PCT) ** 2)
    slope += ROUGH_STD**2 * np.exp(-0.5 * (gap / ROUGH_SPAN_PCT) ** 2)
    above = (grid > start) & (grid < KNOTS_PCT[:, None])
    below = (grid < start) & (grid > KNOTS_PCT[:, None])
    integral = GRID_PCT * (above.astype(np.float64) - below)
    knee = KNEE_STD * np.exp(-KNOTS_PCT / KNEE_SPAN_PCT)
    nugget = np.eye(KNOTS_PCT.size) * NUGGET_STD**2
    return np.asarray(integral @ slope @ integral.T + np.outer(knee, knee) + nugget)


@dataclass(frozen=True, eq=False)
class PackPrior:
    """What is known of a pack without its logs.

    Parameters
    ----------
    chemistry : Chemistry
    capacity_ah : float
        [Ah].
    cells : int, optional
        Cells in series; None where unknown.
    """

    chemistry: Chemistry
    capacity_ah: float
    cells: int | None = None

    def coefficients(self, mean_v: float, mean_soc_pct: float) -> Distribution:
        """Return the distribution of the pack's coefficients.

        Parameters
        ----------
        mean_v, mean_soc_pct : float
            Mean voltage V0 [V] and SoC S0 [%] of the logs.
        """
        chemistry, n = self.chemistry, KNOTS_PCT.size
        if self.cells is None:
            cells = mean_v / float(np.interp(mean_soc_pct, KNOTS_PCT, chemistry.curve_v))
            start, level_std = round(mean_soc_pct / GRID_PCT) * GRID_PCT, LEVEL_STD
        else:
            cells, start, level_std = self.cells, 100.0, FULL_STD
        h_mean, h_std = np.array(RESISTANCE_H).T * mean_v / self.capacity_ah
        b_mean, b_std = B
        std = np.r_[KT_STD * mean_v, h_std, b_std]
        covariance = np.zeros((n + std.size, n + std.size))
        covariance[:n, :n] = (shape_covariance(start, chemistry) + level_std**2) * mean_v**2
        covariance[n:, n:] = np.diag(std**2)
        mean = np.r_[cells * chemistry.curve_v, 0.0, -h_mean, b_mean]
        return Distribution(mean, covariance, -h_mean, RESIDUAL_STD * mean_v, mean_v, REFERENCE_C)


def principal_functions(
    chemistry: ChemistryName, covariance: FloatArray, loads: Loads, capacity_ah: float
) -> Functions:
    """Return the joint principal functions of the coefficients' covariance.

    They explain most of the variance of the voltage, over all SoC and the loads of a usual drive.

    Parameters
    ----------
    chemistry : {"oxide", "lfp"}
        Which states their number.
    covariance : array of shape (p, p)
        Of the knots and the coefficients of the load columns.
    loads : Loads
    capacity_ah : float
        [Ah].
    """
    usual_a, usual_k = 1.0 / 3.0 * capacity_ah, 10.0  # a drive; a season's change within a day
    usual = [usual_k, *[usual_a] * len(loads.resistance_ohm)]
    if loads.arrhenius is not None:
        total_ohm = abs(float(np.sum(loads.arrhenius.resistance_ohm)))
        usual.append(0.5 * usual_a * total_ohm)  # a(T)/a(T̄) − 1 where it is 12 K colder
    basis = hermite_basis(np.linspace(0.0, 100.0, 401))
    n = KNOTS_PCT.size
    weight = np.zeros_like(covariance)
    weight[:n, :n] = basis.T @ basis / len(basis)
    weight[n:, n:] = np.diag(np.array(usual) ** 2)
    root = np.linalg.cholesky(weight)
    variance, direction = np.linalg.eigh(root.T @ covariance @ root)
    first = np.argsort(variance)[::-1][: CHEMISTRIES[chemistry].functions]
    scaled = direction[:, first] * np.sqrt(np.maximum(variance[first], 0.0))
    parts = np.linalg.solve(root.T, scaled).T
    curve_v, load = parts[:, :n].tolist(), parts[:, n:].tolist()
    return Functions(soc_pct=tuple(KNOTS_PCT.tolist()), curve_v=curve_v, load=load)
