"""The temperature's coefficient, as far as the logs tell it from the open-circuit voltage.

Over one discharge the temperature rises as the charge falls, and what the model lacks changes as
slowly as both. Plain least squares then finds any coefficient that makes the residual a little
smaller, and is sure of it: volts per kelvin for a pack of 96 cells, of which each has tenths of a
millivolt per kelvin (`benchmarks/other_temperatures.py`). So the residual is weighed time scale by
time scale, slow errors as likely as the faster ones let expect, and the coefficient is held near
zero by what is usual, as firmly as the logs leave it open.

Least squares with a rising pseudo-OCV: well scaled, with honest standard errors.

The columns 1 … 1/s⁴, s, ln s, ln(1 − s) are nearly dependent (condition numbers of 10⁶ and more
over the SoC of a few trips), so the columns are scaled to unit length and the problem is solved
by SVD. Where the plain solution's pseudo-OCV falls anywhere in the SoC that it saw, the same
problem is solved as a convex quadratic programme with the slope bounded from below.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cangauge._typing import FloatArray
from cangauge.errors import CangaugeError
from cangauge.inference.time_scales import SCALES, by_scale

# --- The temperature's coefficient, as far as the logs tell it from the open-circuit voltage

USUAL_PART_PER_K = 2.5e-4
"""Usual coefficient, in parts of the voltage [1/K]: 1 mV/K a cell, some times what entropy does.
Chosen on simulated packs and real cells: half of it was better for the cells, twice to four times
as much for packs with the published coefficient, which is eight times as large."""

ENOUGH = 40
"""The variance of a scale with fewer coefficients is not that of its errors: the fit took them."""

STEEPEST = np.log(4.0)
"""From one scale to the next, errors' variance grows by no more than that of a random walk."""

OCTAVES = 3
"""How it grows is read from so many of the slowest scales that have enough."""

JITTER = 1e-9


@dataclass(frozen=True, eq=False)
class Held:
    """How firmly the temperature's coefficient is held at zero."""

    std_v_per_k: float
    """How far the logs leave it open [V/K]."""
    usual_v_per_k: float
    """How large it usually is [V/K]."""
    own: FloatArray
    """The temperature as far as no other column goes with it, shape (n,) [K]."""
    others: FloatArray
    """By how much the other coefficients move with it, shape (p,), 0 for itself [per V/K]."""

    residual_std_v: float
    """Of plain least squares [V]."""

    @property
    def weight(self) -> float:
        """Weight of a row that says 0 V/K, beside which least squares leaves `part`.

        At least what it would be with white errors: a temperature that never moves has no own
        part, and nothing else would keep its coefficient from being anything.
        """
        leaves = float(np.sqrt((1.0 / self.part - 1.0) * (self.own @ self.own)))
        return max(leaves, self.residual_std_v / self.usual_v_per_k)

    @property
    def part(self) -> float:
        """Part of the plain coefficient that is left (0–1)."""
        usual = self.usual_v_per_k**2
        return usual / (usual + self.std_v_per_k**2)

    @property
    def held_std_v_per_k(self) -> float:
        """Standard error of what is left [V/K]."""
        return self.std_v_per_k * float(np.sqrt(self.part))


def how_firmly(
    columns: FloatArray,
    residual_v: FloatArray,
    volts: FloatArray,
    lengths: Sequence[int],
    at: int,
) -> Held:
    """Return how firmly the logs let the temperature's coefficient be held.

    Parameters
    ----------
    columns : array of shape (n, p)
        Of all coefficients, all logs' rows in order of time.
    residual_v, volts : array of shape (n,)
        Of plain least squares [V]; measured [V].
    lengths : sequence of int
        Rows of each log.
    at : int
        Which column is the temperature's.
    """
    scale = np.sqrt(np.mean(columns**2, axis=0))
    scale[scale == 0.0] = 1.0
    table = np.column_stack([columns / scale, residual_v])
    ends = np.cumsum(lengths)[:-1]
    parts = [by_scale(item) for item in np.split(table, ends) if len(item)]
    of_scale = [np.vstack([part[j] for part in parts]) for j in range(SCALES)]
    variance = _variance([item[:, -1] for item in of_scale])
    information = sum(
        item[:, :-1].T @ item[:, :-1] / v2 for item, v2 in zip(of_scale, variance, strict=True)
    )
    total = np.asarray(information)
    total[np.diag_indices(len(total))] += JITTER * np.trace(total) / len(total)
    variance_of = float(np.linalg.inv(total)[at, at])
    own, others = _beside(columns, at)
    return Held(
        std_v_per_k=float(np.sqrt(variance_of)) / float(scale[at]),
        usual_v_per_k=USUAL_PART_PER_K * float(np.median(volts)),
        own=own,
        others=others,
        residual_std_v=float(np.sqrt(np.mean(residual_v**2))),
    )


