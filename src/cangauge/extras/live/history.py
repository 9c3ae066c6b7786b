"""History of a running service's status, in bounded memory: one row for each new status."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.service.status_client import SHOW_EVERY_S
from cangauge.types import REASON_WORDS, Reason, Status, reason_name

SILENT_AFTER_S: Final = 0.7
"""Time without a status after which the service counts as gone, and without a sample the bus as
silent [s]: seen within a second."""
SILENT_INTERVALS: Final = 3.0
"""The same on a bus whose samples come seldom, in intervals of the samples."""
RATE_OVER_S: Final = 1.0
"""Averaging time of rates and latency [s]."""

COLUMNS: Final = {
    "time_ms": 0,
    "time_s": 6,
    "soc_pct": 4,
    "soc_low_pct": 4,
    "soc_high_pct": 4,
    "soc_newton_pct": 4,
    "soc_coulomb_pct": 4,
    "current_a": 3,
    "voltage_v": 4,
    "voltage_model_v": 4,
    "residual_mv": 2,
    "temperature_c": 2,
    "frames_per_s": 1,
    "rejects_per_s": 2,
    "latency_ms": 3,
    "status": 0,
    "reasons": 0,
}
"""Columns of the history, with the decimals shown to viewers. `time_ms` is wall-clock time
[ms since 1970] and `time_s` bus time; status and reasons are the numbers of the published frame."""
_AT: Final = {name: place for place, name in enumerate(COLUMNS)}
_STATUS: Final = {each.name.lower(): float(each) for each in Status}
_REASON: Final = {reason_name(each).replace(" ", "_"): int(each) for each in Reason if each}
REASONS: Final = {
    str(int(each)): REASON_WORDS.get(each, reason_name(each)) for each in Reason if each
}
"""Reasons in plain words, by their numbers."""


LOG_NAME: Final = "cangauge-last-hour.csv"
LOG_COLUMNS: Final = ("time_s", "current_a", "voltage_v", "temperature_c")


class Span:
    """The latest rows at one rate, in an array of fixed size.

    Parameters
    ----------
    every_s : float
        Interval of the rows [s].
    rows_at_most : int
    thins : bool
        Keep everything since the start: where the array is full, drop every other row and double
        the interval. Otherwise the oldest row goes.
    """

    def __init__(self, every_s: float, rows_at_most: int, *, thins: bool = False) -> None:
        self.every_s = every_s
        self.rows_at_most = rows_at_most
        self.added = 0
        """Number of rows ever added."""
        self.generation = 0
        """Changes where rows were thinned: rows read earlier are no longer a part of these."""
        self._thins = thins
        self._kept = 0
        self._rows = np.full((rows_at_most, len(COLUMNS)), math.nan)

    def add(self, row: FloatArray) -> None:
        """Add a row, unless it comes too early for this rate."""
        if self._kept:
            waited_s = 1e-3 * (row[0] - self._rows[(self.added - 1) % self.rows_at_most, 0])
            if 0.0 <= waited_s < self.every_s - 0.5 * SHOW_EVERY_S:
                return
        if self._thins and self._kept == self.rows_at_most:
            half = self.rows()[::2].copy()
            self._rows[: len(half)] = half
            self.added = self._kept = len(half)
            self.every_s *= 2.0
            self.generation += 1
        self._rows[self.added % self.rows_at_most] = row
        self.added += 1
        self._kept = min(self._kept + 1, self.rows_at_most)

    def rows(self, after: int = 0) -> FloatArray:
        """Return the rows after the first `after` ever added, as far as they are kept; a copy."""
        new = min(max(self.added - after, 0), self._kept)
        return self._rows[np.arange(self.added - new, self.added) % self.rows_at_most]


class History:
    """Rows of the last 10 minutes, the last hour and everything, and the latest status.

    Parameters
    ----------
    clock : callable
        Wall-clock time [s since 1970].

    Attributes
    ----------
    status : dict or None
        The latest object of `/status`.
    spans : dict of str to Span
        Shown to viewers.
    hour : Span
        Every row of the last hour.
    """

    def __init__(self, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self._received_s = -math.inf
        self._interval_s = SHOW_EVERY_S
        self._samples = 0
        self._sample_s = 0.0
        self._counts: deque[tuple[float, ...]] = deque(maxlen=64)
        self.status: dict[str, Any] | None = None
        self.hour = Span(SHOW_EVERY_S, 36_000)
        self.spans = {
            "10min": Span(SHOW_EVERY_S, 6000),
            "1h": Span(1.0, 3600),
            "all": Span(1.0, 4000, thins=True),
        }

    def add(self, status: dict[str, Any]) -> None:
        """Add a status: the object of `/status`."""
        now_s = self._clock()
        self.status, self._received_s = status, now_s
        if status["samples"] != self._samples:
            self._samples, self._sample_s = status["samples"], status["uptime_s"]
        rate = _number(status["samples_per_s"])
        if _age_s(status) <= SILENT_AFTER_S and rate > 0.0:
            self._interval_s = 1.0 / rate
        row = self._row(status, now_s)
        self.hour.add(row)
        for span in self.spans.values():
            span.add(row)

    def latest(self) -> dict[str, float | None]:
        """Return the columns of the latest row, {} before the first."""
        columns = shown_columns(self.hour.rows(max(self.hour.added - 1, 0)))
        return {name: values[0] for name, values in columns.items() if values}

    def troubles(self) -> list[str]:
        """Return what a viewer must know before trusting the values; [] where all is well."""
        status, silent_s = self.status, self._clock() - self._received_s
        if status is None:
            return ["Waiting for the service."]
        if silent_s > SILENT_AFTER_S:
            return [f"The service has not reported for {silent_s:.1f} s. The values are old."]
        found = []
        if status["loop_stuck"]:
            found.append("The service hangs: restart it.")
        if not status["bus_up"]:
            found.append(f"The bus is lost: {status['bus_trouble'] or 'no reason known'}.")
        # A sample may be old because it waited: the service then works through what has come.
        age_s = min(_age_s(status), status["uptime_s"] - self._sample_s)
        if age_s > max(SILENT_AFTER_S, SILENT_INTERVALS * self._interval_s):
            found.append(f"The bus is silent: no sample for {age_s:.1f} s.")
        elif status["sample"] is None:
            found.append("The bus is silent: no sample yet.")
        if problem := status["config"]["problem"]:
            found.append(f"The latest configuration was refused: {problem}.")
        return [*found, *(f"{notice}." for notice in status["notices"])]

    def _row(self, status: Mapping[str, Any], now_s: float) -> FloatArray:
        estimate, sample = status["estimate"], status["sample"] or {}
        values = {name: _number(estimate.get(name)) for name in COLUMNS}
        values |= {
            name: _number(sample.get(name)) for name in ("current_a", "voltage_v", "temperature_c")
        }
        two_sigma = 2.0 * _number(estimate["soc_std_pct"])
        values["time_ms"] = 1e3 * now_s
        values["soc_low_pct"] = max(values["soc_pct"] - two_sigma, 0.0)
        values["soc_high_pct"] = min(values["soc_pct"] + two_sigma, 100.0)
        values["residual_mv"] = 1e3 * _number(estimate["residual_v"])
        values |= self._rates(status)
        values["status"] = _STATUS[status["status"]]
        values["reasons"] = float(sum(_REASON[each] for each in status["reasons"]))
        return np.array(list(values.values()))

    def _rates(self, status: Mapping[str, Any]) -> dict[str, float]:
        """Return frames and rejects per second and the mean latency, of the last second."""
        latency = status["latency"]
        counts = self._counts
        counts.append(
            (
                float(status["uptime_s"]),
                float(status["frames"]["received"]),
                float(sum(status["rejects"].values())),
                float(latency["count"]),
                float(latency["count"] * (latency["mean_s"] or 0.0)),
            )
        )
        while len(counts) > 2 and counts[-1][0] - counts[1][0] >= RATE_OVER_S:
            counts.popleft()
        seconds, frames, rejects, published, latency_s = np.subtract(counts[-1], counts[0]).tolist()
        if seconds < 0.5 * RATE_OVER_S:
            return {}
        return {
            "frames_per_s": frames / seconds,
            "rejects_per_s": rejects / seconds,
            "latency_ms": 1e3 * latency_s / published if published else math.nan,
        }


def last_hour(history: History) -> str:
    """Return the last hour as a log that `cangauge gap` reads: CSV on bus time.

    A row is kept where bus time has moved on; times begin at the first row after the latest jump
    back, as after a restart.
    """
    rows = history.hour.rows()
    values = np.stack([column(rows, name) for name in LOG_COLUMNS], axis=1)
    values = values[np.isfinite(values[:, :2]).all(axis=1)]
    back = np.flatnonzero(np.diff(values[:, 0]) < 0.0)
    values = values[back[-1] + 1 :] if back.size else values
    values = values[np.diff(values[:, 0], prepend=-math.inf) > 0.0]
    lines = [",".join("" if math.isnan(v) else f"{v:.6g}" for v in row[1:]) for row in values]
    stamps = [f"{time_s:.6f}" for time_s in values[:, 0]]
    return "\n".join([",".join(LOG_COLUMNS), *map(",".join, zip(stamps, lines, strict=True)), ""])


def column(rows: FloatArray, name: str) -> FloatArray:
    """Return a column of rows by its name."""
    return rows[:, _AT[name]]


def shown_columns(rows: FloatArray) -> dict[str, list[float | None]]:
    """Return rows as columns of rounded numbers; None where a value is unknown."""
    shown = {}
    for place, (name, digits) in enumerate(COLUMNS.items()):
        values = np.round(rows[:, place], digits).tolist()
        shown[name] = [None if math.isnan(value) else value for value in values]
    return shown


def _age_s(status: Mapping[str, Any]) -> float:
    return _number((status["sample"] or {}).get("age_s"))


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan
