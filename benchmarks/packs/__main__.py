"""SoC errors on recorded packs, with models from few logs.

    make packs DATA=FOLDER                                     # or, in benchmarks/
    python -m packs --data FOLDER [--pack NAME]… [--case NAME]… [--draws 10] [--keep]
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
import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

import cangauge
from figures import publish

from .estimators import ESTIMATORS, Estimated, Told
from .recorded import MONTHS, PACKS, counted_ah, first_of_each, load, on_one_clock
from .scores import COVER, LATE_S, SETTLED_S, Row, pool, score


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


DESCRIBES = (
    "src/cangauge/model",
    "src/cangauge/identify",
    "src/cangauge/estimation",
    "core",
    "benchmarks/packs",
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
                scores = defaultdict(list)
                for _, training, judged in pack.draws(size, draws, seed):
                    told = Told(pack.chemistry, pack.cells, pack.capacity_of(training))
                    try:
                        model = estimator.fit(training, told)
                    except cangauge.InputError as error:
                        sys.stderr.write(f"{pack.name} {size} {name}: {error}\n")
                        continue
                    for case in cases:
                        logs = foreign if case.is_foreign else filter(case.suits, judged)
                        for log in logs:
                            found = _score(estimator, model, told, case, log)
                            scores[case].append(found)
                for case, found in scores.items():
                    row = pool(found, estimator=name, pack=pack.name, size=size, case=case.name)
                    rows.append(row)
                    _show(row)
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
                row = pool(found, estimator=name, pack=pack.name, size=len(training), case=case)
                rows.append(row)
                _show(row)
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


def _show(row: Row) -> None:
    """Report a row as soon as it is measured."""
    sys.stderr.write(
        f"{row.estimator} {row.pack} {row.size} {row.case}: MAE {row.mae:.2f} %, by voltage alone "
        f"{row.newton:.2f} %, by counting {row.counting:.2f} %\n"
    )


ERROR = ("MAE [%]", "median [%]")
CERTAINTY = (
    "by voltage alone [%]",
    "by counting [%]",
    "within 2σ",
    "rows with 2σ ≥ 88 %",
    "VALID",
    "wrong and VALID",
    "right and not VALID",
    "astray",
)
"""Columns of an estimator that states a standard deviation and a validity."""


def _states_certainty(rows: Sequence[Row]) -> bool:
    return any(row.cover for row in rows)


def by_case(rows: Sequence[Row], title: str = "") -> Table:
    """Return the means of each case over packs and numbers of logs."""
    has_certainty = _states_certainty(rows)
    table = Table("case", *ERROR, *(CERTAINTY if has_certainty else ()), title=title)
    for case, group in grouped(rows, "case"):
        error = f"{_mean(group, 'mae'):.2f}", f"{_mean(group, 'median'):.2f}"
        table.add_row(case, *error, *(_certainty(group) if has_certainty else ()))
    return table


def _certainty(group: Sequence[Row]) -> tuple[str, ...]:
    """Return the cells of `CERTAINTY`."""
    enough = sum(row.cover >= COVER for row in group)
    return (
        f"{_mean(group, 'newton'):.2f}",
        f"{_mean(group, 'counting'):.2f}",
        f"{_mean(group, 'cover'):.0%}",
        f"{enough} of {len(group)}",
        f"{_mean(group, 'valid'):.0%}",
        f"{_mean(group, 'valid_wrong'):.1%}",
        f"{_mean(group, 'right_not_valid'):.0%}",
        f"{sum(row.astray for row in group)} of {sum(row.logs for row in group)}",
    )


def by_pack(rows: Sequence[Row]) -> Table:
    """Return the MAE [%] of each pack and number of logs in each case."""
    cases = list(dict.fromkeys(row.case for row in rows))
    has_certainty = _states_certainty(rows)
    table = Table("pack", "logs", *cases, *(["most wrong and VALID"] if has_certainty else ()))
    for (pack, size), group in grouped(rows, "pack", "size"):
        mae = {row.case: f"{row.mae:.2f}" for row in group}
        cells = [pack, str(size), *(mae.get(case, "") for case in cases)]
        if has_certainty:
            worst = max(group, key=lambda row: row.valid_wrong)
            wrong = f"{worst.valid_wrong:.1%} ({worst.case})" if worst.valid_wrong else "none"
            cells.append(wrong)
        table.add_row(*cells)
    return table


def grouped(rows: Sequence[Row], *names: str) -> list[tuple[Any, list[Row]]]:
    """Return the rows with equal fields, in the order of their first."""
    groups = defaultdict(list)
    for row in rows:
        groups[attrgetter(*names)(row)].append(row)
    return list(groups.items())


def _mean(rows: Sequence[Row], name: str) -> float:
    return float(np.mean([getattr(row, name) for row in rows]))


def main() -> None:
    """Run, print, and keep the figures."""
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
    parser.add_argument("--keep", action="store_true", help="keep the figures of docs/results.md")
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
    packs = load(options.data, names)
    drawn = {"sizes": options.logs, "draws": options.draws, "seed": options.seed}
    rows = (
        run_months(packs, estimators, **drawn)
        if options.months
        else run(packs, estimators, cases, **drawn)
    )
    for estimator, group in grouped(rows, "estimator"):
        if options.months:
            name = f"months-{estimator}"
            tables = [by_case(each, pack) for pack, each in grouped(group, "pack")]
        else:
            name = f"packs-{estimator}"
            tables = [by_case(group), by_pack(group)]
        publish(name, tables, DESCRIBES, keeps=options.keep, width=200)


if __name__ == "__main__":
    main()
