"""The estimator on recorded packs: models from few logs, errors and their σ on the other logs.

`load` reads the packs, `run` fits models to a few of a pack's logs, drawn with fixed seeds, and
estimates the others in every case; `packs_score` pools the errors and judges them by the targets.

Constants of the filter may be chosen on packs of the role "development" only. A log that a pack of
the role "judged" is scored on is in no development pack. But its models are trained on development
logs too, and `leaf_module` and `a123_lfp` alone are packs of which development knows no log at all.
"""

from __future__ import annotations

import math
import multiprocessing
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np

from cangauge._resources import single_threaded
from cangauge.errors import InputError
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.offline import EstimateTable, gap_of, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.identify.fit import fit
from cangauge.inference.rows import decimate
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.coulomb_counting import capacity_from_reference, counted_soc_pct
from cangauge.model.model_file import Model
from cangauge.validation.packs_score import Bench, Failure, LogScore, pool_scores, score_log
from cangauge.validation.recordings import (
    LG_CAPACITY_AH,
    LG_PARALLEL,
    LG_SERIES,
    WINTER,
    folder_of,
    is_folder,
)
from cangauge.validation.twin.injection import scaled_to_pack

Role = Literal["development", "judged"]
Chemistry = Literal["nmc", "lfp"]
"""Layered oxides and spinels (NMC, NCA, LMO blends), whose voltage falls all along; or LFP."""

SIZES: Final = (1, 2, 3, 5, 10)
"""Numbers of training logs of the learning curve."""
MIN_MINUTES: Final = 14.5
"""Shorter logs train, but are not judged: a wrong start has ten minutes to be found out [min]."""
RATE_HZ: Final = 1.0
"""Rate of the judged logs [Hz]: the models', at which a filter uses the voltage. Every row in
between is left out, as on a slow bus; the reference is counted before."""
PIECE_S: Final = 1800.0
"""Length of the pieces that recordings of hours are cut into [s], as a usual trip."""
_MODULE_SERIES: Final = 16
_MODULE_CAPACITY_AH: Final = 55.1
"""Mean of the four full discharges at 0.3 to 2.75 C, 54.9 to 55.4 Ah."""
_A123_CAPACITY_AH: Final = 2.07
"""Discharge at C/30 and 25 °C [Ah]."""
_A123_PARALLEL: Final = 20


class Case(NamedTuple):
    """What is wrong, or not told, while a log is estimated."""

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
)
"""Starts are given with σ 1 %. The cases after the fourth start from the true SoC. A log whose
wrong start would be below 0 or above 100 % is left out of that case."""

QUICK_CASES: Final = ("withheld", "given", "start 20 % low")
QUICK_SIZES: Final = (3, 5)
QUICK_LOGS: Final = 4
"""Cases, numbers of training logs, and judged logs of a pack in a quick run."""


@dataclass(frozen=True, eq=False)
class BenchPack:
    """Logs of a pack that train models, and logs that judge them.

    Parameters
    ----------
    name : str
    role : {"development", "judged"}
        Whether constants may be chosen on it.
    chemistry : {"nmc", "lfp"}
    training : sequence of Log
        Drawn from for the models; each with its reference SoC.
    judged : sequence of Log
        Each with a reference SoC; those in a model's training are left out.
    reference : str
        What the reference SoC is, and its own error.
    capacity_ah : float, optional
        Known capacity [Ah]; by default the training logs' charge per 100 % of their reference.
    sizes : sequence of int
        Numbers of training logs.
    """

    name: str
    role: Role
    chemistry: Chemistry
    training: Sequence[Log]
    judged: Sequence[Log]
    reference: str
    capacity_ah: float | None = None
    sizes: Sequence[int] = SIZES

    def splits(self, size: int, number: int, seed: int) -> Iterator[tuple[list[Log], list[Log]]]:
        """Yield training and judged logs of at most `number` different draws."""
        seen = set()
        for split in range(number):
            rng = np.random.default_rng([seed, zlib.crc32(self.name.encode()), size, split])
            chosen = frozenset(rng.permutation(len(self.training))[:size].tolist())
            training = [self.training[k] for k in sorted(chosen)]
            names = {log.name for log in training}
            judged = [log for log in self.judged if log.name not in names]
            if chosen not in seen and len(training) == size and judged:
                seen.add(chosen)
                yield training, judged


def load(folder: Path, names: Sequence[str] | None = None) -> list[BenchPack]:
    """Read the recorded packs of a folder.

    Parameters
    ----------
    folder : Path
        Contains `bmw_i3`, `batic_car1`, `lg_hg2`, `leaf_module_ornl` and `a123_lfp`, or some of
        them (the README lists the sources).
    names : sequence of str, optional
        Packs to read; by default all whose folder is there.

    Raises
    ------
    InputError
        If the folder is absent, a name is unknown, or a named pack or every pack is absent.
    """
    if not is_folder(folder):
        raise InputError(
            "the folder does not exist", field="--data", value=str(folder),
            cure="name the folder of the recorded logs",
        )  # fmt: skip
    for name in names or ():
        if name not in PACKS:
            raise InputError(
                "unknown pack", field="--pack", value=name, cure=f"use {', '.join(PACKS)}"
            )
    packs = []
    for name, (place, read) in PACKS.items():
        if names is None and not is_folder(folder / place):
            continue
        if names is None or name in names:
            packs.append(replace(read(folder_of(place, folder)), name=name))
    if not packs:
        raise InputError(
            "no recorded packs in this folder",
            field="--data",
            value=str(folder),
            cure=f"name the folder that contains {', '.join(dict(PACKS.values()))}",
        )
    return packs


