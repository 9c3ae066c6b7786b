"""Voltages, resistances and noise that a battery can have; a wrong unit is refused."""

from __future__ import annotations

from typing import Final

from cangauge.errors import InputError
from cangauge.model.curve import HermiteCurve
from cangauge.model.effects.base import RESISTANCE_AT_LEAST
from cangauge.model.noise import Noise
from cangauge.model.voltage_model import VoltageModel

FULL_TO_EMPTY: Final = 3.0
"""Largest ratio of two voltages of one pack: lithium cells are used between 2.0 and 4.4 V, lead and
nickel cells over a narrower range."""


def check_physics(model: VoltageModel, capacity_ah: float, noise: Noise) -> None:
    """Raise InputError for voltages, resistances, kt or noise that no pack has.

    Parameters
    ----------
    model : VoltageModel
    capacity_ah : float
        [Ah].
    noise : Noise
    """
    has_knots = isinstance(model.curve, HermiteCurve)
    middle_v, loads = model.nominal_v, model.loads
    ends = model.pseudo_ocv([*model.range.soc_pct]).tolist()
    low, high = min(*ends, middle_v), max(*ends, middle_v)
    # Vehicles and stores stay below 1.5 kV.
    if not (low > 0.0 and high <= min(1e4, FULL_TO_EMPTY * low)):
        raise InputError(
            f"the pseudo-OCV of {low:.5g} … {high:.5g} V is not that of a battery",
            field="curve.voltage_v" if has_knots else "published.coefficients",
            cure="check its values and their unit (V), or create the file with `cangauge fit`",
        )
    if has_knots:
        ohm_field, first, kt_field = "loads.resistance_ohm.", 0, "loads.kt_v_per_k"
    else:
        ohm_field, first, kt_field = "published.coefficients.R", 1, "published.coefficients.kt"
    ohms = {f"{ohm_field}{k}": ohm for k, ohm in enumerate(loads.resistance_ohm, start=first)}
    noise_v = {
        f"noise.{name}": getattr(noise, name)
        for name in ("level_std_v", "slow_std_v", "fast_std_v")
    }
    for values, most, unit in (
        # With all of its voltage dropped at 1 C a pack could not be discharged in an hour at all:
        # 0.02 for a Leaf, 0.3 for a small cell in the cold.
        (ohms, middle_v / capacity_ah, "ohm"),
        # Relative to the voltage 0.002 as published for a Leaf, 0.0003 by the entropy of the cells.
        ({kt_field: loads.kt_v_per_k}, 0.01 * middle_v, "V/K"),
        (noise_v, middle_v, "V"),
    ):
        for field, value in values.items():
            if abs(value) > most:
                raise InputError(
                    f"must lie within ±{most:.3g} {unit} for a pack of {middle_v:.4g} V and"
                    f" {capacity_ah:.4g} Ah",
                    field=field,
                    value=value,
                    cure="check the value and its unit, or the capacity",
                )
    # A log of constant current leaves the sign open, and there the resistances cancel. Knots have
    # the spread of their resistances in the covariance, so that a wrong sign is within it.
    (low_a, high_a), lasting_ohm = model.range.current_a, sum(loads.resistance_ohm)
    if not has_knots and lasting_ohm * (high_a - low_a) > RESISTANCE_AT_LEAST * middle_v:
        raise InputError(
            "the sum of the resistances is positive, so that discharging would raise the voltage",
            field="published.coefficients",
            value=lasting_ohm,
            cure="positive current discharges, so resistances are negative",
        )
