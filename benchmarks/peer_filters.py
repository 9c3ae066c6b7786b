"""Filters and models of other packages, one sample at a time, in an environment of their own.

    python peer_filters.py NAME WORK.json

WORK.json has the tables of `equivalent_circuit`, the logs and what to do; the result is JSON on
stdout. Called by `peers.py`; needs numpy, filterpy and the package of that name, not cangauge.
Positive current discharges.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from typing import Any

import numpy as np

START_STD_PCT = 10.0
"""Standard deviation of a start found from the first voltage [% SoC]."""
CURRENT_STD_A = 1.0
"""Standard deviation of a measured current [A]: the process noise of every peer."""

Log = dict[str, Any]
Step = Callable[[float, float, float], float]
"""Seconds since the last sample, current [A], voltage [V] → SoC [%]."""


class Circuit:
    """The equivalent circuit at one temperature and its usual current."""

    def __init__(self, tables: dict[str, Any], temperature_c: float) -> None:
        curves, at_c = np.array(tables["ocv_v"]), tables["temperature_c"]
        self.soc = np.array(tables["curve_soc_pct"]) / 100.0
        self.ocv_v = np.array([np.interp(temperature_c, at_c, each) for each in curves.T])
        self.slope_v = np.gradient(self.ocv_v, self.soc)
        ohm = [np.array(table) for table in (tables["series_ohm"], *tables["pair_ohm"])]
        middle = len(tables["soc_pct"]) // 2
        usual = int(np.searchsorted(tables["current_a"], tables["capacity_ah"] / 3.0))
        self.series_ohm, *self.pair_ohm = (
            float(np.interp(temperature_c, at_c, table[:, usual, middle])) for table in ohm
        )
        self.tau_s = np.array(tables["pair_tau_s"])
        self.pair_ohm = np.array(self.pair_ohm)
        self.capacity_as = 3600.0 * tables["capacity_ah"]
        self.noise_v = float(tables["noise_v"])

    def start(self, log: Log) -> float:
        """Return the SoC of the first voltage, without polarisation [0–1]."""
        at_rest_v = log["voltage_v"][0] + self.series_ohm * log["current_a"][0]
        return float(np.clip(np.interp(at_rest_v, self.ocv_v, self.soc), 0.01, 0.99))


def bare_ekf(circuit: Circuit, soc: float) -> Step:
    """Return a step of filterpy's extended Kalman filter over SoC and the RC pairs."""
    from filterpy.kalman import ExtendedKalmanFilter  # noqa: PLC0415

    size = 1 + len(circuit.tau_s)
    ekf = ExtendedKalmanFilter(dim_x=size, dim_z=1)
    ekf.x[:] = 0.0
    ekf.x[0] = soc
    ekf.P = np.diag([(START_STD_PCT / 100.0) ** 2, *[1e-6] * (size - 1)])
    ekf.R[:] = circuit.noise_v**2
    known: dict[str, float] = {"seconds": -1.0, "amperes": 0.0}
    gain = np.zeros((size, 1))
    jacobian = -np.ones((1, size))

    def slope(x: np.ndarray) -> np.ndarray:
        jacobian[0, 0] = np.interp(x[0, 0], circuit.soc, circuit.slope_v)
        return jacobian

    def predicted(x: np.ndarray) -> np.ndarray:
        volts = (
            np.interp(x[0, 0], circuit.soc, circuit.ocv_v) - circuit.series_ohm * known["amperes"]
        )
        return np.array([[volts - x[1:, 0].sum()]])

    def step(seconds: float, amperes: float, volts: float) -> float:
        if seconds != known["seconds"]:
            decay = np.exp(-seconds / circuit.tau_s)
            ekf.F = np.diag([1.0, *decay])
            gain[:, 0] = [-seconds / circuit.capacity_as, *(circuit.pair_ohm * (1.0 - decay))]
            ekf.B, ekf.Q = gain, gain @ gain.T * CURRENT_STD_A**2
            known["seconds"] = seconds
        known["amperes"] = amperes
        ekf.predict(amperes)
        ekf.update(np.array([[volts]]), slope, predicted)
        return 100.0 * float(ekf.x[0, 0])

    ekf.x = ekf.x.reshape(size, 1)
    return step


