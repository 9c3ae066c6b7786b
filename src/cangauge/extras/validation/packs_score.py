"""Errors of the estimator on recorded packs: scored log by log, pooled to rows, judged by targets.

A log counts by its samples. Errors are of the SoC [%] against the log's reference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cangauge._text import duration, number, printable
from cangauge._typing import FloatArray
from cangauge.estimation.offline import EstimateTable
from cangauge.extras.validation.packs_quantities import COLUMNS as QUANTITY_COLUMNS
from cangauge.extras.validation.packs_quantities import Quantity, QuantityRow, Verdict
from cangauge.logs.log import Log
from cangauge.types import Reason, Status

FIVE_MIN_S: Final = 300.0
TEN_MIN_S: Final = 600.0
LONG_MINUTES: Final = 15.0
"""The coverage of a single log is judged if it lasts longer [min]."""
EMPTY_PCT: Final = 10.0
"""Below this reference SoC a pack is nearly empty [%]."""
EMPTY_ERROR_PCT: Final = 5.0
"""Largest error there that needs no σ to cover it [% SoC]."""
WRONG_PCT: Final = 3.0
"""A valid estimate claims to be within this, two of its largest σ (`VALID_STD_PCT`) [% SoC]."""


@dataclass(frozen=True)
class LogScore:
    """Errors of one log in one case by the model of one draw of training logs.

    Errors in % SoC; NaN where nothing is known. `cover` is the share of the samples whose error is
    within 2σ, `late` is after ten minutes, `wrong` are samples whose error exceeds 3 % and 3σ.
    """

    log: str
    minutes: float
    rows: int
    mae_pct: float
    rmse_pct: float
    max_pct: float
    cover: float
    mean_std_pct: float
    newton_mae_pct: float
    counting_mae_pct: float
    plain_mae_pct: float
    """By the Newton inverse of the published equation, fitted without effects."""
    five_min_rows: int
    five_min_mae_pct: float
    late_rows: int
    late_mae_pct: float
    late_wrong: float
    """Share of the late samples that are wrong."""
    valid: float
    """Share of all samples with a valid estimate."""
    valid_wrong: float
    """Share of all samples that are valid and wrong."""
    empty_rows: int
    empty_uncovered: int
    """Samples below 10 % SoC, and those among them with an error over 5 % and over 2σ."""
    pack: str = ""
    role: str = ""
    case: str = ""
    size: int = 0
    split: int = 0
    counting_is_reference: bool = False
    is_model_wrong: bool = False
    """Whether the model is that of another pack."""
    mismatch_min: float = math.nan
    """Time until a model mismatch is first reported [min]; NaN: never."""
    quantities: tuple[Quantity, ...] = ()
    fit_seconds: float = 0.0
    step_us: float = 0.0
    """Time of the fit [s], and of a sample [µs]."""


def score_log(
    table: EstimateTable, plain_newton_pct: FloatArray, log: Log, after_s: float = 0.0
) -> LogScore:
    """Compare estimates with a log's reference SoC.

    Parameters
    ----------
    table : EstimateTable
        Of all n samples of the log.
    plain_newton_pct : array of shape (n,)
        SoC by the inverse of the published equation [%].
    log : Log
    after_s : float
        Earlier samples count for `valid` and `valid_wrong` only [s].
    """
    reference = np.full(len(log), np.nan) if log.soc_pct is None else log.soc_pct
    since_s = log.time_s - log.time_s[0]
    error, std = np.abs(table.soc_pct - reference), table.soc_std_pct
    known = np.isfinite(error)
    wrong = known & (error > WRONG_PCT) & (error > 3.0 * std)
    is_valid = table.status == Status.VALID
    scored = known & (since_s >= after_s)
    five_min, late = scored & (since_s >= FIVE_MIN_S), scored & (since_s >= TEN_MIN_S)
    empty = scored & (reference < EMPTY_PCT)
    covered = error <= 2.0 * std
    mismatch_s = since_s[(table.reasons & Reason.MODEL_MISMATCH) != 0]

    def mean(values: FloatArray, rows: FloatArray = scored) -> float:
        found = values[rows & np.isfinite(values)]
        return float(found.mean()) if found.size else math.nan

    return LogScore(
        log=log.name,
        minutes=log.duration_s / 60.0,
        rows=int(scored.sum()),
        mae_pct=mean(error),
        rmse_pct=math.sqrt(mean(error**2)),
        max_pct=float(error[scored].max()) if scored.any() else math.nan,
        cover=mean(covered.astype(float)),
        mean_std_pct=mean(std),
        newton_mae_pct=mean(np.abs(table.soc_newton_pct - reference)),
        counting_mae_pct=mean(np.abs(table.soc_coulomb_pct - reference)),
        plain_mae_pct=mean(np.abs(plain_newton_pct - reference)),
        five_min_rows=int(five_min.sum()),
        five_min_mae_pct=mean(error, five_min),
        late_rows=int(late.sum()),
        late_mae_pct=mean(error, late),
        late_wrong=mean(wrong.astype(float), late),
        valid=float(is_valid.mean()),
        valid_wrong=float((is_valid & wrong).mean()),
        empty_rows=int(empty.sum()),
        empty_uncovered=int((empty & (error > EMPTY_ERROR_PCT) & ~covered).sum()),
        mismatch_min=float(mismatch_s[0]) / 60.0 if mismatch_s.size else math.nan,
    )


@dataclass(frozen=True)
class Row:
    """Errors of a pack in one case by models from one number of logs, over all draws.

    Names as in `LogScore`; errors in % SoC.
    """

    pack: str
    role: str
    size: int
    case: str
    splits: int
    logs: int
    """Number of judged logs, each counted once a draw."""
    mae_pct: float
    rmse_pct: float
    max_pct: float
    cover: float
    mean_std_pct: float
    std_over_rmse: float
    worst_cover: float
    worst_cover_log: str
    """Lowest coverage of a log of more than 15 minutes."""
    worst_mae_pct: float
    worst_mae_log: str
    newton_mae_pct: float
    counting_mae_pct: float
    counting_is_reference: bool
    plain_mae_pct: float
    five_min_mae_pct: float
    late_mae_pct: float
    astray: int
    """Logs that are wrong in more than half of their samples after ten minutes."""
    valid: float
    valid_wrong: float
    empty_rows: int
    empty_uncovered: int
    is_model_wrong: bool
    mismatches: int
    """Logs in which a model mismatch is reported."""
    mismatch_min: float
    """Median time until then [min]; NaN: never."""
    fit_seconds: float
    step_us: float
    targets: tuple[Verdict, ...] = ()

    @property
    def missed(self) -> tuple[str, ...]:
        """Names of the targets that are missed."""
        return tuple(target.name for target in self.targets if not target.met)


def pool_scores(scores: Sequence[LogScore], chemistry: Mapping[str, str]) -> tuple[Row, ...]:
    """Return a row for each pack, number of training logs and case, in order of appearance.

    A log without a scored sample is in no row.

    Parameters
    ----------
    scores : sequence of LogScore
    chemistry : mapping of str to str
        Pack → "nmc" or "lfp".
    """
    groups: dict[tuple[str, int, str], list[LogScore]] = {}
    for score in scores:
        if score.rows:
            groups.setdefault((score.pack, score.size, score.case), []).append(score)
    rows = []
    for (pack, size, _), group in groups.items():
        row = _pooled(group)
        same_logs = {(score.log, score.split) for score in group}
        withheld = [
            score
            for score in groups.get((pack, size, "withheld"), ())
            if (score.log, score.split) in same_logs
        ]
        verdicts = _verdicts(row, _pooled(withheld) if withheld else None, chemistry[pack])
        rows.append(replace(row, targets=verdicts))
    return tuple(rows)


def _pooled(scores: Sequence[LogScore]) -> Row:
    def mean(name: str, weight: str = "rows") -> float:
        values = np.array([getattr(score, name) for score in scores], float)
        weights = np.array([getattr(score, weight) for score in scores], float)
        known = np.isfinite(values) & (weights > 0.0)
        return float(np.average(values[known], weights=weights[known])) if known.any() else math.nan

    first = scores[0]
    rmse = math.sqrt(np.average([s.rmse_pct**2 for s in scores], weights=[s.rows for s in scores]))
    std = mean("mean_std_pct")
    lasting = [score for score in scores if score.minutes > LONG_MINUTES] or scores
    least_covered = min(lasting, key=lambda score: score.cover)
    farthest = max(scores, key=lambda score: score.mae_pct)
    mismatches = [s.mismatch_min for s in scores if math.isfinite(s.mismatch_min)]
    return Row(
        pack=first.pack,
        role=first.role,
        size=first.size,
        case=first.case,
        splits=len({score.split for score in scores}),
        logs=len(scores),
        mae_pct=mean("mae_pct"),
        rmse_pct=rmse,
        max_pct=max(score.max_pct for score in scores),
        cover=mean("cover"),
        mean_std_pct=std,
        std_over_rmse=std / rmse if rmse else math.inf,
        worst_cover=least_covered.cover,
        worst_cover_log=least_covered.log,
        worst_mae_pct=farthest.mae_pct,
        worst_mae_log=farthest.log,
        newton_mae_pct=mean("newton_mae_pct"),
        counting_mae_pct=mean("counting_mae_pct"),
        counting_is_reference=first.counting_is_reference,
        plain_mae_pct=mean("plain_mae_pct"),
        five_min_mae_pct=mean("five_min_mae_pct", "five_min_rows"),
        late_mae_pct=mean("late_mae_pct", "late_rows"),
        astray=sum(score.late_wrong > 0.5 for score in scores),
        valid=float(np.average([s.valid for s in scores], weights=[s.minutes for s in scores])),
        valid_wrong=float(
            np.average([s.valid_wrong for s in scores], weights=[s.minutes for s in scores])
        ),
        empty_rows=sum(score.empty_rows for score in scores),
        empty_uncovered=sum(score.empty_uncovered for score in scores),
        is_model_wrong=first.is_model_wrong,
        mismatches=len(mismatches),
        mismatch_min=float(np.median(mismatches)) if mismatches else math.nan,
        fit_seconds=float(np.mean([score.fit_seconds for score in scores])),
        step_us=float(np.mean([score.step_us for score in scores])),
    )


def _verdicts(row: Row, withheld: Row | None, chemistry: str) -> tuple[Verdict, ...]:
    """Return the targets that apply to a row.

    Parameters
    ----------
    row : Row
    withheld : Row or None
        The same logs by the same models with the start withheld.
    chemistry : str
    """
    return tuple(_targets(row, withheld, chemistry))


BEST_FACTOR: Final = 1.1
BEST_MARGIN_PCT: Final = 0.3
"""A filter is at most this factor and margin worse than the better of its two inputs."""
WITHHELD_PCT: Final = {10: 1.0, 5: 1.5}
"""Training logs at least → MAE after 5 minutes without a start [% SoC], NMC and NCA."""
COVER: Final = (0.90, 0.99)
WORST_COVER: Final = 0.75
STD_OVER_RMSE: Final = (0.7, 1.5)


def _targets(row: Row, withheld: Row | None, chemistry: str) -> Iterator[Verdict]:
    if row.is_model_wrong:
        return  # nothing can be asked of it but to be noticed
    inputs = [row.newton_mae_pct]
    if not row.counting_is_reference:
        inputs.append(row.counting_mae_pct)
    best = min((each for each in inputs if math.isfinite(each)), default=math.nan)
    yield Verdict("inputs", row.mae_pct, 0.0, BEST_FACTOR * best + BEST_MARGIN_PCT)
    if row.case == "withheld" and chemistry == "nmc":
        limit = next((WITHHELD_PCT[n] for n in WITHHELD_PCT if row.size >= n), None)
        if limit is not None:
            yield Verdict("5 min", row.five_min_mae_pct, 0.0, limit)
    if row.case.startswith("start ") and withheld is not None:
        # "The withheld figure": equal within a tenth.
        yield Verdict("recovery", row.late_mae_pct, 0.0, BEST_FACTOR * withheld.late_mae_pct)
    if row.case.startswith("start "):
        yield Verdict("astray", row.astray, 0.0, 0.0)
    yield Verdict("2σ", row.cover, *COVER)
    yield Verdict("2σ of a log", row.worst_cover, WORST_COVER, 1.0)
    yield Verdict("σ/RMSE", row.std_over_rmse, *STD_OVER_RMSE)
    if row.empty_rows:
        yield Verdict("empty", row.empty_uncovered, 0.0, 0.0)


class Failure(NamedTuple):
    """Training logs that no model could be fitted to."""

    pack: str
    size: int
    split: int
    error: str


@dataclass(frozen=True)
class Bench:
    """Result of `packs.run`.

    Attributes
    ----------
    rows : tuple of Row
        One for each pack, number of training logs and case.
    quantities : tuple of QuantityRow
        One for each quantity that is asked for in one of these.
    logs : tuple of LogScore
        One for each judged log of each draw and case.
    failures : tuple of Failure
    packs : dict
        Pack → role, chemistry, reference and names of its logs.
    settings : dict
    seconds : float
        Time of the whole run [s].
    """

    rows: tuple[Row, ...]
    quantities: tuple[QuantityRow, ...]
    logs: tuple[LogScore, ...]
    failures: tuple[Failure, ...]
    packs: dict[str, dict[str, Any]]
    settings: dict[str, Any]
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Return the object that the command prints as JSON."""
        return {
            "schema": 1,
            "settings": self.settings,
            "seconds": self.seconds,
            "packs": self.packs,
            "rows": [_as_dict(row) for row in self.rows],
            "quantities": [_as_dict(row) for row in self.quantities],
            "logs": [
                {**asdict(score), "quantities": [each._asdict() for each in score.quantities]}
                for score in self.logs
            ],
            "failures": [failure._asdict() for failure in self.failures],
        }


