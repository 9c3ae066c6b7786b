"""Pairing of currents and voltages into samples."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from cangauge.bus.decoder import Pairing
from cangauge.types import Sample

WITHIN_S = 0.020


def run(frames: list[tuple[float, str, float]]) -> list[Sample]:
    pairing = Pairing(WITHIN_S)
    samples = []
    for time_s, kind, value in frames:
        made = (
            pairing.current(time_s, value, 20.0) if kind == "I" else pairing.voltage(time_s, value)
        )
        if made is not None:
            samples.append(made)
    last = pairing.flush()
    return samples if last is None else [*samples, last]


def brief(samples: list[Sample]) -> list[tuple[float, float, float | None]]:
    return [
        (each.time_s, each.current_a, None if math.isnan(each.voltage_v) else each.voltage_v)
        for each in samples
    ]


def test_pairs_form_in_either_order_at_the_currents_time() -> None:
    assert brief(run([(1.0, "I", 5), (1.01, "U", 400)])) == [(1.0, 5, 400)]
    assert brief(run([(1.0, "U", 400), (1.01, "I", 5)])) == [(1.01, 5, 400)]


def test_the_limit_is_inclusive() -> None:
    assert brief(run([(1.0, "I", 5), (1.02, "U", 400)])) == [(1.0, 5, 400)]
    assert brief(run([(1.0, "I", 5), (1.021, "U", 400)])) == [(1.0, 5, None)]
    assert brief(run([(1e9, "I", 5), (1e9 + 0.02, "U", 400)])) == [(1e9, 5, 400)]


def test_each_value_is_used_once() -> None:
    frames = [(0.0, "I", 1.0), (0.001, "U", 400.0), (0.002, "I", 2.0), (0.003, "I", 3.0)]
    assert brief(run(frames)) == [(0.0, 1, 400), (0.002, 2, None), (0.003, 3, None)]


def test_currents_without_voltage_become_samples() -> None:
    frames = [(0.1 * n, "I", float(n)) for n in range(5)]
    assert brief(run(frames)) == [(0.1 * n, n, None) for n in range(5)]


def test_a_late_voltage_releases_the_current_at_once() -> None:
    pairing = Pairing(WITHIN_S)
    assert pairing.current(0.0, 1.0, 20.0) is None
    released = pairing.voltage(0.1, 400.0)
    assert released is not None
    assert math.isnan(released.voltage_v)
    assert pairing.current(0.11, 2.0, 20.0) == Sample(0.11, 2.0, 400.0, 20.0)


def test_no_pair_forms_across_a_step_back_in_time() -> None:
    assert brief(run([(100.0, "I", 1.0), (0.0, "U", 400.0), (0.01, "I", 2.0)])) == [
        (100.0, 1, None),
        (0.01, 2, 400),
    ]


def test_unpaired_values_are_counted() -> None:
    pairing = Pairing(WITHIN_S)
    for n in range(3):
        pairing.voltage(float(n), 400.0)
    pairing.current(10.0, 1.0, 20.0)
    pairing.current(11.0, 1.0, 20.0)
    statistics = pairing.statistics
    assert (statistics.voltage_unpaired, statistics.current_unpaired) == (3, 1)


def _numbered(steps: list[tuple[int, str]]) -> list[tuple[float, str, float]]:
    time_ms, frames = 0, []
    for n, (step, kind) in enumerate(steps):
        time_ms += step
        frames.append((time_ms / 1000.0, kind, float(n)))
    return frames


frames_in_time = st.lists(
    st.tuples(st.integers(0, 60), st.sampled_from("IU")), min_size=1, max_size=60
).map(_numbered)


@given(frames=frames_in_time)
def test_no_current_is_lost_doubled_or_out_of_order(
    frames: list[tuple[float, str, float]],
) -> None:
    samples = run(frames)
    currents = [(time_s, value) for time_s, kind, value in frames if kind == "I"]
    assert [(each.time_s, each.current_a) for each in samples] == currents
    voltages = {value: time_s for time_s, kind, value in frames if kind == "U"}
    used = [each.voltage_v for each in samples if not math.isnan(each.voltage_v)]
    assert len(set(used)) == len(used)
    for each in samples:
        if not math.isnan(each.voltage_v):
            assert abs(voltages[each.voltage_v] - each.time_s) <= WITHIN_S + 1e-6
