"""The compiled core gives the numbers of the reference implementation, within 1e-9."""

from __future__ import annotations

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
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.effects.library import LIBRARY
from cangauge.model.model_file import Model
from cangauge.types import Sample
from estimation.test_any_input import METHODS, MODELS, RULES, inputs, samples_of_rows
from estimation.test_snapshot import eventful_samples
from selection import nightly_except

core = pytest.importorskip("cangauge._core", reason="the extension was not built: no C compiler")

ROOT = Path(__file__).parents[2]
TOLERANCE = 1e-9
"""Largest error [%, V], relative above 1."""
KNOTS = Model.prior("oxide", 96, 60.0)
STARTS = st.sampled_from([None, 0.0, 50.0, 100.0])


def pair(model: Model, chosen: EstimatorSettings) -> tuple[Estimator, CompiledEstimator]:
    compiled = make_estimator(model, chosen)
    assert isinstance(compiled, CompiledEstimator)
    return Estimator(model, chosen), compiled


def assert_same(found: Any, expected: Any, at: str = "", scale: float = 1.0) -> None:
    """Compare numbers, and structures of them, within the tolerance."""
    if isinstance(expected, list | tuple):
        assert len(found) == len(expected), at
        sizes = [abs(each) for each in expected if isinstance(each, float) and math.isfinite(each)]
        for number, (one, other) in enumerate(zip(found, expected, strict=True)):
            assert_same(one, other, f"{at}[{number}]", max([scale, *sizes]))
    elif isinstance(expected, float):
        close = abs(found - expected) <= TOLERANCE * max(1.0, scale, abs(expected))
        assert close or found == expected or (math.isnan(found) and math.isnan(expected)), (
            f"{at}: {found} {expected}"
        )
    else:
        assert found == expected, at


def follow(reference: Estimator, compiled: Estimator, samples: Iterable[Sample]) -> None:
    """Hand the same samples to both and compare each estimate."""
    for number, sample in enumerate(samples):
        assert_same(compiled.step(sample), reference.step(sample), f"sample {number}: {sample}")


def assert_same_state(reference: Estimator, compiled: Estimator) -> None:
    assert_same(compiled.health, reference.health)
    assert_same(compiled.power(), reference.power())
    assert compiled.row == reference.row


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


@pytest.mark.parametrize(
    ("which", "method"),
    nightly_except(
        [("together", "ekf"), ("plain", "newton"), ("plain", "coulomb")],
        [(which, method) for which in ("plain", "together") for method in METHODS],
    ),
)
@settings(max_examples=8, suppress_health_check=list(HealthCheck))
@given(drawn=inputs, with_rules=st.booleans(), start=STARTS)
def test_any_input_gives_the_same_numbers(
    which: str, method: Any, drawn: Any, with_rules: bool, start: Any
) -> None:
    chosen = EstimatorSettings(
        method=method, initial_soc_pct=start, **(RULES if with_rules else {})
    )
    reference, compiled = pair(MODELS[which], chosen)
    follow(reference, compiled, samples_of_rows(drawn))
    assert_same_state(reference, compiled)


@pytest.mark.parametrize("effect_id", LIBRARY)
def test_each_effect_and_a_restart(effect_id: str) -> None:
    chosen = EstimatorSettings(initial_soc_pct=85.0)
    reference, compiled = pair(MODELS[effect_id], chosen)
    samples = eventful_samples()  # until after their long gap, and around the clock's step back
    follow(reference, compiled, samples[:480])
    assert_same_state(reference, compiled)
    now = samples[479]
    assert_same(compiled.pack_tick(now), reference.pack_tick(now))
    stamps = [now.time_s - 3.0, math.nan]
    assert_same(
        compiled.current_changes(now.time_s, stamps), reference.current_changes(now.time_s, stamps)
    )
    after = pair(MODELS[effect_id], chosen)
    for before, again in zip((reference, compiled), after, strict=True):
        again.restore(before.snapshot(), 5.0)
    follow(*after, samples[880:940])


@pytest.mark.parametrize("start", [None, 85.0])
def test_curve_of_knots(start: float | None) -> None:
    reference, compiled = pair(KNOTS, EstimatorSettings(initial_soc_pct=start))
    assert KNOTS.equation == "knots"
    for first in range(0, 1400, 200):
        follow(reference, compiled, eventful_samples()[first : first + 200])
        assert_same_state(reference, compiled)


def test_another_model_takes_over() -> None:
    before = pair(MODELS["plain"], EstimatorSettings(initial_soc_pct=85.0))
    after = pair(MODELS["together"], EstimatorSettings(method="coulomb"))
    samples = eventful_samples()
    follow(*before, samples[:500])
    for old, new in zip(before, after, strict=True):
        new.take_over(old)
    follow(*after, samples[500:])


def test_the_age_of_a_restored_state_survives_another_model() -> None:
    """Stamps that begin anew are followed where the state is known to be old."""
    chosen, samples = EstimatorSettings(initial_soc_pct=85.0), eventful_samples()
    stopped = pair(MODELS["plain"], chosen)
    follow(*stopped, samples[:300])
    restored, after = pair(MODELS["plain"], chosen), pair(KNOTS, chosen)
    for before, again, other in zip(stopped, restored, after, strict=True):
        again.restore(before.snapshot(), 3600.0)
        other.take_over(again)
    follow(*after, samples[:100])
    refused = 300 - stopped[1].estimate.samples
    assert after[1].estimate.samples == 400 - refused


def test_columns_give_the_same_bits_as_samples() -> None:
    columns = np.array(eventful_samples()).T
    (_, whole), (_, single) = (pair(KNOTS, EstimatorSettings()) for _ in range(2))
    found = np.array(whole.run(columns)).T
    for got, sample in zip(found, columns.T.tolist(), strict=True):
        row, expected = single.row, np.array(single.step(Sample._make(sample))[:9])
        if single.row == row:
            expected[5:7] = np.nan  # voltage and residual stand in the rows of their own alone
        np.testing.assert_array_equal(got, expected)


def test_environment_switches_the_core_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CANGAUGE_PURE_PYTHON", "1")
    assert type(make_estimator(KNOTS)) is Estimator


@pytest.mark.parametrize(
    "constants", [{"colour": np.ones(1)}, {"delay_s": np.ones(65)}, {"load": np.ones((2, 2))}]
)
def test_constants_that_the_core_has_no_place_for_are_refused(constants: Any) -> None:
    with pytest.raises(ValueError, match=f"no place for {next(iter(constants))}"):
        core.Core(constants, {}, 1, 0, 1.0, tuple, (), {})


def test_a_model_beyond_the_cores_memory_is_estimated_in_python() -> None:
    raw = KNOTS.model_dump()
    raw["loads"] |= {"delays_s": list(range(66)), "resistance_ohm": [-1e-3] * 68, "arrhenius": None}
    raw["functions"]["load"] = np.zeros((8, 69)).tolist()
    assert type(make_estimator(Model.model_validate(raw))) is Estimator
