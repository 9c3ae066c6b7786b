"""SoC from a voltage: Newton's method, kept inside a bracket.

The pseudo-OCV rises with SoC, so there is one root. Newton's step is taken where it stays inside
the bracket, else the bracket is halved; it cannot diverge, and says when the voltage lies outside
what the model can give between 0 and 100 %.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

TOLERANCE_PCT = 1e-9
"""The root is found when a step is smaller than this [% SoC]."""

STEPS_AT_MOST = 80
"""Halving alone needs 37 steps from 100 % down to the tolerance."""


class Curve(Protocol):
    """What can be inverted: a voltage model, or one extended by effects."""

    def pseudo_ocv_at(self, soc_pct: float) -> tuple[float, float]:
        """Return voltage [V] and its slope [V per %], positive, at one SoC [%]."""


class Inverse(NamedTuple):
    """A root of U(S) = U."""

    soc_pct: float
    """State of charge [%], within 0–100."""
    inside: bool
    """False if the voltage lies outside the model's range and SoC was clipped."""


def soc_from_ocv(model: Curve, ocv_v: float, guess_pct: float = 50.0) -> Inverse:
    """Return the SoC at which the pseudo-OCV at reference temperature equals a voltage.

    Parameters
    ----------
    model : VoltageModel or OnlineExtendedModel
    ocv_v : float
        Voltage [V] less the parts that do not depend on SoC (`VoltageModel.offset_at`).
    guess_pct : float
        Where to start [%]; the last SoC saves steps.
    """
    low, high = 0.0, 100.0
    if ocv_v <= model.pseudo_ocv_at(low)[0]:
        return Inverse(low, inside=ocv_v == model.pseudo_ocv_at(low)[0])
    if ocv_v >= model.pseudo_ocv_at(high)[0]:
        return Inverse(high, inside=ocv_v == model.pseudo_ocv_at(high)[0])
    soc = min(max(guess_pct, low), high)
    for _ in range(STEPS_AT_MOST):
        volts, slope = model.pseudo_ocv_at(soc)
        error = volts - ocv_v
        if error > 0.0:
            high = soc
        else:
            low = soc
        following = soc - error / slope
        if not low < following < high:
            following = 0.5 * (low + high)
        if abs(following - soc) < TOLERANCE_PCT:
            return Inverse(following, inside=True)
        soc = following
    return Inverse(soc, inside=True)
