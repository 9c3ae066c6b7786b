"""What stands for the pack: the twin's own cells, or another simulator behind the same door."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cangauge.twin.cells import Electrical, electrical
from cangauge.twin.condition import Condition
from cangauge.twin.day import Day
from cangauge.twin.pack import Pack

FloatArray = NDArray[np.float64]


class Plant(Protocol):
    """A pack that answers a current with a voltage."""

    @property
    def name(self) -> str:
        """What simulates it, for the truth file."""

    @property
    def pack(self) -> Pack:
        """Its size, thermal masses, sensors and open-circuit voltage."""

    @property
    def settled_k(self) -> float:
        """Change of the core's temperature below which another pass is not worth it [K]."""

    def electrical(
        self, day: Day, condition: Condition, current_a: FloatArray, core_c: FloatArray
    ) -> Electrical:
        """Return voltage, charge and heat, shape (n,) each (parameters as in `cells`)."""


class TwinPlant:
    """The twin's own cells.

    Parameters
    ----------
    pack : Pack
    """

    name = "twin"
    settled_k = 0.05

    def __init__(self, pack: Pack) -> None:
        self.pack = pack

    def electrical(
        self, day: Day, condition: Condition, current_a: FloatArray, core_c: FloatArray
    ) -> Electrical:
        """Return voltage, charge and heat, shape (n,) each."""
        return electrical(self.pack, day, condition, current_a, core_c)
