"""What a user may choose in an identification.

Log → the rows that a fit uses, at the model's own rate.

Rules, in this order:

1. Decimation: the first sample at or after each tick of `rate_hz`; a slower log is kept whole.
2. Start-up and shut-down: rows with a voltage below half the log's median are removed, and so
   are rows less than `GUARD_S` away from one (contactor open, pre-charge).
3. Delay line: the first 70 s (the longest delay), and as long after a gap in the current longer
   than `gap_s`, are removed.

Which rows to fit on and which to judge on.

Several logs: whole logs are left out in turn. One or two logs: short interleaved blocks with a
guard between them, the first and the last block of each log always kept for the fit, since the
1/s⁴ terms explode beyond the SoC that they saw.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.logs.resample import dequantize
from cangauge.model.charge import counted_soc_pct
from cangauge.model.delay_line import GAP_S, delayed_currents, settled

# --- What a user may choose in an identification

DELAYS_S = (0.0, 10.0, 30.0, 70.0)
"""The published delays [s]."""


@dataclass(frozen=True)
class FitOptions:
    """What a user may choose; the defaults are the published choices."""

    capacity_ah: float | None = None
    """Charge from 100 to 0 % [Ah]; by default from a log that runs from full to empty."""
    initial_soc_pct: float | None = None
    """SoC at each log's first row [%]; by default the logs' own reference, else 100."""
    rate_hz: float = 1.0
    delay_s: tuple[float, ...] = DELAYS_S
    epsilon: float = 0.05
    t_ref_c: float = 20.0
    name: str | None = None
    effects: tuple[str, ...] = ()
    """Effects beyond the coefficients: ids, or `auto` alone to let logs left out choose."""


# --- Log → the rows that a fit uses, at the model's own rate

LOW_VOLTAGE = 0.5
"""Rows below this fraction of the log's median voltage are start-up or shut-down."""

GUARD_S = 2.0
"""Rows closer than this to a start-up or shut-down row go too [s]."""

SOC_TOLERANCE_PCT = 3.0
"""How far a counted SoC may leave 0–100 % before the capacity or the start must be wrong."""


@dataclass(frozen=True, eq=False)
class FitRows:
    """What one log gives to the fit: shape (m,) each, and (m, number of delays)."""

    name: str
    time_s: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    """As it was reported [°C]: what an estimator is given."""
    between_c: FloatArray
    """Read between the steps of the reports [°C] (`logs.unstepped`): what the cells were at."""
    soc_pct: FloatArray
    """Counted SoC [%]."""
    delayed_current_a: FloatArray
    """I(t − dj) [A], positive = discharge."""
    removed: dict[str, int]
    """Rows removed by each rule."""

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self.time_s.size)


def fit_rows(
    log: Log,
    *,
    capacity_ah: float,
    delay_s: Sequence[float],
    rate_hz: float = 1.0,
    initial_soc_pct: float | None = None,
    gap_s: float = GAP_S,
) -> FitRows:
    """Return the rows of a log that take part in a fit.

    Raises
    ------
    InputError
        If nothing is left, or the counted SoC leaves 0–100 % by more than `SOC_TOLERANCE_PCT`.
    """
    where = log.source or log.name
    soc = counted_soc_pct(log, capacity_ah, initial_soc_pct)
    low, high = float(soc.min()), float(soc.max())
    if low < -SOC_TOLERANCE_PCT or high > 100.0 + SOC_TOLERANCE_PCT:
        assumed = initial_soc_pct is None and log.first_soc() is None
        start = " from an assumed start at 100 %" if assumed else ""
        raise InputError(
            f"the SoC counted with {capacity_ah:.2f} Ah{start} runs from {high:.1f} to {low:.1f} %",
            source=where,
            field="soc_pct",
            cure="check --capacity-ah, the SoC at the start (soc_pct, --initial-soc) and the sign"
            " of current (positive must discharge; `cangauge inspect` finds it)",
        )
    ticks = decimate(log.time_s, rate_hz)
    running = running_rows(log.time_s, log.voltage_v)[ticks]
    full = settled(log.time_s, max(delay_s), log.time_s[ticks], usual_gap_s(log.time_s, gap_s))
    keep = ticks[running & full]
    if keep.size < 2:
        raise InputError(
            f"no rows are left for the fit: the log lasts {log.duration_s:.0f} s and the first"
            f" {max(delay_s):.0f} s, and as long after each gap, fill the delay line",
            source=where,
            cure="give a longer log",
        )
    return FitRows(
        name=log.name,
        time_s=log.time_s[keep],
        voltage_v=log.voltage_v[keep],
        temperature_c=log.temperature_c[keep],
        between_c=dequantize(log).temperature_c[keep],
        soc_pct=soc[keep],
        delayed_current_a=delayed_currents(log.time_s, log.current_a, delay_s, log.time_s[keep]),
        removed={
            "decimation": len(log) - ticks.size,
            "start_up_or_shut_down": int(np.sum(~running)),
            "delay_line_filling": int(np.sum(running & ~full)),
        },
    )


