"""Model file: round trip, prediction, and errors that name the field."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cangauge._resources import shared_file
from cangauge.errors import InputError
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from synthetic import synthetic_log


@pytest.fixture(scope="module")
def log() -> Log:
    return synthetic_log(hours=1.0, end_pct=60.0, noise_v=0.5)


@pytest.fixture(scope="module")
def model(log: Log) -> Model:
    return fit([log], capacity_ah=51.5).model


def test_round_trip(model: Model, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    model.save(path)
    again = Model.load(path)
    assert again == model
    assert again.voltage_model() == model.voltage_model()


def test_the_shipped_model_loads() -> None:
    assert Model.load(shared_file("replay", "leaf2012_published_model.json")).capacity_ah == 51.5


def test_predicts_a_log_from_its_reference_soc(model: Model, log: Log) -> None:
    found = model.predict(log)
    assert found.rows.size == len(log)
    assert np.array_equal(found.residual_v, log.voltage_v - found.voltage_v)
    assert np.sqrt(np.mean(found.residual_v[70:] ** 2)) == pytest.approx(0.5, rel=0.05)


def test_prediction_is_anchored_at_the_first_known_soc(model: Model, log: Log) -> None:
    assert log.soc_pct is not None
    soc_pct = np.full(len(log), np.nan)
    soc_pct[1000] = log.soc_pct[1000]
    found = model.predict(replace(log, soc_pct=soc_pct))
    assert found.soc_pct[1000] == log.soc_pct[1000]
    unknown = replace(log, soc_pct=None)
    with pytest.raises(InputError, match="unknown initial SoC"):
        model.predict(unknown)
    assert model.predict(unknown, initial_soc_pct=90.0).soc_pct[0] == 90.0


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
def test_names_the_invalid_field(model: Model, tmp_path: Path, break_it, field) -> None:
    raw = json.loads(model.to_json())
    break_it(raw)
    path = tmp_path / "broken.json"
    path.write_text(json.dumps(raw))
    with pytest.raises(InputError) as error:
        Model.load(path)
    assert error.value.source == str(path)
    assert error.value.field == field


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "[" * 100_000, '{"format": NaN}', "\x00"])
def test_refuses_other_files(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.json"
    path.write_text(text)
    with pytest.raises(InputError):
        Model.load(path)


def test_names_the_path_of_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.json.*no such file"):
        Model.load(tmp_path / "nowhere.json")