def _i3(folder: Path, judged: Sequence[str], role: Role) -> BenchPack:
    odd = [_read(folder / f"TripA{number:02d}.csv.gz") for number in range(1, 22, 2)]
    return BenchPack(
        "i3",
        role,
        "nmc",
        odd,
        _judgeable([_read(folder / f"Trip{name}.csv.gz") for name in judged]),
        "the car's own SoC in steps of 0.1 %, itself counted; its offset is unknown",
    )


def _car1(folder: Path, role: Role) -> BenchPack:
    pieces = [
        piece for path in sorted(folder.glob("car1_*.csv.gz")) for piece in _pieces(_read(path))
    ]
    training = pieces[::2] if role == "development" else pieces
    return BenchPack(
        "car1",
        role,
        "nmc",
        training,
        _judgeable(pieces[::2] if role == "development" else pieces[1::2]),
        "the car's own SoC in steps of 0.1 %, itself counted; its offset is unknown",
    )


def _lg(folder: Path, trained: str, judged: str, role: Role, sizes: Sequence[int]) -> BenchPack:
    def packs(patterns: str) -> list[Log]:
        paths = sorted({path for each in patterns.split() for path in folder.glob(each)})
        drives = [path for path in paths if "_Cap_" not in path.name]
        return [
            as_pack(_read(path), LG_SERIES, LG_PARALLEL, LG_CAPACITY_AH, 100.0) for path in drives
        ]

    return BenchPack(
        "lg_hg2",
        role,
        "nmc",
        packs(trained),
        _judgeable(packs(judged)),
        "counted from full with 2.78 Ah a cell (25 °C; 2.69 to 2.72 Ah at 1 C): its error grows"
        " from 0 % when full to 3 % when empty",
        LG_CAPACITY_AH * LG_PARALLEL,
        sizes,
    )


def _leaf_module(folder: Path) -> BenchPack:
    logs = [
        as_pack(_read(path), _MODULE_SERIES, 1, _MODULE_CAPACITY_AH, 100.0)
        for path in sorted(folder.glob("module123-*.csv.gz"))
    ]
    return BenchPack(
        "leaf_module",
        "judged",
        "nmc",
        logs,
        _judgeable(logs),
        "counted from full to the cut-off of the weakest cell with 55.1 Ah (54.9 to 55.4): 0.5 %",
        _MODULE_CAPACITY_AH,
        (1, 2, 3),
    )


def _a123(folder: Path) -> BenchPack:
    logs = [
        as_pack(_read(path), LG_SERIES, _A123_PARALLEL, _A123_CAPACITY_AH, start_pct)
        for script, start_pct in (("s1", 100.0), ("s3", 0.0))
        for path in sorted(folder.glob(f"A123_DYN_*_{script}.csv.gz"))
    ]
    return BenchPack(
        "a123_lfp",
        "judged",
        "lfp",
        logs,
        _judgeable(logs),
        "counted from full (drives) or empty (charges) with 2.07 Ah a cell; whole charges take 2.06"
        " to 2.07 Ah: 0.5 %",
        _A123_CAPACITY_AH * _A123_PARALLEL,
        (1, 2, 3, 5),
    )


_EVEN: Final = tuple(f"A{number:02d}" for number in range(2, 23, 2))
_ODD: Final = tuple(f"A{number:02d}" for number in range(1, 22, 2))
_LG_COLD: Final = "0degC__5*_US06* 0degC__5*_Mixed* 10degC__5*_US06* 10degC__5*_Mixed*"
_LG_COLD_JUDGED: Final = "0degC__590_Mixed5* 0degC__589_US06* 10degC__571_Mixed7* 10degC__567_US*"

