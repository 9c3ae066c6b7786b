"""The time axis of a report: one or more logs, one after another, from zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cangauge.identify.rows import usual_gap_s
from cangauge.model.delay_line import GAP_S
from cangauge.report.recorded import Recorded

FloatArray = NDArray[np.float64]

PAUSE = 0.004
"""Free space between two logs, relative to the whole axis."""


@dataclass(frozen=True, eq=False)
class Timeline:
    """Where the logs lie on the common axis.

    Parameters
    ----------
    names : sequence of str
        The logs' names.
    start : array of shape (k,)
        Where each log begins on the axis, in `unit`.
    first_s : array of shape (k,)
        Its first time stamp [s].
    gap_s : array of shape (k,)
        A line breaks over a longer step of its time [s].
    seconds : float
        Length of the axis' unit [s].
    unit : {"s", "min", "h"}
    pause : float
        Free space between two logs, in `unit`.
    end : float
        End of the last log, in `unit`.
    """

    names: Sequence[str]
    start: FloatArray
    first_s: FloatArray
    gap_s: FloatArray
    seconds: float
    unit: str
    pause: float
    end: float

    @classmethod
    def of(cls, logs: Sequence[Recorded]) -> Timeline:
        """Lay logs out one after another."""
        durations = np.array([log.duration_s for log in logs])
        pause_s = PAUSE * float(durations.sum())
        ends = np.cumsum(durations + pause_s)
        total_s = float(ends[-1]) - pause_s
        total_s = max(total_s, 1e-3)  # one row alone still needs an axis
        seconds, unit = _unit(total_s)
        return cls(
            names=[log.name for log in logs],
            start=np.concatenate(([0.0], ends[:-1])) / seconds,
            first_s=np.array([log.time_s[0] for log in logs]),
            gap_s=np.array([usual_gap_s(log.time_s, GAP_S) for log in logs]),
            seconds=seconds,
            unit=unit,
            pause=pause_s / seconds,
            end=total_s / seconds,
        )

    @property
    def label(self) -> str:
        """Text for the axis."""
        return (
            f"time [{self.unit}]" if len(self.names) == 1 else f"time, logs in turn [{self.unit}]"
        )

    def at(self, number: int, time_s: FloatArray) -> FloatArray:
        """Return the axis positions of times [s] of the log with this number."""
        return np.asarray(self.start[number] + (time_s - self.first_s[number]) / self.seconds)

    def line(
        self, pieces: Sequence[tuple[FloatArray, FloatArray]], *, gap_s: float | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return one line through all logs, with NaN wherever it must break.

        Parameters
        ----------
        pieces : sequence of (time_s, values), one for each log
        gap_s : float, optional
            Break over steps longer than this [s]; by default over the logs' own gaps.
        """
        places, drawn = [], []
        for number, (time_s, values) in enumerate(pieces):
            limit_s = self.gap_s[number] if gap_s is None else gap_s
            breaks = np.flatnonzero(np.diff(time_s) > limit_s) + 1
            # A break at the end parts this log from the next one.
            breaks = np.append(breaks, time_s.size)
            at = self.at(number, time_s)
            places.append(np.insert(at, breaks, at[breaks - 1]))
            drawn.append(np.insert(values, breaks, np.nan))
        return np.concatenate(places), np.concatenate(drawn)


def _unit(total_s: float) -> tuple[float, str]:
    if total_s <= 300.0:
        return 1.0, "s"
    return (60.0, "min") if total_s <= 6.0 * 3600.0 else (3600.0, "h")
