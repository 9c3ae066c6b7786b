"""The model file: what is written is what is read; what is wrong is named."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cangauge.errors import InputError
from cangauge.identify.fit import fit
from cangauge.identify.rows import FitOptions
from cangauge.model.model_file import Model, load_model, model_json
from synthetic import synthetic_log


@pytest.fixture(scope="module")
def model() -> Model:
    log = synthetic_log(hours=1.0, end_pct=60.0, noise_v=0.5)
    return fit([log], FitOptions(capacity_ah=51.5)).model


def test_round_trip(model: Model, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    path.write_text(model_json(model))
    again = load_model(path)
    assert again == model
    assert again.voltage_model() == model.voltage_model()


@pytest.mark.parametrize(
    ("break_it", "field"),
    [
        (lambda raw: raw.update(version=99), "version"),
        (lambda raw: raw.update(format="other"), "format"),
        (lambda raw: raw.pop("capacity_ah"), "capacity_ah"),
        (lambda raw: raw.update(capacity_ah=-1.0), "capacity_ah"),
        (lambda raw: raw["coefficients"]["k3"].update(value="many"), "coefficients.k3.value"),
        (lambda raw: raw["coefficients"].pop("R2"), None),
        (lambda raw: raw.update(delays_s=[0.0, 30.0, 10.0, 70.0]), "delays_s"),
        (lambda raw: raw["coefficients"]["k5"].update(value=-1e5), "coefficients"),
        (lambda raw: raw.update(effects=[{"id": "hysteresis"}]), "effects.0"),
        (lambda raw: raw.update(surprise=1), "surprise"),
        (lambda raw: raw["information"]["scale"].pop(), "information"),
    ],
)
def test_names_the_broken_field(model: Model, tmp_path: Path, break_it, field) -> None:
    raw = json.loads(model_json(model))
    break_it(raw)
    path = tmp_path / "broken.json"
    path.write_text(json.dumps(raw))
    with pytest.raises(InputError) as error:
        load_model(path)
    assert error.value.source == str(path)
    assert error.value.field == field


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "[" * 100_000, '{"format": NaN}', "\x00"])
def test_refuses_what_is_no_model(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.json"
    path.write_text(text)
    with pytest.raises(InputError):
        load_model(path)


def test_says_where_a_missing_file_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.json.*no such file"):
        load_model(tmp_path / "nowhere.json")
