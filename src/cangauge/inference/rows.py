"""Rows of logs that take part in a fit, at the model's rate, and how they are held out.

A row passes these rules, in this order:

1. Decimation: the first sample at or after each tick of `rate_hz`; a slower log is kept whole.
2. Start-up and shut-down: rows with a voltage below half the log's median (contactor open,
   pre-charge) are removed, and rows within `GUARD_S` of one.
3. Delay line: rows within the longest delay (70 s) of the log's start, or of the end of a gap in
   the current longer than `gap_s`, are removed.

Three logs or more: whole logs are held out in turn. One or two logs: interleaved blocks with a
guard between them. The first and the last block of a log always belong to the training rows, since
the 1/s⁴ terms diverge beyond the SoC of the fit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.gaps import usual_gap_s, usual_step_s
from cangauge.logs.log import Log
from cangauge.logs.resample import dequantize
from cangauge.model.coulomb_counting import counted_soc_pct, discharged_ah
from cangauge.model.delay_line import GAP_S, delayed_currents, filled_at
from cangauge.model.effects.base import Signals
from cangauge.model.model_file import Model

DELAYS_S = (0.0, 10.0, 30.0, 70.0)
"""The published delays [s]."""

LOW_VOLTAGE = 0.5
"""Rows below this fraction of the log's median voltage are start-up or shut-down."""

GUARD_S = 2.0
"""Distance of a row from start-up and shut-down rows, at least [s]."""

SOC_TOLERANCE_PCT = 3.0
"""Excess of a counted SoC over 0–100 % from which the capacity or the start must be wrong [%]."""

LOGS_AT_LEAST = 3
"""From this number of logs on, whole logs are held out."""

FOLDS_AT_MOST = 12
"""With more logs, several are held out together."""

BLOCK_S, BLOCK_GUARD_S = 240.0, 60.0
"""Length of a held-out block, and of the guard at its ends: rows that are neither fitted nor
evaluated, within the block in an identification, beside it in a diagnosis [s]."""

BLOCK_FOLDS = 5
"""One block in this number is held out in turn."""

BLOCK_ROWS = 1 << 14
"""Rows of a block that is held with all its columns: 16,384 of 32 columns take 4 MiB, and it is the
longest stretch of the error model's time scales."""

Mask = NDArray[np.bool_]


def row_blocks(rows: int) -> Iterator[slice]:
    """Yield consecutive blocks of at most `BLOCK_ROWS` rows."""
    for start in range(0, rows, BLOCK_ROWS):
        yield slice(start, min(start + BLOCK_ROWS, rows))


def stacked_columns(*parts: FloatArray) -> FloatArray:
    """Return arrays of shape (n, k) or (n,) beside each other; each column is contiguous."""
    table = np.vstack([part.T for part in parts])
    return np.asarray(table.T)


@dataclass(frozen=True)
class FitOptions:
    """How logs become rows and columns of a fit; the defaults are the published choices."""

    capacity_ah: float
    """Charge from 100 to 0 % [Ah]."""
    initial_soc_pct: float | None = None
    """SoC at each log's first row [%]; by default its reference SoC."""
    rate_hz: float = 1.0
    delay_s: tuple[float, ...] = DELAYS_S
    epsilon: float = 0.05
    t_ref_c: float = 20.0

    @classmethod
    def of_model(cls, model: Model) -> FitOptions:
        """Return the options by which the logs of a model became rows."""
        return cls(
            capacity_ah=model.capacity_ah,
            rate_hz=model.rate_hz,
            delay_s=tuple(model.delays_s),
            epsilon=model.epsilon,
            t_ref_c=model.t_ref_c,
        )


