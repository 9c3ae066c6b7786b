"""Capacity, offset, power, energy and weakest cell, each beside what the log itself shows.

Every quantity is a value with a standard deviation, asked from the estimator at one row of a log,
and its truth, which the whole log shows. They are pooled and judged like the SoC, apart from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from cangauge._text import number
from cangauge._typing import FloatArray
from cangauge.estimation.cells import CellEstimator
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.power import ENERGY_C_RATE, HORIZON_S, PackLimits
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.types import Power, Sample

OFFSET_AT_S: Final = 1200.0
"""When the estimated offset of the current sensor is read [s]."""
SETTLED_S: Final = 300.0
"""Earlier than this nothing is asked for power and energy [s]."""
APART_S: Final = 60.0
"""Least time between two questions of one kind [s]."""
STEADY: Final = 0.05
"""A current is constant if it stays this near its mean, relative to it."""
TAKEN_PCT: Final = 10.0
"""Least fall of the SoC to the end of a log for its energy [%]."""
FLAT: Final = 1.0 / 3.0
"""A curve is flat where its slope is below this share of its mean slope."""
_LARGEST_A: Final = 1e4


class Quantity(NamedTuple):
    """A value that the estimator gave, and its truth."""

    name: str
    value: float
    std: float
    truth: float
    is_right: bool | None = None
    """Whether the number of the weakest cell is right; None: no number was asked."""


Question = Callable[[Estimator], Quantity]
"""Asks an estimator that has just taken a row."""


@dataclass(frozen=True, eq=False)
class Questions:
    """Questions by the row of the log after which they are asked.

    Parameters
    ----------
    log : Log
        With its reference SoC, without errors of sensors.
    model : Model
    """

    log: Log
    model: Model

    def of_offset(self, offset_a: float) -> Iterator[tuple[int, Question]]:
        """Yield the questions for the offset of the current sensor [A]: 20 minutes, and the end."""

        def found(name: str) -> Question:
            return lambda estimator: Quantity(
                name, estimator.health.offset_a, estimator.health.offset_std_a, offset_a
            )

        row = int(np.searchsorted(self._since_s, OFFSET_AT_S))
        if row < len(self.log):
            yield row, found("offset at 20 min, A")
        yield len(self.log) - 1, found("offset at the end, A")

    def of_capacity(self) -> Iterator[tuple[int, Question]]:
        """Yield the question for the capacity at the end [% of the known one]."""
        true_ah = self.model.capacity_ah

        def capacity(estimator: Estimator) -> Quantity:
            health = estimator.health
            per_ah = 100.0 / true_ah
            value, std = per_ah * health.capacity_ah, per_ah * health.capacity_std_ah
            return Quantity("capacity, %", value, std, 100.0)

        yield len(self.log) - 1, capacity

    def of_power(self) -> Iterator[tuple[int, Question]]:
        """Yield questions for the current possible for 10 s [% of the current then drawn].

        Asked before a constant current, with the voltage 10 s later as the limit.
        """
        time_s, current_a, voltage_v = self.log.time_s, self.log.current_a, self.log.voltage_v
        ends = np.searchsorted(time_s, time_s + HORIZON_S - 1e-3)
        least_a, due_s = ENERGY_C_RATE * self.model.capacity_ah, SETTLED_S
        for row, end in enumerate(ends.tolist()):
            if self._since_s[row] < due_s or end >= len(self.log):
                continue
            drawn_a = current_a[row + 1 : end + 1]
            mean_a = float(drawn_a.mean())
            if abs(mean_a) < least_a or np.abs(drawn_a - mean_a).max() > STEADY * abs(mean_a):
                continue
            due_s = self._since_s[row] + APART_S
            yield row, self._current(mean_a, float(voltage_v[end]))

    def of_energy(self) -> Iterator[tuple[int, Question]]:
        """Yield the question for the energy to the SoC at the end [% of the energy taken]."""
        soc_pct = self.log.soc_pct
        row = int(np.searchsorted(self._since_s, SETTLED_S))
        if soc_pct is None or row >= len(self.log) or not soc_pct[row] - soc_pct[-1] >= TAKEN_PCT:
            return
        power_w = self.log.voltage_v * self.log.current_a
        taken_wh = float(np.trapezoid(power_w[row:], self.log.time_s[row:])) / 3600.0
        limits = PackLimits(0.0, _LARGEST_A, cutoff_soc_pct=max(float(soc_pct[-1]), 0.0))

        def energy(estimator: Estimator) -> Quantity:
            power = self._power(estimator, limits)
            per_wh = 100.0 / taken_wh
            value, std = per_wh * power.energy_wh, per_wh * power.energy_std_wh
            return Quantity("energy left, %", value, std, 100.0)

        yield row, energy

    def of_flat_curve(self) -> Iterator[tuple[int, Question]]:
        """Yield questions for the SoC [%], on the flat part of the curve and beside it."""
        soc_pct, curve = self.log.soc_pct, self.model.extended_model().model
        if soc_pct is None:
            return
        slopes = curve.pseudo_ocv_slope(np.linspace(*curve.soc_range_pct))
        due_s = SETTLED_S
        for row, since_s in enumerate(self._since_s.tolist()):
            if since_s >= due_s and math.isfinite(soc_pct[row]):
                due_s = since_s + APART_S
                is_flat = curve.pseudo_ocv_at(soc_pct[row])[1] < FLAT * slopes.mean()
                place = "on the flat part" if is_flat else "beside the flat part"
                yield row, _soc(f"SoC {place}, %", float(soc_pct[row]))

    @property
    def _since_s(self) -> FloatArray:
        return np.asarray(self.log.time_s - self.log.time_s[0])

    def _current(self, drawn_a: float, limit_v: float) -> Question:
        sign = math.copysign(1.0, drawn_a)
        limits = PackLimits(0.0, limit_v) if sign < 0.0 else PackLimits(limit_v, _LARGEST_A)
        limits = replace(limits, max_discharge_a=_LARGEST_A, max_charge_a=_LARGEST_A)
        name = f"10 s of {'discharge' if sign > 0.0 else 'charge'}, %"

        def current(estimator: Estimator) -> Quantity:
            power = self._power(estimator, limits)
            found = (power.discharge_a, power.discharge_std_a)
            if sign < 0.0:
                found = (power.charge_a, power.charge_std_a)
            per_a = 100.0 / abs(drawn_a)
            return Quantity(name, per_a * found[0], per_a * found[1], 100.0)

        return current

    def _power(self, estimator: Estimator, limits: PackLimits) -> Power:
        """Return the possible currents and the energy under other limits."""
        asked = Estimator(self.model, replace(estimator.settings, limits=limits))
        asked.restore(estimator.snapshot())
        return asked.power()


def _soc(name: str, truth_pct: float) -> Question:
    def soc(estimator: Estimator) -> Quantity:
        estimate = estimator.estimate
        return Quantity(name, estimate.soc_pct, estimate.soc_std_pct, truth_pct)

    return soc


WEAK_CAPACITY: Final = 0.8
"""Capacity of the weak cell, relative to what the same cell had: the usual end of life."""
CELLS_ALIKE: Final = 0.01
"""Relative standard deviation of the capacities of cells that repeat one real cell."""
STEP_V: Final = 1e-3
"""Resolution of a cell's voltage [V], as of the recorded ones."""


