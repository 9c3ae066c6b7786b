"""Debouncing, ranges, rates and time-outs of one signal."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.bus.plausibility import SignalChecks, SignalHealth
from cangauge.types import Reason

NAN = math.nan


def passed(health: SignalHealth, values: list[float], step_s: float = 0.1) -> list[float]:
    return [health.update(value, step_s * number) for number, value in enumerate(values)]


def same(left: list[float], right: list[float]) -> bool:
    return all(
        a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(left, right, strict=True)
    )


def test_the_first_good_value_is_used_after_any_failures() -> None:
    health = SignalHealth(SignalChecks())
    assert same(passed(health, [NAN] * 20 + [1.0]), [NAN] * 20 + [1.0])
    assert not health.is_invalid


def test_a_few_failures_cost_only_their_own_values() -> None:
    health = SignalHealth(SignalChecks(invalid_after=5))
    values = [1.0, NAN, NAN, NAN, NAN, 2.0, 3.0]
    assert same(passed(health, values), values)
    assert not health.is_invalid


def test_recovery_needs_consecutive_good_values() -> None:
    health = SignalHealth(SignalChecks(invalid_after=3, valid_after=2))
    values = [1.0, NAN, NAN, NAN, 2.0, NAN, 3.0, 4.0, 5.0]
    assert same(passed(health, values), [1.0, *[NAN] * 6, 4.0, 5.0])
    assert not health.is_failing


def test_an_invalid_signal_is_not_usable_and_has_a_cause() -> None:
    health = SignalHealth(SignalChecks(invalid_after=2))
    health.update(1.0, 0.0)
    health.fail(Reason.PROTECTION_FAILED)
    assert health.is_usable(0.1)
    health.fail(Reason.PROTECTION_FAILED)
    assert not health.is_usable(0.1)
    assert (health.is_failing, health.reason) == (True, Reason.PROTECTION_FAILED)


def test_repeated_frames_do_not_prevent_recovery() -> None:
    health = SignalHealth(SignalChecks(invalid_after=2, valid_after=3))
    health.update(1.0, 0.0)
    health.fail(Reason.PROTECTION_FAILED)
    health.fail(Reason.PROTECTION_FAILED)
    used = []
    for number in range(3):
        used.append(health.update(2.0, 0.1 * number))
        health.fail(Reason.PROTECTION_FAILED, is_repeated=True)
    assert same(used, [NAN, NAN, 2.0])


@given(
    st.lists(st.booleans(), max_size=60),
    st.integers(1, 6),
    st.integers(1, 6),
)
def test_debouncing_agrees_with_a_model_over_the_past(
    good: list[bool], invalid_after: int, valid_after: int
) -> None:
    checks = SignalChecks(invalid_after=invalid_after, valid_after=valid_after)
    used = passed(SignalHealth(checks), [float(n) if ok else NAN for n, ok in enumerate(good)])
    trusted, known = True, False
    runs = [(ok, len(list(group))) for ok, group in itertools.groupby(good)]
    expected: list[bool] = []
    for ok, length in runs:
        if ok:
            held = 0 if trusted else min(valid_after - 1, length)
            expected += [False] * held + [True] * (length - held)
            trusted = trusted or length >= valid_after
            known = True
        else:
            expected += [False] * length
            trusted = trusted and not (known and length >= invalid_after)
    assert [not math.isnan(value) for value in used] == expected


def test_values_out_of_range_are_refused() -> None:
    health = SignalHealth(SignalChecks(lowest=-1.0, highest=5.0))
    values = [-1.0, 5.0, 5.1, -1.1, math.inf, 0.0]
    assert same(passed(health, values), [-1.0, 5.0, NAN, NAN, NAN, 0.0])


def test_a_spike_is_refused_and_a_lasting_step_accepted() -> None:
    checks = SignalChecks(max_jump=5.0, max_rate_per_s=1.0)
    health = SignalHealth(checks)
    assert same(passed(health, [20.0, 60.0, 20.5, 21.0]), [20.0, NAN, 20.5, 21.0])
    health = SignalHealth(checks)
    used = passed(health, [20.0, *[28.0] * 40])
    # 28 is possible 3 s after the latest good value; then three are needed.
    assert next(n for n, value in enumerate(used) if value == 28.0) == 30 + 2


def test_the_rate_limit_widens_with_time() -> None:
    health = SignalHealth(SignalChecks(max_jump=5.0, max_rate_per_s=1.0))
    assert health.update(20.0, 0.0) == 20.0
    assert math.isnan(health.update(40.0, 14.9))
    assert health.update(40.0, 15.1) == 40.0


def test_a_stated_time_out_is_exact() -> None:
    health = SignalHealth(SignalChecks(timeout_s=0.2), 0.1)
    health.update(1.0, 10.0)
    assert health.is_usable(10.2)
    assert not health.is_usable(10.21)
    health.update(1.0, 50.0)  # old is not invalid: the next good value is used
    assert health.is_usable(50.0)


@pytest.mark.parametrize(
    ("period_s", "timeout_s"),
    [(0.01, 0.5), (0.1, 1.0), (0.5, 2.0), (1.0, 3.0), (10.0, 30.0)],
)
def test_the_time_out_follows_the_period(period_s: float, timeout_s: float) -> None:
    checks = SignalChecks(usual_timeout_s=2.0)
    assert SignalHealth(checks, period_s).timeout_s == pytest.approx(timeout_s)
    learned = SignalHealth(checks)
    assert learned.timeout_s == 2.0
    passed(learned, [1.0] * 9, period_s)
    assert learned.timeout_s == pytest.approx(timeout_s)


def test_a_signal_sent_on_change_keeps_its_usual_time_out() -> None:
    health = SignalHealth(SignalChecks(usual_timeout_s=10.0), is_cyclic=False)
    passed(health, [1.0] * 50, 0.1)
    assert health.timeout_s == 10.0
    passed(health, [1.0] * 50, 20.0)
    assert health.timeout_s > 30.0


def test_pauses_and_losses_do_not_distort_the_period() -> None:
    health = SignalHealth(SignalChecks(usual_timeout_s=2.0))
    now_s = 0.0
    for number in range(200):
        now_s += 3600.0 if number == 150 else 0.01 * (1 + number % 2)  # half of them lost
        health.update(1.0, now_s)
    assert health.period_s == pytest.approx(0.015, rel=0.2)


def test_a_step_back_in_time_does_not_refresh_old_values() -> None:
    health = SignalHealth(SignalChecks(timeout_s=2.0))
    health.update(1.0, 5000.0)
    health.rewind(3.0)
    assert health.is_usable(5.0)
    assert not health.is_usable(5.1)
