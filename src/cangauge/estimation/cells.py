"""Cells: the weakest cell's SoC beside the pack's, and the sum of the cells as a check.

Each cell has its own SoC and its own resistance relative to the model's, in a Kalman filter of two
states; the n filters share the model of the pack, divided by n:

    n·vᵢ = OCV(S + dᵢ) + rᵢ·drop + the rest of the model + common error

S is the pack's SoC, dᵢ the cell's distance from it [%] and rᵢ the deviation of its resistance. The
common error, the mean over the cells, belongs to the pack and is left to its estimator. dᵢ wanders
with the charge moved, as a cell of another capacity does; a resistance acts with the current, so
the two separate while driving.

The sum of the cells against the pack's voltage checks its sensor, where all cells are known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from cangauge._typing import FloatArray
from cangauge.model.voltage_model import VoltageModel
from cangauge.types import CellReport

CELLS_AT_MOST: Final = 1022
"""Largest number of a cell in SOC_CELLS."""

CELL_SENSOR_STD_V: Final = 2e-3
"""Lasting error of a cell's voltage [V]: data sheets of monitoring ICs state a total error of 1 to
3 mV over temperature. It does not average out."""

CELL_NOISE_STD_V: Final = 2e-3
"""Noise of a cell's voltage [V]: half of the usual steps of 1 to 5 mV, and the residue of the
current's change between cell and pack."""

CELL_SOC_STD_PCT: Final = 10.0
"""Prior standard deviation of a cell's distance from the pack's SoC [%]."""

CELL_CAPACITY_STD: Final = 0.1
CELL_SPAN_PCT: Final = 30.0
"""Relative standard deviation of a cell's capacity in an aged pack, and the SoC travel over which
it acts in one direction [%]."""

CELL_RESISTANCE_STD: Final = 0.15
"""Relative standard deviation of a cell's resistance in an aged pack, and its change in an hour."""

EVERY_S: Final = 1.0
"""Interval of the updates [s]."""

SUM_MEMORY_S: Final = 60.0
"""Memory of the mean difference between pack and sum of cells [s]."""

SUM_AT_LEAST_S: Final = 30.0
"""Least time observed before the difference is judged [s]."""

SUM_WITHIN: Final = 0.005
"""Relative difference that both sensors' data sheets allow: ±0.5 % is usual for pack sensors."""


UNKNOWN: Final = CellReport(
    0, -1, math.nan, math.nan, math.nan, math.nan, math.nan, is_sum_wrong=False
)


class PackTick(NamedTuple):
    """What the pack's estimator knows at a sample."""

    time_s: float
    soc_pct: float
    soc_std_pct: float
    voltage_v: float
    """Pack voltage [V]; NaN: missing."""
    without_ocv_v: float
    """Predicted voltage less the pseudo-OCV [V]."""
    drop_v: float
    """Part of it proportional to the resistances [V]."""
    moved_pct: float
    """Charge moved in either direction since the start [% of capacity]."""


