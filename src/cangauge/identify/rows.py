"""Rows of a log that take part in a fit, at the model's rate.

A row passes these rules, in this order:

1. Decimation: the first sample at or after each tick of `rate_hz`; a slower log is kept whole.
2. Start-up and shut-down: rows with a voltage below half the log's median (contactor open,
   pre-charge) are removed, and rows within `GUARD_S` of one.
3. Delay line: rows within the longest delay (70 s) of the log's start, or of the end of a gap in
   the current longer than usual (`logs.gaps.usual_gap_s`), are removed.

The quantized temperature of the rows is interpolated between its steps. This uses later samples,
and is possible offline only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray, IntArray
from cangauge.errors import InputError
from cangauge.logs.gaps import usual_gap_s, usual_step_s
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import counted_soc_pct
from cangauge.model.curve import BASIS_NAMES
from cangauge.model.delay_line import delayed_currents, filled_at
from cangauge.model.prior import LOW_PASS_S
from cangauge.model.voltage_model import DELAYS_S, past_currents
from cangauge.settings import GAP_S

LOW_VOLTAGE = 0.5
"""Rows below this fraction of the log's median voltage are start-up or shut-down."""

GUARD_S = 2.0
"""Distance of a row from start-up and shut-down rows, at least [s]."""

SOC_TOLERANCE_PCT = 3.0
"""Excess of a counted SoC over 0–100 % from which the capacity or the start must be wrong [%]."""

ROWS_PER_COEFFICIENT = 4
"""Rows that a coefficient of the published equation needs."""

LEAST_ROWS = ROWS_PER_COEFFICIENT * (len(BASIS_NAMES) + 1 + len(DELAYS_S))
"""Fewest rows for a fit: those of the 13 coefficients of the published equation."""

TEMPERATURE_SPAN_K = 3.0
"""Least span of the temperature from which kt is identified [K]: sensors have steps of 1 K."""

SOC_SPAN_AT_LEAST_PCT = 2.0
"""Least SoC span of the logs from which a published curve is printed [%]: below, its eight terms
share one level and one slope."""

PLATEAU_S = 60.0
"""A reported temperature that lasts this long [s] is assumed exact in the middle of its plateau;
shorter plateaus are noise of a temperature between two steps."""

STEPPED_SHARE = 0.5
"""A temperature that changes at this fraction of the rows or more is not quantized [-]."""


CHUNK = 16_384
"""Rows of a chunk: its 41 columns have 5 MB, and stay in the cache of a core."""


@dataclass(frozen=True, eq=False)
class FitRows:
    """Rows of one log, m of them. What is computed from the log needs memory only while it is used.

    Parameters
    ----------
    log : Log
    at : array of int, shape (m,)
        Index of the rows in the log.
    row_s : float
        Time that each row stands for [s].
    soc_pct : array of shape (m,)
        Counted SoC [%].
    dequantized_c : array of shape (m,)
        Temperature, interpolated between the steps of the reports (`dequantize`) [°C].
    low_passed_a : array of shape (m, number of low passes)
        Low-passed currents [A].
    delay_s : tuple of float
        Delays of the current [s].
    removed : dict
        Number of rows removed by each rule.
    """

    log: Log
    at: NDArray[np.intp]
    row_s: float
    soc_pct: FloatArray
    dequantized_c: FloatArray
    low_passed_a: FloatArray
    delay_s: tuple[float, ...]
    removed: dict[str, int]

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self.at.size)

    @property
    def name(self) -> str:
        """Name of the log."""
        return self.log.name

    @property
    def time_s(self) -> FloatArray:
        """Time [s], shape (m,)."""
        return self.log.time_s[self.at]

    @property
    def voltage_v(self) -> FloatArray:
        """Voltage [V], shape (m,)."""
        return self.log.voltage_v[self.at]

    @property
    def current_a(self) -> FloatArray:
        """Current; positive = discharge [A], shape (m,)."""
        return self.log.current_a[self.at]

    @property
    def temperature_c(self) -> FloatArray:
        """Temperature as reported: the input of an estimator [°C], shape (m,)."""
        return self.log.temperature_c[self.at]

    @property
    def current_columns_a(self) -> FloatArray:
        """I(t − dj), then the low-passed currents; positive = discharge [A], shape (m, M)."""
        log = self.log
        delayed = delayed_currents(log.time_s, log.current_a, self.delay_s, self.time_s)
        return np.concatenate([delayed, self.low_passed_a], axis=1)

    def chunks(self) -> Iterator[tuple[slice, FitRows]]:
        """Yield the rows in chunks of `CHUNK`, each with its place among all rows."""
        for first in range(0, len(self), CHUNK):
            place = slice(first, first + CHUNK)
            chunk = replace(
                self,
                at=self.at[place],
                soc_pct=self.soc_pct[place],
                dequantized_c=self.dequantized_c[place],
                low_passed_a=self.low_passed_a[place],
            )
            yield place, chunk

    def product(
        self, columns: Callable[[FitRows], FloatArray], coefficients: FloatArray
    ) -> FloatArray:
        """Return the voltage by columns of the rows and their coefficients, shape (m,)."""
        return np.concatenate([columns(chunk) @ coefficients for _, chunk in self.chunks()])


