"""What a fault put into recorded logs must know of their pack: open-circuit voltage, resistance.

The result is a pack of the twin. Only differences between two of its conditions are ever added
to recorded voltages, so it need not be a good model of the pack; its slope over charge and its
resistance must be about right.

Faults put into recorded logs: what changes is added to what was measured.

Faults of the pack add the difference that they make to a pack of the twin under the recorded
current and temperature; faults of a sensor change the recorded signal itself.

Cases of the withheld check on recorded logs: faults put into files that were held out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import isotonic_regression

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.validation.twin.case import (
    GAP_IN_FLOORS,
    Case,
    CaseLogs,
    draw_kinds,
    extent,
    fault_truth,
    shaped_fault,
    write_case_files,
)
from cangauge.validation.twin.condition import HEALTHY, Condition, is_on
from cangauge.validation.twin.day import Day
from cangauge.validation.twin.faults import Fault, apply_faults
from cangauge.validation.twin.pack import HIGHEST, LOWEST, Chemistry, Pack, Sensors, chemistry
from cangauge.validation.twin.plant import discharged, electrical, lagged, temperatures
from cangauge.validation.twin.scaling import Scaled, find_size
from cangauge.validation.twin.simulate import seen_current, seen_temperature, seen_voltage
from cangauge.validation.twin.world import rms

# --- What a fault put into recorded logs must know of their pack: open-circuit voltage, resi…

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


# --- Faults put into recorded logs: what changes is added to what was measured

_SHORTEST_S: Final = 60.0


@dataclass(frozen=True, eq=False)
class Injected:
    """A recorded log with a fault.

    Parameters
    ----------
    log : Log
        `soc_pct` holds the assumed start only.
    gap_v : array of shape (n,)
        What the fault opens between the log and a perfect model of the healthy pack [V].
    true_soc_pct : array of shape (n,)
        SoC with the fault [%], as far as the recorded log knew it.
    """

    log: Log
    gap_v: FloatArray
    true_soc_pct: FloatArray


def inject(log: Log, faults: Sequence[Fault], pack: Pack, *, seed: int = 0) -> Injected:
    """Return a recorded log as it would be with faults.

    Parameters
    ----------
    log : Log
        A healthy one, with its SoC at the start at least.
    faults : sequence of Fault
    pack : Pack
        From `survey_pack`.
    seed : int
        Of the history of hysteresis.

    Raises
    ------
    InputError
        If the log has no SoC or is too short, or a fault is unknown.
    """
    if log.duration_s < _SHORTEST_S:
        raise InputError(
            "too short for a fault to be put in", source=log.source or log.name, value=len(log)
        )
    condition = apply_faults(pack, tuple(faults))
    day, warm = _day(log, pack, seed)
    clean = electrical(pack, day, HEALTHY, day.current_a, warm)
    current = day.current_a
    if condition.hidden_load is not None:
        current = current + condition.hidden_load.size * is_on(condition.hidden_load, day.time_s)
    core = warm
    if condition.insulation:
        hot, _ = temperatures(pack, day, clean.heat_w, condition.insulation)
        cool, _ = temperatures(pack, day, clean.heat_w)
        core = warm + hot - cool
    faulty = electrical(pack, day, condition, current, core)
    changed = _at(log, day, faulty.voltage_v - clean.voltage_v)
    rows = replace(day, time_s=log.time_s - log.time_s[0])
    voltage = seen_voltage(condition, rows, log.voltage_v + changed)
    recorded_current = seen_current(condition, rows, log.current_a)
    shift = seen_temperature(pack, condition, day, warm) - warm
    if _same_seen(condition, shift):
        expected = log.voltage_v
    else:
        seen = electrical(
            pack, day, HEALTHY, seen_current(condition, day, day.current_a), warm + shift
        )
        expected = log.voltage_v + _at(log, day, seen.voltage_v - clean.voltage_v)
    start = log.first_soc()
    assumed = np.full(len(log), np.nan)
    if start is not None:
        assumed[start[0]] = start[1]
    sensors = pack.sensors
    result = replace(
        log,
        current_a=_stepped(recorded_current, sensors.current_step_a),
        voltage_v=_stepped(voltage, sensors.voltage_step_v),
        temperature_c=_stepped(
            log.temperature_c + _at(log, day, shift), sensors.temperature_step_k
        ),
        soc_pct=assumed,
    )
    taken = discharged(day, current, condition.charge_loss) / pack.capacity_ah
    healthy = discharged(day, day.current_a) / pack.capacity_ah
    away = condition.start_soc_shift + healthy - taken / condition.capacity_factor
    true_soc = 100.0 * (charge_of(log, pack.capacity_ah) + _at(log, day, away))
    return Injected(result, voltage - expected, true_soc)


def scale_injection(
    logs: Sequence[Log], fault: Fault, wanted_v: float, pack: Pack, *, seed: int = 0
) -> Scaled:
    """Return the fault with the size that opens the wanted gap over some recorded logs.

    Parameters
    ----------
    logs : sequence of Log
    fault : Fault
        Its size gives the sign.
    wanted_v : float
        RMS gap [V].
    pack : Pack
    seed : int
    """

    def gap_of(sized: Fault) -> float:
        gaps = [inject(log, (sized,), pack, seed=seed).gap_v for log in logs]
        return float(np.sqrt(np.mean(np.concatenate(gaps) ** 2)))

    return find_size(gap_of, fault, wanted_v, fault.kind.limits(pack))


def scaled_to_pack(log: Log, *, series: int, parallel: int) -> Log:
    """Return the log of a cell as that of a pack of equal cells.

    Parameters
    ----------
    log : Log
    series, parallel : int
        How many cells.

    Raises
    ------
    InputError
        If a number is below 1.
    """
    if series < 1 or parallel < 1:
        raise InputError("a pack has at least one cell", value=(series, parallel))
    return replace(log, current_a=parallel * log.current_a, voltage_v=series * log.voltage_v)


def with_start(log: Log, soc_pct: float) -> Log:
    """Return the log with an assumed SoC in its first row [%] and no other reference."""
    assumed = np.full(len(log), np.nan)
    assumed[0] = soc_pct
    return replace(log, soc_pct=assumed)


def _day(log: Log, pack: Pack, seed: int) -> tuple[Day, FloatArray]:
    """Return the recorded log on an even grid, and its temperature [°C]."""
    step = float(np.clip(np.median(np.diff(log.time_s)), 0.1, 1.0))
    elapsed = log.time_s - log.time_s[0]
    time_s = np.arange(0.0, elapsed[-1] + step, step)
    warm = np.interp(time_s, elapsed, log.temperature_c)
    rng = np.random.default_rng(seed)
    day = Day(
        time_s=time_s,
        current_a=np.interp(time_s, elapsed, log.current_a),
        ambient_c=warm,
        start_c=float(warm[0]),
        start_soc=float(charge_of(log, pack.capacity_ah)[0]),
        history=float(rng.choice((-1.0, 1.0))),
        seed=seed,
    )
    return day, warm


def _at(log: Log, day: Day, signal: FloatArray) -> FloatArray:
    moved: FloatArray = np.interp(log.time_s - log.time_s[0], day.time_s, signal)
    return moved


def _same_seen(condition: Condition, shift: FloatArray) -> bool:
    healthy_current = (
        condition.current_offset_a == 0.0
        and condition.current_gain == 0.0
        and condition.current_skew_s == 0.0
        and condition.remanence_a == 0.0
        and condition.clip_share == 1.0
    )
    return healthy_current and not np.any(shift)


def _stepped(values: FloatArray, step: float) -> FloatArray:
    if step == 0.0:
        return values
    return np.asarray(np.round(np.round(values / step) * step, 9), dtype=np.float64)


# --- Cases of the withheld check on recorded logs: faults put into files that were held out

_REDRAWS: Final = 12
_GOOD_ENOUGH: Final = 0.9


@dataclass(frozen=True, eq=False)
class RecordedSet:
    """Recorded logs of one healthy pack, parted into what a diagnosis knows and what is held out.

    Parameters
    ----------
    name : str
    training, references, held_out : sequence of Log
        Each with its SoC at the start at least. The references may be empty.
    capacity_ah : float
    cells : int
        In series.
    """

    name: str
    training: Sequence[Log]
    references: Sequence[Log]
    held_out: Sequence[Log]
    capacity_ah: float
    cells: int

    def survey(self) -> Pack:
        """Return the pack that faults are put into, seen from all its logs."""
        return survey_pack(
            [*self.training, *self.references, *self.held_out],
            capacity_ah=self.capacity_ah,
            cells=self.cells,
            name=self.name,
        )


def make_real_case(
    seed: int,
    effects: str | Sequence[str] | None,
    recorded: RecordedSet,
    folder: Path,
    sealed: Path,
    *,
    floor_v: float,
    n_logs: int = 4,
    gap_in_floors: tuple[float, float] = GAP_IN_FLOORS,
    name: str | None = None,
) -> Case:
    """Put a fault into some held-out logs and write the case as for a simulated plant.

    Parameters
    ----------
    seed : int
    effects : str, sequence of str or None
        Ids of the faults, `any`, `outside`, or None for logs as they were recorded.
    recorded : RecordedSet
    folder, sealed : Path
        See `case_files.write_case_files`.
    floor_v : float
        What the gap is counted in [V]: for example how well the same drive repeats.
    n_logs : int
        Held-out logs that share the fault, drawn at random; other ones are drawn when they
        cannot show it.
    gap_in_floors : tuple of float
        Range of the gap, in floors, drawn evenly in its logarithm.
    name : str, optional
        Of the case; `case_SEED` without.

    Raises
    ------
    InputError
        If fewer logs are held out, an effect is unknown, or a folder cannot be written.
    """
    if not 1 <= n_logs <= len(recorded.held_out):
        raise InputError(
            f"{len(recorded.held_out)} logs are held out", field="n_logs", value=n_logs
        )
    rng = np.random.default_rng([seed, 3])
    pack = recorded.survey()
    kinds = draw_kinds(effects, rng)
    low, high = np.log(gap_in_floors)
    wanted = [float(floor_v * np.exp(rng.uniform(low, high))) for _ in kinds]
    signs = [-1.0 if kind.signed and rng.random() < 0.5 else 1.0 for kind in kinds]
    seeds = [int(rng.integers(2**31)) for _ in kinds]
    attempts: list[tuple[float, list[Log], tuple[Scaled, ...]]] = []
    for _ in range(_REDRAWS):
        chosen = rng.choice(len(recorded.held_out), size=n_logs, replace=False)
        logs = [recorded.held_out[index] for index in np.sort(chosen)]
        fullest = max(float(charge_of(log, pack.capacity_ah)[0]) for log in logs)
        shortest = min(log.duration_s for log in logs)
        scaled = tuple(
            scale_injection(
                logs,
                shaped_fault(kind, sign, fault_seed, shortest_s=shortest, fullest=fullest),
                volts,
                pack,
                seed=seed,
            )
            for kind, sign, fault_seed, volts in zip(kinds, signs, seeds, wanted, strict=True)
        )
        reached = min((item.reached_v / item.wanted_v for item in scaled), default=1.0)
        attempts.append((reached, logs, scaled))
        if reached >= _GOOD_ENOUGH or n_logs == len(recorded.held_out):
            break  # good, or there are no other logs to draw
    _, logs, scaled = max(attempts, key=lambda attempt: attempt[0])
    faults = [item.fault for item in scaled]
    changed = [inject(log, faults, pack, seed=seed) for log in logs]
    shown = CaseLogs(
        recorded.training,
        recorded.references,
        [item.log for item in changed],
        recorded.capacity_ah,
    )
    hidden = [
        {
            "time_s": item.log.time_s,
            "true_soc_pct": item.true_soc_pct,
            "gap_v": item.gap_v,
            "recorded_voltage_v": log.voltage_v,
        }
        for item, log in zip(changed, logs, strict=True)
    ]
    truth = {
        "plant": recorded.name,
        "seed": seed,
        "effects": [fault.id for fault in faults],
        "faults": [fault_truth(item) for item in scaled],
        "gap_v": rms(np.concatenate([item.gap_v for item in changed])),
        "floor_sensor_v": floor_v,
        "gap_counted_in_v": floor_v,
        "redraws": len(attempts) - 1,
        "logs": [_about(item, log) for item, log in zip(changed, logs, strict=True)],
    }
    return write_case_files(
        shown, truth, hidden, folder=folder, sealed=sealed, name=name or f"case_{seed:06d}"
    )


def _about(item: Injected, log: Log) -> dict[str, Any]:
    return {
        "name": log.name,
        "hours": log.duration_s / 3600.0,
        "temperature_c": extent(log.temperature_c),
        "soc_pct": extent(item.true_soc_pct),
        "gap_v": rms(item.gap_v),
    }
