"""Where the error of a log lies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cangauge.diagnosis.where import Errors, closed_part, excesses, where_sentence


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
    is_kept = (whole.time_s < 300.0) | (whole.time_s >= 3600.0)
    halved = replace(whole, after_v=0.5 * whole.before_v, log=is_kept.astype(np.intp))
    _, apart = halved.by_log
    closed, _ = closed_part(apart, 0.1)
    assert closed is not None
    assert 0.7 < closed < 1.0


@pytest.mark.parametrize(
    ("where", "words"),
    [
        ("low SoC", "Below 25 % SoC"),
        ("cold", "Below 15 °C"),
        ("charging", "While charging at 1 to 20 A"),
        ("after a rest", "In the first 10 min after a rest"),
        ("nowhere", "The error is alike everywhere"),
    ],
)
def test_where_the_error_is_larger_is_said_in_words(where: str, words: str) -> None:
    """Eight times an hour of driving and 15 min of rest, over all SoC."""
    time_s = np.arange(0.0, 8 * 4500.0)
    in_turn = time_s % 4500.0
    driving = in_turn < 3600.0
    rng = np.random.default_rng(1)
    charging = rng.uniform(size=8 * 15).repeat(300) < 0.3
    current_a = np.where(driving, np.where(charging, -20.0, 40.0), 0.0)
    soc_pct = 58.0 + 38.0 * np.cos(time_s / 2900.0)
    celsius = np.where(rng.uniform(size=8 * 15).repeat(300) < 0.3, 12.0, 22.0)
    wrong = {
        "low SoC": soc_pct < 25.0,
        "cold": celsius < 15.0,
        "charging": current_a < 0.0,
        "after a rest": (in_turn < 600.0) & (time_s > 4500.0),
        "nowhere": np.zeros(time_s.size, dtype=bool),
    }[where]
    before_v = np.where(wrong, 4.0, 1.0) * rng.normal(size=time_s.size)
    log = np.zeros(time_s.size, dtype=np.intp)
    errors = Errors(log, time_s, current_a, celsius, soc_pct, before_v, before_v)
    assert where_sentence(excesses(errors, 60.0)).startswith(words)