def _beside(columns: FloatArray, at: int) -> tuple[FloatArray, FloatArray]:
    """Return what is one column's own, (n,), and how the others make up the rest, (p,)."""
    norm = np.linalg.norm(columns, axis=0)
    norm[norm == 0.0] = 1.0
    rest = np.arange(columns.shape[1]) != at
    makes_up = np.zeros(columns.shape[1])
    scaled = columns[:, rest] / norm[rest]
    makes_up[rest] = np.linalg.lstsq(scaled, columns[:, at], rcond=None)[0] / norm[rest]
    return columns[:, at] - columns @ makes_up, -makes_up


def _variance(residual_v: Sequence[FloatArray]) -> FloatArray:
    """Return the variance to expect of each scale's errors, shape (SCALES,) [V²].

    What is slower than the scales with enough coefficients is fitted away, and goes on as they do.
    """
    counts = np.array([item.size for item in residual_v])
    found = np.array([float(item @ item) / max(item.size, 1) for item in residual_v])
    found = np.maximum(found, 1e-12)
    enough = np.flatnonzero(counts >= ENOUGH)
    if enough.size:
        last, first = enough[-1], max(enough[-1] - OCTAVES, 0)
        growth = np.log(found[last] / found[first]) / max(last - first, 1)
        growth = float(np.clip(growth, 0.0, STEEPEST))
        beyond = np.arange(last + 1, SCALES)
        found[beyond] = np.maximum(found[beyond], found[last] * np.exp(growth * (beyond - last)))
    return np.asarray(np.maximum.accumulate(found))


# --- Least squares with a rising pseudo-OCV: well scaled, with honest standard errors

SINGULAR = 1e-11
"""Directions with a smaller singular value, relative to the largest, are left at zero."""

BLOCK_S = 300.0
"""Residuals further apart than this count as independent in the standard errors [s]."""

FEASIBLE = 1e-9
"""A bound is missed by more than this, relative to its value and to one."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Coefficients and what is known of them."""

    coefficients: FloatArray
    """Shape (p,), in the units of the columns."""
    std_error: FloatArray
    """Shape (p,); robust against residuals that are correlated within `BLOCK_S`."""
    condition_number: float
    """Of the scaled columns."""
    constrained: bool
    """Whether the plain solution broke the bounds, so that they had to hold it."""
    held: Held | None = None
    """How firmly the temperature's coefficient was held, if it was."""

    def part(self, first: int) -> Solution:
        """Return what is known of the first coefficients."""
        return replace(
            self, coefficients=self.coefficients[:first], std_error=self.std_error[:first]
        )


