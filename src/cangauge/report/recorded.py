"""What a report needs of a recording: a log has it, and so have the samples of a capture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class Recorded(Protocol):
    """Series of a drive or test, n rows; voltage, temperature and SoC may hold NaN."""

    @property
    def time_s(self) -> FloatArray:
        """Time [s], increasing."""

    @property
    def current_a(self) -> FloatArray:
        """Current [A], positive = discharge."""

    @property
    def voltage_v(self) -> FloatArray:
        """Voltage [V]."""

    @property
    def temperature_c(self) -> FloatArray:
        """Temperature [°C]."""

    @property
    def soc_pct(self) -> FloatArray | None:
        """Reference SoC [%]."""

    @property
    def name(self) -> str:
        """Short name."""

    @property
    def source(self) -> str:
        """Path of the file."""

    @property
    def temperature_source(self) -> str:
        """What the temperature was measured on."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """What reading it showed."""

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last [s]."""

    def __len__(self) -> int:
        """Return the number of rows."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Samples as they were recorded: unlike a log's, voltage and temperature may be missing.

    Parameters
    ----------
    time_s : array of shape (n,)
        Time [s], not decreasing.
    current_a, voltage_v, temperature_c : array of shape (n,)
        Current [A] (positive = discharge), voltage [V] and temperature [°C], NaN where missing.
    soc_pct : array of shape (n,), optional
        Reference SoC [%], NaN where missing.
    name, source, temperature_source : str
    remarks : tuple of str
    """

    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    soc_pct: FloatArray | None
    name: str
    source: str
    temperature_source: str
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self.time_s.size)

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last [s]."""
        return float(self.time_s[-1] - self.time_s[0])