def _as_dict(row: Row | QuantityRow) -> dict[str, Any]:
    return {
        **asdict(row),
        "targets": [{**target._asdict(), "met": target.met} for target in row.targets],
        "missed": list(row.missed),
    }


Cell = Callable[[Row], str]


def _percent(share: float) -> str:
    return number(100.0 * share, 0)


def _counting(row: Row) -> str:
    text = number(row.counting_mae_pct, 2)
    return f"({text})" if row.counting_is_reference else text


def _mismatch(row: Row) -> str:
    after = f", {number(row.mismatch_min, 0)} min" if row.mismatches else ""
    return f"{row.mismatches} of {row.logs}{after}"


COLUMNS: Final[tuple[tuple[str, Cell], ...]] = (
    ("logs", lambda row: str(row.size)),
    ("case", lambda row: row.case),
    ("EKF\nMAE", lambda row: number(row.mae_pct, 2)),
    ("after\n5 min", lambda row: number(row.five_min_mae_pct, 2)),
    ("\nRMSE", lambda row: number(row.rmse_pct, 2)),
    ("\nmax", lambda row: number(row.max_pct, 1)),
    ("Newton\nMAE", lambda row: number(row.newton_mae_pct, 2)),
    ("count\nMAE", _counting),
    ("plain\nMAE", lambda row: number(row.plain_mae_pct, 2)),
    ("2σ\n%", lambda row: _percent(row.cover)),
    ("mean\nσ", lambda row: number(row.mean_std_pct, 2)),
    ("σ/\nRMSE", lambda row: number(row.std_over_rmse, 2)),
    ("worst\n2σ %", lambda row: _percent(row.worst_cover)),
    ("worst\nMAE", lambda row: number(row.worst_mae_pct, 2)),
    ("valid\n%", lambda row: _percent(row.valid)),
    ("wrong\n%", lambda row: number(100.0 * row.valid_wrong, 1)),
    ("mis-\nmatch", _mismatch),
    ("targets", lambda row: "missed: " + ", ".join(row.missed) if row.missed else "pass"),
)
WIDTH: Final = 170