@dataclass(frozen=True, eq=False)
class WeakCell:
    """A log of cells of which one has less capacity.

    Parameters
    ----------
    log : Log
        Its voltage is the sum of the cells; ends where the weak cell is empty.
    cells_v : array of shape (n, cells)
        Voltages of the cells [V].
    number : int
        Of the weak cell, from 1.
    soc_pct : array of shape (n,)
        Its SoC [%], of a capacity of 80 % of the pack's.
    """

    log: Log
    cells_v: FloatArray
    number: int
    soc_pct: FloatArray

    @classmethod
    def of(cls, log: Log, real_v: FloatArray, cells: int, number: int) -> WeakCell:
        """Repeat the real cells, each copy of another capacity, and weaken one.

        A smaller capacity passes the cell's own curve faster. The current is nearly constant, so
        that the polarisation along the curve is the same.

        Parameters
        ----------
        log : Log
            With its reference SoC, which ends with the weakest real cell.
        real_v : array of shape (n, real cells)
            Their voltages [V].
        cells : int
            Number of cells: with as many as the real ones nothing is repeated.
        number : int
            Of the weak cell, from 1.
        """
        soc_pct = np.asarray(log.soc_pct)
        used_pct = np.maximum.accumulate(100.0 - soc_pct)
        rng = np.random.default_rng([cells, number])
        real = real_v.shape[1]
        capacity = 1.0 + CELLS_ALIKE * rng.normal(size=cells) * (np.arange(cells) >= real)
        capacity[number - 1] = WEAK_CAPACITY
        passed = [
            np.interp(used_pct / each, used_pct, real_v[:, at % real])
            for at, each in enumerate(capacity)
        ]
        cells_v = STEP_V * np.round(np.column_stack(passed) / STEP_V)
        rows = used_pct / WEAK_CAPACITY <= used_pct[-1]
        scale = float(np.mean(log.voltage_v / real_v.sum(axis=1))) * real / cells
        seen = replace(log, voltage_v=scale * cells_v.sum(axis=1)).rows(rows)
        weak_pct = 100.0 - used_pct[rows] / WEAK_CAPACITY
        return cls(seen, scale * cells_v[rows], number, weak_pct)


