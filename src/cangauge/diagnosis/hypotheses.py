"""Hypotheses of a diagnosis: candidate effects, and the role of each in the linear model.

A *candidate* is one effect at one shape, such as a time constant; its *amplitudes* enter the
voltage linearly. Every candidate is tested as the cause of the diagnosed logs. Some have further
roles:

- *shared structure*: effects that healthy logs show as well, with amplitudes common to all logs;
- *per-log effects*: effects by which healthy logs may differ a little, with amplitudes of each log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.diagnosis.design_matrix import PER_LOG_STATES
from cangauge.model.effects.library import Candidate

Indices = NDArray[np.intp]

PRIOR_SIGMAS = 2.0
"""Half the width of an amplitude's bounds in prior standard deviations."""


def prior_precision(bounds: FloatArray) -> FloatArray:
    """Return the prior precision of amplitudes with bounds of shape (k, 2), shape (k, k)."""
    return np.diag((2.0 * PRIOR_SIGMAS / (bounds[:, 1] - bounds[:, 0])) ** 2)


@dataclass(frozen=True, eq=False)
class Layout:
    """Column indices of a log's normal equations."""

    coefficients: Indices
    """Voltage model coefficients."""
    structure: Indices
    """Amplitudes of the shared structure."""
    effects: Indices
    """Amplitudes of all candidates, including those with another role; empty for a reference."""
    per_log: Indices
    """Amplitudes of the per-log effects, then `PER_LOG_STATES`."""
    residual: int

    @cached_property
    def shared(self) -> Indices:
        """Columns whose amplitudes all logs share, in the order of a solution."""
        return np.concatenate((self.coefficients, self.structure))

    @cached_property
    def kept(self) -> Indices:
        """Columns that remain without the per-log amplitudes; each stays at its index."""
        last = max(int(self.shared.max()), int(self.effects.max(initial=0)))
        return np.append(np.arange(last + 1), self.residual)


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Candidates of a diagnosis with their roles, and the prior of the voltage model.

    The number of voltage model coefficients is p; their columns are divided by `column_scale`.
    """

    candidates: tuple[Candidate, ...]
    prior_root: FloatArray | None
    """Square root of the coefficients' information in the model file, shape (p, p)."""
    column_scale: FloatArray
    """Scale of the coefficient columns, shape (p,)."""
    structure: tuple[int, ...] = ()
    """Candidates of the shared structure."""
    per_log: tuple[int, ...] = ()
    """Candidates of the per-log effects."""
    per_log_prior_std: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Prior standard deviations: amplitudes of `per_log`, then `PER_LOG_STATES`."""
    prior_mean: FloatArray | None = None
    """Mean of the coefficients' prior in scaled columns, shape (p,); 0 if None."""

    @cached_property
    def offsets(self) -> Indices:
        """Index of each candidate's first amplitude, and the number of amplitudes at the end."""
        widths = [len(candidate.amplitudes) for candidate in self.candidates]
        return np.concatenate(([0], np.cumsum(widths))).astype(np.intp)

    @cached_property
    def structure_prior(self) -> tuple[tuple[str, ...], FloatArray]:
        """Effect and prior precision of each amplitude of the shared structure."""
        candidates = [self.candidates[k] for k in self.structure]
        names = tuple(each.effect.id for each in candidates for _ in each.amplitudes)
        return names, np.diag(prior_precision(self.bounds_of(self.structure)))

    @cached_property
    def mixtures(self) -> tuple[tuple[int, int], ...]:
        """Pairs of candidates adjacent in one shape parameter.

        A mixture of both represents a time constant between two grid values, or a spread of them.
        """
        pairs = []
        for a, one in enumerate(self.candidates):
            grids = _shape_grids(self.candidates, one.effect.id)
            for b in range(a + 1, len(self.candidates)):
                other = self.candidates[b]
                if other.effect.id != one.effect.id:
                    break
                differing = [name for name in one.shape if one.shape[name] != other.shape[name]]
                if len(differing) == 1:
                    name = differing[0]
                    places = [grids[name].index(each.shape[name]) for each in (one, other)]
                    if abs(places[0] - places[1]) == 1:
                        pairs.append((a, b))
        return tuple(pairs)

    @cached_property
    def shapes(self) -> dict[int, list[tuple[int, ...]]]:
        """Candidates and mixtures by their number of amplitudes."""
        found: dict[int, list[tuple[int, ...]]] = {}
        for chosen in (*((k,) for k in range(len(self.candidates))), *self.mixtures):
            found.setdefault(self.amplitudes_of(chosen).size, []).append(chosen)
        return found

    @cached_property
    def diagnosed_layout(self) -> Layout:
        """Columns of a diagnosed log: those of all candidates."""
        p, amplitudes = self.column_scale.size, int(self.offsets[-1])
        end = p + amplitudes
        states = end + np.arange(len(PER_LOG_STATES))
        return Layout(
            coefficients=np.arange(p),
            structure=p + self.amplitudes_of(self.structure),
            effects=p + np.arange(amplitudes),
            per_log=np.concatenate((p + self.amplitudes_of(self.per_log), states)),
            residual=end + len(PER_LOG_STATES),
        )

    @cached_property
    def reference_layout(self) -> Layout:
        """Columns of a reference: those of `reference_columns` only."""
        p = self.column_scale.size
        shared = p + self.amplitudes_of(self.structure).size
        end = shared + self.amplitudes_of(self.per_log).size + len(PER_LOG_STATES)
        return Layout(
            coefficients=np.arange(p),
            structure=np.arange(p, shared),
            effects=np.zeros(0, dtype=np.intp),
            per_log=np.arange(shared, end),
            residual=end,
        )

    @cached_property
    def reference_places(self) -> Indices:
        """Place of each column of a reference among those without duplicates.

        Structure may be a per-log effect as well.
        """
        p, columns = self.column_scale.size, self.reference_columns
        unique = tuple(dict.fromkeys(columns))
        first = p + np.concatenate(([0], np.cumsum(np.diff(self.offsets)[list(unique)])))
        place = {k: np.arange(first[at], first[at + 1]) for at, k in enumerate(unique)}
        states = first[-1] + np.arange(len(PER_LOG_STATES) + 1)  # and the residual
        parts = [np.arange(p), *(place[k] for k in columns), states]
        return np.concatenate(parts).astype(np.intp)

    @property
    def reference_columns(self) -> tuple[int, ...]:
        """Candidates with columns in the references: shared structure, then per-log effects."""
        return (*self.structure, *self.per_log)

    def shared_amplitudes(self, structure: Sequence[int]) -> Indices:
        """Return the places of a solution, and the residual's, with some of the structure only."""
        p, widths = self.column_scale.size, np.diff(self.offsets)[list(self.structure)]
        first = p + np.concatenate(([0], np.cumsum(widths)))
        at = [self.structure.index(k) for k in structure]
        parts = [np.arange(first[k], first[k + 1]) for k in at]
        return np.concatenate([np.arange(p), *parts, first[-1:]]).astype(np.intp)

    def amplitudes_of(self, chosen: Sequence[int]) -> Indices:
        """Return the amplitude indices of some candidates."""
        parts = [np.arange(self.offsets[k], self.offsets[k + 1]) for k in chosen]
        return np.concatenate([np.zeros(0, dtype=np.intp), *parts])

    def bounds_of(self, chosen: Sequence[int]) -> FloatArray:
        """Return the amplitude bounds of some candidates, shape (amplitudes, 2)."""
        return np.vstack([np.zeros((0, 2)), *(self.candidates[k].bounds for k in chosen)])


def _shape_grids(candidates: Sequence[Candidate], effect_id: str) -> dict[str, list[float]]:
    """Return the ascending grid of each shape parameter of an effect."""
    shapes = [candidate.shape for candidate in candidates if candidate.effect.id == effect_id]
    return {name: sorted({shape[name] for shape in shapes}) for name in shapes[0]}
