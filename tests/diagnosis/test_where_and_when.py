"""Maps, worst moments and limits: right bins, right rows, the right sentence for poor logs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cangauge.diagnosis.caveats import limits, stepped_temperature
from cangauge.diagnosis.cross_validation import LogErrors
from cangauge.diagnosis.design_matrix import DesignMatrix
from cangauge.diagnosis.error_breakdown import (
    LEAST_ROWS,
    MOMENTS,
    OTHER_BINS,
    SOC_BINS,
    around,
    error_map,
    even_edges,
    places,
    worst_moments,
)
from cangauge.inference.rows import FitOptions, SampledLog, sample_log
from cangauge.logs.log import Log
from cangauge.model.published import CAPACITY_AH, leaf_2012_model
from synthetic import synthetic_log

OPTIONS = FitOptions(
    capacity_ah=CAPACITY_AH, rate_hz=1.0, delay_s=leaf_2012_model().delay_s, epsilon=1e-3
)


def prepared(log: Log) -> SampledLog:
    return sample_log(log, OPTIONS)


def terms(log: Log) -> DesignMatrix:
    item = prepared(log)
    none = np.zeros((len(item.rows), 0))
    return DesignMatrix(item, np.zeros(len(item.rows)), none, none, ())


def long_log(**changes: object) -> Log:
    log = synthetic_log(hours=1.0, start_pct=80.0, end_pct=50.0)
    return replace(log, temperature_c=15.0 + log.time_s / 200.0, **changes)


# --- maps -------------------------------------------------------------------------------------


def test_a_map_holds_each_error_in_its_own_bin() -> None:
    rng = np.random.default_rng(1)
    soc, current = rng.uniform(0.0, 100.0, 20_000), rng.uniform(-50.0, 50.0, 20_000)
    faulty = (soc >= 40.0) & (soc < 45.0) & (current >= 10.0) & (current < 20.0)
    found = error_map(soc, current, np.where(faulty, -3.0, 0.5))
    assert found.rms_v.shape == (found.edges.size - 1, found.soc_edges_pct.size - 1)
    up, across = (
        np.searchsorted(found.edges, 15.0) - 1,
        np.searchsorted(found.soc_edges_pct, 42) - 1,
    )
    assert found.rms_v[up, across] == pytest.approx(3.0)
    assert found.mean_v[up, across] == pytest.approx(-3.0)
    assert found.rows[up, across] == faulty.sum()
    others = np.delete(found.rms_v.ravel(), up * found.rms_v.shape[1] + across)
    assert others == pytest.approx(0.5)
    assert found.rows.sum() == soc.size


def test_bins_with_few_rows_are_empty() -> None:
    soc = np.concatenate([np.full(200, 52.0), np.full(LEAST_ROWS - 1, 82.0)])
    found = error_map(soc, np.full(soc.size, 23.0), np.ones(soc.size))
    assert np.isfinite(found.rms_v).sum() == 1
    assert found.rms_v[0, np.searchsorted(found.soc_edges_pct, 52.0, side="right") - 1] == 1.0
    assert found.rows.sum() == soc.size


def test_a_few_pulses_take_no_bins_of_their_own_but_are_in_the_map() -> None:
    current = np.concatenate([np.linspace(-20.0, 40.0, 9_990), np.full(10, 400.0)])
    found = error_map(np.full(10_000, 60.0), current, np.ones(10_000), tails=True)
    assert found.tails
    assert found.edges[-1] < 50.0
    assert found.rows.sum() == 10_000


@pytest.mark.parametrize("at_most", [SOC_BINS, OTHER_BINS])
@pytest.mark.parametrize(("low", "high"), [(23.0, 23.0), (-400.0, 399.0), (97.2, 99.1), (0, 1e4)])
def test_edges_are_even_few_and_hold_all(low: float, high: float, at_most: int) -> None:
    edges = even_edges(np.array([low, high]), at_most)
    assert 2 <= edges.size <= at_most + 1
    assert edges[0] <= low <= high < edges[-1]
    assert np.ptp(np.diff(edges)) < 1e-9 * edges[-1]


# --- moments ----------------------------------------------------------------------------------


def test_ten_moments_of_all_logs_a_minute_apart() -> None:
    logs = [terms(long_log(name=name)) for name in ("one", "two", "three")]
    spikes = [[(500, -9.0), (510, -8.0), (900, 5.0)], [(700, 8.5)], [(k, 6.0) for k in (100, 300)]]
    errors = []
    for item, put in zip(logs, spikes, strict=True):
        error = 0.01 * np.sin(np.arange(len(item.prepared.rows)))
        for at, volts in put:
            error[at] = volts
        errors.append(error)
    found = worst_moments(logs, errors)
    assert len(found) == MOMENTS
    # 510 is within a minute of 500; the later logs' moments come in by their size.
    assert [(m.log, m.residual_v) for m in found[:5]] == [
        ("one", -9.0), ("two", 8.5), ("three", 6.0), ("three", 6.0), ("one", 5.0),
    ]  # fmt: skip
    assert found[0].time_s == logs[0].prepared.rows.time_s[500]
    for name in ("one", "two", "three"):
        times = sorted(m.time_s for m in found if m.log == name)
        assert np.all(np.diff(times) >= 60.0)
    assert "number" not in found[0].to_dict()


def test_around_a_moment_is_a_minute_before_and_after_of_its_own_log() -> None:
    logs = [terms(long_log(name=name)) for name in ("one", "two")]
    rows = [len(item.prepared.rows) for item in logs]
    errors = [np.zeros(rows[0]), np.zeros(rows[1])]
    errors[1][400] = 7.0
    both = [LogErrors(item.prepared, e, 0.1 * e) for item, e in zip(logs, errors, strict=True)]
    moment = worst_moments(logs, errors, 1)[0]
    seen = around(moment, both)
    assert moment.log == "two"
    assert (seen.time_s.min(), seen.time_s.max()) == (-60.0, 60.0)
    assert seen.before_v[seen.time_s == 0.0] == 7.0
    assert seen.after_v[seen.time_s == 0.0] == pytest.approx(0.7)
    log = logs[1].prepared.log
    assert np.array_equal(seen.current_a, log.current_a[np.abs(log.time_s - moment.time_s) <= 60.0])


# --- limits -----------------------------------------------------------------------------------


def said(log: Log, references: int = 3, initial_soc_pct: float | None = None) -> str:
    known = [prepared(long_log(name=f"reference {k}")) for k in range(references)]
    return " ".join(limits([prepared(log)], known, CAPACITY_AH, initial_soc_pct))


def test_nothing_is_said_of_a_log_that_shows_enough() -> None:
    log = long_log()
    rested = replace(log, current_a=np.where(log.time_s % 100.0 < 5.0, 0.0, log.current_a))
    assert said(rested) == ""


def test_a_short_log_of_one_temperature_and_little_soc_is_called_so() -> None:
    short = synthetic_log(hours=0.15, start_pct=70.0, end_pct=68.0, name="stub")
    short = replace(short, temperature_c=np.full(len(short), 23.0))
    words = said(short)
    assert "Shorter than 10 min: stub (9.0 min)" in words
    assert "One temperature (23.0 … 23.0 °C)" in words
    assert "resistance_temperature" in words
    assert "A narrow range of SoC" in words


@pytest.mark.parametrize(
    ("log", "references", "sentence"),
    [
        (long_log(soc_pct=None), 3, "No SoC at the start"),
        (long_log(), 0, "No reference logs"),
        (long_log(), 2, "Only 2 reference logs"),
        (replace(long_log(), temperature_c=long_log().temperature_c - 15.0), 3,
         "Temperatures of 0.3 … 18.0 °C where the references have 15.3 … 33.0 °C"),
        (replace(long_log(), soc_pct=long_log().soc_pct - 20.0), 3, "SoC of 30 … 60 % where"),
        (replace(long_log(), current_a=np.maximum(long_log().current_a, 2.0)), 3,
         "The pack is never charged"),
    ],
)  # fmt: skip
def test_each_limit_has_its_sentence(log: Log, references: int, sentence: str) -> None:
    assert sentence in said(log, references)


def test_a_reference_without_a_soc_is_told() -> None:
    known = [prepared(long_log()), prepared(long_log(soc_pct=None, name="silent"))]
    words = " ".join(limits([prepared(long_log())], known, CAPACITY_AH))
    assert "No SoC at the start of the reference silent: 100 % was assumed" in words


def test_a_temperature_of_another_place_is_told() -> None:
    log, known = [prepared(long_log())], [prepared(long_log())] * 3
    assert limits(log, known, CAPACITY_AH, None, "room") == limits(log, known, CAPACITY_AH)
    words = " ".join(limits(log, known, CAPACITY_AH, None, "pack"))
    assert "measured on pack, that of these logs on room" in words


def test_time_is_that_since_the_logs_start() -> None:
    item = terms(long_log())
    spans = [p for p in places([item], [np.ones(len(item.prepared.rows))], CAPACITY_AH)
             if p.axis == "time"]  # fmt: skip
    assert spans[-1].high == pytest.approx(item.prepared.log.duration_s, abs=2.0)


def test_a_given_start_is_a_start() -> None:
    assert "No SoC at the start" not in said(long_log(soc_pct=None), initial_soc_pct=80.0)


def test_steps_of_the_temperature_are_told_where_they_hide_as_much_as_the_floor() -> None:
    words = stepped_temperature(0.5, 0.74, floor_v=0.3)
    assert "steps of 0.5 K" in words
    assert "740 mV/K: up to 0.18 V" in words  # half a step, 0.25 K
    assert stepped_temperature(0.5, -0.74, floor_v=0.3) != ""
    assert stepped_temperature(0.5, 0.05, floor_v=0.3) == ""
    assert stepped_temperature(0.0, 0.74, floor_v=0.3) == ""
