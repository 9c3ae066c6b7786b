"""A model and settings as constants of the C core: structures of `core/cangauge.h`.

Names, order and types are those of the header; `compiled` proves that sizes agree.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from cangauge.estimation.settings import EstimatorSettings
from cangauge.estimation.validity import temperature_mismatch
from cangauge.model.effects.base import CoreForm
from cangauge.model.extended import OnlineModel
from cangauge.model.model_file import Model
from cangauge.model.voltage_model import HermiteCurve, PublishedCurve, resistance_factor

DELAYS, LOW_PASSES, KNOTS, FUNCTIONS, EFFECTS = 64, 4, 201, 16, 32
OCV, LAGS, VALUES = 8, 2, 5
CURRENTS: Final = DELAYS + LOW_PASSES
LOADS: Final = CURRENTS + 2
"""Upper limits of a model, as in the header."""

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
METHODS: Final = ("ekf", "newton", "coulomb")
"""Methods, in the order of `cg_method`."""


_TYPES: Final = {"d": "f8", "i": "i4", "u": "u4"}
_SIZES: Final = {name: value for name, value in globals().items() if isinstance(value, int)}


def _structure(fields: str, **nested: np.dtype[Any]) -> np.dtype[Any]:
    """Return the type of a C structure from items `type:name[shape]`."""
    found: list[tuple[Any, ...]] = []
    for item in fields.split():
        kind, _, rest = item.partition(":")
        name, _, shape = rest.partition("[")
        of = nested[kind] if kind in nested else np.dtype(_TYPES[kind])
        numbers = [each for each in shape.rstrip("]").split(",") if each]
        found.append((name, of, tuple(_SIZES.get(each) or int(each) for each in numbers)))
    return np.dtype(found, align=True)


EFFECT: Final = _structure("i:kind d:value[VALUES] d:tau_s[LAGS]")
MODEL: Final = _structure(
    "d:ocv_v[OCV] d:epsilon d:slope_beyond[2] i:knots d:knot_pct[KNOTS] d:knot_v[KNOTS]"
    " d:knot_slope[KNOTS] d:t_ref_c d:temperature_limits_c[2] i:delays d:delay_s[DELAYS]"
    " i:low_passes d:low_pass_s[LOW_PASSES] i:has_arrhenius d:arrhenius_ohm[CURRENTS]"
    " d:arrhenius_mean d:usual_c d:load[LOADS] d:soc_range_pct[2] d:temperature_range_c[2]"
    " d:current_range_a[2] d:rate_hz d:capacity_ah d:charge_efficiency d:initial_offset_pct"
    " d:nominal_v d:level_std_v d:slow_std_v d:slow_time_s d:fast_std_v d:soc_std_pct"
    " d:cold_exponent d:residual_std_v d:block_s i:tested_blocks d:innovations_at_most"
    " d:strain_at_most i:functions i:function_knots d:function_pct[KNOTS]"
    " d:function_v[KNOTS,FUNCTIONS] d:function_slope[KNOTS,FUNCTIONS]"
    " d:function_load[LOADS,FUNCTIONS] i:effects effect:effect[EFFECTS] d:skew_s",
    effect=EFFECT,
)
SETTINGS: Final = _structure(
    "i:method d:initial_soc_pct d:initial_soc_std_pct d:valid_std_pct d:gap_s u:reasons"
    " d:full_voltage_v d:full_current_a d:full_hold_s d:full_soc_pct d:full_soc_std_pct"
    " d:rest_after_s d:rest_soc_std_pct"
)

Record = Any
"""A NumPy record of one of these types."""


def core_forms(model: OnlineModel) -> list[CoreForm] | None:
    """Return the model's effects as the core has them; None if it lacks one, or memory for one."""
    forms = [
        effect.core_form(values, model.model, model.extended.pack)
        for effect, values in model.extended.effects
    ]
    known = [form for form in forms if form is not None]
    voltage = model.model
    sizes = (
        (len(known), EFFECTS),
        (len(voltage.loads.delays_s), DELAYS),
        (len(voltage.loads.low_pass_s), LOW_PASSES),
        (model.functions.number, FUNCTIONS),
        (model.functions.soc_pct.size, KNOTS),
    )
    skews = sum(form.kind == "time_skew" for form in known)
    if len(known) < len(forms) or skews > 1 or any(number > most for number, most in sizes):
        return None
    return known


