"""Thinning for drawing loses no peak, whatever the series."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cangauge.report.charts import envelope, every, extremes

VALUES = st.one_of(st.floats(-1e6, 1e6), st.just(float("nan")))
SERIES = arrays(np.float64, st.integers(0, 400), elements=VALUES)
SOME = arrays(np.float64, st.integers(1, 400), elements=VALUES)


@given(values=SERIES, at_most=st.integers(6, 60))
def test_extremes_are_kept_in_order_and_few(values: np.ndarray, at_most: int) -> None:
    rows = extremes(values, at_most)
    assert rows.size <= at_most
    assert np.all(np.diff(rows) > 0)
    known = values[np.isfinite(values)]
    drawn = values[rows]
    if known.size:
        assert np.nanmin(drawn) == known.min()
        assert np.nanmax(drawn) == known.max()
    assert np.isnan(values).any() == np.isnan(drawn).any()


@given(values=SOME, at_most=st.integers(6, 60))
def test_a_band_covers_all_that_it_stands_for(values: np.ndarray, at_most: int) -> None:
    rows, low, high = envelope(values - 1.0, values + 1.0, at_most)
    assert rows.size == low.size == high.size <= at_most
    ends = np.append(rows[1:], values.size)
    for first, end, bottom, top in zip(rows, ends, low, high, strict=True):
        inside = values[first:end][np.isfinite(values[first:end])]
        if inside.size:
            assert bottom <= inside.min() - 1.0
            assert top >= inside.max() + 1.0
        else:
            assert np.isnan(bottom)


@given(n=st.integers(0, 100_000), at_most=st.integers(1, 5000))
def test_a_cloud_is_thinned_evenly(n: int, at_most: int) -> None:
    assert len(range(n)[every(n, at_most)]) <= at_most


def test_a_lone_spike_in_a_long_series_is_drawn() -> None:
    values = np.zeros(90_000)
    values[54_321] = -7.0
    assert 54_321 in extremes(values)
