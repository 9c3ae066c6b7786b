"""Reduction for drawing loses no peak, whatever the series."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cangauge.extras.report.charts import extremes

VALUES = st.one_of(st.floats(-1e6, 1e6), st.just(float("nan")))
SERIES = arrays(np.float64, st.integers(0, 400), elements=VALUES)


@given(values=SERIES, max_points=st.integers(6, 60))
def test_extremes_are_kept_in_order_and_few(values: np.ndarray, max_points: int) -> None:
    rows = extremes(values, max_points)
    assert rows.size <= max_points
    assert np.all(np.diff(rows) > 0)
    known = values[np.isfinite(values)]
    drawn = values[rows]
    if known.size:
        assert np.nanmin(drawn) == known.min()
        assert np.nanmax(drawn) == known.max()
    assert np.isnan(values).any() == np.isnan(drawn).any()


def test_a_single_spike_in_a_long_series_is_drawn() -> None:
    values = np.zeros(90_000)
    values[54_321] = -7.0
    assert 54_321 in extremes(values)
