"""History of a running service's status, in bounded memory: one row for each new status."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from cangauge._text import plain
from cangauge._typing import FloatArray
from cangauge.service.status_client import SHOW_EVERY_S
from cangauge.types import Reason, Status

SILENT_AFTER_S: Final = 0.7
"""Time without a status after which the service counts as gone, and without a sample the bus as
silent [s]: seen within a second. On a slower bus it is the time of three samples."""

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
[ms since 1970] and `time_s` bus time; status and reasons are the numbers of the published frame.
Rates and latency are those of the last second."""
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

    Attributes
    ----------
    added : int
        Number of rows ever added.
    generation : int
        Changes where rows were thinned: rows read earlier are no longer a part of these.
    """

    def __init__(self, every_s: float, rows_at_most: int, *, thins: bool = False) -> None:
        self.every_s = every_s
        self.rows_at_most = rows_at_most
        self.added = self.generation = 0
        self._thins = thins
        self._rows = np.full((rows_at_most, len(COLUMNS)), math.nan)

    def add(self, row: FloatArray) -> None:
        """Add a row, unless it comes too early for this rate."""
        if self.added:
            waited_s = 1e-3 * (row[0] - self._rows[(self.added - 1) % self.rows_at_most, 0])
            if 0.0 <= waited_s < self.every_s - 0.5 * SHOW_EVERY_S:
                return
        if self._thins and self.added == self.rows_at_most:
            half = self._rows[::2].copy()
            self._rows[: len(half)] = half
            self.added = len(half)
            self.every_s *= 2.0
            self.generation += 1
        self._rows[self.added % self.rows_at_most] = row
        self.added += 1

    def rows(self, after: int = 0) -> FloatArray:
        """Return the rows after the first `after` ever added, as far as they are kept; a copy."""
        first = max(after, self.added - self.rows_at_most, 0)
        return self._rows[np.arange(first, self.added) % self.rows_at_most]

    def columns(self, after: int = 0) -> dict[str, list[float]]:
        """Return such rows as columns of rounded numbers; NaN where a value is unknown."""
        values = self.rows(after).T
        return {
            name: np.round(column, digits).tolist()
            for (name, digits), column in zip(COLUMNS.items(), values, strict=True)
        }

    def to_json(self, after: int = 0) -> str:
        """Return such columns as a JSON object; null where a value is unknown."""
        return json.dumps(plain(self.columns(after)))


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
        rate = status["samples_per_s"] or 0.0
        if _age_s(status) <= SILENT_AFTER_S and rate > 0.0:
            self._interval_s = 1.0 / rate
        row = self._row(status, now_s)
        for span in (self.hour, *self.spans.values()):
            span.add(row)

    def latest(self) -> dict[str, float]:
        """Return the columns of the latest row, {} before the first; NaN: unknown."""
        columns = self.hour.columns(self.hour.added - 1)
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
        if status["sample"] is None:
            found.append("The bus is silent: no sample yet.")
        elif age_s > max(SILENT_AFTER_S, 3.0 * self._interval_s):
            found.append(f"The bus is silent: no sample for {age_s:.1f} s.")
        if problem := status["config"]["problem"]:
            found.append(f"The latest configuration was refused: {problem}.")
        return [*found, *(f"{notice}." for notice in status["notices"])]

    def last_hour(self) -> str:
        """Return the last hour as a log that `cangauge gap` reads: CSV on bus time.

        A row is kept where bus time has moved on; times begin at the first row after the latest
        jump back, as after a restart.
        """
        places = [list(COLUMNS).index(name) for name in LOG_COLUMNS]
        values = self.hour.rows()[:, places]
        values = values[np.isfinite(values[:, :2]).all(axis=1)]
        back = np.flatnonzero(np.diff(values[:, 0]) < 0.0)
        values = values[back[-1] + 1 :] if back.size else values
        lines, before_s = [",".join(LOG_COLUMNS)], -math.inf
        for time_s, *measured in values.tolist():
            if time_s > before_s:
                cells = ["" if math.isnan(value) else f"{value:.6g}" for value in measured]
                lines.append(f"{time_s:.6f},{','.join(cells)}")
            before_s = time_s
        return "\n".join([*lines, ""])

    def _row(self, status: Mapping[str, Any], now_s: float) -> FloatArray:
        values = dict.fromkeys(COLUMNS, math.nan)
        for name, value in (status["estimate"] | (status["sample"] or {})).items():
            if name in COLUMNS and value is not None:
                values[name] = value
        two_sigma = 2.0 * _number(status["estimate"]["soc_std_pct"])
        values["time_ms"] = 1e3 * now_s
        values["soc_low_pct"] = max(values["soc_pct"] - two_sigma, 0.0)
        values["soc_high_pct"] = min(values["soc_pct"] + two_sigma, 100.0)
        values["residual_mv"] = 1e3 * _number(status["estimate"]["residual_v"])
        values |= self._rates(status)
        values["status"] = Status[status["status"].upper()]
        values["reasons"] = sum(Reason[name.upper()] for name in status["reasons"])
        return np.array([*values.values()], dtype=np.float64)

    def _rates(self, status: Mapping[str, Any]) -> dict[str, float]:
        """Return frames and rejects per second and the mean latency, of the last second."""
        latency, counts = status["latency"], self._counts
        counts.append(
            (
                status["uptime_s"],
                status["frames"]["received"],
                sum(status["rejects"].values()),
                latency["count"],
                latency["count"] * (latency["mean_s"] or 0.0),
            )
        )
        while len(counts) > 2 and counts[-1][0] - counts[1][0] >= 1.0:
            counts.popleft()
        seconds, frames, rejects, published, latency_s = np.subtract(counts[-1], counts[0]).tolist()
        if seconds < 0.5:
            return {}
        return {
            "frames_per_s": frames / seconds,
            "rejects_per_s": rejects / seconds,
            "latency_ms": 1e3 * latency_s / published if published else math.nan,
        }


def _age_s(status: Mapping[str, Any]) -> float:
    """Return the age of the latest sample [s]; NaN without one."""
    return _number((status["sample"] or {}).get("age_s"))


def _number(value: float | None) -> float:
    return math.nan if value is None else value