def progpy_ukf(circuit: Circuit, soc: float) -> Step:
    """Return a step of ProgPy's unscented filter over the same circuit."""
    from progpy import PrognosticsModel  # noqa: PLC0415
    from progpy.state_estimators import UnscentedKalmanFilter  # noqa: PLC0415
    from progpy.uncertain_data import MultivariateNormalDist  # noqa: PLC0415

    pairs = [f"v{k}" for k in range(len(circuit.tau_s))]

    class Pack(PrognosticsModel):
        inputs, states, outputs, events = ["i"], ["soc", *pairs], ["v"], []
        default_parameters = {"x0": dict.fromkeys(["soc", *pairs], 0.0)}  # noqa: RUF012
        amperes = 0.0

        def next_state(self, x: Any, u: Any, dt: float) -> Any:
            decay = np.exp(-dt / circuit.tau_s)
            values = {"soc": x["soc"] - u["i"] * dt / circuit.capacity_as}
            for name, part, ohm in zip(pairs, decay, circuit.pair_ohm, strict=True):
                values[name] = part * x[name] + (1.0 - part) * ohm * u["i"]
            return self.StateContainer(values)

        def output(self, x: Any) -> Any:
            volts = np.interp(x["soc"], circuit.soc, circuit.ocv_v)
            volts = volts - circuit.series_ohm * self.amperes - sum(x[name] for name in pairs)
            return self.OutputContainer({"v": volts})

    model = Pack(process_noise=0, measurement_noise=0)
    size = 1 + len(pairs)
    start = MultivariateNormalDist(
        ["soc", *pairs], [soc, *[0.0] * len(pairs)],
        np.diag([(START_STD_PCT / 100.0) ** 2, *[1e-4] * len(pairs)]),
    )  # fmt: skip
    gain = np.array([1.0 / circuit.capacity_as, *(circuit.pair_ohm / circuit.tau_s)])
    noise = np.diag(gain**2) * CURRENT_STD_A**2 + 1e-12 * np.eye(size)
    ukf = UnscentedKalmanFilter(model, start, Q=noise, R=np.array([[circuit.noise_v**2]]))
    now = [0.0]

    def step(seconds: float, amperes: float, volts: float) -> float:
        now[0] += max(seconds, 1e-9)
        model.amperes = amperes
        given = model.InputContainer({"i": amperes}), model.OutputContainer({"v": volts})
        ukf.estimate(now[0], *given, dt=max(seconds, 1e-9))
        return 100.0 * float(ukf.x.mean["soc"])

    return step


def thevenin_step(circuit: Circuit, soc: float) -> Step:
    """Return a step of `thevenin`'s prediction: the model alone, no filter."""
    import thevenin  # noqa: PLC0415

    parameters = {
        "num_RC_pairs": len(circuit.tau_s), "soc0": soc, "capacity": circuit.capacity_as / 3600.0,
        "ce": 1.0, "gamma": 0.0, "mass": 1.0, "isothermal": True, "Cp": 1e3, "T_inf": 298.15,
        "h_therm": 10.0, "A_therm": 1.0, "M_hyst": lambda part: 0.0 * part,
        "ocv": lambda part: np.interp(part, circuit.soc, circuit.ocv_v),
        "R0": lambda _soc, _kelvin: circuit.series_ohm,
    }  # fmt: skip
    for k, (ohm, tau_s) in enumerate(zip(circuit.pair_ohm, circuit.tau_s, strict=True), start=1):
        parameters[f"R{k}"] = lambda _soc, _kelvin, ohm=ohm: ohm
        parameters[f"C{k}"] = lambda _soc, _kelvin, farad=tau_s / ohm: farad
    model = thevenin.Prediction(parameters)
    state = [thevenin.TransientState(soc, 298.15, 0.0, np.zeros(len(circuit.tau_s)))]

    def step(seconds: float, amperes: float, _volts: float) -> float:
        if seconds > 0.0:
            state[0] = model.take_step(state[0], amperes, seconds)
        return 100.0 * float(state[0].soc)

    return step


def pybamm_step(circuit: Circuit, soc: float) -> Step:
    """Return a step of PyBaMM's Thevenin model: the model alone, no filter."""
    import pybamm  # noqa: PLC0415

    values = {
        "chemistry": "ecm", "Initial SoC": soc, "Initial temperature [K]": 298.15,
        "Ambient temperature [K]": 298.15, "Cell capacity [A.h]": circuit.capacity_as / 3600.0,
        "Nominal cell capacity [A.h]": circuit.capacity_as / 3600.0,
        "Current function [A]": "[input]", "Upper voltage cut-off [V]": 1e4,
        "Lower voltage cut-off [V]": 0.0, "Cell thermal mass [J/K]": 1e9,
        "Cell-jig heat transfer coefficient [W/K]": 10.0, "Jig thermal mass [J/K]": 1e9,
        "Jig-air heat transfer coefficient [W/K]": 10.0, "R0 [Ohm]": circuit.series_ohm,
        "Open-circuit voltage [V]": lambda x: pybamm.Interpolant(circuit.soc, circuit.ocv_v, x),
        "Entropic change [V/K]": lambda _v, _c: pybamm.Scalar(0.0),
    }  # fmt: skip
    for k, (ohm, tau_s) in enumerate(zip(circuit.pair_ohm, circuit.tau_s, strict=True), start=1):
        values |= {f"R{k} [Ohm]": float(ohm), f"C{k} [F]": float(tau_s / ohm)}
        values[f"Element-{k} initial overpotential [V]"] = 0.0
    options = {"number of rc elements": len(circuit.tau_s)}
    simulation = pybamm.Simulation(
        pybamm.equivalent_circuit.Thevenin(options=options),
        parameter_values=pybamm.ParameterValues(values),
        solver=pybamm.IDAKLUSolver(),
    )

    def step(seconds: float, amperes: float, _volts: float) -> float:
        if seconds > 0.0:
            simulation.step(seconds, inputs={"Current function [A]": amperes}, save=False)
        return float("nan")

    return step


