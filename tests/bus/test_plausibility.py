"""Signals of a pack: debouncing, ranges, rates, time-outs, and values that are stuck."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.bus.plausibility import (
    PackProperties,
    SignalChecks,
    SignalHealth,
    StuckDetector,
    stuck_detectors,
)
from cangauge.types import Reason

NAN = math.nan
BAD = Reason.PROTECTION_FAILED


def passed(health: SignalHealth, values: list[float], step_s: float = 0.1) -> list[float | None]:
    used = [health.update(value, step_s * number) for number, value in enumerate(values)]
    return [None if math.isnan(value) else value for value in used]


@given(st.lists(st.booleans(), max_size=60), st.integers(1, 6), st.integers(1, 6))
def test_debouncing_agrees_with_a_model_over_the_past(
    good: list[bool], invalid_after: int, valid_after: int
) -> None:
    checks = SignalChecks(invalid_after=invalid_after, valid_after=valid_after)
    used = passed(SignalHealth(checks), [float(n) if ok else NAN for n, ok in enumerate(good)])
    trusted, known, expected = True, False, []
    for ok, group in itertools.groupby(good):
        length = len(list(group))
        held = length if not ok else 0 if trusted else min(valid_after - 1, length)
        expected += [False] * held + [True] * (length - held)
        if ok:
            trusted, known = trusted or length >= valid_after, True
        else:
            trusted = trusted and not (known and length >= invalid_after)
    assert [value is not None for value in used] == expected


def test_an_invalid_signal_is_not_usable_and_has_a_reason() -> None:
    health = SignalHealth(SignalChecks(invalid_after=2, valid_after=3))
    health.update(1.0, 0.0)
    health.fail(BAD)
    assert health.value_at(0.1) == 1.0
    health.fail(BAD)
    assert math.isnan(health.value_at(0.1))
    assert (health.is_failing, health.reason) == (True, BAD)
    used = []
    for number in range(3):  # repeated frames in between do not stop recovery
        used.append(health.update(2.0, 0.1 * number))
        health.fail(BAD, is_repeated=True)
    assert [math.isnan(value) for value in used] == [True, True, False]


def test_values_out_of_range_and_spikes_are_refused() -> None:
    values = [-1.0, 5.0, 5.1, -1.1, math.inf, 0.0]
    limited = SignalHealth(SignalChecks(lowest=-1.0, highest=5.0))
    assert passed(limited, values) == [-1.0, 5.0, None, None, None, 0.0]
    checks = SignalChecks(max_jump=5.0, max_rate_per_s=1.0)
    assert passed(SignalHealth(checks), [20.0, 60.0, 20.5, 21.0]) == [20.0, None, 20.5, 21.0]
    # A lasting step: 28 is possible 3 s after the latest good value; then three are needed.
    assert passed(SignalHealth(checks), [20.0, *[28.0] * 40]).index(28.0) == 30 + 2
    health = SignalHealth(checks)
    health.update(20.0, 0.0)
    assert math.isnan(health.update(40.0, 14.9))
    assert health.update(40.0, 15.1) == 40.0


def test_limits_of_a_pack_hold_where_none_are_stated() -> None:
    pack = PackProperties(0.1, 0.5, 50.0, usual_v=400.0)
    voltage = SignalChecks(highest=500.0).within_pack("voltage", pack)
    assert (voltage.lowest, voltage.highest) == (200.0, 500.0)
    warm = SignalChecks().within_pack("temperature", pack)
    assert (warm.lowest, warm.highest, warm.max_jump, warm.max_rate_per_s) == (-60, 120, 5, 1)
    current = SignalChecks().within_pack("current", pack)
    assert (current.lowest, current.highest) == (-4000.0, 4000.0)  # a short circuit
    stiff = PackProperties(0.01, 0.5, 50.0, usual_v=400.0)
    assert SignalChecks().within_pack("current", stiff).highest == 5000.0


def test_a_stated_time_out_is_exact() -> None:
    health = SignalHealth(SignalChecks(timeout_s=0.2), 0.1)
    health.update(1.0, 10.0)
    assert (health.is_usable(10.2), health.is_usable(10.21)) == (True, False)
    health.update(1.0, 50.0)  # old is not invalid: the next good value is used
    assert health.is_usable(50.0)
    health.rewind(3.0)  # a step back in time does not refresh it
    assert (health.is_usable(3.1), health.is_usable(3.3)) == (True, False)


@pytest.mark.parametrize(
    ("period_s", "timeout_s"), [(0.01, 0.5), (0.1, 1.0), (0.5, 2.0), (1.0, 3.0), (10.0, 30.0)]
)
def test_the_time_out_follows_the_period(period_s: float, timeout_s: float) -> None:
    checks = SignalChecks()
    assert SignalHealth(checks, period_s).timeout_s == pytest.approx(timeout_s)
    learned = SignalHealth(checks)
    passed(learned, [1.0] * 8, period_s)
    assert learned.timeout_s == 2.0
    learned.update(1.0, 8 * period_s)
    assert learned.timeout_s == pytest.approx(timeout_s)
    on_change = SignalHealth(SignalChecks(), period_s, is_cyclic=False)
    assert on_change.timeout_s == pytest.approx(max(10.0, timeout_s))


def test_pauses_and_losses_do_not_distort_the_period() -> None:
    health, now_s = SignalHealth(SignalChecks()), 0.0
    for number in range(200):
        now_s += 3600.0 if number == 150 else 0.01 * (1 + number % 2)  # half of them lost
        health.update(1.0, now_s)
    assert health.period_s == pytest.approx(0.015, rel=0.2)


# --- Stuck

PACK = PackProperties(resistance_ohm=0.1, error_std_v=0.5, capacity_ah=50.0, usual_v=370.0)
Signal = Callable[[float], float]


def driving(now_s: float) -> float:
    return 20.0 + 60.0 * math.sin(now_s / 3.0)


def under_load(now_s: float) -> float:
    return 370.0 - 0.1 * driving(now_s)


def stuck_from(
    current: Signal, voltage: Signal, seconds: float, step: float = 0.5, step_v: float | None = None
) -> tuple[float | None, float | None]:
    """Return when current and voltage first count as stuck [s]."""
    detectors: tuple[StuckDetector, StuckDetector]
    detectors = stuck_detectors(PACK, (step, 10.0), (min(step, step_v or step), None))
    found: list[float | None] = [None, None]
    for number in range(int(seconds * 10.0)):
        now_s = number / 10.0
        for which, (signal, unit) in enumerate(((current, step), (voltage, step_v or step))):
            value = unit * round(signal(now_s) / unit)
            if detectors[which].update(value, now_s) and found[which] is None:
                found[which] = now_s
    return found[0], found[1]


def test_a_frozen_signal_is_stuck_while_its_partner_swings() -> None:
    current, voltage = stuck_from(driving, lambda t: under_load(min(t, 60.0)), 200.0)
    assert current is None
    assert voltage is not None
    assert 70.0 <= voltage <= 110.0
    # A finer voltage needs smaller swings, once it has shown its steps.
    gentle, step_v = (lambda t: 20.0 * math.sin(t / 3.0)), 0.01
    frozen = stuck_from(gentle, lambda t: 370.0 - 0.1 * gentle(min(t, 60.0)), 200.0, 0.5, step_v)
    assert frozen[1] is not None
    assert 70.0 <= frozen[1] <= 110.0
    current, voltage = stuck_from(lambda t: driving(min(t, 60.0)), under_load, 200.0)
    assert voltage is None
    assert current is not None
    assert 70.0 <= current <= 110.0


NOT_STUCK: dict[str, tuple[Signal, Signal, float, float, float | None]] = {
    "a moving pair": (driving, under_load, 600.0, 0.5, None),
    "rest: the last bit flickers": (lambda t: 0.5 * (int(t) % 3), lambda _: 380.0, 7200, 0.5, None),
    "constant current": (lambda _: -20.0, lambda t: 350.0 + 0.01 * t, 7200.0, 0.5, None),
    "relaxation drifts one way": (
        lambda _: 0.0, lambda t: 380.0 - 8.0 * math.exp(-t / 30.0), 600.0, 0.5, None,
    ),
    # Alternating noise of up to three times the model's error.
    "noise at 0 A": (
        lambda _: 0.0, lambda t: 370.0 + 1.5 * (-1) ** int(10.0 * t), 3600.0, 0.01, None,
    ),
    # Swings of ±20 A are 2 V, less than a step of the sensor, which the first minute shows.
    "a coarse voltage": (
        lambda t: 20.0 * math.sin(t / 3.0) + (100.0 if t < 60.0 else 0.0),
        lambda t: 370.0 - 2.0 * math.sin(t / 3.0) - (10.0 if t < 60.0 else 0.0), 600.0, 0.01, 5.0,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NOT_STUCK)
def test_a_constant_signal_can_be_sound(name: str) -> None:
    assert stuck_from(*NOT_STUCK[name]) == (None, None)


def test_a_signal_that_changes_again_is_no_longer_stuck() -> None:
    current, voltage = stuck_detectors(PACK, (0.5, None), (0.5, None))
    verdicts = []
    for number in range(2000):
        now_s = number / 10.0
        current.update(0.5 * round(2.0 * driving(now_s)), now_s)
        frozen_s = 60.0 if 60.0 <= now_s < 150.0 else now_s
        verdicts.append(voltage.update(0.5 * round(2.0 * under_load(frozen_s)), now_s))
    assert verdicts[1490]
    assert not any(verdicts[1520:])


def test_a_temperature_is_stuck_after_the_stated_time_alone() -> None:
    checks = SignalChecks(stuck_after_s=60.0, valid_after=1)
    # A current or voltage needs its partner.
    assert None not in passed(SignalHealth(checks), [20.0] * 170, 1.0)
    health = SignalHealth(checks, is_cyclic=False)
    used = passed(health, [20.0 if t < 100 else 21.0 for t in range(170)], 1.0)
    assert [t for t, value in enumerate(used) if value is None] == [
        *range(60, 100),
        *range(160, 170),
    ]
    assert health.reason == Reason.SIGNAL_STUCK
