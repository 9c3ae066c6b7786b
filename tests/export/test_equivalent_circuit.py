"""Equivalent circuit of a model: tables, module, and the voltage that other simulators compute."""

from __future__ import annotations

import json
import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cangauge.cli.app import app
from cangauge.errors import InputError
from cangauge.extras.embedded.equivalent_circuit import equivalent_circuit, module_of
from cangauge.logs.log import Log
from cangauge.model.first_order import low_passed
from cangauge.model.model_file import Model
from cangauge.model.published import leaf_2012_model_file
from synthetic import synthetic_log

TEMPERATURE_C = 23.0


def with_effect(name: str, **parameters: float) -> Model:
    effects = [{"id": name, "parameters": parameters}]
    return leaf_2012_model_file().model_copy(update={"effects": effects})


@pytest.fixture(scope="module")
def log() -> Log:
    drive = synthetic_log(hours=0.5, start_pct=80.0, end_pct=60.0, seed=3)
    return replace(
        drive,
        temperature_c=np.full(len(drive), TEMPERATURE_C),
        # At rest, as the circuit begins.
        current_a=np.where(drive.time_s < 100.0, 0.0, drive.current_a),
    )


@pytest.fixture
def exported(tmp_path: Path) -> dict[str, Any]:
    path = tmp_path / "pack.py"
    path.write_text(module_of(equivalent_circuit(leaf_2012_model_file())), encoding="utf-8")
    return runpy.run_path(str(path))


def mean_error_pct(volts: np.ndarray, log: Log) -> float:
    ours = leaf_2012_model_file().predict(log).voltage_v
    return 100.0 * float(np.mean(np.abs(volts - ours)) / ours.mean())


def test_the_circuit_follows_the_model(exported: dict[str, Any], log: Log) -> None:
    pack = exported["thevenin_parameters"](80.0, TEMPERATURE_C)
    soc = leaf_2012_model_file().predict(log).soc_pct / 100.0
    volts = pack["ocv"](soc) - pack["R0"](0.5, 296.0) * log.current_a
    for k in range(1, pack["num_RC_pairs"] + 1):
        ohm, farad = pack[f"R{k}"](0.5, 296.0), pack[f"C{k}"](0.5, 296.0)
        volts = volts - ohm * low_passed(log.time_s, log.current_a, ohm * farad, 0.0)
    assert mean_error_pct(volts, log) < 0.1


def test_resistances_add_up_to_the_lasting_one() -> None:
    model = leaf_2012_model_file()
    circuit = equivalent_circuit(model)
    total = np.array(circuit["series_ohm"]) + np.sum(circuit["pair_ohm"], axis=0)
    assert total == pytest.approx(-sum(model.voltage_model().resistance_ohm), rel=0.02)
    assert 0.0 < circuit["step_error_pct"] < 2.0


def test_an_rc_effect_is_a_pair_of_the_circuit() -> None:
    parameters = {"ohm": 0.02, "tau_s": 6.0, "activation_k": 0.0}
    model = with_effect("fast_polarization", **parameters)
    assert model.published is not None
    kept = {name: of for name, of in model.coefficients.items() if name not in "R2R3R4"}
    published = model.published.model_copy(update={"delays_s": [0.0], "coefficients": kept})
    model = model.model_copy(update={"published": published})
    circuit = equivalent_circuit(model)
    assert circuit["pair_tau_s"] == pytest.approx([6.0])
    assert np.array(circuit["pair_ohm"]) == pytest.approx(0.02, rel=1e-6)
    assert circuit["step_error_pct"] < 1e-6


def test_a_resistance_that_bends_with_current_is_in_the_table() -> None:
    model = with_effect(
        "charge_transfer", scale_v=5.0, exchange_a=10.0, bend_only=0.0, activation_k=0.0
    )
    circuit = equivalent_circuit(model)
    small, large = (
        np.interp(amperes, circuit["current_a"], np.array(circuit["series_ohm"])[0, :, 5])
        for amperes in (0.05 * circuit["capacity_ah"], 2.0 * circuit["capacity_ah"])
    )
    by_hand = 5.0 * np.arcsinh(np.array([2.575, 103.0]) / 20.0) / np.array([2.575, 103.0])
    assert small - large == pytest.approx(by_hand[0] - by_hand[1], rel=0.02)


