"""Health of the pack: capacity and resistance, learned beside the state of charge.

Both are constants that the filter's equations contain as known: b = (g, r), with g the reference
capacity over the true one less 1, and r the relative deviation of the resistances. Friedland's
separated form of the augmented filter estimates them from the filter's own innovations y without
changing its state: with V = ∂x/∂b, G = ∂(S counted)/∂b and D = ∂U/∂b,

    V ← F V + G                                   prediction
    T = H V + D,   V ← V − K T                    update of the state with gain K, variance S
    b ← b + Kb (y − T b),   Kb = Pb Tᵀ/(S + T Pb Tᵀ),   Pb ← Pb − Kb T Pb

The optimal estimate of the augmented problem is x + V b with covariance P + V Pb Vᵀ. Health is read
from it. The published SoC is x, which counts with the stated capacity; its variance contains the
mean square of that error, (V b)² + V Pb Vᵀ. The form is linear: from a reference capacity that is
10 % wrong, the capacity of a recorded cell is learned to 1.6 %.

References
----------
Friedland, Treatment of bias in recursive filtering, IEEE Trans. Automatic Control 14 (1969) 359.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.types import Health

if TYPE_CHECKING:
    from cangauge.estimation.ekf import SocFilter

CAPACITY_STD: Final = 0.1
"""Prior relative standard deviation of the capacity: a pack in service holds 80 % (the usual end
of life in a car, IEC 62660) to somewhat above 100 % of its rated charge."""

RESISTANCE_STD: Final = 0.3
"""Prior relative standard deviation of the resistance: it doubles over a life and with cold, and
the model may come from another season."""

G, R = range(2)
"""Index of capacity and resistance."""

PRIOR: Final = np.diag([CAPACITY_STD**2, RESISTANCE_STD**2])
WALK_PER_S: Final = np.diag([1e-3**2, 0.02**2]) / 86400.0
"""Random walk of both, relative, of 0.1 % and 2 % in a day [1/s]: cells lose 2 % of capacity in a
year; the temperature inside a pack differs from the measured one by another amount each day."""


class FriedlandBias:
    """Capacity and resistance of one filter: the second stage of Friedland's two-stage filter.

    Parameters
    ----------
    n : int
        Number of the filter's states.

    Attributes
    ----------
    b : array of shape (2,)
        g and r.
    P : array of shape (2, 2)
        Their covariance.
    V : array of shape (n, 2)
        Sensitivity of the filter's state to them.
    """

    def __init__(self, n: int) -> None:
        self.b = np.zeros(2)
        self.P = PRIOR.copy()
        self.V = np.zeros((n, 2))

    def predict(self, F: FloatArray, discharged_pct: float, seconds: float) -> None:
        """Propagate the sensitivity over counted charge [% of capacity]."""
        self.V = F @ self.V
        self.V[0, G] -= discharged_pct
        self.P = self.P + WALK_PER_S * seconds

    def update(self, H: FloatArray, K: FloatArray, y: float, S: float, drop_v: float) -> None:
        """Learn from an innovation y of variance S, after an update with gain K.

        Parameters
        ----------
        H, K : array of shape (n,)
        y, S : float
            [V] and [V²], or [%] and [%²] for a SoC.
        drop_v : float
            Part of the prediction that is proportional to the resistances [V].
        """
        T = H @ self.V
        T[R] += drop_v
        self.V = self.V - np.outer(K, T)
        PTt = self.P @ T
        Kb = PTt / (S + T @ PTt)
        self.b = self.b + Kb * (y - T @ self.b)
        P = self.P - np.outer(Kb, PTt)
        self.P = 0.5 * (P + P.T)

    @property
    def soc_error_pct2(self) -> float:
        """Mean square error of the SoC by them, (V b)² + V P Vᵀ [%²]."""
        v = self.V[0]
        return float((v @ self.b) ** 2 + v @ self.P @ v)

    def take_over(self, before: FriedlandBias, ratio: float) -> None:
        """Keep the capacity learned with another reference capacity, `ratio` times as large."""
        self.b[G] = (1.0 + before.b[G]) * ratio - 1.0
        self.P[G, G] = before.P[G, G] * ratio**2


def health_of(filter_: SocFilter, temperature_c: float) -> Health:
    """Return capacity, resistance and offset as a filter and its biases know them.

    The resistance is that to a lasting current, functions and bias included, over the model's.
    """
    model, bias = filter_.model, filter_.bias
    x, P = filter_.joint()
    count = len(model.model.loads.resistance_ohm)
    rest = model.load_at(temperature_c, np.zeros(count))
    lasting = model.load_at(temperature_c, np.ones(count))
    functions = model.functions.row(50.0, lasting) - model.functions.row(50.0, rest)
    row = np.zeros_like(x)  # of the ratio
    row[-2 - functions.size : -2] = functions / ((lasting - rest) @ model.load_coefficients)
    row[-1] = 1.0
    gain = 1.0 + float(bias.b[G])
    capacity_ah = model.capacity_ah / gain
    return Health(
        capacity_ah,
        capacity_ah / gain * math.sqrt(bias.P[G, G]),
        1.0 + float(row @ x),
        math.sqrt(max(float(row @ P @ row), 0.0)),
        float(x[1]) / gain,  # the filter's o is g times the sensor's
        math.sqrt(P[1, 1]) / gain,
    )
