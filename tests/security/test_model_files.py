"""Model files: impossible ones are refused by field, all others give bounded estimates."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cangauge.errors import InputError
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.model_file import Model
from live import leaf_model_path, short_log

DRIVE = list(samples_of(short_log(80.0, 1.0)))
KNOWN = EstimatorSettings(initial_soc_pct=80.0)


def leaf() -> dict[str, Any]:
    """The Leaf's model with an effect and an information matrix."""
    content: dict[str, Any] = json.loads(leaf_model_path().read_text())
    names = list(content["coefficients"])
    content["effects"] = [
        {"id": "current_offset", "parameters": {"offset_a": 0.5}},
        {
            "id": "fast_polarization",
            "parameters": {"ohm": 0.01, "tau_s": 5.0, "activation_k": 2000.0},
        },
    ]
    content["information"] = {
        "columns": names,
        "scale": [1.0] * len(names),
        "root": np.triu(np.full((len(names), len(names)), 0.5)).tolist(),
        "projected": [1.0] * len(names),
    }
    return content


def put(content: Any, place: list[Any], value: object) -> None:
    for part in place[:-1]:
        content = content[part]
    content[place[-1]] = value


@pytest.mark.parametrize(
    ("place", "value", "field", "cure"),
    [
        ("coefficients.R1.value", -1e9, "coefficients.R1.value", "unit"),
        ("coefficients.R2.value", 1e3, "coefficients.R2.value", "unit"),
        ("coefficients.R1.value", 0.1032, "coefficients", "negative"),
        ("coefficients.k0.value", -0.5, "coefficients", "unit"),
        ("coefficients.k0.value", 0.3944, "coefficients", "unit"),
        ("coefficients.k0.value", 1e5, "coefficients", "unit"),
        ("coefficients.kt.value", 50.0, "coefficients.kt.value", "unit"),
        ("capacity_ah", 5e4, "coefficients.R1.value", "capacity"),
        ("noise.fast_std_v", -1.0, "noise.fast_std_v", "fit"),
        ("noise.lasting_std_v", 5e5, "noise.lasting_std_v", "unit"),
        ("information.scale.0", 0.0, "information.scale.0", "fit"),
        ("information.scale.0", 1e-300, "information.scale.0", "fit"),
        ("information.root.0.0", 1e300, "information.root.0.0", "fit"),
        ("information.root.3.0", 1.0, "information", "fit"),
        ("information.projected.2", -1e200, "information.projected.2", "fit"),
    ],
)
def test_an_impossible_value_is_refused_by_field(
    tmp_path: Path, place: str, value: float, field: str, cure: str
) -> None:
    content = leaf()
    path = tmp_path / "model.json"
    path.write_text(json.dumps(content))
    Model.load(path)
    parts = [int(part) if part.isdecimal() else part for part in place.split(".")]
    put(content, parts, value)
    path.write_text(json.dumps(content))
    with pytest.raises(InputError) as caught:
        Model.load(path)
    assert caught.value.source == str(path)
    assert caught.value.field == field
    assert cure in (caught.value.cure or "")


def test_a_model_of_thousands_of_effects_is_refused(tmp_path: Path) -> None:
    """Each costs time at every sample; before, 4,096 took 13 s at a reload and 20 ms a sample."""
    content = leaf()
    content["effects"] = [
        {
            "id": "fast_polarization",
            "parameters": {"ohm": 1e-4, "tau_s": 0.5 + number / 1000, "activation_k": 0.0},
        }
        for number in range(4096)
    ]
    path = tmp_path / "model.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="at most 32 items"):
        Model.load(path)
    content["effects"] = content["effects"][:32]
    path.write_text(json.dumps(content))
    assert len(Model.load(path).effects) == 32


def numbers(content: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    if isinstance(content, dict):
        return [each for key, item in content.items() for each in numbers(item, (*place, key))]
    if isinstance(content, list):
        return [each for key, item in enumerate(content) for each in numbers(item, (*place, key))]
    is_number = isinstance(content, int | float) and not isinstance(content, bool)
    return [place] if is_number and place[-1] != "version" else []


PLACES = numbers(leaf())
CHANGES = st.one_of(
    st.tuples(st.just("times"), st.floats(-3.0, 3.0)),
    st.tuples(st.just("times"), st.floats(1e-6, 1e6)),
    st.tuples(st.just("is"), st.sampled_from([0.0, -1.0, 1.0, 1e-300, 1e300, 1e12, -1e12, 1e6])),
)


@settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(changes=st.lists(st.tuples(st.sampled_from(PLACES), CHANGES), min_size=1, max_size=3))
def test_a_changed_model_is_refused_or_gives_bounded_estimates(
    tmp_path: Path, changes: list[tuple[tuple[Any, ...], tuple[str, float]]]
) -> None:
    content = leaf()
    for place, (how, amount) in changes:
        old = content
        for part in place:
            old = old[part]
        put(content, list(place), old * amount if how == "times" else amount)  # type: ignore[operator] # a number
    path = tmp_path / "model.json"
    path.write_text(json.dumps(content))
    try:
        model = Model.load(path)
    except InputError as error:
        assert error.source == str(path)  # noqa: PT017 - refused or not, both are right
        return
    estimator = Estimator(model, KNOWN)
    for sample in DRIVE:
        estimator.update(sample)
        estimate = estimator.estimate
        assert -10.0 <= estimate.soc_pct <= 110.0
        assert 0.0 <= estimate.soc_std_pct < 1000.0
        assert math.isfinite(estimate.voltage_model_v)
        assert not math.isinf(estimate.residual_v)  # NaN: the voltage is refused