@pytest.mark.parametrize(
    "model",
    [
        leaf_2012_model_file(),
        with_effect(
            "charge_transfer", scale_v=5.0, exchange_a=10.0, bend_only=0.0, activation_k=0.0
        ),
    ],
)
def test_a_model_of_one_temperature_has_increasing_axes(model: Model) -> None:
    narrow = model.range.model_copy(update={"temperature_c": (TEMPERATURE_C, TEMPERATURE_C)})
    circuit = equivalent_circuit(model.model_copy(update={"range": narrow}))
    assert np.diff(circuit["temperature_c"]).min() > 0.0
    assert np.mean(circuit["temperature_c"]) == pytest.approx(TEMPERATURE_C)
    assert np.diff(circuit["current_a"]).min() > 0.0


def test_thevenin_computes_the_voltage(exported: dict[str, Any], log: Log) -> None:
    thevenin = pytest.importorskip("thevenin", reason="needs the simulator thevenin")
    run = thevenin.Experiment(max_step=10.0)
    run.add_step("current_A", lambda t: float(np.interp(t, log.time_s, log.current_a)), log.time_s)
    found = thevenin.Simulation(exported["thevenin_parameters"](80.0, TEMPERATURE_C)).run(run)
    volts = np.interp(log.time_s, found.vars["time_s"], found.vars["voltage_V"])
    assert mean_error_pct(volts, log) < 0.1


def test_pybamm_computes_the_voltage(exported: dict[str, Any], log: Log) -> None:
    pybamm = pytest.importorskip("pybamm", reason="needs the simulator PyBaMM")
    values = exported["pybamm_parameters"](80.0, TEMPERATURE_C)
    values["Current function [A]"] = pybamm.Interpolant(log.time_s, log.current_a, pybamm.t)
    circuit = pybamm.equivalent_circuit.Thevenin(
        options={"number of rc elements": exported["PAIRS"]}
    )
    found = pybamm.Simulation(circuit, parameter_values=values).solve(
        [0.0, float(log.time_s[-1])], t_interp=log.time_s
    )
    assert mean_error_pct(np.asarray(found["Voltage [V]"](t=log.time_s)), log) < 0.1


@pytest.mark.parametrize("soc_pct", [190.0, -1.0, float("nan")])
def test_an_initial_soc_beyond_the_pack_is_refused(
    exported: dict[str, Any], soc_pct: float
) -> None:
    with pytest.raises(ValueError, match="initial_soc_pct"):
        exported["thevenin_parameters"](soc_pct)


def test_the_command_writes_tables_or_a_module(tmp_path: Path) -> None:
    model, tables = tmp_path / "model.json", tmp_path / "tables.json"
    leaf_2012_model_file().save(model)
    run = CliRunner().invoke(app, ["export-ecm", "-m", str(model), "-o", str(tables), "--json"])
    assert run.exit_code == 0
    assert json.loads(run.stdout)["pairs"] == len(json.loads(tables.read_text())["pair_tau_s"])
    module = tmp_path / "pack.py"
    assert (
        CliRunner().invoke(app, ["export-ecm", "-m", str(model), "-o", str(module)]).exit_code == 0
    )
    assert callable(runpy.run_path(str(module))["pybamm_parameters"])


@pytest.mark.parametrize("name", ["my-pack.py", "class.py", "pack.txt"])
def test_a_module_that_cannot_be_imported_is_refused(tmp_path: Path, name: str) -> None:
    leaf_2012_model_file().save(tmp_path / "model.json")
    arguments = ["export-ecm", "-m", str(tmp_path / "model.json"), "-o", str(tmp_path / name)]
    assert isinstance(CliRunner().invoke(app, arguments).exception, InputError)
    assert not (tmp_path / name).exists()
