"""SoC at the start of each log: stated, from the log, or estimated together with the curve.

Where a log states no SoC, its start is the one at which the model fits its voltage best, its level
being unknown within the prior. Models and starts are found in turn until the starts stay: at least
one log must pin the curve along the SoC axis, and the others attach to it where their voltages
overlap.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
from scipy import optimize

from cangauge._text import counted, significant
from cangauge._typing import FloatArray
from cangauge.errors import InputError, require_number
from cangauge.identify.least_squares import (
    LogSums,
    N,
    Solution,
    load_features,
    log_sums,
    row_weights,
    solve,
)
from cangauge.identify.rows import fit_rows
from cangauge.logs.gaps import discharged_ah, split_where_moved
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import soc_at_first_row
from cangauge.model.curve import KNOTS_PCT, SLOPE_AT_LEAST, HermiteCurve
from cangauge.model.effects.base import Signals
from cangauge.model.model_file import Model
from cangauge.model.prior import CHEMISTRIES, PackPrior

_LOG = logging.getLogger(__name__)

Origin = Literal["given", "log", "estimated"]

STEPS_AT_MOST: Final = 20
CONVERGED_PCT: Final = 0.05
"""Change of every start below which the steps end [%]: half the resolution of published SoC."""

STD_AT_MOST_PCT: Final = 5.0
"""Standard deviation of an estimated start above which its log is refused [%]. The counted SoC of a
log is worth as much as its start, and a start that is worse than this is read off any table of
rest voltages."""

SEARCH_STEP_PCT: Final = 1.0
"""Grid of the search for a start [%]."""


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """SoC at the first row of a log.

    Parameters
    ----------
    log : Log
        Its first finite `soc_pct` is where counting starts.
    soc_pct : float
        [%].
    origin : {"given", "log", "estimated"}
    std_pct : float or None
        Standard deviation, if it was estimated [%].
    """

    log: Log
    soc_pct: float
    origin: Origin
    std_pct: float | None = None

    def __str__(self) -> str:
        """Return the start of the log in a phrase."""
        std = "" if self.std_pct is None else f" ± {significant(self.std_pct, 2)}"
        return f"{self.log.name} starts at {self.soc_pct:.1f}{std} %"


def with_start(log: Log, soc_pct: float) -> Log:
    """Return the log with an SoC at its first row [%]; its other reference values stay."""
    soc = np.full(len(log), np.nan) if log.soc_pct is None else log.soc_pct.copy()
    soc[0] = soc_pct
    return replace(log, soc_pct=soc)


def given_starts(
    initial_soc_pct: float | str | Sequence[float | str | None] | None, number: int
) -> list[float | None]:
    """Return the given SoC at the start of each log [%]; None where none is given, or "auto".

    Raises
    ------
    InputError
        If several are given, but not one for each log, or one is not within 0–100 %.
    """
    stated: Any = initial_soc_pct
    if stated is None or isinstance(stated, int | float | str):
        stated = [stated] * number
    given = [None if value == "auto" else value for value in stated]
    if len(given) != number:
        raise InputError(
            f"{len(given)} values for {counted(number, 'log')}",
            field="--initial-soc",
            cure="give one for all, or one for each log in order (auto where it is unknown)",
        )
    for value in given:
        if value is None:
            continue
        require_number(value, "--initial-soc")
        if not 0.0 <= value <= 100.0:
            raise InputError("must lie within 0 … 100 %", field="--initial-soc", value=value)
    return given


def find_starts(logs: Sequence[Log], given: Sequence[float | None], pack: PackPrior) -> list[Start]:
    """Return the logs with a known start: given, their own, or estimated with the curve.

    A log that was charged or driven in a gap is split there.

    Parameters
    ----------
    logs : sequence of Log
    given : sequence of float or None
        SoC at the first row of each log [%].
    pack : PackPrior

    Raises
    ------
    InputError
        If no log pins the curve, or a start is not determined.
    """
    pieces: list[Log] = []
    starts: list[Start | None] = []
    for whole, given_pct in zip(logs, given, strict=True):
        for number, log in enumerate(split_where_moved(whole)):
            own_pct = soc_at_first_row(log, pack.capacity_ah)
            pieces.append(log)
            if given_pct is not None and number == 0:
                starts.append(Start(with_start(log, given_pct), given_pct, "given"))
            else:
                starts.append(None if own_pct is None else Start(log, own_pct, "log"))
    known = [start.log for start in starts if start is not None]
    if not known:
        which = "no log states" if len(pieces) > 1 else "the log does not state"
        raise InputError(
            f"{which} its SoC (soc_pct), and the curve over SoC cannot begin anywhere",
            source=pieces[0].source or pieces[0].name,
            field="soc_pct",
            cure="give --initial-soc P, the SoC at the first row (100 for a log from full), name"
            " the SoC (--columns soc=…; for captures [soc] in the map file), or add a log with its"
            " SoC: the start of the others is then estimated",
        )
    unknown = [log for log, start in zip(pieces, starts, strict=True) if start is None]
    estimated = iter(_estimated(known, unknown, pack) if unknown else ())
    return [start or next(estimated) for start in starts]


class _Unknown:
    """A log of unknown start: its rows, counted from a start in the middle of the possible ones."""

    def __init__(self, log: Log, capacity_ah: float) -> None:
        self.log = log
        self.low, self.high = _limits(log, capacity_ah)
        self._middle = 0.5 * (self.low + self.high)
        self.rows = fit_rows(with_start(log, self._middle), capacity_ah)

    def soc_pct(self, start_pct: float) -> FloatArray:
        """Return the SoC of the rows from a start [%]."""
        return self.rows.soc_pct + start_pct - self._middle

    def sums(self, start_pct: float, pack: PackPrior) -> LogSums:
        """Return the sums of the log from a start [%]."""
        return log_sums(replace(self.rows, soc_pct=self.soc_pct(start_pct)), pack.chemistry)

    def best_pct(self, solution: Solution, pack: PackPrior) -> float:
        """Return the start at which a solution misfits the voltage least [%]."""
        rows, chemistry = self.rows, pack.chemistry
        curve = HermiteCurve.rising(KNOTS_PCT, solution.coefficients[:N])
        loads = (
            load_features(rows.dequantized_c, rows.current_columns_a) @ solution.select[N:, N:].T
        )
        open_v = rows.voltage_v - loads @ solution.coefficients[N:]
        level2 = float(chemistry.level_v(solution.mean_v)) ** 2

        def misfit(start_pct: float) -> float:
            soc_pct = self.soc_pct(start_pct)
            error = open_v - curve.values(soc_pct)
            weight = row_weights(soc_pct, rows.row_s, chemistry) + 1e-9
            mean = float(weight @ error / weight.sum())
            square = float(weight @ (error - mean) ** 2 / weight.sum())
            return square / (solution.residual_v**2 + 1e-12) + mean**2 / level2

        return _minimum(misfit, self.low, self.high)

    def start(self, soc_pct: float, solution: Solution, pack: PackPrior) -> Start:
        """Return an estimated start [%]; raise InputError if a solution does not determine it."""
        sums = self.sums(soc_pct, pack)
        variance = float(solution.mean_error(sums)[1])
        variance += float(pack.chemistry.level_v(solution.mean_v)) ** 2
        curve = HermiteCurve.rising(KNOTS_PCT, solution.coefficients[:N])
        slope = max(curve.at(sums.mean_soc_pct)[1], SLOPE_AT_LEAST * solution.mean_v)
        std_pct = float(variance**0.5) / slope
        if not std_pct <= STD_AT_MOST_PCT:
            raise InputError(
                "the SoC at the start is unknown, and the voltage determines it to"
                f" ±{std_pct:.0f} % only",
                source=self.log.source or self.log.name,
                field="soc_pct",
                cure="give --initial-soc for this log, or logs whose SoC overlaps with it",
            )
        start = Start(with_start(self.log, soc_pct), soc_pct, "estimated", std_pct)
        _LOG.info("%s", start)
        return start


def _estimated(known: Sequence[Log], logs: Sequence[Log], pack: PackPrior) -> list[Start]:
    """Return the starts of logs, found in turn with the curve, which the known logs pin."""
    pinned = [log_sums(fit_rows(log, pack.capacity_ah), pack.chemistry) for log in known]
    unknown = [_Unknown(log, pack.capacity_ah) for log in logs]
    sums, values = pinned, np.full(len(logs), np.nan)
    for _ in range(STEPS_AT_MOST):
        solution, before = solve(sums, pack), values
        values = np.array([each.best_pct(solution, pack) for each in unknown])
        if np.all(np.abs(values - before) < CONVERGED_PCT):
            break
        found = zip(unknown, values.tolist(), strict=True)
        sums = [*pinned, *(each.sums(value, pack) for each, value in found)]
    by_known = solve(pinned, pack)
    return [
        each.start(value, by_known, pack)
        for each, value in zip(unknown, values.tolist(), strict=True)
    ]


def _minimum(misfit: Callable[[float], float], low: float, high: float) -> float:
    """Return the argument of the least value between two bounds: a grid, then Brent's method."""
    grid = np.linspace(low, high, max(2, int((high - low) / SEARCH_STEP_PCT) + 1)).tolist()
    best = float(min(grid, key=misfit))
    bounds = max(low, best - SEARCH_STEP_PCT), min(high, best + SEARCH_STEP_PCT)
    if bounds[0] >= bounds[1]:
        return best
    return float(optimize.minimize_scalar(misfit, bounds=bounds, method="bounded").x)


