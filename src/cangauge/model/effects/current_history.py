"""What a log's current leaves behind: delayed and lagged currents, each worked out once.

Many effects and shapes ask for the same ones, which are most of the work on a long log. What
follows the temperature or the count of charge may change meanwhile; the current's history stays.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cangauge.model.charge import BRIDGE_S, discharged_ah
from cangauge.model.delay_line import delayed_currents
from cangauge.model.effects.first_order import low_passed

FloatArray = NDArray[np.float64]

MOST_LAGS = 64
"""No more are kept: all shapes of all effects ask for some fifty."""


@dataclass(frozen=True, eq=False)
class CurrentHistory:
    """A current over a whole log, n samples, positive = discharge. No array is to be written to."""

    time_s: FloatArray
    current_a: FloatArray
    _lagged_a: dict[float, FloatArray] = field(default_factory=dict, init=False, repr=False)
    _lagged_a2: dict[float, FloatArray] = field(default_factory=dict, init=False, repr=False)
    _delayed_a: dict[tuple[float, ...], FloatArray] = field(
        default_factory=dict, init=False, repr=False
    )

    def lagged_a(self, tau_s: float) -> FloatArray:
        """Return the current behind a first-order lag [A], shape (n,), at rest before the log."""
        if tau_s not in self._lagged_a:
            while len(self._lagged_a) >= MOST_LAGS:  # a fit asks for ever new ones
                del self._lagged_a[next(iter(self._lagged_a))]
            self._lagged_a[tau_s] = low_passed(
                self.time_s, self.current_a, tau_s, 0.0, rest_s=BRIDGE_S
            )
        return self._lagged_a[tau_s]

    def lagged_a2(self, tau_s: float) -> FloatArray:
        """Return the square of the current behind such a lag [A²], shape (n,)."""
        if tau_s not in self._lagged_a2:
            self._lagged_a2[tau_s] = low_passed(
                self.time_s, self.current_a**2, tau_s, 0.0, rest_s=BRIDGE_S
            )
        return self._lagged_a2[tau_s]

    def delayed_a(self, delay_s: tuple[float, ...]) -> FloatArray:
        """Return I(t − dj) [A], shape (n, len(delay_s))."""
        if delay_s not in self._delayed_a:
            self._delayed_a[delay_s] = delayed_currents(
                self.time_s, self.current_a, delay_s, self.time_s
            )
        return self._delayed_a[delay_s]

    @cached_property
    def out_ah(self) -> FloatArray:
        """Charge taken out since the first sample [Ah], shape (n,)."""
        return discharged_ah(self.time_s, self.current_a)


def history_of(
    time_s: FloatArray, current_a: FloatArray, remembered: CurrentHistory | None
) -> CurrentHistory:
    """Return what is remembered, if it is of these very arrays, or a new history."""
    if remembered is not None and remembered.current_a is current_a and remembered.time_s is time_s:
        return remembered
    return CurrentHistory(time_s, current_a)
