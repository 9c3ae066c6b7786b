"""Where the error of a log lies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cangauge.diagnosis.where import Errors, closed_part, excesses


def errors_v(rows: int, wrong: int) -> Errors:
    """Return a log of one row a second whose last `wrong` rows alone are off."""
    time_s = np.arange(float(rows))
    before_v = np.where(time_s >= rows - wrong, 1.0, 0.0)
    soc_pct = np.linspace(90.0, 30.0, rows)
    current_a = np.full(rows, 20.0)
    log = np.zeros(rows, dtype=np.intp)
    return Errors(log, time_s, current_a, np.full(rows, 20.0), soc_pct, before_v, before_v)


@pytest.mark.parametrize("wrong", [0, 200, 3600])
@pytest.mark.filterwarnings("error")
def test_a_log_without_error_in_most_pieces_has_finite_intervals(wrong: int) -> None:
    found = excesses(errors_v(3600, wrong), 60.0)
    assert bool(found) is (wrong > 0)
    for place in found:
        assert np.all(np.isfinite([place["excess"], *place["ci"]]))


@pytest.mark.filterwarnings("error")
def test_a_drawn_piece_without_rows_costs_the_closed_part_nothing() -> None:
    """Of two stretches an hour apart, most pieces between hold no row."""
    whole = errors_v(3900, 300)
    halved = replace(whole, after_v=0.5 * whole.before_v)
    apart = halved.rows((whole.time_s < 300.0) | (whole.time_s >= 3600.0))
    closed, _ = closed_part(apart, 0.1)
    assert closed is not None
    assert 0.7 < closed < 1.0
