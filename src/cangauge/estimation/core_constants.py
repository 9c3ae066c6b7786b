"""Constants of a model and settings of an estimator as the C core takes them (`core/cangauge.h`).

Names and order are those of the structures `cg_model`, `cg_effect` and `cg_settings`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.effects.base import CoreForm
from cangauge.model.model_file import Model, effective_error_std_v
from cangauge.types import temperature_mismatch

Fields = dict[str, object]
"""Field of a C structure → number or list of numbers."""

KINDS: Final = (
    "no_effect", "current_sensor", "voltage_sensor", "time_skew", "temperature_lag",
    "core_temperature", "resistance_temperature", "resistance_soc", "resistance_asymmetry",
    "resistance_step", "charge_transfer", "rc", "hysteresis", "entropic", "inner_temperature",
    "ocv_shape", "weak_cell",
)  # fmt: skip
"""Kinds of effects, in the order of `cg_effect_kind`."""

METHODS: Final = ("ekf", "newton", "coulomb")
"""Methods, in the order of `cg_method`."""


@dataclass(frozen=True)
class CoreConstants:
    """What the core is started with."""

    model: Fields
    """All of `cg_model` but `function_v` and `effect`."""
    functions: list[tuple[float, ...]]
    """Functions of the curve's error [V], by knots."""
    effects: list[CoreForm]
    settings: Fields
    longest_s: float
    """Longest delay [s]."""


def core_constants(model: Model, settings: EstimatorSettings) -> CoreConstants | None:
    """Return the constants of an estimator; None if one of the effects has no form in C."""
    extended = model.extended_model()
    online = extended.online(settings.capacity_ah)
    forms = [
        effect.online(values, extended.model, extended.pack).core_form()
        for effect, values in extended.effects
    ]
    known = [form for form in forms if form is not None]
    # The core has memory for one.
    if len(known) < len(forms) or sum(form.kind == "time_skew" for form in known) > 1:
        return None
    counting = extended.counting(0.0)
    voltage, noise, curve = extended.model, model.noise, model.noise.curve
    fields: Fields = {
        "ocv_v": list(voltage.ocv_v),
        "epsilon": voltage.epsilon,
        "slope_beyond": list(voltage.slope_beyond),
        "kt_v_per_k": voltage.kt_v_per_k,
        "t_ref_c": voltage.t_ref_c,
        "soc_range_pct": list(voltage.soc_range_pct),
        "temperature_range_c": list(voltage.temperature_range_c),
        "current_range_a": list(voltage.current_range_a),
        "delays": len(voltage.delay_s),
        "delay_s": list(voltage.delay_s),
        "resistance_ohm": list(voltage.resistance_ohm),
        "rate_hz": model.rate_hz,
        "capacity_ah": online.capacity_ah,
        "charge_efficiency": counting.charge_efficiency,
        "initial_offset_pct": counting.initial_soc_pct,
        "steady_ohm": online.steady_ohm,
        "nominal_v": voltage.pseudo_ocv_at(50.0)[0],
        "fast_std_v": effective_error_std_v(noise, 1.0 / model.rate_hz),
        "slow_std_v": noise.slow_std_v,
        "slow_time_s": noise.slow_time_s,
        "lasting_std_v": noise.lasting_std_v,
        "lasting_time_s": noise.lasting_time_s,
        "lasting_soc_pct": noise.lasting_soc_pct,
        "mean_c": voltage.t_ref_c if curve is None else curve.temperature_c,
        "kt_std_v_per_k": 0.0 if curve is None else curve.kt_std_v_per_k,
        "resistance_std_per_k": 0.0 if curve is None else curve.resistance_std_per_k,
        "knots": 0 if curve is None else len(curve.soc_pct),
        "functions": 0 if curve is None else len(curve.functions_v),
        "knot_pct": [] if curve is None else list(curve.soc_pct),
        "effects": len(known),
        "skew_s": sum(form.values[0] for form in known if form.kind == "time_skew"),
        "memories": len(online.memory),
        "memory_ohm": [ohm for ohm, _ in online.memory],
        "memory_tau_s": [tau_s for _, tau_s in online.memory],
    }
    functions = [] if curve is None else list(zip(*curve.functions_v, strict=True))
    return CoreConstants(
        fields, functions, known, _settings_fields(model, settings), voltage.delay_s[-1]
    )


def _settings_fields(model: Model, settings: EstimatorSettings) -> Fields:
    full, rest, start = settings.full_charge, settings.long_rest, settings.initial_soc_pct
    return {
        "method": METHODS.index(settings.method),
        "initial_soc_pct": math.nan if start is None else start,
        "initial_soc_std_pct": settings.initial_soc_std_pct,
        "valid_std_pct": settings.valid_std_pct,
        "gap_s": settings.gap_s,
        "reasons": int(temperature_mismatch(model.temperature_source, settings.temperature_source)),
        "full_voltage_v": math.nan if full is None else full.voltage_v,
        "full_current_a": 0.0 if full is None else full.current_a,
        "full_hold_s": 0.0 if full is None else full.hold_s,
        "full_soc_pct": 0.0 if full is None else full.soc_pct,
        "full_soc_std_pct": 0.0 if full is None else full.soc_std_pct,
        "rest_after_s": math.nan if rest is None else rest.after_s,
        "rest_soc_std_pct": 0.0 if rest is None else rest.soc_std_pct,
    }


def effect_fields(form: CoreForm) -> Fields:
    """Return the fields of a `cg_effect`."""
    return {
        "kind": KINDS.index(form.kind),
        "lags": len(form.tau_s),
        "value": list(form.values),
        "tau_s": list(form.tau_s),
    }
