"""SoC at the start of each log: stated, from the log, or estimated together with the curve.

Where a log states no SoC, its start S₀ is a further unknown of the least squares. With the charge
counted from it, S(t) = S₀ − ΔS(t), a change of S₀ shifts the voltage of the whole log by dU/dS, so

    U ≈ X(S)·k + dU/dS·δ,

solved for the coefficients k and δ = ΔS₀ in turn (Gauss–Newton) until δ vanishes. At least one log
must pin the curve along the SoC axis; the others attach to it where their voltages overlap.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from scipy import optimize

from cangauge._formatting import significant
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.identify.log_errors import score_sums, summed_scores, with_std_errors
from cangauge.identify.passes import fit_voltage_model
from cangauge.identify.voltage_fit import information_of, pooled, solve_information, table_of
from cangauge.inference.least_squares import CLUSTER_S, Solution
from cangauge.inference.rows import FitOptions, FitRows, block_numbers, fit_rows, row_blocks
from cangauge.logs.gaps import split_where_moved
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import discharged_ah
from cangauge.model.effects.base import Signals
from cangauge.model.model_file import Model
from cangauge.model.voltage_model import VoltageModel, ocv_basis_slope

_LOG = logging.getLogger(__name__)

Origin = Literal["given", "log", "estimated"]

STEP_AT_MOST_PCT: Final = 5.0
"""Largest change of a start in one step [%]: the curve is bent."""

STEPS_AT_MOST: Final = 40
CONVERGED_PCT: Final = 0.005
"""Change of every start below which the steps end [%]: half the resolution of published SoC."""

STD_AT_MOST_PCT: Final = 5.0
"""Standard deviation of an estimated start above which its log is refused [%]. The counted SoC of a
log is worth as much as its start, and a start that is worse than this is read off any table of
rest voltages."""

SEARCH_STEP_PCT: Final = 1.0
"""Grid of the first search for a start [%]."""

SEARCH_ROWS: Final = 400
"""Rows of a log that the first search uses, evenly spaced."""


@dataclass(frozen=True, slots=True)
class Start:
    """SoC at the first row of a log.

    Parameters
    ----------
    name : str
        Of the log.
    soc_pct : float
        [%].
    std_pct : float or None
        Standard deviation, if it was estimated [%].
    origin : {"given", "log", "estimated"}
    """

    name: str
    soc_pct: float
    std_pct: float | None
    origin: Origin

    def __str__(self) -> str:
        """Return the start of the log in a phrase."""
        std = "" if self.std_pct is None else f" ± {significant(self.std_pct, 2)}"
        return f"{self.name} starts at {self.soc_pct:.1f}{std} %"


@dataclass(frozen=True, slots=True, eq=False)
class Starts:
    """Logs of which the start is known, and how.

    Parameters
    ----------
    logs : tuple of Log
        The first finite `soc_pct` of each is where counting starts. A log that was charged or
        driven in a gap is split there.
    pieces : tuple of Log
        The same with their own SoC.
    starts : tuple of Start
    std_error : array of shape (p,) or None
        Standard errors of the coefficients with the uncertainty of the estimated starts.
    """

    logs: tuple[Log, ...]
    pieces: tuple[Log, ...]
    starts: tuple[Start, ...]
    std_error: FloatArray | None = None

    def remarks(self) -> list[str]:
        """Return a remark on the starts that were estimated."""
        found = [str(start) for start in self.starts if start.origin == "estimated"]
        remarks = [f"start estimated together with the curve: {'; '.join(found)}"] if found else []
        parts = [log.name for log in self.logs if " part " in log.name]
        if parts:
            remarks.append(f"split where the pack was used in a gap: {', '.join(parts)}")
        return remarks


def with_start(log: Log, soc_pct: float) -> Log:
    """Return the log with an SoC at its first row [%]; its other reference values stay."""
    soc = np.full(len(log), np.nan) if log.soc_pct is None else log.soc_pct.copy()
    soc[0] = soc_pct
    return replace(log, soc_pct=soc)


def given_starts(
    initial_soc_pct: float | Sequence[float | None] | None, number: int
) -> list[float | None]:
    """Return the given SoC at the start of each log [%]; None where none is given.

    Raises
    ------
    InputError
        If several are given, but not one for each log, or one is not within 0–100 %.
    """
    if initial_soc_pct is None or isinstance(initial_soc_pct, int | float):
        given: list[float | None] = [initial_soc_pct] * number
    else:
        given = list(initial_soc_pct)
    if len(given) != number:
        raise InputError(
            f"{len(given)} values for {number} logs",
            field="initial_soc_pct",
            cure="give one for all, or one for each log in order (auto where it is unknown)",
        )
    for value in given:
        if value is not None and not 0.0 <= value <= 100.0:
            raise InputError("must lie within 0 … 100 %", field="initial_soc_pct", value=value)
    return given


def find_starts(logs: Sequence[Log], given: Sequence[float | None], options: FitOptions) -> Starts:
    """Return the logs with a known start: given, their own, or estimated with the curve.

    Parameters
    ----------
    logs : sequence of Log
    given : sequence of float or None
        SoC at the first row of each log [%].
    options : FitOptions

    Raises
    ------
    InputError
        If no log pins the curve, or a start is not determined.
    """
    split = [split_where_moved(log) for log in logs]
    given = [
        value if k == 0 else None
        for value, of_log in zip(given, split, strict=True)
        for k in range(len(of_log))
    ]
    logs = [piece for of_log in split for piece in of_log]
    known, starts = list(logs), []
    unknown: list[int] = []
    for k, (log, value) in enumerate(zip(logs, given, strict=True)):
        first = log.first_soc()
        if value is not None:
            known[k] = with_start(log, value)
            starts.append(Start(log.name, value, None, "given"))
        elif first is not None:
            counted = discharged_ah(log.time_s, log.current_a)[first[0]]
            at_first_row = first[1] + 100.0 * float(counted) / options.capacity_ah
            starts.append(Start(log.name, at_first_row, None, "log"))
        else:
            unknown.append(k)
            starts.append(Start(log.name, float("nan"), None, "estimated"))
    if not unknown:
        return Starts(tuple(known), tuple(logs), tuple(starts))
    if len(unknown) == len(logs):
        raise unknown_start(logs[0], others=len(logs) > 1)
    pinned = [fit_rows(log, options) for k, log in enumerate(known) if k not in unknown]
    model, _ = fit_voltage_model(pinned, options)
    search = _JointFit(known, unknown, options, model)
    values, std_pct, std_error = search.solve()
    for k, value, std in zip(unknown, values.tolist(), std_pct.tolist(), strict=True):
        starts[k] = Start(logs[k].name, value, std, "estimated")
        if not std <= STD_AT_MOST_PCT:
            raise InputError(
                f"the SoC at the start is unknown, and the voltage determines it to ±{std:.0f} %"
                " only",
                source=logs[k].source or logs[k].name,
                field="soc_pct",
                cure="give --initial-soc for this log, or logs whose SoC overlaps with it",
            )
        known[k] = with_start(logs[k], value)
        _LOG.info("%s", starts[k])
    return Starts(tuple(known), tuple(logs), tuple(starts), std_error)


def unknown_start(log: Log, *, others: bool) -> InputError:
    """Return the error for logs of which none states its SoC."""
    which = "no log states" if others else "the log does not state"
    return InputError(
        f"{which} its SoC (soc_pct), and the curve over SoC cannot begin anywhere",
        source=log.source or log.name,
        field="soc_pct",
        cure="give --initial-soc P, the SoC at the first row (100 for a log from full), name the"
        " SoC (--columns soc=…; for captures [soc] in the map file), or add a log with its SoC: the"
        " start of the others is then estimated",
    )


class _JointFit:
    """Least squares over the coefficients and the unknown starts."""

    def __init__(
        self, logs: Sequence[Log], unknown: Sequence[int], options: FitOptions, model: VoltageModel
    ) -> None:
        self._logs, self._unknown, self._options = list(logs), list(unknown), options
        self._limits = [_limits(logs[k], options.capacity_ah) for k in unknown]
        values = [
            _search(logs[k], limits, options, model)
            for k, limits in zip(unknown, self._limits, strict=True)
        ]
        self._values = np.array(values)

    def solve(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return starts and standard deviations [%], and the coefficients' standard errors."""
        for _ in range(STEPS_AT_MOST):
            step, std_pct, std_error = self._step()
            bounded = np.clip(step, -STEP_AT_MOST_PCT, STEP_AT_MOST_PCT)
            low, high = np.array(self._limits).T
            moved = np.clip(self._values + bounded, low, high) - self._values
            self._values = self._values + moved
            if np.all(np.abs(moved) < CONVERGED_PCT):
                break
        return self._values, std_pct, std_error

    def _rows(self) -> list[FitRows]:
        logs = list(self._logs)
        for k, value in zip(self._unknown, self._values.tolist(), strict=True):
            logs[k] = with_start(logs[k], value)
        return [fit_rows(log, self._options) for log in logs]

    def _step(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        options, rows = self._options, self._rows()
        model, _ = fit_voltage_model(rows, options)
        slopes = [
            ocv_basis_slope(item.soc_pct, options.epsilon) @ np.array(model.ocv_v) for item in rows
        ]
        extra = [
            np.outer(slope, np.array(self._unknown) == k) for k, slope in enumerate(slopes)
        ]  # one column for each unknown start
        each = list(zip(rows, extra, strict=True))
        parts = [information_of(item, options, extra=of_log) for item, of_log in each]
        volts = np.concatenate([item.voltage_v for item in rows])
        solution = solve_information(
            pooled(parts), options.epsilon, nominal_v=float(np.median(volts))
        )
        scores = [score_sums(item, options, solution, of_log) for item, of_log in each]
        solution = with_std_errors(solution, *summed_scores(scores))
        # The least squares does not model an error that lasts as long as a log and shifts its whole
        # voltage. Residuals averaged over five minutes show how large those that last are.
        means_v = np.concatenate([_cluster_means(*of_log, options, solution) for of_log in each])
        lasting_v = float(np.sqrt(np.mean(means_v**2)))
        mean_slopes = np.array([float(np.mean(slopes[k])) for k in self._unknown])
        n = len(solution.coefficients) - len(self._unknown)
        std_pct = np.hypot(solution.std_error[n:], lasting_v / np.maximum(mean_slopes, 1e-9))
        return solution.coefficients[n:], std_pct, solution.std_error[:n]


def _cluster_means(
    rows: FitRows, extra: FloatArray, options: FitOptions, solution: Solution
) -> FloatArray:
    """Return the mean error of each cluster of a log's rows [V]."""
    blocks = row_blocks(len(rows))
    tables = (table_of(rows.part(block), options, extra[block]) for block in blocks)
    error_v = np.concatenate(
        [each[:, -1] - each[:, :-1] @ solution.coefficients for each in tables]
    )
    first = np.flatnonzero(np.diff(block_numbers([rows], CLUSTER_S), prepend=-1))
    return np.asarray(np.add.reduceat(error_v, first) / np.diff(first, append=len(rows)))


def _limits(log: Log, capacity_ah: float) -> tuple[float, float]:
    """Return the starts from which the counted SoC stays within 0–100 % [%]."""
    out_pct = 100.0 * discharged_ah(log.time_s, log.current_a) / capacity_ah
    low, high = float(np.max(out_pct)), 100.0 + float(np.min(out_pct))
    middle = 0.5 * (low + high)
    return (low, high) if low <= high else (middle, middle)


def _search(
    log: Log, limits: tuple[float, float], options: FitOptions, model: VoltageModel
) -> float:
    """Return the start of the smallest error with a given model, on a grid [%]."""
    low, high = limits
    rows = fit_rows(with_start(log, 0.5 * (low + high)), options)
    some = np.linspace(0, len(rows) - 1, min(len(rows), SEARCH_ROWS)).astype(np.intp)
    soc = rows.soc_pct[some] - 0.5 * (low + high)
    grid = np.linspace(low, high, max(2, int((high - low) / SEARCH_STEP_PCT) + 1))
    errors = [
        np.mean(
            np.abs(
                model.voltage(soc + start, rows.dequantized_c[some], rows.delayed_current_a[some])
                - rows.voltage_v[some]
            )
        )
        for start in grid
    ]
    return float(grid[int(np.argmin(errors))])


def start_by_model(log: Log, model: Model) -> Start:
    """Return the SoC at a log's first row by a known model, from the voltage of the whole log.

    Parameters
    ----------
    log : Log
    model : Model

    Returns
    -------
    Start
        Its standard deviation follows from the lasting part of the model's error.
    """
    extended = model.extended_model()
    options = FitOptions.of_model(model)
    low, high = _limits(log, model.capacity_ah)
    rows = fit_rows(with_start(log, 0.5 * (low + high)), options)
    some = np.linspace(0, len(rows) - 1, min(len(rows), SEARCH_ROWS)).astype(np.intp)
    at = np.searchsorted(log.time_s, rows.time_s[some])
    signals = Signals(log.time_s, log.current_a, log.voltage_v, log.temperature_c)

    def error_v(start: float) -> float:
        return float(np.mean(np.abs(extended.predict(signals, start, at).residual_v)))

    grid = np.linspace(low, high, max(2, int((high - low) / (2.0 * SEARCH_STEP_PCT)) + 1))
    best = float(min(grid.tolist(), key=error_v))
    bounds = max(low, best - 2.0 * SEARCH_STEP_PCT), min(high, best + 2.0 * SEARCH_STEP_PCT)
    if bounds[0] < bounds[1]:
        best = float(optimize.minimize_scalar(error_v, bounds=bounds, method="bounded").x)
    soc = rows.soc_pct - 0.5 * (low + high) + best
    slope = float(np.mean(extended.model.pseudo_ocv_slope(soc)))
    noise = model.noise
    std_v = float(np.hypot(noise.lasting_std_v, 0.25 * noise.voltage_rmse_v))
    return Start(log.name, best, std_v / max(slope, 1e-9), "estimated")
