"""Stuck detection: a constant signal while its partner swings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import pytest

from cangauge.bus.plausibility import Pack, StuckDetector, stuck_detectors

PACK = Pack(resistance_ohm=0.1, error_std_v=0.5, capacity_ah=50.0, usual_v=370.0)
RATE_HZ = 10.0


def pair(step: float = 0.5) -> tuple[StuckDetector, StuckDetector]:
    return stuck_detectors(PACK, steps=(step, step), after_s=(10.0, 10.0))


def rounded(value: float, step: float = 0.5) -> float:
    return step * round(value / step)


def watched(
    current: Callable[[float], float],
    voltage: Callable[[float], float],
    seconds: float,
    step: float = 0.5,
) -> tuple[float | None, float | None]:
    """Return when current and voltage first count as stuck [s]."""
    detectors = pair(step)
    found: list[float | None] = [None, None]
    for now_s in times(seconds):
        stuck = (
            detectors[0].update(rounded(current(now_s), step), now_s),
            detectors[1].update(rounded(voltage(now_s), step), now_s),
        )
        for which, is_stuck in enumerate(stuck):
            if is_stuck and found[which] is None:
                found[which] = now_s
    return found[0], found[1]


def times(seconds: float) -> Iterable[float]:
    return (number / RATE_HZ for number in range(int(seconds * RATE_HZ)))


def driving(now_s: float) -> float:
    return 20.0 + 60.0 * math.sin(now_s / 3.0)


def under_load(now_s: float) -> float:
    return 370.0 - 0.1 * driving(now_s)


def test_a_moving_pair_is_not_stuck() -> None:
    assert watched(driving, under_load, 600.0) == (None, None)


def test_a_frozen_voltage_is_stuck_while_the_current_swings() -> None:
    current, voltage = watched(driving, lambda t: under_load(min(t, 60.0)), 200.0)
    assert current is None
    assert voltage is not None
    assert 70.0 <= voltage <= 110.0


def test_a_frozen_current_is_stuck_while_the_voltage_swings() -> None:
    current, voltage = watched(lambda t: driving(min(t, 60.0)), under_load, 200.0)
    assert voltage is None
    assert current is not None
    assert 70.0 <= current <= 110.0


def test_at_rest_nothing_is_stuck() -> None:
    # The last bit of the current flickers; the voltage is constant for hours.
    assert watched(lambda t: 0.5 * (int(t) % 3), lambda _: 380.0, 7200.0) == (None, None)


def test_a_charge_at_constant_current_is_not_stuck() -> None:
    assert watched(lambda _: -20.0, lambda t: 350.0 + 0.01 * t, 7200.0) == (None, None)
    # Nor is the relaxation after a step of the current: it drifts one way.
    assert watched(lambda _: 0.0, lambda t: 380.0 - 8.0 * math.exp(-t / 30.0), 600.0) == (
        None,
        None,
    )


@pytest.mark.parametrize("noise_v", [0.5, 1.5])
def test_voltage_noise_at_zero_current_proves_nothing(noise_v: float) -> None:
    # Worst case: alternating noise of up to three times the model error.
    noisy = watched(lambda _: 0.0, lambda t: 370.0 + noise_v * (-1) ** int(10.0 * t), 3600.0, 0.01)
    assert noisy == (None, None)


def test_a_coarse_voltage_needs_larger_swings() -> None:
    """A voltage in steps of 5 V is constant under currents of ±20 A: 2 V."""
    current, voltage = pair(0.01)
    for now_s in times(600.0):
        current_a = 20.0 * math.sin(now_s / 3.0) + (100.0 if now_s < 60.0 else 0.0)
        current.update(rounded(current_a, 0.01), now_s)
        assert not voltage.update(rounded(370.0 - 0.1 * current_a, 5.0), now_s)


def test_a_signal_that_changes_again_is_no_longer_stuck() -> None:
    current, voltage = pair()
    verdicts = []
    for now_s in times(200.0):
        frozen = 60.0 <= now_s < 150.0
        current.update(rounded(driving(now_s)), now_s)
        verdicts.append(voltage.update(rounded(under_load(60.0 if frozen else now_s)), now_s))
    assert verdicts[1490]
    assert not any(verdicts[1520:])
