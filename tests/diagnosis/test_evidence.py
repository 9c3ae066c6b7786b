"""Evidence of effects: integrals, invariances, and equality with simulated logs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from days import FAULTS, day, late, more_amperes, more_volts, wrong_start
from scipy.integrate import quad
from scipy.stats import norm

from cangauge.diagnosis import References
from cangauge.diagnosis.evidence import (
    WIDTHS,
    analyse,
    bounded_evidence,
    columns,
    held_out_sizes,
    learn,
)
from cangauge.diagnosis.pack_fit import Trace, lagged, trace, turned
from cangauge.diagnosis.trials import Trial, library, residual, slope
from cangauge.logs.log import Log
from selection import nightly_except
from synthetic import synthetic_log

CAPACITY_AH = 51.5


@pytest.mark.parametrize(
    ("g", "s", "low", "high"),
    nightly_except(
        [(40.0, 25.0, -1.0, 1.0), (-6.0, 4.0, 0.0, 1.0)],
        [
            (3.0, 9.0, -1.0, 1.0),
            (40.0, 25.0, -1.0, 1.0),
            (-6.0, 4.0, 0.0, 1.0),
            (0.0, 1e4, -0.3, 1.0),
        ],
    ),
)
def test_evidence_within_bounds_is_the_integral(
    g: float, s: float, low: float, high: float
) -> None:
    def mean_likelihood(width: float) -> float:
        prior = norm(0.0, 0.5 * width)
        mass = prior.cdf(high) - prior.cdf(low)

        def density(a: float) -> float:
            return float(np.exp(g * a - 0.5 * s * a * a) * prior.pdf(a)) / mass

        inner = [x for x in np.linspace(-5, 5, 41) * 0.5 * width if low < x < high]
        return float(quad(density, low, high, points=inner or None, limit=400)[0])

    expected = np.log(np.mean([mean_likelihood(float(width)) for width in WIDTHS]))
    found = bounded_evidence(*(np.array([x]) for x in (g, s, low, high)))
    assert found[0] == pytest.approx(expected, abs=1e-6)


def test_a_second_of_a_fast_log_is_its_mean() -> None:
    time_s = np.arange(0.0, 600.0, 0.1)
    amperes = 10.0 + time_s % 1.0
    log = Log(time_s, amperes, 380.0 + 0.0 * time_s, 20.0 + 0.0 * time_s, 80.0 + 0.0 * time_s)
    at_1_hz = trace(log, CAPACITY_AH)
    assert len(at_1_hz.current_a) == 600
    assert at_1_hz.current_a == pytest.approx(10.45)
    assert at_1_hz.start_pct == 80.0


def test_a_gap_is_a_rest_that_is_not_measured() -> None:
    log = day(3)
    kept = (log.time_s < 600.0) | (log.time_s > 1200.0)
    gap = trace(log.rows(kept), CAPACITY_AH)
    assert np.all(gap.current_a[605:1195] == 0.0)
    assert not gap.measured[605:1195].any()
    assert len(gap.current_a) == len(trace(log, CAPACITY_AH).current_a)


def test_hysteresis_in_closed_form_is_the_recursion() -> None:
    amperes = np.random.default_rng(0).normal(0.0, 40.0, 5000)
    state, steps = 0.0, []
    for i in amperes:
        toward = -np.sign(i)
        state = toward + (state - toward) * np.exp(-abs(i) / 700.0)
        steps.append(state)
    assert turned(amperes, 700.0) == pytest.approx(steps, abs=1e-9)


def test_a_lag_settles_at_its_input() -> None:
    assert lagged(np.ones(2000), 100.0)[-1] == pytest.approx(1.0, abs=1e-6)


@pytest.fixture(scope="module")
def ten() -> Trace:
    return trace(day(10), CAPACITY_AH)


def _trials(known: References) -> list[Trial]:
    return [item for item in library(known.pack) if item.changes_signal]


def test_a_tangent_is_the_change_of_the_residual(known: References, ten: Trace) -> None:
    for item in _trials(known):
        if item.effect == "time_skew" and item.shape is not None:
            continue  # a secant
        step = 0.02 * (item.high - item.low)
        expected = residual(known.pack, ten) - residual(known.pack, ten, item, step)
        assert slope(known.pack, ten, item) * step == pytest.approx(expected, abs=1e-9), item.effect


def test_what_is_injected_is_undone(known: References, ten: Trace) -> None:
    offset = next(item for item in _trials(known) if item.effect == "current_offset")
    more = replace(ten, current_a=ten.current_a + 2.0)
    assert residual(known.pack, more, offset, 2.0) == pytest.approx(residual(known.pack, ten))


def test_evidence_does_not_depend_on_the_order_of_logs(known: References) -> None:
    logs = [columns(known, trace(more_volts(day(seed), 3.0), CAPACITY_AH)) for seed in (20, 21)]
    one, other = analyse(known, logs), analyse(known, logs[::-1])
    for name, item in one.effects.items():
        if name != "resistance_step":  # it lasts from a moment on
            assert other.effects[name].nats == pytest.approx(item.nats, rel=1e-6, abs=1e-9)


def test_evidence_does_not_depend_on_the_unit_of_the_voltage() -> None:
    def nats(factor: float) -> dict[str, float]:
        def scaled(log: Log) -> Trace:
            return trace(replace(log, voltage_v=factor * log.voltage_v), CAPACITY_AH)

        known = learn([scaled(day(seed)) for seed in (11, 12, 13)], CAPACITY_AH)
        found = analyse(known, [columns(known, scaled(more_volts(day(20), 3.0)))])
        return {name: item.nats for name, item in found.effects.items()}

    pack, cell = nats(1.0), nats(0.01)
    for name, value in pack.items():
        assert cell[name] == pytest.approx(value, rel=1e-3, abs=1e-4), name


def test_references_have_no_evidence_beyond_chance(known: References) -> None:
    assert all(excess >= 1.0 for excess in known.excess.values())
    assert len(known.left_out) == 3
    assert known.healthy_rmse_v == pytest.approx(0.5, rel=0.25)


@pytest.mark.parametrize(
    ("effect", "sign"),
    [("current_offset", 1), ("voltage_offset", 1), ("time_skew", 1), ("initial_soc", -1)],
)
def test_a_size_is_found_within_its_interval(known: References, effect: str, sign: int) -> None:
    fault, size = FAULTS[effect]
    found = analyse(known, [columns(known, trace(fault(day(20), size), CAPACITY_AH))])
    item = found.effects[effect]
    assert item.size == pytest.approx(sign * size, abs=2.0 * np.hypot(item.std, 0.05 * size))


@pytest.mark.parametrize("seconds", nightly_except((-0.3,), (0.3, -0.3)))
def test_a_skew_below_a_row_is_found_in_a_fast_log(seconds: float) -> None:
    def fast(seed: int) -> Log:
        return synthetic_log(hours=0.8, rate_hz=10.0, start_pct=85.0, end_pct=60.0, seed=seed,
                             noise_v=0.5)  # fmt: skip

    known = learn([trace(fast(seed), CAPACITY_AH) for seed in (11, 12, 13)], CAPACITY_AH)
    found = analyse(known, [columns(known, trace(late(fast(20), seconds), CAPACITY_AH))])
    best = max(found.effects, key=lambda name: found.effects[name].nats)
    assert best == "time_skew"
    assert found.effects[best].size == pytest.approx(seconds, abs=0.1)


def test_noise_of_the_voltage_is_no_evidence_of_a_gain(known: References) -> None:
    assert known.excess["voltage_gain"] < 2.0


def test_held_out_sizes_are_near_the_size_of_all(known: References) -> None:
    for logs in ([20], [20, 21]):
        of_logs = [columns(known, trace(more_amperes(day(s), 6.0), CAPACITY_AH)) for s in logs]
        item = analyse(known, of_logs).effects["current_offset"]
        sizes = held_out_sizes(known, of_logs, item)
        assert [len(each) for each in sizes] == [len(each.rows) for each in of_logs]
        assert np.concatenate(sizes) == pytest.approx(item.size, rel=0.35)


def test_a_start_beyond_a_bend_of_the_curve_is_found() -> None:
    """Its tangent shows no evidence: the assumed SoC lies beyond the bend at 30 %."""

    def drive(seed: int, start_pct: float, end_pct: float) -> Log:
        return synthetic_log(
            hours=0.8, start_pct=start_pct, end_pct=end_pct, noise_v=0.5, seed=seed
        )

    references = [drive(11, 45.0, 20.0), drive(12, 45.0, 20.0), drive(13, 90.0, 50.0)]
    references.append(drive(14, 50.0, 5.0))
    known = learn([trace(log, CAPACITY_AH) for log in references], CAPACITY_AH)
    log = wrong_start(drive(20, 45.0, 20.0), 10.0)
    evidence = analyse(known, [columns(known, trace(log, CAPACITY_AH))])
    found = evidence.effects["initial_soc"]
    assert found.size == pytest.approx(-10.0, abs=2.0 * found.std)
    assert found.left_v2 < 0.2 * evidence.gap_v2
