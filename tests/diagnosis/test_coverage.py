"""Coverage: temperatures and SoC that the references cover."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cangauge.diagnosis.references import BEYOND_WEIGHT, soc_weight, temperatures_covered
from cangauge.model.effects.base import Pack
from cangauge.model.effects.library import LIBRARY, candidates


def log(low_c: float, high_c: float) -> Any:
    return SimpleNamespace(rows=SimpleNamespace(temperature_c=np.linspace(low_c, high_c, 50)))


@pytest.mark.parametrize(
    ("references_c", "log_c", "covered"),
    [
        ((20.0, 24.0), (18.0, 22.0), True),
        ((20.0, 24.0), (8.0, 14.0), False),  # many kelvin below few
        ((0.0, 30.0), (34.0, 36.0), True),  # few above many
        ((0.0, 30.0), (-6.0, -4.0), True),  # few below many
        ((0.0, 30.0), (-20.0, -14.0), False),
        ((16.0, 32.0), (36.0, 39.0), True),
        ((16.0, 32.0), (9.0, 12.0), False),  # as far below: resistance rises in the cold
        ((16.0, 32.0), (5.0, 27.0), True),  # most rows inside
    ],
)
def test_references_cover_a_little_more_than_their_temperatures(
    references_c: tuple[float, float], log_c: tuple[float, float], covered: bool
) -> None:
    middle = sum(references_c) / 2.0
    references = [log(references_c[0], middle), log(middle, references_c[1])]
    assert temperatures_covered(references, [log(*log_c)]) is covered


def at_soc(*soc_pct: float) -> Any:
    return SimpleNamespace(rows=SimpleNamespace(soc_pct=np.array(soc_pct)))


def test_rows_outside_the_references_soc_count_less() -> None:
    references = [at_soc(40.0, 50.0), at_soc(70.0, 60.0)]
    log = at_soc(20.0, 36.0, 38.0, 55.0, 72.0, 74.0, 92.0)
    weight = soc_weight(log, references, (30.0, 90.0))
    assert weight.tolist() == [0.0, BEYOND_WEIGHT, 1.0, 1.0, 1.0, BEYOND_WEIGHT, 0.0]
    assert np.all(soc_weight(at_soc(10.0, 90.0), [], (30.0, 80.0)) == 1.0)


def test_only_a_diagnosis_tries_spread_diffusion() -> None:
    pack = Pack(voltage_v=360.0, capacity_ah=60.0, resistance_ohm=0.1, cells=96)
    tried = [
        {
            choice.shape["spread"]
            for choice in candidates(
                [LIBRARY["slow_diffusion"]], pack, np.arange(10.0), for_diagnosis=for_diagnosis
            )
        }
        for for_diagnosis in (False, True)
    ]
    assert tried == [{0.0}, {0.0, 1.0}]