def print_bench(bench: Bench, console: Console) -> None:
    """Print a table for each pack, the quantities, and how many rows meet each target."""
    for name, about in bench.packs.items():
        rows = [row for row in bench.rows if row.pack == name]
        if rows:
            console.print(_table_of_pack(name, about["role"], rows))
            console.print(Text(printable(f"reference: {about['reference']}\n")))
    for failure in bench.failures:
        text = f"no model: {failure.pack}, {failure.size} logs, draw {failure.split + 1}"
        console.print(Text(printable(f"{text}: {failure.error}")))
    console.print(
        "MAE, RMSE, max in % SoC; 2σ: share of samples within 2σ; worst: over single logs; valid:"
        " share with status VALID; wrong: valid, but off by more than 3σ and 3 %. Counting in"
        " brackets repeats the reference. Withheld is scored after 5 min, wrong starts after 10."
        " Mismatch: logs in which the model is reported not to fit, and after how long."
    )
    if bench.quantities:
        console.print(_table_of_quantities(bench.quantities))
    console.print(_table_of_targets((*bench.rows, *bench.quantities)))
    console.print(f"{duration(bench.seconds)} in all")


def _table_of_pack(name: str, role: str, rows: Sequence[Row]) -> Table:
    about = {
        "development": "development: constants may be chosen on it",
        "judged": "judged: left out of every choice of a constant",
    }[role]
    table = _empty_table(f"{name} ({about})")
    for heading, _ in COLUMNS:
        table.add_column(Text(heading), justify="left" if heading in {"case", "targets"} else
                         "right", no_wrap=heading != "targets")  # fmt: skip
    for before, row in zip([rows[0], *rows], rows, strict=False):
        if row.size != before.size:
            table.add_section()
        table.add_row(*(Text(printable(cell(row))) for _, cell in COLUMNS))
    return table


def _table_of_quantities(rows: Sequence[QuantityRow]) -> Table:
    table = _empty_table("Beside the SoC")
    for heading, _ in QUANTITY_COLUMNS:
        table.add_column(Text(heading), no_wrap=heading != "targets")
    for row in rows:
        table.add_row(*(Text(printable(cell(row))) for _, cell in QUANTITY_COLUMNS))
    return table


def _table_of_targets(rows: Sequence[Row | QuantityRow]) -> Table:
    table = _empty_table("Rows that meet each target")
    for heading in ("target", "development", "judged"):
        table.add_column(heading)
    for name in dict.fromkeys(target.name for row in rows for target in row.targets):
        cells = []
        for role in ("development", "judged"):
            met = [
                target.met
                for row in rows
                for target in row.targets
                if row.role == role and target.name == name
            ]
            cells.append(f"{sum(met)} of {len(met)}")
        table.add_row(Text(name), *cells)
    return table


def _empty_table(title: str) -> Table:
    return Table(
        title=Text(printable(title)),
        title_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
