r"""A gauge with filterpy's extended Kalman filter over SoC and one RC pair, nothing tuned.

cangauge judge --suite -- python examples/gauge_filterpy.py {interface} {channel} {port} \
        {model} {soc}
"""

import sys

import can
import cantools
import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from cangauge import Model
from cangauge._resources import shared_file

interface, channel, port, path, start = sys.argv[1:6]
model = Model.load(path)
curve = model.voltage_model()
loads = curve.loads
ohm = -np.array(loads.resistance_ohm)  # the model: U = OCV + Σ R·I
R0, R1, TAU_S = ohm[0], ohm[1:].sum(), 60.0
pack = cantools.database.load_file(shared_file("dbc", "generic_pack.dbc"))
ours = cantools.database.load_file(shared_file("dbc", "soc_estimate.dbc"))
answer = ours.get_message_by_name("SOC_ESTIMATE")
clock = ours.get_message_by_name("REPLAY_CLOCK")

ekf = ExtendedKalmanFilter(dim_x=2, dim_z=1)  # x: SoC [%], voltage over the pair [V]
ekf.x = np.array([[float(start)], [0.0]])
ekf.P = np.diag([10.0**2, 1e-4])
ekf.R[:] = model.noise.voltage_rmse_v**2


def slope(x: np.ndarray) -> np.ndarray:
    """Return dU/dx."""
    return np.array([[curve.pseudo_ocv_slope(x[0])[0], -1.0]])


def voltage(x: np.ndarray) -> np.ndarray:
    """Return the terminal voltage."""
    warm_v = loads.kt_v_per_k * (temperature_c - loads.t_ref_c)
    return np.array([curve.pseudo_ocv(x[0]) + warm_v - R0 * current_a - x[1, 0]])


def step(seconds: float, volts: float) -> None:
    """Count, then correct by the voltage."""
    decay = np.exp(-seconds / TAU_S)
    gain = np.array([[-seconds / 36.0 / model.capacity_ah], [R1 * (1.0 - decay)]])
    ekf.F, ekf.B, ekf.Q = np.diag([1.0, decay]), gain, gain @ gain.T  # 1 A of current noise
    ekf.predict(current_a)
    ekf.x[0, 0] = np.clip(ekf.x[0, 0], 0.5, 99.5)
    ekf.update(np.array([[volts]]), slope, voltage)


def publish() -> None:
    """Send SoC and σ."""
    soc_pct, std_pct = float(np.clip(ekf.x[0, 0], 0.0, 100.0)), float(np.sqrt(ekf.P[0, 0]))
    values = {signal.name: 0 for signal in answer.signals}
    data = answer.encode({**values, "soc_pct": soc_pct, "soc_std_pct": min(std_pct, 100.0)})
    bus.send(can.Message(arbitration_id=answer.frame_id, data=data, is_extended_id=False))


current_a = now_s = before_s = 0.0
temperature_c = loads.t_ref_c
with can.Bus(interface=interface, channel=channel, port=int(port)) as bus:
    publish()
    for frame in bus:
        if frame.arbitration_id == clock.frame_id:
            now_s = clock.decode(frame.data)["log_time_us"] / 1e6
        elif frame.arbitration_id == 0x400:
            current_a = pack.decode_message(0x400, frame.data)["current_a"]
        elif frame.arbitration_id == 0x402:
            temperature_c = pack.decode_message(0x402, frame.data)["temperature_c"]
        elif frame.arbitration_id == 0x401:
            step(now_s - before_s, pack.decode_message(0x401, frame.data)["voltage_v"])
            before_s = now_s
            publish()