def fit_rows(
    log: Log,
    capacity_ah: float,
    *,
    rate_hz: float = 1.0,
    delay_s: Sequence[float] = DELAYS_S,
    low_pass_s: Sequence[float] = LOW_PASS_S,
) -> FitRows:
    """Return the rows of a log that take part in a fit.

    Parameters
    ----------
    log : Log
        Counting starts from its first finite `soc_pct`.
    capacity_ah : float
        Charge from 100 to 0 % [Ah].
    rate_hz : float
        Rate to which the log is decimated [Hz].
    delay_s, low_pass_s : sequence of float
        Delays and time constants of `current_columns_a` [s].

    Raises
    ------
    InputError
        If no row is left, the SoC is known nowhere, or the counted SoC leaves 0–100 % by more than
        the tolerance.
    """
    source = log.source or log.name
    soc = counted_soc_pct(log, capacity_ah)
    low, high = float(soc.min()), float(soc.max())
    if low < -SOC_TOLERANCE_PCT or high > 100.0 + SOC_TOLERANCE_PCT:
        raise InputError(
            f"the SoC counted with {capacity_ah:.2f} Ah runs from {high:.1f} to {low:.1f} %",
            source=source,
            field="soc_pct",
            cure="check --capacity-ah, the SoC at the start (soc_pct, --initial-soc) and the sign"
            " of current (positive must discharge; see `cangauge inspect`)",
        )
    at, removed = usable_rows(log, delay_s, rate_hz)
    if at.size < 2:
        raise InputError(
            f"no rows are left for the fit: the log lasts {log.duration_s:.0f} s, and the first"
            f" {max(delay_s):.0f} s, and as long after each gap, fill the delay line",
            source=source,
            cure="give a longer log",
        )
    return FitRows(
        log=log,
        at=at,
        row_s=usual_step_s(log.time_s[at]),
        soc_pct=soc[at],
        dequantized_c=dequantize(log).temperature_c[at],
        low_passed_a=past_currents(log.time_s, log.current_a, at, (), low_pass_s),
        delay_s=tuple(delay_s),
        removed=removed,
    )


def decimate(time_s: FloatArray, rate_hz: float) -> NDArray[np.intp]:
    """Return the index of the first sample at or after each tick of `rate_hz`."""
    tick = np.floor((time_s - time_s[0]) * rate_hz + 1e-6)
    return np.flatnonzero(np.concatenate(([True], np.diff(tick) > 0.0)))


def running_rows(time_s: FloatArray, voltage_v: FloatArray) -> NDArray[np.bool_]:
    """Return the mask of rows that are neither start-up nor shut-down (rule 2), shape (n,)."""
    down = voltage_v < LOW_VOLTAGE * float(np.median(voltage_v))
    at_s = np.r_[-np.inf, time_s[down], np.inf]
    following = np.searchsorted(at_s, time_s)
    nearest_s = np.minimum(at_s[following] - time_s, time_s - at_s[following - 1])
    return np.asarray(nearest_s > GUARD_S)


def usable_delays(logs: Sequence[Log], delay_s: Sequence[float]) -> tuple[float, ...]:
    """Return the delays that the fastest of some logs resolves [s].

    Between rows the current is interpolated, so that the columns of delays closer together than a
    row depend on each other.

    Parameters
    ----------
    logs : sequence of Log
    delay_s : sequence of float
        Increasing from 0 [s].
    """
    step_s = min(usual_step_s(log.time_s) for log in logs)
    usable = [delay_s[0]]
    for delay in delay_s[1:]:
        if step_s <= delay - usable[-1] + 1e-9:
            usable.append(delay)
    return tuple(usable)


def usable_rows(
    log: Log, delay_s: Sequence[float], rate_hz: float
) -> tuple[NDArray[np.intp], dict[str, int]]:
    """Return the indices of the rows of a log that take part in a fit, and the numbers removed."""
    ticks = decimate(log.time_s, rate_hz)
    running = running_rows(log.time_s, log.voltage_v)[ticks]
    is_filled = filled_at(
        log.time_s, max(delay_s), log.time_s[ticks], usual_gap_s(log.time_s, GAP_S)
    )
    removed = {
        "decimation": len(log) - ticks.size,
        "start_up_or_shut_down": int(np.sum(~running)),
        "delay_line_filling": int(np.sum(running & ~is_filled)),
    }
    return ticks[running & is_filled], removed


def dequantize(log: Log) -> Log:
    """Return a log whose quantized temperature is interpolated between its steps.

    A sensor reports whole or quarter degrees, while the temperature may change by less in an hour:
    the error of up to half a step lasts as long. With a coefficient of tenths of a volt per kelvin
    (0.74 V/K in the published model) it exceeds most effects. At a step the temperature is known:
    half-way between the two values.

    Interpolation is linear between steps and the middles of long plateaus, and clipped to half a
    usual step around the reported value, which preserves jumps, as after an unobserved interval. A
    temperature that never changes, or changes at most rows, is kept.
    """
    time_s, reported = log.time_s, log.temperature_c
    steps = np.diff(reported)
    change = np.flatnonzero(steps)
    if not 0 < change.size < STEPPED_SHARE * len(log):
        return log
    half_step = 0.5 * float(np.median(np.abs(steps[change])))
    first, last = np.append(0, change + 1), np.append(change, len(log) - 1)
    plateau = time_s[last] - time_s[first] >= PLATEAU_S
    plateau[[0, -1]] = True  # nothing else is known before the first step and after the last
    knots_s = np.append(_midpoints(time_s, change), 0.5 * (time_s[first] + time_s[last])[plateau])
    knots_c = np.append(_midpoints(reported, change), reported[first][plateau])
    order = np.argsort(knots_s, kind="stable")
    line = np.interp(time_s, knots_s[order], knots_c[order])
    bounded = np.clip(line, reported - half_step, reported + half_step)
    return replace(log, temperature_c=bounded)


def _midpoints(values: FloatArray, change: IntArray) -> FloatArray:
    return np.asarray(0.5 * (values[change] + values[change + 1]))
