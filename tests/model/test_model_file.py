"""Model file: round trip, prediction, and errors that name the field."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cangauge._resources import shared_file
from cangauge.errors import InputError
from cangauge.estimation.offline import estimate
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.curve import KNOTS_PCT, hermite_basis
from cangauge.model.model_file import Model
from synthetic import synthetic_log, voltage_of


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
    soc, currents = np.array([3.0, 50.0, 99.0]), np.full((3, 6), 20.0)
    assert np.array_equal(
        voltage_of(again.voltage_model(), soc, [5.0, 20.0, 30.0], currents),
        voltage_of(model.voltage_model(), soc, [5.0, 20.0, 30.0], currents),
    )


def test_models_that_have_estimated_are_compared_by_their_fields(model: Model, log: Log) -> None:
    again = Model.model_validate_json(model.to_json())
    for each in (model, again):
        estimate(log.rows(slice(0, 100)), each)
    assert again == model
    assert again.model_copy(update={"capacity_ah": 50.0}) != model


def test_information_holds_the_coefficients(model: Model) -> None:
    found = model.information
    assert found is not None
    assert model.curve is not None
    assert model.loads is not None
    theta = dict(zip(found.columns, np.linalg.solve(found.root, found.projected), strict=True))
    assert theta["knot_50"] == pytest.approx(model.curve.voltage_v[KNOTS_PCT.tolist().index(50)])
    assert theta["R1"] == pytest.approx(model.loads.resistance_ohm[0])
    assert theta["b"] == pytest.approx(model.loads.arrhenius.factor)


def test_functions_reproduce_the_covariance_of_the_voltage(model: Model) -> None:
    assert model.information is not None
    functions = model.functions
    voltage = model.voltage_model()
    covariance = np.linalg.inv(np.array(model.information.root))
    covariance = covariance @ covariance.T
    for soc in (20.0, 50.0, 80.0):
        columns = voltage.load_columns([10.0], np.full((1, 6), 15.0))[0]
        row = np.r_[hermite_basis(np.array([soc]))[0], columns]
        exact = row @ covariance @ row
        reduced = float(np.sum(functions.row(soc, columns) ** 2))
        assert reduced == pytest.approx(exact, rel=0.05)


def test_prints_where_it_holds_and_how_well(model: Model) -> None:
    """With `print`, and in a notebook."""
    corrected = model.model_validate(model.model_dump() | {"effects": [offset_a(1.0)]})
    for text in (str(corrected), repr(corrected)):
        for part in ("oxide", "% SoC", "°C", "voltage error", "effects: current_offset"):
            assert part in text
        assert len(text) < 250


def test_prior_is_a_model_of_its_chemistry() -> None:
    model = Model.prior("lfp", cells=16, capacity_ah=100.0)
    assert model.voltage_model().nominal_v == pytest.approx(16 * 3.29, rel=0.01)
    assert model.noise.level_std_v == pytest.approx(0.008 * 16 * 3.29, rel=0.01)
    functions = model.functions
    zero = np.zeros(len(model.voltage_model().load_coefficients))
    std_v = float(np.sqrt(np.sum(functions.row(100.0, zero) ** 2)))
    assert std_v == pytest.approx(0.02 * 16 * 3.29, rel=0.05)


def test_the_shipped_model_loads() -> None:
    model = Model.load(shared_file("replay", "leaf2012_published_model.json"))
    assert (model.version, model.equation, model.capacity_ah) == (2, "published", 51.5)
    assert model.coefficients["k0"].value == 394.4
    assert model.noise.slow_time_s == 300.0


def test_predicts_a_log_from_its_reference_soc(model: Model, log: Log) -> None:
    found = model.predict(log)
    assert found.rows.size == len(log)
    assert np.array_equal(found.residual_v, log.voltage_v - found.voltage_v)
    # 0.5 V of noise; the published kt is eight standard deviations from the prior of a cell.
    assert 0.45 < np.sqrt(np.mean(found.residual_v[70:] ** 2)) < 0.6


def test_prediction_is_anchored_at_the_first_known_soc(model: Model, log: Log) -> None:
    assert log.soc_pct is not None
    soc_pct = np.full(len(log), np.nan)
    soc_pct[1000] = log.soc_pct[1000]
    found = model.predict(replace(log, soc_pct=soc_pct))
    assert found.soc_pct[1000] == log.soc_pct[1000]
    unknown = replace(log, soc_pct=None)
    with pytest.raises(InputError, match=r"the SoC at the start is unknown.*give initial_soc_pct"):
        model.predict(unknown)
    assert model.predict(unknown, initial_soc_pct=90.0).soc_pct[0] == 90.0


def offset_a(value: object) -> dict[str, object]:
    return {"id": "current_offset", "parameters": {"offset_a": value}}


@pytest.mark.parametrize(
    ("break_it", "field"),
    [
        (lambda raw: raw.update(version=99), "version"),
        (lambda raw: raw.update(version=[]), "version"),
        (lambda raw: raw.update(format="other"), "format"),
        (lambda raw: raw.pop("capacity_ah"), "capacity_ah"),
        (lambda raw: raw.update(capacity_ah=-1.0), "capacity_ah"),
        (lambda raw: raw.update(equation="other"), "equation"),
        (lambda raw: raw.update(chemistry="lead"), "chemistry"),
        (lambda raw: raw["curve"]["voltage_v"].pop(), "curve.voltage_v"),
        (lambda raw: raw["curve"]["voltage_v"].insert(3, "many"), "curve.voltage_v.3"),
        (lambda raw: raw["curve"].update(voltage_v=[3.7e4] * 28), "curve.voltage_v"),
        (lambda raw: raw["loads"].update(delays_s=[0.0, 30.0, 10.0, 70.0]), "loads.delays_s"),
        *(
            (lambda raw, name=name: raw["loads"].pop(name), f"loads.{name}")
            for name in ("t_ref_c", "delays_s", "low_pass_s", "arrhenius")
        ),
        (lambda raw: raw["loads"]["resistance_ohm"].pop(), "loads.resistance_ohm"),
        (lambda raw: raw["loads"].update(resistance_ohm=[9.0] * 6), "loads.resistance_ohm.0"),
        (lambda raw: raw["loads"]["arrhenius"].update(factor=1e300), "loads.arrhenius.factor"),
        (lambda raw: raw["loads"]["arrhenius"].update(more=1), "loads.arrhenius.more"),
        (lambda raw: raw["range"].update(temperature_c=[50.0, 20.0]), "range.temperature_c"),
        (lambda raw: raw["noise"].update(level_std_v=-1.0), "noise.level_std_v"),
        (lambda raw: raw["functions"]["load"].pop(), "functions.load"),
        (lambda raw: raw.update(effects=[{"id": "hysteresis"}]), "effects.0"),
        (lambda raw: raw.update(effects=[offset_a(1.0), offset_a(2.0)]), "effects.1.id"),
        (lambda raw: raw.update(effects=[offset_a("x")]), "effects.0.parameters.offset_a"),
        (lambda raw: raw.update(surprise=1), "surprise"),
        (lambda raw: raw["information"]["root"].pop(), "information.root"),
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
    assert error.value.cure


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "[" * 100_000, '{"format": NaN}', "\x00"])
def test_refuses_other_files(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.json"
    path.write_text(text)
    with pytest.raises(InputError):
        Model.load(path)


def test_shows_what_a_misspelt_parameter_of_an_effect_is(model: Model, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    effect = {"id": "current_offset", "parameters": {"ofset_a": 1.0}}
    path.write_text(json.dumps(json.loads(model.to_json()) | {"effects": [effect]}))
    with pytest.raises(InputError, match=r"has the fields offset_a only \(got .*ofset_a"):
        Model.load(path)


def test_a_file_of_version_1_is_refused_with_the_cure(model: Model, tmp_path: Path) -> None:
    path = tmp_path / "old.json"
    path.write_text(json.dumps(json.loads(model.to_json()) | {"version": 1}))
    with pytest.raises(InputError, match=r"fit again"):
        Model.load(path)


def test_half_of_a_surrogate_pair_is_no_name(model: Model, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text(json.dumps(json.loads(model.to_json()) | {"name": "a\ud800"}))
    with pytest.raises(InputError, match="surrogates not allowed"):
        Model.load(path)


def test_names_the_path_of_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.json: no such file; .*`cangauge fit`"):
        Model.load(tmp_path / "nowhere.json")
