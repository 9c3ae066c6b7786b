"""Functional mock-up units: valid, and equal to the Python reference in a simulator."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cangauge.cli.app import app
from cangauge.errors import CangaugeError, InputError
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.embedded.fmu import Kind, export_fmu
from cangauge.model.model_file import Model
from cangauge.model.published import leaf_2012_model_file
from cangauge.types import Sample

fmpy = pytest.importorskip("fmpy", reason="needs the simulator fmpy")
if shutil.which("cc") is None:
    pytest.skip("needs a C compiler", allow_module_level=True)

TIME_S = np.arange(0.0, 301.0)
CURRENT_A = 15.0 + 40.0 * np.sin(TIME_S / 17.0)
TEMPERATURE_C = 22.0 + TIME_S / 300.0
EFFECTS = [
    {"id": "voltage_offset", "parameters": {"offset_v": 1.5}},
    {
        "id": "resistance_soc",
        "parameters": {"at_empty": 0.5, "at_full": 0.2, "width_pct": 20.0, "delayed": 1.0},
    },
    {"id": "fast_polarization", "parameters": {"ohm": 0.02, "tau_s": 4.0, "activation_k": 900.0}},
]


def repaired() -> Model:
    """The published model with effects, one of them of a sensor."""
    return leaf_2012_model_file().model_copy(update={"effects": EFFECTS})


@pytest.fixture(scope="module")
def units(tmp_path_factory: pytest.TempPathFactory) -> dict[Kind, Path]:
    """The pack of the function, and the estimator of the command."""
    folder = tmp_path_factory.mktemp("units")
    model, unit = folder / "model.json", folder / "estimator.fmu"
    repaired().save(model)
    done = CliRunner().invoke(
        app, ["export-fmu", "-m", str(model), "-o", str(unit), "--kind", "estimator"]
    )
    assert done.exit_code == 0, done.output
    return {"pack": export_fmu(repaired(), folder / "pack.fmu", kind="pack"), "estimator": unit}


def simulate(
    unit: Path, outputs: list[str], more: dict[str, Any], *, logger: Any = None, **start: float
) -> Any:
    columns = {
        "time": TIME_S,
        "current_a": CURRENT_A,
        "temperature_c": TEMPERATURE_C,
    } | more
    given = np.array(
        list(zip(*columns.values(), strict=True)), dtype=[(name, "f8") for name in columns]
    )
    return fmpy.simulate_fmu(
        str(unit), stop_time=TIME_S[-1], step_size=1.0, output_interval=1.0, input=given,
        output=outputs, start_values=start, fmi_type="CoSimulation",
        logger=logger,
    )  # fmt: skip


def held(values: np.ndarray) -> list[float]:
    """What a unit gets at the end of each step: the input that was set before it."""
    return [*values[:1], *values[:-1]]


def pack_voltage(model: Model, initial_soc_pct: float) -> list[float]:
    effects = [effect for effect in model.effects if effect["id"] != "voltage_offset"]
    online = model.model_copy(update={"effects": effects}).online()
    volts, out_ah, last = [], 0.0, 0.0
    for time_s, current_a, temperature_c in zip(
        TIME_S.tolist(), held(CURRENT_A), held(TEMPERATURE_C), strict=True
    ):
        (now,) = online.correct(Sample(time_s, current_a, float("nan"), temperature_c))
        if volts:
            out_ah += 0.5 * (now.current_a + last) / 3600.0
        last = now.current_a
        online.advance(time_s, now.current_a, now.temperature_c)
        soc = initial_soc_pct - 100.0 * out_ah / model.capacity_ah
        volts.append(online.pseudo_ocv_at(soc)[0] + online.load_v)
    return volts


@pytest.mark.parametrize("kind", ["pack", "estimator"])
def test_the_unit_is_valid(units: dict[Any, Path], kind: Kind) -> None:
    from fmpy.validation import validate_fmu  # noqa: PLC0415

    assert validate_fmu(str(units[kind])) == []


def test_the_pack_is_the_model_within_1e_9(units: dict[Any, Path]) -> None:
    found = simulate(units["pack"], ["voltage_v"], {}, initial_soc_pct=81.0)
    np.testing.assert_allclose(found["voltage_v"], pack_voltage(repaired(), 81.0), atol=1e-9)


def test_the_estimator_is_pythons_within_1e_9(units: dict[Any, Path]) -> None:
    volts = np.array(pack_voltage(repaired(), 80.0))
    found = simulate(units["estimator"], ["soc_pct", "soc_std_pct", "status"], {"voltage_v": volts})
    estimator = Estimator(repaired(), EstimatorSettings())
    samples = zip(TIME_S.tolist(), held(CURRENT_A), held(volts), held(TEMPERATURE_C), strict=True)
    for row, sample in zip(found, samples, strict=True):
        estimator.update(Sample(*sample))
        expected = estimator.estimate
        assert row["soc_pct"] == pytest.approx(expected.soc_pct, abs=1e-9, nan_ok=True)
        assert row["soc_std_pct"] == pytest.approx(expected.soc_std_pct, abs=1e-9, nan_ok=True)
        assert row["status"] == expected.status


def test_a_diagnosed_effect_is_a_parameter(units: dict[Any, Path]) -> None:
    given = {"initial_soc_pct": 81.0, "effect_3_rc.ohm_1": 0.05}
    found = simulate(units["pack"], ["voltage_v"], {}, **given)
    polarization = {"ohm": 0.05, "tau_s": 4.0, "activation_k": 900.0}
    changed = [*EFFECTS[:2], {"id": "fast_polarization", "parameters": polarization}]
    model = repaired().model_copy(update={"effects": changed})
    np.testing.assert_allclose(found["voltage_v"], pack_voltage(model, 81.0), atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        ("pack", "capacity_ah", -5.0), ("pack", "capacity_ah", 0.0),
        ("pack", "initial_soc_pct", 175.0), ("pack", "effect_3_rc.tau_1_s", 0.0),
        ("pack", "effect_3_rc.ohm_1", float("inf")), ("pack", "effect_3_rc.mean_slope", 0.0),
        ("pack", "effect_2_resistance_soc.width_pct", 0.0),
        ("estimator", "initial_soc_pct", 150.0), ("estimator", "initial_soc_pct", float("nan")),
    ],
)  # fmt: skip
def test_a_parameter_out_of_range_is_refused(
    units: dict[Any, Path], kind: Kind, name: str, value: float
) -> None:
    told: list[str] = []

    def log(*arguments: Any) -> None:
        told.append(b" ".join(each for each in arguments if isinstance(each, bytes)).decode())

    more = {"voltage_v": 0.0 * TIME_S} if kind == "estimator" else {}
    with pytest.raises(fmpy.fmi1.FMICallException):
        simulate(units[kind], ["soc_pct"], more, logger=log, **{name: value})
    assert any("is outside" in text for text in told)


def test_the_range_of_a_parameter_is_stated(units: dict[Any, Path]) -> None:
    found = fmpy.read_model_description(str(units["pack"])).modelVariables
    limits = {item.name: (item.min, item.max) for item in found}
    assert [float(end) for end in limits["initial_soc_pct"]] == [0.0, 100.0]
    assert [float(end) for end in limits["capacity_ah"]] == [1e-3, 1e5]
    assert limits["effect_3_rc.ohm_1"] == (None, None)


def test_what_the_core_divides_by_is_positive(tmp_path: Path) -> None:
    values = {
        "core_temperature": {"rise_k": 5.0, "late": 0.1, "tau_s": 900.0},
        "charge_transfer": {
            "scale_v": 0.01,
            "exchange_a": 5.0,
            "bend_only": 1.0,
            "activation_k": 0.0,
        },
        "hysteresis": {"half_width_v": 0.005, "travel_pct": 4.0},
    }
    effects = [{"id": each, "parameters": numbers} for each, numbers in values.items()]
    model = leaf_2012_model_file().model_copy(update={"effects": effects})
    unit = export_fmu(model, tmp_path / "pack.fmu")
    found = fmpy.read_model_description(str(unit)).modelVariables
    divisors = ("effect_1_core_temperature.capacity_ah", "effect_2_charge_transfer.zero_a",
                "effect_3_hysteresis.travel_as")  # fmt: skip
    limits = {item.name: item.min for item in found if item.name in divisors}
    assert set(limits) == set(divisors)
    assert all(float(low) > 0.0 for low in limits.values())


def test_inputs_of_the_end_of_a_step_estimate_the_log(units: dict[Any, Path]) -> None:
    volts = np.array(pack_voltage(repaired(), 80.0))
    columns = {"current_a": CURRENT_A, "temperature_c": TEMPERATURE_C, "voltage_v": volts}
    # The recipe of docs/howto/export.md.
    earlier = {"time": np.concatenate(([TIME_S[0] - 1.0, TIME_S[0]], TIME_S[:-1]))}
    earlier |= {name: np.concatenate((values[:1], values)) for name, values in columns.items()}
    found = simulate(units["estimator"], ["soc_pct"], earlier)
    estimator = Estimator(repaired(), EstimatorSettings())
    samples = zip(TIME_S.tolist(), CURRENT_A, volts, TEMPERATURE_C, strict=True)
    for row, sample in zip(found, samples, strict=True):
        estimator.update(Sample(*sample))
        expected = estimator.estimate.soc_pct
        assert row["soc_pct"] == pytest.approx(expected, abs=1e-9, nan_ok=True)


def test_a_saved_state_continues_as_it_was(units: dict[Any, Path], tmp_path: Path) -> None:
    unit = units["pack"]
    description = fmpy.read_model_description(str(unit))
    fmu = fmpy.instantiate_fmu(fmpy.extract(str(unit), tmp_path), description, "CoSimulation")
    fmu.setupExperiment(startTime=0.0)
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    fmu.setReal([1], [30.0])
    fmu.doStep(0.0, 1.0)
    state = fmu.getFMUState()
    first = [_stepped(fmu, time_s) for time_s in range(1, 20)]
    fmu.setFMUState(state)
    assert [_stepped(fmu, time_s) for time_s in range(1, 20)] == first
    fmu.freeFMUState(state)
    fmu.terminate()
    fmu.freeInstance()


def _stepped(fmu: Any, time_s: float) -> float:
    fmu.doStep(float(time_s), 1.0)
    return float(fmu.getReal([3])[0])


def test_a_missing_compiler_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="no C compiler"):
        export_fmu(leaf_2012_model_file(), tmp_path / "pack.fmu")
    assert list(tmp_path.iterdir()) == []


def test_options_in_cc_reach_the_compiler(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CC", "cc --no-such-option")
    with pytest.raises(CangaugeError, match="no-such-option"):
        export_fmu(leaf_2012_model_file(), tmp_path / "pack.fmu")
    monkeypatch.setenv("CC", "no-such-compiler -m64")
    with pytest.raises(InputError, match="no-such-compiler"):
        export_fmu(leaf_2012_model_file(), tmp_path / "pack.fmu")


def test_the_command_writes_a_unit(units: dict[Any, Path]) -> None:
    description = fmpy.read_model_description(str(units["estimator"]))
    assert description.fmiVersion == "2.0"
    assert description.coSimulation.modelIdentifier.isidentifier()
    assert [item.name for item in description.modelVariables if item.causality == "input"] == [
        "current_a",
        "temperature_c",
        "voltage_v",
    ]
