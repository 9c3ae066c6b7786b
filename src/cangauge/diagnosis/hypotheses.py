"""What all evidence of one diagnosis shares: candidates, what is structure, what is a log's own.

A log's products (`evidence.Gram`) have a column for each of these; `Layout` says where.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.diagnosis.design_matrix import LEVELS
from cangauge.model.effects.library import Candidate


@dataclass(frozen=True, eq=False)
class Layout:
    """Where a log's columns are in its products (`Gram`), as indices."""

    coefficients: NDArray[np.intp]
    structure: NDArray[np.intp]
    effects: NDArray[np.intp]
    """Amplitudes of all candidates, those of structure and own among them; none of a reference."""
    own: NDArray[np.intp]
    """What is each log's own: amplitudes of `Frame.own`, then `columns.LEVELS`."""
    residual: int

    @property
    def shared(self) -> NDArray[np.intp]:
        """What all logs share, in the order of a solution."""
        return np.concatenate((self.coefficients, self.structure))


@dataclass(frozen=True, eq=False)
class Frame:
    """What all evidence of one diagnosis shares."""

    choices: tuple[Candidate, ...]
    prior_root: FloatArray | None
    """Square root of the coefficients' information, shape (p, p), in scaled columns."""
    scale: FloatArray
    """Scale of the baseline's columns, shape (p,)."""
    repairs: tuple[int, ...] = ()
    """Candidates that clean logs show too; all logs share their amplitudes."""
    own: tuple[int, ...] = ()
    """Candidates by which logs may differ without a cause: every effect, a little."""
    own_prior: FloatArray = field(default_factory=lambda: np.zeros(0))
    """How much so before references were seen, as standard deviations: of the amplitudes of `own`,
    then of `columns.LEVELS`."""
    centre: FloatArray | None = None
    """Where the information holds the coefficients, in scaled columns, shape (p,); 0 if None."""

    @cached_property
    def first(self) -> NDArray[np.intp]:
        """Index of each candidate's first amplitude, one more than candidates."""
        widths = [len(choice.amplitudes) for choice in self.choices]
        return np.concatenate(([0], np.cumsum(widths))).astype(np.intp)

    @cached_property
    def neighbours(self) -> tuple[tuple[int, int], ...]:
        """Pairs of candidates next to each other in one shape: what lies in between is a mixture.

        A time constant between two of the grid, or a spread of them, is none of the grid's.
        """
        found = []
        for a, one in enumerate(self.choices):
            values = _shape_values(self.choices, one.effect.id)
            for b in range(a + 1, len(self.choices)):
                other = self.choices[b]
                if other.effect.id != one.effect.id:
                    break
                differ = [name for name in one.shape if one.shape[name] != other.shape[name]]
                if len(differ) == 1:
                    grid = values[differ[0]]
                    places = grid.index(one.shape[differ[0]]), grid.index(other.shape[differ[0]])
                    if abs(places[0] - places[1]) == 1:
                        found.append((a, b))
        return tuple(found)

    @cached_property
    def diagnosed(self) -> Layout:
        """Where the columns of a log are that is diagnosed: those of all candidates."""
        p, amplitudes = self.scale.size, int(self.first[-1])
        end = p + amplitudes
        return Layout(
            coefficients=np.arange(p),
            structure=p + self.amplitudes_of(self.repairs),
            effects=p + np.arange(amplitudes),
            own=np.concatenate((p + self.amplitudes_of(self.own), end + np.arange(len(LEVELS)))),
            residual=end + len(LEVELS),
        )

    @cached_property
    def reference(self) -> Layout:
        """Where the columns of a reference are: those of `shown` alone."""
        p = self.scale.size
        shared = p + self.amplitudes_of(self.repairs).size
        end = shared + self.amplitudes_of(self.own).size + len(LEVELS)
        return Layout(
            coefficients=np.arange(p),
            structure=np.arange(p, shared),
            effects=np.zeros(0, dtype=np.intp),
            own=np.arange(shared, end),
            residual=end,
        )

    @property
    def shown(self) -> tuple[int, ...]:
        """Candidates whose columns are wanted of references too: repairs, then own."""
        return (*self.repairs, *self.own)

    def amplitudes_of(self, chosen: Sequence[int]) -> NDArray[np.intp]:
        """Return the indices of some candidates' amplitudes."""
        parts = [np.arange(self.first[k], self.first[k + 1]) for k in chosen]
        return np.concatenate([np.zeros(0, dtype=np.intp), *parts])

    def bounds_of(self, chosen: Sequence[int]) -> FloatArray:
        """Return the bounds of some candidates' amplitudes, shape (…, 2)."""
        return np.vstack([np.zeros((0, 2)), *(self.choices[k].bounds for k in chosen)])


def _shape_values(choices: Sequence[Candidate], effect_id: str) -> dict[str, list[float]]:
    """Return each shape's values on an effect's grid, ascending."""
    shapes = [choice.shape for choice in choices if choice.effect.id == effect_id]
    return {name: sorted({shape[name] for shape in shapes}) for name in shapes[0]}
