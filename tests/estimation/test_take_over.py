"""An estimator that continues from one of another model or with other settings."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.model_file import Model
from cangauge.types import Estimate, Reason, Sample
from live import leaf_model, short_log


def drive() -> list[Sample]:
    return list(samples_of(short_log(200.0)))


def stepped(estimator: Estimator, samples: list[Sample]) -> Estimate:
    for sample in samples:
        estimate = estimator.step(sample)
    return estimate


def other_model() -> Model:
    data = leaf_model().model_dump()
    data["published"]["coefficients"]["k0"]["value"] += 2.0
    return Model.model_validate(data)


@pytest.mark.parametrize("method", ["ekf", "coulomb"])
def test_soc_uncertainty_and_delay_line_are_kept(method: str) -> None:
    samples = drive()
    settings = EstimatorSettings(method=method, initial_soc_pct=80.0)  # type: ignore[arg-type] # one of them
    before = Estimator(leaf_model(), settings)
    last = stepped(before, samples[:1500])
    after = Estimator(other_model(), settings)
    after.take_over(before)
    first = after.step(samples[1500])
    # It moves by the charge of 0.1 s and one voltage update.
    assert first.soc_pct == pytest.approx(last.soc_pct, abs=0.25 * last.soc_std_pct)
    assert first.soc_std_pct == pytest.approx(last.soc_std_pct, rel=0.05)
    assert not first.reasons & (Reason.DELAY_LINE_FILLING | Reason.NO_INITIAL_SOC)
    assert first.samples == 1501
    # The other model predicts other voltages.
    assert first.voltage_model_v == pytest.approx(last.voltage_model_v + 2.0, abs=1.0)


def test_no_charge_is_lost() -> None:
    samples = [each._replace(current_a=100.0) for each in drive()]
    settings = EstimatorSettings(method="coulomb", initial_soc_pct=80.0)
    whole = stepped(Estimator(leaf_model(), settings), samples)
    part = Estimator(leaf_model(), settings)
    for cut in range(100, 2000, 100):
        stepped(part, samples[cut - 100 : cut])
        following = Estimator(leaf_model(), settings)
        following.take_over(part)
        part = following
    # 20 estimators in a row: losing 100 A × 0.1 s each time would be 0.1 %.
    assert stepped(part, samples[1900:]).soc_pct == pytest.approx(whole.soc_pct, abs=1e-9)


@pytest.mark.parametrize("make", [Estimator, make_estimator])
@pytest.mark.parametrize("is_longer", [False, True])
def test_a_model_of_other_loads_continues_within_a_block(
    make: Callable[..., Estimator], is_longer: bool
) -> None:
    samples, data = drive(), leaf_model().model_dump()
    data["published"]["delays_s"] = [0.0, 10.0, 70.0]
    del data["published"]["coefficients"]["R4"]
    models = [leaf_model(), Model.model_validate(data)]
    settings = EstimatorSettings(initial_soc_pct=80.0)
    before, after = (make(each, settings) for each in (reversed(models) if is_longer else models))
    last = stepped(before, samples[:1600])  # 160 s: the block ends at 180 s
    after.take_over(before)
    assert stepped(after, samples[1600:]).soc_pct == pytest.approx(last.soc_pct, abs=1.0)


def test_longer_delay_line_must_fill_first() -> None:
    samples = drive()
    data = leaf_model().model_dump()
    data["published"]["delays_s"] = [0.0, 1.0, 2.0, 3.0]
    short = Model.model_validate(data)
    settings = EstimatorSettings(initial_soc_pct=80.0)
    before = Estimator(short, settings)
    stepped(before, samples[:1900])
    after = Estimator(leaf_model(), settings)
    after.take_over(before)
    assert after.step(samples[1900]).reasons & Reason.DELAY_LINE_FILLING


def test_unknown_soc_stays_unknown_and_old_samples_are_refused() -> None:
    samples = drive()
    before = Estimator(leaf_model())
    after = Estimator(leaf_model())
    after.take_over(before)
    assert after.step(samples[0]._replace(voltage_v=float("nan"))).reasons & Reason.NO_INITIAL_SOC
    before = Estimator(leaf_model(), EstimatorSettings(initial_soc_pct=80.0))
    stepped(before, samples[:100])
    after = Estimator(leaf_model(), EstimatorSettings(initial_soc_pct=80.0))
    after.take_over(before)
    assert after.step(samples[50]).reasons & Reason.IMPLAUSIBLE_INPUT


def test_inverse_without_voltage_continues_from_counting() -> None:
    samples = drive()
    settings = EstimatorSettings(method="newton", initial_soc_pct=80.0)
    before = Estimator(leaf_model(), settings)
    stepped(before, samples[:1000])
    silent = [each._replace(voltage_v=float("nan")) for each in samples[1000:1020]]
    last = stepped(before, silent)
    after = Estimator(leaf_model(), EstimatorSettings(initial_soc_pct=80.0))
    after.take_over(before)
    assert after.step(samples[1020]._replace(voltage_v=float("nan"))).soc_pct == pytest.approx(
        last.soc_coulomb_pct, abs=0.05
    )
