"""The temperature of the cells' inside, which may follow the measured one late."""

from __future__ import annotations

from collections.abc import Sequence

from cangauge.model.effects.first_order import LowPass
from cangauge.model.effects.pack_state import AT_ONCE_S
from cangauge.model.effects.parameter import Parameter

LAG = Parameter(
    "lag_s", "s", 0.0, 10000.0, neutral=None, grid=(0.0,), elsewhere=(600.0, 1800.0), formerly=0.0
)
"""How late (0: at once; `PackState.inside_c`). Only a diagnosis tries others: on a day on which the
pack warms, what the inside does tells causes apart."""


class Inside:
    """That temperature, one sample at a time."""

    def __init__(self, lag_s: float) -> None:
        self._lag = LowPass(lag_s) if lag_s > AT_ONCE_S else None

    @property
    def is_late(self) -> bool:
        """Whether it follows late."""
        return self._lag is not None

    def step(self, time_s: float, measured_c: float) -> float:
        """Take one sample and return the temperature inside [°C]."""
        return measured_c if self._lag is None else self._lag.step(time_s, measured_c)

    def memory(self) -> list[float]:
        """Return what is to be remembered of earlier samples."""
        return [] if self._lag is None else self._lag.memory()

    def remember(self, memory: Sequence[float], latest_s: float) -> None:
        """Go on from a memory, no later than `latest_s` [s]; may raise ValueError."""
        if self._lag is not None:
            self._lag.remember(memory, latest_s)
        elif memory:
            raise ValueError("follows at once, and remembers nothing")