def _limits(log: Log, capacity_ah: float) -> tuple[float, float]:
    """Return the starts from which the counted SoC stays within 0–100 % [%]."""
    out_pct = 100.0 * discharged_ah(log.time_s, log.current_a) / capacity_ah
    low, high = float(np.max(out_pct)), 100.0 + float(np.min(out_pct))
    middle = 0.5 * (low + high)
    return (low, high) if low <= high else (middle, middle)


def start_by_model(log: Log, model: Model) -> Start:
    """Return the SoC at a log's first row by a known model, from the voltage of the whole log.

    Parameters
    ----------
    log : Log
    model : Model

    Returns
    -------
    Start
        Its standard deviation follows from the model's lasting error.
    """
    extended, voltage = model.extended_model(), model.voltage_model()
    low, high = _limits(log, model.capacity_ah)
    middle = 0.5 * (low + high)
    at = fit_rows(with_start(log, middle), model.capacity_ah, delay_s=voltage.loads.delays_s).at
    prediction = extended.predict(Signals.of(log), middle, at)
    moved_pct = prediction.soc_pct[at] - middle

    def error_v(start_pct: float) -> float:
        modelled_v = extended.voltage_at(moved_pct + start_pct, prediction)
        return float(np.mean(np.abs(prediction.signals.voltage_v[at] - modelled_v)))

    best = _minimum(error_v, low, high)
    soc_pct, celsius = moved_pct + best, prediction.signals.temperature_c[at]
    columns = voltage.load_columns(celsius, prediction.currents_a).mean(axis=0)
    by_functions = model.functions.row(float(np.mean(soc_pct)), columns)
    lasting_v = np.hypot(np.linalg.norm(by_functions), model.noise.level_std_v)
    slope = float(np.mean(voltage.pseudo_ocv_slope(soc_pct)))
    slope = max(slope, SLOPE_AT_LEAST * voltage.nominal_v)
    std_pct = float(np.hypot(lasting_v / slope, CHEMISTRIES[model.chemistry].soc_std_pct))
    return Start(log, best, "estimated", std_pct)