def decimate(time_s: FloatArray, rate_hz: float) -> NDArray[np.intp]:
    """Return the rows of the first sample at or after each tick of `rate_hz`."""
    tick = np.floor((time_s - time_s[0]) * rate_hz + 1e-6)
    return np.flatnonzero(np.concatenate(([True], np.diff(tick) > 0.0)))


def running_rows(time_s: FloatArray, voltage_v: FloatArray) -> NDArray[np.bool_]:
    """Return which rows are neither start-up nor shut-down (rule 2 of this module)."""
    down = voltage_v < LOW_VOLTAGE * float(np.median(voltage_v))
    if not down.any():
        return ~down
    at = time_s[down]
    right = np.searchsorted(at, time_s)
    to_next = np.where(right < at.size, at[np.minimum(right, at.size - 1)] - time_s, np.inf)
    to_last = np.where(right > 0, time_s - at[np.maximum(right - 1, 0)], np.inf)
    return np.asarray(np.minimum(to_next, to_last) > GUARD_S) & ~down


def usual_gap_s(time_s: FloatArray, gap_s: float) -> float:
    """Return what counts as a gap in a recorded log [s]: `gap_s`, or 3 usual steps if longer."""
    return max(gap_s, 3.0 * float(np.median(np.diff(time_s)))) if time_s.size > 1 else gap_s


# --- Which rows to fit on and which to judge on

Mask = NDArray[np.bool_]

LOGS_AT_LEAST = 3
FOLDS_AT_MOST = 12
BLOCK_S, INTERLEAVED_GUARD_S = 240.0, 60.0
BLOCK_FOLDS = 5


def folds(logs: Sequence[FitRows]) -> Iterator[tuple[Mask, Mask]]:
    """Yield (fit on, judge on) masks over the rows of all logs, one after another."""
    owner = np.concatenate([np.full(len(rows), k) for k, rows in enumerate(logs)])
    if len(logs) >= LOGS_AT_LEAST:
        number = min(len(logs), FOLDS_AT_MOST)
        for fold in range(number):
            judged = owner % number == fold
            yield ~judged, judged
        return
    block, since = _blocks(logs)
    for fold in range(BLOCK_FOLDS):
        judged = block % BLOCK_FOLDS == fold
        edge = _edge_blocks(block, owner)
        core = (
            judged
            & ~edge
            & (since >= INTERLEAVED_GUARD_S)
            & (since < BLOCK_S - INTERLEAVED_GUARD_S)
        )
        if core.any():
            yield ~judged | edge, core


def _blocks(logs: Sequence[FitRows]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    number, since, first = [], [], 0
    for rows in logs:
        elapsed = rows.time_s - rows.time_s[0]
        number.append(first + (elapsed // BLOCK_S).astype(np.intp))
        since.append(elapsed % BLOCK_S)
        first = int(number[-1][-1]) + 1
    return np.concatenate(number), np.concatenate(since)


def _edge_blocks(block: NDArray[np.intp], owner: NDArray[np.intp]) -> Mask:
    edge = np.zeros(block.size, dtype=bool)
    for log in np.unique(owner):
        numbers = block[owner == log]
        edge |= (block == numbers[0]) | (block == numbers[-1])
    return edge
