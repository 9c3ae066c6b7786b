"""An estimator that is interrupted and restored continues as if it had not been."""

from __future__ import annotations

import functools
import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cangauge.errors import InputError
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings, FullCharge, LongRest
from cangauge.estimation.state import EstimatorState
from cangauge.model.effects.base import Pack
from cangauge.model.effects.library import LIBRARY, effect_entries
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH, leaf_2012_model, leaf_2012_model_file
from cangauge.types import Estimate, Reason, Sample
from synthetic import synthetic_log

PACK = Pack.of(leaf_2012_model(), CAPACITY_AH)
PLAIN = leaf_2012_model_file()
RULES = {"full_charge": FullCharge(400.0, 5.0), "long_rest": LongRest(600.0)}


def extended_by(ids: list[str]) -> Model:
    """Return the published model with effects, half way to their bounds."""
    chosen = []
    for effect_id in ids:
        effect = LIBRARY[effect_id]
        values = effect.neutral(PACK)
        for parameter in effect.amplitudes:
            low, high = parameter.bounds(PACK)
            far = high if high > values[parameter.name] else low
            values[parameter.name] = 0.5 * (values[parameter.name] + far)
        chosen.append((effect, values | ({"skew_s": 0.7} if effect_id == "time_skew" else {})))
    return Model.model_validate(PLAIN.model_dump() | {"effects": effect_entries(chosen)})


def eventful_samples() -> list[Sample]:
    """Return a drive with a gap, an unobserved interval, missing signals, a late sample and a
    clock that is set back."""
    samples = list(samples_of(synthetic_log(hours=0.15, rate_hz=2.0, start_pct=80.0, end_pct=70.0,
                                            noise_v=0.3, seed=5)))  # fmt: skip
    out = []
    for number, sample in enumerate(samples):
        time_s = sample.time_s
        time_s += 8.0 if number > 300 else 0.0
        time_s += 7200.0 if number > 450 else 0.0
        time_s -= 5000.0 if number > 900 else 0.0
        if number % 97 == 5:
            sample = sample._replace(voltage_v=math.nan)  # noqa: PLW2901 - a sample goes through
        if number % 4:
            sample = sample._replace(temperature_c=math.nan)  # noqa: PLW2901
        out.append(sample._replace(time_s=time_s))
    out.insert(200, out[190])
    return out


EVENTFUL = eventful_samples()


def through_json(state: EstimatorState) -> EstimatorState:
    text = json.dumps(state.model_dump(mode="json"), allow_nan=False)
    return EstimatorState.model_validate(json.loads(text))


def same(first: list[Estimate], again: list[Estimate]) -> bool:
    return np.array_equal(np.array(first, float), np.array(again, float), equal_nan=True)


def inner_state(thing: Any, depth: int = 0) -> Any:
    """Return all values of an object, recursively, with NaN as a string."""
    if isinstance(thing, float) and math.isnan(thing):
        return "nan"
    if isinstance(thing, np.ndarray):
        return thing.tolist()
    if isinstance(thing, list | tuple) or type(thing).__name__ == "deque":
        return [inner_state(each, depth + 1) for each in thing]
    if hasattr(thing, "__dict__") and not callable(thing) and depth < 8:
        # The rest of filterpy's attributes is derived.
        names = {"x", "P"} if type(thing).__name__ == "ExtendedKalmanFilter" else vars(thing)
        return {name: inner_state(vars(thing)[name], depth + 1) for name in sorted(names)}
    return thing if isinstance(thing, int | float | str | bool | None) else type(thing).__name__


def check_continues(model: Model, chosen: EstimatorSettings, at: int) -> None:
    whole = Estimator(model, chosen)
    for sample in EVENTFUL[:at]:
        whole.step(sample)
    state = through_json(whole.snapshot())
    after = Estimator(model, chosen)
    after.restore(state)
    rest = EVENTFUL[at:]
    # The next voltage is used within a second; after it the inner states must agree as well.
    assert same([after.step(each) for each in rest[:8]], [whole.step(each) for each in rest[:8]])
    assert inner_state(after) == inner_state(whole)
    assert same([after.step(each) for each in rest[8:]], [whole.step(each) for each in rest[8:]])


