"""Chains of days of healthy packs, and what faults make of them."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

import cangauge
from cangauge.logs.read import CellColumns
from judge.storage import CELLS, draw_days
from packs.recorded import load, one_hz

PACKS = ("i3", "car1", "lg_hg2", "a123_lfp", "storage")
LOGS = {"i3": (5, 4), "car1": (4, 4), "lg_hg2": (3, 3), "a123_lfp": (2, 2), "storage": (3, 5)}
"""Logs that a model is fitted to, and logs of a chain."""
SHORTEST_S = 600.0


@dataclass(eq=False)
class Chain:
    """Logs with the gauge's SoC, and the truth.

    `true_pct` is the true SoC of each row of each log. `causes` are the names that are right; none:
    the gauge is right. `resets` are stamps at which the gauge set itself.
    """

    pack: str
    number: int
    logs: list[cangauge.Log]
    true_pct: list[np.ndarray]
    model: cangauge.Model
    cells: int
    capacity_ah: float
    rng: np.random.Generator
    fault: str = "none"
    causes: list[set[str]] = field(default_factory=list)
    resets: list[float] = field(default_factory=list)
    cell_voltages: list[CellColumns] = field(default_factory=list)
    lack_pct: float = 0.0

    @property
    def error_pct(self) -> float:
        """Published minus true SoC at the end of the last log [%]."""
        return float(self.logs[-1].soc_pct[-1] - self.true_pct[-1][-1])

    def sign(self) -> float:
        """Return a sign at random."""
        return float(self.rng.choice([-1.0, 1.0]))


def healthy_chains(name: str, number: int, seed: int, data: Path) -> Iterator[Chain]:
    """Yield chains of a pack without a fault: other logs than those of its model, in order."""
    trained, used = LOGS[name]
    if name != "storage":
        packs = load(data, ["i3", "i3_winter"] if name == "i3" else [name])
        logs = {log.name: one_hz(log) for pack in packs for log in [*pack.training, *pack.judged]}
        names = [key for key, log in logs.items() if log.duration_s >= SHORTEST_S]
        pack = packs[0]
    for chain in range(number):
        rng = np.random.default_rng([seed, zlib.crc32(name.encode()), chain])
        if name == "storage":
            days, capacity_ah = draw_days(rng, trained + used, rng.uniform(0.3, 1.0))
            fitted, days = days[:trained], days[trained:]
            chemistry, cells = "lfp", CELLS
        else:
            order = [names[k] for k in rng.permutation(len(names))]
            fitted = [logs[key] for key in order[:trained]]
            days = [_on_day(logs[key], day) for day, key in enumerate(order[trained:][:used])]
            capacity_ah = pack.capacity_of(fitted)
            chemistry, cells = pack.chemistry, pack.cells
        model = cangauge.fit(
            fitted, capacity_ah=capacity_ah, chemistry=chemistry, cells=cells
        ).model
        true = [_whole(log) for log in days]
        yield Chain(name, chain, days, true, model, cells, capacity_ah, rng)


def _on_day(log: cangauge.Log, day: int) -> cangauge.Log:
    start_s = 1.7e9 + 86400.0 * day + 8.0 * 3600.0
    return replace(log, time_s=log.time_s - log.time_s[0] + start_s)


def _whole(log: cangauge.Log) -> np.ndarray:
    known = np.isfinite(log.soc_pct)
    return np.interp(log.time_s, log.time_s[known], log.soc_pct[known])


def publish(chain: Chain, error_pct: Sequence[np.ndarray], step_pct: float = 0.1) -> None:
    """Have the gauge publish the true SoC plus an error, in steps and within 0–100 %."""
    for k, (log, true, error) in enumerate(zip(chain.logs, chain.true_pct, error_pct, strict=True)):
        shown = np.clip(np.round((true + error) / step_pct) * step_pct, 0.0, 100.0)
        chain.logs[k] = replace(log, soc_pct=shown)


def _hours(chain: Chain) -> list[np.ndarray]:
    """Return the logged hours since the first row, through all logs."""
    before, found = 0.0, []
    for log in chain.logs:
        found.append(before + (log.time_s - log.time_s[0]) / 3600.0)
        before = float(found[-1][-1])
    return found


def _constant(chain: Chain, error_pct: float) -> list[np.ndarray]:
    return [np.full(len(log), error_pct) for log in chain.logs]


def none(chain: Chain) -> None:
    """Be right."""
    publish(chain, _constant(chain, 0.0), float(chain.rng.choice([0.1, 0.5, 1.0])))


def quantised(chain: Chain) -> None:
    """Be right, in coarse steps."""
    publish(chain, _constant(chain, 0.0), float(chain.rng.choice([2.0, 5.0])))


def offset(chain: Chain) -> None:
    """Count with an offset of the current that the log does not have."""
    end_pct = chain.sign() * chain.rng.uniform(6.0, 16.0)
    hours = _hours(chain)
    publish(chain, [end_pct * each / hours[-1][-1] for each in hours])
    chain.causes = [{"current_offset"}]


def scale(chain: Chain) -> None:
    """Count too much or too little."""
    factor = chain.sign() * chain.rng.uniform(0.06, 0.15)
    publish(chain, [factor * (true - 100.0) for true in chain.true_pct], 0.5)
    chain.causes = [{"count_scale", "pack_capacity"}]


def start(chain: Chain) -> None:
    """Start wrong."""
    publish(chain, _constant(chain, chain.sign() * chain.rng.uniform(6.0, 15.0)))
    chain.causes = [{"start_or_reset"}]


def capacity(chain: Chain) -> None:
    """Count with a capacity that the pack had when it was new, and so does the model."""
    lost = chain.rng.uniform(0.08, 0.2)
    publish(chain, [lost * (100.0 - true) for true in chain.true_pct])
    told_ah = chain.capacity_ah / (1.0 - lost)
    chain.model = chain.model.model_copy(update={"capacity_ah": told_ah})
    chain.capacity_ah = told_ah
    chain.causes = [{"pack_capacity", "count_scale"}]


def aged(chain: Chain) -> None:
    """Let the pack have aged since the model was fitted, and the gauge know it."""
    new_ah = chain.capacity_ah / (1.0 - chain.rng.uniform(0.08, 0.2))
    chain.model = chain.model.model_copy(update={"capacity_ah": new_ah})
    publish(chain, _constant(chain, 0.0))


def drift(chain: Chain) -> None:
    """Give the current sensor of gauge and log an offset; nothing resets the count."""
    hours = _hours(chain)
    end_pct = chain.sign() * chain.rng.uniform(6.0, 16.0)
    offset_a = -end_pct * chain.model.capacity_ah / 100.0 / hours[-1][-1]
    publish(chain, [end_pct * each / hours[-1][-1] for each in hours])
    chain.logs = [replace(log, current_a=log.current_a + offset_a) for log in chain.logs]
    chain.causes = [{"current_offset"}]


def sensor_gain(chain: Chain) -> None:
    """Have a wrong gain of the current sensor, of gauge and log."""
    gain = chain.sign() * chain.rng.uniform(0.04, 0.1)
    publish(chain, [gain * (true - chain.true_pct[0][0]) for true in chain.true_pct])
    chain.logs = [replace(log, current_a=log.current_a * (1.0 + gain)) for log in chain.logs]
    chain.causes = [{"current_gain", "pack_capacity", "count_scale"}]


def _reset(chain: Chain, before_pct: float, after_pct: float) -> None:
    at_log = int(chain.rng.integers(max(0, len(chain.logs) - 2), len(chain.logs)))
    log = chain.logs[at_log]
    at_s = float(log.time_s[0] + chain.rng.uniform(0.3, 0.7) * log.duration_s)
    stamps = [log.time_s for log in chain.logs]
    publish(chain, [np.where(time_s < at_s, before_pct, after_pct) for time_s in stamps])
    chain.resets = [at_s]


def self_reset_right(chain: Chain) -> None:
    """Be wrong, until it sets itself right."""
    _reset(chain, chain.sign() * chain.rng.uniform(6.0, 15.0), 0.0)
    chain.causes = [{"start_or_reset"}]


def self_reset_wrong(chain: Chain) -> None:
    """Be right, until it sets itself wrong."""
    _reset(chain, 0.0, chain.sign() * chain.rng.uniform(6.0, 15.0))
    chain.causes = [{"start_or_reset"}]


def clamp(chain: Chain) -> None:
    """Off, so that the gauge stands at its limit early, and counts on from there."""
    low, high = float(chain.true_pct[-1].min()), float(chain.true_pct[-1].max())
    beyond = chain.rng.uniform(2.0, 6.0)
    error = -low - beyond if low < 100.0 - high else 100.0 - high + beyond
    errors, count = _constant(chain, error), chain.true_pct[-1] + error
    errors[-1] = error + np.maximum.accumulate(np.maximum(0.0, -count))
    errors[-1] -= np.maximum.accumulate(np.maximum(0.0, count - 100.0))
    publish(chain, errors)
    chain.causes = [{"start_or_reset"}]


def frozen(chain: Chain) -> None:
    """Stand still from a moment on."""
    publish(chain, _constant(chain, 0.0))
    at = int(chain.rng.integers(max(0, len(chain.logs) - 2), len(chain.logs)))
    part = chain.rng.uniform(0.05, 0.4)
    for k in range(at, len(chain.logs)):
        log = chain.logs[k]
        row = round(part * len(log)) if k == at else 0
        held = chain.logs[at].soc_pct[round(part * len(chain.logs[at]))]
        shown = np.where(np.arange(len(log)) < row, log.soc_pct, held)
        chain.logs[k] = replace(log, soc_pct=shown)
    chain.causes = [{"stands_still"}]


def delayed(chain: Chain) -> None:
    """Publish late."""
    late_s = chain.rng.uniform(60.0, 300.0)
    errors = [
        np.interp(log.time_s - late_s, log.time_s, true) - true
        for log, true in zip(chain.logs, chain.true_pct, strict=True)
    ]
    publish(chain, errors)
    known = [log.time_s >= log.time_s[0] + late_s for log in chain.logs]
    chain.logs = [log.rows(rows) for log, rows in zip(chain.logs, known, strict=True)]
    chain.true_pct = [true[rows] for true, rows in zip(chain.true_pct, known, strict=True)]
    chain.causes = [{"late"}]


def table(chain: Chain) -> None:
    """Read the SoC from a table of voltages under load."""
    drop_pct = chain.rng.uniform(6.0, 20.0) / chain.model.capacity_ah * 2.0
    publish(chain, [-drop_pct * _smooth(log) for log in chain.logs])
    chain.causes = [{"voltage_table"}]


def _smooth(log: cangauge.Log) -> np.ndarray:
    step_s = float(np.median(np.diff(log.time_s)))
    width = max(1, round(30.0 / step_s))
    return np.convolve(log.current_a, np.ones(width) / width)[: len(log)]


def usable_window(chain: Chain) -> None:
    """Show the usable part of the cells."""
    low, high = chain.rng.uniform(0.03, 0.06, 2)
    shown = [(true - 100.0 * low) / (1.0 - low - high) for true in chain.true_pct]
    publish(chain, [each - true for each, true in zip(shown, chain.true_pct, strict=True)])
    chain.causes = [{"count_scale", "start_or_reset", "pack_capacity"}]


def weak_cell(chain: Chain) -> None:
    """Let one cell lack capacity: the pack is as empty as it, and the gauge does not know."""
    lack = chain.rng.uniform(0.06, 0.2)
    publish(chain, _constant(chain, 0.0))
    number = chain.cells
    weakest = int(chain.rng.integers(number))
    less, balance = chain.rng.normal(0.0, 0.5, (2, number))
    curve = chain.model.voltage_model().pseudo_ocv
    for k, (log, true) in enumerate(zip(chain.logs, chain.true_pct, strict=True)):
        drawn = 100.0 - true
        lacks = np.r_[less[:weakest], 100.0 * lack, less[weakest + 1 :]] / 100.0
        socs = 100.0 + np.minimum(balance, 0.0) - drawn[:, None] / (1.0 - lacks)
        change = (curve(np.maximum(socs, -5.0).ravel()) - curve(np.repeat(true, number))) / number
        volts = log.voltage_v[:, None] / number + change.reshape(socs.shape)
        volts += chain.rng.normal(0.0, 0.002, volts.shape)
        chain.cell_voltages.append(CellColumns(1, volts))
        chain.logs[k] = replace(chain.logs[k], voltage_v=volts.sum(axis=1))
        chain.true_pct[k] = 100.0 - drawn / (1.0 - lack)
    chain.lack_pct = 100.0 * lack
    chain.causes = [{"weak_cell"}]


def voltage(chain: Chain) -> None:
    """Have a wrong voltage in the log, and a right gauge."""
    publish(chain, _constant(chain, 0.0))
    factor = 1.0 + chain.sign() * chain.rng.uniform(0.01, 0.02)
    chain.logs = [replace(log, voltage_v=factor * log.voltage_v) for log in chain.logs]


def start_and_scale(chain: Chain) -> None:
    """Start wrong, and count wrong."""
    shift, factor = chain.sign() * chain.rng.uniform(6.0, 12.0), chain.rng.uniform(0.08, 0.15)
    publish(chain, [shift + factor * (true - 100.0) for true in chain.true_pct])
    chain.causes = [{"start_or_reset"}, {"count_scale", "pack_capacity"}]


def offset_and_reset(chain: Chain) -> None:
    """Drift by an offset of the count; a reset sets it right, and it drifts on."""
    hours = _hours(chain)
    slope = chain.sign() * chain.rng.uniform(8.0, 16.0) / hours[-1][-1]
    _reset(chain, 1.0, 0.0)
    at_s, errors = chain.resets[0], []
    begun = next(
        float(np.interp(at_s, log.time_s, each))
        for log, each in zip(chain.logs, hours, strict=True)
        if log.time_s[0] <= at_s <= log.time_s[-1]
    )
    for log, each in zip(chain.logs, hours, strict=True):
        errors.append(slope * np.where(log.time_s < at_s, each, each - begun))
    publish(chain, errors)
    chain.causes = [{"current_offset"}, {"start_or_reset", "current_offset"}]


FAULTS: dict[str, Callable[[Chain], None]] = {
    each.__name__: each
    for each in (
        none, quantised, aged, voltage, offset, scale, start, capacity, drift, sensor_gain,
        self_reset_right, self_reset_wrong, clamp, frozen, delayed, table, usable_window, weak_cell,
        start_and_scale, offset_and_reset,
    )
}  # fmt: skip
HEALTHY = ("none", "quantised", "aged")
"""Chains whose gauge is right."""
