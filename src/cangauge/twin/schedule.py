"""Speed traces from files: a driving schedule as CSV with time and speed."""

from __future__ import annotations

from os import PathLike
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
from numpy.typing import NDArray

from cangauge.errors import InputError
from cangauge.files import read_bounded
from cangauge.limits import MAX_SPEED_TRACE_BYTES

FloatArray = NDArray[np.float64]

# Unit in the heading (or none) → factor to m/s.
_UNITS: Final = {"kmh": 1.0 / 3.6, "kph": 1.0 / 3.6, "km/h": 1.0 / 3.6, "mph": 0.44704}
_FASTEST_MS: Final = 85.0
_LONGEST_S: Final = 1e6
_CURE: Final = "give two columns with a heading: time [s] and speed [m/s], or speed_kmh, speed_mph"


def read_speed(path: str | PathLike[str]) -> FloatArray:
    """Return the speed of a schedule at 1 Hz [m/s], shape (n,).

    The first column is time [s], the second speed [m/s], or km/h or mph where its heading says so.

    Parameters
    ----------
    path : path-like
        CSV with one line of headings.

    Raises
    ------
    InputError
        If it cannot be read, time does not increase, or a speed is negative or out of this world.
    """
    data = read_bounded(path, MAX_SPEED_TRACE_BYTES, "a speed trace")
    try:
        data.decode("utf-8")
        table = pacsv.read_csv(pa.BufferReader(data))
        if table.num_columns < 2 or table.num_rows < 2:
            raise InputError("this is no speed trace", source=path, cure=_CURE)
        time_s = np.asarray(table.column(0).cast(pa.float64()).to_numpy())
        speed = np.asarray(table.column(1).cast(pa.float64()).to_numpy())
    except (pa.ArrowException, ValueError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"this is no speed trace ({reason})", source=path, cure=_CURE) from error
    heading = table.column_names[1]
    compact = heading.lower().replace("_", "").replace(" ", "")
    factor = next((value for unit, value in _UNITS.items() if unit in compact), 1.0)
    speed = factor * speed
    if not (np.all(np.isfinite(time_s)) and np.all(np.diff(time_s) > 0.0)):
        raise InputError(
            "time does not increase", source=path, field=table.column_names[0], cure=_CURE
        )
    if time_s[-1] - time_s[0] > _LONGEST_S:
        raise InputError(
            f"it lasts longer than {_LONGEST_S:g} s",
            source=path,
            field=table.column_names[0],
            value=float(time_s[-1]),
            cure=_CURE,
        )
    bad = np.flatnonzero(~((speed >= 0.0) & (speed < _FASTEST_MS)))
    if bad.size:
        raise InputError(
            f"row {bad[0] + 1} is no speed of a car in m/s",
            source=path,
            field=heading,
            value=float(speed[bad[0]]),
            cure=_CURE,
        )
    seconds = np.arange(time_s[0], time_s[-1] + 0.5)
    trace: FloatArray = np.interp(seconds, time_s, speed)
    return trace