def model_constants(
    model: Model, online: OnlineModel, forms: list[CoreForm], tests: tuple[int, float, float]
) -> Record:
    """Return a `cg_model`.

    Parameters
    ----------
    model : Model
    online : OnlineModel
        Of this model.
    forms : list of CoreForm
        From `core_forms`.
    tests : tuple
        Number of blocks that are tested together, and the limits of innovations and strain.
    """
    voltage, noise, functions = online.model, online.noise, online.functions
    counting, arrhenius = online.extended.counting(0.0), online.model.loads.arrhenius
    record = np.zeros(1, MODEL)
    of = record[0]
    curve = voltage.curve
    if isinstance(curve, PublishedCurve):
        of["ocv_v"], of["epsilon"], of["slope_beyond"] = curve.ocv_v, curve.epsilon, curve.beyond
    elif isinstance(curve, HermiteCurve):
        of["knots"] = curve.soc_pct.size
        _fill(of, knot_pct=curve.soc_pct, knot_v=curve.value, knot_slope=curve.slope)
    if arrhenius is not None:
        of["has_arrhenius"] = 1
        of["arrhenius_mean"] = resistance_factor(arrhenius.mean_c)
        _fill(of, arrhenius_ohm=arrhenius.resistance_ohm)
    of["delays"], of["low_passes"] = len(voltage.loads.delays_s), len(voltage.loads.low_pass_s)
    _fill(
        of,
        delay_s=voltage.loads.delays_s,
        low_pass_s=voltage.loads.low_pass_s,
        load=voltage.load_coefficients,
        function_pct=functions.soc_pct,
        function_v=functions.value,
        function_slope=functions.slope,
        function_load=functions.load,
    )
    for name in (
        "usual_c",
        "temperature_limits_c",
        "nominal_v",
    ):
        of[name] = getattr(voltage, name)
    of["t_ref_c"], known = voltage.loads.t_ref_c, voltage.range
    of["soc_range_pct"], of["current_range_a"] = known.soc_pct, known.current_a
    of["temperature_range_c"] = known.temperature_c
    for name in (
        "level_std_v",
        "slow_std_v",
        "slow_time_s",
        "fast_std_v",
        "soc_std_pct",
        "cold_exponent",
        "residual_std_v",
        "block_s",
    ):
        of[name] = getattr(noise, name)
    of["rate_hz"], of["capacity_ah"] = model.rate_hz, online.capacity_ah
    of["charge_efficiency"] = counting.charge_efficiency
    of["initial_offset_pct"] = counting.initial_soc_pct
    of["tested_blocks"], of["innovations_at_most"], of["strain_at_most"] = tests
    of["functions"], of["function_knots"] = functions.number, functions.soc_pct.size
    of["effects"] = len(forms)
    for effect, form in zip(of["effect"], forms, strict=False):
        effect["kind"] = KINDS.index(form.kind)
        _fill(effect, value=form.values, tau_s=form.tau_s)
        if form.kind == "time_skew":
            of["skew_s"] = form.values[0]
    return of


def settings_constants(model: Model, settings: EstimatorSettings) -> Record:
    """Return a `cg_settings`."""
    full, rest, start = settings.full_charge, settings.long_rest, settings.initial_soc_pct
    of = np.zeros(1, SETTINGS)[0]
    of["method"] = METHODS.index(settings.method)
    of["initial_soc_pct"] = math.nan if start is None else start
    for name in ("initial_soc_std_pct", "valid_std_pct", "gap_s"):
        of[name] = getattr(settings, name)
    mismatch = temperature_mismatch(model.temperature_source, settings.temperature_source)
    of["reasons"] = int(mismatch)
    of["full_voltage_v"] = of["rest_after_s"] = math.nan
    if full is not None:
        for name in ("voltage_v", "current_a", "hold_s", "soc_pct", "soc_std_pct"):
            of[f"full_{name}"] = getattr(full, name)
    if rest is not None:
        of["rest_after_s"], of["rest_soc_std_pct"] = rest.after_s, rest.soc_std_pct
    return of


def _fill(record: Record, **values: Any) -> None:
    """Copy arrays into the beginning of a record's arrays."""
    for name, value in values.items():
        array = np.asarray(value, dtype=np.float64)
        record[name][tuple(slice(size) for size in array.shape)] = array
