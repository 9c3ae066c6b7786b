"""A simulated pack with healthy logs: training logs of its model, and references."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from cangauge.errors import InputError
from cangauge.extras.validation.twin.drive import Drive, draw_drive
from cangauge.extras.validation.twin.pack import TwinPack
from cangauge.extras.validation.twin.plant import Plant
from cangauge.extras.validation.twin.recording import Recording, record_drive, rms
from cangauge.extras.validation.twin.simulation import PlantName, draw_plant

Climate = Literal["wide", "mild"]

_AMBIENT_C: Final[dict[str, tuple[float, float]]] = {"wide": (-10.0, 35.0), "mild": (10.0, 28.0)}


@dataclass(frozen=True, eq=False)
class Scenario:
    """A pack with healthy logs: to identify a model on, and as references.

    Parameters
    ----------
    seed : int
    plant : Plant
    training, references : tuple of Recording
        The first training log runs from full to empty at a mild temperature.
    reference_drives : tuple of Drive
    climate : {"wide", "mild"}
        Range of the ambient temperature: −10–35 or 10–28 °C.
    """

    seed: int
    plant: Plant
    training: tuple[Recording, ...]
    references: tuple[Recording, ...]
    reference_drives: tuple[Drive, ...]
    climate: Climate

    @property
    def pack(self) -> TwinPack:
        """Size, thermal masses and sensors."""
        return self.plant.pack

    @property
    def sensor_floor_v(self) -> float:
        """RMS error of a perfect model on the references, by the sensors alone [V]."""
        healthy = self.references or self.training
        return rms(np.concatenate([recording.sensor_error_v for recording in healthy]))

    def draw_drives(
        self, rng: np.random.Generator, count: int, hours: float | None = None
    ) -> tuple[Drive, ...]:
        """Draw drives within the ambient temperatures of the references.

        At other temperatures the temperature dependence of the healthy pack would open a gap.
        """
        known = [float(drive.ambient_c[0]) for drive in self.reference_drives]
        low, high = (min(known), max(known)) if known else _AMBIENT_C[self.climate]
        if high - low <= 4.0:
            low, high = low - 2.0, high + 2.0
        return tuple(
            draw_drive(rng, self.pack, hours=hours, ambient_c=float(rng.uniform(low, high)))
            for _ in range(count)
        )


def draw_scenario(
    seed: int,
    *,
    kind: str | None = None,
    chemistry_name: str | None = None,
    n_reference: int = 3,
    n_training: int = 1,
    climate: Climate = "wide",
    plant_name: PlantName = "twin",
) -> Scenario:
    """Draw a pack with healthy logs.

    Parameters
    ----------
    seed : int
    kind, chemistry_name : str, optional
        As in `draw_pack`.
    n_reference : int
        Reference logs, their ambient temperatures spread over the climate.
    n_training : int
        Logs to identify the model on: the first from full to empty.
    climate : {"wide", "mild"}
    plant_name : {"twin", "equation", "published", "pybamm"}
        Model of the cells; `pybamm` needs the extra of that name.

    Raises
    ------
    InputError
        For a number or name out of range.
    """
    if n_training < 1 or n_reference < 0:
        raise InputError(
            "a scenario needs a training log, and no negative number of references",
            value=(n_training, n_reference),
        )
    if climate not in _AMBIENT_C:
        raise InputError("unknown climate", value=climate, cure="use wide or mild")
    rng = np.random.default_rng([seed, 1])
    plant = draw_plant(rng, kind, chemistry_name, plant_name)
    pack = plant.pack
    low, high = _AMBIENT_C[climate]
    training = [
        draw_drive(
            rng,
            pack,
            hours=float(rng.uniform(2.0, 2.8)),
            ambient_c=float(rng.uniform(18.0, 26.0)),
            start_soc=1.0,
            end_soc=0.02,
            discharge=True,
        )
    ]
    training += [
        draw_drive(rng, pack, ambient_c=float(rng.uniform(low, high)))
        for _ in range(n_training - 1)
    ]
    # One temperature from each of as many equal ranges, in random order.
    edges = np.linspace(low, high, n_reference + 1)
    ambient = rng.permutation(rng.uniform(edges[:-1], edges[1:]))
    references = tuple(draw_drive(rng, pack, ambient_c=float(degrees)) for degrees in ambient)
    return Scenario(
        seed=seed,
        plant=plant,
        training=tuple(
            record_drive(plant, drive, (), name=f"training_{number}")
            for number, drive in enumerate(training, start=1)
        ),
        references=tuple(
            record_drive(plant, drive, (), name=f"reference_{number}")
            for number, drive in enumerate(references, start=1)
        ),
        reference_drives=references,
        climate=climate,
    )
