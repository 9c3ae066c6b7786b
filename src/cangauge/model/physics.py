"""Voltages, resistances and noise that a battery can have; a wrong unit is refused."""

from __future__ import annotations

from cangauge.errors import InputError
from cangauge.model.curve import HermiteCurve
from cangauge.model.effects.base import RESISTANCE_AT_LEAST
from cangauge.model.noise import Noise
from cangauge.model.voltage_model import VoltageModel


def check_physics(model: VoltageModel, capacity_ah: float, noise: Noise) -> None:
    """Raise InputError for voltages, resistances, kt or noise that no pack has.

    Parameters
    ----------
    model : VoltageModel
    capacity_ah : float
        [Ah].
    noise : Noise
    """
    knots = isinstance(model.curve, HermiteCurve)
    prefix = "loads" if knots else "published.coefficients"
    middle = model.nominal_v
    ends = model.pseudo_ocv([*model.range.soc_pct]).tolist()
    low, high = min(*ends, middle), max(*ends, middle)
    # Lithium cells are used between 2.0 and 4.4 V, lead and nickel cells over a narrower range;
    # vehicles and stores stay below 1.5 kV.
    if not (low > 0.0 and high <= min(1e4, 3.0 * low)):
        raise InputError(
            f"the pseudo-OCV of {low:.5g} … {high:.5g} V is not that of a battery",
            field="curve.voltage_v" if knots else prefix,
            cure="check its values and their unit (V), or create the file with `cangauge fit`",
        )
    # With all of its voltage dropped at 1 C a pack could not be discharged in an hour at all: 0.02
    # for a Leaf, 0.3 for a small cell in the cold.
    loads, most_ohm = model.loads, middle / capacity_ah
    limits = [
        (
            f"{prefix}.resistance_ohm.{k}" if knots else f"{prefix}.R{k + 1}",
            ohm,
            most_ohm,
            "ohm",
        )
        for k, ohm in enumerate(loads.resistance_ohm)
    ]
    kt = f"{prefix}.{'kt_v_per_k' if knots else 'kt'}"
    # Relative to the voltage 0.002 as published for a Leaf, 0.0003 by the entropy of the cells.
    limits.append((kt, loads.kt_v_per_k, 0.01 * middle, "V/K"))
    noises = ("level_std_v", "slow_std_v", "fast_std_v")
    limits += [(f"noise.{name}", getattr(noise, name), middle, "V") for name in noises]
    for field, value, most, unit in limits:
        if abs(value) > most:
            raise InputError(
                f"must lie within ±{most:.3g} {unit} for a pack of {middle:.4g} V and"
                f" {capacity_ah:.4g} Ah",
                field=field,
                value=value,
                cure="check the value and its unit, or the capacity",
            )
    # A log of constant current leaves the sign open, and there the resistances cancel. Knots have
    # the spread of their resistances in the covariance, so that a wrong sign is within it.
    (low_a, high_a), lasting_ohm = model.range.current_a, sum(loads.resistance_ohm)
    if not knots and lasting_ohm * (high_a - low_a) > RESISTANCE_AT_LEAST * middle:
        raise InputError(
            "the sum of the resistances is positive, so that discharging would raise the voltage",
            field=prefix,
            value=lasting_ohm,
            cure="positive current discharges, so resistances are negative",
        )