def solve(
    columns: FloatArray, target: FloatArray, block: NDArray[np.intp], bounds: FloatArray | None,
    at_least: float | FloatArray,
) -> Solution:  # fmt: skip
    """Minimise |columns·x − target|² subject to bounds·x ≥ at_least.

    Parameters
    ----------
    columns : array of shape (n, p)
    target : array of shape (n,)
    block : array of shape (n,)
        Rows with the same number may have correlated residuals.
    bounds : array of shape (m, p), optional
    at_least : float or array of shape (m,)

    Raises
    ------
    CangaugeError
        If the convex solver finds no solution.
    """
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    left, singular, right = np.linalg.svd(columns / scale, full_matrices=False)
    kept = singular > SINGULAR * singular[0]
    left, right = left[:, kept], right[kept]
    # x = scale⁻¹·rightᵀ·(z/singular): in z the objective is |z − leftᵀ·target|², a sphere.
    back = (right / singular[kept, None]).T / scale[:, None]
    z = left.T @ target
    constrained = bounds is not None and bool(np.any(bounds @ (back @ z) < at_least))
    if constrained and bounds is not None:
        z = _nearest(z, bounds @ back, np.broadcast_to(at_least, bounds.shape[:1]))
    x = back @ z
    return Solution(
        coefficients=x,
        std_error=_clustered_std_error(left, target - columns @ x, block, back),
        condition_number=float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf"),
        constrained=constrained,
    )


def nearest_rising(
    root: FloatArray, target: FloatArray, bounds: FloatArray, at_least: FloatArray
) -> FloatArray:
    """Minimise |root·x − target|² subject to bounds·x ≥ at_least; root is square and regular.

    Parameters
    ----------
    root : array of shape (p, p)
    target : array of shape (p,)
    bounds : array of shape (m, p)
    at_least : array of shape (m,)

    Raises
    ------
    CangaugeError
        If the convex solver finds no solution.
    """
    inverse = np.linalg.inv(root)
    plain = inverse @ target
    if np.all(bounds @ plain >= at_least):
        return np.asarray(plain)
    return np.asarray(inverse @ _nearest(target, bounds @ inverse, at_least))


def _nearest(z: FloatArray, bounds: FloatArray, at_least: FloatArray) -> FloatArray:
    """Return the point nearest to z with bounds·point ≥ at_least.

    Few of the bounds matter: those that are missed, and those that are missed then.
    """
    length = np.linalg.norm(bounds, axis=1)
    # What no kept direction moves cannot be bounded.
    moves = length > 0.0
    bounds, at_least = bounds[moves] / length[moves, None], at_least[moves] / length[moves]
    enough = at_least - FEASIBLE * (1.0 + np.abs(at_least))
    point, held = z, np.zeros(at_least.size, dtype=bool)
    while np.any(missed := (bounds @ point < enough) & ~held):
        held |= missed
        point = _nearest_within(z, bounds[held], at_least[held])
    return point


def _nearest_within(z: FloatArray, bounds: FloatArray, at_least: FloatArray) -> FloatArray:
    # From z on and in units of what is missed most: the solver's tolerances suit numbers about 1,
    # and at a hundred it may stop short.
    missed = at_least - bounds @ z
    unit = float(np.abs(missed).max())
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix(np.eye(z.size)),
        np.zeros(z.size),
        sparse.csc_matrix(-bounds),
        -missed / unit,
        [clarabel.NonnegativeConeT(at_least.size)],
        settings,
    ).solve()
    if str(solution.status) not in {"Solved", "AlmostSolved"}:
        raise CangaugeError(
            f"the fit under a rising pseudo-OCV found no solution ({solution.status}):"
            " is the sign of current right, and does the log move over some SoC?"
        )
    return z + unit * np.array(solution.x)


def _clustered_std_error(
    left: FloatArray, residual: FloatArray, block: NDArray[np.intp], back: FloatArray
) -> FloatArray:
    """Return the sandwich estimate with one cluster a block (Liang and Zeger)."""
    _, number = np.unique(block, return_inverse=True)
    scores = np.zeros((int(number.max()) + 1, left.shape[1]))
    np.add.at(scores, number, left * residual[:, None])
    groups, (n, p) = scores.shape[0], left.shape
    small_sample = (groups / max(groups - 1, 1)) * ((n - 1) / max(n - p, 1))
    # Few blocks cannot tell p directions apart; the plain estimate is then the floor.
    clustered = small_sample * np.sum((back @ scores.T) ** 2, axis=1)
    plain = float(residual @ residual) / max(n - p, 1) * np.sum(back**2, axis=1)
    return np.asarray(np.sqrt(np.maximum(clustered, plain)))
