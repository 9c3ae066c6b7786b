"""A model and settings as constants of the C core: fields of structures in `core/cangauge.h`.

Their names and units are those of the header. The compiled core takes them by name, and an export
writes them as initialisers.
"""

from __future__ import annotations

import math
from typing import Any, Final, get_args

from cangauge.estimation.estimator import Estimator
from cangauge.model.curve import HermiteCurve, PublishedCurve
from cangauge.model.effects.base import CoreForm
from cangauge.model.extended import OnlineModel
from cangauge.settings import Method

KINDS: Final = (
    "no_effect",
    "current_sensor",
    "voltage_sensor",
    "time_skew",
    "temperature_sensor",
    "temperature_lag",
    "core_temperature",
    "resistance_growth",
    "resistance_temperature",
    "resistance_soc",
    "resistance_asymmetry",
    "resistance_step",
    "charge_transfer",
    "rc",
    "hysteresis",
    "entropic",
    "weak_cell",
)
"""Kinds of effects, in the order of `cg_effect_kind`."""
NOISE: Final = (
    "level_std_v",
    "slow_std_v",
    "slow_time_s",
    "fast_std_v",
    "soc_std_pct",
    "cold_exponent",
    "residual_std_v",
    "block_s",
)
"""Fields of `Noise` that the core has by the same name."""

Constants = dict[str, Any]
"""Name → number, or array-like of one or two dimensions."""


def core_forms(online: OnlineModel) -> list[CoreForm]:
    """Return the model's effects as the core has them, in their order.

    Raises
    ------
    ValueError
        If the core lacks one, or has no memory for it.
    """
    forms = [
        effect.core_form(values, online.model, online.extended.pack)
        for effect, values in online.extended.effects
    ]
    known = [form for form in forms if form is not None]
    if len(known) < len(forms) or sum(form.kind == "time_skew" for form in known) > 1:
        raise ValueError("the core has no form of an effect, or the model has time_skew twice")
    return known


def model_constants(estimator: Estimator, forms: list[CoreForm]) -> Constants:
    """Return the fields of a `cg_model`, but for the effects themselves.

    Parameters
    ----------
    estimator : Estimator
        Of the model.
    forms : list of CoreForm
        From `core_forms`.
    """
    online = estimator.online
    voltage, noise, functions = online.model, online.noise, online.functions
    loads, known, counting = voltage.loads, voltage.range, online.extended.counting(0.0)
    constants = {
        "temperature_limits_c": voltage.temperature_limits_c,
        "usual_c": voltage.usual_c,
        "nominal_v": voltage.nominal_v,
        "t_ref_c": loads.t_ref_c,
        "delays": len(loads.delays_s),
        "delay_s": loads.delays_s,
        "low_passes": len(loads.low_pass_s),
        "low_pass_s": loads.low_pass_s,
        "load": voltage.load_coefficients,
        "soc_range_pct": known.soc_pct,
        "temperature_range_c": known.temperature_c,
        "current_range_a": known.current_a,
        "rate_hz": estimator.model.rate_hz,
        "capacity_ah": estimator.capacity_ah,
        "charge_efficiency": counting.charge_efficiency,
        "initial_offset_pct": counting.initial_soc_pct,
        **{name: getattr(noise, name) for name in NOISE},
        **estimator.limits._asdict(),
        "functions": functions.number,
        "function_knots": len(functions.soc_pct),
        "function_pct": functions.soc_pct,
        "function_v": functions.value,
        "function_slope": functions.slope,
        "function_load": functions.load_parts(voltage.load_coefficients.size),
        "effects": len(forms),
        "skew_s": sum(form.values[0] for form in forms if form.kind == "time_skew"),
    }
    curve, arrhenius = voltage.curve, loads.arrhenius
    if isinstance(curve, PublishedCurve):
        constants |= {
            "ocv_v": curve.ocv_v,
            "epsilon": curve.epsilon,
            "slope_beyond": curve.beyond,
        }
    elif isinstance(curve, HermiteCurve):
        constants |= {
            "knots": curve.soc_pct.size,
            "knot_pct": curve.soc_pct,
            "knot_v": curve.value,
            "knot_slope": curve.slope,
        }
    if arrhenius is not None:
        constants |= {
            "has_arrhenius": 1,
            "arrhenius_ohm": arrhenius.resistance_ohm,
            "arrhenius_mean": arrhenius.warm,
        }
    return constants


def settings_constants(estimator: Estimator) -> Constants:
    """Return the fields of a `cg_settings`."""
    settings, start = estimator.settings, estimator.settings.initial_soc_pct
    constants = {
        "method": get_args(Method).index(settings.method),  # as `cg_method`
        "initial_soc_pct": math.nan if start is None else start,
        "initial_soc_std_pct": settings.initial_soc_std_pct,
        "valid_std_pct": settings.valid_std_pct,
        "gap_s": settings.gap_s,
        "reasons": int(estimator.always),
        "full_voltage_v": math.nan,
        "rest_after_s": math.nan,
    }
    for rule, values in (("full", settings.full_charge), ("rest", settings.long_rest)):
        if values is not None:
            constants |= {f"{rule}_{name}": value for name, value in vars(values).items()}
    return constants
