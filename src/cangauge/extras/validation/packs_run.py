"""Models from few logs of a recorded pack, and the pack's other logs estimated in every case.

`run` fits models to a few of a pack's logs, drawn with fixed seeds, and estimates the others;
`packs_score` and `packs_quantities` pool the errors and judge them by the targets.
"""

from __future__ import annotations

import itertools
import math
import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from typing import Final, Literal, NamedTuple

import numpy as np

from cangauge._resources import single_threaded
from cangauge._typing import BoolArray, FloatArray
from cangauge.errors import InputError
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.offline import EstimateTable, gap_of, samples_of
from cangauge.estimation.power import ENERGY_C_RATE
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.validation.packs import RATE_HZ, BenchPack
from cangauge.extras.validation.packs_quantities import (
    CellWatch,
    Quantity,
    Question,
    Questions,
    WeakCell,
    pool_quantities,
)
from cangauge.extras.validation.packs_score import Bench, Failure, LogScore, pool_scores, score_log
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import capacity_from_reference
from cangauge.model.model_file import Model
from cangauge.types import Sample


class Case(NamedTuple):
    """Error or withheld input with which a log is estimated."""

    name: str
    start_error_pct: float | None = 0.0
    """Error of the given start [% SoC]; None: the start is withheld."""
    offset_a: float = 0.0
    """Added to the measured current [A]."""
    capacity_factor: float = 1.0
    """Factor on the model's capacity."""
    voltage_factor: float = 1.0
    """Factor on the measured voltage."""
    after_s: float = 0.0
    """Rows before this time are not scored [s]."""
    charges: int = 0
    """Logs are chained by so many charges, in which the current alone is measured."""
    weak_of: int = 0
    """One of so many cells has 80 % of its capacity."""
    is_foreign: bool = False
    """The logs are those of another pack."""

    def suits(self, log: Log) -> bool:
        """Whether the wrong start is one that can be given: from 0 to 100 %."""
        start = log.first_soc()
        if not self.start_error_pct or start is None:
            return True
        return 0.0 <= start[1] + self.start_error_pct <= 100.0

    @property
    def counting_is_reference(self) -> bool:
        """Whether counting repeats the reference, which is counted too, and cannot be beaten."""
        return self.start_error_pct == 0.0 and not self.offset_a and self.capacity_factor == 1.0

    @property
    def is_healthy(self) -> bool:
        """Whether nothing is wrong, but for a start that may be withheld."""
        return self._replace(name="", start_error_pct=None, after_s=0.0) == Case("", None) and (
            not self.start_error_pct
        )


CASES: Final = (
    Case("withheld", None, after_s=300.0),
    Case("given"),
    Case("start 20 % low", -20.0, after_s=600.0),
    Case("start 20 % high", 20.0, after_s=600.0),
    Case("+2 A", offset_a=2.0),
    Case("-2 A", offset_a=-2.0),
    Case("capacity +10 %", capacity_factor=1.1),
    Case("capacity -10 %", capacity_factor=0.9),
    Case("voltage +0.5 %", voltage_factor=1.005),
    Case("charges, capacity +10 %", capacity_factor=1.1, charges=3),
    Case("charges, capacity -10 %", capacity_factor=0.9, charges=3),
    Case("weak cell of 6", weak_of=6),
    Case("weak cell of 96", weak_of=96),
    Case("another pack's model", None, after_s=300.0, is_foreign=True),
)
"""Starts are given with σ 1 %. From the fifth to the last but one they are the true SoC. A log
whose wrong start would be below 0 or above 100 % is left out of that case."""

FOREIGN_LOGS: Final = 3
"""Logs of each other pack that a model is tried on."""
WEAK_NUMBERS: Final = (0.0, 0.3, 0.5, 0.7, 0.99)
"""Places of the weak cell in the row of cells: 1 and 6 of six are ends of the module."""
REST_S: Final = 600.0
"""Rest after a charge [s]: longer than the model's delays."""

QUICK_CASES: Final = ("withheld", "given", "start 20 % low")
QUICK_SIZES: Final = (3, 5)
QUICK_LOGS: Final = 4
"""Cases, numbers of training logs, and judged logs of a pack in a quick run."""


