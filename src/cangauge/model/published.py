"""The published model: 2012 Nissan Leaf SV on a chassis dynamometer (Table 1 of the paper)."""

from __future__ import annotations

import math

from cangauge.model.model_file import FunctionFields, Made, Model, Published, Ranges
from cangauge.model.noise import Noise
from cangauge.model.prior import BLOCK_S
from cangauge.model.voltage_model import (
    KNOTS_PCT,
    LEAF_2012_OCV_V,
    PublishedCurve,
    VoltageModel,
)

CAPACITY_AH = 51.5
"""Charge from 100 to 0 % [Ah]."""

MEAN_VOLTAGE_V = 370.0
"""Approximate mean pack voltage over the test [V]."""

FAST_TIME_S = 3.0
"""Assumed correlation time of the fast error [s]."""

# Figures of the paper, to compare results with.
VOLTAGE_MAE_PCT = 0.25
SOC_NEWTON_MAE_PCT = 2.5


def leaf_2012_model() -> VoltageModel:
    """Return the published voltage model; temperatures are those of the test room, 20–26 °C."""
    return VoltageModel(
        PublishedCurve(LEAF_2012_OCV_V),
        kt_v_per_k=-0.7428,
        resistance_ohm=(-0.1032, -0.01501, -0.009697, -0.004652),
        temperature_range_c=(20.0, 26.0),
        current_range_a=(-50.0, 200.0),
    )


def leaf_2012_model_file() -> Model:
    """Return the published model for `estimate` and `run`.

    The paper states neither noise nor standard errors. The noise is assumed: the published voltage
    error of 0.25 % (0.93 V mean, 1.16 V rms), split evenly into a fast, a slow and a lasting part.
    """
    model = leaf_2012_model()
    rmse_v = VOLTAGE_MAE_PCT / 100.0 * MEAN_VOLTAGE_V * math.sqrt(math.pi / 2.0)
    part_v = rmse_v / math.sqrt(3.0)
    block_share = math.sqrt((1.0 + 2.0 * FAST_TIME_S) / BLOCK_S)  # as many independent values
    curve = model.curve
    if not isinstance(curve, PublishedCurve):
        raise TypeError("the published model has the published curve")
    return Model(
        name="2012 Nissan Leaf, published coefficients",
        equation="published",
        chemistry="oxide",
        capacity_ah=CAPACITY_AH,
        temperature_source="room",
        published=Published.of(
            [*curve.ocv_v, model.kt_v_per_k, *model.resistance_ohm],
            epsilon=curve.epsilon,
            t_ref_c=model.t_ref_c,
            delays_s=model.delay_s,
        ),
        functions=FunctionFields(soc_pct=KNOTS_PCT.tolist(), curve_v=[], load=[]),
        noise=Noise(
            level_std_v=part_v,
            slow_std_v=part_v,
            fast_std_v=block_share * part_v,
            soc_std_pct=0.0,
            cold_exponent=0.0,
            residual_std_v=rmse_v,
            voltage_mae_pct=VOLTAGE_MAE_PCT,
            voltage_rmse_v=rmse_v,
            judged_on="published; split into parts by assumption",
        ),
        range=Ranges(
            soc_pct=model.soc_range_pct,
            temperature_c=model.temperature_range_c,
            current_a=model.current_range_a,
        ),
        made=Made(by="published Table 1", options={}, logs=[], fingerprint="published"),
    )
