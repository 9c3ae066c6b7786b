"""The canonical log: one drive or test as time series, positive current discharging."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cangauge._typing import FloatArray
from cangauge.errors import InputError

TemperatureSource = Literal["cell", "pack", "coolant", "room", "unknown"]
TEMPERATURE_SOURCES: tuple[str, ...] = get_args(TemperatureSource)


@dataclass(frozen=True, slots=True, eq=False)
class Log:
    """One drive or test.

    Parameters
    ----------
    time_s : array of shape (n,)
        Time [s], strictly increasing; the rate may vary and there may be gaps.
    current_a : array of shape (n,)
        Pack current [A], positive = discharge.
    voltage_v : array of shape (n,)
        Pack voltage [V].
    temperature_c : array of shape (n,)
        Temperature [°C] from `temperature_source`.
    soc_pct : array of shape (n,), optional
        Reference state of charge [%]. May be NaN anywhere: the first finite value is the assumed
        SoC at that moment, finite values are the reference to compare with.
    name : str
        Short name for tables and plots.
    source : str
        Path of the file that it was read from, or "".
    temperature_source : {"cell", "pack", "coolant", "room", "unknown"}
        What the temperature was measured on.
    remarks : tuple of str
        What the reader changed or noticed ("12 duplicated time stamps dropped").

    Raises
    ------
    InputError
        If the arrays are empty, differ in length, hold NaN or infinities (except `soc_pct`), or
        if time does not increase.
    """

    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    soc_pct: FloatArray | None = None
    name: str = "log"
    source: str = ""
    temperature_source: TemperatureSource = "unknown"
    remarks: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        for channel in ("time_s", "current_a", "voltage_v", "temperature_c", "soc_pct"):
            values = getattr(self, channel)
            if values is not None:
                object.__setattr__(self, channel, _read_only(values))
        self._validate()

    def _validate(self) -> None:
        where = self.source or self.name
        n = self.time_s.size
        if n == 0:
            raise InputError("the log holds no rows", source=where, cure="check the export")
        for channel in ("current_a", "voltage_v", "temperature_c", "soc_pct"):
            values = getattr(self, channel)
            if values is not None and values.shape != (n,):
                raise InputError(
                    f"has {values.size} values where time_s has {n}", source=where, field=channel
                )
        for channel in ("time_s", "current_a", "voltage_v", "temperature_c"):
            values = getattr(self, channel)
            bad = np.flatnonzero(~np.isfinite(values))
            if bad.size:
                raise InputError(
                    f"{bad.size} of {n} values are not finite, the first in row {bad[0] + 1}",
                    source=where,
                    field=channel,
                    value=float(values[bad[0]]),
                    cure="fill or drop these rows in the file",
                )
        back = np.flatnonzero(np.diff(self.time_s) <= 0.0)
        if back.size:
            row = int(back[0]) + 1
            raise InputError(
                f"time does not increase at row {row + 1}"
                f" ({back.size} such rows; {self.time_s[row - 1]:.6f} s comes before)",
                source=where,
                field="time_s",
                value=float(self.time_s[row]),
                cure="sort the rows by time and drop duplicated stamps",
            )

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self.time_s.size)

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last [s]."""
        return float(self.time_s[-1] - self.time_s[0])

    def first_soc(self) -> tuple[int, float] | None:
        """Return row and value [%] of the first finite reference SoC, or None."""
        if self.soc_pct is None:
            return None
        rows = np.flatnonzero(np.isfinite(self.soc_pct))
        return (int(rows[0]), float(self.soc_pct[rows[0]])) if rows.size else None

    def rows(self, keep: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Self:
        """Return the log of the rows that `keep` selects (mask, indices or slice)."""
        return replace(
            self,
            time_s=self.time_s[keep],
            current_a=self.current_a[keep],
            voltage_v=self.voltage_v[keep],
            temperature_c=self.temperature_c[keep],
            soc_pct=None if self.soc_pct is None else self.soc_pct[keep],
        )


def _read_only(values: ArrayLike) -> FloatArray:
    array = np.array(values, dtype=np.float64, copy=True)
    array.flags.writeable = False
    return array
