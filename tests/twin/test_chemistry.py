"""Chemistry tables: monotone voltage, entropy and spread in the range of real cells."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.errors import InputError
from cangauge.extras.validation.twin.pack import CHEMISTRIES, chemistry

PLATEAU_V = {"nmc": 3.745, "lmo": 3.835, "nca": 3.742, "lfp": 3.297}


@given(st.sampled_from(CHEMISTRIES), st.integers(0, 10**6))
def test_voltage_rises_with_soc_in_every_specimen(name: str, seed: int) -> None:
    cell = chemistry(name, np.random.default_rng(seed))
    assert np.all(np.diff(cell.ocv_table_v) > 0.0)
    # A specimen deviates by millivolts.
    assert cell.ocv(np.array([0.5]))[0] == pytest.approx(PLATEAU_V[name], abs=0.04)


@pytest.mark.parametrize("name", CHEMISTRIES)
def test_entropy_is_tenths_of_a_millivolt_per_kelvin(name: str) -> None:
    cell = chemistry(name, np.random.default_rng(1))
    entropy = cell.entropy(np.linspace(0.0, 1.0, 50))
    assert 1e-4 < np.max(np.abs(entropy)) < 6e-4


def test_voltage_falls_steeply_below_empty() -> None:
    cell = chemistry("nmc", np.random.default_rng(1))
    full, empty, below = cell.ocv(np.array([1.0, 0.0, -0.03]))
    assert full == pytest.approx(4.2, abs=0.03)
    assert empty - below > 0.4


def test_unknown_chemistry_is_refused() -> None:
    with pytest.raises(InputError, match=r"lmo.*lfp"):
        chemistry("lead", np.random.default_rng(1))