class Drive(NamedTuple):
    """A log as the estimator is given it."""

    log: Log
    is_measured: BoolArray | None = None
    """Rows with a voltage; None: all."""
    cells: WeakCell | None = None

    def samples(self, case: Case) -> Iterator[Sample]:
        """Yield the rows with the case's errors of the sensors."""
        seen = replace(
            self.log,
            current_a=self.log.current_a + case.offset_a,
            voltage_v=case.voltage_factor * self.log.voltage_v,
        )
        if self.is_measured is None:
            yield from samples_of(seen)
            return
        for sample, is_measured in zip(samples_of(seen), self.is_measured, strict=True):
            yield sample if is_measured else sample._replace(voltage_v=math.nan)


def chain(logs: Sequence[Log], capacity_ah: float) -> tuple[Log, BoolArray]:
    """Chain logs by charges; return one log, and which rows have a voltage.

    Between two logs there is a current but no voltage, at a third of the capacity per hour, until
    their difference of SoC is charged or discharged, and a rest. The reference is NaN meanwhile.

    Parameters
    ----------
    logs : sequence of Log
        Each with a reference SoC.
    capacity_ah : float
        Capacity that converts the SoC between two logs to charge [Ah].
    """
    parts: list[list[FloatArray]] = []
    begins_s, last_pct = 0.0, math.nan
    for log in logs:
        soc_pct = np.asarray(log.soc_pct)
        known = soc_pct[np.isfinite(soc_pct)]
        if parts:
            current_a = _charge(float(known[0]) - last_pct, capacity_ah)
            one = np.ones(current_a.size)
            time_s, temperature_c = begins_s + np.cumsum(one), log.temperature_c[0] * one
            parts.append([time_s, current_a, log.voltage_v[0] * one, temperature_c, math.nan * one])
            begins_s = float(time_s[-1]) + 1.0
        time_s = log.time_s + (begins_s - log.time_s[0])
        parts.append([time_s, log.current_a, log.voltage_v, log.temperature_c, soc_pct])
        begins_s, last_pct = float(time_s[-1]), float(known[-1])
    time_s, current_a, voltage_v, temperature_c, soc_pct = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    measured = np.concatenate([np.full(len(part[0]), k % 2 == 0) for k, part in enumerate(parts)])
    name = f"{logs[0].name} and {len(logs) - 1} more"
    return replace(
        logs[0],
        time_s=time_s,
        current_a=current_a,
        voltage_v=voltage_v,
        temperature_c=temperature_c,
        soc_pct=soc_pct,
        name=name,
    ), measured


def _charge(gained_pct: float, capacity_ah: float) -> FloatArray:
    """Return the currents of a charge and of the rest after it, every second [A]."""
    current_a = ENERGY_C_RATE * capacity_ah
    seconds = round(36.0 * capacity_ah * abs(gained_pct) / current_a)
    charging = np.full(seconds, -math.copysign(current_a, gained_pct))
    return np.concatenate([charging, np.zeros(round(REST_S))])


@dataclass(frozen=True, eq=False)
class _Task:
    pack: BenchPack
    size: int
    split: int
    training: list[Log]
    judged: list[Log]
    foreign: list[Log]
    cases: Sequence[Case]
    effects: Sequence[str]

    @property
    def rows(self) -> int:
        """About the number of samples to estimate."""
        return sum(len(log) for case in self.cases for log in self.logs_of(case))

    def logs_of(self, case: Case) -> list[Log]:
        """Return the recorded logs of a case."""
        if case.is_foreign:
            return self.foreign
        if case.weak_of:
            return [log for log in self.judged if log.name in self.pack.cells_v]
        return list(filter(case.suits, self.judged))

    def drives(self, case: Case, capacity_ah: float) -> Iterator[Drive]:
        """Yield what the estimator is given in a case."""
        logs = self.logs_of(case)
        if case.charges and logs:
            number = case.charges + 1
            for first in range(0, max(len(logs) - number, 0) + 1, number):
                chosen = [logs[(first + k) % len(logs)] for k in range(number)]
                yield Drive(*chain(chosen, capacity_ah))
        elif case.weak_of:
            for log in logs:
                places = [1 + int(case.weak_of * each) for each in WEAK_NUMBERS]
                for weak in places:
                    found = WeakCell.of(log, self.pack.cells_v[log.name], case.weak_of, weak)
                    yield Drive(found.log, cells=found)
        else:
            yield from map(Drive, logs)


