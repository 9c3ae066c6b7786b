"""The canonical log: one drive or test as time series, positive current discharging."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from os import PathLike
from typing import Any, Final, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from cangauge._dataframes import ArrowExport, arrow_table
from cangauge._extras import extra
from cangauge._text import duration
from cangauge._typing import BoolArray, FloatArray, IntArray
from cangauge.errors import InputError, naming_arguments
from cangauge.logs.quantities import REQUIRED
from cangauge.settings import TEMPERATURE_SOURCES, TemperatureSource
from cangauge.types import SOC_WITHIN_PCT

__all__ = ["TEMPERATURE_SOURCES", "Log", "TemperatureSource"]

SOURCE: Final = "temperature_source"
"""Column of a canonical log: the location of the temperature sensor."""
SOURCE_KEY: Final = b"cangauge.temperature_source"
"""Metadata of an Arrow schema with the same word."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Log(ArrowExport):
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
        Reference state of charge [%], NaN where unknown. The first finite value is also the
        assumed SoC at that time.
    name : str
        Short name for tables and plots.
    source : str
        Path of the file, or "".
    temperature_source : {"cell", "pack", "coolant", "room", "unknown"}
        Location of the temperature sensor.
    remarks : tuple of str
        Changes and findings of the reader ("12 duplicated time stamps dropped").
    counted_ah : array of shape (n,), optional
        Charge discharged by the log's own counter [Ah], from any zero.
    assumed : tuple of str
        How the columns of an arbitrary table were understood; empty where the format defines them.

    Raises
    ------
    InputError
        If the arrays are empty, differ in length, hold NaN or infinities (except `soc_pct`), or
        if time does not increase.

    See Also
    --------
    Log.from_dataframe : The log of a pandas, polars or pyarrow table.

    Notes
    -----
    A log exports the Arrow PyCapsule interface: `polars.DataFrame(log)`, `pyarrow.table(log)`.

    Examples
    --------
    >>> log = Log([0, 1, 2], [10, 20, 0], [380, 379, 381], [21, 21, 21], soc_pct=[80, 80, 79.9])
    >>> len(log), log.duration_s
    (3, 2.0)
    >>> log.to_arrow().column_names
    ['time_s', 'current_a', 'voltage_v', 'temperature_c', 'soc_pct']
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
    assumed: tuple[str, ...] = field(default=())
    counted_ah: FloatArray | None = None

    def __post_init__(self) -> None:
        where = self.source or self.name
        for channel, given in self._channels().items():
            values = _read_only(given)
            object.__setattr__(self, channel, values)
            n = self.time_s.size
            if n == 0:
                raise InputError("the log holds no rows", source=where, cure="check the export")
            if values.shape != (n,):
                problem = f"has {values.size} values where time_s has {n}"
                raise InputError(problem, source=where, field=channel)
            bad = np.flatnonzero(~np.isfinite(values)) if channel in REQUIRED else np.empty(0)
            if bad.size:
                problem = f"{bad.size} of {n} values are not finite, the first in row {bad[0] + 1}"
                value, cure = float(values[bad[0]]), "fill or drop these rows"
                raise InputError(problem, source=where, field=channel, value=value, cure=cure)
        back = np.flatnonzero(np.diff(self.time_s) <= 0.0)
        if back.size:
            row = int(back[0]) + 1
            before = f"the row before has {self.time_s[row - 1]:.6f} s"
            problem = f"time does not increase at row {row + 1} ({back.size} such rows; {before})"
            value = float(self.time_s[row])
            cure = "sort the rows by time and drop duplicated stamps"
            raise InputError(problem, source=where, field="time_s", value=value, cure=cure)

    @classmethod
    @naming_arguments
    def from_dataframe(
        cls,
        table: Any,
        *,
        name: str = "log",
        temperature_c: float | None = None,
        temperature_source: TemperatureSource | None = None,
        columns: Mapping[str, str] | str | None = None,
        sign: Literal["charge", "discharge"] | None = None,
    ) -> Log:
        """Return the log of a pandas, polars or pyarrow table.

        The values are checked as those of a file: missing values, wrong units and time that runs
        backwards raise; rows that repeat a time stamp are dropped with a remark.

        Parameters
        ----------
        table : DataFrame or Table
            Anything with the Arrow PyCapsule interface (`__arrow_c_stream__`), or a mapping of
            columns. Columns in any order and case: `time_s` [s], `current_a` [A, positive =
            discharge], `voltage_v` [V], `temperature_c` [°C], optionally `soc_pct` [%] and
            `temperature_source`; or any with plain headings.
        name : str
            Short name of the log.
        temperature_c, temperature_source, columns, sign
            As of `cangauge.read_log`.

        Raises
        ------
        InputError
            Names the column, the row (from 1) and the value.

        Examples
        --------
        >>> table = {"Time_s": [0, 1], "current_A": [5.0, 6.0], "voltage_V": [380, 379]}
        >>> Log.from_dataframe(table, temperature_c=21.0).voltage_v
        array([380., 379.])
        """
        log: Log = _reading().log_of_dataframe(
            table,
            name=name,
            columns=columns,
            temperature_c=temperature_c,
            temperature_source=temperature_source,
            sign=sign,
        )
        return log

    def to_arrow(self) -> Any:
        """Return a pyarrow.Table of the columns; missing SoC is null.

        The temperature source, where known, is metadata of the schema.
        """
        is_known = self.temperature_source != "unknown"
        metadata = {SOURCE_KEY: self.temperature_source} if is_known else None
        return arrow_table(self._channels(), metadata)

    def __repr__(self) -> str:
        """Return one line of what the log holds."""
        channels = {"A": self.current_a, "V": self.voltage_v, "°C": self.temperature_c}
        spans = [f"{v.min():.4g} … {v.max():.4g} {unit}" for unit, v in channels.items()]
        text = f"{self.name!r}: {len(self):,} rows in {duration(self.duration_s)}"
        soc = np.empty(0) if self.soc_pct is None else self.soc_pct[np.isfinite(self.soc_pct)]
        if soc.size:
            spans.append(f"SoC {soc[0]:.4g} … {soc[-1]:.4g} %")
        return f"<Log {text}; {', '.join(spans)}>"

    def plot(self) -> Any:
        """Return current, voltage, temperature and SoC over time, for `bokeh.plotting.show`."""
        return extra("report.inspection:log_figure")(self)

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self.time_s.size)

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last [s]."""
        return float(self.time_s[-1] - self.time_s[0])

    def first_soc(self) -> tuple[int, float] | None:
        """Return row and value [%] of the first finite reference SoC, or None.

        A SoC that leaves 0–100 % somewhere has a wrong scale or offset, and gives no start.
        """
        if self.soc_pct is None:
            return None
        rows = np.flatnonzero(np.isfinite(self.soc_pct))
        least, most = SOC_WITHIN_PCT
        known = self.soc_pct[rows]
        if not rows.size or known.min() < least or known.max() > most:
            return None
        return int(rows[0]), float(known[0])

    def rows(self, keep: BoolArray | IntArray | slice) -> Self:
        """Return the log of the rows that `keep` selects (mask, indices or slice)."""
        kept: dict[str, Any] = {name: values[keep] for name, values in self._channels().items()}
        if self.counted_ah is not None:
            kept["counted_ah"] = self.counted_ah[keep]
        return replace(self, **kept)

    def _channels(self) -> dict[str, FloatArray]:
        """Return the columns of the canonical log that this one has, by name."""
        channels = {name: getattr(self, name) for name in (*REQUIRED, "soc_pct")}
        return {name: values for name, values in channels.items() if values is not None}


def as_log(log: Any) -> Log:
    """Return a log for a `Log`, a path, or a data frame (`Log.from_dataframe`)."""
    if isinstance(log, Log):
        return log
    if isinstance(log, str | PathLike):
        read: Log = _reading().open_log(log).read()
        return read
    return Log.from_dataframe(log)


def _reading() -> Any:
    """Return the module that reads logs, by name: the service runs without pyarrow."""
    return import_module("cangauge.logs.read")


def _read_only(values: ArrayLike) -> FloatArray:
    if isinstance(values, np.ndarray) and values.dtype == np.float64:
        flags = values.flags
        if flags.owndata and flags.c_contiguous and not flags.writeable:
            return values  # that of another log; it is never changed
    try:
        array = np.array(values, dtype=np.float64, copy=True)
    except (TypeError, ValueError) as error:
        raise InputError(f"a column holds values that are not numbers ({error})") from error
    array.flags.writeable = False
    return array