MOMENTS = [0, 1, 3, 201, 310, 455, 850, 910]


@pytest.mark.parametrize("at", MOMENTS)
@pytest.mark.parametrize("method", ["ekf", "newton", "coulomb"])
def test_continues_bit_for_bit(method: Any, at: int) -> None:
    check_continues(PLAIN, EstimatorSettings(method=method, **RULES), at)


@pytest.mark.parametrize("at", [0, 1, 3, 40, 201])
@pytest.mark.parametrize("start_pct", [80.0, 65.0])
def test_continues_bit_for_bit_with_untested_initial_soc(start_pct: float, at: int) -> None:
    check_continues(PLAIN, EstimatorSettings(initial_soc_pct=start_pct), at)


@pytest.mark.parametrize("effect_id", LIBRARY)
def test_continues_bit_for_bit_with_each_effect(effect_id: str) -> None:
    check_continues(extended_by([effect_id]), EstimatorSettings(initial_soc_pct=80.0), 465)


@pytest.mark.parametrize("at", MOMENTS)
def test_continues_bit_for_bit_with_many_effects(at: int) -> None:
    ids = ["time_skew", "temperature_lag", "core_temperature", "fast_polarization",
           "slow_diffusion", "hysteresis", "resistance_step", "entropic_coefficient"]  # fmt: skip
    check_continues(extended_by(ids), EstimatorSettings(), at)


def test_snapshot_is_a_copy() -> None:
    estimator = Estimator(extended_by(["time_skew", "hysteresis"]))
    for sample in EVENTFUL[:475]:
        estimator.step(sample)
    state = estimator.snapshot()
    before = state.model_dump_json()
    for sample in EVENTFUL[475:600]:
        estimator.step(sample)
    assert state.model_dump_json() == before


@pytest.mark.parametrize(
    "change", [{"method": "coulomb"}, {"capacity_ah": 45.0}, {"method": "ekf", "capacity_ah": 60.0}]
)
def test_soc_is_kept_with_other_settings(change: dict[str, Any]) -> None:
    before = Estimator(PLAIN, EstimatorSettings(initial_soc_pct=80.0))
    for sample in EVENTFUL[:300]:
        last = before.step(sample)
    after = Estimator(PLAIN, EstimatorSettings(**change))
    after.restore(through_json(before.snapshot()))
    found = after.step(EVENTFUL[300])
    assert found.soc_pct == pytest.approx(last.soc_pct, abs=0.05)
    assert found.soc_std_pct == pytest.approx(last.soc_std_pct, abs=0.2)


def test_another_model_takes_over_the_soc() -> None:
    before = Estimator(PLAIN, EstimatorSettings(initial_soc_pct=80.0))
    for sample in EVENTFUL[:300]:
        last = before.step(sample)
    after = Estimator(extended_by(["hysteresis", "time_skew"]))
    after.take_over(before)
    found = [after.step(each) for each in EVENTFUL[300:304]]
    assert found[0].samples == last.samples + 1
    assert found[-1].soc_pct == pytest.approx(last.soc_pct, abs=0.1)
    assert found[-1].soc_std_pct == pytest.approx(last.soc_std_pct, abs=0.2)
    assert not found[-1].reasons & Reason.DELAY_LINE_FILLING
    nothing = Estimator(PLAIN)
    nothing.take_over(Estimator(PLAIN))
    assert nothing.step(Sample(0.0, 10.0, math.nan, 23.0)).reasons & Reason.NO_INITIAL_SOC


def test_state_of_another_model_is_refused() -> None:
    estimator = Estimator(extended_by(["hysteresis", "fast_polarization"]))
    for sample in EVENTFUL[:100]:
        estimator.step(sample)
    state = estimator.snapshot()
    with pytest.raises(InputError, match="effects"):
        Estimator(PLAIN).restore(state)
    with pytest.raises(InputError, match=r"effects\.0"):
        Estimator(extended_by(["current_offset", "fast_polarization"])).restore(state)


