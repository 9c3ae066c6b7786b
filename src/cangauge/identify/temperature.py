"""The temperature's coefficient, as far as the logs tell it from the open-circuit voltage.

Over one discharge the temperature rises as the charge falls, and what the model lacks changes as
slowly as both. Plain least squares then finds any coefficient that makes the residual a little
smaller, and is sure of it: volts per kelvin for a pack of 96 cells, of which each has tenths of a
millivolt per kelvin (`benchmarks/other_temperatures.py`). So the residual is weighed time scale by
time scale, slow errors as likely as the faster ones let expect, and the coefficient is held near
zero by what is usual, as firmly as the logs leave it open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge.identify.scales import SCALES, by_scale

FloatArray = NDArray[np.float64]

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