@dataclass(frozen=True, eq=False)
class FitRows:
    """Rows of one log, shape (m,) each; delayed currents (m, number of delays)."""

    name: str
    time_s: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    """As reported [°C]: the input of an estimator."""
    dequantized_c: FloatArray
    """Interpolated between the steps of the reports [°C] (`logs.resample.dequantize`)."""
    soc_pct: FloatArray
    """Counted SoC [%]."""
    delayed_current_a: FloatArray
    """I(t − dj) [A], positive = discharge."""
    removed: dict[str, int]
    """Number of rows removed by each rule."""

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self.time_s.size)

    def part(self, keep: slice | Mask | NDArray[np.intp]) -> FitRows:
        """Return some of the rows."""
        return replace(
            self,
            time_s=self.time_s[keep],
            voltage_v=self.voltage_v[keep],
            temperature_c=self.temperature_c[keep],
            dequantized_c=self.dequantized_c[keep],
            soc_pct=self.soc_pct[keep],
            delayed_current_a=self.delayed_current_a[keep],
        )


@dataclass(frozen=True, eq=False)
class SampledLog:
    """A log with its rows, as input of the extended model."""

    log: Log
    rows: FitRows
    at: NDArray[np.intp]
    """Index of the rows in the log, shape (m,)."""
    initial_soc_pct: float
    """SoC at the log's first sample [%]."""
    signals: Signals
    """Signals at the log's own rate."""

    def with_history_cache(self) -> SampledLog:
        """Return the log with a cache of the current's history: faster, but larger."""
        return replace(self, signals=self.signals.with_history_cache())


def sample_log(
    log: Log, options: FitOptions, *, soc_tolerance_pct: float = SOC_TOLERANCE_PCT
) -> SampledLog:
    """Return a log with its rows and its SoC at the first sample.

    Raises
    ------
    InputError
        As `fit_rows`.
    """
    rows = fit_rows(log, options, soc_tolerance_pct=soc_tolerance_pct)
    at = np.searchsorted(log.time_s, rows.time_s)
    out_ah = discharged_ah(log.time_s, log.current_a)
    first_pct = float(rows.soc_pct[0] + 100.0 * out_ah[at[0]] / options.capacity_ah)
    signals = Signals(log.time_s, log.current_a, log.voltage_v, log.temperature_c)
    return SampledLog(log, rows, at, first_pct, signals)


def fit_rows(
    log: Log,
    options: FitOptions,
    *,
    gap_s: float = GAP_S,
    soc_tolerance_pct: float = SOC_TOLERANCE_PCT,
) -> FitRows:
    """Return the rows of a log that take part in a fit.

    Raises
    ------
    InputError
        If no row is left, the SoC is known nowhere, or the counted SoC leaves 0–100 % by more than
        the tolerance.
    """
    source = log.source or log.name
    capacity_ah, delay_s = options.capacity_ah, options.delay_s
    soc = counted_soc_pct(log, capacity_ah, options.initial_soc_pct)
    low, high = float(soc.min()), float(soc.max())
    if low < -soc_tolerance_pct or high > 100.0 + soc_tolerance_pct:
        raise InputError(
            f"the SoC counted with {capacity_ah:.2f} Ah runs from {high:.1f} to {low:.1f} %",
            source=source,
            field="soc_pct",
            cure="check --capacity-ah, the SoC at the start (soc_pct, --initial-soc) and the sign"
            " of current (positive must discharge; see `cangauge inspect`)",
        )
    indices, removed = usable_rows(log, delay_s, options.rate_hz, gap_s)
    if indices.size < 2:
        raise InputError(
            f"no rows are left for the fit: the log lasts {log.duration_s:.0f} s, and the first"
            f" {max(delay_s):.0f} s, and as long after each gap, fill the delay line",
            source=source,
            cure="give a longer log",
        )
    first, last = int(indices[0]), int(indices[-1])
    # Of consecutive rows nothing is copied.
    keep = slice(first, last + 1) if last - first + 1 == indices.size else indices
    time_s = log.time_s[keep]
    return FitRows(
        name=log.name,
        time_s=time_s,
        voltage_v=log.voltage_v[keep],
        temperature_c=log.temperature_c[keep],
        dequantized_c=dequantize(log).temperature_c[keep],
        soc_pct=soc[keep],
        delayed_current_a=delayed_currents(log.time_s, log.current_a, delay_s, time_s),
        removed=removed,
    )


