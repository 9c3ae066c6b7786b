"""An estimator that is interrupted and restored continues as if it had not been."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.estimation.state import EstimatorState
from cangauge.model.effects.base import Effect, Pack
from cangauge.model.effects.library import LIBRARY, effect_entries
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH, leaf_2012_model, leaf_2012_model_file
from cangauge.settings import FullCharge, LongRest
from cangauge.types import Estimate, Sample
from selection import nightly_except
from synthetic import synthetic_log

PACK = Pack.of(leaf_2012_model(), CAPACITY_AH)
PLAIN = leaf_2012_model_file()
RULES = {"full_charge": FullCharge(400.0, 5.0), "long_rest": LongRest(600.0)}


def half_way(effect: Effect) -> dict[str, float]:
    """Return amplitudes half way to the far bound, shapes in the middle."""
    values = effect.neutral(PACK)
    for parameter in effect.amplitudes:
        low, high = parameter.bounds(PACK)
        far = high if high > values[parameter.name] else low
        values[parameter.name] = 0.5 * (values[parameter.name] + far)
    return values | ({"skew_s": 0.7} if effect.id == "time_skew" else {})


def extended_by(ids: list[str]) -> Model:
    """Return the published model with effects, half way to their bounds."""
    chosen = [(LIBRARY[effect_id], half_way(LIBRARY[effect_id])) for effect_id in ids]
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


def check_continues(model: Model, chosen: EstimatorSettings, at: int) -> None:
    whole = Estimator(model, chosen)
    for sample in EVENTFUL[:at]:
        whole.step(sample)
    state = through_json(whole.snapshot())
    after = Estimator(model, chosen)
    after.restore(state)
    rest = EVENTFUL[at:]
    assert same([after.step(each) for each in rest], [whole.step(each) for each in rest])
    assert after.snapshot().model_dump_json() == whole.snapshot().model_dump_json()


MOMENTS = [0, 1, 3, 201, 310, 455, 850, 910]


@pytest.mark.parametrize(
    ("method", "at"),
    nightly_except(
        [("ekf", 201), ("ekf", 455), ("ekf", 910), ("newton", 310), ("coulomb", 310)],
        [*(("ekf", at) for at in MOMENTS), *((each, 310) for each in ("newton", "coulomb"))],
    ),
)
def test_continues_bit_for_bit(method: Any, at: int) -> None:
    check_continues(PLAIN, EstimatorSettings(method=method, **RULES), at)


@pytest.mark.parametrize(
    ("start_pct", "at"),
    nightly_except(
        [(80.0, 3), (65.0, 40)],
        [(start_pct, at) for start_pct in (80.0, 65.0) for at in (0, 1, 3, 40, 201)],
    ),
)
def test_continues_bit_for_bit_with_untested_initial_soc(start_pct: float, at: int) -> None:
    check_continues(PLAIN, EstimatorSettings(initial_soc_pct=start_pct), at)


# Of those with a memory, the suite has the others together below.
@pytest.mark.parametrize("effect_id", nightly_except(("weak_cell", "charge_transfer"), LIBRARY))
def test_continues_bit_for_bit_with_each_effect(effect_id: str) -> None:
    check_continues(extended_by([effect_id]), EstimatorSettings(initial_soc_pct=80.0), 465)


@pytest.mark.parametrize("at", nightly_except((310, 910), (3, 310, 455, 910)))
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


def test_state_of_another_model_is_refused() -> None:
    estimator = Estimator(extended_by(["hysteresis", "fast_polarization"]))
    for sample in EVENTFUL[:100]:
        estimator.step(sample)
    state = estimator.snapshot()
    with pytest.raises(InputError, match="effects"):
        Estimator(PLAIN).restore(state)
    with pytest.raises(InputError, match="effects"):
        Estimator(extended_by(["current_offset", "fast_polarization"])).restore(state)


@pytest.mark.parametrize(
    ("part", "value"),
    [
        (("hypotheses", "filters", 0, "x"), [50.0, 0.0]),
        (("hypotheses", "filters", 0, "p"), [[1.0]]),
        (("hypotheses", "filters", 0, "bias", "v"), [[0.0, 0.0]]),
        (("hypotheses", "filters", 0, "x", 0), "nan"),
        (("counter", "discharged_pct"), None),
        (("memory", "tick"), "noon"),
        (("memory", "weather"), "rain"),
        (("memory", "first_s"), None),
        (("estimate", 1), 100.1),
        (("estimate", 2), -1.0),
        (("line", "current_a"), [1.0]),
        (("reasons",), -1),
        (("estimate",), [0.0]),
        (("more",), 1),
    ],
)
def test_state_of_another_shape_is_refused(part: tuple[Any, ...], value: object) -> None:
    estimator = Estimator(PLAIN, EstimatorSettings(initial_soc_pct=80.0))
    for sample in EVENTFUL[:300]:
        estimator.step(sample)
    data = json.loads(estimator.snapshot().model_dump_json())
    at = data
    for key in part[:-1]:
        at = at[key]
    at[part[-1]] = value
    with pytest.raises((InputError, ValueError)):
        Estimator(PLAIN).restore(EstimatorState.model_validate(data))


@pytest.mark.parametrize("make", [Estimator, make_estimator])
@pytest.mark.parametrize(
    ("effect_id", "places"),
    [
        ("time_skew", (0, 1, 3, -1)),  # the number of readings that wait, a time, a voltage
        ("core_temperature", (0, 1, 5)),
        ("hysteresis", (0, 2)),
        ("resistance_step", (0,)),
    ],
)
def test_damaged_state_of_an_effect_is_refused(
    make: Any, effect_id: str, places: Sequence[int]
) -> None:
    model = extended_by([effect_id])
    estimator = make(model)
    for sample in EVENTFUL[:300]:
        estimator.step(sample)
    state = estimator.snapshot()
    currents, numbers = state.online
    damaged = [[*numbers, 1.0]]
    for place in places:
        damaged.append(list(numbers))
        damaged[-1][place] = math.inf
    damaged.append([math.nan, *numbers[1:]])
    for each in damaged:
        with pytest.raises(InputError, match=r"^effects\.0: the saved state is "):
            make(model).restore(state.model_copy(update={"online": [currents, each]}))


@pytest.mark.parametrize(
    "change",
    [
        lambda numbers: [numbers[0] + 1.0, *numbers[1:]],
        lambda numbers: [numbers[0], numbers[1] + 1e6, *numbers[2:]],
        lambda numbers: [*numbers[:5], numbers[5] + 0.01, *numbers[6:]],
        lambda numbers: [*numbers[:9], numbers[9] + 1e6, *numbers[10:]],
    ],
    ids=[
        "another number waits",
        "waiting times turn",
        "the last has no current",
        "times of currents turn",
    ],
)
def test_readings_that_wait_are_in_order(change: Any) -> None:
    model = extended_by(["time_skew"])
    estimator = Estimator(model)
    for sample in EVENTFUL[:300]:
        estimator.step(sample)
    state = estimator.snapshot()
    assert state.online[1][0] == 2.0
    online = [state.online[0], change(state.online[1])]
    with pytest.raises(InputError, match=r"^effects\.0: the saved state is damaged"):
        Estimator(model).restore(state.model_copy(update={"online": online}))


@pytest.mark.parametrize("away_s", [30.0, 86400.0])
def test_a_restart_while_away_equals_no_restart(away_s: float) -> None:
    """Two drives; between them the car is charged without a log."""
    days = [
        synthetic_log(hours=0.3, start_pct=start, end_pct=start - 6.0) for start in (80.0, 60.0)
    ]
    first, second = (list(samples_of(day)) for day in days)
    later_s = first[-1].time_s + away_s - second[0].time_s
    second = [sample._replace(time_s=sample.time_s + later_s) for sample in second]
    carried = make_estimator(PLAIN)
    for sample in first:
        carried.step(sample)
    restarted = make_estimator(PLAIN)
    restarted.restore(through_json(carried.snapshot()))
    again = [restarted.step(sample) for sample in second]
    assert same(again, [carried.step(sample) for sample in second])


def test_a_compiled_service_starts_without_filterpy() -> None:
    code = (
        "import sys; from cangauge.estimation.compiled import make_estimator;"
        "from cangauge.model.published import leaf_2012_model_file;"
        "from cangauge.types import Sample;"
        "estimator = make_estimator(leaf_2012_model_file());"
        "[estimator.step(Sample(float(k), 20.0 + k % 7, 385.0, 23.0)) for k in range(200)];"
        "estimator.health, estimator.power(), estimator.snapshot();"
        "print(estimator.core, 'filterpy' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["compiled", "False"]