class CellEstimator:
    """Estimate each cell's SoC from its voltage.

    Parameters
    ----------
    model : VoltageModel
    count : int
        Number of cells in series, n.
    first : int
        Number of the first cell.
    """

    def __init__(self, model: VoltageModel, count: int, first: int = 1) -> None:
        self._model = model
        self._due_s = -math.inf
        self._count = count
        self._first = first
        self._x = np.zeros((count, 2))  # d and r of each cell
        self._P = np.tile(np.diag([CELL_SOC_STD_PCT**2, CELL_RESISTANCE_STD**2]), (count, 1, 1))
        self._is_seen = np.zeros(count, dtype=bool)
        self._last: PackTick | None = None
        self._sum_s = 0.0
        self._sum_v = self._sum_square_v2 = 0.0

    def is_due(self, time_s: float) -> bool:
        """Return whether a second has passed at a sample's time [s]; ask once a sample."""
        if self._due_s - EVERY_S <= time_s < self._due_s:
            return False
        self._due_s = time_s + EVERY_S
        return True

    def update(
        self, tick: PackTick, voltage_v: Sequence[float], current_change_a: Sequence[float]
    ) -> None:
        """Take the cells' voltages, at most once a second.

        Parameters
        ----------
        tick : PackTick
        voltage_v : sequence of n floats
            Voltages [V]; NaN: none since the last call.
        current_change_a : sequence of n floats
            Current of the sample less that at the cell's own time [A].
        """
        # The resistance without delay carries a voltage from the cell's time to the sample's.
        volts = np.asarray(voltage_v, dtype=np.float64)
        per_cell_ohm = self._model.loads.resistance_ohm[0] / self._count
        volts = volts + per_cell_ohm * np.asarray(current_change_a, dtype=np.float64)
        last, self._last = self._last, tick
        if last is not None and tick.time_s > last.time_s:
            self._predict(tick.time_s - last.time_s, max(tick.moved_pct - last.moved_pct, 0.0))
            self._check_sum(tick, volts, tick.time_s - last.time_s)
        known = np.isfinite(volts)
        if known.any() and math.isfinite(tick.soc_pct) and math.isfinite(tick.without_ocv_v):
            self._fuse(tick, volts, known)

    @property
    def report(self) -> CellReport:
        """Weakest cell, spread and check of the sum."""
        error_v, std_v, is_wrong = self._sum()
        found = UNKNOWN._replace(
            cells=int(self._is_seen.sum()),
            sum_error_v=error_v,
            sum_std_v=std_v,
            is_sum_wrong=is_wrong,
        )
        if not found.cells or self._last is None or math.isnan(self._last.soc_pct):
            return found
        distances = np.where(self._is_seen, self._x[:, 0], np.nan)
        weakest = int(np.nanargmin(distances))
        soc_pct = self._last.soc_pct + float(distances[weakest])
        slope = float(self._model.pseudo_ocv_slope(soc_pct)[0])
        return found._replace(
            weakest=self._first + weakest,
            soc_pct=min(max(soc_pct, 0.0), 100.0),
            soc_std_pct=math.sqrt(
                float(self._P[weakest, 0, 0])
                + (self._count * CELL_SENSOR_STD_V / slope) ** 2
                + self._last.soc_std_pct**2
            ),
            spread_pct=float(np.nanmax(distances)) - float(distances[weakest]),
        )

    def _predict(self, seconds: float, moved_pct: float) -> None:
        dd, rr = self._P[:, 0, 0], self._P[:, 1, 1]
        dd[:] = np.minimum(
            dd + CELL_CAPACITY_STD**2 * CELL_SPAN_PCT * moved_pct, 4.0 * CELL_SOC_STD_PCT**2
        )
        rr[:] = np.minimum(rr + CELL_RESISTANCE_STD**2 * seconds / 3600.0, CELL_RESISTANCE_STD**2)

    def _fuse(self, tick: PackTick, volts: FloatArray, known: FloatArray) -> None:
        soc_pct = np.clip(tick.soc_pct + self._x[:, 0], 0.0, 100.0)
        expected_v = self._model.pseudo_ocv(soc_pct) + self._x[:, 1] * tick.drop_v
        y = self._count * volts - tick.without_ocv_v - expected_v
        # Of the first voltages it is not known yet what cells differ in.
        common = np.mean if self._is_seen.any() else np.median
        y = np.where(known, y - common(y[known]), 0.0)
        self._is_seen |= known
        slope = self._model.pseudo_ocv_slope(soc_pct)
        H = np.stack((slope, np.full_like(slope, tick.drop_v)), axis=1)
        PHt = np.einsum("nij,nj->ni", self._P, H)
        S = np.sum(H * PHt, axis=1) + (self._count * CELL_NOISE_STD_V) ** 2
        K = np.where(known, 1.0 / S, 0.0)[:, None] * PHt
        self._x = self._x + K * y[:, None]
        self._P = self._P - K[:, :, None] * PHt[:, None, :]

    def _check_sum(self, tick: PackTick, volts: FloatArray, seconds: float) -> None:
        difference_v = tick.voltage_v - float(volts.sum())
        if math.isnan(difference_v):
            return
        self._sum_s = min(self._sum_s + seconds, 1e6)
        weight = max(1.0 - math.exp(-seconds / SUM_MEMORY_S), min(seconds / self._sum_s, 1.0))
        self._sum_v += weight * (difference_v - self._sum_v)
        self._sum_square_v2 += weight * (difference_v**2 - self._sum_square_v2)

    def _sum(self) -> tuple[float, float, bool]:
        """Return mean difference, its standard deviation [V], and whether it is too large."""
        if self._sum_s < SUM_AT_LEAST_S or self._last is None:
            return math.nan, math.nan, False
        variance = max(self._sum_square_v2 - self._sum_v**2, 0.0)
        independent = max(min(self._sum_s, SUM_MEMORY_S) / 2.0, 1.0)
        std_v = math.hypot(
            math.sqrt(variance / independent), math.sqrt(self._count) * CELL_SENSOR_STD_V
        )
        usual_v = abs(self._model.pseudo_ocv_at(50.0)[0])
        return self._sum_v, std_v, abs(self._sum_v) > SUM_WITHIN * usual_v + 2.0 * std_v
