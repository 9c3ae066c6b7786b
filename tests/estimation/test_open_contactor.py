"""The voltage behind an open contactor, and on its way there, corrects nothing."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from cangauge import Sample
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.published import leaf_2012_model_file

OPENED_S, CLOSED_S, END_S = 100.0, 110.0, 180.0
BLOCK_S = 30.0


def voltage(time_s: float) -> float:
    if OPENED_S <= time_s < CLOSED_S:
        return 250.0 if time_s == OPENED_S else 3.0  # its filter capacitor discharges
    return 375.0


def soc_pct(estimator: Estimator, *, blanked: bool) -> list[float]:
    """Return the SoC over a stop; `blanked` withholds all voltages of its blocks."""
    found = []
    for second in range(int(END_S)):
        volts = voltage(float(second))
        if blanked and second // BLOCK_S == OPENED_S // BLOCK_S:
            volts = math.nan
        found.append(estimator.step(Sample(float(second), 0.0, volts, 23.0)).soc_pct)
    return found


@pytest.mark.parametrize("make", [Estimator, make_estimator])
def test_an_open_contactor_is_a_block_without_voltage(make: Callable[..., Estimator]) -> None:
    settings = EstimatorSettings(initial_soc_pct=60.0)
    opened = soc_pct(make(leaf_2012_model_file(), settings), blanked=False)
    absent = soc_pct(make(leaf_2012_model_file(), settings), blanked=True)
    assert opened == absent
