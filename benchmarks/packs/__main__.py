"""SoC errors on recorded packs, with models from few logs.

    make packs DATA=FOLDER                                     # or, in benchmarks/
    python -m packs --data FOLDER [--pack NAME]… [--case NAME]… [--draws 10] [--json FILE]
    python -m packs --data FOLDER --months

Models are fitted to 1, 2, 3, 5 and 10 logs of a pack, drawn with fixed seeds; they estimate the
pack's other logs with the start withheld (scored after five minutes), given, or 20 % low (scored
after ten), with errors of the sensors, without a temperature, and at one sample in 10, 30 or 60 s.
With `--months` the first five (or N) logs of a car make the model. One estimator, which restarts
from its state at each drive, goes through all others in time order, with stops and nights of random
length between; beside it, one starts anew at each drive. Constants may be chosen on the `_dev`
packs only.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
import json
import math
import sys
import time
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import cangauge

from .estimators import ESTIMATORS, Estimated, Told
from .recorded import MONTHS, PACKS, counted_ah, first_of_each, load, on_one_clock
from .scores import LATE_S, SETTLED_S, Row, judge, pool, score


@dataclass(frozen=True)
class Case:
    """Error or withheld input with which a log is estimated."""

    name: str
    start_error_pct: float | None = 0.0
    """Error of the given start [% SoC]; None: withheld."""
    after_s: float = 0.0
    offset_a: float = 0.0
    capacity_factor: float = 1.0
    voltage_factor: float = 1.0
    current_factor: float = 1.0
    every_s: float = 0.0
    """Interval of the samples [s]; 0: that of the log."""
    has_temperature: bool = True
    is_foreign: bool = False
    """The logs are those of other packs."""

    def suits(self, log) -> bool:
        """Whether the wrong start is one that can be given: from 0 to 100 %."""
        return not self.start_error_pct or 0.0 <= _start(log) + self.start_error_pct <= 100.0

    def seen(self, log):
        """Return the log as the sensors state it, with the reference SoC."""
        log = first_of_each(log, self.every_s) if self.every_s else log
        return replace(
            log,
            current_a=self.current_factor * log.current_a + self.offset_a,
            voltage_v=log.voltage_v * self.voltage_factor,
        )


CASES = (
    Case("withheld", None, SETTLED_S),
    Case("given"),
    Case("20 % low", -20.0, LATE_S),
    Case("+2 A", offset_a=2.0),
    Case("capacity +10 %", capacity_factor=1.1),
    Case("capacity -10 %", capacity_factor=0.9),
    Case("voltage +0.5 %", voltage_factor=1.005),
    Case("+0.5 %, withheld", None, SETTLED_S, voltage_factor=1.005),
    Case("one in 10 s", every_s=10.0),
    Case("one in 30 s", every_s=30.0),
    Case("one in 60 s", every_s=60.0),
    Case("no temperature", None, SETTLED_S, has_temperature=False),
    Case("wrong sign", None, SETTLED_S, current_factor=-1.0),
    Case("foreign model", None, SETTLED_S, is_foreign=True),
)
FOREIGN_LOGS = 3
"""Logs of each other pack that a model is tried on."""


def _start(log) -> float:
    """Return the first finite reference SoC [%]."""
    return float(log.soc_pct[np.isfinite(log.soc_pct)][0])


def run(packs, estimators, cases, *, sizes, draws: int, seed: int) -> list[Row]:
    """Return the rows of every estimator, pack, number of logs and case."""
    rows = []
    for pack in packs:
        others = {other.group: other for other in packs if other.role == pack.role}
        foreign = [
            log for group, other in others.items() if group != pack.group
            for log in other.judged[:FOREIGN_LOGS]
        ]  # fmt: skip
        for size in [size for size in pack.sizes if not sizes or size in sizes]:
            for name, estimator in estimators.items():
                began = time.perf_counter()
                scores, failures = defaultdict(list), 0
                for _, training, judged in pack.draws(size, draws, seed):
                    told = Told(pack.chemistry, pack.cells, pack.capacity_of(training))
                    try:
                        model = estimator.fit(training, told)
                    except cangauge.InputError as error:
                        sys.stderr.write(f"{pack.name} {size} {name}: {error}\n")
                        failures += 1
                        continue
                    for case in cases:
                        logs = foreign if case.is_foreign else filter(case.suits, judged)
                        for log in logs:
                            found = _score(estimator, model, told, case, log)
                            scores[case].append(found)
                for case, found in scores.items():
                    row = pool(
                        found, estimator=name, pack=pack.name, role=pack.role,
                        chemistry=pack.chemistry, size=size, case=case.name, draws=draws,
                    )  # fmt: skip
                    row.failures = failures
                    row.seconds = time.perf_counter() - began
                    judge(row, counting_is_reference=_counts_reference(case))
                    rows.append(row)
                    _print(row)
    return rows


MONTHS_SIZE = 5
"""Training logs of a car in time order: the first days that an owner logs."""


def run_months(packs, estimators, *, sizes, draws: int, seed: int) -> list[Row]:
    """Return the rows of every estimator and car, carried on and started anew at each drive."""
    rows = []
    for pack, size in itertools.product(packs, sizes or [MONTHS_SIZE]):
        training, later = pack.months(size)
        judged = {log.name for log in pack.judged}
        told = Told(pack.chemistry, pack.cells, pack.capacity_of(training))
        for name, estimator in estimators.items():
            began = time.perf_counter()
            model = estimator.fit(training, told)
            scores = defaultdict(list)
            for draw in range(draws):
                days = on_one_clock(later, [seed, draw])
                blind = [replace(day, soc_pct=None) for day in days]
                carried = estimator.estimate_days(blind, model, told.capacity_ah)
                edges = np.cumsum([len(day) for day in days])[:-1]
                parts = zip(*(np.split(each, edges) for each in carried[:3]), strict=True)
                status = [None] * len(days)
                if carried.status is not None:
                    status = np.split(carried.status, edges)
                for day, part, its_status in zip(days, parts, status, strict=True):
                    if day.name in judged:
                        found = Estimated(*part, its_status, carried.mismatch)
                        scores["months"].append(_compare(day, found, None, told.capacity_ah))
            for day in later:
                if day.name in judged:
                    blind = replace(day, soc_pct=None)
                    found = estimator.estimate(blind, model, None, told.capacity_ah)
                    scores["anew"].append(_compare(day, found, None, told.capacity_ah))
            for case, found in scores.items():
                row = pool(
                    found, estimator=name, pack=pack.name, role=pack.role,
                    chemistry=pack.chemistry, size=len(training), case=case, draws=draws,
                )  # fmt: skip
                row.seconds = time.perf_counter() - began
                rows.append(row)
                _print(row)
    return rows


def _score(estimator, model, told: Told, case: Case, log):
    seen, start_pct = case.seen(log), None
    if case.start_error_pct is not None:
        start_pct = _start(log) + case.start_error_pct
    capacity_ah = told.capacity_ah * case.capacity_factor
    blind = replace(seen, soc_pct=None)
    if case.has_temperature:
        found = estimator.estimate(blind, model, start_pct, capacity_ah)
    else:
        found = estimator.estimate_without_temperature(blind, model, capacity_ah)
    return _compare(seen, found, start_pct, capacity_ah, case.after_s)


def _compare(log, found: Estimated, start_pct, capacity_ah: float, after_s: float = SETTLED_S):
    """Score an estimate; an unknown start is counted from the first voltage."""
    by_voltage = found.newton_pct[np.isfinite(found.newton_pct)]
    begin_pct = (by_voltage[0] if by_voltage.size else np.nan) if start_pct is None else start_pct
    counted = begin_pct - 100.0 * counted_ah(log) / capacity_ah
    return score(
        log, found.soc_pct, found.std_pct, found.newton_pct, counted, status=found.status,
        after_s=after_s, mismatch=found.mismatch,
    )  # fmt: skip


def _counts_reference(case: Case) -> bool:
    """Whether counting repeats the reference, which is counted too, and cannot be beaten."""
    return (
        case.start_error_pct == 0.0
        and not case.offset_a
        and case.capacity_factor == case.current_factor == 1.0
    )


HEADING = (
    f"{'estimator':12} {'pack':15} {'logs':>4} {'case':16} {'MAE':>6} {'median':>6} {'Newton':>6} "
    f"{'count':>6} {'2σ %':>5} {'σ':>5} {'σ/RMSE':>6} {'astray':>11} {'VALID':>5} {'wrong':>6} "
    f"{'right':>5}  missed"
)


def _print(row) -> None:
    missed = [name for name, met in row.targets.items() if not met]
    print(
        f"{row.estimator:12} {row.pack:15} {row.size:4d} {row.case:16} {row.mae:6.2f} "
        f"{row.median:6.2f} {row.newton:6.2f} {row.counting:6.2f} {100 * row.cover:5.0f} "
        f"{row.std:5.2f} {row.std / max(row.rmse, 1e-9):6.2f} {row.astray:4d} of {row.logs:<4d} "
        f"{100 * row.valid:5.0f} {100 * row.valid_wrong:6.1f} {100 * row.right_not_valid:5.0f}  "
        f"{', '.join(missed)}",
        flush=True,
    )


def _summary(rows: list) -> None:
    """Print how many rows meet each target, judged packs apart from development."""
    groups = defaultdict(list)
    for row in rows:
        if row.targets:
            kind = row.role + (", LFP" if row.chemistry == "lfp" else "")
            groups[row.estimator, kind].append(row)
    for (estimator, kind), group in groups.items():
        names = dict.fromkeys(name for row in group for name in row.targets)
        parts = [
            f"{name}: {sum(row.targets.get(name, False) for row in group)}"
            f" of {sum(name in row.targets for row in group)}"
            for name in names
        ]
        logs, astray = sum(row.logs for row in group), sum(row.astray for row in group)
        withheld = [row.std / row.rmse for row in group if row.case == "withheld" and row.rmse]
        median = float(np.median(withheld)) if withheld else math.nan
        print(f"{estimator}, {kind}, {len(group)} rows: {'; '.join(parts)};"
              f" astray {astray} of {logs} logs; median σ/RMSE withheld {median:.2f}")  # fmt: skip


def main() -> None:
    """Run, print, and keep as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of the recorded logs")
    parser.add_argument("--pack", action="append", choices=PACKS, help="default: all")
    parser.add_argument("--role", choices=("development", "judged"), help="default: both")
    parser.add_argument("--case", action="append", choices=[case.name for case in CASES])
    parser.add_argument("--months", action="store_true", help="cars in time order instead")
    parser.add_argument("--logs", action="append", type=int, metavar="N", help="training logs")
    parser.add_argument("--draws", type=int, default=10, metavar="N")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the draws")
    parser.add_argument("--estimator", action="append", metavar="NAME|MODULE:CLASS",
                        help=f"{', '.join(ESTIMATORS)}, or a class; default: cangauge")  # fmt: skip
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows here too")
    options = parser.parse_args()
    names = options.pack or [
        name for name in (MONTHS if options.months else PACKS)
        if options.role is None or name.endswith("_dev") == (options.role == "development")
    ]  # fmt: skip
    cases = [case for case in CASES if not options.case or case.name in options.case]
    estimators = {}
    for name in options.estimator or ["cangauge"]:
        module, _, kind = name.rpartition(":")
        made = getattr(importlib.import_module(module), kind) if module else ESTIMATORS[name]
        estimators[name] = made()
    began = time.perf_counter()
    print(HEADING)
    packs = load(options.data, names)
    drawn = {"sizes": options.logs, "draws": options.draws, "seed": options.seed}
    if options.months:
        rows = run_months(packs, estimators, **drawn)
    else:
        rows = run(packs, estimators, cases, **drawn)
        _summary(rows)
    if options.json:
        result = {
            "schema": 1, "draws": options.draws, "seed": options.seed,
            "seconds": time.perf_counter() - began, "rows": [row.to_dict() for row in rows],
        }  # fmt: skip
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
