"""Error maps, worst segments, and the caveat of each poor log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cangauge.diagnosis.caveats import (
    extended_soc_caveat,
    extension_caveat,
    log_caveats,
    reference_fit_caveat,
    temperature_step_caveat,
)
from cangauge.diagnosis.design_matrix import DesignMatrix
from cangauge.diagnosis.error_breakdown import (
    MAX_OTHER_BINS,
    MAX_SOC_BINS,
    MIN_BIN_ROWS,
    SEGMENTS,
    LogErrors,
    error_map,
    error_shares,
    even_edges,
    segment_signals,
    worst_segments,
)
from cangauge.inference.rows import FitOptions, SampledLog, sample_log
from cangauge.logs.log import Log
from cangauge.model.published import CAPACITY_AH, leaf_2012_model
from synthetic import synthetic_log

OPTIONS = FitOptions(
    capacity_ah=CAPACITY_AH, rate_hz=1.0, delay_s=leaf_2012_model().delay_s, epsilon=1e-3
)


def sampled(log: Log) -> SampledLog:
    return sample_log(log, OPTIONS)


def matrix(log: Log) -> DesignMatrix:
    item = sampled(log)
    none = np.zeros((len(item.rows), 0))
    return DesignMatrix(item, np.zeros(len(item.rows)), none, none, ())


def long_log(**changes: object) -> Log:
    log = synthetic_log(hours=1.0, start_pct=80.0, end_pct=50.0)
    return replace(log, temperature_c=15.0 + log.time_s / 200.0, **changes)


# --- maps ---


def test_a_map_has_each_error_in_its_bin() -> None:
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
    soc = np.concatenate([np.full(200, 52.0), np.full(MIN_BIN_ROWS - 1, 82.0)])
    found = error_map(soc, np.full(soc.size, 23.0), np.ones(soc.size))
    assert np.isfinite(found.rms_v).sum() == 1
    assert found.rms_v[0, np.searchsorted(found.soc_edges_pct, 52.0, side="right") - 1] == 1.0
    assert found.rows.sum() == soc.size


def test_a_few_pulses_share_the_outer_bins() -> None:
    current = np.concatenate([np.linspace(-20.0, 40.0, 9_990), np.full(10, 400.0)])
    found = error_map(np.full(10_000, 60.0), current, np.ones(10_000), tails=True)
    assert found.tails
    assert found.edges[-1] < 50.0
    assert found.rows.sum() == 10_000


@pytest.mark.parametrize("at_most", [MAX_SOC_BINS, MAX_OTHER_BINS])
@pytest.mark.parametrize(("low", "high"), [(23.0, 23.0), (-400.0, 399.0), (97.2, 99.1), (0, 1e4)])
def test_edges_are_even_and_include_all(low: float, high: float, at_most: int) -> None:
    edges = even_edges(np.array([low, high]), at_most)
    assert 2 <= edges.size <= at_most + 1
    assert edges[0] <= low <= high < edges[-1]
    assert np.ptp(np.diff(edges)) < 1e-9 * edges[-1]


# --- worst segments ---


def test_worst_segments_are_a_minute_apart() -> None:
    logs = [matrix(long_log(name=name)) for name in ("one", "two", "three")]
    spikes = [[(500, -9.0), (510, -8.0), (900, 5.0)], [(700, 8.5)], [(k, 6.0) for k in (100, 300)]]
    errors = []
    for item, put in zip(logs, spikes, strict=True):
        error = 0.01 * np.sin(np.arange(len(item.sampled.rows)))
        for at, volts in put:
            error[at] = volts
        errors.append(error)
    found = worst_segments(logs, errors)
    assert len(found) == SEGMENTS
    # 510 is within a minute of 500.
    assert [(m.log, m.residual_v) for m in found[:5]] == [
        ("one", -9.0), ("two", 8.5), ("three", 6.0), ("three", 6.0), ("one", 5.0),
    ]  # fmt: skip
    assert found[0].time_s == logs[0].sampled.rows.time_s[500]
    for name in ("one", "two", "three"):
        times = sorted(m.time_s for m in found if m.log == name)
        assert np.all(np.diff(times) >= 60.0)
    assert "number" not in found[0].to_dict()


def test_a_segment_is_a_minute_either_side_in_its_log() -> None:
    logs = [matrix(long_log(name=name)) for name in ("one", "two")]
    rows = [len(item.sampled.rows) for item in logs]
    errors = [np.zeros(rows[0]), np.zeros(rows[1])]
    errors[1][400] = 7.0
    both = [LogErrors(item.sampled, e, 0.1 * e) for item, e in zip(logs, errors, strict=True)]
    segment = worst_segments(logs, errors, 1)[0]
    seen = segment_signals(segment, both)
    assert segment.log == "two"
    assert (seen.time_s.min(), seen.time_s.max()) == (-60.0, 60.0)
    assert seen.before_v[seen.time_s == 0.0] == 7.0
    assert seen.after_v[seen.time_s == 0.0] == pytest.approx(0.7)
    log = logs[1].sampled.log
    assert np.array_equal(
        seen.current_a, log.current_a[np.abs(log.time_s - segment.time_s) <= 60.0]
    )


# --- caveats ---


def caveats(log: Log, references: int = 3) -> str:
    known = [sampled(long_log(name=f"reference {k}")) for k in range(references)]
    return " ".join(log_caveats([sampled(log)], known, CAPACITY_AH))


def test_a_good_log_has_no_caveat() -> None:
    log = long_log()
    rested = replace(log, current_a=np.where(log.time_s % 100.0 < 5.0, 0.0, log.current_a))
    assert caveats(rested) == ""


def test_a_short_and_narrow_log_has_caveats() -> None:
    short = synthetic_log(hours=0.15, start_pct=70.0, end_pct=68.0, name="stub")
    short = replace(short, temperature_c=np.full(len(short), 23.0))
    words = caveats(short)
    assert "Shorter than 10 min: stub (9.0 min)" in words
    assert "Narrow temperature range (23.0 … 23.0 °C)" in words
    assert "resistance_temperature" in words
    assert "Narrow SoC range" in words


@pytest.mark.parametrize(
    ("log", "references", "sentence"),
    [
        (long_log(), 0, "No reference logs"),
        (long_log(), 2, "Only 2 reference logs"),
        (replace(long_log(), temperature_c=long_log().temperature_c - 15.0), 3,
         "Temperatures of 0.3 … 18.0 °C, references 15.3 … 33.0 °C"),
        (replace(long_log(), soc_pct=long_log().soc_pct - 20.0), 3, "SoC of 30 … 60 %, references"),
        (replace(long_log(), current_a=np.maximum(long_log().current_a, 2.0)), 3,
         "The pack is never charged"),
    ],
)  # fmt: skip
def test_each_limitation_has_its_caveat(log: Log, references: int, sentence: str) -> None:
    assert sentence in caveats(log, references)


def test_another_temperature_source_is_a_caveat() -> None:
    log, known = [sampled(long_log())], [sampled(long_log())] * 3
    assert log_caveats(log, known, CAPACITY_AH, "room") == log_caveats(log, known, CAPACITY_AH)
    words = " ".join(log_caveats(log, known, CAPACITY_AH, "pack"))
    assert "measured on pack, that of these logs on room" in words


def test_time_counts_from_the_start_of_the_log() -> None:
    item = matrix(long_log())
    spans = [p for p in error_shares([item], [np.ones(len(item.sampled.rows))], CAPACITY_AH)
             if p.axis == "time"]  # fmt: skip
    assert spans[-1].high == pytest.approx(item.sampled.log.duration_s, abs=2.0)


def test_coarse_temperature_steps_are_a_caveat() -> None:
    words = temperature_step_caveat(0.5, 0.74, floor_v=0.3)
    assert "steps of 0.5 K" in words
    assert "740 mV/K that is an error of up to 0.18 V" in words  # half a step, 0.25 K
    assert temperature_step_caveat(0.5, -0.74, floor_v=0.3) != ""
    assert temperature_step_caveat(0.5, 0.05, floor_v=0.3) == ""
    assert temperature_step_caveat(0.0, 0.74, floor_v=0.3) == ""


def test_a_poor_fit_of_references_is_a_caveat() -> None:
    fine = [("a", 0.5), ("b", 0.6), ("c", 0.55)]
    assert reference_fit_caveat(fine, 0.4, 360.0) == ""
    assert reference_fit_caveat([], 0.4, 360.0) == ""
    odd = reference_fit_caveat([("other", 41.8), *fine], 0.4, 360.0)
    assert "the reference other: 41.8 V RMS (12 % of the voltage), the others 0.55 V" in odd
    all_off = reference_fit_caveat([("same", 2.9), ("same", 2.7)], 0.44, 360.0)
    assert "2.80 V RMS; the model file states 0.44 V" in all_off


def test_a_worse_extended_model_is_a_caveat() -> None:
    assert extension_caveat(2.05, 0.5) == ""
    assert "2.90 V, the given one 2.05 V. Do not use it" in extension_caveat(2.05, 2.90)


@pytest.mark.parametrize(
    ("given_pct", "extended_pct", "stated_pct", "warned"),
    [(1.0, 2.4, 1.1, True), (2.4, 1.0, 0.5, False), (0.7, 0.8, 1.0, False)],
)
def test_an_extended_model_with_a_worse_soc_is_not_silent(
    given_pct: float, extended_pct: float, stated_pct: float, warned: bool
) -> None:
    caveat = extended_soc_caveat(given_pct, extended_pct, stated_pct)
    assert ("farther" in caveat) is warned
