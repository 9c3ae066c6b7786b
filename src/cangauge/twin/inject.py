"""Faults put into recorded logs: what changes is added to what was measured.

Faults of the pack add the difference that they make to a pack of the twin under the recorded
current and temperature; faults of a sensor change the recorded signal itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.twin.cells import electrical
from cangauge.twin.condition import HEALTHY, Condition, is_on
from cangauge.twin.day import Day
from cangauge.twin.extras import discharged
from cangauge.twin.faults import Fault, apply_faults
from cangauge.twin.pack import Pack
from cangauge.twin.scaling import Scaled, find_size
from cangauge.twin.sensors import seen_current, seen_temperature, seen_voltage
from cangauge.twin.survey import charge_of
from cangauge.twin.thermal import temperatures

FloatArray = NDArray[np.float64]

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