STEPS = {
    "filterpy EKF": bare_ekf,
    "ProgPy UKF": progpy_ukf,
    "thevenin step": thevenin_step,
    "PyBaMM Thevenin step": pybamm_step,
}
FILTERS = ("filterpy EKF", "ProgPy UKF")
"""Those that correct the SoC by the voltage."""


def run(step: Step, log: Log, rows: int | None = None) -> tuple[list[float], float]:
    """Return the SoC [%] and the time per sample [s] over the first rows of a log."""
    count = min(rows or len(log["time_s"]), len(log["time_s"]))
    steps_s = np.diff(log["time_s"][:count], prepend=log["time_s"][0])
    seconds = np.round(steps_s, 6).tolist()  # of equal steps a filter keeps what depends on them
    samples = list(zip(seconds, log["current_a"], log["voltage_v"], strict=False))
    step(0.0, *samples[0][1:])  # compile, allocate
    began = time.process_time()
    soc = [step(*sample) for sample in samples]
    return soc, (time.process_time() - began) / count


class BatterySe:
    """PyBatterySE: a model by PyBatteryID of the training logs at 1 Hz, and its filter."""

    def __init__(self, tables: dict[str, Any], training: list[Log]) -> None:
        from pybatteryid.identification import identify_model  # noqa: PLC0415
        from pybatteryid.modelstructure import ModelStructure  # noqa: PLC0415

        self._circuit = Circuit(tables, 20.0)
        structure = ModelStructure(self._circuit.capacity_as, 1.0)
        structure.add_emf_function(
            {"soc_values": self._circuit.soc, "voltage_values": self._circuit.ocv_v}
        )
        structure.add_basis_functions(["s", "1/s"])
        data = [self._given(log, log["start_pct"] / 100.0) for log in training]
        with redirect_stdout(sys.stderr):
            self._model = identify_model(data, structure, 2, 1, ["ridgecv.sklearn"])

    def run(self, log: Log) -> tuple[list[float], float]:
        """Return the SoC [%] and the time per sample [s]."""
        import pybatteryse  # noqa: PLC0415

        space = pybatteryse.load_statespace_representation(self._model, ["s", "overpotentials"])
        ekf = pybatteryse.load_filter(
            space, "extended_kalman_filter",
            variance_eta_u=CURRENT_STD_A**2, variance_eta_y_e=self._circuit.noise_v**2,
        )  # fmt: skip
        start = self._circuit.start(log)
        order = self._model.model_order
        began = time.process_time()
        states, _ = ekf.run(
            self._given(log, start),
            np.array([start, *[0.0] * order]),
            np.diag([(START_STD_PCT / 100.0) ** 2, *[1e-4] * order]),
        )
        seconds = (time.process_time() - began) / len(log["time_s"])
        soc = np.full(len(log["time_s"]), states[-1, 0])
        soc[: len(states)] = states[:, 0]
        return (100.0 * soc).tolist(), seconds

    @staticmethod
    def _given(log: Log, soc: float) -> dict[str, Any]:
        """Return a log as PyBatteryID takes it: positive current charges."""
        return {
            "initial_soc": soc,
            "current_values": -np.array(log["current_a"]),
            "voltage_values": np.array(log["voltage_v"]),
        }


def main() -> None:
    """Time the steps, and estimate the judged logs of each pack."""
    name, work = sys.argv[1], json.load(open(sys.argv[2], encoding="utf-8"))  # noqa: SIM115, PTH123
    result: dict[str, Any] = {"us": {}, "soc_pct": {}}
    for pack, data in work["packs"].items():
        if name == "PyBatterySE EKF":
            battery = BatterySe(data["tables"], data["training"])
            runs = [battery.run(log) for log in data["judged"]]
            result["us"]["1 Hz"] = 1e6 * float(np.median([seconds for _, seconds in runs]))
            result["soc_pct"][pack] = [soc for soc, _ in runs]
            continue
        make = STEPS[name]
        if name in FILTERS:
            circuits = [Circuit(data["tables"], log["mean_c"]) for log in data["judged"]]
            result["soc_pct"][pack] = [
                run(make(circuit, circuit.start(log)), log)[0]
                for circuit, log in zip(circuits, data["judged"], strict=True)
            ]
    if name in STEPS:
        circuit = Circuit(work["timing"]["tables"], 20.0)
        for rate, log in work["timing"]["logs"].items():
            step = STEPS[name](circuit, circuit.start(log))
            result["us"][rate] = 1e6 * run(step, log, work["timing"]["rows"])[1]
    json.dump(result, sys.stdout)


if __name__ == "__main__":
    main()