@dataclass(frozen=True, eq=False)
class _Done:
    scores: list[LogScore] = field(default_factory=list)
    failure: Failure | None = None


def run(
    packs: Sequence[BenchPack],
    *,
    cases: Sequence[Case] = CASES,
    sizes: Sequence[int] | None = None,
    splits: int = 2,
    judged_at_most: int | None = None,
    effects: Sequence[str] = (),
    jobs: int = 1,
    seed: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Bench:
    """Fit models to few logs of each pack and estimate its other logs in every case.

    The result does not depend on `jobs`.

    Parameters
    ----------
    packs : sequence of BenchPack
        From `load`, or made from own logs.
    cases : sequence of Case
    sizes : sequence of int, optional
        Numbers of training logs; by default those of each pack.
    splits : int
        Draws of training logs for each number.
    judged_at_most : int, optional
        Estimate at most this many logs of each draw, spread evenly.
    effects : sequence of str
        Effects of the models, as for `fit`; none by default. The Newton inverse of the published
        equation is scored beside them.
    jobs : int
        Number of processes.
    seed : int
        Seed of the draws.
    progress : callable, optional
        Called with the samples done and to do after each draw.

    Raises
    ------
    InputError
        If no pack is judged with models of one of the `sizes`.
    """
    began = time.perf_counter()
    foreign = {pack.name: _foreign_logs(pack, packs) for pack in packs}
    tasks = [
        _Task(
            pack,
            size,
            split,
            training,
            _spread(judged, judged_at_most),
            foreign[pack.name],
            cases,
            effects,
        )
        for pack in packs
        for size in pack.sizes
        if sizes is None or size in sizes
        for split, (training, judged) in enumerate(pack.splits(size, splits, seed))
    ]
    if not tasks:
        raise InputError(
            "no pack is judged with models of so many logs",
            field="--logs",
            value=", ".join(map(str, sizes or ())),
            cure="use 1, 2, 3, 5 or 10, as far as the pack has logs",
        )
    total, done_rows = sum(task.rows for task in tasks), 0
    done: dict[int, _Done] = {}
    # The longest first, so that no process is left alone with one at the end.
    order = sorted(range(len(tasks)), key=lambda k: -tasks[k].rows)
    for k, found in _work([(k, tasks[k]) for k in order], jobs):
        done[k] = found
        done_rows += tasks[k].rows
        if progress is not None:
            progress(done_rows, total)
    scores = [score for k in sorted(done) for score in done[k].scores]
    return Bench(
        rows=pool_scores(scores, {pack.name: pack.chemistry for pack in packs}),
        quantities=pool_quantities(_by_row(scores)),
        logs=tuple(scores),
        failures=tuple(item.failure for k, item in sorted(done.items()) if item.failure),
        packs={
            pack.name: {
                "role": pack.role,
                "chemistry": pack.chemistry,
                "reference": pack.reference,
                "training_logs": [log.name for log in pack.training],
                "judged_logs": [log.name for log in pack.judged],
            }
            for pack in packs
        },
        settings={"effects": list(effects), "splits": splits, "seed": seed, "rate_hz": RATE_HZ},
        seconds=time.perf_counter() - began,
    )


def _work(tasks: Sequence[tuple[int, _Task]], jobs: int) -> Iterator[tuple[int, _Done]]:
    if jobs == 1:
        for k, task in tasks:
            yield k, _judge(task)
        return
    with (
        single_threaded(),
        ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool,
    ):
        running = {pool.submit(_judge, task): k for k, task in tasks}
        for future in as_completed(running):
            yield running[future], future.result()


def _spread(logs: list[Log], at_most: int | None) -> list[Log]:
    if at_most is None or len(logs) <= at_most:
        return logs
    return [logs[k] for k in np.linspace(0, len(logs) - 1, at_most).round().astype(int)]


def _judge(task: _Task) -> _Done:
    """Fit the models of one draw and score every judged log in every case."""
    began = time.perf_counter()
    try:
        capacity = task.pack.capacity_ah or capacity_from_reference(task.training)
        model = fit(task.training, capacity_ah=capacity, effects=task.effects).model
        plain = fit(task.training, capacity_ah=capacity).model if task.effects else model
        model.extended_model()  # refuses coefficients that no pack has
    except InputError as error:
        return _Done(failure=Failure(task.pack.name, task.size, task.split, str(error)))
    fit_seconds = time.perf_counter() - began
    scores = []
    for case in task.cases:
        for drive in task.drives(case, model.capacity_ah):
            ran = _estimate(drive, model, case, _questions(drive.log, model, case, task.pack))
            newton = ran.table
            if plain is not model:
                newton = _estimate(drive, plain, case, method="newton").table
            score = score_log(ran.table, newton.soc_newton_pct, drive.log, case.after_s)
            scores.append(
                replace(
                    score,
                    pack=task.pack.name,
                    role=task.pack.role,
                    case=case.name,
                    size=task.size,
                    split=task.split,
                    counting_is_reference=case.counting_is_reference,
                    is_model_wrong=case.is_foreign,
                    quantities=ran.quantities,
                    fit_seconds=fit_seconds,
                    step_us=1e6 * ran.seconds / len(drive.log),
                )
            )
    return _Done(scores)


def _foreign_logs(pack: BenchPack, packs: Sequence[BenchPack]) -> list[Log]:
    """Return some logs of the other packs of the same role, named by pack."""
    others = {other.place: other for other in packs if other.role == pack.role}
    return [
        replace(log, name=f"{other.name}: {log.name}")
        for place, other in others.items()
        if place != pack.place
        for log in _spread(list(other.judged), FOREIGN_LOGS)
    ]


def _by_row(scores: Sequence[LogScore]) -> dict[tuple[str, str, int, str], list[Quantity]]:
    groups: dict[tuple[str, str, int, str], list[Quantity]] = {}
    for score in scores:
        row = (score.pack, score.role, score.size, score.case)
        groups.setdefault(row, []).extend(score.quantities)
    return groups


def _questions(log: Log, model: Model, case: Case, pack: BenchPack) -> dict[int, list[Question]]:
    """Return what is asked for in a case, by row."""
    ask = Questions(log, model)
    asked: list[Iterator[tuple[int, Question]]] = []
    if case.offset_a:
        asked.append(ask.of_offset(case.offset_a))
    if case.charges:
        asked.append(ask.of_capacity())
    if case.is_healthy:
        asked += [ask.of_power(), ask.of_energy()]
        if pack.chemistry == "lfp":
            asked.append(ask.of_flat_curve())
    by_row: dict[int, list[Question]] = {}
    for row, question in itertools.chain.from_iterable(asked):
        by_row.setdefault(row, []).append(question)
    return by_row


class _Ran(NamedTuple):
    table: EstimateTable
    quantities: tuple[Quantity, ...]
    seconds: float


def _estimate(
    drive: Drive,
    model: Model,
    case: Case,
    questions: Mapping[int, Sequence[Question]] | None = None,
    *,
    method: Literal["ekf", "newton"] = "ekf",
) -> _Ran:
    """Run the estimator over a log with the case's errors, and ask it."""
    log, start = drive.log, drive.log.first_soc()
    initial = None
    if case.start_error_pct is not None and start is not None:
        initial = min(max(start[1] + case.start_error_pct, 0.0), 100.0)
    estimator = make_estimator(
        model,
        EstimatorSettings(
            method=method,
            initial_soc_pct=initial,
            capacity_ah=case.capacity_factor * model.capacity_ah,
            gap_s=gap_of(log),
            temperature_source=log.temperature_source,
        ),
    )
    watch = None if drive.cells is None else CellWatch(drive.cells, estimator)
    estimates, found = [], []
    began, asking_s = time.perf_counter(), 0.0
    for row, sample in enumerate(drive.samples(case)):
        estimates.append(estimator.step(sample))
        if watch is not None:
            watch.take(row, sample)
        if questions and row in questions:
            asks = time.perf_counter()
            found += [question(estimator) for question in questions[row]]
            asking_s += time.perf_counter() - asks
    seconds = time.perf_counter() - began - asking_s
    if watch is not None:
        found += watch.found
    return _Ran(EstimateTable.of(estimates), tuple(found), seconds)