def decimate(time_s: FloatArray, rate_hz: float) -> NDArray[np.intp]:
    """Return the index of the first sample at or after each tick of `rate_hz`."""
    tick = np.floor((time_s - time_s[0]) * rate_hz + 1e-6)
    return np.flatnonzero(np.concatenate(([True], np.diff(tick) > 0.0)))


def running_rows(time_s: FloatArray, voltage_v: FloatArray) -> NDArray[np.bool_]:
    """Return the mask of rows that are neither start-up nor shut-down (rule 2), shape (n,)."""
    down = voltage_v < LOW_VOLTAGE * float(np.median(voltage_v))
    if not down.any():
        return ~down
    at = time_s[down]
    right = np.searchsorted(at, time_s)
    to_next = np.where(right < at.size, at[np.minimum(right, at.size - 1)] - time_s, np.inf)
    to_last = np.where(right > 0, time_s - at[np.maximum(right - 1, 0)], np.inf)
    return np.asarray(np.minimum(to_next, to_last) > GUARD_S) & ~down


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
    kept = [delay_s[0]]
    for delay in delay_s[1:]:
        if step_s <= delay - kept[-1] + 1e-9:
            kept.append(delay)
    return tuple(kept)


def usable_rows(
    log: Log, delay_s: Sequence[float], rate_hz: float, gap_s: float = GAP_S
) -> tuple[NDArray[np.intp], dict[str, int]]:
    """Return the indices of the rows of a log that take part in a fit, and the numbers removed."""
    ticks = decimate(log.time_s, rate_hz)
    running = running_rows(log.time_s, log.voltage_v)[ticks]
    full = filled_at(log.time_s, max(delay_s), log.time_s[ticks], usual_gap_s(log.time_s, gap_s))
    removed = {
        "decimation": len(log) - ticks.size,
        "start_up_or_shut_down": int(np.sum(~running)),
        "delay_line_filling": int(np.sum(running & ~full)),
    }
    return ticks[running & full], removed


def folds(logs: Sequence[FitRows]) -> Iterator[tuple[Mask, Mask]]:
    """Yield (training, held out) masks over the rows of all logs, one fold at a time."""
    owner = np.repeat(np.arange(len(logs)), [len(rows) for rows in logs])
    if len(logs) >= LOGS_AT_LEAST:
        number = min(len(logs), FOLDS_AT_MOST)
        for fold in range(number):
            held_out = owner % number == fold
            yield ~held_out, held_out
        return
    block = block_numbers(logs, BLOCK_S)
    since = np.concatenate([(rows.time_s - rows.time_s[0]) % BLOCK_S for rows in logs])
    edge = np.zeros(block.size, dtype=bool)
    for log in range(len(logs)):
        numbers = block[owner == log]
        edge |= (block == numbers[0]) | (block == numbers[-1])
    guarded = (since >= BLOCK_GUARD_S) & (since < BLOCK_S - BLOCK_GUARD_S)
    for fold in range(BLOCK_FOLDS):
        of_fold = block % BLOCK_FOLDS == fold
        held_out = of_fold & ~edge & guarded
        if held_out.any():
            yield ~of_fold | edge, held_out


def block_numbers(logs: Sequence[FitRows], block_s: float) -> NDArray[np.intp]:
    """Return the number of each row's block of `block_s`, over all logs in order, shape (n,)."""
    numbers: list[NDArray[np.intp]] = []
    first = 0
    for rows in logs:
        elapsed_s = rows.time_s - rows.time_s[0]
        numbers.append(first + (elapsed_s // block_s).astype(np.intp))
        first = int(numbers[-1][-1]) + 1
    return np.concatenate(numbers)