@functools.cache
def _state_after(samples: int) -> str:
    estimator = Estimator(extended_by(["time_skew", "hysteresis", "slow_diffusion"]))
    for sample in EVENTFUL[:samples]:
        estimator.step(sample)
    return json.dumps(estimator.snapshot().model_dump(mode="json"))


def state_of_a_drive(samples: int = 465) -> dict[str, Any]:
    """Return the state with two hypotheses; with one before the unobserved interval at 451."""
    return json.loads(_state_after(samples))


def places(data: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths of all values."""
    items = (
        data.items()
        if isinstance(data, dict)
        else enumerate(data)
        if isinstance(data, list)
        else ()
    )
    found = [place for key, value in items for place in places(value, (*here, key))]
    return found or [here]


PLACES = [place for place in places(state_of_a_drive()) if "line" not in place]


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(PLACES),
            st.one_of(st.none(), st.booleans(), st.integers(), st.text(max_size=3),
                      st.floats(allow_nan=False, allow_infinity=False), st.just([]),
                      st.floats(-1e12, 1e12)),
        ),
        min_size=1,
        max_size=6,
    )
)  # fmt: skip
def test_damaged_state_is_refused_or_harmless(changes: list[tuple[Any, Any]]) -> None:
    data = state_of_a_drive()
    for place, value in changes:
        at = data
        for key in place[:-1]:
            at = at[key]
        at[place[-1]] = value
    estimator = Estimator(extended_by(["time_skew", "hysteresis", "slow_diffusion"]))
    try:
        estimator.restore(EstimatorState.model_validate(data))
    except (InputError, ValueError):  # pydantic's ValidationError is one
        return
    for sample in EVENTFUL[465:495]:
        found = estimator.step(sample)
        assert 0.0 <= found.soc_pct <= 100.0 or math.isnan(found.soc_pct)
        assert found.soc_std_pct >= 0.0 or math.isnan(found.soc_std_pct)
        assert math.isnan(found.soc_pct) == math.isnan(found.soc_std_pct)


@pytest.mark.parametrize(
    "place",
    [
        ("filter", "hypotheses", 0, "x", 0),
        ("filter", "hypotheses", 0, "p", 0, 0),
        ("filter", "log_odds"),
        ("since", "discharged_pct"),
        ("since", "gap_var_pct2"),
    ],
)
def test_state_contradicting_its_estimate_is_refused(place: tuple[Any, ...]) -> None:
    # Beside a wider hypothesis the standard deviation of the narrow one does not show.
    data = state_of_a_drive(440 if "p" in place else 465)
    at = data
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] += 0.001
    with pytest.raises(InputError, match="the last estimate"):
        Estimator(extended_by(["time_skew", "hysteresis", "slow_diffusion"])).restore(
            EstimatorState.model_validate(data)
        )


@pytest.mark.parametrize(
    ("place", "later_s"),
    [
        (("counter", "time_s"), -0.9),
        (("line", "since_s"), 1e5),
        (("memory", "first_s"), 1e5),
        (("memory", "rest_since_s"), 1e5),
    ],
)
def test_inconsistent_times_are_refused(place: tuple[str, ...], later_s: float) -> None:
    data = state_of_a_drive()
    at = data
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = data["clock"]["last_s"] + later_s
    with pytest.raises(ValueError, match=r"different times|later than the latest sample"):
        EstimatorState.model_validate(data)


def test_effect_memory_after_latest_sample_is_refused() -> None:
    ids = ["time_skew", "slow_diffusion", "hysteresis", "resistance_step", "core_temperature"]
    whole = Estimator(extended_by(ids))
    for sample in EVENTFUL[:465]:
        whole.step(sample)
    state = through_json(whole.snapshot())
    Estimator(extended_by(ids)).restore(state)
    for number in range(len(ids)):
        # The memory of `time_skew` starts with the number of waiting samples, then their times.
        at = 1 if number == ids.index("time_skew") else 0
        effects = [list(each) for each in state.effects]
        effects[number][at] = state.clock.last_s + 10.0
        with pytest.raises(InputError, match=rf"effects\.{number}"):
            Estimator(extended_by(ids)).restore(state.model_copy(update={"effects": effects}))
