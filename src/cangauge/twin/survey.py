"""What a fault put into recorded logs must know of their pack: open-circuit voltage, resistance.

The result is a pack of the twin. Only differences between two of its conditions are ever added
to recorded voltages, so it need not be a good model of the pack; its slope over charge and its
resistance must be about right.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.optimize import isotonic_regression

from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.twin.chemistry import HIGHEST, LOWEST, Chemistry, chemistry
from cangauge.twin.pack import Pack, Sensors
from cangauge.twin.relaxation import lagged

FloatArray = NDArray[np.float64]

_KNOTS: Final = np.array([0.0, 0.02, 0.05, *np.linspace(0.1, 0.9, 17), 0.95, 1.0])
_LAGS_S: Final = (20.0, 200.0)
_SMOOTH: Final = 0.02
_POINTS: Final = 1101
_RATE_S: Final = 1.0


def charge_of(log: Log, capacity_ah: float) -> FloatArray:
    """Return the state of charge of a log [-], shape (n,): its own where given, else counted.

    Parameters
    ----------
    log : Log
        With a first finite `soc_pct`.
    capacity_ah : float

    Raises
    ------
    InputError
        If it has no SoC at all.
    """
    first = log.first_soc()
    if first is None or log.soc_pct is None:
        raise InputError(
            "no SoC to start from",
            source=log.source or log.name,
            field="soc_pct",
            cure="give a log with its SoC at the start",
        )
    finite = np.isfinite(log.soc_pct)
    if finite.mean() > 0.5:
        return np.asarray(np.interp(log.time_s, log.time_s[finite], log.soc_pct[finite] / 100.0))
    steps = 0.5 * (log.current_a[1:] + log.current_a[:-1]) * np.diff(log.time_s) / 3600.0
    taken = np.concatenate(([0.0], np.cumsum(steps)))
    row, start = first
    return np.asarray(start / 100.0 - (taken - taken[row]) / capacity_ah, dtype=np.float64)


def survey_pack(
    logs: Sequence[Log], *, capacity_ah: float, cells: int, name: str = "recorded"
) -> Pack:
    """Return a pack of the twin that has about the voltage and resistance of recorded logs.

    Parameters
    ----------
    logs : sequence of Log
        Healthy ones, each with a SoC.
    capacity_ah : float
    cells : int
        In series.
    name : str

    Raises
    ------
    InputError
        If there is no log, or one has no SoC.
    """
    if not logs:
        raise InputError("no logs to survey", cure="give at least one healthy log")
    rows, volts = [], []
    for log in logs:
        time_s = np.arange(log.time_s[0], log.time_s[-1], _RATE_S)
        current = np.interp(time_s, log.time_s, log.current_a)
        soc = np.interp(time_s, log.time_s, charge_of(log, capacity_ah))
        slow = [lagged(current, _RATE_S, lag) for lag in _LAGS_S]
        rows.append(np.column_stack([_hats(soc), -current, *(-item for item in slow)]))
        volts.append(np.interp(time_s, log.time_s, log.voltage_v))
    matrix, voltage = np.vstack(rows), np.concatenate(volts)
    # Second differences of the curve are held small where the logs say nothing of it.
    bends = np.zeros((_KNOTS.size - 2, matrix.shape[1]))
    for row in range(_KNOTS.size - 2):
        bends[row, row : row + 3] = (1.0, -2.0, 1.0)
    bends *= _SMOOTH * np.sqrt(voltage.size)
    solution, *_ = np.linalg.lstsq(
        np.vstack([matrix, bends]), np.concatenate([voltage, np.zeros(len(bends))])
    )
    resistance = max(float(np.sum(solution[_KNOTS.size : _KNOTS.size + 2])), 1e-4)
    curve = isotonic_regression(solution[: _KNOTS.size]).x / cells
    return _pack(_chemistry(name, curve), cells, capacity_ah, resistance, logs[0])


def _hats(soc: FloatArray) -> FloatArray:
    """Return piecewise linear weights of the knots, shape (n, knots)."""
    place = np.clip(soc, 0.0, 1.0)
    right = np.clip(np.searchsorted(_KNOTS, place, side="right"), 1, _KNOTS.size - 1)
    share = (place - _KNOTS[right - 1]) / (_KNOTS[right] - _KNOTS[right - 1])
    result = np.zeros((soc.size, _KNOTS.size))
    rows = np.arange(soc.size)
    result[rows, right - 1] = 1.0 - share
    result[rows, right] = share
    return result


def _chemistry(name: str, curve: FloatArray) -> Chemistry:
    grid = np.linspace(LOWEST, HIGHEST, _POINTS)
    soc = np.concatenate(([-0.06, -0.03], _KNOTS, [1.04]))
    volts = np.concatenate(([curve[0] - 1.2, curve[0] - 0.5], curve, [curve[-1] + 0.1]))
    ocv = np.maximum.accumulate(PchipInterpolator(soc, volts)(grid)) + 1e-6 * grid
    entropy = chemistry("nmc", np.random.default_rng(0)).entropy(grid)
    return Chemistry(name, grid, ocv, entropy)


def _pack(
    curve: Chemistry, cells: int, capacity_ah: float, resistance_ohm: float, log: Log
) -> Pack:
    one = resistance_ohm / cells
    heat_j_k = cells * 3.7 * capacity_ah / 1000.0 * 7000.0
    interval = float(np.median(np.diff(log.time_s)))
    return Pack(
        name=curve.name,
        chemistry=curve,
        cells=cells,
        capacity_ah=capacity_ah,
        weights=np.array([float(cells)]),
        capacity_factor=np.ones(1),
        resistance_factor=np.ones(1),
        soc_shift=np.zeros(1),
        ohmic_ohm=0.55 * one,
        ohmic_vogel_k=240.0,
        busbar_ohm=0.05 * resistance_ohm,
        exchange_a=0.02569 / (0.40 * one),
        exchange_activation_k=5200.0,
        anodic=0.5,
        double_layer_s=0.1,
        electrolyte_ohm=(0.08 * one, 0.07 * one),
        electrolyte_tau_s=(20.0, 50.0),
        solid_swing=(0.012 / capacity_ah, 0.005 / capacity_ah, 0.003 / capacity_ah),
        solid_tau_s=(60.0, 17.0, 5.0),
        diffusion_activation_k=3000.0,
        core_j_k=0.75 * heat_j_k,
        surface_j_k=0.25 * heat_j_k,
        core_surface_w_k=cells * 3.7 * capacity_ah / 1000.0 * 7.0,
        surface_ambient_w_k=heat_j_k / 18000.0,
        sensors=Sensors(
            current_step_a=_step(log.current_a),
            current_noise_a=0.0,
            voltage_step_v=_step(log.voltage_v),
            voltage_noise_v=0.0,
            temperature_step_k=_step(log.temperature_c),
            temperature_lag_s=0.0,
            rate_hz=1.0 / interval,
            jitter=0.0,
            drop_share=0.0,
            start_soc_std_pct=0.0,
        ),
    )


def _step(values: FloatArray) -> float:
    """Return the coarsest usual step that all values are multiples of, or 0 if there is none."""
    for step in (1.0, 0.5, 0.25, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.001):
        if np.all(np.abs(values / step - np.rint(values / step)) < 1e-5):
            return step
    return 0.0
