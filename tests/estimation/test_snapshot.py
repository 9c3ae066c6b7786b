"""An estimator that is interrupted and restored continues as if it had not been."""

from __future__ import annotations

import math
import subprocess
import sys
from base64 import b64decode, b64encode
from typing import Any

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
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


def same(first: list[Estimate], again: list[Estimate]) -> bool:
    return np.array_equal(np.array(first, float), np.array(again, float), equal_nan=True)


def check_continues(make: Any, model: Model, chosen: EstimatorSettings, at: int) -> None:
    whole = make(model, chosen)
    for sample in EVENTFUL[:at]:
        whole.step(sample)
    state = whole.snapshot()
    after = make(model, chosen)
    after.restore(state)
    rest = EVENTFUL[at:]
    assert same([after.step(each) for each in rest], [whole.step(each) for each in rest])
    assert after.snapshot() == whole.snapshot()
    assert after.power() == whole.power()


MOMENTS = [0, 1, 3, 201, 310, 455, 850, 910]


BOTH = pytest.mark.parametrize("make", [Estimator, make_estimator])


@BOTH
@pytest.mark.parametrize(
    ("method", "at"),
    nightly_except(
        [("ekf", 201), ("ekf", 455), ("ekf", 910), ("newton", 310), ("coulomb", 310)],
        [*(("ekf", at) for at in MOMENTS), *((each, 310) for each in ("newton", "coulomb"))],
    ),
)
def test_continues_bit_for_bit(make: Any, method: Any, at: int) -> None:
    check_continues(make, PLAIN, EstimatorSettings(method=method, **RULES), at)


@BOTH
@pytest.mark.parametrize(
    ("start_pct", "at"),
    nightly_except(
        [(80.0, 3), (65.0, 40)],
        [(start_pct, at) for start_pct in (80.0, 65.0) for at in (0, 1, 3, 40, 201)],
    ),
)
def test_continues_bit_for_bit_with_untested_initial_soc(
    make: Any, start_pct: float, at: int
) -> None:
    check_continues(make, PLAIN, EstimatorSettings(initial_soc_pct=start_pct), at)


# Of those with a memory, the suite has the others together below.
@BOTH
@pytest.mark.parametrize("effect_id", nightly_except(("weak_cell", "charge_transfer"), LIBRARY))
def test_continues_bit_for_bit_with_each_effect(make: Any, effect_id: str) -> None:
    check_continues(make, extended_by([effect_id]), EstimatorSettings(initial_soc_pct=80.0), 465)


@BOTH
@pytest.mark.parametrize("at", nightly_except((310, 910), (3, 310, 455, 910)))
def test_continues_bit_for_bit_with_many_effects(make: Any, at: int) -> None:
    ids = ["time_skew", "temperature_lag", "core_temperature", "fast_polarization",
           "slow_diffusion", "hysteresis", "resistance_step", "entropic_coefficient"]  # fmt: skip
    check_continues(make, extended_by(ids), EstimatorSettings(), at)


@BOTH
def test_snapshot_is_a_copy(make: Any) -> None:
    estimator = make(extended_by(["time_skew", "hysteresis"]))
    for sample in EVENTFUL[:475]:
        estimator.step(sample)
    state = estimator.snapshot()
    before = state.model_dump_json()
    for sample in EVENTFUL[475:600]:
        estimator.step(sample)
    assert state.model_dump_json() == before


def after_drive(make: Any, model: Model, **chosen: Any) -> Estimator:
    """Return an estimator after part of the drive."""
    estimator: Estimator = make(model, EstimatorSettings(initial_soc_pct=80.0, **chosen))
    for sample in EVENTFUL[:300]:
        estimator.step(sample)
    return estimator


@BOTH
@pytest.mark.parametrize(
    "change", [{"method": "coulomb"}, {"capacity_ah": 45.0}, {"method": "ekf", "capacity_ah": 60.0}]
)
def test_soc_is_kept_with_other_settings(make: Any, change: dict[str, Any]) -> None:
    before = after_drive(make, PLAIN)
    after = make(PLAIN, EstimatorSettings(**change))
    after.restore(before.snapshot())
    found, last = after.step(EVENTFUL[300]), before.estimate
    assert found.soc_pct == pytest.approx(last.soc_pct, abs=0.05)
    assert found.soc_std_pct == pytest.approx(last.soc_std_pct, abs=0.2)


@pytest.mark.parametrize("makes", [(Estimator, make_estimator), (make_estimator, Estimator)])
@pytest.mark.parametrize("age_s", [30.0, 86400.0, math.nan])
def test_state_of_another_release_gives_its_soc(makes: tuple[Any, Any], age_s: float) -> None:
    """The two implementations stand for two releases: neither reads the other's block."""
    write, read = makes
    state = after_drive(write, PLAIN).snapshot()
    after = read(PLAIN, EstimatorSettings(initial_soc_pct=20.0))
    latest = after.restore(state, age_s)
    assert (latest.time_s, latest.soc_pct) == (state.time_s, state.soc_pct)
    found = [after.step(each) for each in EVENTFUL[300:900]]
    assert found[0].soc_pct == pytest.approx(state.soc_pct, abs=0.2)
    assert (found[0].soc_std_pct < 1.5) is (age_s == 30.0)  # else charged or driven unseen
    assert found[-1].soc_pct == pytest.approx(before_end(), abs=3.0)


def before_end() -> float:
    """Return the SoC of one estimator over the same samples."""
    estimator = after_drive(make_estimator, PLAIN)
    return [estimator.step(each) for each in EVENTFUL[300:900]][-1].soc_pct


@BOTH
def test_state_of_another_model_is_refused(make: Any) -> None:
    state = after_drive(make, extended_by(["time_skew", "hysteresis"])).snapshot()
    with pytest.raises(InputError, match="another model"):
        make(extended_by(["current_offset"])).restore(state)


@BOTH
def test_damaged_block_is_refused(make: Any) -> None:
    state = after_drive(make, extended_by(["time_skew"])).snapshot()
    whole = b64decode(state.block)
    for size in (0, 1, len(whole) // 2, len(whole) - 1):
        part = state.model_copy(update={"block": b64encode(whole[:size]).decode()})
        with pytest.raises(InputError, match=r"^estimator\.block: damaged"):
            make(extended_by(["time_skew"])).restore(part)


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
    restarted.restore(carried.snapshot())
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
