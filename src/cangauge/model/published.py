"""The published model: 2012 Nissan Leaf SV on a chassis dynamometer (Table 1 of the paper).

The shipped model file holds it. The paper states neither noise nor standard errors. The noise is
assumed: the published voltage error of 0.25 % (0.93 V mean, 1.16 V rms at 370 V), split evenly into
a fast, a slow and a lasting part. The fast part correlates over 3 s, and is averaged over 30 s.
"""

from __future__ import annotations

from cangauge._resources import shared_file
from cangauge.model.model_file import Model
from cangauge.model.voltage_model import VoltageModel

CAPACITY_AH = 51.5
"""Charge from 100 to 0 % [Ah]."""

# Figures of the paper, to compare results with.
VOLTAGE_MAE_PCT = 0.25
SOC_NEWTON_MAE_PCT = 2.5


def leaf_2012_model_file() -> Model:
    """Return the published model for `estimate` and `run`."""
    return Model.load(shared_file("replay", "leaf2012_published_model.json"))


def leaf_2012_model() -> VoltageModel:
    """Return the published voltage model; temperatures are those of the test room, 20–26 °C."""
    return leaf_2012_model_file().voltage_model()
