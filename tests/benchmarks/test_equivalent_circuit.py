"""Equivalent circuit of the peers: it follows the model, over all its tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cangauge.logs.log import Log
from cangauge.model.first_order import low_passed
from cangauge.model.model_file import Model
from cangauge.model.published import leaf_2012_model_file
from equivalent_circuit import equivalent_circuit
from peer_filters import Circuit
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


def test_the_circuit_follows_the_model(log: Log) -> None:
    model = leaf_2012_model_file()
    ours = model.predict(log)
    circuit = Circuit(equivalent_circuit(model) | {"noise_v": 0.0}, TEMPERATURE_C)
    volts = np.interp(ours.soc_pct / 100.0, circuit.soc, circuit.ocv_v)
    volts = volts - circuit.series_ohm * log.current_a
    for ohm, tau_s in zip(circuit.pair_ohm, circuit.tau_s, strict=True):
        volts = volts - ohm * low_passed(log.time_s, log.current_a, tau_s, 0.0)
    assert np.mean(np.abs(volts - ours.voltage_v)) < 0.001 * ours.voltage_v.mean()


def test_resistances_add_up_to_the_lasting_one() -> None:
    model = leaf_2012_model_file()
    circuit = equivalent_circuit(model)
    total = np.array(circuit["series_ohm"]) + np.sum(circuit["pair_ohm"], axis=0)
    assert total == pytest.approx(-sum(model.voltage_model().loads.resistance_ohm), rel=0.02)
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
