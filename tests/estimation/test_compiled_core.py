"""The compiled core gives the numbers of the reference implementation, bit for bit."""

from __future__ import annotations

import json
import math
import runpy
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cangauge._core_digest import sources_digest
from cangauge.estimation import compiled as compiled_module
from cangauge.estimation.compiled import CompiledEstimator, make_estimator
from cangauge.estimation.core_constants import core_constants, effect_fields
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.validation.packs import BenchPack, load
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import capacity_from_reference
from cangauge.model.effects.library import LIBRARY
from cangauge.model.model_file import Model
from cangauge.types import Estimate, Sample, Status
from estimation.test_any_input import MODELS, RULES, inputs, odd, samples_of_rows
from estimation.test_snapshot import eventful_samples

core = pytest.importorskip("cangauge._core", reason="the extension was not built: no C compiler")

ROOT = Path(__file__).parents[2]
STARTS = st.sampled_from([None, 0.0, 50.0, 100.0])


def bits(numbers: Iterable[float]) -> list[str]:
    return [float(number).hex() for number in numbers]


def pair(model: Model, chosen: EstimatorSettings) -> tuple[Estimator, CompiledEstimator]:
    compiled = make_estimator(model, chosen)
    assert isinstance(compiled, CompiledEstimator)
    return Estimator(model, chosen), compiled


def follow(reference: Estimator, compiled: Estimator, samples: Iterable[Sample]) -> None:
    """Hand the same samples to both; each estimate has the same bits."""
    for number, sample in enumerate(samples):
        expected, found = reference.step(sample), compiled.step(sample)
        assert bits(expected) == bits(found), f"sample {number}: {sample}"


def state_of(estimator: Estimator) -> Any:
    return json.loads(estimator.snapshot().model_dump_json())


def test_extension_is_built_from_these_sources() -> None:
    digest = sources_digest(ROOT / "core")
    assert digest == core.SOURCES, "run `python hatch_build.py` again"


def test_extension_of_other_sources_is_not_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert compiled_module._load(tmp_path) is core  # no sources there
    shutil.copytree(ROOT / "core", tmp_path / "core")
    assert compiled_module._load(tmp_path) is core
    with (tmp_path / "core" / "cangauge.c").open("a", encoding="utf-8") as source:
        source.write("/* changed */")
    assert not caplog.records
    assert compiled_module._load(tmp_path) is None
    assert ["hatch_build.py" in record.getMessage() for record in caplog.records] == [True]


