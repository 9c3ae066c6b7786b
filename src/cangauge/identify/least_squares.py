"""Least squares with a rising pseudo-OCV: well scaled, with honest standard errors.

The columns 1 … 1/s⁴, s, ln s, ln(1 − s) are nearly dependent (condition numbers of 10⁶ and more
over the SoC of a few trips), so the columns are scaled to unit length and the problem is solved
by SVD. Where the plain solution's pseudo-OCV falls anywhere in the SoC that it saw, the same
problem is solved as a convex quadratic programme with the slope bounded from below.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cangauge.errors import CangaugeError
from cangauge.identify.temperature import Held

FloatArray = NDArray[np.float64]

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
