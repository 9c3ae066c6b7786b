"""The published model: 2012 Nissan Leaf SV on a chassis dynamometer (Table 1 of the paper)."""

from __future__ import annotations

from cangauge.model.voltage_model import VoltageModel

CAPACITY_AH = 51.5
"""Charge from 100 to 0 % [Ah]."""

VOLTAGE_MAE_PCT = 0.25
SOC_NEWTON_MAE_PCT = 2.5
SLOPE_OHM = 0.110
DRIVEN_KWH = 21.3
REGENERATED_KWH = 3.2
NET_KWH = 18.1
HEAT_KWH = 0.41
EFFICIENCY_PCT = 98.0


def leaf_2012_model() -> VoltageModel:
    """Return the published voltage model; its temperature was the test room's, 20–26 °C."""
    return VoltageModel(
        ocv_v=(394.4, 48.89, -4.769, 0.2158, -0.003718, -54.59, 109.3, -3.141),
        kt_v_per_k=-0.7428,
        resistance_ohm=(-0.1032, -0.01501, -0.009697, -0.004652),
        delay_s=(0.0, 10.0, 30.0, 70.0),
        epsilon=0.05,
        t_ref_c=20.0,
        soc_range_pct=(0.0, 100.0),
        temperature_range_c=(20.0, 26.0),
        current_range_a=(-50.0, 200.0),
    )
