"""A simulated pack with training logs of its model, and more drives of it in the same weather."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge.extras.validation.twin.drive import Drive, draw_drive
from cangauge.extras.validation.twin.pack import TwinPack
from cangauge.extras.validation.twin.plant import Plant
from cangauge.extras.validation.twin.recording import Recording, record_drive
from cangauge.extras.validation.twin.simulation import draw_plant

_AMBIENT_C: Final = (10.0, 28.0)
"""Range of the ambient temperature [°C]."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """A pack with logs to identify a model on.

    Parameters
    ----------
    seed : int
    plant : Plant
    training : tuple of Recording
        The first runs from full to empty at a mild temperature.
    ambient_c : tuple of float
        Lowest and highest ambient temperature of further drives [°C].
    """

    seed: int
    plant: Plant
    training: tuple[Recording, ...]
    ambient_c: tuple[float, float]

    @property
    def pack(self) -> TwinPack:
        """Size, thermal masses and sensors."""
        return self.plant.pack

    def draw_drives(
        self, rng: np.random.Generator, count: int, hours: float | None = None
    ) -> tuple[Drive, ...]:
        """Draw drives of the pack within its ambient temperatures.

        At other temperatures the temperature dependence of the healthy pack would open a gap.
        """
        return tuple(
            draw_drive(rng, self.pack, hours=hours, ambient_c=float(rng.uniform(*self.ambient_c)))
            for _ in range(count)
        )


def draw_scenario(seed: int, *, n_temperatures: int = 3, n_training: int = 1) -> Scenario:
    """Draw a pack with training logs.

    Parameters
    ----------
    seed : int
    n_temperatures : int
        Number of drawn temperatures, at least 1, between whose extremes further drives take place.
    n_training : int
        Logs to identify the model on: the first from full to empty.
    """
    rng = np.random.default_rng([seed, 1])
    plant = draw_plant(rng)
    low, high = _AMBIENT_C
    training = [
        draw_drive(
            rng,
            plant.pack,
            hours=float(rng.uniform(2.0, 2.8)),
            ambient_c=float(rng.uniform(18.0, 26.0)),
            start_soc=1.0,
            end_soc=0.02,
            discharge=True,
        )
    ]
    training += [
        draw_drive(rng, plant.pack, ambient_c=float(rng.uniform(low, high)))
        for _ in range(n_training - 1)
    ]
    # One temperature from each of as many equal ranges, at least 4 K apart in all.
    edges = np.linspace(low, high, n_temperatures + 1)
    temperatures = rng.uniform(edges[:-1], edges[1:])
    coldest, warmest = float(temperatures.min()), float(temperatures.max())
    if warmest - coldest <= 4.0:
        coldest, warmest = coldest - 2.0, warmest + 2.0
    return Scenario(
        seed=seed,
        plant=plant,
        training=tuple(
            record_drive(plant, drive, (), name=f"training_{number}")
            for number, drive in enumerate(training, start=1)
        ),
        ambient_c=(coldest, warmest),
    )