def test_failed_build_leaves_no_earlier_extension(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    build = runpy.run_path(str(ROOT / "hatch_build.py"))["build_extension"]
    monkeypatch.delenv("LDSHARED", raising=False)
    monkeypatch.setenv("CC", "cc")
    assert build(ROOT, tmp_path).is_file()
    monkeypatch.setenv("CC", "no-such-compiler")
    assert build(ROOT, tmp_path) is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("method", ["ekf", "newton", "coulomb"])
@pytest.mark.parametrize("which", ["plain", "together"])
@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(drawn=inputs, with_rules=st.booleans(), start=STARTS)
def test_any_input_gives_the_same_bits(
    which: str, method: Any, drawn: Any, with_rules: bool, start: Any
) -> None:
    chosen = EstimatorSettings(
        method=method, initial_soc_pct=start, **(RULES if with_rules else {})
    )
    reference, compiled = pair(MODELS[which], chosen)
    follow(reference, compiled, samples_of_rows(drawn))
    assert state_of(reference) == state_of(compiled)


@pytest.mark.parametrize("which", ["plain", "together"])
@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(drawn=st.lists(st.tuples(odd, odd, odd, odd), max_size=40))
def test_extreme_numbers_give_the_same_bits(which: str, drawn: Any) -> None:
    follow(*pair(MODELS[which], EstimatorSettings()), [Sample(*row) for row in drawn])


@pytest.mark.parametrize("effect_id", LIBRARY)
def test_eventful_drive_gives_the_same_bits_with_each_effect(effect_id: str) -> None:
    chosen = EstimatorSettings(initial_soc_pct=85.0)
    reference, compiled = pair(MODELS[effect_id], chosen)
    samples = eventful_samples()
    follow(reference, compiled, samples[:700])
    assert state_of(reference) == state_of(compiled)
    assert bits(reference.power()) == bits(compiled.power())
    assert bits(reference.health) == bits(compiled.health)
    now = samples[699]
    assert bits(reference.pack_tick(now)) == bits(compiled.pack_tick(now))
    stamps = [now.time_s - 3.0, math.nan]
    assert bits(reference.current_changes(now.time_s, stamps)) == bits(
        compiled.current_changes(now.time_s, stamps)
    )
    # Each continues from the other's state.
    after = pair(MODELS[effect_id], chosen)
    after[0].restore(compiled.snapshot(), 5.0)
    after[1].restore(reference.snapshot(), 5.0)
    follow(*after, samples[700:])


def test_other_model_takes_over_with_the_same_bits() -> None:
    before = pair(MODELS["plain"], EstimatorSettings(initial_soc_pct=85.0))
    after = pair(MODELS["together"], EstimatorSettings(method="coulomb"))
    samples = eventful_samples()
    follow(*before, samples[:500])
    for old, new in zip(before, after, strict=True):
        new.take_over(old)
    follow(*after, samples[500:])


def test_columns_give_the_same_bits_as_samples() -> None:
    columns = np.array(eventful_samples()).T
    chosen = EstimatorSettings()
    reference, compiled = pair(MODELS["plain"], chosen)
    found = compiled.run(columns)
    expected = [reference.step(Sample._make(row)) for row in columns.T.tolist()]
    for number, row in enumerate(zip(*found, strict=True)):
        assert bits(row) == bits(expected[number][:9])


def test_environment_switches_the_core_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CANGAUGE_PURE_PYTHON", "1")
    assert type(make_estimator(MODELS["plain"])) is Estimator


def test_health_has_the_same_bits_at_every_sample() -> None:
    reference, compiled = pair(MODELS["plain"], EstimatorSettings(initial_soc_pct=85.0))
    for number, sample in enumerate(eventful_samples()):
        reference.step(sample)
        compiled.step(sample)
        assert bits(reference.health) == bits(compiled.health), f"sample {number}"
        if not number % 97:
            assert state_of(reference) == state_of(compiled)


def test_error_of_the_health_estimator_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    _, compiled = pair(MODELS["plain"], EstimatorSettings())

    def fail(*_: object) -> None:
        raise ArithmeticError("no")

    columns = np.tile([[0.0], [10.0], [385.0], [23.0]], 100)
    columns[0] = np.arange(
        100.0
    )  # [s]: the first with a full delay line starts the health's filter
    monkeypatch.setattr("cangauge.estimation.health.HealthEstimator.use", fail)
    with pytest.raises(ArithmeticError, match="no"):
        compiled.run(columns)


def core_arguments() -> dict[str, Any]:
    """Arguments of `Core` for the model with every effect, for a test to change."""
    model, chosen = MODELS["together"], EstimatorSettings()
    constants = core_constants(model, chosen)
    assert constants is not None
    return {
        "model": constants.model | {"function_v": []}, "settings": constants.settings,
        "effects": [effect_fields(form) for form in constants.effects], "hook": None,
        "line_size": 100, "line_block": 1, "spacing_s": 1.0,
        "estimate": Estimate, "statuses": tuple(Status), "reasons": {},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("part", "name", "value"),
    [
        *(("model", name, -1) for name in ("delays", "knots", "functions", "memories")),
        *(("model", name, 1000) for name in ("delays", "knots", "functions", "memories")),
        ("model", "delays", 0), ("model", "effects", 33), ("settings", "method", 3),
        ("", "line_size", 0), ("", "line_size", -1), ("", "line_block", -2),
        ("", "line_block", 100),
    ],
)  # fmt: skip
def test_sizes_beyond_the_core_memory_are_refused(part: str, name: str, value: int) -> None:
    arguments = core_arguments()
    core.Core(**arguments)
    (arguments[part] if part else arguments)[name] = value
    with pytest.raises(ValueError, match=name if part else "line_size"):
        core.Core(**arguments)


@pytest.mark.parametrize(("name", "value"), [("lags", 6), ("lags", -1), ("kind", 99)])
def test_effect_beyond_the_core_memory_is_refused(name: str, value: int) -> None:
    arguments = core_arguments()
    arguments["effects"][0][name] = value
    with pytest.raises(ValueError, match=name):
        core.Core(**arguments)


@pytest.mark.parametrize("knots", [0, 1])
def test_curve_functions_without_knots_are_refused(knots: int) -> None:
    arguments = core_arguments()
    arguments["model"] |= {"functions": 1, "knots": knots}
    with pytest.raises(ValueError, match="knots"):
        core.Core(**arguments)


@pytest.mark.parametrize("hypotheses", [-1, 0, 3, 2**31])
def test_state_with_other_hypotheses_is_refused(hypotheses: int) -> None:
    made = core.Core(**core_arguments())
    with pytest.raises(ValueError, match="hypotheses"):
        made.set("filter", made.get("filter") | {"hypotheses": hypotheses})


def test_delay_line_needs_a_current_for_each_time() -> None:
    with pytest.raises(ValueError, match="currents"):
        core.Core(**core_arguments()).fill_line([0.0, 1.0], [0.0], 0.0)


def test_core_without_a_model_cannot_be_made() -> None:
    with pytest.raises(TypeError, match="model"):
        core.Core.__new__(core.Core)


def same_table(log: Log, model: Model, chosen: EstimatorSettings) -> None:
    """Both estimate a log with the same bits, by columns."""
    found = run_estimator(log, model, chosen)
    reference = Estimator(model, chosen)
    expected = np.array([reference.step(sample)[:9] for sample in samples_of(log)])
    columns = [
        found.time_s, found.soc_pct, found.soc_std_pct, found.soc_newton_pct,
        found.soc_coulomb_pct, found.voltage_model_v, found.residual_v,
    ]  # fmt: skip
    for column, wanted in zip(columns, expected.T, strict=False):
        np.testing.assert_array_equal(column.view(np.int64), wanted.copy().view(np.int64))
    np.testing.assert_array_equal(found.reasons, expected[:, 8])


@pytest.fixture(scope="module")
def packs(shared_data: Path) -> list[BenchPack]:
    return load(shared_data)


@pytest.mark.real
def test_held_out_trips_of_the_i3_give_the_same_bits(packs: list[BenchPack]) -> None:
    (i3,) = (pack for pack in packs if pack.name == "i3")
    model = fit(i3.training[:3], capacity_ah=60.0).model
    for log in i3.judged[:4]:
        same_table(log, model, EstimatorSettings(initial_soc_pct=80.0))


@pytest.mark.real
def test_every_pack_of_the_bench_gives_the_same_bits(packs: list[BenchPack]) -> None:
    for pack in (each for each in packs if each.role != "development"):
        capacity_ah = pack.capacity_ah or capacity_from_reference(pack.training[:1])
        model = fit(pack.training[:1], capacity_ah=capacity_ah).model
        same_table(pack.judged[-1].rows(slice(0, 800)), model, EstimatorSettings())
