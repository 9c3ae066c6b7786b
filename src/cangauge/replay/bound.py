"""How far the SoC of a replayed log can be from that of the log itself: frames are rounded.

The numbers that a frame holds differ from the log's by half a step at most (δI, δU, δT; and half
a microsecond in time). Through the model:

    counting   ≤ 100/(3600·C) · (δI·t + δt·Σ|ΔI|)
    Newton     ≤ (δU + |kt|·δT + Σ|Rj|·(δI + δt·max|dI/dt|)) / min dU/dS
    fusion     ≤ counting + Newton

The last because a filter moves the counted SoC towards that of the voltage by less than the whole
difference: the error stays below the larger of the two, plus what is counted in between. It holds
as long as no threshold (outlier, lasting contradiction) falls the other way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cangauge.bus.encode import FrameEncoder
from cangauge.bus.vehicle import Vehicle
from cangauge.logs.log import Log
from cangauge.model.model_file import ModelFile


@dataclass(frozen=True)
class QuantisationBound:
    """Largest difference that rounding can make in SoC [%], by method."""

    coulomb_pct: float
    newton_pct: float

    @property
    def ekf_pct(self) -> float:
        """For fusion."""
        return self.coulomb_pct + self.newton_pct


def quantisation_bound(
    vehicle: Vehicle, model: ModelFile, log: Log, capacity_ah: float | None = None
) -> QuantisationBound:
    """Return the bound for a log that is replayed as a vehicle's frames with REPLAY_CLOCK.

    Parameters
    ----------
    vehicle : Vehicle
    model : ModelFile
    log : Log
    capacity_ah : float, optional
        Instead of the model's [Ah].
    """
    step = FrameEncoder(vehicle).quantisation()
    voltage_model = model.voltage_model()
    current_a = step["current_a"]
    time_s = float(np.max(np.abs(np.rint(log.time_s * 1e6) / 1e6 - log.time_s)))
    steps_a = np.abs(np.diff(log.current_a))
    slew = float(np.max(steps_a / np.diff(log.time_s))) if len(log) > 1 else 0.0
    pct_per_as = 100.0 / (3600.0 * (capacity_ah or model.capacity_ah))
    coulomb = pct_per_as * (current_a * log.duration_s + time_s * float(steps_a.sum()))
    # A vehicle without a temperature signal is not bounded here: its temperature is another one.
    temperature_k = step.get("temperature_c", 0.0)
    resistance = sum(abs(each) for each in voltage_model.resistance_ohm)
    volts = step["voltage_v"] + abs(voltage_model.kt_v_per_k) * temperature_k
    volts += resistance * (current_a + time_s * slew)
    slope = min(voltage_model.pseudo_ocv_at(soc)[1] for soc in np.linspace(0.0, 100.0, 1001))
    return QuantisationBound(coulomb, volts / slope)
