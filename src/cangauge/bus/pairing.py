"""Current and voltage → samples, on bus time.

Rules
-----
- A current and a voltage at most `within_s` apart make a sample, stamped with the current's
  time, when the later of the two arrives. Each is used once.
- A current that can no longer be paired (a newer frame of either kind lies more than `within_s`
  after it, or the next current arrives) becomes a sample without voltage (NaN), so that its
  charge is still counted.
- A voltage that finds no current is dropped: the next one replaces it.
- When time runs backwards by more than `within_s`, what waits is given up: a current as a sample
  without voltage, a voltage dropped.

At most one sample results from one frame, and samples come in the order of their currents.
"""

from __future__ import annotations

import math

from cangauge.estimate.types import Sample


class Pairing:
    """Pairs currents and voltages; see the rules in the module's docstring.

    Parameters
    ----------
    within_s : float
        Largest distance in bus time [s].

    Attributes
    ----------
    current_unpaired, voltage_unpaired : int
        Samples without voltage, voltages dropped.
    """

    __slots__ = (
        "_current_a",
        "_current_s",
        "_temperature_c",
        "_voltage_s",
        "_voltage_v",
        "_within_s",
        "current_unpaired",
        "voltage_unpaired",
    )

    def __init__(self, within_s: float) -> None:
        # A hair more than stated, so that stamps 20 ms apart pair whatever their rounding.
        self._within_s = within_s + 1e-6
        self.current_unpaired = 0
        self.voltage_unpaired = 0
        self._current_s = math.nan  # NaN: nothing waits
        self._current_a = math.nan
        self._temperature_c = math.nan
        self._voltage_s = math.nan
        self._voltage_v = math.nan

    def current(self, time_s: float, current_a: float, temperature_c: float) -> Sample | None:
        """Take a current [A] and the temperature [°C] that holds at it."""
        if abs(time_s - self._voltage_s) <= self._within_s:
            # No current can wait beside a waiting voltage that near.
            voltage_v = self._voltage_v
            self._voltage_s = math.nan
            return Sample(time_s, current_a, voltage_v, temperature_c)
        if not math.isnan(self._voltage_s):
            self.voltage_unpaired += 1
            self._voltage_s = math.nan
        given_up = self.flush()
        self._current_s, self._current_a = time_s, current_a
        self._temperature_c = temperature_c
        return given_up

    def voltage(self, time_s: float, voltage_v: float) -> Sample | None:
        """Take a voltage [V]."""
        if abs(time_s - self._current_s) <= self._within_s:
            sample = Sample(self._current_s, self._current_a, voltage_v, self._temperature_c)
            self._current_s = math.nan
            return sample
        if not math.isnan(self._voltage_s):
            self.voltage_unpaired += 1
        self._voltage_s, self._voltage_v = time_s, voltage_v
        return self.flush()

    def flush(self) -> Sample | None:
        """Give up the waiting current, if any: a sample without voltage."""
        if math.isnan(self._current_s):
            return None
        sample = Sample(self._current_s, self._current_a, math.nan, self._temperature_c)
        self._current_s = math.nan
        self.current_unpaired += 1
        return sample