class CellWatch:
    """Follows the cells of a log beside an estimator, row by row.

    Parameters
    ----------
    weak : WeakCell
    estimator : Estimator
        That the log's rows are given to.
    """

    def __init__(self, weak: WeakCell, estimator: Estimator) -> None:
        self._weak = weak
        self._estimator = estimator
        count = weak.cells_v.shape[1]
        self._cells = CellEstimator(estimator.voltage_model, count)
        self._current_change_a = [0.0] * count
        last = len(weak.log) - 1
        self._asked = {last // 2: "at half", last: "at the end"}
        self.found: list[Quantity] = []

    def take(self, row: int, sample: Sample) -> None:
        """Take the cells at a row, whose sample the estimator has just taken."""
        if self._cells.is_due(sample.time_s):
            tick = self._estimator.pack_tick(sample)
            self._cells.update(tick, self._weak.cells_v[row].tolist(), self._current_change_a)
        if row in self._asked:
            report, weak = self._cells.report, self._weak
            self.found.append(
                Quantity(
                    f"weak cell {self._asked[row]}, %",
                    report.soc_pct,
                    report.soc_std_pct,
                    float(weak.soc_pct[row]),
                    report.weakest == weak.number,
                )
            )


class Verdict(NamedTuple):
    """A target of a row: its figure, limits and whether they are met."""

    name: str
    value: float
    low: float
    high: float

    @property
    def met(self) -> bool:
        """Whether the figure is within the limits; an unknown figure is not."""
        return self.low <= self.value <= self.high


@dataclass(frozen=True)
class QuantityRow:
    """A quantity of a pack in one case by models from one number of logs, over all draws."""

    pack: str
    role: str
    size: int
    case: str
    quantity: str
    asked: int
    """Number of values."""
    mae: float
    max: float
    cover: float
    """Share of the values within 2σ of the truth."""
    mean_std: float
    std_over_rmse: float
    right: int | None
    """How often the number of the weakest cell is right; None: no number was asked."""
    targets: tuple[Verdict, ...]

    @property
    def missed(self) -> tuple[str, ...]:
        """Names of the targets that are missed."""
        return tuple(target.name for target in self.targets if not target.met)


COVER_AT_LEAST: Final = 0.9
"""Share of the values within 2σ."""
CAPACITY_PCT: Final = 2.0
"""Mean error of the capacity after the charges [%]."""
OFFSET_A: Final = 0.3
"""Error of the current offset after 20 minutes, where its σ does not cover it [A]."""


def pool_quantities(
    groups: Mapping[tuple[str, str, int, str], Sequence[Quantity]],
) -> tuple[QuantityRow, ...]:
    """Return a row for each group and quantity, in order of appearance.

    Parameters
    ----------
    groups : mapping
        Pack, role, number of training logs and case → quantities; an unknown value is no value.
    """
    rows = []
    for of, quantities in groups.items():
        known = [each for each in quantities if math.isfinite(each.value + each.std)]
        names = dict.fromkeys(each.name for each in known)
        rows += [_pooled(of, name, [each for each in known if each.name == name]) for name in names]
    return tuple(rows)


def _pooled(of: tuple[str, str, int, str], name: str, found: Sequence[Quantity]) -> QuantityRow:
    error = np.array([each.value - each.truth for each in found])
    std = np.array([each.std for each in found])
    is_covered = np.abs(error) <= 2.0 * std
    rmse = float(np.sqrt(np.mean(error**2)))
    answers = [each.is_right for each in found if each.is_right is not None]
    mae, cover = float(np.abs(error).mean()), float(is_covered.mean())
    targets = [Verdict("2σ beside the SoC", cover, COVER_AT_LEAST, 1.0)]
    if name.startswith("capacity"):
        targets.append(Verdict("capacity", mae, 0.0, CAPACITY_PCT))
    if name.startswith("offset at 20"):
        unknown = (np.abs(error) > OFFSET_A) & ~is_covered
        targets.append(Verdict("offset", int(unknown.sum()), 0, 0))
    if answers:
        targets.append(Verdict("number", sum(answers), len(answers), len(answers)))
    return QuantityRow(
        *of,
        quantity=name,
        asked=len(found),
        mae=mae,
        max=float(np.abs(error).max()),
        cover=cover,
        mean_std=float(std.mean()),
        std_over_rmse=float(std.mean()) / rmse if rmse else math.inf,
        right=sum(answers) if answers else None,
        targets=tuple(targets),
    )


COLUMNS: Final[tuple[tuple[str, Callable[[QuantityRow], str]], ...]] = (
    ("pack", lambda row: row.pack),
    ("logs", lambda row: str(row.size)),
    ("case", lambda row: row.case),
    ("quantity", lambda row: row.quantity),
    ("asked", lambda row: str(row.asked)),
    ("MAE", lambda row: number(row.mae, 2)),
    ("max", lambda row: number(row.max, 2)),
    ("2σ\n%", lambda row: number(100.0 * row.cover, 0)),
    ("mean\nσ", lambda row: number(row.mean_std, 2)),
    ("σ/\nRMSE", lambda row: number(row.std_over_rmse, 2)),
    ("number\nright", lambda row: "" if row.right is None else f"{row.right} of {row.asked}"),
    ("targets", lambda row: "missed: " + ", ".join(row.missed) if row.missed else "pass"),
)