PACKS: Final[dict[str, tuple[str, Callable[[Path], BenchPack]]]] = {
    "i3_dev": ("bmw_i3", lambda folder: _i3(folder, _ODD, "development")),
    "car1_dev": ("batic_car1", lambda folder: _car1(folder, "development")),
    "lg_hg2_dev": (
        "lg_hg2",
        lambda folder: _lg(folder, "25degC__551_*", "25degC__551_*", "development", (1, 2, 3)),
    ),
    "i3": ("bmw_i3", lambda folder: _i3(folder, _EVEN, "judged")),
    "i3_winter": ("bmw_i3", lambda folder: _i3(folder, WINTER, "judged")),
    "car1": ("batic_car1", lambda folder: _car1(folder, "judged")),
    "lg_hg2": (
        "lg_hg2",
        lambda folder: _lg(folder, "25degC__*", "25degC__552_*", "judged", (1, 2, 3, 5)),
    ),
    "lg_hg2_cold": (
        "lg_hg2",
        lambda folder: _lg(folder, _LG_COLD, _LG_COLD_JUDGED, "judged", SIZES),
    ),
    "lg_hg2_from_25c": (
        "lg_hg2",
        lambda folder: _lg(folder, "25degC__551_*", _LG_COLD_JUDGED, "judged", (3,)),
    ),
    "leaf_module": ("leaf_module_ornl", _leaf_module),
    "a123_lfp": ("a123_lfp", _a123),
}
"""Pack → folder and reader. `_dev`: the part that constants may be chosen on. `i3_winter` and
`lg_hg2_from_25c` are judged at temperatures that their models have not seen."""

DEVELOPMENT: Final = ("i3_dev", "car1_dev", "lg_hg2_dev")


def as_pack(log: Log, series: int, parallel: int, cell_capacity_ah: float, start_pct: float) -> Log:
    """Return the log of a cell as that of a pack of equal cells, with its SoC counted.

    Voltage × `series`, current × `parallel`; all cells are equal, the wiring has no resistance.

    Parameters
    ----------
    log : Log
        Of one cell (or module).
    series, parallel : int
        Cells (or modules) in series and in parallel.
    cell_capacity_ah : float
        Known capacity of the cell [Ah], positive.
    start_pct : float
        Known SoC at the first row [%].
    """
    soc_pct = counted_soc_pct(log, cell_capacity_ah, start_pct)
    return replace(scaled_to_pack(log, series=series, parallel=parallel), soc_pct=soc_pct)


def _read(path: Path) -> Log:
    return read_log(path)


def _pieces(log: Log) -> list[Log]:
    """Return a recording in pieces of about `PIECE_S`."""
    number = max(1, round(log.duration_s / PIECE_S))
    edges = np.linspace(log.time_s[0], log.time_s[-1], number + 1)[1:-1]
    bounds = [0, *np.searchsorted(log.time_s, edges).tolist(), len(log)]
    return [
        replace(log.rows(slice(low, high)), name=f"{log.name}_{part}")
        for part, (low, high) in enumerate(pairwise(bounds), start=1)
    ]


def _judgeable(logs: Sequence[Log]) -> list[Log]:
    """Return the logs that are long enough, at `RATE_HZ`."""
    long = [log for log in logs if log.duration_s >= 60.0 * MIN_MINUTES]
    return [log.rows(decimate(log.time_s, RATE_HZ)) for log in long]


@dataclass(frozen=True, eq=False)
class _Task:
    pack: BenchPack
    size: int
    split: int
    training: list[Log]
    judged: list[Log]
    cases: Sequence[Case]
    effects: Sequence[str]

    @property
    def rows(self) -> int:
        """Number of samples to estimate."""
        return sum(len(log) for case in self.cases for log in filter(case.suits, self.judged))


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
    tasks = [
        _Task(pack, size, split, training, _spread(judged, judged_at_most), cases, effects)
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
        for log in filter(case.suits, task.judged):
            ran = _estimate(log, model, case)
            newton = ran.table
            if plain is not model:
                newton = _estimate(log, plain, case, "newton").table
            score = score_log(ran.table, newton.soc_newton_pct, log, case.after_s)
            scores.append(
                replace(
                    score,
                    pack=task.pack.name,
                    role=task.pack.role,
                    case=case.name,
                    size=task.size,
                    split=task.split,
                    counting_is_reference=case.counting_is_reference,
                    offset_a=case.offset_a,
                    found_offset_a=ran.offset_a,
                    fit_seconds=fit_seconds,
                    step_us=1e6 * ran.seconds / len(log),
                )
            )
    return _Done(scores)


class _Ran(NamedTuple):
    table: EstimateTable
    offset_a: float
    seconds: float


OFFSET_AT_S: Final = 1200.0
"""When the estimated offset of the current sensor is read [s]."""


def _estimate(log: Log, model: Model, case: Case, method: Literal["ekf", "newton"] = "ekf") -> _Ran:
    """Run the estimator over a log with the case's errors; NaN offset for a shorter log."""
    start = log.first_soc()
    initial = None
    if case.start_error_pct is not None and start is not None:
        initial = min(max(start[1] + case.start_error_pct, 0.0), 100.0)
    seen = replace(
        log,
        current_a=log.current_a + case.offset_a,
        voltage_v=case.voltage_factor * log.voltage_v,
    )
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
    read_s, offset_a = log.time_s[0] + OFFSET_AT_S, math.nan
    began = time.perf_counter()
    estimates = []
    for sample in samples_of(seen):
        estimates.append(estimator.step(sample))
        if sample.time_s >= read_s and math.isnan(offset_a) and method == "ekf":
            offset_a = estimator.filter.offset_a
    seconds = time.perf_counter() - began
    return _Ran(EstimateTable.of(estimates), offset_a, seconds)
